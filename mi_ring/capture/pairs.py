"""Captures with two kinds of photographs: with a light of their own, a flash, and in the light of the room alone.

Photographs of both kinds from the same place are pairs.
"""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import read_photograph
from mi_ring.capture.pixels import Pixels
from mi_ring.scene.shot import Shot


def with_room_photographs(capture: Capture) -> Capture:
    """Return a copy of the capture in which `ambient` images are photographs, too, which the room alone lights.

    They follow the others. Each has the camera, the mask and the response of the photograph that names it. An image is
    left out if it is a photograph of the capture already, or if the photograph that names it has no mask: a lit
    background would be taken for the object. No file is read.
    """
    known = {real(shot.files.filename) for shot in capture.shots}
    index, shots = [], list(capture.shots)
    for k, shot in enumerate(capture.shots):
        file = shot.files.ambient
        if file and capture.masks.given[k] and real(file) not in known:
            known.add(real(file))
            index.append(k)
            shots.append(room_photograph(shot, {other.name for other in shots}))
    if not index:
        return capture
    readers = [partial(read_photograph, shot, capture.path) for shot in shots[len(capture) :]]
    images = Pixels([*capture.images.readers, *readers], capture.images.kept)
    masks, valid = (
        Pixels([*own.readers, *own.part(index).readers], own.kept) for own in (capture.masks, capture.valid)
    )
    return replace(capture, shots=tuple(shots), images=images, masks=masks, valid=valid)


def room_photograph(shot: Shot, names: set[str]) -> Shot:
    """Return the `ambient` image of a photograph as a photograph, without a light of its own.

    `names`: names of photographs, which it must not have.
    """
    files = shot.files._replace(filename=shot.files.ambient, ambient=None)
    name = free_name(f"{shot.name}_room", names)
    return replace(shot, name=name, light=shot.own_light._replace(rgb=np.zeros(3)), files=files)


def free_name(name: str, names: set[str]) -> str:
    """Return a name that is not in `names`: `name`, with as many underscores at its end as that takes."""
    while name in names:
        name += "_"
    return name


def real(file: Path | None) -> str:
    """Return the path of a file without links, to compare it with others."""
    return os.path.realpath(str(file))


def camera_numbers(capture: Capture) -> np.ndarray:
    """Number the cameras of a capture. Returns (P,) int, the number of each photograph's camera.

    In a capture with both kinds of photographs, those whose cameras are equal have the same number. Differences of the
    lens by rounding do not count. In all other captures each photograph has a number of its own.
    """
    if not capture.photographs.mixed:
        return np.arange(len(capture))
    known: dict[tuple, int] = {}
    cameras = [shot.whole.camera for shot in capture.shots]
    # Crops of other sizes change the last digits of the lens.
    rounded = [camera._replace(focal=camera.focal.round(3), centre=camera.centre.round(3) + 0.0) for camera in cameras]
    return np.array([known.setdefault(camera.key, len(known)) for camera in rounded])


def varies_in_exposure(capture: Capture) -> bool:
    """Test whether photographs in the room's light alone may have other exposures than those with their own light.

    False if there are no such photographs beside others, and if all are the `ambient` images of others: these have the
    same exposure.
    """
    paired = {real(shot.files.ambient) for shot in capture.shots if shot.files.ambient}
    photographs = capture.photographs
    several = zip(capture.shots, photographs.lit)
    return photographs.mixed and any(not lit and real(shot.files.filename) not in paired for shot, lit in several)
