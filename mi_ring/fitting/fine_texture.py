"""A texture: colours as fine as the photographs, which may be larger than the fit has seen them.

After a fit, surface, light and material are known. The ratio of a photograph to its prediction, without highlights, is
what the fitted colours lack. Each point of the surface gets the mean ratio of the photographs that show it, as in the
texture mapping of photogrammetry. Shading is divided out, so the colours stay free of light. Coarse differences are
left out: they are errors of light or shape. Photographs that disagree with the others, as with a wrong pose, weigh
less: what they have added is taken out again.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
import trimesh

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import read_photograph
from mi_ring.capture.observation import Observation, observed
from mi_ring.capture.reduction import HIGHEST, reduced_image, windowed
from mi_ring.fitting.surface_ratios import PatchRatios, Points, Ratios, bilinear
from mi_ring.geometry.camera import pixels_per_unit
from mi_ring.geometry.hull import evenly_spaced
from mi_ring.geometry.meshes import area_of
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.rendering import prediction
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.shot import Shot, Window
from mi_ring.scene.visibility import MaskedCamera, Visibility
from mi_ring.scene.xml_elements import with_fine_attribute
from mi_ring.system.machine import pipelined, release_memory
from mi_ring.system.progress import progress

WIDEST = 2048  #: to which photographs are reduced for the texture [px]
PREDICTED = 1024  #: largest width of a prediction, unless the fit is finer [px]
CELL = 1.2  #: side of the cubes of the texture [px]
COARSE = 8.0  #: differences that are coarser than this are left out [px of the fit]
MOST_POINTS, MOST_PHOTOGRAPHS = 8_000_000, 80
DARK, GLOSSY = 0.03, 0.5  #: least prediction [median of the object], and largest share of highlights in it
LARGEST = 1.5  #: largest change of a colour, as a logarithm
AT_ONCE = 2**19  #: points that are compared at once: all of them would take too much memory
SQUARE = np.ones((3, 3), np.uint8)  #: a pixel and its neighbours
SLANT = 4  #: exponent of the cosine of the view in the weight of a photograph


def chosen_photographs(before: Capture, fitted: Sequence[int] | np.ndarray) -> list[int]:
    """Choose photographs for the texture: at most `MOST_PHOTOGRAPHS`, evenly among those of `fitted`.

    Those without a light of their own are left out if there are others: their light is known less well.
    """
    found = np.intersect1d(fitted, before.photographs.mainly).tolist()
    return [found[place] for place in evenly_spaced(len(found), MOST_PHOTOGRAPHS)]


def texture_width(before: Capture, index: Sequence[int]) -> int:
    """Choose the largest width of photographs for the texture [px]; higher ones are narrower. Returns 0 for none.

    `before`: the capture of the fit, which may be reduced. `index`: the result of `chosen_photographs`.
    """
    shots = [before.shots[k] for k in index]
    sizes = [shot.window.extent if shot.window else shot.size for shot in shots]
    return min(WIDEST, max((max(width, math.ceil(height / HIGHEST)) for width, height in sizes), default=0))


def texture_seconds(before: Capture, fitted: Sequence[int] | np.ndarray) -> float:
    """Estimate how long `sharpened` takes [s] on two cores, if it reads no photograph twice.

    The arguments are those of `chosen_photographs`.
    """
    return sum(0.5 + 4e-8 * math.prod(before.shots[k].whole.size) for k in chosen_photographs(before, fitted))


def at_width(given: Shot, refined: Shot, width: int) -> tuple[Shot, Shot]:
    """Return a photograph of the fit at another width: (with the given calibration, with the refined one).

    Both show what the photograph of the fit shows. `width`: the largest width [px].
    """
    window = given.window or Window((0, 0), given.size, given.size, given.size)
    window = windowed(window.whole, window.corner, window.extent, width)
    return given.whole.through(window), refined.whole.through(window)


def enlarged(given: Capture, before: Capture, k: int, own: Shot, shot: Shot) -> Observation:
    """Read photograph `k` at another width, decoded with the refined response of the camera.

    Its mask and its valid pixels are those of the fit, enlarged. `given`, `before`: the capture before and after it was
    reduced for the fit. `own`, `shot`: as `at_width` returns them. Raises InputError if a file cannot be read.
    """
    assert own.window
    size = own.window.size
    from_file = partial(read_photograph, own.whole, before.path)
    read = (given.shots[k].window is None and given.images.readers[k]) or from_file
    image = reduced_image(shot.whole, read, own.window)
    mask, valid = (None if part is None else cv2.resize(part, size) for part in (before.masks[k], before.valid[k]))
    return observed(shot, image, mask, valid, 1)


class Expected(NamedTuple):
    """What is expected in a photograph, and where in it the vertices are."""

    diffuse: np.ndarray  #: (h, w, 4) the picture without highlights, and which pixels are usable
    highlights: np.ndarray  #: (h, w, 3) the picture's highlights
    pixels: np.ndarray  #: (V, 2) places of the vertices in the picture [px]
    visible: np.ndarray  #: (V,) which vertices are seen


class Predictor:
    """Predicts photographs of a fitted object, with and without highlights.

    `surface`: shows the object `ring`, in the light of the fit. `refined`: the capture after calibration by the fit.
    """

    def __init__(self, surface: Surface, ring: FittedObject, refined: Capture) -> None:
        self.surface, self.ring, self.refined = surface, ring, refined
        self.s, self.faces = ring.domain.sample(ring.subdivisions)
        with torch.no_grad():
            self.vertices = ring.surface(self.s.to(ring.center.device)).cpu().numpy()
        self.normals = trimesh.Trimesh(self.vertices, self.faces, process=False).vertex_normals
        self.visibility = Visibility(self.vertices, self.faces, [])

    def of(self, shot: Shot) -> Expected:
        """Predict a photograph.

        A pixel is usable if it and its neighbours show only the object, are lit, and have no strong highlight.
        """
        photographs = Photographs.of([shot], self.refined.room, self.refined.lobes)

        def drawn() -> tuple[np.ndarray, np.ndarray]:
            rgb, coverage = prediction.draw(self.surface, photographs, 1, shadows=self.refined.shadows,
                                            indirect=self.ring.indirect)  # fmt: skip
            return rgb[0].numpy(), coverage[0].numpy()

        full, coverage = drawn()
        with prediction.without_gloss(self.surface):
            diffuse, _ = drawn()
        inside = eroded(coverage > 0.99)
        lit = diffuse[inside][diffuse[inside] > 0]
        least = DARK * np.median(lit) if len(lit) else 0.0
        usable = inside & ((diffuse > least) & (full - diffuse <= GLOSSY * full)).all(-1)
        visible = self.visibility.seen_by(MaskedCamera(shot.camera, None), self.vertices, self.normals)
        pixels, _ = shot.camera.project(self.vertices)
        return Expected(np.dstack([diffuse, eroded(usable)]).astype(np.float32), full - diffuse, pixels, visible)


def eroded(mask: np.ndarray) -> np.ndarray:
    """Return a mask (H, W) bool without the pixels that have a neighbour outside it."""
    return cv2.erode(mask.astype(np.uint8), SQUARE, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def with_usable_pixels(seen: Observation) -> np.ndarray:
    """Return a photograph as (h, w, 4) float32: linear R, G, B, and 1 where a pixel is usable, otherwise 0.

    A pixel is usable if all pixels up to two pixels away show only the object, and none is clipped.
    """
    usable = seen.surely(torch.ones(1)).numpy()[0] & ~seen.clipped[0].numpy().any(-1)
    return cv2.merge([*cv2.split(seen.rgb[0].numpy()), eroded(eroded(usable)).astype(np.float32)])


def ratios_of(expected: Expected, photograph: np.ndarray, points: Points, triangles: np.ndarray, pixels: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Compare a photograph with its prediction. Returns (logarithms of ratios (f, n, 3), which are usable (f, n)).

    A ratio is usable if the pixels of photograph and prediction are. `photograph`: result of `with_usable_pixels`.
    `pixels` (V, 2): the vertices in it. `points`: n points in each triangle. `triangles` (f,): those to compare.
    """

    def at_points(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
        at = points.at(places, triangles)
        return bilinear(picture, at.reshape(-1, 2)).reshape(*at.shape[:2], picture.shape[-1])

    shown, diffuse = at_points(photograph, pixels), at_points(expected.diffuse, expected.pixels)
    highlights = at_points(expected.highlights, expected.pixels)
    ratio = (shown[..., :3] - highlights) / np.maximum(diffuse[..., :3], 1e-9)
    certain = np.minimum(shown[..., 3], diffuse[..., 3]) > 0.999
    return np.log(ratio.clip(math.exp(-LARGEST), math.exp(LARGEST))), certain


@torch.no_grad()
def sharpened(
    given: Capture, before: Capture, refined: Capture, surface: Surface, ring: FittedObject,
    fitted: Sequence[int] | np.ndarray, width: int,
) -> FittedObject:  # fmt: skip
    """Return an object with the networks of `ring` and a texture from the photographs, or `ring` itself.

    It is `ring` if there are no photographs, if they show nothing that its colours lack, or if the material has no
    albedo. `given`: the capture before it was reduced for the fit. `before`, `refined`: that of the fit, before and
    after calibration. `surface`: shows the object `ring`, in the light of the fit. `fitted`: indices of the photographs
    to use. `width`: of the photographs in the last stage of the fit [px]. Raises InputError if a file cannot be read.
    """
    index = chosen_photographs(before, fitted)
    widest, albedo = texture_width(before, index), ring.brdf_net.albedo
    if not widest or not albedo:
        return ring
    predictor = Predictor(surface, ring, refined)
    vertices, normals, faces = predictor.vertices, predictor.normals, predictor.faces
    shots = {k: at_width(before.shots[k], refined.shots[k], widest) for k in index}
    resolution = pixels_per_unit([shot.camera for _, shot in shots.values()], ring.center.cpu().numpy())
    corners = torch.from_numpy(faces)
    area = area_of(torch.from_numpy(vertices), corners)
    scale = resolution * math.sqrt(area / area_of(predictor.s, corners))  # pixels for a length of 1 on the domain
    wanted = resolution * math.sqrt(area / len(faces))  # divisions of a triangle, for one point in each pixel
    divisions = max(1, min(math.ceil(wanted), math.isqrt(MOST_POINTS // len(faces))))
    ratios = Ratios(Points.of(faces, divisions))
    patches, trust = PatchRatios(ratios.points, predictor.s.numpy(), len(index)), np.ones(len(index))

    def predicted(k: int) -> Expected:
        release_memory()  # of the photograph before
        return predictor.of(at_width(before.shots[k], refined.shots[k], min(widest, max(width, PREDICTED)))[1])

    def compare(k: int, expected: Expected) -> None:
        camera = shots[k][1].camera
        away = camera.position - vertices
        distance = np.linalg.norm(away, axis=1)
        weights = ((normals * away).sum(1) / distance).clip(0, 1) ** SLANT
        weights *= (camera.focal.mean() / resolution / distance) ** 2
        triangles = np.flatnonzero(expected.visible[faces].all(1))
        photograph, (pixels, _) = with_usable_pixels(enlarged(given, before, k, *shots[k])), camera.project(vertices)
        number, parts = index.index(k), 1 + len(triangles) * len(ratios.points.shares) // AT_ONCE
        again = trust[number] < 1
        factor = trust[number] - again  # negative the second time: what was too much is taken out
        for part in np.array_split(triangles, parts):
            logarithms, usable = ratios_of(expected, photograph, ratios.points, part, pixels)
            weight = usable * ratios.points.at(weights[:, None], part)[..., 0]
            ratios.add(number % 2, part, logarithms, weight * factor)
            if not again:
                patches.add(number, part, logarithms, weight)

    for _ in progress(pipelined(predicted, compare, index), "texture", len(index)):
        pass
    trust = patches.trust()
    doubtful = [k for k, share in zip(index, trust) if share < 1]
    for _ in progress(pipelined(predicted, compare, doubtful), "texture: photographs that disagree", len(doubtful)):
        pass
    own = [at_width(before.shots[k], refined.shots[k], min(width, widest))[1].camera for k in index]
    coarser = resolution / pixels_per_unit(own, ring.center.cpu().numpy())
    coarse, fine = COARSE * max(1.0, coarser), CELL * max(1.0, wanted / divisions)  # in pixels
    grid = ratios.texture(predictor.s, coarse / scale, fine / scale)
    if grid is None:
        return ring
    bsdf = with_fine_attribute(ring.bsdf, albedo.attribute)
    return FittedObject(
        ring.center, float(ring.radius), domain=ring.domain, bsdf=bsdf, indirect=ring.indirect, up=ring.up,
        subdivisions=ring.subdivisions, ground=ring.ground, metres=ring.metres,
        networks=(ring.shape_net, SharpenedMaterial.of(ring.brdf_net, grid)),
    ).to(ring.center.device)  # fmt: skip
