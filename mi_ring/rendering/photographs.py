"""Cameras and lights of many photographs as Dr.Jit buffers, and the rays of their pixels."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.rendering.lobe_light import LobeLight
from mi_ring.rendering.photograph_lights import Lights, flash_falloff
from mi_ring.rendering.pinhole import Pinhole
from mi_ring.rendering.spherical_harmonics import BASIS, bsdfs_with_lobes, reflected_harmonics
from mi_ring.rendering.views import Views
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.lobes import Lobes
from mi_ring.scene.shot import Shot

LANES = 2**22  #: rays at once where memory must be bounded: about a gigabyte


@dataclass(frozen=True)
class Photographs:
    """Cameras and lights of all photographs of a scene, as Dr.Jit buffers, and which of the photographs to render.

    In methods, `view` (UInt32) is an index into the selected photographs, one for each lane.
    """

    views: Views  #: buffers of all photographs
    finite: object  #: Bool, one per photograph: is its light a point light? Else it is distant
    index: object  #: UInt32: the selected photographs in their order
    size: tuple[int, int]  #: (width, height) [px] of every selected photograph
    colocated: bool  #: is every light at its camera's centre? Then the camera sees no shadows
    lit: np.ndarray  #: (P,) bool, one per photograph: has it a light of its own? Others have one that is black
    in_room: np.ndarray  #: (P,) bool, one per photograph: does light reach it that lights all photographs?
    #: Light of the room, (BASIS, 3) in `mi_ring.rendering.spherical_harmonics`; None if there is none.
    room: np.ndarray | None = None
    lobes: LobeLight | None = None  #: small lights of the room; None if there are none
    before: int = 0  #: number of photographs before these that are rendered elsewhere: random numbers depend on it

    @classmethod
    def of(cls, shots: Sequence[Shot], room: np.ndarray | None = None, lobes: Lobes | None = None) -> "Photographs":
        """Collect cameras and lights of photographs. All are selected. `room` (BASIS, 3): room light; None: none.

        `lobes`: small lights of the room.

        `size` becomes that of the first photograph. If photographs have several sizes, select those of one size before
        rendering. Raises SceneError if a light is invalid.
        """
        lights = Lights.of(shots)
        views = Views.of(shots, lights.positions(), lights.rgb())
        eyes = views.cameras[:, :, 3]
        # Equal but for the rounding of float32.
        off = np.abs(views.places - eyes).max(1) > 1e-6 * np.abs(eyes).max()
        lit = lights.rgb().any(1)
        apart = (off | ~lights.is_finite())[lit if lit.any() else slice(None)]
        return cls(
            views.buffers(), lights.finite, dr.arange(mi.UInt32, len(shots)), shots[0].size, not apart.any(), lit,
            np.array([shot.in_room for shot in shots]), room, LobeLight.of(lobes),
        )  # fmt: skip

    @classmethod
    def attached(cls, sensor) -> "Photographs":
        """Make the buffers of one `photograph` sensor. They carry gradients of the parameters of sensor and light.

        All light of the scene reaches it, as in Mitsuba, also if a fit subtracts a part of it.
        """
        m = sensor.to_world.matrix
        light = Lights.attached(sensor.light)
        views = Views(
            dr.concat([mi.Float(m[i, j]) for i in range(3) for j in range(4)]),
            dr.concat([*sensor.focal, *sensor.centre]), light.places, light.strengths, dr.concat([*sensor.cone]),
            mi.Float(sensor.distortion),
        )  # fmt: skip
        return replace(cls.of([sensor.shot]), views=views, in_room=np.array([True]))

    def select(self, index: Sequence[int] | np.ndarray, size: tuple[int, int], scale: int = 1) -> "Photographs":
        """Return a copy with another selection of photographs, and another size of the pictures.

        `index`: indices of the photographs to select, which all have `size` (width, height) [px]. `scale`: whole number
        by which width and height are divided.
        """
        width, height = size
        views = self.views._replace(intrinsics=self.views.intrinsics / dr.opaque(mi.Float, scale))
        return replace(self, views=views, index=to_flat(mi.UInt32, index), size=(width // scale, height // scale))

    def with_views(self, views: Views) -> "Photographs":
        """Return a copy with other cameras and lights. `views`: Dr.Jit buffers for all photographs.

        In the copy, lights count as apart from their cameras (`colocated` is False), so that renderers compute shadows.
        """
        return replace(self, views=views, colocated=False)

    @property
    def lights(self) -> Lights:
        """The lights of all photographs."""
        return Lights(self.views.places, self.finite, self.views.strengths)

    def in_units(self, unit: float) -> "Photographs":
        """Return a copy in which all lengths have another unit. Intensities are changed so that pictures stay the same.

        `unit`: the new unit [scene units].
        """
        if unit == 1:
            return self
        views = self.views
        length = dr.select(dr.arange(mi.UInt32, dr.width(views.cameras)) % 4 == 3, 1 / unit, 1)
        near = dr.gather(mi.Bool, self.finite, dr.arange(mi.UInt32, 3 * dr.width(self.finite)) // 3)
        scale = dr.select(near, 1 / unit, 1)
        places, strengths = views.places * scale, views.strengths * scale * scale  # scale² may be inf
        return replace(self, views=views._replace(cameras=views.cameras * length, places=places, strengths=strengths))

    def __len__(self) -> int:
        return dr.width(self.index)

    def camera(self, view) -> Pinhole:
        """Return the cameras of the photographs `view`, one for each lane."""
        k = dr.gather(mi.UInt32, self.index, view)
        rows = [dr.gather(mi.Vector4f, self.views.cameras, 3 * k + row) for row in range(3)]
        f = dr.gather(mi.Vector4f, self.views.intrinsics, k)
        to_world = mi.Matrix4f(*[list(row) for row in rows], [0, 0, 0, 1])
        distortion = None if self.views.distortion is None else dr.gather(mi.Float, self.views.distortion, k)
        return Pinhole(to_world, mi.Point2f(f.x, f.y), mi.Point2f(f.z, f.w), distortion)

    def eye(self, view):
        """Return (position of the camera of photograph `view`, True), for each lane."""
        return mi.Vector3f(self.camera(view).position), mi.Bool(True)

    def source(self, view):
        """Return where the light of photograph `view` is: (position, True), or (direction toward it, False).

        The second is for directional lights.
        """
        return self.lights.eye(dr.gather(mi.UInt32, self.index, view))

    def light(self, view, si):
        """Compute the light of photograph `view` that arrives at the interactions `si` if nothing is in its way.

        Returns (DirectionSample3f toward the light, irradiance (Color3f) of a surface that faces the light).
        """
        k = dr.gather(mi.UInt32, self.index, view)
        ds, radiance = self.lights.sample(k, si)
        if self.views.cone is not None:
            finite = dr.gather(mi.Bool, self.finite, k)
            share = flash_falloff(ds.d, self.camera(view).to_world, dr.gather(mi.Vector3f, self.views.cone, k))
            radiance *= dr.select(finite, share, 1)
        return ds, radiance

    @property
    def dark(self) -> bool:
        """True if no photograph has a light of its own."""
        return not self.lit.any()

    @property
    def mixed(self) -> bool:
        """True if some photographs have a light of their own, and others do not."""
        return bool(self.lit.any() and not self.lit.all())

    @property
    def mainly(self) -> np.ndarray:
        """Indices of the photographs that have a light of their own; of all photographs if none has."""
        return np.flatnonzero(self.lit | self.dark)

    @property
    def casts_shadows(self) -> bool:
        """True if the photographs' own lights cast shadows that cameras can see.

        False if all lights are at their cameras, or if all are black.
        """
        return not (self.colocated or self.dark)

    @property
    def room_rows(self) -> list[int]:
        """Indices of the rows of `room_strengths` that are not 0, and of all lobes."""
        used = [] if self.room is None else np.flatnonzero(self.room.any(1)).tolist()
        return used + [BASIS + j for j in range(len(self.lobes or ()))]

    @property
    def room_strengths(self) -> np.ndarray:
        """Room light (BASIS + L, 3): the coefficients of spherical harmonics, then the fluxes of L lobes."""
        room = np.zeros((BASIS, 3)) if self.room is None else self.room
        return room if self.lobes is None else np.concatenate([room, self.lobes.flux])

    def lighting(self, view):
        """Return a function of surface interactions that computes the own light of photograph `view` there.

        The function returns (DirectionSample3f toward the light, irradiance (Color3f) of a surface that faces the
        light). Returns None instead of a function if all lights are black.
        """
        return None if self.dark else lambda si: self.light(view, si)

    def shared(self, view):
        """Return a factor (Float) of the light that lights all photographs: 0 in those that it does not reach, else 1.

        `view`: photograph of each lane. Returns None if it reaches all photographs.
        """
        if self.in_room.all():
            return None
        return dr.gather(mi.Float, to_flat(mi.Float, self.in_room), dr.gather(mi.UInt32, self.index, view))

    def room_radiance(self, scene, view):
        """Return a function that computes the room light (Color3f) that surface interactions reflect to the viewer.

        Its arguments are the interactions, and a function that returns random points. It assumes that nothing blocks
        the harmonics of the room light; lobes cast shadows. Its result carries gradients. Returns None if there is no
        room light. `view`: photograph of each lane, for room light that is fixed to the camera.
        """
        which = self.room_rows
        if not which:
            return None

        def radiance(si, random):
            buffer = to_flat(mi.Float, self.room_strengths[which])
            bsdfs, pose = bsdfs_with_lobes(scene), self.camera(view).to_world
            smooth = [k for k in which if k < BASIS]
            values = reflected_harmonics(bsdfs, si, pose, smooth) if smooth else []
            if self.lobes is not None:
                values += self.lobes.reflected(scene, bsdfs, si, pose, random, si.is_valid())
            return sum((value * dr.gather(mi.Color3f, buffer, n) for n, value in enumerate(values)), mi.Color3f(0))

        return radiance

    def irradiance(self, point: np.ndarray) -> np.ndarray:
        """Compute the RGB irradiance (N, 3) by each photograph's light at `point` (3,), on a surface that faces it.

        For a photograph without a light of its own, it is the mean irradiance by the room light.
        """
        own = self.lights.irradiance(point)
        if self.room is not None:
            own[~self.lit] += math.pi * self.room[0] / math.sqrt(4 * math.pi)
        if self.lobes is not None:
            own[~self.lit] += self.lobes.flux.sum(0) / 4
        return own

    @property
    def shape(self) -> tuple[int, int, int]:
        """(number of selected photographs, height [px], width [px])."""
        return len(self), self.size[1], self.size[0]

    @property
    def pixels(self) -> int:
        """Total number of pixels of all selected photographs."""
        return math.prod(self.shape)

    def first_lane(self, spp: int, first: int = 0):
        """Return the number of the first ray of a pixel, for random numbers. It counts the rays of all photographs.

        `spp`: rays per pixel. `first`: number of the pixel, counted through the selected photographs. Photographs that
        are rendered elsewhere before these are counted, too, so that random numbers do not depend on who renders them.
        """
        return dr.opaque(mi.UInt32, (self.before * self.size[0] * self.size[1] + first) * spp % 2**32)

    def chunks(self, spp: int) -> Iterator[tuple[int, int]]:
        """Split all pixels into ranges of at most `LANES` rays, so that memory is bounded. Yields (first, last + 1).

        `spp`: rays per pixel. Pixels are numbered through all selected photographs.
        """
        step = max(1, LANES // spp)
        return ((first, min(first + step, self.pixels)) for first in range(0, self.pixels, step))


def pixel_position(photographs: Photographs, pixel):
    """Return (photograph, column, row) of pixels. `pixel` (UInt32): numbers through all selected photographs."""
    width, height = photographs.size
    view, pixel = pixel // (width * height), pixel % (width * height)
    return view, mi.Float(pixel % width), mi.Float(pixel // width)


def pixel_rays(photographs: Photographs, spp: int, seed: int, pixels: tuple[int, int] | None = None):
    """Make `spp` stratified random camera rays per pixel. Returns (Ray3f, index of the photograph of each ray).

    Consecutive rays belong to the same pixel. `pixels`: range of pixels (first, last + 1), numbered through all
    selected photographs; None: all. The rays of a pixel do not depend on the range.
    """
    first, last = pixels or (0, photographs.pixels)
    local = dr.arange(mi.UInt32, (last - first) * spp)
    pixel = local // spp + dr.opaque(mi.UInt32, first)
    lane = local + photographs.first_lane(spp, first)
    view, column, row = pixel_position(photographs, pixel)
    jitter_x = mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed))
    jitter_y = mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed) ^ 0x5BD1E995)
    columns = int(np.sqrt(spp))
    while spp % columns:
        columns -= 1
    stratum = local % spp
    x = column + (mi.Float(stratum % columns) + jitter_x) / columns
    y = row + (mi.Float(stratum // columns) + jitter_y) / (spp // columns)
    return mi.Ray3f(*photographs.camera(view).ray(mi.Point2f(x, y))), view


def center_rays(photographs: Photographs, pixels: tuple[int, int] | None = None):
    """Make one camera ray through each pixel centre. Returns (Ray3f, index of the photograph of each ray).

    `pixels`: range of pixels (first, last + 1), numbered through all selected photographs; None: all.
    """
    first, last = pixels or (0, photographs.pixels)
    pixel = dr.arange(mi.UInt32, last - first) + dr.opaque(mi.UInt32, first)
    view, column, row = pixel_position(photographs, pixel)
    return mi.Ray3f(*photographs.camera(view).ray(mi.Point2f(column + 0.5, row + 0.5))), view
