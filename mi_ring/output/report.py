"""Makes report.html: a self-contained page that shows the quality of a fit."""

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from itertools import chain
from typing import Any, NamedTuple

import jinja2
import numpy as np
from PIL import Image
from scipy import ndimage
from skimage.measure import block_reduce
from skimage.registration import phase_cross_correlation

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import recorded
from mi_ring.capture.pairs import camera_numbers
from mi_ring.images import encoded_picture, linear_to_srgb, to_bytes
from mi_ring.metrics.capture_findings import moved_far
from mi_ring.metrics.image_errors import comparable
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.output.calibration_panel import held_out_text, panel
from mi_ring.output.fit_result import FitResult
from mi_ring.output.svg import new_figure, svg_uri
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface
from mi_ring.system.command import scene_name
from mi_ring.system.machine import pipelined
from mi_ring.version import __version__

REGISTERED = 1024  # largest side of the pictures whose shift is measured [px]
TOGETHER = 4  # photographs that are drawn at once
PICTURE = 480  # largest side of the pictures on the page [px]
WHITE_LEVEL = 5  # of the mesh at whose vertices the largest value of a BSDF parameter is looked for

# Thresholds of the findings.
LOW_PSNR, LOW_IOU = 3.0, 0.9  # PSNR below the median of all photographs [dB]; IoU of prediction and mask
UNEXPLAINED = 0.3  # share of the object's light; good fits end at 0.07 to 0.15
FEW_ITERATIONS = 60
SATURATED = 0.25  # share of the object's pixels, in one photograph
SHIFTED, ALL_SHIFTED = 1.0, 0.25  # shift of one photograph relative to the others, and of all photographs [px]


@dataclass
class PhotographPanel:
    """One photograph of the report: its numbers, and its pictures as data URIs by title."""

    name: str
    psnr: float
    iou: float | None
    saturated: float  # share of the object's pixels
    shift: tuple[float, float] | None  # how far the photograph is right of and below its prediction [px of its file]
    pictures: dict[str, str]
    held_out: bool = False  # then the page has no findings about it
    pixel: float = 1.0  # side of a pixel of the compared photograph [px of its file]


def report_html(result: FitResult, glb: bytes | None = None, unseen: float | None = None) -> str:
    """Make the report of a fit. Renders photographs. Returns the HTML text, and writes no file.

    `glb`: bytes of a GLB file, which the viewer of the page shows; None: no viewer. `unseen`: share of the surface area
    that no photograph shows; None: unknown.
    """
    capture, ring, refined = result.capture, result.ring, result.calibration
    surface = result.drawn(ring.subdivisions)
    some = list(capture.together(capture.spread(), TOGETHER))
    parts = pipelined(partial(predicted, result, surface), partial(panels_of, result, white(ring)), some)
    cameras = camera_numbers(capture)[shown := np.concatenate(some)]  # photographs of one are beside each other
    panels = [panel for *_, panel in sorted(zip(cameras, shown, chain(*parts)), key=lambda entry: entry[:2])]
    rows = [row for row, _ in panels]
    fitted, errors = zip(*([panel for panel in panels if not panel[0].held_out] or panels))  # all may be held out
    known = [error for error in errors if not math.isnan(error)]
    masked = [row.iou for row in fitted if row.iou is not None]
    overlap = "intersection over union with the masks"
    pixels = "the object's pixels" if capture.lit_room else "all pixels"
    s, faces = ring.domain.sample(ring.subdivisions)
    made = f"sRGB, {pixels}, 4 samples each"
    if any(scale_of(result, size) > 1 for size in capture.sizes):
        made += f", at most {result.width} px wide"
    numbers = {
        "Photographs": f"{len(capture)}"
        + (f"; below are {len(rows)} of them, as are the next two numbers" if len(rows) < len(capture) else ""),
        "PSNR of the photographs": f"{-10 * np.log10(np.mean(known)):.2f} dB ({made})" if known else "no valid pixels",
        "Silhouettes": f"{np.mean(masked):.4f} {overlap}" if masked else "no masks of the whole object",
        "Iterations": f"{result.iteration} of {result.iterations}",
        "Fit time": f"{result.seconds:.0f} s",
        **({"Photographs kept out": held_out_text(result.validation)} if len(result.held_out) else {}),
        "Mesh": f"{len(s):,} vertices, {len(faces):,} triangles, closed",
        **({} if unseen is None else {"Seen by no photograph": f"{unseen:.1%} of the surface's area"}),
        "Made by": f"mi_ring {__version__}",
        "Normalising sphere": "centre ({:.5g}, {:.5g}, {:.5g}), radius {:.5g}".format(*ring.center, ring.radius),
    }
    files = resources.files("mi_ring.output")
    template = jinja2.Environment(autoescape=True).from_string(files.joinpath("report.html.jinja").read_text("utf-8"))
    return template.render(
        name=scene_name(result.given.path), version=__version__, rows=rows, numbers=numbers, curve=loss_curve(result),
        settings=result.settings,
        findings=fit_findings(fitted, result.iteration, result.iterations, refined, result.unexplained),
        refined=refined and panel(result.before, capture, refined),
        view=first_view(capture, ring), glb=glb and base64.b64encode(glb).decode(),
        saturated=SATURATED, viewer=(files / "viewer" / "viewer.min.js").read_text("utf-8"),
    )  # fmt: skip


def first_view(capture: Capture, ring: FittedObject) -> dict[str, list[float]]:
    """Choose camera and light with which the viewer of the report starts. Returns lists of three numbers by name.

    `up`: up direction. `eye`: position of the first photograph's camera [scene units]. `irradiance`: RGB at the centre
    of the object, the median over the photographs; 1 if the photographs have no light of their own.
    """
    eye, received = capture.shots[0].camera.position, capture.photographs.irradiance(ring.center.cpu().numpy())
    irradiance = np.median(received[capture.photographs.mainly], axis=0)
    if not irradiance.any():  # photographs have no lights of their own
        irradiance = np.ones(3)
    return {"up": capture.up.tolist(), "eye": eye.tolist(), "irradiance": irradiance.tolist()}


def fit_findings(
    rows: Sequence[PhotographPanel], iteration: int, iterations: int, refined: dict[str, Any] | None = None,
    unexplained: float = 0.0,
) -> list[str]:  # fmt: skip
    """List problems of a fit as sentences for the user. Each sentence contains advice.

    `rows`: the photographs that the fit used. `iteration`: number of iterations that are done. `iterations`: number
    that the whole fit has. `refined`: content of calibration.json; None: nothing was refined. `unexplained`: share of
    the object's light that the fit does not predict, 0 to 1.
    """
    found = []
    if iteration == iterations >= FEW_ITERATIONS and unexplained > UNEXPLAINED:
        found.append(f"{unexplained:.0%} of the object's light is not as predicted: do not trust this surface. "
                     "Cameras, masks or lights are wrong; see the contact sheet of mi-ring check.")  # fmt: skip
    if iteration == iterations < FEW_ITERATIONS:
        found.append(f"The fit had {iterations} iterations, too few for an accurate surface.")
    if iteration < iterations:
        found.append(f"The fit ended early, at iteration {iteration} of {iterations}: continue it with --resume.")

    typical, scatter = middle([row.psnr for row in rows if not math.isnan(row.psnr)])
    limit = typical - max(LOW_PSNR, 3 * scatter)
    if few := worst((row.psnr, row.name, f"{row.psnr:.1f} dB") for row in rows if row.psnr < limit):
        found.append(f"{few}: far below the others' {typical:.1f} dB; see the difference there. If a longer fit "
                     "does not help, correct pose, light or mask, or leave the photograph out.")  # fmt: skip
    covers = [(row.iou, row.name) for row in rows if row.iou is not None]
    if few := worst((iou, name, f"IoU {iou:.2f}") for iou, name in covers if iou < LOW_IOU):
        found.append(f"{few}: prediction and mask do not overlap well; check mask and pose with "
                     "mi-ring check.")  # fmt: skip
    if few := worst((-row.saturated, row.name, f"{row.saturated:.1%}") for row in rows if row.saturated > SATURATED):
        found.append(f"{few}: so much of the object is saturated; the fit only knows that it is at least this bright. "
                     "Expose less.")  # fmt: skip

    shifts = [(row.name, row.shift) for row in rows if row.shift is not None]
    if shifts:
        shift, scatter = middle([by for _, by in shifts])
        scatter = np.hypot(*scatter)
        pixel = float(np.median([row.pixel for row in rows]))
        if np.hypot(*shift) > max(ALL_SHIFTED * pixel, 3 * scatter / math.sqrt(len(shifts))):
            found.append(f"The photographs are shifted against their predictions, {sides(*shift)} (median): masks or "
                         "cameras may be wrong. If cameras were measured, check cx and cy: the first pixel's centre is "
                         "at (0.5, 0.5). Otherwise try --refine auto principal.")  # fmt: skip
        away = [(name, np.subtract(by, shift)) for name, by in shifts]
        limit = max(SHIFTED * pixel, 3 * scatter)
        if few := worst((-np.hypot(*by), name, sides(*by)) for name, by in away if np.hypot(*by) > limit):
            found.append(f"{few}: shifted against the prediction, unlike the others; correct the pose, or leave the "
                         "photograph out.")  # fmt: skip
    if refined and (few := moved_far(refined["photographs"])):
        found.append(f"{few}: the fit has moved the camera much farther than the others': out of focus, or another "
                     "scene? Then leave the photograph out.")  # fmt: skip
    return found


def middle(values: Sequence[float] | Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Compute (median, robust standard deviation) of values (n, ...) over n.

    The standard deviation is estimated by the median absolute deviation.
    """
    median = np.median(values, axis=0)
    return median, 1.4826 * np.median(np.abs(np.subtract(values, median)), axis=0)


def worst(photographs: Iterable[tuple[float, str, str]], most: int = 5) -> str:
    """Return a text for the user that lists the photographs with the lowest ranks; empty if there are no photographs.

    `photographs`: tuples (rank, name, number as text). `most`: how many are listed by name; the text counts the others.
    """
    ranked = [f"{name} ({number})" for _, name, number in sorted(photographs)]
    return ", ".join(ranked[:most]) + (f" and {len(ranked) - most} more" if len(ranked) > most else "")


def sides(x: float, y: float) -> str:
    """Describe a shift of (`x`, `y`) pixels as text, for example "1.0 px to the right and 2.0 px above".

    A positive `x` is a shift to the right, a positive `y` is a shift downward. A shift that rounds to 0.0 is left out.
    """
    parts = [(x, "to the right" if x > 0 else "to the left"), (y, "below" if y > 0 else "above")]
    return " and ".join(
        f"{abs(by):.1f} px {where}" for by, where in parts if abs(by) >= 0.05 or by == max(x, y, key=abs)
    )


class PredictedPhotograph(NamedTuple):
    """The prediction of one photograph."""

    rgb: np.ndarray  #: (H, W, 3) linear radiance
    coverage: np.ndarray  #: (H, W), in [0, 1]
    maps: dict[str, np.ndarray]  #: normals and material, as `prediction.maps` returns them, smaller


def scale_of(result: FitResult, size: tuple[int, int]) -> int:
    """Return the factor by which photographs of this size are reduced before the report compares them.

    `size`: (width, height) [px]. The width is then at most the width in the last stage of the fit.
    """
    return -(-size[0] // result.width)


def predicted(result: FitResult, surface: Surface, index: np.ndarray) -> list[PredictedPhotograph]:
    """Render the predictions of the photographs with indices `index` (n,). All of them must have the same size.

    `surface`: the fitted surface, ready for rendering. Returns n predictions in the order of `index`.
    """
    capture, ring = result.capture, result.ring
    size = capture.shots[index[0]].size
    scale = scale_of(result, size)
    rgb, coverage = prediction.draw(
        surface, capture.selected(index, scale), spp=4, shadows=capture.shadows, indirect=ring.indirect, paths=4
    )
    small = capture.selected(index, max(scale, max(size) // PICTURE))
    maps = prediction.maps(surface, small, ring.brdf_net.bsdf_parameters)
    return [
        PredictedPhotograph(rgb[n].numpy(), coverage[n].numpy(), {name: values[n] for name, values in maps.items()})
        for n in range(len(index))
    ]


def white(ring: FittedObject) -> dict[str, float]:
    """Return for each BSDF parameter the value that the report shows as white. The surface has hardly any above it."""
    material = ring.material(ring.domain.sample(min(WHITE_LEVEL, ring.subdivisions))[0].to(ring.center.device))
    parameters = ring.brdf_net.bsdf_parameters
    largest = {p: float(np.quantile(material[p.name].numpy(force=True), 0.99)) for p in parameters}
    return {p.name: max(value, p.low + 1e-6) for p, value in largest.items()}


def panels_of(
    result: FitResult, white: dict[str, float], index: np.ndarray, predictions: Sequence[PredictedPhotograph]
) -> list[tuple[PhotographPanel, float]]:
    """Compare photographs with their predictions. Returns (panel, mean squared sRGB error) for each, in this order.

    `white`: result of the function `white`. `index` (n,): indices of the photographs. `predictions`: their n
    rendered predictions.
    """
    return [panel_of(result, white, int(k), prediction) for k, prediction in zip(index, predictions)]


def panel_of(
    result: FitResult, white: dict[str, float], k: int, prediction: PredictedPhotograph
) -> tuple[PhotographPanel, float]:
    """Compare photograph `k` with its prediction. Returns (panel for the report, mean squared sRGB error).

    `white`: result of the function `white`.

    The error is the mean over all valid pixels. If the room was lit and the photograph has a mask, it is the mean over
    the valid pixels in the mask.
    """
    capture = result.capture
    scale = scale_of(result, capture.shots[k].size)
    seen, maps = capture.observe([k], scale), prediction.maps
    observed, saturated, mask, masked = (t[0].numpy() for t in seen[:4])
    valid = np.ones(mask.shape, bool) if seen.valid is None else seen.valid[0].numpy()
    shot = capture.shots[k]
    shown = prediction.rgb * valid[..., None]
    photo, guess = (linear_to_srgb(recorded(linear, shot, scale)) for linear in (observed, shown))
    found = (prediction.coverage > 0.5) & valid
    inside = (mask > 0.5) & valid if masked else found
    normal = np.where((maps["normal"] != 0).any(-1, keepdims=True), maps["normal"] * 0.5 + 0.5, 0)
    telling = comparable(capture, seen)
    compared = telling if telling.any() else valid
    pictures = {
        "photograph": photo,
        "prediction": guess,
        "4 × difference": 4 * np.abs(photo - guess) * compared[..., None],
        "normals": normal,
    }
    for p in result.ring.brdf_net.bsdf_parameters:
        value = (maps[p.name] - p.low) / (white[p.name] - p.low)
        pictures[f"{p.name}, white is {white[p.name]:.2g}"] = linear_to_srgb(value) if p.channels == 3 else value
    error = float(np.mean((photo - guess)[compared] ** 2)) if compared.any() else math.nan
    by = shift(photo * inside[..., None] if masked else photo, guess, inside | found)
    along, down = shot.window.scale if shot.window else (1.0, 1.0)
    row = PhotographPanel(
        name=capture.names[k],
        psnr=-10 * np.log10(max(error, 1e-10)),
        iou=float((inside & found).sum() / max(1, (inside | found).sum())) if masked and capture.whole else None,
        saturated=float(saturated[inside].any(-1).mean()) if inside.any() else 0.0,
        shift=by and (scale * along * by[0], scale * down * by[1]),
        pixel=float(along),
        held_out=k in result.held_out,
        pictures={title: data_uri(picture) for title, picture in pictures.items()},
    )
    return row, error


def shift(photo: np.ndarray, guess: np.ndarray, inside: np.ndarray) -> tuple[float, float] | None:
    """Estimate the translation (right, down) [px] from the picture `guess` to the picture `photo`, both (H, W, 3).

    `inside` (H, W) bool: the region that is compared. Returns None if it is empty, or if a picture is black.
    """
    if not (photo.any() and guess.any() and inside.any()):
        return None
    rows, columns = ndimage.find_objects(ndimage.binary_dilation(inside, iterations=8).astype(np.uint8))[0]
    a, b = (picture[rows, columns].mean(-1) for picture in (photo, guess))
    scale = -(-max(a.shape) // REGISTERED)
    a, b = (block_reduce(picture, scale, np.mean) for picture in (a, b))
    down, right = scale * phase_cross_correlation(a, b, upsample_factor=10, normalization=None)[0]
    return float(right), float(down)


def data_uri(picture: np.ndarray) -> str:
    """Encode a picture (H, W) or (H, W, 3) in [0, 1] as the data URI of a small WebP."""
    image = Image.fromarray(to_bytes(picture))
    image.thumbnail((PICTURE, PICTURE))
    content = encoded_picture(image, "WEBP", quality=85, method=1)  # method 1: faster, hardly larger
    return "data:image/webp;base64," + base64.b64encode(content).decode()


def loss_curve(result: FitResult) -> str:
    """Draw the loss and its weighted terms over the iterations as an SVG data URI."""
    figure = new_figure(9, 3.2)
    axes = figure.subplots()
    for term in ("loss", *result.terms):
        points = []
        for entry in result.log:
            weight = 1.0 if term == "loss" else entry["weights"].get(term, 0.0)
            points.append((entry["iteration"], weight * entry.get(term, 0.0)))
        points = [(iteration, value) for iteration, value in points if value > 0]
        if points:
            label = "loss" if term == "loss" else f"weighted {term}"
            axes.semilogy(*zip(*points), label=label, linewidth=2 if term == "loss" else 1)
    for first in result.stage_starts[1:]:
        if first < result.iteration:
            axes.axvline(first, color="0.7", linewidth=1, linestyle=":")
    axes.set_xlabel("iteration (dotted: next stage)")
    axes.grid(alpha=0.3)
    if result.log:
        figure.legend(loc="outside right upper")
    return svg_uri(figure)
