"""Figures of experiments."""

import functools
import textwrap
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.figure import Figure

from mi_ring.capture.loading import load_capture
from mi_ring.experiments.brdf_slices import ANGLES
from mi_ring.experiments.experiment import Outcome, Row
from mi_ring.experiments.measures import normal_errors
from mi_ring.experiments.single_view import SingleView
from mi_ring.images import linear_to_srgb
from mi_ring.metrics.surfaces import hits, load_true_mesh
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import MaterialOptions, edit_material
from mi_ring.objects.ring_file import load_fit
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

WIDTH = 256  #: greatest width of pictures [px]
SPP = 16  #: samples per pixel of pictures
WORST = 20.0  #: error of normals at the bright end of the colour map [deg]

Plot = Callable[[list[Outcome]], Figure]


def title_of(outcome: Outcome, but: str = "") -> str:
    """Return the labels of a run as text, without the label `but`: for example "bunny, views 5".

    The name of a label is before its value if the value is a number.
    """
    return ", ".join(v if isinstance(v, str) else f"{k} {v}" for k, v in outcome.run.labels.items() if k != but)


def of_finished(plot: Plot) -> Plot:
    """Decorator of a plot. The plot then gets only the finished runs. A line below the figure names the failed runs."""

    @functools.wraps(plot)
    def annotated(outcomes: list[Outcome]) -> Figure:
        figure = plot([outcome for outcome in outcomes if not outcome.failed])
        if failed := [title_of(outcome) for outcome in outcomes if outcome.failed]:
            figure.supxlabel(textwrap.fill(f"failed: {'; '.join(failed)}", 50), fontsize=8)
        return figure

    return annotated


def bars(*columns: tuple[str, str]) -> Plot:
    """Return a function that draws a bar chart for each of the `columns`, given as (name in the table, heading).

    Each run has one bar. If a run has no number, the chart shows a word instead, such as "failed".
    """

    def plot(outcomes: list[Outcome]) -> Figure:
        figure = Figure(figsize=(4.5 * len(columns), 1.2 + 0.35 * len(outcomes)), layout="constrained")
        for axes, (name, heading) in zip(np.ravel(figure.subplots(1, len(columns), sharey=True)), columns):
            for place, outcome in enumerate(outcomes):
                value = outcome.rows[0].get(name, "") if outcome.rows else "failed"
                if isinstance(value, str) or not np.isfinite(value):
                    axes.text(0, place, f" {value}".replace("nan", "NaN"), va="center")
                else:
                    axes.barh(place, value, color="steelblue")
            axes.set(xlabel=heading, xlim=(0, None), ylim=(len(outcomes) - 0.5, -0.5))
            axes.set_yticks(range(len(outcomes)), [title_of(outcome) for outcome in outcomes])
        return figure

    return plot


def curves(x: tuple[str, str], y: tuple[str, str], logarithmic: bool = False) -> Plot:
    """Return a function that draws one column of the table over another.

    `x`, `y`: (name in the table, heading) of both. Runs that differ only in x are one curve. `logarithmic`: the x axis
    is logarithmic.
    """

    @of_finished
    def plot(outcomes: list[Outcome]) -> Figure:
        figure = Figure(figsize=(6, 4), layout="constrained")
        axes = figure.subplots()
        lines = dict[str, list[Row]]()
        for outcome in outcomes:
            lines.setdefault(title_of(outcome, x[0]), []).extend({**outcome.run.labels, **r} for r in outcome.rows)
        for title, rows in lines.items():
            points = sorted((row[x[0]], row[y[0]]) for row in rows)
            gaps = ", ".join(f"{a:g}" for a, b in points if not np.isfinite(b))
            axes.plot(*zip(*points), "o-", label=title + f"; NaN at {gaps}" * bool(gaps))
        axes.set(xlabel=x[1], ylabel=y[1], ylim=(0, None), **({"xscale": "log"} if logarithmic else {}))
        axes.legend()
        return figure

    return plot


@of_finished
def slices(outcomes: list[Outcome]) -> Figure:
    """Draw the true and the fitted BRDF for each run, as medians over the surface.

    The x axis is the angle between the normal and the common direction of light and camera.
    """
    figure = Figure(figsize=(4 * len(outcomes), 3.6), layout="constrained")
    for axes, outcome in zip(np.ravel(figure.subplots(1, len(outcomes), squeeze=False)), outcomes):
        with np.load(outcome.folder / "slices.npz") as arrays:
            for name, style in (("truth", "-"), ("found", "--")):
                for channel, colour in enumerate(("firebrick", "seagreen", "royalblue")):
                    axes.plot(np.degrees(ANGLES), arrays[name][:, channel], style, color=colour)
        axes.set(xlabel="θh, camera and light at one place [°]", yscale="log", title=title_of(outcome))
    figure.axes[0].set_ylabel("BRDF [1/sr]; lines: true, dashes: found")
    return figure


@of_finished
def pictures(outcomes: list[Outcome]) -> Figure:
    """Draw a row for each run: its first photograph, a rendering of the fitted object, and a map of normal errors."""
    rows = []
    for outcome in outcomes:
        folder, dataset = outcome.folder, outcome.run.dataset
        picture, scale = predicted(outcome, load_fit(folder))
        capture = load_capture(dataset.scene)
        observed = linear_to_srgb(capture.observe([0], scale).rgb[0].numpy()).clip(0, 1)
        if isinstance(dataset, SingleView):
            error = normal_errors(outcome.run, folder)[0]
        else:
            photograph = capture.photograph(0, scale)
            found, true = (hits(load_true_mesh(place / "mesh.ply")[1], photograph) for place in (folder, dataset.truth))
            error = np.degrees(np.arccos(np.clip((found[2] * true[2]).sum(1), -1, 1)))
            error = np.where(found[0] & true[0], error, np.where(found[0] ^ true[0], 90.0, np.nan))
            error = error.reshape(observed.shape[:2])
        rows.append((title_of(outcome), [observed, picture, error]))
    return grid(rows, ["photograph", "fit", f"error of normals, yellow: {WORST:.0f}° or more"])


@of_finished
def swapped(outcomes: list[Outcome]) -> Figure:
    """Draw the shape of each run with the material of each run. Shapes are rows, materials are columns."""
    rows = []
    for shape in outcomes:
        cells = []
        for material in outcomes:
            ring = load_fit(shape.folder)
            if material is not shape:
                edit_material(ring, MaterialOptions(material=material.folder))
            cells.append(predicted(shape, ring)[0])
        rows.append((title_of(shape), cells))
    return grid(rows, [f"material: {title_of(outcome)}" for outcome in outcomes])


def grid(rows: Sequence[tuple[str, list[np.ndarray]]], heads: Sequence[str]) -> Figure:
    """Draw a table of images. An array (H, W, 3) is an sRGB picture, an array (H, W) is a map of errors [deg].

    `rows`: (title, images) of each row. `heads`: titles of the columns.
    """
    figure = Figure(figsize=(2.6 * len(heads), 2.7 * len(rows)), layout="constrained")
    for line, (title, images) in zip(figure.subplots(len(rows), len(heads), squeeze=False), rows):
        for axes, image in zip(line, images):
            axes.imshow(image, cmap="inferno", vmin=0, vmax=WORST if image.ndim == 2 else None)
            axes.set(xticks=[], yticks=[])
        line[0].set_ylabel(title, fontsize=8)
    for axes, head in zip(figure.axes, heads):
        axes.set_title(head, fontsize=8)
    return figure


def predicted(outcome: Outcome, ring: FittedObject) -> tuple[np.ndarray, int]:
    """Render the first photograph of a run from its fit, `ring`. Returns (sRGB picture (H, W, 3), factor).

    The photograph is `factor` times as large as the picture.
    """
    capture = load_capture(outcome.folder / "scene.xml", images=False)
    scale = -(-capture.shots[0].size[0] // WIDTH)
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    rgb, _ = prediction.draw(
        surface, capture.photograph(0, scale), SPP, shadows=capture.shadows, indirect=ring.indirect
    )
    return linear_to_srgb(rgb[0].numpy()).clip(0, 1), scale
