"""Lobe search: during a fit, finds the small lights of an unknown room in what harmonics leave unexplained.

It compares the photographs with pictures of the current surface in the light of candidates: lobes from all directions.
So it finds a light both by its mirror image on a glossy surface and by the shading and shadows of a matte one. The
method is orthogonal matching pursuit ("Orthogonal Matching Pursuit", Pati, Rezaiifar and Krishnaprasad 1993): the
candidate is taken that reduces the squared error most, after all strengths are solved for again.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.room_light import DIM, RIDGE, SHARPNESS, RoomLight
from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.geometry.hull import evenly_spaced
from mi_ring.geometry.sphere_map import even_directions
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.lobe_candidates import candidate_pictures
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.rendering.surface import Surface
from mi_ring.scene.lobes import Lobes

SEARCH_WIDTH, PATHS = 48, 16  #: of the pictures that are compared: largest width [px], paths per pixel
PHOTOGRAPHS, PIXELS = 24, 5000  #: that are compared, at most
GRID = 600  #: directions all around, about 8° apart
FIRST_SHARPNESS = 40.0  #: of the lobes in all directions: as wide as they are apart
SHARPER = (6.0, 20.0, 60.0, 200.0, 700.0)  #: sharpness that is tried about a direction
RINGS = (6.0, 3.0, 1.5)  #: steps by which a direction is refined [degrees]
#: A lobe is added if it explains at least this share of the squared error that is left, and kept if it explains the
#: second share.
ADDED, KEPT = 0.05, 0.01
#: The first lobe must also give this share of all light. While the surface is coarse, a faint lobe explains its errors:
#: it gave 0.05 to 0.08 under an overcast sky. The first of three windows gave 0.14.
FIRST = 0.1
APART = 0.5  #: distance of lobes, relative to the sum of their widths, below which two are one


@dataclass(frozen=True)
class FoundLobes:
    """The lobes of a room, its harmonics, and the normal equations for both."""

    lobes: Lobes | None
    harmonics: Tensor  #: (BASIS, 3)
    matrix: Tensor  #: (3, rows, rows)
    vector: Tensor  #: (3, rows)

    @torch.no_grad()
    def put_into(self, room: RoomLight) -> None:
        """Set the light of `room`. Its normal equations become those of the search, of equal weight."""
        room.place(self.lobes)
        room.harmonics.copy_(self.harmonics)
        room.matrix.copy_(self.matrix)
        room.vector.copy_(self.vector)


def find_lobes(problem: Problem, model: Model, renderer: Renderer, level: int, iteration: int) -> FoundLobes | None:
    """Find the lobes of the room's light, beginning with those that are known. Renders the surface.

    Returns None if no pixel can be compared: the surface is not where the masks are, or all pixels are clipped.
    `level`: level of the mesh that is rendered. `iteration`: number of the iteration, for random numbers.
    """
    search = LobeSearch(problem, model, renderer.show(model, level), iteration)
    if not len(search.target):
        return None
    search.refine()
    while len(search.lobes) < problem.config.small_lights and search.add():
        search.refine()
    search.drop()
    return search.found()


class LobeSearch:
    """The photographs at some pixels, and the pictures of the surface in the light of harmonics and lobes there."""

    def __init__(self, problem: Problem, model: Model, surface: Surface, iteration: int) -> None:
        """Render the light that is known. `surface`: shows the model."""
        calibration = model.calibration
        assert calibration is not None
        self.room, self.surface, self.seed = calibration.room, surface, problem.config.seed + 7919 * (iteration + 1)
        self.in_camera = self.room.frames == ("camera",)
        self.parts: list[tuple[Photographs, np.ndarray]] = []  #: photographs, and the numbers of pixels in them
        known = self.room.lobes()
        self.lobes: list[tuple[np.ndarray, float]] = []  #: direction and sharpness of each
        if known is not None:
            self.lobes = list(zip(known.toward, known.sharpness.tolist()))
        basis, observed = self.compared(problem, calibration, model.ring.indirect)
        scale = observed.mean(-1, keepdim=True) + DIM * problem.exposure
        self.weights = 1 / scale[..., 0]  #: (n,) of errors
        self.smooth = basis * self.weights[:, None, None]  #: (n, J, 3) pictures of the harmonics, weighted
        self.target = observed * self.weights[:, None]  #: (n, 3)
        self.pictures = [self.picture(*lobe) for lobe in self.lobes]  #: (n, 3) of each lobe

    def compared(self, problem: Problem, calibration: Calibration, indirect: bool) -> tuple[Tensor, Tensor]:
        """Render harmonics at random pixels of the object. Returns (their pictures (n, J, 3), photographs (n, 3))."""
        capture, random = problem.capture, np.random.default_rng(self.seed)
        fitted = problem.fitted[evenly_spaced(len(problem.fitted), PHOTOGRAPHS)]
        basis, observed = [torch.zeros(0, len(self.room.free), 3)], [torch.zeros(0, 3)]
        for index in capture.together(fitted):
            scale = -(-max(capture.shots[index[0]].size) // SEARCH_WIDTH)
            photographs = calibration.refined_photographs(
                capture.selected(index, scale), calibration(scale).to(problem.device)
            )
            seen = capture.observe(index, scale)
            around = GlobalIllumination.of(
                self.surface, replace(photographs, lobes=None), torch.zeros(photographs.shape), self.seed,
                SEARCH_WIDTH, PATHS, indirect, self.room.free,
            )  # fmt: skip
            inside = (seen.surely(around.alpha.cpu()) & ~seen.clipped.any(-1)).ravel().nonzero()[:, 0].numpy()
            most = PIXELS * len(index) // len(fitted)
            pixels = np.sort(random.permutation(inside)[:most]).astype(np.uint32)
            if not len(pixels):
                continue
            self.parts.append((photographs, pixels))
            chosen = torch.from_numpy(pixels.astype(np.int64))
            basis.append(around.transfer.flatten(1, 3).cpu()[:, chosen].movedim(0, 1).nan_to_num(0.0, 0.0, 0.0))
            linear = calibration.linear(seen.rgb, index, scale)
            observed.append(linear.reshape(-1, 3)[chosen])
        return torch.cat(basis), torch.cat(observed)

    def candidates(self, toward: np.ndarray, sharpness: np.ndarray) -> Tensor:
        """Render the pictures (n, D, 3) of lobes, weighted like the photographs."""
        parts = [candidate_pictures(self.surface, photographs, pixels, toward, sharpness, self.in_camera, self.seed)
                 for photographs, pixels in self.parts]  # fmt: skip
        parts.append(np.zeros((0, len(toward), 3), np.float32))
        return torch.from_numpy(np.concatenate(parts)).nan_to_num(0.0, 0.0, 0.0) * self.weights[:, None, None]

    def picture(self, toward: np.ndarray, sharpness: float) -> Tensor:
        """Render the picture (n, 3) of one lobe, weighted like the photographs."""
        return self.candidates(toward[None], np.array([sharpness]))[:, 0]

    def basis(self, without: int | None = None) -> Tensor:
        """Return the pictures (n, J + L, 3) of the harmonics and of all lobes but the one with the index `without`."""
        lobes = [picture for k, picture in enumerate(self.pictures) if k != without]
        return torch.cat([self.smooth, *(picture[:, None] for picture in lobes)], 1)

    def gains(self, candidates: Tensor, without: int | None = None) -> tuple[Tensor, float]:
        """Compute by how much each candidate reduces the squared error, beside the light that is known.

        `candidates` (n, D, 3). `without`: index of a lobe that is left out. Returns (reductions (D,), squared error).
        """
        basis, gains, left = self.basis(without), torch.zeros(candidates.shape[1]), 0.0
        smooth = self.smooth.shape[1]
        for colour in range(3):
            own, target, new = basis[..., colour], self.target[:, colour], candidates[..., colour]
            own = torch.linalg.qr(self.with_ridge(own, smooth)).Q[: len(target)]
            rest = target - own @ (own.T @ target)
            new = new - own @ (own.T @ new)
            along = (new.T @ rest).clamp(min=0)
            least = max(1e-6 * float(candidates[..., colour].square().sum(0).max()), 1e-30)
            gains += along**2 / new.square().sum(0).clamp(min=least)
            left += float(rest.square().sum())
        return gains, left

    def with_ridge(self, basis: Tensor, smooth: int) -> Tensor:
        """Append rows to a basis (n, J + L), which keep the first `smooth` columns small, as in the fit."""
        ridge = basis.new_zeros(smooth, basis.shape[1])
        ridge[:, :smooth] = torch.eye(smooth) * (RIDGE * basis[:, :smooth].square().sum(0).mean()).sqrt()
        return torch.cat([basis, ridge])

    def add(self) -> bool:
        """Add the lobe that explains most of the error that is left.

        Returns False if none explains enough, or if the first gives less than `FIRST` of the light.
        """
        toward = even_directions(GRID)
        gains, left = self.gains(self.candidates(toward, np.full(GRID, FIRST_SHARPNESS)))
        best = int(gains.argmax())
        lobe, gain, _ = self.refined(toward[best], FIRST_SHARPNESS)
        if not gain >= ADDED * left or any(are_one(lobe, other) for other in self.lobes):
            return False
        self.lobes.append(lobe)
        self.pictures.append(self.picture(*lobe))
        if len(self.lobes) > 1 or self.share() >= FIRST:
            return True
        self.lobes, self.pictures = [], []
        return False

    def share(self) -> float:
        """Compute the share of the lobes in all light: of their mean radiance over all directions."""
        found = self.found()
        if found.lobes is None:
            return 0.0
        lobes, smooth = found.lobes.mean_radiance().mean(), float(found.harmonics[0].mean()) / math.sqrt(4 * math.pi)
        return float(lobes / max(lobes + max(smooth, 0.0), 1e-30))

    def refined(
        self, toward: np.ndarray, sharpness: float, without: int | None = None
    ) -> tuple[tuple[np.ndarray, float], float, float]:
        """Improve direction and sharpness of a lobe. Returns (lobe, reduction of the squared error, that before).

        `without`: index of a lobe that is left out.
        """
        before = None
        gain = 0.0
        for ring in RINGS:
            around = np.concatenate([toward[None], tilted(toward, ring), tilted(toward, 2 * ring)])
            widths = np.array(sorted({sharpness, *SHARPER}))
            directions, sharp = np.repeat(around, len(widths), 0), np.tile(widths, len(around))
            gains, _ = self.gains(self.candidates(directions, sharp), without)
            if before is None:
                before = float(gains[np.flatnonzero(sharp == sharpness)[0]])
            best = int(gains.argmax())
            toward, sharpness, gain = directions[best], float(sharp[best]), float(gains[best])
        return (toward, float(np.clip(sharpness, *SHARPNESS))), gain, before or 0.0

    def refine(self) -> None:
        """Improve direction and sharpness of all lobes, one after the other."""
        for k, lobe in enumerate(self.lobes):
            better, gain, before = self.refined(*lobe, without=k)
            if gain > (1 + KEPT) * before:
                self.lobes[k], self.pictures[k] = better, self.picture(*better)

    def drop(self) -> None:
        """Remove lobes that explain hardly anything, and of two lobes in one place the fainter one."""
        k = 0
        while k < len(self.lobes):
            gains, left = self.gains(self.pictures[k][:, None], without=k)
            others = [lobe for n, lobe in enumerate(self.lobes) if n != k]
            if not float(gains[0]) >= KEPT * left or any(are_one(self.lobes[k], other) for other in others):
                del self.lobes[k], self.pictures[k]
            else:
                k += 1

    def found(self) -> FoundLobes:
        """Solve for the strengths of all light."""
        basis, free, count = self.basis(), self.room.free, len(self.lobes)
        rows = [*free, *range(BASIS, BASIS + count)]
        matrix, vector = torch.zeros_like(self.room.matrix).cpu(), torch.zeros_like(self.room.vector).cpu()
        for colour in range(3):
            own, at = basis[..., colour], torch.tensor(rows)
            matrix[colour, at[:, None], at] = own.T @ own
            vector[colour, at] = own.T @ self.target[:, colour]
        known = float(self.room.matrix[:, 0, 0].mean())
        factor = known / max(float(matrix[:, 0, 0].mean()), 1e-12) if known > 0 else 1.0
        matrix, vector = factor * matrix, factor * vector
        device = self.room.vector.device
        values = self.room.solved_with_lobes(matrix.to(device), vector.to(device), free, count)
        harmonics = self.room.given.clone()
        harmonics[free] = values[0]
        lobes = None
        if count:
            toward, sharpness = (np.array(part, float) for part in zip(*self.lobes))
            flux = values[1].double().numpy(force=True)
            lobes = Lobes(toward, sharpness, flux, np.full(count, self.in_camera))
        return FoundLobes(lobes, harmonics.cpu(), matrix, vector)


def are_one(lobe: tuple[np.ndarray, float], other: tuple[np.ndarray, float]) -> bool:
    """Test whether two lobes (direction, sharpness) are too near to each other to be told apart."""
    angle = np.arccos(np.clip(lobe[0] @ other[0], -1, 1))
    return bool(angle < APART * (lobe[1] ** -0.5 + other[1] ** -0.5))


def tilted(direction: np.ndarray, angle: float) -> np.ndarray:
    """Return the unit vectors (8, 3) at this angle [degrees] from a unit vector (3,), on all sides."""
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    across /= np.linalg.norm(across)
    side, turn = np.cross(direction, across), np.pi / 4 * np.arange(8)[:, None]
    aside = np.cos(turn) * across + np.sin(turn) * side
    return np.cos(np.radians(angle)) * direction + np.sin(np.radians(angle)) * aside
