"""Colours finer than the photographs of the fit, from the photographs at their own size.

After a fit, surface, light and material are known. The photographs may be larger than the fit has seen them. The ratio
of such a photograph to its prediction, without highlights, is what the fitted colours lack. Each point of the surface
gets the mean ratio of the photographs that show it, as in the texture mapping of photogrammetry. Shading is divided
out, so the colours stay free of light. Coarse differences are left out: they are errors of light or shape.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
import trimesh
from scipy import ndimage

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import read_photograph
from mi_ring.capture.observation import Observation, observed
from mi_ring.capture.reduction import reduced_image, windowed
from mi_ring.geometry.meshes import area_vectors
from mi_ring.objects.detail import Grid
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import SPECULAR
from mi_ring.objects.sharpened_material import SharpenedMaterial, albedo_of
from mi_ring.rendering import prediction
from mi_ring.rendering.bridge import to_drjit
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.shot import Shot, Window
from mi_ring.scene.visibility import MaskedCamera, Visibility
from mi_ring.system.progress import progress

WIDEST = 1024  #: to which photographs are reduced for the texture [px]
WORTH = 1.3  #: the photographs must be wider than those of the fit by this factor
CELL, SOLVING = 1.0, 4  #: side of the cubes of the texture [px]; steps to find the values of their corners
COARSE = 8.0  #: differences that are coarser than this are left out [px of the fit]
MOST_POINTS = 2_000_000
DARK, GLOSSY = 0.03, 0.5  #: least prediction [median of the object], and largest share of highlights in it
LARGEST = 1.5  #: largest change of a colour, as a logarithm
SQUARE = np.ones((3, 3))  #: a pixel and its neighbours
SLANT = 4  #: exponent of the cosine of the view in the weight of a photograph
CERTAIN = 0.05  #: least share of the ratios that halves of the photographs have in common


def texture_width(given: Capture, fitted: Sequence[int] | np.ndarray, width: int) -> int:
    """Choose the width to which photographs are reduced for the texture [px]. Returns 0 if it would not be finer.

    `given`: the capture of the fit, which may be reduced. `fitted`: indices of its photographs that are fitted.
    `width`: of the photographs in the last stage of the fit [px].
    """
    extents = [shot.window.extent[0] if shot.window else shot.size[0]
               for shot in (given.shots[k] for k in fitted) if shot.files.filename]  # fmt: skip
    widest = min(WIDEST, max(extents, default=0))
    return widest if widest >= WORTH * width else 0


def texture_seconds(given: Capture, fitted: Sequence[int] | np.ndarray, width: int) -> float:
    """Estimate how long `sharpened` takes [s] on two cores. The arguments are those of `texture_width`."""
    widest = texture_width(given, fitted, width)
    return len(fitted) * (0.3 + 1.1e-6 * widest**2) if widest else 0.0


def at_width(given: Shot, refined: Shot, width: int) -> tuple[Shot, Shot]:
    """Return a photograph of the fit at another width: (with the given calibration, with the refined one).

    Both show what the photograph of the fit shows. `width`: the largest width [px].
    """
    window = given.window or Window((0, 0), given.size, given.size, given.size)
    window = windowed(window.whole, window.corner, window.extent, width)
    return given.whole.through(window), refined.whole.through(window)


def enlarged(before: Capture, k: int, own: Shot, shot: Shot) -> Observation:
    """Read photograph `k` of the capture `before` at another width, decoded with the refined response of the camera.

    Its mask and its valid pixels are those of the fit, enlarged. `own`, `shot`: as `at_width` returns them. Raises
    InputError if the file cannot be read.
    """
    assert own.window
    size = own.window.size
    image = reduced_image(shot.whole, partial(read_photograph, own.whole, before.path), own.window)
    mask, valid = (None if part is None else cv2.resize(part, size) for part in (before.masks[k], before.valid[k]))
    return observed(shot, image, mask, valid, 1)


class Ratios:
    """Means of the logarithms of ratios at N points of the surface, from each half of the photographs.

    `number`: N.
    """

    def __init__(self, number: int) -> None:
        self.sums, self.weights = np.zeros((2, number, 3), np.float32), np.zeros((2, number), np.float32)

    def add(self, half: int, points: np.ndarray, logarithms: np.ndarray, weights: np.ndarray) -> None:
        """Add what a photograph shows. `points` (M,): indices. `logarithms` (M, 3). `weights` (M,)."""
        self.sums[half, points] += logarithms * weights[:, None]
        self.weights[half, points] += weights

    def means(self) -> np.ndarray:
        """Return the mean (2, N, 3) of each half; 0 without photographs."""
        return self.sums / np.maximum(self.weights, 1e-9)[..., None]


def ratio_picture(
    surface: Surface, ring: FittedObject, highlights: dict[str, torch.Tensor], refined: Capture, shot: Shot,
    seen: Observation,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Compare a photograph with its prediction. Returns (logarithms of ratios (H, W, 3), which are usable (H, W)).

    A pixel is usable if it and its neighbours show nothing but the object, lit, neither clipped nor in a highlight.

    `surface`: shows the object `ring`. `highlights`: the parameter of its highlights (V,) or (V, 3) by name, or {}.
    `refined`, `shot`, `seen`: capture, photograph and its pixels after the calibration by the fit.
    """
    pictures = []
    for factor in (0, 1):
        surface.write_arrays({f"vertex_{name}": to_drjit(factor * value) for name, value in highlights.items()})
        rgb, coverage = prediction.draw(surface, Photographs.of([shot], refined.room), 1, shadows=refined.shadows,
                                        indirect=ring.indirect)  # fmt: skip
        pictures.append(rgb[0].numpy())
    diffuse, full = pictures
    inside = ndimage.binary_erosion(seen.surely(coverage)[0].numpy(), SQUARE)
    lit = diffuse[inside][diffuse[inside] > 0]
    typical = float(np.median(lit)) if len(lit) else 1.0
    usable = inside & ~seen.clipped[0].numpy().any(-1)
    usable &= ((diffuse > DARK * typical) & (full - diffuse <= GLOSSY * full)).all(-1)
    ratio = np.maximum(seen.rgb[0].numpy() - (full - diffuse), 1e-3 * typical) / np.maximum(diffuse, 1e-3 * typical)
    return np.log(ratio).clip(-LARGEST, LARGEST), ndimage.binary_erosion(usable, SQUARE)


class Points(NamedTuple):
    """Points between the vertices of a mesh, at the centres of equal parts of its triangles."""

    corners: np.ndarray  #: (N, 3) vertices of the triangle
    shares: np.ndarray  #: (N, 3) barycentric coordinates

    @classmethod
    def of(cls, faces: np.ndarray, divisions: int) -> "Points":
        """Make 4^`divisions` points in each triangle of `faces` (F, 3)."""
        triangles = np.eye(3)[None]
        for _ in range(divisions):
            middles = (triangles + np.roll(triangles, -1, 1)) / 2
            corners = [np.stack([triangles[:, k], middles[:, k], middles[:, k - 1]], 1) for k in range(3)]
            triangles = np.concatenate([*corners, middles])
        centres = triangles.mean(1).astype(np.float32)
        return cls(np.repeat(faces, len(centres), 0), np.tile(centres, (len(faces), 1)))

    def at(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values (V, n) of the vertices: (N, n) float32."""
        return sum(self.shares[:, k, None] * values[self.corners[:, k]].astype(np.float32) for k in range(3))


def bilinear(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Interpolate a picture (H, W, C) at pixel coordinates (N, 2): (N, C) float32. All must be inside it."""
    rows = max(1, -(-len(pixels) // 4096))  # OpenCV takes no empty arrays
    maps = np.full((2, rows * 4096), 0.5, np.float32)
    maps[:, : len(pixels)] = pixels.T - 0.5
    across, down = maps.reshape(2, rows, 4096)
    found = cv2.remap(picture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(rows * 4096, -1)[: len(pixels)]


def mean_around(grid: Grid, s: torch.Tensor, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted means (nodes, C) of values (N, C) of points `s` (N, 3) around the corners of a grid.

    The grid has one octave. `weights` (N,).
    """
    (shares,) = grid.weights(s)
    return shares.T @ (values * weights[:, None]) / np.maximum(shares.T @ weights, 1e-12)[:, None]


def smoothed(grid: Grid, s: torch.Tensor, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return values (N, C) of points `s` (N, 3) as a grid of one octave represents them. `weights` (N,)."""
    return grid.weights(s)[0] @ mean_around(grid, s, values, weights)


@torch.no_grad()
def sharpened(
    before: Capture, refined: Capture, surface: Surface, ring: FittedObject, fitted: Sequence[int] | np.ndarray,
    width: int,
) -> FittedObject:  # fmt: skip
    """Return a copy of an object whose colours have a texture from larger photographs, or the object itself.

    It is the object itself if no photograph is larger than the fit has seen it, if they show nothing finer, or if the
    material has no albedo. `before`, `refined`: the capture before and after the calibration by the fit. `surface`:
    shows the object `ring`, in the light of the fit. `fitted`: indices of the photographs to use. `width`: of the
    photographs in the last stage of the fit [px]. Raises InputError if a file cannot be read.
    """
    widest = texture_width(before, fitted, width)
    if not widest or not albedo_of(ring.brdf_net):
        return ring
    s, faces = ring.domain.sample(ring.subdivisions)
    vertices, material = ring(s.to(ring.center.device))
    vertices = vertices.cpu().numpy()
    highlights = {name: material[name] for name in SPECULAR if name in material}
    shots = {k: at_width(before.shots[k], refined.shots[k], widest) for k in fitted if before.shots[k].files.filename}
    eyes = {k: shot.camera.position for k, (_, shot) in shots.items()}
    middle = ring.center.cpu().numpy()
    resolution = float(np.median([  # pixels of a photograph for a length of 1 in scene units
        shot.camera.focal.mean() / np.linalg.norm(eyes[k] - middle) for k, (_, shot) in shots.items()]))  # fmt: skip
    corners = torch.from_numpy(faces)
    areas = [float(area_vectors(torch.as_tensor(points), corners).norm(dim=1).sum()) / 2 for points in (s, vertices)]
    stretch = math.sqrt(areas[1] / areas[0])
    wanted = areas[1] * resolution**2 / len(faces)  # points in each triangle
    most = math.floor(math.log(max(1.0, MOST_POINTS / len(faces)), 4))
    points = Points.of(faces, min(most, max(0, math.ceil(math.log(wanted, 4)))))
    places, at = points.at(vertices), torch.from_numpy(points.at(s.numpy()))
    normals = points.at(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    visibility = Visibility(vertices, faces, [])
    ratios = Ratios(len(places))
    for number, (k, (own, shot)) in enumerate(progress(shots.items(), "fine texture", len(shots))):
        seen = enlarged(before, k, own, shot)
        logarithms, usable = ratio_picture(surface, ring, highlights, refined, shot, seen)
        view = MaskedCamera(shot.camera, usable.astype(np.uint8) * 255)
        visible = np.flatnonzero(visibility.seen_by(view, places, normals))
        pixels, _ = shot.camera.project(places[visible].astype(float))
        away = eyes[k] - places[visible]
        distance = np.linalg.norm(away, axis=1)
        cosine = ((normals[visible] * away).sum(1) / distance).clip(0, 1)
        weight = cosine**SLANT / (resolution * distance / shot.camera.focal.mean()) ** 2
        ratios.add(number % 2, visible, bilinear(logarithms.astype(np.float32), pixels), weight.astype(np.float32))
    values, weights = agreed(ratios, Grid.around(at, COARSE * widest / width / stretch / resolution, 1, 3), at)
    if values is None:
        return ring
    shown = weights > 0
    at, values, weights = at[shown], values[shown], weights[shown]
    grid = Grid.around(at, CELL / stretch / resolution, 1, 3)
    (shares,), nodes = grid.weights(at), np.zeros((len(grid.keys(0)), 3), np.float32)
    for _ in range(SOLVING):  # for values of the corners whose interpolation is `values`
        nodes += mean_around(grid, at, values - shares @ nodes, weights)
    grid.values[0].copy_(torch.from_numpy(nodes))
    grid.latest.clear()  # the weights take more memory than the values
    return FittedObject(
        ring.center, float(ring.radius), domain=ring.domain, bsdf=ring.bsdf, indirect=ring.indirect, up=ring.up,
        subdivisions=ring.subdivisions, ground=ring.ground, metres=ring.metres,
        networks=(ring.shape_net, SharpenedMaterial.of(ring.brdf_net, grid)),
    ).to(ring.center.device)  # fmt: skip


def agreed(ratios: Ratios, coarse: Grid, s: torch.Tensor) -> tuple[np.ndarray | None, np.ndarray]:
    """Return what both halves of the photographs say of fine colours: (logarithms (N, 3), weights (N,)).

    Coarse differences are subtracted. What remains is multiplied by the share of its variance, around each corner of
    the grid `coarse`, that the halves have in common: so noise is left out (Wiener's filter). `s` (N, 3): the points.
    The logarithms are None if the halves have hardly anything in common.
    """
    means, weights = ratios.means(), ratios.weights
    total = weights.sum(0)
    both = np.where((weights > 0).all(0), total, 0)
    for half in range(2):
        means[half] -= smoothed(coarse, s, means[half], weights[half])
    mean = (means * weights[..., None]).sum(0) / np.maximum(total, 1e-9)[:, None]
    common = smoothed(coarse, s, means.prod(0).mean(1, keepdims=True), both).clip(min=0)
    different = smoothed(coarse, s, np.square(means[0] - means[1]).mean(1, keepdims=True) / 4, both)
    if not both.any() or (both * common[:, 0]).sum() < CERTAIN * (both * (common + different)[:, 0]).sum():
        return None, total
    return mean * (common / np.maximum(common + different, 1e-12)), total
