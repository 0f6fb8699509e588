"""report.html: one self-contained page that shows whether to trust a fit."""

import base64
import io
import math
from dataclasses import dataclass
from importlib import resources

import jinja2
import matplotlib
import numpy as np
from PIL import Image

from mi_ring import bridge
from mi_ring.capture import linear_to_srgb, to_bytes

matplotlib.use("Agg")
from matplotlib import pyplot as plt

THUMBNAIL = 192  # width and height of the pictures, at most [px]


@dataclass
class Row:
    """One photograph of the page: its numbers and pictures as data URIs."""

    name: str
    psnr: float
    iou: float | None
    pictures: dict[str, str]


def html(fit, log: list[dict]) -> str:
    """The page for a `Fit` whose surface is shown at its final resolution."""
    capture, ring = fit.capture, fit.ring
    rows, errors = [], []
    for k in capture.spread():
        row, error = compare(fit, k, capture.names[k])
        rows.append(row)
        errors.append(error)
    masked = [row.iou for row in rows if row.iou is not None]
    s, faces = ring.domain.sample(fit.config.subdivisions)
    numbers = {
        "Photographs": f"{len(capture)}" + (f"; below are {len(rows)} of them, as are the next two numbers"
                                             if len(rows) < len(capture) else ""),
        "PSNR of the photographs": f"{-10 * np.log10(np.mean(errors)):.2f} dB (sRGB, all pixels)",
        "Silhouettes": f"{np.mean(masked):.4f} intersection over union with the masks" if masked else "no masks given",
        "Iterations": f"{fit.iteration} of {fit.iterations}",
        "Fit time": f"{fit.seconds:.0f} s",
        "Mesh": f"{len(s):,} vertices, {len(faces):,} triangles, closed",
        "Normalising sphere": "centre ({:.5g}, {:.5g}, {:.5g}), radius {:.5g}".format(*ring.center, ring.radius),
    }
    template = resources.files("mi_ring").joinpath("report.html.jinja").read_text()
    environment = jinja2.Environment(autoescape=True)
    return environment.from_string(template).render(
        name=fit.config.name, rows=rows, numbers=numbers, curve=loss_curve(log, fit), settings=fit.config.settings()
    )


def compare(fit, k: int, name: str) -> tuple[Row, float]:
    """The row of photograph `k`, and its mean squared error over all pixels of the sRGB image."""
    capture = fit.capture
    observed, _, mask, masked = capture.observe([k])
    predicted, coverage = bridge.draw(
        fit.surface, capture.photograph(k), spp=4, shadows=capture.shadows, indirect=fit.ring.indirect
    )
    photo, guess = linear_to_srgb(observed[0].numpy()), linear_to_srgb(predicted[0].numpy())
    small = capture.photograph(k, max(1, max(capture.sensors[k].size) // THUMBNAIL))
    parameters = fit.ring.brdf_net.bsdf_parameters
    maps = {key: m[0] for key, m in bridge.maps(fit.surface, small, parameters).items()}
    normal = np.where((maps["normal"] != 0).any(-1, keepdims=True), maps["normal"] * 0.5 + 0.5, 0)
    pictures = {
        "photograph": photo,
        "prediction": guess,
        "4 × difference": 4 * np.abs(photo - guess),
        "normals": normal,
    }
    for p in parameters:
        if math.isinf(p.high):
            pictures[p.name] = linear_to_srgb((maps[p.name] - p.low) / (2.5 * float(fit.ring.brdf_net.scale)))
        else:
            value = (maps[p.name] - p.low) / (p.high - p.low)
            pictures[p.name] = linear_to_srgb(value) if p.channels == 3 else value
    iou = None
    if masked:
        inside, found = mask[0].numpy() > 0.5, coverage[0].numpy() > 0.5
        iou = float((inside & found).sum() / max(1, (inside | found).sum()))
    error = float(np.mean((photo - guess) ** 2))
    pictures = {title: data_uri(picture) for title, picture in pictures.items()}
    return Row(name, -10 * np.log10(max(error, 1e-10)), iou, pictures), error


def data_uri(picture: np.ndarray) -> str:
    """An (H, W) or (H, W, 3) picture in [0, 1] as a JPEG thumbnail."""
    image = Image.fromarray(to_bytes(picture))
    image.thumbnail((THUMBNAIL, THUMBNAIL))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def loss_curve(log: list[dict], fit) -> str:
    """The loss and its weighted terms over the iterations as an SVG data URI."""
    figure, axes = plt.subplots(figsize=(9, 3.2), layout="constrained")
    for term in ("loss", *fit.config.weights):
        points = []
        for entry in log:
            done = (entry["iteration"] - 1) / fit.iterations  # before the iteration that the entry is about
            weights = {"loss": 1.0} | fit.config.weights_at(done)
            points.append((entry["iteration"], weights[term] * entry.get(term, 0)))
        points = [(iteration, value) for iteration, value in points if value > 0]
        if points:
            label = "loss" if term == "loss" else f"weighted {term}"
            axes.semilogy(*zip(*points), label=label, linewidth=2 if term == "loss" else 1)
    for stage in fit.stages[1:]:
        if stage.first < fit.iteration:
            axes.axvline(stage.first, color="0.7", linewidth=1, linestyle=":")
    axes.set_xlabel("iteration (dotted: next stage)")
    axes.grid(alpha=0.3)
    if log:
        axes.legend(loc="upper right")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg")
    plt.close(figure)
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
