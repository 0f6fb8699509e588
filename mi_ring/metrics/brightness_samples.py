"""Samples the brightness of an object's surface in the photographs of a capture, with the light that it gets there.

The surface is the visual hull. Its places are nearly right, its normals are rough.
"""

from dataclasses import dataclass, field

import numpy as np
import trimesh
from scipy import ndimage

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.geometry.hull import evenly_spaced
from mi_ring.scene.lights import shared_emitters
from mi_ring.scene.visibility import MaskedCamera, Visibility

POINTS, MOST = 600, 40  #: number of points of the surface, and of photographs
RESOLUTION = 64  #: cells of the hull's surface along its longest side
WINDOWS = 60  #: brightness is averaged over squares; about so many are side by side on the object
BESIDE = 60.0  #: largest angle between light and camera, seen from the object [deg]: shadows then are few
CLIPPED = 0.98  #: brightness that counts as clipped


@dataclass
class BrightnessSamples:
    """Brightness of M points of a surface in K photographs: arrays (K, M), NaN where a point is not seen.

    Only photographs with a point light of their own near the camera are used.
    """

    brightness: np.ndarray  #: linear, 1 = full scale; mean of the colours around the point
    #: Irradiance of a surface that faces the light, relative to that at the object's centre in the median photograph.
    irradiance: np.ndarray
    cosine: np.ndarray  #: between the rough normal and the direction to the light
    #: (K, M, 5): logarithm of the cosine from the camera's axis, as the light sees the point; left, up, also seen from
    #: the light; left and up of the normal, divided by the distance [radii] and the cosine. What a cone, a tilt and an
    #: offset of the flash change.
    place: np.ndarray
    clipped: np.ndarray  #: bool: is there a clipped pixel around the point?
    falloff: np.ndarray  #: (K,) irradiance at the object's centre by a light of strength 1, in any unit


@dataclass
class BrightnessSampler:
    """Collects `BrightnessSamples`, one photograph after the other.

    `points`, `normals` (M, 3): of the surface. `radius`: of the normalising sphere [scene units].
    """

    capture: Capture
    radius: float
    chosen: list[int]  #: indices of the photographs to use
    points: np.ndarray
    normals: np.ndarray
    visibility: Visibility
    rows: dict[int, np.ndarray] = field(default_factory=dict)  #: (9, M) by photograph

    @classmethod
    def of(cls, capture: Capture, center: np.ndarray, radius: float) -> "BrightnessSampler | None":
        """Choose the photographs and the points to use. Returns None where brightness has other known causes.

        These are an environment, a room or lamps in the scene file, and photographs of a room beside those with a
        flash. It is also None for lights that are distant or far from the camera, and without a hull. `center` (3,):
        of the normalising sphere [scene units].
        """
        photographs = capture.photographs
        known = photographs.mixed or photographs.room_rows or shared_emitters(capture.scene, rooms=True)
        if known or not (capture.hull and capture.whole):
            return None
        toward = photographs.lights.toward(center)
        cameras = np.stack([shot.camera.position for shot in capture.shots]) - center
        lengths = np.linalg.norm(toward, axis=1) * np.linalg.norm(cameras, axis=1)
        near = (toward * cameras).sum(1) > np.cos(np.radians(BESIDE)) * lengths
        usable = np.flatnonzero(near & photographs.lit & photographs.in_room & photographs.lights.is_finite())
        if not len(usable):
            return None
        try:
            mesh = capture.hull.surface(RESOLUTION)
        except InputError:  # the hull is empty, which another finding says
            return None
        chosen = [int(usable[i]) for i in evenly_spaced(len(usable), MOST)]
        return cls(capture, radius, chosen, *surface_points(mesh, POINTS), Visibility(mesh.vertices, mesh.faces, []))

    def add(self, k: int, scale: int, rgb: np.ndarray, clipped: np.ndarray, mask: np.ndarray) -> None:
        """Take the samples of photograph `k`, if it is one to use.

        `rgb` (H, W, 3): linear, reduced by the factor `scale`. `clipped` (H, W): bool. `mask` (H, W): 0 to 1.
        """
        if k not in self.chosen:
            return
        shot, light = self.capture.shots[k], self.capture.photographs.lights[k]
        camera = shot.camera.shrunk(scale)
        side = 2 * max(1, round(np.sqrt((mask > 0.5).sum()) / WINDOWS)) + 1
        image = ndimage.uniform_filter(rgb.mean(-1), side)
        inside = ndimage.minimum_filter(mask, 2 * side - 1) > 0.99
        over = ndimage.maximum_filter(clipped.astype(np.uint8), side) > 0
        seen = np.flatnonzero(self.visibility.seen_by(MaskedCamera(camera, None), self.points, self.normals))
        column, row = camera.project(self.points[seen])[0].astype(int).T
        shown = inside[row, column]
        seen, column, row = seen[shown], column[shown], row[shown]
        toward = light.vector - self.points[seen]
        distance = np.linalg.norm(toward, axis=1)
        toward /= distance[:, None]
        left, up, ahead = -toward @ camera.to_world[:3, 0], -toward @ camera.to_world[:3, 1], -toward @ camera.forward
        cosine, normals = (self.normals[seen] * toward).sum(1), self.normals[seen]
        ahead = np.maximum(ahead, 1e-3)
        beam = ahead**shot.falloff * np.exp(shot.tilt[0] * left + shot.tilt[1] * up)
        offset = normals @ camera.to_world[:3, :2] * (self.radius / distance / np.maximum(cosine, 0.1))[:, None]
        values = np.full((9, POINTS), np.nan)
        values[:, seen] = [image[row, column], light.rgb.mean() / distance**2 * beam, cosine, over[row, column],
                           np.log(ahead), left, up, *offset.T]  # fmt: skip
        self.rows[k] = values

    def samples(self, center: np.ndarray) -> BrightnessSamples:
        """Return the samples of all photographs. `center` (3,): centre of the object [scene units]."""
        used, values = [*self.rows], np.stack([*self.rows.values()])
        photographs = self.capture.photographs
        usual = np.median(photographs.irradiance(center).mean(1)[self.chosen])
        falloff = 1 / photographs.lights.distances(center)[used] ** 2
        brightness, irradiance, cosine, clipped = (values[:, n] for n in range(4))
        over = (clipped > 0) | (brightness > CLIPPED)
        return BrightnessSamples(brightness, irradiance / usual, cosine, np.moveaxis(values[:, 4:], 1, -1), over,
                                 falloff)  # fmt: skip


def surface_points(mesh: trimesh.Trimesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose points of a mesh, evenly by area, with smooth unit normals. Returns two arrays (count, 3).

    The same mesh gives the same points.
    """
    across = mesh.face_normals * mesh.area_faces[:, None]
    total = np.cumsum(mesh.area_faces)
    faces = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
    at_vertices = np.zeros((len(mesh.vertices), 3))
    for corner in range(3):
        np.add.at(at_vertices, mesh.faces[:, corner], across)
    at_vertices /= np.maximum(np.linalg.norm(at_vertices, axis=1, keepdims=True), 1e-30)
    normals = at_vertices[mesh.faces[faces]].sum(1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return mesh.vertices[mesh.faces[faces]].mean(1), normals
