"""Joint least squares of all unknowns of calibration. Surface and material are unknown, too.

All photographs are compared with their predictions from the current model. The normal equations follow from these
errors, and from the derivatives with respect to each unknown. Each patch of the surface has unknowns of its own, which
are eliminated ("Bundle Adjustment: A Modern Synthesis", Triggs et al. 2000, section 6.1). The covariance is the inverse
of the matrix (the same, section 8.1).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor
from torch.nn import functional as F

from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.unknowns import Exposure
from mi_ring.fitting.local_unknowns import Patches
from mi_ring.fitting.losses import perceived
from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.rendering import prediction
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.lobe_light import LobeLight
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.plain_mesh import POSITIONS

COMPARED_WIDTH, SPP = 96, 4  #: of the compared pictures: largest width [px], samples per pixel
LEVEL = 5  #: of the mesh in them, at most
ROOM, DIM = 10.0, 0.01  #: prior and step of the room's light [exposure]
STEP = 0.2  #: of the unknowns to either side [standard deviations of their priors]
BLOCK = 8  #: width of blocks of pixels whose errors are taken to be correlated


class Layout:
    """The places of all unknowns of a calibration in one vector of all parameters. Its length is `count`."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration, self.first, self.count = calibration, {}, 0
        for name in calibration.widths:
            self.first[name] = self.count
            self.count += getattr(calibration, name).numel()
        #: the room's harmonics that are unknown; R, G, B of each
        self.room = calibration.room.free if "ambient" in calibration.refined else []
        self.first["ambient"] = self.count
        self.count += 3 * len(self.room)

    def values(self) -> np.ndarray:
        """Return the current parameters (N,). The room's light counts as 0."""
        unknowns = [
            getattr(self.calibration, name).double().numpy(force=True).ravel() for name in self.calibration.widths
        ]
        return np.concatenate([*unknowns, np.zeros(3 * len(self.room))])

    def centring(self) -> np.ndarray:
        """Return the matrix (N, N) that subtracts from powers and gains their means, as `Calibration` does."""
        result = np.eye(self.count)
        for name, unknown in self.calibration.unknowns.items():
            if isinstance(unknown, Exposure):
                for colour in range(3):
                    at = self.first[name] + 3 * self.calibration.rig.exposed[name].numpy() + colour
                    result[np.ix_(at, at)] -= 1 / max(len(at), 1)
        return result

    def of(self, index: np.ndarray) -> list[tuple[str, int, np.ndarray]]:
        """List the components of all unknowns that affect the photographs `index` (n,): (unknown, component, places).

        An unknown is given by its name, a component by its number. `places` (n,): for each photograph, the index of
        this component in the vector of all parameters. All or none of the photographs have a light of their own.
        """
        result, rig = [], self.calibration.rig
        for name, unknown in self.calibration.unknowns.items():
            if not unknown.concerns(rig, bool(rig.lit[index[0]])):
                continue
            for row in unknown.rows(rig, index):
                first = self.first[name] + unknown.components * row
                result += [(name, k, first + k) for k in range(unknown.components)]
        return result


@dataclass(frozen=True)
class JointEquations:
    """Normal equations `matrix` x = `vector` of all parameters of a calibration, in the units of their priors.

    Their solution is the change from the current parameters that explains the photographs best, whatever the surface
    and the material are. The priors of the parameters are not part of them.
    """

    layout: Layout
    matrix: np.ndarray  #: (N, N), the Fisher information
    vector: np.ndarray  #: (N,)

    @classmethod
    @torch.no_grad()
    def of(
        cls, problem: Problem, model: Model, renderer: Renderer, level: int, most: int | None = None
    ) -> "JointEquations":
        """Render fitted photographs from the current model, and compare them with the photographs.

        `most`: how many at most, evenly chosen; None: all of them. `level` of the mesh: at most `LEVEL` is rendered.
        Colours and silhouettes eliminate the surface separately, so its prior counts twice.
        """
        calibration, ring = model.calibration, model.ring
        assert calibration is not None
        layout = Layout(calibration)
        surface = renderer.show(model, min(level, LEVEL))
        s = ring.domain.sample(min(level, LEVEL))[0]
        patches = Patches(surface, s, float(ring.radius), ring.brdf_net.bsdf_parameters)
        colours, silhouettes = (Equations(layout.count, patches.count, n) for n in (patches.components, 1))
        chosen = problem.fitted[:: -(-len(problem.fitted) // most) if most else 1]
        lit = problem.capture.photographs.lit[chosen]
        kinds = [chosen[lit == kind] for kind in (True, False)]
        for index in (some for kind in kinds for some in problem.capture.together(kind)):
            scale = -(-problem.capture.shots[index[0]].size[0] // COMPARED_WIDTH)
            group = CovarianceGroup(problem, calibration, surface, patches, ring.indirect, index, scale)
            compare(group, layout, colours, silhouettes)
        calibration.relight(surface)  # as it was
        (matrix, vector), (more, shift) = (part.without_patches() for part in (colours, silhouettes))
        return cls(layout, matrix + more, vector + shift)


def covariance(problem: Problem, model: Model, renderer: Renderer, level: int) -> dict[str, np.ndarray]:
    """Compute the standard deviation of each refined unknown of calibration.

    Returns a dict from names of unknowns to arrays in the shape and the unit of the unknown. The room's light is
    "ambient": (3,), the deviations of the first harmonic's R, G, B [radiance]. `level` of the mesh of the results.
    """
    joint = JointEquations.of(problem, model, renderer, level)
    layout, calibration, centring = joint.layout, joint.layout.calibration, joint.layout.centring()
    precision = np.eye(layout.count) + joint.matrix
    spread = np.sqrt(np.diag(centring @ np.linalg.inv(precision) @ centring.T))
    result = {
        name: width * spread[layout.first[name] :][: getattr(calibration, name).numel()]
        .reshape(getattr(calibration, name).shape)
        for name, width in calibration.widths.items()
    }  # fmt: skip
    if layout.room:
        result["ambient"] = ROOM * problem.exposure * spread[layout.first["ambient"] :][:3]
    return result


class Equations:
    """The normal equations of least squares for N = `count` parameters, and the variance of the residuals.

    Photographs are added one by one. Each of the `patches` of the surface has L more unknowns of its own.
    """

    def __init__(self, count: int, patches: int, of_each: int) -> None:
        self.matrix, self.squares, self.pixels = np.zeros((count, count)), 0.0, 0
        self.vector = np.zeros(count)  #: products of the parameters with the errors
        self.own = np.zeros((patches, of_each, of_each))  #: products of a patch's unknowns
        self.cross = np.zeros((patches, of_each, count))  #: of these with the parameters
        self.own_vector = np.zeros((patches, of_each))  #: and of these with the errors

    def add(
        self, slopes: Tensor, error: Tensor, counted: Tensor, places: np.ndarray, local: Tensor, patch: np.ndarray
    ) -> None:
        """Add one photograph to the equations. Pixels of which a number is not finite are left out.

        `slopes` (K, H, W, C): derivatives of the prediction with respect to K parameters. `places` (K,): their indices
        among all N parameters. `error` (H, W, C): prediction minus photograph. `counted` (H, W) bool: True for pixels
        to use. `local` (L, H, W, C): derivatives with respect to the unknowns of the patch (H, W) of each pixel.
        """
        counted = counted & torch.cat([slopes, local, error[None]]).isfinite().all(-1).all(0)
        if not counted.any():
            return
        slopes, own, at = slopes[:, counted].double(), local[:, counted].double(), patch[counted.numpy()]
        flat, off = slopes.flatten(1), error[counted].double()
        np.add.at(self.matrix, np.ix_(places, places), (flat @ flat.T).numpy())
        np.add.at(self.vector, places, (flat @ off.flatten()).numpy())
        summed = csr_matrix((np.ones(len(at)), (at, np.arange(len(at)))), (len(self.own), len(at)))
        products = [torch.einsum("apc,bpc->pab", own, other).flatten(1).numpy() for other in (own, slopes, off[None])]
        self.own += (summed @ products[0]).reshape(self.own.shape)
        self.cross[:, :, places] += (summed @ products[1]).reshape(*self.own.shape[:2], len(places))
        self.own_vector += summed @ products[2]
        height, width, channels = error.shape
        error = torch.where(counted[..., None], error, 0.0).double()
        error = F.pad(error, (0, 0, 0, -width % BLOCK, 0, -height % BLOCK))
        blocks = error.unfold(0, BLOCK, BLOCK).unfold(1, BLOCK, BLOCK).sum((-2, -1))
        self.squares += float(blocks.square().sum())
        self.pixels += channels * int(counted.sum())

    def without_patches(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the normal equations of the N parameters alone, for all added photographs: (N, N) and (N,).

        The matrix is the Fisher information, the inverse of the covariance whatever the unknowns of the patches are.
        These have priors of standard deviation 1.
        """
        if not self.squares:
            return 0 * self.matrix, 0 * self.vector
        weight = self.pixels / self.squares
        own = np.eye(self.own.shape[1]) + weight * self.own
        solved = np.linalg.solve(own, weight * np.dstack([self.cross, self.own_vector]))
        explained = weight * np.tensordot(self.cross, solved, ((0, 1), (0, 1)))  # by the patches
        return weight * self.matrix - explained[:, :-1], explained[:, -1] - weight * self.vector


@dataclass(frozen=True)
class CovarianceGroup:
    """Photographs of one size, to be rendered from the current model at 1 / `scale` of their width and height.

    `index` (n,): indices of the photographs. All of them have a light of their own, or none of them has.
    """

    problem: Problem
    calibration: Calibration
    surface: Surface
    patches: Patches
    indirect: bool  #: Is interreflection predicted?
    index: np.ndarray
    scale: int

    @property
    def dark(self) -> bool:
        """True if the photographs have no light of their own."""
        return not self.problem.capture.photographs.lit[self.index[0]]

    def photographs(self) -> Photographs:
        """Return the cameras and lights of the group for the renderer, with the current calibration.

        Nothing is rendered. They contain the harmonics of the room's light only if the photographs have no lights of
        their own, its lobes always. Lamps in the scene get their current values.
        """
        calibration, photographs = self.calibration, self.problem.capture.selected(self.index, self.scale)
        calibration.relight(self.surface)
        room = calibration.room_harmonics().cpu().double().numpy() if self.dark else None
        lobes = LobeLight.of(calibration.room_lobes())
        lit = replace(photographs, room=room, lobes=lobes)
        return prediction.with_views(lit, calibration(self.scale).to(self.problem.device))

    def direct(self) -> tuple[Tensor, Tensor]:
        """Render direct light.

        Returns linear radiance (n, H, W, 3) and coverage (n, H, W), the object's share of each pixel.
        """
        shadows = self.problem.config.shadows and self.problem.capture.shadows
        photographs = self.photographs()
        photographs = photographs if self.dark else replace(photographs, lobes=None)
        return prediction.draw(self.surface, photographs, SPP, shadows=shadows, occlusion=False)

    def other(self, lit: Tensor, coverage: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Render interreflection and room light. Returns both as linear radiance (n, H, W, 3), and the transfer.

        Light that the fit does not use is 0. `lit` (n, H, W, 3): direct light. `coverage` (n, H, W): the object's share
        of each pixel. The transfer (J, n, H, W, 3) is radiance in a room of one harmonic, of J that are unknown.
        """
        calibration, indirect = self.calibration, self.indirect
        bounced, room_light, transfer = torch.zeros_like(lit), torch.zeros_like(lit), lit.new_zeros(0, *lit.shape)
        unknown, photographs = "ambient" in calibration.refined, self.photographs()
        room = torch.cat([calibration.room_harmonics().cpu(), lobe_fluxes(photographs)])
        if indirect or room.any() or unknown:
            around = GlobalIllumination.of(self.surface, photographs, coverage.to(self.problem.device), 1, paths=SPP,
                                         indirect=indirect, rows=calibration.room.which)  # fmt: skip
            bounced = around.interreflection.cpu() if indirect else bounced
            added = around.occlusion if self.dark else around.room_light
            room_light = added(room.to(self.problem.device)).cpu() if room.any() else room_light
            if unknown:
                chosen = [around.rows.index(k) for k in calibration.room.free]
                transfer = torch.stack([around.upsampled(around.transfer[k]).cpu() for k in chosen])
        return bounced, room_light, transfer

    def local_slopes(self, picture: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Return derivatives with respect to the unknowns of each pixel's patch: (L, n, H, W, 3), and (1, n, H, W).

        The first are of `picture`, a function of direct light. The second are of the coverage, with respect to the
        displacement.
        """
        moving = torch.zeros(0)
        slopes: list[Tensor] = []
        for unknown in self.patches.unknowns:
            sides: list[tuple[Tensor, Tensor]] = []
            for step in (STEP, -STEP):
                with self.patches.changed(unknown, step):
                    lit, coverage = self.direct()
                sides.append((picture(lit), coverage))
            slope, covering = ((plus - minus) / (2 * STEP) for plus, minus in zip(*sides))
            moving = covering if unknown.name == POSITIONS else moving
            slopes += [slope * channel for channel in torch.eye(3)] if unknown.channels == 3 else [slope]
        return torch.stack(slopes), moving[None]


def lobe_fluxes(photographs: Photographs) -> Tensor:
    """Return the fluxes (n, 3) of the lobes of the room light."""
    return torch.zeros(0, 3) if photographs.lobes is None else torch.from_numpy(photographs.lobes.flux).float()


def compare(at: CovarianceGroup, layout: Layout, colours: Equations, silhouettes: Equations) -> None:
    """Compare the photographs of the group `at` with their predictions, and add the result to normal equations.

    Errors of colours are added to `colours`, errors of silhouettes to `silhouettes`. Both are changed in place.
    `layout`: the places of all unknowns in the vector of parameters.
    """
    problem, calibration, index = at.problem, at.calibration, at.index
    seen = problem.capture.observe(index, at.scale)
    lit, coverage = at.direct()
    bounced, room_light, transfer = at.other(lit, coverage)

    def picture(lit: Tensor, bounced: Tensor = bounced, gain: Tensor | float = 1.0) -> Tensor:
        light = gain * (lit + bounced + room_light)
        return perceived(calibration.recorded(light, index, at.scale), problem.exposure, "log")

    def beside(name: str, k: int, places: np.ndarray, step: float) -> tuple[Tensor, Tensor]:
        """Predict picture and coverage after component `k` of the unknown `name`, at `places`, changes by a `step`."""
        factor, changes = float(np.exp(step * calibration.widths[name])), calibration.unknowns[name].changes
        colour = torch.ones(3)
        colour[k] = factor
        if changes == "light":  # directly: of the unknown itself the mean is subtracted
            return picture(lit * colour, bounced * colour), coverage
        if changes == "gain":
            return picture(lit, gain=colour), coverage
        if changes == "indirect":
            return picture(lit, bounced / factor), coverage
        tensor = getattr(calibration, name)
        found = tensor.detach().clone()
        tensor.view(-1)[torch.from_numpy(np.unique(places - layout.first[name]))] += step
        rgb, covered = (lit, coverage) if changes == "recording" else at.direct()
        result = picture(rgb), covered
        tensor.copy_(found)
        return result

    slopes, unknowns = [], layout.of(index)  # of colours (n, H, W, 3) and coverage (n, H, W)
    for unknown in unknowns:
        sides = beside(*unknown, STEP), beside(*unknown, -STEP)
        slopes.append([(plus - minus) / (2 * STEP) for plus, minus in zip(*sides)])
    for harmonic in transfer:
        plus, minus = (picture(lit + sign * DIM * problem.exposure * harmonic) for sign in (1, -1))
        slope = (plus - minus) * ROOM / (2 * DIM)
        slopes += [[slope * channel, torch.zeros_like(coverage)] for channel in torch.eye(3)]
    changing, covering = (torch.stack(part) for part in zip(*slopes))
    room = layout.first["ambient"] + np.arange(3 * len(transfer))
    own = np.column_stack([*(places for *_, places in unknowns), np.tile(room, (len(index), 1))])
    local, moving = at.local_slopes(picture)
    patch = at.patches.seen(at.photographs())
    error, off = picture(lit) - perceived(seen.rgb, problem.exposure, "log"), coverage - seen.mask
    surely = seen.surely(coverage) & ~seen.clipped.any(-1)
    known = torch.ones_like(surely) if seen.valid is None else seen.valid.bool()
    outlined = (covering.abs().amax(0) > 0) | (off != 0)  # pixels away from outlines have no error and do not count
    for n in range(len(index)):
        colours.add(changing[:, n], error[n], surely[n], own[n], local[:, n], patch[n])
        if seen.masked[n] and problem.capture.threshold is None:
            silhouettes.add(covering[:, n, ..., None], off[n, ..., None], (known & outlined)[n], own[n],
                            moving[:, n, ..., None], patch[n])  # fmt: skip
