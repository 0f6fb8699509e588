"""What there is to say of each photograph of a capture, and what is to be mended."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage, stats

from mi_ring.capture.brightness_masks import dark_threshold
from mi_ring.capture.capture import Capture
from mi_ring.geometry.hull import MAX_WIDTH, shrink_mask
from mi_ring.metrics.mask_agreement import CONFORMS, half_pixel
from mi_ring.system.files import read_json

CLIPPED, DARK, AMBIENT = 0.1, 0.5, 0.05  #: shares beyond which something is said
ODD = 3.0  #: a photograph whose light a fit finds so many times as strong as the others', or as weak
FAR, LEAST_FAR = 4.0, 2.0  #: a photograph that a fit moves so many times as far as half of them, and so far [px]


def moved_far(photographs: dict[str, dict[str, Any]]) -> str:
    """Which photographs a fit has moved much farther than the others, and how far, by its `summary`; empty if none."""
    moved = {name: entry["moved_px"] for name, entry in photographs.items()}
    limit = max(LEAST_FAR, FAR * float(np.median(list(moved.values()) or [0])))
    return ", ".join(f"{name} ({far:.1f} px)" for name, far in moved.items() if far > limit)


def lit_otherwise(photographs: dict[str, dict[str, Any]]) -> str:
    """Of which photographs a fit has found the light much stronger or weaker than of the others; empty if of none."""
    powers = {name: float(np.exp(np.log(e["power"]).mean())) for name, e in photographs.items() if "power" in e}
    return ", ".join(f"{name} ({power:.2g} times)" for name, power in powers.items() if not 1 / ODD < power < ODD)


def told_before(scene: Path, names: Collection[str]) -> tuple[str, str]:
    """`moved_far` and `lit_otherwise` of these photographs, by calibration.json of the scene's fit."""
    record = read_json(scene.parent / "calibration.json")
    try:
        known = {name: entry for name, entry in record["photographs"].items() if name in names}
        return moved_far(known), lit_otherwise(known)
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError):  # none, or another tool's
        return "", ""


@dataclass
class PhotographQuality:
    """What there is to say of one photograph. Distances are in radii of the normalising sphere."""

    name: str
    distance: float  #: from the camera to the object
    light: float | None  #: from the light to the object; infinite if it is distant, None if there is none
    angle: float | None  #: between light and camera, seen from the object [deg]
    object: float | None  #: share of the photograph that is object
    clipped: float  #: share of the object that is clipped
    dark: float  #: share of the object that is black, or nearly
    background: float | None  #: brightness of what is not object, in that of the object
    brightness: float  #: brightness of the object, for the light it gets
    agreement: float | None  #: share of the mask that the other masks agree to


HEADS = (
    "photograph",
    "distance",
    "light",
    "angle",
    "object",
    "clipped",
    "dark",
    "background",
    "brightness",
    "agreement",
)
LEGEND = """distance, light: how far camera and light are from the object, in its radii; angle: between the two [°];
object: share of the photograph that is object; clipped, dark: shares of the object that are over-exposed, and black;
background: its brightness, by that of the object; brightness: for the light that the object gets, by that of the other
photographs; agreement: share of the mask that the other masks agree to"""


def measure(
    capture: Capture, center: np.ndarray, radius: float, agreement: dict[str, float]
) -> list[PhotographQuality]:
    """The rows of all photographs."""
    lights, rows = capture.photographs.lights, []
    lit = np.any(lights.rgb() > 0, axis=1)
    of_each = zip(capture.shots, capture.names, lights.toward(center), lights.distances(center),
                  received_by(capture, center))  # fmt: skip
    for k, (shot, name, to_light, away, received) in enumerate(of_each):
        to_camera = shot.camera.position - center
        cosine = to_camera @ to_light / (np.linalg.norm(to_camera) * max(np.linalg.norm(to_light), 1e-12))
        rgb, saturated, mask, masked = (t[0].numpy() for t in capture.observe([k], -(-max(shot.size) // MAX_WIDTH))[:4])
        image = rgb.max(-1)
        inside = mask > 0.5 if masked else image > 0.02 * image.max()
        outside = ~ndimage.binary_dilation(inside, iterations=3) if masked else None
        level = float(np.quantile(image[inside], 0.9)) if inside.any() else 0.0  # what is lit, not in shadow
        around = None if outside is None or not outside.any() else float(np.median(image[outside]))
        rows.append(PhotographQuality(
            name=name, distance=float(np.linalg.norm(to_camera) / radius),
            light=float(away / radius) if lit[k] else None,
            angle=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) if lit[k] else None,
            object=float(inside.mean()) if masked else None,
            clipped=float(np.any(saturated, -1)[inside].mean()) if inside.any() else 0.0,
            dark=float((image[inside] < 0.02 * np.quantile(image[inside], 0.95)).mean()) if inside.any() else 1.0,
            background=None if around is None else around / max(level, 1e-9),
            brightness=level / max(received, 1e-30), agreement=agreement.get(capture.outline(k)),
        ))  # fmt: skip
    return rows


def received_by(capture: Capture, center: np.ndarray) -> np.ndarray:
    """(N,) what light the object gets in each photograph, or as much in all, where that is unknown."""
    received = capture.photographs.irradiance(center).mean(1)
    return received if np.median(received) > 0 else np.ones_like(received)


def units(capture: Capture, center: np.ndarray) -> str | None:
    """Are the lights in other units than the cameras?"""
    lights, point = capture.photographs.lights.positions(), capture.photographs.lights.is_finite()
    cameras = np.stack([shot.camera.position for shot in capture.shots])
    if not point.any() or np.ptp(cameras, axis=0).max() == 0:
        return None
    away = np.linalg.norm(cameras[point] - center, axis=1)

    def beside(scale: float) -> float:  # distance from light to camera, for that from camera to object
        return float(np.median(np.linalg.norm(scale * lights[point] - cameras[point], axis=1) / away))

    scale = min((0.001, 0.01, 0.1, 1, 10, 100, 1000), key=beside)
    if scale != 1 and beside(1) > 0.8 and beside(scale) < 0.5:
        return (f"lights are in other units than cameras: multiply their positions by {scale:g} "
                f"and their intensities by {scale**2:g}")  # fmt: skip
    return None


def facing(capture: Capture, center: np.ndarray) -> str | None:
    """Do the cameras look at the object?"""
    cameras = [shot.camera for shot in capture.shots]
    away = np.array([(center - camera.position) @ camera.forward < 0 for camera in cameras])
    if away.mean() > 0.5:
        return (f"{away.sum()} of {len(away)} cameras look away from the object: z of to_world is forward, here; "
                "of OpenGL's (NeRF's, Blender's) axes: to_world @ diag(-1, 1, -1, 1)")  # fmt: skip
    return f"{', '.join(np.array(capture.names)[away][:5])}: looking away from the object" if away.any() else None


def room_light(brightness: np.ndarray, received: np.ndarray) -> float:
    """Share of a light on the object that does not fall off as the photographs' own do, at least; 0 if none is found.

    Of each photograph (n,): how bright the object is for the light that it gets, and that light. If the room adds to
    it the object is too bright where it gets little.
    """
    if len(received) < 12 or received.max() < 1.5 * received.min():
        return 0.0
    level = brightness * received
    _, _, _, steepest = stats.theilslopes(level, received)
    rest = np.median(level - steepest * received)
    return float(max(0.0, rest / np.median(level)))


def capture_findings(capture: Capture, rows: list[PhotographQuality], center: np.ndarray) -> list[str]:
    """What is to be mended, each in one line."""
    found: list[str] = []
    agree = [row.agreement for row in rows if row.agreement is not None]
    if capture.whole and agree and np.median(agree) >= CONFORMS:  # those of bright parts only need not agree
        strays = [row for row in rows if row.agreement is not None and row.agreement < CONFORMS]
        if not strays and capture.hull and max(shot.size[0] for shot in capture.shots) <= MAX_WIDTH:
            found += filter(None, [half_pixel(capture.hull)])
        for row in strays:
            found.append(f"{row.name}: the others agree to {row.agreement:.0%} of its mask: pose or mask is wrong")
    few, odd = told_before(capture.path, capture.names)
    if few:
        found.append(
            f"{few}: the fit has moved the camera much farther than the others': out of focus, or another scene?"
        )
    if odd:
        found.append(f"{odd}: so strong is the light that the fit has found, by the others': did the flash fire?")
    found += filter(None, [units(capture, center)])
    received = received_by(capture, center)
    # Not from behind; and where photographs have lights of their own: else some show the side that is not lit.
    lit = [row for row in rows if row.angle is not None and row.angle < 60 and row.brightness > 0]
    typical = np.median([row.brightness for row in lit]) if lit else 1.0
    for row in lit:
        if not typical / 4 < row.brightness < 4 * typical:
            times = f"{row.brightness / typical:.2g} times as bright as the others"
            found.append(f"{row.name}: is {times}, for the light it gets: its exposure or its light is wrong")
    for name, limit, text in (
        ("clipped", CLIPPED, "of the object is over-exposed; expose less"),
        ("dark", DARK, "of the object is black: under-exposed, or unlit"),
    ):
        share = np.median([getattr(row, name) for row in rows])
        if share > limit:
            found.append(f"{share:.0%} {text}")
    if not any(capture.masks.given) and dark_threshold(capture) is None:
        found.append("no masks, and the background is not dark, for which a fit would take it: give masks, or have "
                     "them found by mi-ring photos")  # fmt: skip
    share = room_light(np.array([row.brightness for row in lit]), received[[row in lit for row in rows]])
    if share > AMBIENT:
        found.append(f"{share:.0%} of the light on the object is the room's, by how little darker the object gets "
                     "where the flash is farther: darken the room, or go nearer")  # fmt: skip
    views = len({shot.camera.to_world.tobytes() for shot in capture.shots})
    if views < 8:
        found.append(f"{views} views are few: about 30 from all around are needed for a closed surface")
    return found


def quality_table(rows: list[PhotographQuality]) -> str:
    """The rows as text, and what the columns are."""
    typical = np.median([row.brightness for row in rows])

    def cells(row: PhotographQuality) -> Iterator[str]:
        yield row.name
        yield f"{row.distance:.2f}"
        yield "-" if row.light is None else "distant" if np.isinf(row.light) else f"{row.light:.2f}"
        yield "-" if row.angle is None else f"{row.angle:.0f}"
        for share in (row.object, row.clipped, row.dark, row.background):
            yield "-" if share is None else f"{share:.1%}"
        yield f"{row.brightness / typical:.2f}" if typical else "-"
        yield "-" if row.agreement is None else f"{row.agreement:.0%}"

    lines = [HEADS, *map(tuple, map(cells, rows))]
    widths = [max(map(len, column)) for column in zip(*lines)]
    table = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in lines]
    return "\n".join([*table, LEGEND])


def without_empty_masks(capture: Capture) -> tuple[Capture, list[str]]:
    """The capture without masks that have nothing in them, and the names of the photographs with these masks."""
    given = [k for k, is_given in enumerate(capture.masks.given) if is_given]
    empty = [k for k in given if not (shrink_mask(capture.masks[k], MAX_WIDTH)[0] > 127).any()]
    masks = capture.masks.replaced(dict.fromkeys(empty))
    return replace(capture, masks=masks), [capture.names[k] for k in empty]
