"""The light of the room as an unknown of a fit: spherical harmonics and lobes, whose strengths least squares find."""

import math
from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.spherical_harmonics import BASIS, MAX_ORDER, harmonics_up_to
from mi_ring.scene.lobes import MOST_LOBES, Lobes

MEMORY = 0.95  #: factor per iteration of earlier normal equations, which belong to an earlier surface
RIDGE = 0.01  #: ridge toward the values of the capture, relative to the mean diagonal of the normal equations
DIM = 0.3  #: radiance, in units of the exposure, that is added to the scale of errors: dark pixels count less
ROBUST = 0.2  #: relative error above which an error counts linearly
OBJECT = 0.99  #: coverage of pixels that are compared, at least
COMPARED_WIDTH = 64  #: largest width of the pictures that are compared [px]
BESIDE_FLASH = 2  #: order of the harmonics of a room beside a flash: photographs tell hardly more
FINE = 0.3  #: progress from which the only light has its full order
SHARPNESS = 4.0, 3000.0  #: least and largest sharpness of a lobe: a wider one is for harmonics
OF_LOBES = "toward", "log_sharpness", "flux", "in_camera", "count"  #: tensors that describe the lobes
LOBE_RIDGE = 1e-3  #: ridge of a lobe's flux toward 0, relative to its own diagonal of the normal equations


class RoomLight(nn.Module):
    """Room light as an unknown: harmonics and lobes.

    If it alone lights photographs, normal equations determine their strengths, in rows like those of
    `Photographs.room_strengths`, and directions and sharpness of lobes are trained by gradients. Beside other light a
    fit sets the harmonics as a whole, and lobes stay as given.
    """

    given: Tensor  #: (BASIS, 3) from the capture
    harmonics: Tensor  #: (BASIS, 3) as found
    toward: Tensor  #: (MOST_LOBES, 3) directions of the lobes, of any length, in the axes of `in_camera`
    log_sharpness: Tensor  #: (MOST_LOBES,)
    flux: Tensor  #: (MOST_LOBES, 3) [W/m²]
    in_camera: Tensor  #: (MOST_LOBES,) bool
    count: Tensor  #: () int, number of lobes; the other rows are unused
    matrix: Tensor  #: (3, rows, rows) of the normal equations, one for each colour
    vector: Tensor  #: (3, rows) right sides of the normal equations

    def __init__(
        self, given: Tensor, exposure: float, frames: Iterable[str] = ("world",), alone: bool = False,
        lobes: Lobes | None = None,
    ) -> None:  # fmt: skip
        """Start from the harmonics `given` (BASIS, 3) and `lobes`. `exposure`: mean radiance of the object.

        `frames`: the axes, "world" or "camera", whose harmonics are estimated; the others stay as given. If both were
        estimated, they could imitate a flash elsewhere or another reflectance. `alone`: there is no other light, or
        none in some photographs. Then more harmonics are estimated, as soon as the shape is no longer coarse.
        """
        super().__init__()
        self.exposure, self.frames, self.alone = exposure, tuple(frames), alone
        self.free = harmonics_up_to(MAX_ORDER if alone else BESIDE_FLASH, frames)  #: those that are estimated
        self.used = sorted({*self.free, *given.abs().sum(1).nonzero()[:, 0].tolist()})  #: harmonics that may not be 0
        rows = BASIS + MOST_LOBES * alone
        self.register_buffer("given", given, persistent=False)
        self.register_buffer("harmonics", given.clone())
        self.register_buffer("matrix", torch.zeros(3, rows, rows))
        self.register_buffer("vector", torch.zeros(3, rows))
        for name, shape in (("toward", (MOST_LOBES, 3)), ("log_sharpness", (MOST_LOBES,))):
            if alone:
                self.register_parameter(name, nn.Parameter(torch.zeros(shape)))
            else:
                self.register_buffer(name, torch.zeros(shape))
        self.register_buffer("flux", torch.zeros(MOST_LOBES, 3))
        self.register_buffer("in_camera", torch.zeros(MOST_LOBES, dtype=torch.bool))
        self.register_buffer("count", torch.tensor(0))
        self.place(lobes)
        for name in OF_LOBES:
            self.register_buffer(f"given_{name}", getattr(self, name).detach().clone(), persistent=False)

    @property
    def which(self) -> list[int]:
        """Rows of `strengths` that may not be 0."""
        return [*self.used, *range(BASIS, BASIS + int(self.count))]

    @property
    def strengths(self) -> Tensor:
        """Room light (BASIS + n, 3) as `Photographs.room_strengths`."""
        return torch.cat([self.harmonics, self.flux[: int(self.count)]])

    @torch.no_grad()
    def place(self, lobes: Lobes | None) -> None:
        """Replace all lobes. None: there are none. The normal equations do not change."""
        self.count.fill_(0 if lobes is None else len(lobes))
        tensors = self.toward, self.log_sharpness, self.flux, self.in_camera
        for tensor in tensors:
            tensor.zero_()
        if lobes is not None:
            values = lobes.toward, np.log(lobes.sharpness), lobes.flux, lobes.in_camera
            for tensor, value in zip(tensors, values):
                tensor[: len(lobes)] = torch.from_numpy(np.array(value)).to(tensor)

    def lobe_tensors(self) -> list[Tensor]:
        """Return [unit directions (n, 3), sharpness (n,)] of the n lobes, with gradients; [] if there are none."""
        count = int(self.count)
        if not count:
            return []
        return [F.normalize(self.toward[:count], dim=1), self.log_sharpness[:count].exp()]

    @torch.no_grad()
    def lobes(self) -> Lobes | None:
        """Return the lobes as arrays; None if there are none."""
        if not (parts := self.lobe_tensors()):
            return None
        toward, sharpness, flux = (t.double().numpy(force=True) for t in (*parts, self.flux[: int(self.count)]))
        return Lobes(toward, sharpness, flux, self.in_camera[: int(self.count)].numpy(force=True))

    def current_and_given(self) -> list[tuple[Tensor, Tensor]]:
        """List (current value, value of the capture) of all tensors that describe the light."""
        names = [(name, f"given_{name}") for name in OF_LOBES]
        return [(getattr(self, now).detach(), getattr(self, given)) for now, given in [("harmonics", "given"), *names]]

    def forget(self) -> None:
        """Set the normal equations to 0, so that earlier photographs no longer count. The light does not change."""
        self.matrix.zero_()
        self.vector.zero_()

    @torch.no_grad()
    def solve(
        self, around: GlobalIllumination, predicted: Tensor, observed: Tensor, counted: Tensor, progress: float = 1.0,
        total: Callable[[Tensor], Tensor] = lambda equations: equations,
    ) -> None:  # fmt: skip
        """Add photographs to the normal equations, solve them, and set harmonics and fluxes to the solution.

        `around`: rendered pictures, one for the light of each harmonic and lobe. `predicted`, `observed` (N, H, W, 3):
        linear radiance. `predicted` must contain the current room light, reflected once; its harmonics without
        occlusion. `counted` (N, H, W) bool: True where a pixel shows only the object. `progress` of the fit, 0 to 1: a
        room without other light has its finest harmonics only later in the fit. `total`: returns the sum of a tensor
        over all processes; default: one process.
        """
        which = around.rows
        sums = total(torch.cat(self.equations(around, predicted, observed, counted), 1))
        if not bool(sums.isfinite().all()):  # a single pixel of the renderer may be NaN, and equations are kept
            return
        self.matrix *= MEMORY
        self.vector *= MEMORY
        matrix, vector = sums.split([len(which) ** 2, len(which)], 1)
        self.matrix[:, torch.tensor(which)[:, None], which] += matrix.unflatten(1, (len(which), -1))
        self.vector[:, which] += vector
        self.update(progress)

    def equations(
        self, around: GlobalIllumination, predicted: Tensor, observed: Tensor, counted: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Compute the normal equations of photographs for the J strengths of `around`.

        Returns the matrix (3, J²) and the vector (3, J). The other arguments are those of `solve`.
        """

        def pooled(pictures: Tensor, factor: int) -> Tensor:
            means = F.avg_pool2d(pictures.movedim(-1, 1), factor, ceil_mode=True, count_include_pad=False)
            return means.movedim(1, -1)

        # Few paths per pixel are noisy, and noise would make the room darker.
        coarser = max(1, max(around.alpha.shape[1:]) // COMPARED_WIDTH)
        alpha = pooled(around.alpha[..., None], coarser)[..., 0]
        height, width = alpha.shape[1:]

        def small(pictures: Tensor) -> Tensor:
            return pooled(pictures, around.factor * coarser)[:, :height, :width]

        inside = torch.minimum(small(counted.float()[..., None])[..., 0], alpha) > OBJECT
        missing, seen = small(observed - predicted)[inside], small(observed)[inside]
        now = self.strengths[around.rows]
        lit = torch.einsum("jnhwc,jc->nhwc", around.unoccluded, now)
        basis = torch.stack([pooled(picture, coarser)[inside] for picture in around.transfer])  # (J, n, 3)
        missing = missing + pooled(lit, coarser)[inside]
        scale = seen.mean(-1) + DIM * self.exposure
        left = missing - torch.einsum("jnc,jc->nc", basis, now)
        weight = (ROBUST / (left.abs().mean(-1) / scale).clamp(min=ROBUST)) / scale**2
        matrix = torch.einsum("jnc,knc,n->cjk", basis, basis, weight)
        vector = torch.einsum("jnc,nc,n->cj", basis, missing, weight)
        return matrix.flatten(1), vector

    @torch.no_grad()
    def limit_sharpness(self) -> None:
        """Keep the sharpness of lobes that a fit changes between the limits `SHARPNESS`."""
        self.log_sharpness.clamp_(*map(math.log, SHARPNESS))

    def update(self, progress: float) -> None:
        """Set the light to the solution of the normal equations. Does nothing while they do not tell each harmonic."""
        told = self.matrix.diagonal(dim1=1, dim2=2)[:, self.used].mean(1)
        if not bool((told > 0).all()):
            return
        free = self.free if progress >= FINE else harmonics_up_to(BESIDE_FLASH, self.frames)
        self.harmonics = self.given.clone()
        if count := int(self.count):
            found = self.solved_with_lobes(self.matrix, self.vector, free, count)
            self.harmonics[free], self.flux[:count] = found
        else:
            rows = len(self.vector[0])
            ridge = RIDGE * told[:, None, None] * torch.eye(rows).to(self.matrix)
            given = F.pad(self.given.T, (0, rows - BASIS))
            right = self.vector[..., None] - self.matrix @ given[..., None]
            more = torch.linalg.solve((self.matrix + ridge)[:, free][:, :, free], right[:, free])[..., 0]
            self.harmonics[free] += more.T
        # A room with negative mean radiance is impossible: another part of the model is too bright then.
        self.harmonics[:, self.harmonics[0] < 0] = 0.0

    def solved_with_lobes(self, matrix: Tensor, vector: Tensor, free: list[int], count: int) -> tuple[Tensor, Tensor]:
        """Solve normal equations with lobes, whose fluxes must not be negative.

        `matrix` (3, rows, rows), `vector` (3, rows). `free`: numbers of the harmonics. `count`: n, number of lobes.
        Returns (harmonics (len(free), 3), fluxes (n, 3)).
        """
        lobes = list(range(BASIS, len(vector[0])))[:count]
        result = torch.zeros(len(free) + len(lobes), 3).to(vector)
        for colour in range(3):
            own, right, used = matrix[colour].double(), vector[colour].double(), [*free, *lobes]
            given, diagonal = self.given[:, colour].double(), own.diagonal()
            ridge = torch.zeros_like(diagonal)
            ridge[:BASIS] = RIDGE * diagonal[self.used].mean()
            ridge[BASIS:] = LOBE_RIDGE * diagonal[BASIS:] + 1e-30
            # toward the harmonics that are given, as without lobes
            right = right + F.pad(ridge[:BASIS] * given, (0, len(right) - BASIS))
            others = [k for k in self.used if k not in free]
            right = right - own[:, others] @ given[others]
            while True:
                system = own[used][:, used] + ridge[used].diag()
                found = torch.linalg.solve(system, right[used])
                negative = [k for k, value in zip(used, found.tolist()) if k >= BASIS and value < 0]
                if not negative:
                    break
                used = [k for k in used if k not in negative]
            places = [[*free, *lobes].index(k) for k in used]
            result[places, colour] = found.to(result)
        return result[: len(free)], result[len(free) :]
