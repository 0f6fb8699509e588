"""A capture: the photographs, masks, cameras and lights of a scene file as tensors."""

import functools
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.decoding import decode, is_linear, shade
from mi_ring.capture.pixels import Pixels
from mi_ring.errors import InputError
from mi_ring.geometry.camera import NoParallax, nearest_point
from mi_ring.geometry.hull import MOST, WIDTH, Hull, Silhouette, evenly, shrink_mask, small_silhouette
from mi_ring.images import blur, box_filter
from mi_ring.rendering.photographs import Photographs
from mi_ring.scene.visibility import MaskedCamera

#: Of small photographs, to save decoding them again. A pixel takes up to 200 bytes: what stays tears holes in memory.
REMEMBERED_PIXELS = 2**23

SOME, COARSE = 50, 128  #: how many photographs, and pixels across them, tell how bright object and room are
ALBEDO = 0.5  #: of an object of which nothing says how much it reflects
LIT = 0.01  #: brightness of the background, in that of the object, from which a room is not black


class Observation(NamedTuple):
    """Photographs as a fit sees them, n of one size."""

    rgb: Tensor  #: (n, H, W, 3) linear radiance, 1.0 = full scale of the file
    clipped: Tensor  #: (n, H, W, 3) bool: the scene is at least this bright
    mask: Tensor  #: (n, H, W) the object's coverage in [0, 1]; 0 where there is no mask
    masked: Tensor  #: (n,) bool: which have a mask
    valid: Tensor | None  #: (n, H, W) bool: which pixels say something; None if all do. Others are black and clipped

    def surely(self, coverage: Tensor) -> Tensor:
        """(n, H, W) bool: where pixels are wholly object, by their masks, if they have any, and by a `coverage`."""
        mask = torch.where(self.masked.to(self.mask.device)[:, None, None], self.mask, 1.0)
        return torch.minimum(mask, coverage) > 0.99

    def to(self, device: torch.device) -> "Observation":
        """The same on a device."""
        return Observation(*(None if tensor is None else tensor.to(device) for tensor in self))  # type: ignore[arg-type]


@dataclass
class Capture:
    """What a scene file gives to a fit. `images` are the files' encoded pixels, decoded on demand by `observe`.

    Nothing that renders or fits a capture changes it. Lists of arrays may take the place of its pixels.
    """

    path: Path
    scene: mi.Scene
    shape: Any  #: the `shapenet`
    sensors: list  #: the photographs
    photographs: Photographs  #: their cameras and lights
    shadows: bool
    images: Pixels = field(default_factory=lambda: Pixels([]))  #: (H, W, 3) uint8, uint16 or float32 each
    masks: Pixels = field(default_factory=lambda: Pixels([]))  #: (H, W) uint8, 0 background, 255 object
    valid: Pixels = field(default_factory=lambda: Pixels([]))  #: (H, W) uint8, 0 where the photograph shows nothing
    threshold: float | None = None  #: radiance by which masks were found in the photographs; None if they were not

    def __post_init__(self) -> None:
        sizes = [sensor.size for sensor in self.sensors]
        self._decoded: dict[int, tuple] = {}  # (scale, result of `decoded`) by photograph
        self._remembered = 0  # their pixels
        #: Indices of the photographs of each size (width, height); one launch renders photographs of one size.
        self.sizes = {size: np.array([i for i, s in enumerate(sizes) if s == size]) for size in dict.fromkeys(sizes)}

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("images", "masks", "valid") and not isinstance(value, Pixels):
            value = Pixels.of(value)
        super().__setattr__(name, value)

    @property
    def known(self) -> bool:
        """Does the scene say that cameras and lights are exact?"""
        return all(sensor.calibrated for sensor in self.sensors)

    def __len__(self) -> int:
        return len(self.sensors)

    @functools.cached_property
    def names(self) -> list[str]:
        """File names of the photographs, with folders where they would not tell one from another without."""
        files = [Path(os.path.abspath(sensor.filename)) for sensor in self.sensors]
        names = [file.name for file in files]
        if len(set(names)) == len(names):
            return names
        try:
            common = os.path.commonpath([file.parent for file in files])
        except ValueError:  # on several drives
            return [file.as_posix() for file in files]
        return [file.relative_to(common).as_posix() for file in files]

    def part(self, index: Sequence[int] | np.ndarray) -> "Capture":
        """The photographs of these indices alone."""
        sensors = [self.sensors[k] for k in index]
        pixels = {name: getattr(self, name).part(index) for name in ("images", "masks", "valid") if self.images}
        return replace(self, sensors=sensors, photographs=Photographs.of(sensors, self.photographs.room), **pixels)

    def spread(self, most: int = 200) -> list[int]:
        """Indices of at most so many photographs, evenly spread: enough to look at."""
        return evenly(len(self), most)

    def together(self, index: Sequence[int] | np.ndarray, most: int = 8) -> Iterator[np.ndarray]:
        """Photographs `index`, at most so many at a time and all of one size: what one launch renders."""
        for alike in self.sizes.values():
            chosen = np.intersect1d(alike, index)
            for start in range(0, len(chosen), most):
                yield chosen[start : start + most]

    def photograph(self, k: int, scale: int = 1) -> Photographs:
        """Photograph `k` alone, to be rendered `scale` times smaller."""
        return self.selected([k], scale)

    def selected(self, index: Sequence[int] | np.ndarray, scale: int = 1) -> Photographs:
        """Photographs `index`, all of one size, to be rendered `scale` times smaller."""
        return self.photographs.select(index, self.sensors[index[0]].size, scale)

    def observe(self, index: Sequence[int] | np.ndarray, scale: int = 1) -> Observation:
        """Photographs `index`, all of one size, box-filtered `scale` times smaller."""
        rgb, clipped, mask, valid = zip(*(self.decoded(k, scale) for k in index))
        masked = torch.tensor(self.masks.part(index).given)
        if all(v is None for v in valid):
            return Observation(torch.stack(rgb), torch.stack(clipped), torch.stack(mask), masked, None)
        shown = [torch.ones_like(m, dtype=torch.bool) if v is None else v for v, m in zip(valid, mask)]
        return Observation(torch.stack(rgb), torch.stack(clipped), torch.stack(mask), masked, torch.stack(shown))

    def decoded(self, k: int, scale: int) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """One photograph of `observe`. If smaller than the file and if it fits, it is remembered, at its last scale."""
        if k in self._decoded:
            before, result = self._decoded[k]
            if before == scale:
                return result
            self._remembered -= self._decoded.pop(k)[1][2].numel()
        sensor = self.sensors[k]
        image = self.images[k]
        linear, saturated = decode(image, is_linear(sensor, image), sensor.saturation, sensor.gamma, sensor.contrast)
        linear = linear / shade(sensor)
        mask, own = self.masks[k], self.valid[k]
        mask = np.zeros(linear.shape[:2], np.uint8) if mask is None else mask
        valid = None
        if own is not None:
            shown = own > 127
            linear = np.where(shown[..., None], linear, 0)
            saturated = saturated | ~shown[..., None]  # nothing is known: the scene is at least this black
            valid = box_filter(torch.from_numpy(shown).float()[..., None], scale)[..., 0] == 1
        result = (
            box_filter(torch.from_numpy(linear), scale),
            box_filter(torch.from_numpy(saturated).float(), scale) > 0,
            box_filter(torch.from_numpy(mask).float()[..., None] / 255, scale)[..., 0],
            valid,
        )
        pixels = result[2].numel()
        if scale > 1 and self._remembered + pixels <= REMEMBERED_PIXELS:
            self._decoded[k] = scale, result
            self._remembered += pixels
        return result

    def exposure(self) -> float:
        """Mean linear radiance of the object's pixels (of all that are not black, where there are no masks).

        Of many photographs some tell.
        """
        total, count = 0.0, 0
        for k in self.spread(SOME):
            side = min(self.sensors[k].size)
            rgb, _, mask, masked, _ = self.observe([k], max(4 if side >= 16 else 1, side // COARSE))
            inside = mask[0] > 0.5 if masked else rgb[0].mean(-1) > 0.02 * rgb.max()
            total, count = total + float(rgb[0][inside].sum()), count + 3 * int(inside.sum())
        if not total > 0:
            raise InputError(f"{self.path}: photographs: every pixel of the object is black; check exposure and masks")
        return total / count

    @functools.cached_property
    def lit_room(self) -> bool:
        """Is more to be seen than the object, by the photographs' masks? Then colours beside it say nothing.

        Where the room was black they say that nothing is there.
        """
        shares = []
        for k in self.spread(SOME):
            rgb, _, mask, masked, valid = self.observe([k], max(1, min(self.sensors[k].size) // COARSE))
            inside, outside = mask[0] > 0.99, blur(mask, 2.0)[0] < 0.01
            if valid is not None:
                outside &= valid[0]
            if masked and inside.any() and outside.any():
                shares.append(float(rgb[0][outside].quantile(0.9) / rgb[0][inside].mean().clamp(min=1e-9)))
        return bool(shares) and float(np.median(shares)) > LIT

    def reflectance(self, center: np.ndarray, exposure: float) -> float:
        """Order of magnitude of ρ: what makes a surface at `center` as bright as `exposure` under these lights.

        That of `ALBEDO` where photographs have no light of their own: what others bring nobody knows.
        """
        received = float(np.median(self.photographs.irradiance(center).mean(1)))
        return exposure / received if received > 0 else ALBEDO / math.pi

    @property
    def up(self) -> np.ndarray:
        """The mean direction (3,) that is up in the photographs; in the first if they were held in every way."""
        ups = np.stack([sensor.camera.up for sensor in self.sensors])
        up = ups.mean(0) if np.linalg.norm(ups.mean(0)) > 0.1 else ups[0]
        return up / np.linalg.norm(up)

    def silhouettes(self, most: int | None = None) -> list[Silhouette]:
        """The masks with their cameras, small, one for all photographs that share both; at most so many, evenly."""
        once: dict[tuple, int] = {}
        for k, (mask, sensor) in enumerate(zip(self.masks.readers, self.sensors)):
            if mask is not None:
                once.setdefault((mask, sensor.camera.to_world.tobytes()), k)
        all_ = list(once.values())
        chosen = [all_[i] for i in evenly(len(all_), len(all_) if most is None else most)]
        return [
            small_silhouette(Silhouette(self.masks[k], self.sensors[k].camera, self.outline(k), self.valid[k]))
            for k in chosen
        ]

    @property
    def views(self) -> list[MaskedCamera]:
        """What each photograph can show."""
        return views_of(self.sensors, self.valid)

    @functools.cached_property
    def hull(self) -> Hull | None:
        """The visual hull of the masks, if there are any and they are seen from more than one side."""
        silhouettes = self.silhouettes(MOST)
        try:
            return Hull(silhouettes, str(self.path), 0.02 if self.whole else 0.25) if silhouettes else None
        except NoParallax:
            return None

    @property
    def whole(self) -> bool:
        """Do masks show the whole object? Those that were found do not show what is in shadow."""
        return self.threshold is None or (self.photographs.colocated and not self.photographs.dark)

    def outline(self, k: int) -> str:
        """The file that photograph `k` has its mask from."""
        return str(self.sensors[k].mask or self.sensors[k].filename)

    def sphere(self) -> tuple[np.ndarray, float]:
        """Normalising sphere (center (3,), radius) [scene units]: from the XML, else the masks, else the cameras."""
        center, radius = self.shape.center, self.shape.radius
        if center is None or radius is None:
            middle, ball = sphere_of_masks(self.hull) if self.hull else sphere_of_cameras(self)
            center, radius = middle if center is None else center, ball if radius is None else radius
        return center, radius


def views_of(sensors: Sequence, valid: Pixels) -> list[MaskedCamera]:
    """What photographs can show that have these masks of what is valid, which are made small."""
    small: dict[Any, tuple[np.ndarray | None, int]] = {None: (None, 1)}
    for k, reader in enumerate(valid.readers):
        if reader not in small:
            small[reader] = shrink_mask(valid[k], WIDTH)
    found = [small[reader] for reader in valid.readers]
    return [
        MaskedCamera(sensor.camera.shrunk(scale), mask) for sensor, (mask, scale) in zip(sensors, found, strict=True)
    ]


def sphere_of_masks(hull: Hull) -> tuple[np.ndarray, float]:
    """Centre of the masks' visual hull and 1.3 times the radius of the ball of the same volume [scene units].

    A start surface that is a little too large shrinks onto the object, which goes faster than growing limbs.
    """
    center, radius = hull.ball()
    return center, 1.3 * radius


def sphere_of_cameras(capture: Capture) -> tuple[np.ndarray, float]:
    """The point that all cameras look at, and half the radius of the ball there that every photograph holds."""
    cameras = [sensor.camera for sensor in capture.sensors]
    origins = np.stack([camera.position for camera in cameras])
    center = nearest_point(origins, np.stack([camera.forward for camera in cameras]), str(capture.path))
    half_angle = min(np.arctan(min(camera.size) / 2 / camera.focal.max()) for camera in cameras)
    return center, float(0.5 * np.sin(half_angle) * np.linalg.norm(origins - center, axis=1).min())
