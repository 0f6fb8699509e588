"""The lights of many photographs as Dr.Jit buffers, and the irradiance by each of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.errors import SceneError
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.lights import Light, position_of, strength_of
from mi_ring.scene.shot import Shot

MIN_FLASH_COSINE = 1e-3  #: the least cosine between the axis of a flash and a direction; smaller ones are clamped
DISTANT = 1e9  #: distance of a directional light [scene units]


@dataclass(frozen=True)
class Lights:
    """The own light of each of N photographs, as Dr.Jit buffers that may carry gradients."""

    places: object  #: Float, 3 per light: position [scene units], or unit direction toward a distant light
    finite: object  #: Bool: is it a point light? Else it is distant
    strengths: object  #: Float, 3 per light: intensity [W/sr], or irradiance [W/m²]

    @classmethod
    def of(cls, shots: Sequence[Shot]) -> "Lights":
        """Collect the own lights of photographs. One without a light gets a point light of intensity 1 at its camera.

        Raises SceneError if a light has infinite or negative values.
        """
        lights = [shot.own_light for shot in shots]
        finite = np.array([light.kind == "point" for light in lights])
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite then is refused
            places = np.stack([light.vector if light.kind == "point" else toward(light) for light in lights])
            places, strengths = places.astype(np.float32), np.stack([light.rgb for light in lights]).astype(np.float32)
        for shot, place, rgb in zip(shots, places, strengths):
            what = f'photograph "{shot.name}": its light is'
            if not (np.isfinite(rgb) & (rgb >= 0)).all():
                raise SceneError(f"{what} {rgb} strong, must be positive, or 0 for none")
            if not np.isfinite(place).all():
                raise SceneError(f"{what} at {place}, must be finite")
        return cls(to_flat(mi.Float, places), mi.Bool(finite), to_flat(mi.Float, strengths))

    @classmethod
    def attached(cls, emitter) -> "Lights":
        """Make the buffers of one Mitsuba emitter, point or directional. They carry gradients of its parameters."""
        place, finite = position_of(emitter)
        return cls(dr.concat(list(place)), mi.Bool(finite), dr.concat(list(strength_of(emitter))))

    def eye(self, k):
        """Return where lights are: (position, True), or (direction toward the light, False) for a directional light.

        `k` (UInt32): index of the light for each lane.
        """
        return dr.gather(mi.Vector3f, self.places, k), dr.gather(mi.Bool, self.finite, k)

    def sample(self, k, si):
        """Compute the light that arrives at the surface interactions `si` if nothing is in its way.

        `k` (UInt32): index of the light for each interaction. Returns (DirectionSample3f toward the light, irradiance
        (Color3f) of a surface that faces the light: intensity / distance² for a point light).
        """
        where, finite = self.eye(k)
        strength = dr.gather(mi.Color3f, self.strengths, k)
        ds = dr.zeros(mi.DirectionSample3f)
        to_light = dr.select(finite, where - si.p, where)
        distance2 = dr.squared_norm(to_light)
        ds.d = to_light * dr.rsqrt(distance2)
        ds.dist = dr.select(finite, dr.sqrt(distance2), DISTANT)
        ds.p = si.p + ds.d * ds.dist
        return ds, strength * dr.select(finite, dr.rcp(distance2), 1)

    def __len__(self) -> int:
        return dr.width(self.finite)

    def __getitem__(self, k: int) -> Light:
        place, rgb = self.positions()[k], self.rgb()[k]
        return Light("point", place, rgb) if self.is_finite()[k] else Light("directional", -place, rgb)

    def is_finite(self) -> np.ndarray:
        """Test which lights are point lights. Returns (N,) bool: True for point lights, False for distant lights."""
        return np.array(self.finite)

    def positions(self) -> np.ndarray:
        """Return the positions (N, 3) of the lights [scene units]; for distant lights, unit directions toward them."""
        return np.array(self.places).reshape(-1, 3).astype(float)

    def rgb(self) -> np.ndarray:
        """Return the RGB intensities (N, 3) of the lights [W/sr]; for distant lights, their irradiances [W/m²]."""
        return np.array(self.strengths).reshape(-1, 3).astype(float)

    def toward(self, point: np.ndarray) -> np.ndarray:
        """Return the vectors (N, 3) from `point` (3,) to the lights [scene units]; for distant lights, unit vectors."""
        places = self.positions()
        return np.where(self.is_finite()[:, None], places - point, places)

    def distances(self, point: np.ndarray) -> np.ndarray:
        """Return the distances (N,) from `point` (3,) to the lights [scene units]; infinite for distant lights."""
        return np.where(self.is_finite(), np.linalg.norm(self.toward(point), axis=1), np.inf)

    def irradiance(self, point: np.ndarray) -> np.ndarray:
        """Compute the RGB irradiance (N, 3) by each light at `point` (3,), on a surface that faces this light.

        For a point light, it is intensity / distance².
        """
        distance2 = np.where(self.is_finite(), np.maximum((self.toward(point) ** 2).sum(1), 1e-24), 1.0)
        return self.rgb() / distance2[:, None]


def flash_falloff(direction, to_world, cone):
    """Compute the factor of a flash's intensity in a direction: cosine ^ n · exp(a x + b y).

    x, y and the cosine are the components of the direction from the flash to the surface in the axes of the camera:
    left, up and forward. `direction`: unit vector from the surface to the flash. `to_world`: pose of the camera.
    `cone` (Vector3f): the exponent n, and the tilts a and b. All are 0 for a flash that is equal in all directions. A
    cone of exponent n whose axis is turned by a small angle has a tilt of about n times this angle.
    """
    x, y, cosine = (-dr.dot(direction, mi.Vector3f(to_world[0, k], to_world[1, k], to_world[2, k])) for k in range(3))
    return dr.power(dr.maximum(cosine, MIN_FLASH_COSINE), cone.x) * dr.exp(cone.y * x + cone.z * y)


def toward(light: Light) -> np.ndarray:
    """Return the unit direction (3,) toward a directional light, opposite to that in which the light travels."""
    length = np.linalg.norm(light.vector)
    # What Mitsuba has read is of unit length, but for the rounding of float32.
    return -light.vector if abs(length - 1) < 1e-6 else -light.vector / length
