"""Cameras and lights of many photographs as Dr.Jit buffers, and the rays of their pixels."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.rendering.photograph_lights import Lights, cone
from mi_ring.rendering.pinhole import camera_ray
from mi_ring.rendering.spherical_harmonics import shown

LANES = 2**22  #: rays at once where memory is to be bounded: about a gigabyte


@dataclass(frozen=True)
class Photographs:
    """Cameras and lights of all photographs of a scene as Dr.Jit buffers, and which of them to render.

    `index` (UInt32) selects and orders them; `size` is (width, height) [px] of every selected photograph.
    """

    cameras: object  #: Float, 12 per photograph: the upper three rows of to_world
    intrinsics: object  #: Float, 4 per photograph: fx, fy, cx, cy [px]
    lights: Lights
    index: object
    size: tuple[int, int]
    colocated: bool  #: is every light at its camera's centre? Then nothing that is seen is in shadow
    falloff: object = None  #: Float, one per photograph: exponent of its flash's cone; None if all shine to all sides
    distortion: object = None  #: Float, one per photograph: its lens' as `Camera` has it; None if no lens has any
    room: np.ndarray | None = (
        None  #: light of the room as in `mi_ring.rendering.spherical_harmonics`, (BASIS, 3); None if it is dark
    )
    dark: bool = False  #: have they no lights of their own, which are 0 strong?
    before: int = 0  #: how many others come before them, rendered elsewhere: random numbers are as if all were together

    @classmethod
    def of(cls, sensors: Sequence, room: np.ndarray | None = None) -> "Photographs":
        """All `photograph` sensors of a scene; `size` is the first one's, `select` those of equal size."""
        cameras = [sensor.camera for sensor in sensors]
        matrices = np.stack([camera.to_world[:3] for camera in cameras])
        intrinsics = np.stack([np.concatenate([camera.focal, camera.centre]) for camera in cameras])
        lights = Lights.of(sensors)
        falloff = np.array([sensor.cone for sensor in sensors], np.float32)
        bent = np.array([camera.distortion for camera in cameras], np.float32)
        # Equal but for the rounding of float32.
        off = np.abs(lights.positions() - matrices[:, :, 3]).max(1) > 1e-6 * np.abs(matrices[:, :, 3]).max()
        return cls(
            mi.Float(matrices.astype(np.float32).ravel()), mi.Float(intrinsics.astype(np.float32).ravel()), lights,
            dr.arange(mi.UInt32, len(sensors)), sensors[0].size, not (off | ~lights.is_finite()).any(),
            mi.Float(falloff) if falloff.any() else None, mi.Float(bent) if bent.any() else None, room,
            dark=not lights.rgb().any(),
        )  # fmt: skip

    @classmethod
    def attached(cls, sensor) -> "Photographs":
        """One photograph, its camera and its light attached to the parameters of the sensor."""
        m = sensor.to_world.matrix
        return replace(
            cls.of([sensor]),
            cameras=dr.concat([mi.Float(m[i, j]) for i in range(3) for j in range(4)]),
            intrinsics=dr.concat([*sensor.focal, *sensor.centre]),
            lights=Lights.attached(sensor),
            falloff=mi.Float(sensor.falloff),
            distortion=mi.Float(sensor.distortion),
        )

    def select(self, index: Sequence[int] | np.ndarray, size: tuple[int, int], scale: int = 1) -> "Photographs":
        """Photographs `index`, all (width, height) = `size`, rendered `scale` times smaller."""
        width, height = size
        return replace(
            self, intrinsics=self.intrinsics / dr.opaque(mi.Float, scale),
            index=mi.UInt32(np.asarray(index, np.uint32)), size=(width // scale, height // scale),
        )  # fmt: skip

    def moved(self, cameras, intrinsics, places, strengths, falloff=None, distortion=None) -> "Photographs":
        """The same with other buffers of cameras and lights; no light is taken to be exactly at its camera.

        Cones of flashes and distortion of lenses stay as they are if none are given.
        """
        return replace(
            self, cameras=cameras, intrinsics=intrinsics, colocated=False,
            lights=replace(self.lights, places=places, strengths=strengths),
            falloff=self.falloff if falloff is None else falloff,
            distortion=self.distortion if distortion is None else distortion,
        )  # fmt: skip

    def in_units(self, unit: float) -> "Photographs":
        """The same pictures in a world of another unit of length, of so many scene units."""
        if unit == 1:
            return self
        entry, finite = dr.arange(mi.UInt32, dr.width(self.cameras)), self.lights.finite
        length = dr.select(entry % 4 == 3, 1 / unit, 1)
        near = dr.gather(mi.Bool, finite, dr.arange(mi.UInt32, 3 * dr.width(finite)) // 3)
        scale = dr.select(near, 1 / unit, 1)
        places, strengths = self.lights.places * scale, self.lights.strengths * scale * scale  # its square may be inf
        lights = replace(self.lights, places=places, strengths=strengths)
        return replace(self, cameras=self.cameras * length, lights=lights)

    def __len__(self) -> int:
        return dr.width(self.index)

    def camera(self, view):
        """(to_world, focal, centre, distortion) of the selected photograph `view`, one per lane."""
        k = dr.gather(mi.UInt32, self.index, view)
        rows = [dr.gather(mi.Vector4f, self.cameras, 3 * k + row) for row in range(3)]
        f = dr.gather(mi.Vector4f, self.intrinsics, k)
        to_world = mi.Matrix4f(*[list(row) for row in rows], [0, 0, 0, 1])
        distortion = None if self.distortion is None else dr.gather(mi.Float, self.distortion, k)
        return to_world, mi.Point2f(f.x, f.y), mi.Point2f(f.z, f.w), distortion

    def eye(self, view):
        """The camera of photograph `view`, one per lane, as an eye of `Edges`."""
        to_world, *_ = self.camera(view)
        return mi.Vector3f(to_world[0, 3], to_world[1, 3], to_world[2, 3]), mi.Bool(True)

    def source(self, view):
        """The light of photograph `view`, one per lane, as an eye of `Edges`."""
        return self.lights.eye(dr.gather(mi.UInt32, self.index, view))

    def light(self, view, si):
        """(DirectionSample3f, radiance · d⁻²) at `si` of the light of photograph `view`, one per lane."""
        k = dr.gather(mi.UInt32, self.index, view)
        ds, radiance = self.lights.sample(k, si)
        if self.falloff is not None:
            finite = dr.gather(mi.Bool, self.lights.finite, k)
            given = cone(ds.d, self.camera(view)[0], dr.gather(mi.Float, self.falloff, k))
            radiance *= dr.select(finite, given, 1)
        return ds, radiance

    @property
    def cast(self) -> bool:
        """May the photographs' own lights cast shadows that are seen?"""
        return not (self.colocated or self.dark)

    @property
    def harmonics(self) -> list[int]:
        """Which of the room's are not 0; none where there is no room."""
        return [] if self.room is None else np.flatnonzero(self.room.any(1)).tolist()

    def lighting(self, view):
        """`light` of photograph `view`, one per lane, as a function of surface interactions; None if `dark`."""
        return None if self.dark else lambda si: self.light(view, si)

    def around(self, scene, view):
        """What a surface reflects of the room if nothing is in the way, as such a function; None if there is none."""
        if not self.harmonics:
            return None
        return lambda si: shown(scene, self, si, view)

    def irradiance(self, point: np.ndarray) -> np.ndarray:
        """(N, 3) what lights bring to a point (3,), on a surface that faces them; a room, if they are dark, to any."""
        own = self.lights.irradiance(point)
        if self.dark and self.room is not None:
            own = own + math.pi * self.room[0] / math.sqrt(4 * math.pi)
        return own

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the selected photographs: their number, height and width [px]."""
        return len(self), self.size[1], self.size[0]

    @property
    def pixels(self) -> int:
        """Of all selected photographs together."""
        return math.prod(self.shape)

    def lanes_before(self, spp: int, first: int = 0):
        """The number of the first lane of these photographs, or of pixel `first` of theirs, if a pixel has `spp`."""
        return dr.opaque(mi.UInt32, (self.before * self.size[0] * self.size[1] + first) * spp % 2**32)

    def chunks(self, spp: int) -> Iterator[tuple[int, int]]:
        """Ranges (first, last + 1) of their pixels that make `LANES` rays at most, if a pixel has `spp`."""
        step = max(1, LANES // spp)
        return ((first, min(first + step, self.pixels)) for first in range(0, self.pixels, step))


def place_in(photographs: Photographs, pixel):
    """(photograph, column, row) of a pixel, counted through all of them."""
    width, height = photographs.size
    view, pixel = pixel // (width * height), pixel % (width * height)
    return view, mi.Float(pixel % width), mi.Float(pixel // width)


def pixel_rays(photographs: Photographs, spp: int, seed: int, pixels: tuple[int, int] | None = None):
    """`spp` stratified primary rays per pixel: (rays, photograph per lane). A pixel's samples are consecutive lanes.

    `pixels`: only this range of them. Each has the same rays whatever the range.
    """
    first, last = pixels or (0, photographs.pixels)
    local = dr.arange(mi.UInt32, (last - first) * spp)
    pixel = local // spp + dr.opaque(mi.UInt32, first)
    lane = local + photographs.lanes_before(spp, first)
    view, column, row = place_in(photographs, pixel)
    jitter_x = mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed))
    jitter_y = mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed) ^ 0x5BD1E995)
    columns = int(np.sqrt(spp))
    while spp % columns:
        columns -= 1
    stratum = local % spp
    x = column + (mi.Float(stratum % columns) + jitter_x) / columns
    y = row + (mi.Float(stratum // columns) + jitter_y) / (spp // columns)
    return mi.Ray3f(*camera_ray(*photographs.camera(view), mi.Point2f(x, y))), view


def center_rays(photographs: Photographs, pixels: tuple[int, int] | None = None):
    """One ray through the centre of every pixel, or of this range of them: (rays, photograph per lane)."""
    first, last = pixels or (0, photographs.pixels)
    pixel = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
    view, column, row = place_in(photographs, pixel)
    return mi.Ray3f(*camera_ray(*photographs.camera(view), mi.Point2f(column + 0.5, row + 0.5))), view
