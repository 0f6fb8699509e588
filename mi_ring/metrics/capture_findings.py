"""Measures the quality of a capture's photographs, and lists findings: problems that the user should correct."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from mi_ring.capture.brightness_masks import dark_threshold
from mi_ring.capture.capture import Capture
from mi_ring.geometry.hull import MAX_WIDTH, shrink_mask
from mi_ring.image_headers import bits_of
from mi_ring.images import LOW_BITS, largest_value, read_image
from mi_ring.metrics.brightness_samples import BrightnessSampler
from mi_ring.metrics.mask_agreement import CONFORMS, half_pixel
from mi_ring.system.files import read_json

CLIPPED, DARK = 0.1, 0.5  #: shares above which there is a finding
ODD_POWER = 3.0  #: a light is odd if its fitted power is larger than this, or smaller than the inverse
FAR, LEAST_FAR = 4.0, 2.0  #: a camera has moved far: more than this multiple of the median, and than this [px]


def moved_far(photographs: dict[str, dict[str, Any]]) -> str:
    """Name the photographs whose camera a fit has moved much farther than the others.

    `photographs`: the entry of this name in calibration.json: a dict from names of photographs to their values. Returns
    a text for the user; empty if there are no such photographs.
    """
    moved = {name: entry["moved_px"] for name, entry in photographs.items()}
    limit = max(LEAST_FAR, FAR * float(np.median(list(moved.values()) or [0])))
    return ", ".join(f"{name} ({far:.1f} px)" for name, far in moved.items() if far > limit)


def odd_powers(photographs: dict[str, dict[str, Any]]) -> str:
    """Name the photographs whose light, as a fit has found it, is much stronger or weaker than the others' lights.

    `photographs`: the entry of this name in calibration.json: a dict from names of photographs to their values. Returns
    a text for the user; empty if there are no such photographs.
    """
    powers = {name: float(np.exp(np.log(e["power"]).mean())) for name, e in photographs.items() if "power" in e}
    odd = {name: power for name, power in powers.items() if not 1 / ODD_POWER < power < ODD_POWER}
    return ", ".join(f"{name} ({power:.2g} times)" for name, power in odd.items())


def findings_of_fit(scene: Path, names: Collection[str]) -> tuple[str, str]:
    """Read calibration.json, which a fit has written beside a scene file. Returns two texts for the user.

    They name the photographs whose camera the fit has moved far, and those whose light is much stronger or weaker than
    the others. `names`: only these photographs count. Both texts are empty if there is no such file.
    """
    record = read_json(scene.parent / "calibration.json")
    try:
        known = {name: entry for name, entry in record["photographs"].items() if name in names}
        return moved_far(known), odd_powers(known)
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError):
        return "", ""


@dataclass
class PhotographQuality:
    """The quality of one photograph: a row in the table of `mi-ring check`. Lengths are in radii of the object."""

    name: str
    distance: float  #: from the camera to the object
    light: float | None  #: from the light to the object; infinite for a directional light, None without a light
    angle: float | None  #: between light and camera, seen from the object [deg]
    object: float | None  #: share of the photograph that the object covers
    clipped: float  #: share of the object that is clipped
    dark: float  #: share of the object that is almost black
    background: float | None  #: brightness of the background, relative to the object's
    brightness: float  #: brightness of the object, relative to the irradiance
    agreement: float | None  #: share of the mask that the other masks agree with


#: Columns of the table and their number formats.
FORMATS = {"distance": ".2f", "light": ".2f", "angle": ".0f", "object": ".1%", "clipped": ".1%", "dark": ".1%",
           "background": ".1%", "brightness": ".2f", "agreement": ".0%"}  # fmt: skip
LEGEND = """distance, light: distances of camera and light from the object, in radii of the object
angle: angle between camera and light, seen from the object [°]
object: share of the photograph that the object covers
clipped, dark: shares of the object that are over-exposed and black
background: its brightness, relative to the object
brightness: brightness of the object per irradiance, relative to the other photographs
agreement: share of the mask that the other masks agree with"""


def measure(
    capture: Capture,
    center: np.ndarray,
    radius: float,
    agreement: dict[str, float],
    sampler: BrightnessSampler | None = None,
) -> list[PhotographQuality]:
    """Measure the quality of each photograph. Reads all photographs. Returns one row for each.

    `center` (3,), `radius`: normalising sphere [scene units]. `agreement`: a dict from the name of a mask file to the
    share of this mask that the other masks confirm. `sampler` collects samples of each photograph; None: no samples.
    """
    lights, rows = capture.photographs.lights, []
    lit = np.any(lights.rgb() > 0, axis=1)
    of_each = zip(capture.shots, capture.names, lights.toward(center), lights.distances(center),
                  received_by(capture, center))  # fmt: skip
    for k, (shot, name, to_light, away, received) in enumerate(of_each):
        to_camera = shot.camera.position - center
        cosine = to_camera @ to_light / (np.linalg.norm(to_camera) * max(np.linalg.norm(to_light), 1e-12))
        scale = -(-max(shot.size) // MAX_WIDTH)
        rgb, saturated, mask, masked = (t[0].numpy() for t in capture.observe([k], scale)[:4])
        if sampler is not None:
            sampler.add(k, scale, rgb, np.any(saturated, -1), mask)
        image, part = rgb.max(-1), shot.window.share if shot.window else 1.0
        inside = mask > 0.5 if masked else image > 0.02 * image.max()
        outside = ~ndimage.binary_dilation(inside, iterations=3) if masked else None
        level = float(np.quantile(image[inside], 0.9)) if inside.any() else 0.0  # of lit parts, not of shadows
        around = None if outside is None or not outside.any() else float(np.median(image[outside]))
        rows.append(PhotographQuality(
            name=name, distance=float(np.linalg.norm(to_camera) / radius),
            light=float(away / radius) if lit[k] else None,
            angle=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) if lit[k] else None,
            object=float(inside.mean()) * part if masked else None,
            clipped=float(np.any(saturated, -1)[inside].mean()) if inside.any() else 0.0,
            dark=float((image[inside] < 0.02 * np.quantile(image[inside], 0.95)).mean()) if inside.any() else 1.0,
            background=None if around is None or level < 1e-3 * image.max() else around / level,
            brightness=level / max(received, 1e-30), agreement=agreement.get(capture.outline(k)),
        ))  # fmt: skip
    return rows


def received_by(capture: Capture, center: np.ndarray) -> np.ndarray:
    """Compute the irradiance (N,) at the object in each photograph, from the known lights, as a mean over colours.

    `center` (3,): centre of the object [scene units]. If the lights are unknown, all values are 1. If those of some
    photographs are unknown, these values are the median of the others.
    """
    received = capture.photographs.irradiance(center).mean(1)
    usual = np.median(received[capture.photographs.mainly])
    return np.where(received > 0, received, usual) if usual > 0 else np.ones_like(received)


def units(capture: Capture, center: np.ndarray) -> str | None:
    """Return a warning for the user if lights and cameras seem to have different length units; otherwise None.

    `center` (3,): centre of the object [scene units].
    """
    lights, point = capture.photographs.lights.positions(), capture.photographs.lights.is_finite()
    cameras = np.stack([shot.camera.position for shot in capture.shots])
    if not point.any() or np.ptp(cameras, axis=0).max() == 0:
        return None
    away = np.linalg.norm(cameras[point] - center, axis=1)
    # By scale of the lights the median distance from light to camera, in units of that from camera to object.
    beside = {scale: float(np.median(np.linalg.norm(scale * lights[point] - cameras[point], axis=1) / away))
              for scale in (0.001, 0.01, 0.1, 1, 10, 100, 1000)}  # fmt: skip
    scale = min(beside, key=beside.__getitem__)
    if scale != 1 and beside[1] > 0.8 and beside[scale] < 0.5:
        return (f"lights are in other units than cameras: multiply their positions by {scale:g} "
                f"and their intensities by {scale**2:g}")  # fmt: skip
    return None


def facing(capture: Capture, center: np.ndarray) -> str | None:
    """Return a warning for the user if cameras look away from the object; otherwise None.

    `center` (3,): centre of the object [scene units].
    """
    cameras = [shot.camera for shot in capture.shots]
    away = np.array([(center - camera.position) @ camera.forward < 0 for camera in cameras])
    if away.mean() > 0.5:
        return (f"{away.sum()} of {len(away)} cameras look away from the object: here, z of to_world is forward; "
                "convert OpenGL's axes (NeRF, Blender) by to_world @ diag(-1, 1, -1, 1)")  # fmt: skip
    return f"{', '.join(np.array(capture.names)[away][:5])}: looking away from the object" if away.any() else None


def capture_findings(capture: Capture, rows: list[PhotographQuality], center: np.ndarray) -> list[str]:
    """List the problems of a capture, each as a sentence for the user. Reads calibration.json if a fit has written it.

    `rows`: measured quality of each photograph. `center` (3,): centre of the object [scene units].
    """
    found: list[str] = []
    agree = [row.agreement for row in rows if row.agreement is not None]
    if capture.whole and agree and np.median(agree) >= CONFORMS:  # masks of bright parts only need not agree
        strays = [row for row in rows if row.agreement is not None and row.agreement < CONFORMS]
        if not strays and capture.hull and max(shot.whole.size[0] for shot in capture.shots) <= MAX_WIDTH:
            found += filter(None, [half_pixel(capture.hull)])
        for row in strays:
            found.append(f"{row.name}: the others agree to {row.agreement:.0%} of its mask: pose or mask is wrong")
    moved, odd = findings_of_fit(capture.path, capture.names)
    if moved:
        found.append(f"{moved}: the fit moved this camera much farther than the others: is the photograph blurred, or "
                     "of another scene?")  # fmt: skip
    if odd:
        found.append(f"{odd}: strength of the light, relative to the others, as the fit found it: did the flash fire?")
    found += filter(None, [units(capture, center)])
    # Only photographs with lights of their own, not from behind: others may show the unlit side.
    lit = [row for row in rows if row.angle is not None and row.angle < 60 and row.brightness > 0]
    typical = np.median([row.brightness for row in lit]) if lit else 1.0
    for row in lit:
        if not typical / 4 < row.brightness < 4 * typical:
            times = f"{row.brightness / typical:.2g} times as bright as the others"
            found.append(f"{row.name}: is {times}, for the light that it gets: exposure or light is wrong")
    if (share := np.median([row.clipped for row in rows])) > CLIPPED:
        found.append(f"{share:.0%} of the object is over-exposed; expose less")
    files = (shot.files.filename for shot in capture.shots)
    largest = largest_value(read_image(file) for file in files if file and bits_of(file) == 16)
    if largest in LOW_BITS and max(shot.saturation for shot in capture.shots) * 65535 > largest:
        found.append(f"the largest value of the photographs of 16 bits is {largest}, as of {LOW_BITS[largest]} bits: "
                     "over-exposed pixels are not known; give the photographs in the scene file the saturation "
                     f"{(largest - 0.5) / 65535:.4g}")  # fmt: skip
    if (share := np.median([row.dark for row in rows])) > DARK:
        found.append(f"{share:.0%} of the object is black: under-exposed, or unlit")
    if not any(capture.masks.given) and dark_threshold(capture) is None:
        found.append("no masks, and the background is not dark, which a fit without masks needs: give masks, or "
                     "find them with mi-ring photos")  # fmt: skip
    if (views := len({shot.camera.to_world.tobytes() for shot in capture.shots})) < 8:
        found.append(f"{views} views are too few: a closed surface needs about 30 from all sides")
    return found


def quality_table(rows: list[PhotographQuality]) -> str:
    """Format the quality of photographs as a text table with a legend. It shows brightness relative to the median."""
    typical = float(np.median([row.brightness for row in rows]))
    lines = [["photograph", *FORMATS]]
    for row in rows:
        values = vars(row) | {"brightness": row.brightness / typical if typical else None}
        lines.append([row.name, *(
            "-" if values[name] is None else "distant" if np.isinf(values[name]) else format(values[name], digits)
            for name, digits in FORMATS.items()
        )])  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*lines)]
    table = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in lines]
    return "\n".join([*table, LEGEND])


def without_empty_masks(capture: Capture) -> tuple[Capture, list[str]]:
    """Remove empty masks from a capture. Returns (copy of the capture, names of the photographs with an empty mask).

    In the copy, these photographs have no mask.
    """
    given = [k for k, is_given in enumerate(capture.masks.given) if is_given]
    empty = [k for k in given if not (shrink_mask(capture.masks[k], MAX_WIDTH)[0] > 127).any()]
    masks = capture.masks.replaced(dict.fromkeys(empty))
    return replace(capture, masks=masks), [capture.names[k] for k in empty]
