"""Figures of experiments, of what their runs have found."""

import functools
import textwrap
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.figure import Figure

from mi_ring.capture.loading import load_capture
from mi_ring.experiments.experiment import Outcome, Row
from mi_ring.experiments.measures import errors_from_one_side
from mi_ring.experiments.single_view import SingleView
from mi_ring.experiments.slices import ANGLES
from mi_ring.images import linear_to_srgb
from mi_ring.metrics.surfaces import hits, load_true_mesh
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import MaterialOptions, dress
from mi_ring.objects.ring_file import load_fit
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

WIDTH = 256  #: of pictures, at most [px]
SPP = 16  #: of theirs
WORST = 20.0  #: error of normals that is drawn brightest [deg]

Drawing = Callable[[list[Outcome]], Figure]


def title_of(outcome: Outcome, but: str = "") -> str:
    """The labels of a run `but` one, of those whose words say little by themselves with their names."""
    return ", ".join(v if isinstance(v, str) else f"{k} {v}" for k, v in outcome.run.labels.items() if k != but)


def of_done(draw: Drawing) -> Drawing:
    """A figure of the runs that are done, and a line that names those that have failed."""

    @functools.wraps(draw)
    def noted(ran: list[Outcome]) -> Figure:
        figure = draw([outcome for outcome in ran if not outcome.failed])
        if failed := [title_of(outcome) for outcome in ran if outcome.failed]:
            figure.supxlabel(textwrap.fill(f"failed: {'; '.join(failed)}", 50), fontsize=8)
        return figure

    return noted


def bars(*columns: tuple[str, str]) -> Drawing:
    """A diagram for each of some columns, (name, heading) each, a bar for each run, or a word that it has none."""

    def draw(ran: list[Outcome]) -> Figure:
        figure = Figure(figsize=(4.5 * len(columns), 1.2 + 0.35 * len(ran)), layout="constrained")
        for axes, (name, heading) in zip(np.ravel(figure.subplots(1, len(columns), sharey=True)), columns):
            for place, outcome in enumerate(ran):
                value = outcome.rows[0].get(name, "") if outcome.rows else "failed"
                if isinstance(value, str) or not np.isfinite(value):
                    axes.text(0, place, f" {value}".replace("nan", "NaN"), va="center")
                else:
                    axes.barh(place, value, color="steelblue")
            axes.set(xlabel=heading, ylim=(len(ran) - 0.5, -0.5))
            axes.set_yticks(range(len(ran)), [title_of(outcome) for outcome in ran])
            axes.set_xlim(left=0)
        return figure

    return draw


def curves(x: tuple[str, str], y: tuple[str, str], logarithmic: bool = False) -> Drawing:
    """One number over another, (name, heading) each, a line for those runs whose other labels are the same."""

    @of_done
    def draw(done: list[Outcome]) -> Figure:
        figure = Figure(figsize=(6, 4), layout="constrained")
        axes = figure.subplots()
        lines = dict[str, list[Row]]()
        for outcome in done:
            lines.setdefault(title_of(outcome, x[0]), []).extend({**outcome.run.labels, **r} for r in outcome.rows)
        for title, rows in lines.items():
            points = sorted((row[x[0]], row[y[0]]) for row in rows)
            gaps = ", ".join(f"{a:g}" for a, b in points if not np.isfinite(b))
            axes.plot(*zip(*points), "o-", label=title + f"; NaN at {gaps}" * bool(gaps))
        axes.set(xlabel=x[1], ylabel=y[1], ylim=(0, None), **({"xscale": "log"} if logarithmic else {}))
        axes.legend()
        return figure

    return draw


@of_done
def slices(done: list[Outcome]) -> Figure:
    """BRDFs by the angle from the normal, found and true, light and camera at one place: of each run the median."""
    figure = Figure(figsize=(4 * len(done), 3.6), layout="constrained")
    for axes, outcome in zip(np.ravel(figure.subplots(1, len(done), squeeze=False)), done):
        assert outcome.made
        with np.load(outcome.made.folder / "slices.npz") as arrays:
            for name, style in (("truth", "-"), ("found", "--")):
                for channel, colour in enumerate(("firebrick", "seagreen", "royalblue")):
                    axes.plot(np.degrees(ANGLES), arrays[name][:, channel], style, color=colour)
        axes.set(xlabel="θh, camera and light at one place [°]", yscale="log", title=title_of(outcome))
    figure.axes[0].set_ylabel("BRDF [1/sr]; lines: true, dashes: found")
    return figure


@of_done
def pictures(done: list[Outcome]) -> Figure:
    """Of each run a photograph, what the fit predicts for it, and the error of its normals."""
    heads = "photograph", "fit", f"error of normals, yellow: {WORST:.0f}° or more"
    return grid([(title_of(outcome), three_pictures(outcome)) for outcome in done], heads)


@of_done
def swapped(done: list[Outcome]) -> Figure:
    """Every shape with every material, each shape in a row."""
    rows = []
    for shape in done:
        assert shape.made
        cells = []
        for material in done:
            assert material.made
            ring = load_fit(shape.made.folder)
            if material is not shape:
                dress(ring, MaterialOptions(material=material.made.folder))
            cells.append(predicted(shape, ring)[0])
        rows.append((title_of(shape), cells))
    return grid(rows, [f"material: {title_of(outcome)}" for outcome in done])


def grid(rows: Sequence[tuple[str, list[np.ndarray]]], heads: Sequence[str]) -> Figure:
    """Pictures (H, W, 3) or (H, W), a row each with a title."""
    figure = Figure(figsize=(2.6 * len(heads), 2.7 * len(rows)), layout="constrained")
    for line, (title, images) in zip(figure.subplots(len(rows), len(heads), squeeze=False), rows):
        for axes, image in zip(line, images):
            axes.imshow(image, cmap="inferno", vmin=0, vmax=WORST if image.ndim == 2 else None)
            axes.set(xticks=[], yticks=[])
        line[0].set_ylabel(title, fontsize=8)
    for axes, head in zip(figure.axes, heads):
        axes.set_title(head, fontsize=8)
    return figure


def three_pictures(outcome: Outcome) -> list[np.ndarray]:
    """As `pictures` shows them, of the first photograph."""
    assert outcome.made
    made = outcome.made
    picture, scale = predicted(outcome, load_fit(made.folder))
    capture = load_capture(made.scene)
    observed = linear_to_srgb(capture.observe([0], scale).rgb[0].numpy())
    if isinstance(outcome.run.recipe, SingleView):
        return [observed.clip(0, 1), picture, errors_from_one_side(outcome.run, made)[0]]
    photograph = capture.photograph(0, scale)
    meshes = made.folder / "mesh.ply", made.truth / "mesh.ply"
    found, true = (hits(load_true_mesh(mesh)[1], photograph) for mesh in meshes)
    error = np.degrees(np.arccos(np.clip((found[2] * true[2]).sum(1), -1, 1)))
    error = np.where(found[0] & true[0], error, np.where(found[0] ^ true[0], 90.0, np.nan))
    return [observed.clip(0, 1), picture, error.reshape(observed.shape[:2])]


def predicted(outcome: Outcome, ring: FittedObject) -> tuple[np.ndarray, int]:
    """What the first photograph shows by a fit, sRGB (H, W, 3), and by what it is made smaller."""
    assert outcome.made
    capture = load_capture(outcome.made.folder / "scene.xml", images=False)
    scale = -(-capture.sensors[0].size[0] // WIDTH)
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    rgb, _ = prediction.draw(
        surface, capture.photograph(0, scale), SPP, shadows=capture.shadows, indirect=ring.indirect
    )
    return linear_to_srgb(rgb[0].numpy()).clip(0, 1), scale
