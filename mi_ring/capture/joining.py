"""Joins two captures of one object: photographs with a flash, and photographs in the light of the room alone."""

import contextlib
import itertools
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.emitter_elements import Element
from mi_ring.capture.loading import FEWEST_DARK, load_capture, masks_of, require_headers
from mi_ring.capture.pairs import free_name, real
from mi_ring.capture.scenefile import FILES, bsdf_element, move_names, scene_bytes, with_missing_photographs
from mi_ring.errors import InputError
from mi_ring.geometry.camera import NoParallax, sphere_of_cameras
from mi_ring.geometry.hull import Hull
from mi_ring.scene.shot import Shot
from mi_ring.system.files import quoted

SAME = 0.01  #: largest distance [px] between the pictures of a point by two cameras that are taken for one
SOME = 32  #: number of masks of each capture that tell where the object is
WIDE = 0.006  #: pixels of a mask may be so far beside the hull of others [widths of the mask], and a pixel
CONFORMS, DIFFERS = 0.9, 0.5  #: share of such pixels below which masks are doubtful, and below which they are wrong


class Joined(NamedTuple):
    """Two captures as one scene."""

    xml: bytes  #: content of the scene file
    lit: int  #: number of photographs with a light of their own
    dark: int  #: number of photographs in the light of the room alone
    pairs: int  #: how many of these have the camera of a photograph with a light of its own
    notes: list[str]  #: sentences for the user


def join_captures(flash_path: Path, room_path: Path, folder: Path) -> Joined:
    """Join the photographs of two scene files. Those of `room_path` follow, without lights of their own.

    All else is what `flash_path` says. A photograph of the room whose camera is that of another one but for `SAME`
    pixels gets exactly this camera, and its mask if it has none. `folder`: where the scene file will be. No file is
    written. Raises InputError if the files cannot be read, or do not show the same object in the same frame.
    """
    flash, room = map(opened, (flash_path, room_path))
    require_joinable(flash, room)
    require_same_scene(flash, room)
    hulls = hull_of(flash), hull_of(room)
    center, radius = ball_of(flash, hulls[0])
    with contextlib.suppress(NoParallax):  # then the first one tells where the object is
        require_near(flash, room, center, radius, *ball_of(room, hulls[1]))
    gaps = camera_gaps(room, flash, points_on(center, radius))
    agree, nearest = agreement(*hulls), float(gaps.min())
    if nearest >= SAME and agree < DIFFERS:
        raise InputError(f"{room_path}: ROOM.xml: its masks agree to {agree:.0%} only with those of {flash_path}: "
                         "frames or objects differ; calibrate all photographs together")  # fmt: skip

    root = ElementTree.fromstring(flash.xml)
    ids = {element.get("id", "") for element in root.iter()} | {""}
    for element, shot in zip(root.findall(".//sensor[@type='photograph']"), flash.shots):
        if not element.get("id"):
            element.set("id", add_name(Path(shot.file_name).stem, ids))
    move_names(root, flash_path.parent, folder)
    mates = [flash.shots[k] if gap[k] < SAME else None for gap, k in zip(gaps, gaps.argmin(1))]
    names = [shot.name or Path(shot.file_name).stem for shot in room.shots]
    names = [add_name(f"{name}_room" if name in ids else name, ids) for name in names]
    shots = [in_room_light(shot, mate, flash.shots[0], name) for shot, mate, name in zip(room.shots, mates, names)]
    xml = with_missing_photographs(scene_bytes(root), shots, folder)
    if path := next((word for word in quoted(xml) if "$" in word), None):
        raise InputError(f"{path}: has a $ in its path, which scene files take for a parameter; rename it")

    notes = remarks(flash, room, shots)
    if agree < CONFORMS:
        notes.append(f"Warning: the masks of {room_path} agree to {agree:.0%} only with those of {flash_path}. Do both "
                     "show the same object?")  # fmt: skip
    if nearest >= SAME:
        notes.append(f"No camera of {room_path} is one of {flash_path}: the nearest ones differ by {nearest:.2g} px.")
    lit = flash.photographs.lit
    known = {shot.camera.key for shot, is_lit in zip(flash.shots, lit) if is_lit}
    dark = [*(shot for shot, is_lit in zip(flash.shots, lit) if not is_lit), *shots]
    return Joined(xml, int(lit.sum()), len(dark), sum(shot.camera.key in known for shot in dark), notes)


def remarks(flash: Capture, room: Capture, shots: Sequence[Shot]) -> list[str]:
    """Return sentences for the user about lights and masks. `shots`: the photographs of `room`, as they are written."""
    notes = []
    if left_out := sum(map(has_light, room.shots)):
        notes.append(f"Photographs of {room.path} whose own light is left out: {left_out}")
    if any(element.tag == "emitter" for element in ElementTree.fromstring(flash.xml)):
        notes.append(f"The emitters of {flash.path} light the photographs of {room.path}, too.")
    if lent := sum(new.files.mask != old.files.mask for new, old in zip(shots, room.shots)):
        notes.append(f"Photographs of {room.path} that get the mask of the photograph with flash: {lent}")
    if bare := sum(shot.files.mask is None for shot in shots):
        notes.append(f"Photographs of {room.path} without a mask, whose background must be black: {bare}")
    return notes


def add_name(name: str, names: set[str]) -> str:
    """Add `name` to `names`, with underscores at its end if it is there already. Returns it."""
    name = free_name(name, names)
    names.add(name)
    return name


def opened(path: Path) -> Capture:
    """Read a scene file, with masks but without the pixels of photographs. Raises InputError if a file is unusable."""
    capture = load_capture(path, images=False)
    for shot in capture.shots:
        require_headers(shot, path, "given")
    bsdf_element(ElementTree.fromstring(capture.xml), path)  # refuses what a fit refuses, files that it includes
    masks, valid = (masks_of(capture.shots, field, path) for field in ("mask", "valid"))
    return replace(capture, masks=masks, valid=valid)


def require_joinable(flash: Capture, room: Capture) -> None:
    """Raise InputError if photographs of two captures cannot be those with a flash and those in the room's light."""
    if real(flash.path) == real(room.path):
        raise InputError(f"{room.path}: ROOM.xml: is FLASH.xml itself; give the scene of the photographs without flash")
    if not flash.photographs.lit.any():
        raise InputError(f"{flash.path}: FLASH.xml: no photograph has a light of its own; exchange FLASH.xml and "
                         "ROOM.xml, or leave out intensities of 0")  # fmt: skip
    if len(room) + int((~flash.photographs.lit).sum()) < FEWEST_DARK:
        raise InputError(f"{room.path}: ROOM.xml: has {len(room)} photographs; a fit needs at least {FEWEST_DARK} in "
                         "the light of the room alone")  # fmt: skip
    known = {real(shot.files.filename): shot for shot in flash.shots}
    for shot in room.shots:
        if other := known.get(real(shot.files.filename)):
            raise InputError(f'{room.path}: photograph "{shot.name}", filename: {shot.files.filename} is photograph '
                             f'"{other.name}" of {flash.path}, too; remove one')  # fmt: skip
        if shot.files.ambient:
            raise InputError(f'{room.path}: photograph "{shot.name}", ambient: is for photographs with a flash; '
                             "exchange FLASH.xml and ROOM.xml, or remove it")  # fmt: skip


def require_same_scene(flash: Capture, room: Capture) -> None:
    """Raise InputError if the second scene says something, beside its photographs, that the first one does not say."""
    known = statements(flash)
    for what, content in statements(room):
        if (what, content) not in known:
            says = "something else" if what in dict(known) else "nothing"
            raise InputError(f"{room.path}: {what}: {flash.path} says {says} of it, but counts for all photographs; "
                             "remove it, or write the same in both")  # fmt: skip


def statements(capture: Capture) -> list[tuple[str, str]]:
    """List what a scene says beside its sensors. Returns pairs: what it is about, and comparable content."""
    found = []
    for element in ElementTree.fromstring(capture.xml):
        if element.get("type") == "shapenet":
            found += [(f"shapenet, {part.get('name', part.tag)}", part) for part in element]
        elif element.tag != "sensor":
            found.append((f"{element.tag} {element.get('type', element.get('name', ''))}", element))
    return [(what, content_of(element, capture.path.parent)) for what, element in found]


def content_of(element: Element, folder: Path) -> str:
    """Return the content of an XML element as text that is equal for elements that say the same.

    Numbers are rounded, ids left out. `folder`: that of the scene file, for names of files.
    """
    attributes = {}
    for key, value in sorted(element.items()):
        if key == "value" and element.get("name") in FILES and os.path.isfile(folder / value):
            attributes[key] = real(folder / value)
        elif key != "id" or element.tag == "ref":
            attributes[key] = " ".join(map(rounded, value.replace(",", " ").split()))
    return f"{element.tag} {attributes} {sorted(content_of(part, folder) for part in element)}"


def rounded(word: str) -> str:
    """Round a number in a text to 6 digits. Other words are returned as they are."""
    try:
        return f"{float(word) + 0.0:.6g}"
    except ValueError:
        return word


def hull_of(capture: Capture) -> Hull | None:
    """Compute the visual hull of some masks. It is None if there are no masks, or if cameras look from one side."""
    with contextlib.suppress(NoParallax):
        if silhouettes := capture.silhouettes(SOME):
            return Hull(silhouettes, str(capture.path))
    return None


def ball_of(capture: Capture, hull: Hull | None) -> tuple[np.ndarray, float]:
    """Return (centre (3,), radius) [scene units] of a ball around the object: given, or by masks, or by cameras.

    `hull`: by the capture's masks. Raises NoParallax if nothing tells.
    """
    center, radius = capture.shape.center, capture.shape.radius
    if center is not None and radius is not None:
        return center, radius
    if hull:
        return hull.center, float(hull.reach)
    return sphere_of_cameras([shot.camera for shot in capture.shots], str(capture.path))


def require_near(
    flash: Capture, room: Capture, center: np.ndarray, radius: float, place: np.ndarray, reach: float
) -> None:
    """Raise InputError if the objects of two captures do not touch.

    `center` (3,), `radius`: ball around the object of the first one; `place` (3,), `reach`: of the second one.
    """
    distance = float(np.linalg.norm(place - center))
    if distance > radius + reach:
        raise InputError(
            f"{room.path}: ROOM.xml: its object is {distance:.3g} scene units away from that of {flash.path}, with "
            f"radii of {reach:.3g} and {radius:.3g}: frames or objects differ; calibrate all photographs together"
        )


def agreement(first: Hull | None, second: Hull | None) -> float:
    """Return to which share, 0 to 1, the masks of each capture are inside the visual hull of the other one.

    `first`, `second`: visual hulls of both. The smaller share counts. It is 1 if there is no hull.
    """
    if not first or not second:
        return 1.0
    shares = []
    for hull, other in ((first, second), (second, first)):
        some = other.silhouettes[::4]
        limits = [max(1, WIDE * silhouette.mask.shape[1]) for silhouette in some]
        shares.append(float((hull.shortfall(some, 50) < np.array(limits)[:, None]).mean()))
    return min(shares)


def points_on(center: np.ndarray, radius: float) -> np.ndarray:
    """Return points (27, 3): 26 on a sphere, and its `center` (3,)."""
    grid = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    return center + radius * grid / np.maximum(np.linalg.norm(grid, axis=1, keepdims=True), 1)


def camera_gaps(capture: Capture, other: Capture, points: np.ndarray) -> np.ndarray:
    """Return how much cameras differ: (n, m), the largest distance [px] between their pictures of `points` (p, 3).

    n, m: numbers of photographs of both captures. It is infinite if two photographs have different sizes.
    """
    there = np.stack([shot.camera.project(points)[0] for shot in other.shots])
    sizes = np.array([shot.size for shot in other.shots])
    gaps = np.full((len(capture), len(other)), np.inf)
    for shot, row in zip(capture.shots, gaps):
        apart = np.linalg.norm(there - shot.camera.project(points)[0], axis=2)  # NaN where a lens folds the picture
        np.copyto(row, np.nan_to_num(np.fmax.reduce(apart, 1), nan=np.inf), where=(sizes == shot.size).all(1))
    return gaps


def has_light(shot: Shot) -> bool:
    """True if a photograph has a light of its own that is not the usual one, of intensity 1 at the camera."""
    kind, place, rgb = shot.own_light
    usual = kind == "point" and np.allclose(place, shot.camera.position, 1e-6) and (rgb == 1).all()
    return bool(rgb.any()) and not usual


def in_room_light(shot: Shot, mate: Shot | None, flash: Shot, name: str) -> Shot:
    """Return a copy of a photograph without a light of its own, named `name`.

    `mate`: a photograph from the same place, whose camera it gets, and whose mask if it has none. None: there is none.
    `flash`: any photograph with flash, which says of which kind the black light is.
    """
    light = (mate or flash).own_light
    shot = replace(shot, name=name, light=light._replace(rgb=np.zeros(3)), falloff=0.0, tilt=(0.0, 0.0))
    if mate is None:
        return shot
    files, mask = shot.files, mate.files.mask
    if files.mask is None and mask != mate.files.filename:  # an alpha channel belongs to its photograph
        files = files._replace(mask=mask)
    return replace(shot, camera=mate.camera, calibrated=mate.calibrated, files=files)
