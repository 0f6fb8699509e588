"""A capture: photographs with their masks, cameras and lights, and the scene that they show."""

import functools
import math
import os
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mi_ring.capture import arrays
from mi_ring.capture.observation import Observation, ObservationCache, observed
from mi_ring.capture.pixels import Pixels
from mi_ring.capture.scenefile import recalibrated_xml, with_photographs
from mi_ring.errors import InputError, SceneError
from mi_ring.geometry.camera import Camera, NoParallax, sphere_of_cameras
from mi_ring.geometry.hull import MAX_MASKS, MAX_WIDTH, Hull, Silhouette, evenly_spaced, shrink_mask, small_silhouette
from mi_ring.images import blur
from mi_ring.plugins import shapenet
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import room_of
from mi_ring.scene.lights import Light
from mi_ring.scene.lobes import Lobes
from mi_ring.scene.shot import Encoding, Files, Shot
from mi_ring.scene.visibility import MaskedCamera
from mi_ring.system import llvm
from mi_ring.system.files import write_file

SOME, COARSE = 50, 128  #: number of photographs, and their reduced width [px], for estimates of brightness
ALBEDO = 0.5  #: assumed for the object if lights are unknown
LIT = 0.01  #: a room is lit if the background is brighter than this [brightness of the object]


def require_variant(what: str | Path) -> None:
    """Raise InputError unless Mitsuba's variant is llvm_ad_rgb or cuda_ad_rgb. The message begins with `what`."""
    if mi.variant() not in ("llvm_ad_rgb", "cuda_ad_rgb"):
        why = llvm.missing() or "call mi.set_variant('llvm_ad_rgb') first"
        raise InputError(f"{what}: needs the variant llvm_ad_rgb or cuda_ad_rgb of Mitsuba, not {mi.variant()}; {why}")


@dataclass(frozen=True, eq=False)
class Capture:
    """Photographs with their masks, cameras and lights, and the scene that they show: the input of a fit.

    `mi_ring.load_capture` reads a capture from a scene file. `from_arrays` makes one from arrays. A capture is
    immutable. To change a field, for example `shots`, make a new capture with `dataclasses.replace`.
    """

    path: Path  #: the scene file; for a capture from arrays its name
    xml: bytes  #: content of the scene file
    scene: mi.Scene
    shape: Any  #: the `shapenet`
    shots: tuple[Shot, ...]  #: the photographs
    room: np.ndarray | None = None  #: light of the room, see `Photographs`; None if it is dark
    shadows: bool = True  #: may the object cast shadows on itself?
    images: Pixels = field(default_factory=Pixels)  #: encoded pixels (H, W, 3) uint8, uint16 or float32; see `observe`
    masks: Pixels = field(default_factory=Pixels)  #: (H, W) uint8, 0 background, 255 object
    valid: Pixels = field(default_factory=Pixels)  #: (H, W) uint8, 0 where the photograph shows nothing
    lobes: Lobes | None = None  #: small lights of the room; None if there are none
    threshold: float | None = None  #: radiance above which pixels are in masks by brightness; None for given masks
    #: Cache of visual hulls, by masks and cameras. Captures that `replace` makes of this one share it.
    hulls: dict[Hashable, Hull | None] = field(default_factory=dict, repr=False)
    observations: ObservationCache = field(default_factory=ObservationCache, init=False, repr=False)

    def __post_init__(self) -> None:
        """Convert lists of arrays, which `replace` may be given, to `Pixels`."""
        for name in ("images", "masks", "valid"):
            if not isinstance(given := getattr(self, name), Pixels):
                object.__setattr__(self, name, Pixels.of(given))

    @classmethod
    def from_arrays(
        cls, images: Sequence[ArrayLike], masks: Sequence[ArrayLike | None] | None = None, *,
        cameras: Sequence[Camera], lights: Sequence[Light | None] | None = None,
        valid: Sequence[ArrayLike | None] | None = None, names: Sequence[str] | None = None,
        center: ArrayLike | None = None, radius: float | None = None, room: ArrayLike | None = None,
        encoding: Encoding = "auto", saturation: float = 1.0, calibrated: bool = False, name: str = "capture",
    ) -> "Capture":  # fmt: skip
        """Make a capture from photographs in arrays. No file is read. The object's BSDF is `cooktorrance`. ::

            camera = mi_ring.Camera(to_world, focal, centre, (width, height))
            light = mi_ring.Light("point", position, intensity)
            capture = mi_ring.Capture.from_arrays(images, masks, cameras=cameras, lights=lights)

        `images`: N arrays (H, W, 3). Their sizes may differ. uint8 is sRGB. uint16 and float32 are linear, unless
        `encoding` is "srgb". Full scale is 1.0 or the largest integer. `saturation`: encoded value (1 = full scale)
        from which a pixel is clipped. Arrays are not copied.

        `masks`, `valid`: N arrays (H, W) of bool, or of uint8 from 0 to 255, or None for a photograph without one. In a
        mask, 255 is the object. Where `valid` is 0, a pixel is ignored. By default, no photograph has a mask, and all
        pixels are valid.

        `cameras`: N `Camera`. The `size` of each is that of the image. `lights`: N `Light`. Each lights only its own
        photograph. None stands for a point light of intensity 1 at the camera. Lengths are in scene units.

        `names`: N different names of photographs. Default: 000, 001, …. `center` (3,), `radius`: sphere around the
        object [scene units]. By default, it is estimated from masks or cameras. `room` (n, 3): light of the room in all
        photographs, as R, G, B of radiance in the first n real spherical harmonics, in world axes; n is 1, 4, 9, 16 or
        25. `calibrated`: True says that cameras and lights are exact. `name`: name of the capture, for error messages
        and reports.

        A scene file can say more about a photograph. To say it here, replace the `shots` by changed ones.

        Raises InputError if the input cannot be fitted. The message names the argument.
        """
        require_variant(name)
        pictures = arrays.images_of(images, encoding)
        shots = arrays.shots_of(pictures, cameras, lights, names, encoding, saturation, calibrated)
        own_masks, shown = arrays.masks_of(masks, pictures, "masks"), arrays.masks_of(valid, pictures, "valid")
        files = list(map(arrays.files_of, shots, pictures, own_masks.given, shown.given))
        xml = arrays.scene_xml(shots, files, center, radius, room)
        scene = mi.load_string(xml.decode(), optimize=False, parallel=False)
        shape = next(s for s in scene.shapes() if isinstance(s, shapenet.ShapeNetMesh))
        capture = cls(Path(name), xml, scene, shape, shots, room_of(scene), True, Pixels.of(pictures), own_masks, shown)
        try:
            capture.photographs  # noqa: B018 (refuses lights that cannot be rendered)
        except SceneError as error:
            raise InputError(f"lights: {error}") from error
        return capture

    @property
    def in_memory(self) -> bool:
        """True if the photographs are arrays in memory, without files."""
        return any(shot.files.filename is None for shot in self.shots)

    def save(self, path: str | Path) -> "Capture":
        """Write a capture from arrays as the scene file `path`. Its photographs and masks are written beside it.

        Returns a copy of the capture that refers to these files. Raises InputError if they cannot be written, or if
        this capture already has a scene file.
        """
        path = Path(path)
        if not self.in_memory:
            raise InputError(f"{path}: is for a capture from arrays; this one has the scene file {self.path}")
        relative, shots = [], []
        for k, shot in enumerate(self.shots):
            own = arrays.files_of(shot, self.images[k], self.masks.given[k], self.valid.given[k])
            files = Files(*(file and path.parent / file for file in own))
            for file, pixels in zip(files, (self.images, self.masks, self.valid)):
                if file:
                    arrays.write_array(pixels[k], file)
            relative.append(replace(shot, files=own))
            shots.append(replace(shot, files=files))
        xml = recalibrated_xml(with_photographs(self.xml, relative), relative, self.room, lobes=self.lobes)
        write_file(path, xml)
        return replace(self, path=path, xml=xml, shots=tuple(shots))

    @functools.cached_property
    def photographs(self) -> Photographs:
        """Cameras, lights and room light of all photographs, in the form that the renderer takes.

        Raises SceneError if a light is not supported.
        """
        return Photographs.of(self.shots, self.room, self.lobes)

    @functools.cached_property
    def sizes(self) -> dict[tuple[int, int], np.ndarray]:
        """Dict from image size (width, height) [px] to the indices of the photographs of this size."""
        sizes = [shot.size for shot in self.shots]
        return {size: np.array([k for k, other in enumerate(sizes) if other == size]) for size in dict.fromkeys(sizes)}

    @property
    def known(self) -> bool:
        """True if the scene says of every photograph that its camera and light are exact."""
        return all(shot.calibrated for shot in self.shots)

    def __len__(self) -> int:
        return len(self.shots)

    @functools.cached_property
    def names(self) -> list[str]:
        """File name of each photograph. If two photographs have the same file name, all names also contain folders."""
        files = [Path(os.path.abspath(shot.files.filename or shot.name)) for shot in self.shots]
        names = [file.name for file in files]
        if len(set(names)) == len(names):
            return names
        try:
            common = os.path.commonpath([file.parent for file in files])
        except ValueError:  # on several drives
            return [file.as_posix() for file in files]
        return [file.relative_to(common).as_posix() for file in files]

    def part(self, index: Sequence[int] | np.ndarray) -> "Capture":
        """Return a capture that contains only the photographs with these indices."""
        pixels = {name: getattr(self, name).part(index) for name in ("images", "masks", "valid") if self.images}
        return replace(self, shots=tuple(self.shots[k] for k in index), **pixels)

    def moved(self, scale: float, rotation: np.ndarray, shift: np.ndarray) -> "Capture":
        """Return a copy with transformed cameras and photographs' lights: x ↦ scale · rotation (3, 3) x + shift (3,).

        Use it for small motions only, because the rest of the scene (room light, table, lamps) does not move.
        """
        return replace(self, shots=tuple(shot.moved(scale, rotation, shift) for shot in self.shots))

    def spread(self, most: int = 200) -> list[int]:
        """Return the indices of at most `most` photographs, evenly spaced."""
        return evenly_spaced(len(self), most)

    def together(self, index: Sequence[int] | np.ndarray, most: int = 8) -> Iterator[np.ndarray]:
        """Split the photographs `index` into groups of one size, each of at most `most`. Yields their indices."""
        for alike in self.sizes.values():
            chosen = np.intersect1d(alike, index)
            for start in range(0, len(chosen), most):
                yield chosen[start : start + most]

    def photograph(self, k: int, scale: int = 1) -> Photographs:
        """Return camera and lights of photograph `k`, for rendering. Width and height are divided by `scale`."""
        return self.selected([k], scale)

    def selected(self, index: Sequence[int] | np.ndarray, scale: int = 1) -> Photographs:
        """Return cameras and lights of the photographs `index`, all of one size, for rendering.

        Width and height are divided by `scale`.
        """
        return self.photographs.select(index, self.shots[index[0]].size, scale)

    def observe(self, index: Sequence[int] | np.ndarray, scale: int = 1) -> Observation:
        """Read the photographs `index`, all of one size, and average blocks of `scale` × `scale` pixels."""
        return Observation.joined([self.observations.get(k, scale, partial(self._observe, k, scale)) for k in index])

    def _observe(self, k: int, scale: int) -> Observation:
        return observed(self.shots[k], self.images[k], self.masks[k], self.valid[k], scale)

    def clear_caches(self) -> None:
        """Remove all pixels from the caches, which other captures may share. They are read again when they are used."""
        self.observations.clear()
        for pixels in (self.images, self.masks, self.valid):
            pixels.clear()

    def exposure(self) -> float:
        """Estimate the mean linear radiance of the object's pixels (1 = full scale of the files) from some photographs.

        Those without a light of their own are left out if there are others. In a photograph without a mask, pixels
        above 2 % of its maximum count. Raises InputError if all of them are black, or all clipped.
        """
        total, count, clipped, index = 0.0, 0, True, self.photographs.mainly
        for k in index[evenly_spaced(len(index), SOME)]:
            side = min(self.shots[k].size)
            rgb, over, mask, masked, _ = self.observe([k], max(4 if side >= 16 else 1, side // COARSE))
            inside = mask[0] > 0.5 if masked else rgb[0].mean(-1) > 0.02 * rgb.max()
            total, count = total + float(rgb[0][inside].sum()), count + 3 * int(inside.sum())
            clipped &= bool(over[0][inside].all())
        if clipped or not total > 0:
            fault = "over-exposed; take darker ones" if total > 0 else "black; check exposure and masks"
            raise InputError(f"{self.path}: photographs: every pixel of the object is {fault}")
        return total / count

    @functools.cached_property
    def lit_room(self) -> bool:
        """True if pixels outside the masks are lit, in photographs with or in those without their own light."""
        shares: dict[bool, list[float]] = {}
        for k in self.spread(SOME):
            rgb, _, mask, masked, valid = self.observe([k], max(1, min(self.shots[k].size) // COARSE))
            inside, outside = mask[0] > 0.99, blur(mask, 2.0)[0] < 0.01
            if valid is not None:
                outside &= valid[0]
            if masked and inside.any() and outside.any():
                share = float(rgb[0][outside].quantile(0.9) / rgb[0][inside].mean().clamp(min=1e-9))
                shares.setdefault(bool(self.photographs.lit[k]), []).append(share)
        return any(float(np.median(several)) > LIT for several in shares.values())

    def reflectance(self, center: np.ndarray, exposure: float) -> float:
        """Estimate the reflectance, radiance / irradiance [1/sr], of the object at `center` (3,) [scene units].

        `exposure`: mean radiance of the object. If no known light reaches it, the albedo is assumed to be 0.5.
        """
        received = float(np.median(self.photographs.irradiance(center)[self.photographs.mainly].mean(1)))
        return exposure / received if received > 0 else ALBEDO / math.pi

    @property
    def up(self) -> np.ndarray:
        """Mean up direction (3,) of the cameras, of length 1; that of the first camera if the mean is near 0."""
        ups = np.stack([shot.camera.up for shot in self.shots])
        up = ups.mean(0) if np.linalg.norm(ups.mean(0)) > 0.1 else ups[0]
        return up / np.linalg.norm(up)

    def silhouettes(self, most: int | None = None) -> list[Silhouette]:
        """Return the masks of the photographs with their cameras, reduced in size. Equal pairs of both occur once.

        `most`: largest number of silhouettes, which are then evenly spaced. None: all.
        """
        return [
            small_silhouette(Silhouette(
                self.masks[k], self.shots[k].camera, self.outline(k), self.valid[k],
                self.shots[k].frame if self.shots[k].window else None))
            for k in self._outlined(most)
        ]  # fmt: skip

    def _outlined(self, most: int | None) -> list[int]:
        """Indices of the photographs that `silhouettes` uses."""
        once: dict[tuple, int] = {}
        for k, (mask, shot) in enumerate(zip(self.masks.readers, self.shots)):
            if mask is not None:
                once.setdefault((mask, shot.camera.to_world.tobytes()), k)
        all_ = list(once.values())
        return [all_[i] for i in evenly_spaced(len(all_), len(all_) if most is None else most)]

    @property
    def views(self) -> list[MaskedCamera]:
        """Camera of each photograph, with its mask of valid pixels (None: all are valid). Both are reduced in size."""
        return views_of(self.shots, self.valid)

    @property
    def hull(self) -> Hull | None:
        """Visual hull of the masks. It is None if there are no masks, or if all cameras look from one side."""
        index, wrong = self._outlined(MAX_MASKS), 0.02 if self.whole else 0.25
        key = wrong, *((self.masks.readers[k], self.valid.readers[k], self.shots[k].camera.key) for k in index)
        if key not in self.hulls:
            try:
                self.hulls[key] = Hull(self.silhouettes(MAX_MASKS), str(self.path), wrong) if index else None
            except NoParallax:
                self.hulls[key] = None
        return self.hulls[key]

    @property
    def whole(self) -> bool:
        """True if the masks contain the whole object. Masks from brightness may lack the object's shadowed side."""
        return self.threshold is None or (self.photographs.colocated and not self.photographs.dark)

    def outline(self, k: int) -> str:
        """Return the name of the file that contains the mask of photograph `k`. The name is for messages."""
        return str(self.shots[k].files.mask or self.shots[k].files.filename or self.shots[k].name)

    def sphere(self) -> tuple[np.ndarray, float]:
        """Return (centre (3,), radius) [scene units] of the normalising sphere: given by the file or else estimated."""
        center, radius = self.shape.center, self.shape.radius
        if center is None or radius is None:
            if self.hull:
                middle, ball = self.hull.ball()
                ball *= 1.3  # a fit starts from this sphere, and shrinking is faster than growing limbs
            else:
                middle, ball = sphere_of_cameras([shot.whole.camera for shot in self.shots], str(self.path))
            center, radius = middle if center is None else center, ball if radius is None else radius
        return center, radius


def views_of(shots: Sequence[Shot], valid: Pixels) -> list[MaskedCamera]:
    """Return the camera of each photograph with its mask of valid pixels (None: all are valid), reduced in size."""
    small: dict[Any, tuple[np.ndarray | None, int]] = {None: (None, 1)}
    for k, reader in enumerate(valid.readers):
        if reader not in small:
            small[reader] = shrink_mask(valid[k], MAX_WIDTH)
    found = [small[reader] for reader in valid.readers]
    return [MaskedCamera(shot.camera.shrunk(scale), mask) for shot, (mask, scale) in zip(shots, found, strict=True)]
