"""Draws the contact sheet of a capture: a plan of cameras and lights, and the photographs with masks and hull."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image, ImageDraw
from scipy import ndimage

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.metrics.capture_findings import PhotographQuality
from mi_ring.metrics.mask_agreement import CONFORMS
from mi_ring.metrics.surfaces import hits
from mi_ring.scene.plain_mesh import scene_of

CELL, LINE = 200, 16  # size of a photograph, height of a line of text [px]
GOOD, DOUBTED = (255, 255, 255), (255, 220, 40)  # colours of the photographs' names
GREEN, RED, BLUE = (60, 255, 60), (255, 60, 60), (80, 160, 255)
LEGEND = (
    ("mask", GREEN), ("uncertain, or outside the lens", RED), ("hull of all masks", BLUE),
    ("share of the mask that the other masks agree with", GOOD), ("too small", DOUBTED),
)  # fmt: skip


def plan(capture: Capture, center: np.ndarray, radius: float) -> Image.Image:
    """Draw cameras, viewing directions, lights and the normalising sphere in three panels, one along each axis.

    `center` (3,), `radius`: the normalising sphere, which contains the object [scene units].
    """
    cameras, lights = np.stack([shot.camera.to_world for shot in capture.shots]), capture.photographs.lights
    reach = max(np.linalg.norm(cameras[:, :3, 3] - center, axis=1).max(), 1.5 * radius)
    away = np.where(lights.is_finite()[:, None], lights.positions(), center + reach * lights.positions())
    away = away[lights.rgb().any(1)]
    figure = Figure(figsize=(12, 4), dpi=100)
    canvas, panels = FigureCanvasAgg(figure), figure.subplots(1, 3)
    for panel, (a, b) in zip(panels, ((0, 1), (0, 2), (1, 2))):
        panel.add_patch(Circle((center[a], center[b]), radius, color="tab:green", alpha=0.3))
        panel.scatter(*away[:, [a, b]].T, s=12, c="tab:orange", label="lights")
        panel.quiver(*cameras[:, [a, b], 3].T, *(0.25 * reach * cameras[:, [a, b], 2]).T, color="tab:blue", angles="xy",
                     scale_units="xy", scale=1, width=0.004, label="cameras")  # fmt: skip
        panel.set_xlabel("xyz"[a])
        panel.set_ylabel("xyz"[b])
        panel.set_aspect("equal", "datalim")
        panel.autoscale_view()
    panels[0].legend(loc="upper right", fontsize=8)
    figure.tight_layout()
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def capture_sheet(capture: Capture, rows: list[PhotographQuality], center: np.ndarray, radius: float) -> Image.Image:
    """Draw the contact sheet: a plan of cameras and lights, then photographs with mask outlines and the visual hull.

    `rows`: quality of each photograph, in the order of the capture. `center` (3,), `radius`: the normalising sphere,
    which contains the object [scene units].
    """
    top = plan(capture, center, radius)
    try:
        mesh = capture.hull.surface() if capture.hull else None
    except InputError:
        mesh = None
    hull = mesh and scene_of(mesh.vertices, mesh.faces)
    some = capture.spread()
    columns = max(1, min(top.width // CELL, len(some)))
    above, lines = top.height + LINE, -(-len(some) // columns)
    page = Image.new("RGB", (max(top.width, columns * CELL), above + lines * (CELL + LINE)))
    page.paste(top)
    draw, left = ImageDraw.Draw(page), 2.0
    for words, colour in LEGEND:
        draw.text((left, top.height + 2), words, fill=colour)
        left += draw.textlength(words) + 16
    white = 3 * capture.exposure()
    for place, k in enumerate(some):
        scale = max(1, max(capture.shots[k].size) // CELL)
        observed, _, mask, masked, valid = capture.observe([k], scale)
        picture = linear_to_srgb(observed[0].numpy() / white)
        outlined = [(~valid[0].numpy(), RED)] if valid is not None else []
        outlined += [(hits(hull, capture.photograph(k, scale))[0].reshape(mask[0].shape), BLUE)] if hull else []
        outlined += [(mask[0].numpy() > 0.5, GREEN)] if masked else []
        for inside, colour in outlined:
            edge = inside & ~ndimage.binary_erosion(inside, border_value=1)
            picture[edge] = np.divide(colour, 255)
        cell = Image.fromarray(to_bytes(picture))
        cell.thumbnail((CELL, CELL))
        x, y = place % columns * CELL, above + place // columns * (CELL + LINE)
        page.paste(cell, (x, y + LINE))
        agreement = rows[k].agreement
        text = rows[k].name + ("" if agreement is None else f"  {agreement:.0%}")
        draw.text((x + 2, y + 2), text, fill=GOOD if agreement is None or agreement >= CONFORMS else DOUBTED)
    return page
