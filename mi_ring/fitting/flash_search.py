"""Flash search: highlights tell where a flash that moves with the cameras is.

Matte shading tells it badly: a flash elsewhere, another response of the camera and another surface look alike. A mirror
image does not depend on the response, and it moves by half of what the flash moves. But a highlight that is predicted
in a wrong place does not pull the flash to the right one. So the search compares what the prediction lacks with narrow
highlights of a flash at many places.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.geometry.hull import evenly_spaced
from mi_ring.images import blur
from mi_ring.rendering import prediction
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.rendering.views import Views

MOST, WIDTH, SPP = 16, 96, 4  #: photographs that are compared, their largest width [px], and samples per pixel
FAR, STEP = 0.6, 0.15  #: places that are tried: largest distance from the lens, and steps [distance of the object]
FINER = 0.075, 0.0375  #: steps around the best of them
HIGHLIGHTS = {"diffuse": 0.0, "specular": 1.0, "coat": 0.0}  #: parameters of a material that show highlights alone
MATTE = {"specular": 0.0, "coat": 0.0}  #: and that show none
NARROW, WIDE = 0.15, 0.35  #: roughness of the highlights that are tried, and of one around which pixels are compared
NEAR = 0.2  #: least brightness of the wide one there, relative to its maximum: about 27° from it
COARSE = 0.1  #: standard deviation of the blur that is subtracted [square root of the number of pixels]
DIM = 0.3  #: radiance that is added before logarithms [exposure]: dark pixels count less
SHARE = 0.015  #: the flash is moved if highlights there explain at least this share of the squared error,
FACTOR = 1.2  #: so much more than those of the current flash, in each half of the photographs, too,
NEAREST = 0.1  #: and if it is so far away: gradients find nearer places [distance of the object]


class Part(NamedTuple):
    """Photographs of one size that are compared."""

    photographs: np.ndarray  #: (n,) their numbers
    scale: int  #: they are this many times smaller
    inside: Tensor  #: (n, H, W) bool: which pixels are compared
    predicted: Tensor  #: (n, H, W) predicted radiance, and `DIM` [exposure]
    lacking: Tensor  #: (n, H, W) logarithm of what it lacks
    weights: Tensor  #: (n, 1, 1) so that each photograph has the same squared error


class Subset(NamedTuple):
    """Pixels of some photographs, and what predictions lack there."""

    pixels: Tensor  #: (n,) their numbers among all
    matte: Tensor  #: (n, 2) what matte shading changes if the flash moves, orthonormal columns
    lacking: Tensor  #: (n,) without these changes


@torch.no_grad()
def find_flash(problem: Problem, model: Model, renderer: Renderer, level: int) -> Tensor | None:
    """Find the place of the flash by highlights. Returns the value (1, 3) of the unknown `light`.

    Returns None if highlights do not show another place, as with one photograph. Also if a flash that moves with the
    cameras is not the only light, if its place is not refined, and if the material is not that of `cooktorrance`.
    Renders the surface at a `level` of the mesh.
    """
    calibration, known = model.calibration, {p.name for p in model.ring.brdf_net.bsdf_parameters}
    if calibration is None or "light" not in calibration.unknowns or not calibration.flash_alone:
        return None
    if not {"diffuse", "specular", "roughness"} <= known:
        return None
    return FlashSearch(problem, model, renderer.show(model, level)).place()


class FlashSearch:
    """Photographs, and the highlights of a flash at other places.

    A place (2,) is to the left of the lens and up, in the axes of an upright camera [distance of the object].
    """

    def __init__(self, problem: Problem, model: Model, surface: Surface) -> None:
        """Render what is predicted now. `surface`: shows the model."""
        assert model.calibration is not None
        self.problem, self.surface, self.calibration = problem, surface, model.calibration
        self.shadows = problem.config.shadows and problem.capture.shadows
        rig, offset = self.calibration.rig, self.calibration.value("light")[0]
        self.given, self.ahead = (rig.upright / rig.distance)[:2], offset[2:]  #: place in the capture; offset ahead
        self.now = self.given + offset[:2]
        chosen = problem.fitted[evenly_spaced(len(problem.fitted), MOST)]
        parts = [self.compared(model, index) for index in problem.capture.together(chosen)]
        self.parts = [part for part in parts if part.inside.any()]
        self.subsets = self.with_halves() if self.parts else []  #: all pixels; those of each half of the photographs

    def compared(self, model: Model, index: np.ndarray) -> Part:
        """Compare photographs of one size with their predictions."""
        capture, calibration, unit = self.problem.capture, self.calibration, self.problem.exposure
        scale = -(-max(capture.shots[index[0]].size) // WIDTH)
        seen = capture.observe(index, scale)
        photographs = self.photographs(index, calibration(scale), scale)
        whole, coverage = prediction.draw(self.surface, photographs, SPP, shadows=self.shadows,
                                          indirect=model.ring.indirect)  # fmt: skip
        with prediction.with_material(self.surface, HIGHLIGHTS | {"roughness": WIDE}):
            wide = self.picture(index, scale, torch.zeros(2))
        inside = seen.surely(coverage) & ~seen.clipped.any(-1)
        wide = torch.where(inside, wide, 0)
        inside &= wide > NEAR * wide.amax((1, 2), keepdim=True)
        observed = calibration.linear(seen.rgb, index, scale).mean(-1) / unit
        predicted = whole.mean(-1) / unit + DIM
        lacking = torch.log(observed.clamp(min=-DIM / 2) + DIM) - predicted.log()
        squares = fine(lacking, inside).square().sum((1, 2), keepdim=True)
        return Part(index, scale, inside, predicted, lacking, squares.clamp(min=1e-12) ** -0.5)

    def photographs(self, index: np.ndarray, views: Views, scale: int) -> Photographs:
        """Return photographs for the renderer, with cameras and lights `views`."""
        selected = self.problem.capture.selected(index, scale)
        return self.calibration.refined_photographs(selected, views.to(self.problem.device))

    def picture(self, index: np.ndarray, scale: int, place: Tensor) -> Tensor:
        """Render the grey radiance (n, H, W) of photographs under a flash at `place` alone."""
        estimate = replace(self.calibration.estimate(), offset=self.offset(place))
        views = self.calibration.rig.views_of(estimate)
        views = views._replace(intrinsics=views.intrinsics / scale)
        photographs = replace(self.photographs(index, views, scale), room=None, lobes=None)
        return prediction.draw(self.surface, photographs, 1, shadows=self.shadows)[0].mean(-1)

    def pictures(self, place: Tensor) -> list[Tensor]:
        """Render `picture` of all that is compared."""
        return [self.picture(part.photographs, part.scale, place) for part in self.parts]

    def offset(self, place: Tensor) -> Tensor:
        """Return the offset (1, 3) of a flash at `place` from where the capture says."""
        return torch.cat([place - self.given, self.ahead])[None]

    def joined(self, pictures: Iterable[Tensor]) -> Tensor:
        """Return what is fine in a picture (n, H, W) for each of `parts`, weighted, at the pixels that are compared."""
        return torch.cat([(part.weights * fine(picture, part.inside))[part.inside]
                          for picture, part in zip(pictures, self.parts)])  # fmt: skip

    def with_halves(self) -> list[Subset]:
        """Return all pixels, and those of each half of the photographs."""
        lacking, slopes = self.joined(part.lacking for part in self.parts), []
        with prediction.with_material(self.surface, MATTE):
            for aside in STEP * torch.eye(2):
                changes = zip(self.pictures(self.now + aside), self.pictures(self.now - aside), self.parts)
                slopes.append(self.joined((a - b) / self.problem.exposure / part.predicted for a, b, part in changes))
        first, numbers = 0, []
        for part in self.parts:
            numbers.append(first + part.inside.nonzero()[:, 0])
            first += len(part.photographs)
        number, found = torch.cat(numbers), []
        for chosen in (number >= 0, number % 2 == 0, number % 2 == 1):
            pixels = chosen.nonzero()[:, 0]
            matte = torch.linalg.qr(torch.stack(slopes, 1)[pixels]).Q
            found.append(Subset(pixels, matte, without(lacking[pixels], matte)))
        return found

    def place(self) -> Tensor | None:
        """Search the place whose highlights explain most; see `find_flash`."""
        if not self.subsets:
            return None
        with prediction.with_material(self.surface, HIGHLIGHTS | {"roughness": NARROW}):
            own = self.gains(self.now)
            most, best, *others = self.best_of(STEP * around(FAR // STEP))
            for step in FINER:
                most, best, *_ = self.best_of(best + step * around(1))
        agree = all((other - best).norm() < 2 * STEP for other in others)
        told = most[0] >= SHARE * float(self.subsets[0].lacking.square().sum()) and (most > FACTOR * own).all()
        inner = best.norm() <= FAR - STEP  # otherwise the error may fall on and on: then something else is wrong
        if not (told and agree and inner and (best - self.now).norm() >= NEAREST):
            return None
        return self.offset(best) / self.calibration.widths["light"]

    def best_of(self, places: Tensor) -> list:
        """Return the gains (3,) of the best of `places` (n, 2), this place, and those that are best for each half."""
        places = places[places.norm(dim=1) <= FAR]
        gains = np.array([self.gains(place) for place in places])
        best = gains.argmax(0)
        return [gains[best[0]], *places[best]]

    def gains(self, place: Tensor) -> np.ndarray:
        """Compute by how much highlights of a flash at `place` reduce the squared error, beside matte shading.

        Returns (3,): of all photographs, of each half of them. One strength of the highlights is fitted to each. The
        surface must show narrow highlights alone.
        """
        added = self.joined(picture / part.predicted for picture, part in zip(self.pictures(place), self.parts))
        found = []
        for subset in self.subsets:
            own = without(added[subset.pixels], subset.matte)
            along, square = float(own @ subset.lacking), float(own.square().sum())
            found.append(max(along, 0.0) ** 2 / max(square, 1e-30))
        return np.array(found)


def around(steps: float) -> Tensor:
    """Return a square grid (n, 2) of whole numbers from -`steps` to `steps`."""
    return torch.cartesian_prod(*2 * [torch.arange(-steps, steps + 1)])


def without(values: Tensor, columns: Tensor) -> Tensor:
    """Return values (n,) without their part along orthonormal columns (n, k)."""
    return values - columns @ (columns.T @ values)


def fine(picture: Tensor, inside: Tensor) -> Tensor:
    """Subtract from pictures (n, H, W) what is coarse. `inside` (n, H, W) bool: the pixels that count; others are 0."""
    sigma = COARSE * math.sqrt(max(float(inside.sum()), 1.0) / len(inside))
    weight, picture = inside.to(picture), torch.where(inside, picture, 0)
    return weight * (picture - blur(picture, sigma) / blur(weight, sigma).clamp(min=1e-6))
