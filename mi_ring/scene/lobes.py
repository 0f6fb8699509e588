"""Small lights of a room, such as windows, lamps and the sun: lobes, each a von Mises–Fisher distribution."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mi_ring.scene.lights import is_room

LEAST_SHARPNESS, LARGEST_SHARPNESS = 0.1, 1e5  #: what float32 renders
MOST_LOBES = 32  #: in a room


def solid_angle(sharpness: np.ndarray) -> np.ndarray:
    """Compute the integral [sr] of exp(κ (cos θ − 1)) over all directions. `sharpness`: κ, of any shape."""
    return -2 * np.pi * np.expm1(-2 * sharpness) / sharpness


@dataclass(frozen=True)
class Lobes:
    """n lobes of the light of a room. The radiance of each is a constant times exp(κ (cos θ − 1)) about its direction.

    The flux of a lobe is the integral of its radiance over all directions: the irradiance of a surface that faces it,
    if the lobe is sharp.
    """

    toward: np.ndarray  #: (n, 3) unit vectors from the object toward the light
    sharpness: np.ndarray  #: (n,) κ
    flux: np.ndarray  #: (n, 3) R, G, B [W/m²]
    in_camera: np.ndarray  #: (n,) bool: is the direction in the axes of the camera? Else it is in those of the world

    @classmethod
    def of(cls, values: np.ndarray, in_camera: bool = False) -> "Lobes":
        """Make lobes of the numbers of a `room` emitter: x, y, z, sharpness, and R, G, B of the radiance at the centre.

        `values` (n, 7). `in_camera`: the directions are in the axes of the camera.
        """
        toward = values[:, :3] / np.linalg.norm(values[:, :3], axis=1, keepdims=True)
        flux = values[:, 4:] * solid_angle(values[:, 3])[:, None]
        return cls(toward, values[:, 3], flux, np.full(len(values), in_camera))

    @classmethod
    def together(cls, parts: Sequence["Lobes"]) -> "Lobes | None":
        """Join lobes. Returns None if there are none."""
        parts = [part for part in parts if len(part)]
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts)))) if parts else None

    def __len__(self) -> int:
        return len(self.sharpness)

    def scaled(self, factor: float) -> "Lobes":
        """Return lobes that are `factor` times as bright."""
        return replace(self, flux=self.flux * factor)

    def selected(self, which: np.ndarray) -> "Lobes":
        """Return some of the lobes. `which`: an index or a mask of NumPy."""
        return Lobes(*(value[which] for value in vars(self).values()))

    def values(self) -> np.ndarray:
        """Return the numbers of a `room` emitter (n, 7). The axes are left out."""
        return np.column_stack([self.toward, self.sharpness, self.flux / solid_angle(self.sharpness)[:, None]])

    def mean_radiance(self) -> np.ndarray:
        """Return the mean radiance (3,) over all directions by all lobes together."""
        return self.flux.sum(0) / (4 * np.pi)

    def radiance(self, directions: np.ndarray, to_world: np.ndarray) -> np.ndarray:
        """Compute the radiance (m, 3) that comes from unit `directions` (m, 3) of the world.

        `to_world`: pose of the camera, for lobes in its axes.
        """
        toward = np.where(self.in_camera[:, None], self.toward @ to_world[:3, :3].T, self.toward)
        return np.exp(self.sharpness * (directions @ toward.T - 1)) @ self.values()[:, 4:]


def lobes_of(scene) -> Lobes | None:
    """Return the lobes of all `room` emitters of a scene; None if they have none."""
    rooms = [emitter for emitter in scene.emitters() if is_room(emitter)]
    numbers = [np.array(room.lobes, float).reshape(-1, 7) for room in rooms]
    return Lobes.together([Lobes.of(one, room.frame == "camera") for one, room in zip(numbers, rooms) if len(one)])
