"""Tests whether the masks of a capture agree. If they do not, it looks for a mistake in cameras or masks.

A pixel of a mask is confirmed if its ray hits the visual hull of all masks.
"""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.geometry.hull import Hull, Silhouette, evenly_spaced, subsample

CONFORMS = 0.9  #: least share of a mask that the others must agree with
AROUND = 0.9  #: share of a photograph's border above which a mask is that of the background


def agreements(capture: Capture) -> tuple[dict[str, float], list[str]]:
    """Test whether the masks of a capture agree. Returns (shares, problems).

    `shares`: a dict from mask files to the share of the mask that all other masks confirm. `problems`: sentences for
    the user. Both are empty if the capture has no visual hull.
    """
    if not capture.hull:
        return {}, []
    silhouettes = capture.silhouettes()
    pixels = max(16, 12800 // len(silhouettes))

    def shares(hull: Hull) -> np.ndarray:
        return (hull.shortfall(silhouettes, pixels) < 1).mean(1)

    agree, why, turned = shares(capture.hull), None, []
    if capture.whole and agree.min() < CONFORMS:
        whole = [silhouette.whole for silhouette in subsample(silhouettes, 32, 96)]
        why = mistake(whole) if np.median(agree) < CONFORMS else None
        if not why:  # one wrong mask damages the hull; a hull that tolerates wrong masks may find it
            tolerant = copy.copy(capture.hull)
            tolerant.outliers = max(0.1, 1.01 / len(tolerant.silhouettes))
            robust = shares(tolerant)
            if np.median(robust) >= CONFORMS:
                agree = robust
                turned = [word for k in np.flatnonzero(robust < CONFORMS) for word in turns(silhouettes[k], tolerant)]
            else:
                why = "cameras or masks are wrong"
    wrong = [f"The masks agree to {agree.mean():.0%} only: {why}"] if why else turned
    if not why and capture.whole and np.median([border(silhouette.whole) for silhouette in silhouettes]) > AROUND:
        wrong = [
            "masks cover the border of most photographs: are they inverted? 255 is to be the object, 0 the background"
        ]
    return {silhouette.name: float(a) for silhouette, a in zip(silhouettes, agree)}, wrong


def turns(silhouette: Silhouette, hull: Hull) -> list[str]:
    """Return sentences for the user: by which angles the mask of a photograph may be turned. It is empty if by none.

    Turned back by such an angle, the mask agrees with the `hull` of all. 90 and 270 degrees are tried if it is square.
    """
    mask = silhouette.whole.mask
    quarters = (1, 2, 3) if mask.shape[0] == mask.shape[1] else (2,)
    back = [silhouette.whole._replace(mask=np.rot90(mask, -k)) for k in quarters]
    agree = (hull.shortfall(back) < 1).mean(1)
    return [f"{Path(silhouette.name).name}: mask or camera is turned by {90 * k} degrees counterclockwise: turn it back"
            for k, share in zip(quarters, agree) if share >= CONFORMS]  # fmt: skip


def with_camera(silhouette: Silhouette, **changed: Any) -> Silhouette:
    """Return a copy of a silhouette with a changed camera.

    `changed`: new values of the camera's fields, such as `focal=…`.
    """
    return silhouette._replace(camera=silhouette.camera._replace(**changed))


#: Mistakes in camera-to-world matrices, and functions that correct them.
MATRICES = {
    "": lambda m: m,
    "to_world is world-to-camera: invert it": np.linalg.inv,
    "the rotation in to_world is transposed: transpose its upper left 3 x 3":
        lambda m: np.block([[m[:3, :3].T, m[:3, 3:]], [m[3:]]]),
}  # fmt: skip
#: Mistakes in the camera axes, and the signs that correct them.
AXES = {
    "": (1, 1, 1),
    "its axes are OpenCV's (COLMAP's), x right, y down: to_world @ diag(-1, -1, 1, 1); or all masks are turned by 180 "
    "degrees": (-1, -1, 1),
    "its axes are OpenGL's (NeRF's, Blender's), x right, y up: to_world @ diag(-1, 1, -1, 1)": (-1, 1, -1),
    "its y and z are flipped: to_world @ diag(1, -1, -1, 1)": (1, -1, -1),
}
#: Other mistakes, and functions that correct a silhouette.
OTHERS = {
    "cx and cy are exchanged": lambda s: with_camera(s, centre=s.camera.centre[[1, 0]]),
    "fx, fy, cx, cy are for photographs of half the size: double them":
        lambda s: with_camera(s, focal=2 * s.camera.focal, centre=2 * s.camera.centre),
    "fx, fy, cx, cy are for photographs of twice the size: halve them":
        lambda s: with_camera(s, focal=s.camera.focal / 2, centre=s.camera.centre / 2),
    "photographs or masks are upside down": lambda s: s._replace(mask=s.mask[::-1]),
    "photographs or masks are mirrored": lambda s: s._replace(mask=s.mask[:, ::-1]),
}  # fmt: skip


def share_agreed(silhouettes: Sequence[Silhouette]) -> float:
    """Compute the share of mask pixels that all masks confirm: the rays through these pixels hit the visual hull.

    It is 0 if the hull is empty.
    """
    try:
        return float((Hull(silhouettes, "").shortfall(samples=48) < 1).mean())
    except InputError:
        return 0.0


def border(silhouette: Silhouette) -> float:
    """Compute which share of the pixels along the border of a photograph is inside the mask, 0 to 1."""
    mask = silhouette.mask > 127
    return float(np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean())


def mistake_in_masks(silhouettes: Sequence[Silhouette]) -> dict[str, Sequence[Silhouette]]:
    """List mistakes that the user may have made in the masks.

    Returns a dict from descriptions to corrected silhouettes.
    """
    guesses: dict[str, Sequence[Silhouette]] = {}
    if np.median([border(silhouette) for silhouette in silhouettes]) > 0.5:  # an object is rarely all around
        guesses["masks are inverted: 255 is to be the object, 0 the background"] = [
            s._replace(mask=255 - s.mask) for s in silhouettes]  # fmt: skip
    if len({silhouette.mask.shape for silhouette in silhouettes}) == 1:
        for step, other in ((1, "next"), (-1, "previous")):
            masks = [silhouette.mask for silhouette in (*silhouettes[step:], *silhouettes[:step])]
            guesses[f"each photograph has the mask of the {other} one: name the masks as the photographs"] = [
                s._replace(mask=mask) for s, mask in zip(silhouettes, masks)]  # fmt: skip
    return guesses


def mistake(silhouettes: Sequence[Silhouette]) -> str | None:
    """Find a mistake in the masks or cameras that explains why the masks disagree. It tries usual mistakes.

    Returns a description for the user; None if no such mistake is found.
    """
    some = subsample(silhouettes, 32, 96)
    limit = max(CONFORMS, share_agreed(some) + 0.05)
    masks = {name: share_agreed(subsample(guess, 32, 96)) for name, guess in mistake_in_masks(silhouettes).items()}
    if masks and masks[best := max(masks, key=masks.__getitem__)] >= limit:  # before the cameras are blamed
        return f"{best} (the masks then agree to {masks[best]:.0%})"
    guesses = {name: [change(s) for s in some] for name, change in OTHERS.items()}
    for first, change in MATRICES.items():
        for second, axes in AXES.items():
            name = "; then ".join(part for part in (first, second) if part)
            guesses[name] = [with_camera(s, to_world=change(s.camera.to_world) @ np.diag([*axes, 1.0])) for s in some]
    del guesses[""]
    scores = {name: share_agreed(guess) for name, guess in guesses.items()}
    best = max(scores, key=scores.__getitem__)
    if scores[best] < limit:
        return None
    return f"{best} (the masks then agree to {scores[best]:.0%})"


def half_pixel(hull: Hull) -> str | None:
    """Test whether all principal points are wrong by half a pixel.

    Returns a sentence for the user; None if they are not.
    """
    gaps, some = dict[float, float](), evenly_spaced(len(hull.silhouettes), 32)
    silhouettes, distances = [hull.silhouettes[k] for k in some], [hull.distances[k] for k in some]
    hull = copy.copy(hull)
    hull.distances = distances
    for shift in (-0.5, 0.0, 0.5):
        hull.silhouettes = [with_camera(s, centre=s.camera.centre + shift) for s in silhouettes]
        gaps[shift] = float(np.mean(hull.shortfall(pixels=50, samples=96, outline=True).clip(max=2)))
    best = min(gaps, key=gaps.__getitem__)
    if gaps[0.0] > 0.01 and gaps[best] < 0.5 * gaps[0.0]:
        do = "add 0.5 to" if best > 0 else "subtract 0.5 from"
        return f"principal points seem off by half a pixel: {do} cx and cy (the first pixel's centre is 0.5, 0.5)"
    return None
