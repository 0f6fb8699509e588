"""The light of the room as an unknown of a fit: spherical harmonics, estimated by linear least squares."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.spherical_harmonics import BASIS, MAX_ORDER, harmonics_up_to

MEMORY = 0.95  #: factor per iteration of earlier normal equations, which belong to an earlier surface
RIDGE = 0.01  #: ridge toward the values of the capture, relative to the mean diagonal of the normal equations
DIM = 0.3  #: radiance, in units of the exposure, that is added to the scale of errors: dark pixels count less
ROBUST = 0.2  #: relative error above which an error counts linearly
OBJECT = 0.99  #: coverage of pixels that are compared, at least
COMPARED_WIDTH = 64  #: largest width of the pictures that are compared [px]
#: A room beside a flash whose light is a smaller share of what photographs show is not believed: another material may
#: look like it.
DOUBT = 0.03
BESIDE_FLASH = 2  #: order of the harmonics of a room beside a flash: photographs tell hardly more
FINE = 0.3  #: progress from which the only light has its full order


class RoomLight(nn.Module):
    """Room light as an unknown: its spherical harmonics, and the normal equations that determine them."""

    which: list[int]  #: numbers of the harmonics that may be non-zero
    given: Tensor  #: (BASIS, 3) from the capture
    harmonics: Tensor  #: (BASIS, 3) as found
    matrix: Tensor  #: (3, BASIS, BASIS) of the normal equations, one for each colour
    vector: Tensor  #: (3, BASIS) right sides of the normal equations
    shown: Tensor  #: (3, BASIS + 1) products of the photographs with the harmonics' light, and with themselves

    def __init__(self, given: Tensor, exposure: float, frames: Iterable[str] = ("world",), alone: bool = False) -> None:
        """Start from the harmonics `given` (BASIS, 3). `exposure`: mean radiance of the object.

        `frames`: the axes, "world" or "camera", whose harmonics are estimated; the others stay as given. If both were
        estimated, they could imitate a flash elsewhere or another reflectance. `alone`: there is no other light, or
        none in some photographs. Then more harmonics are estimated, as soon as the shape is no longer coarse.
        """
        super().__init__()
        self.exposure, self.frames, self.alone = exposure, tuple(frames), alone
        self.free = harmonics_up_to(MAX_ORDER if alone else BESIDE_FLASH, frames)  #: those that are estimated
        self.which = sorted({*self.free, *given.abs().sum(1).nonzero()[:, 0].tolist()})
        self.register_buffer("given", given, persistent=False)
        self.register_buffer("harmonics", given.clone())
        self.register_buffer("matrix", torch.zeros(3, BASIS, BASIS))
        self.register_buffer("vector", torch.zeros(3, BASIS))
        self.register_buffer("shown", torch.zeros(3, BASIS + 1))

    def forget(self) -> None:
        """Set the normal equations to 0, so that earlier photographs no longer count. The harmonics do not change."""
        self.matrix.zero_()
        self.vector.zero_()
        self.shown.zero_()

    @torch.no_grad()
    def solve(
        self, around: GlobalIllumination, predicted: Tensor, observed: Tensor, counted: Tensor, progress: float = 1.0,
        total: Callable[[Tensor], Tensor] = lambda equations: equations,
    ) -> None:  # fmt: skip
        """Add photographs to the normal equations, solve them, and set the harmonics to the solution.

        `around`: rendered pictures, one for the light of each spherical harmonic. `predicted`, `observed` (N, H, W, 3):
        linear radiance. `predicted` must contain the current room light without occlusion. `counted` (N, H, W) bool:
        True where a pixel shows only the object. `progress` of the fit, 0 to 1: a room without other light has its
        finest harmonics only later in the fit. `total`: returns the sum of a tensor over all processes; default: one
        process.
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
        which, now = around.harmonics, self.harmonics[around.harmonics]
        basis = torch.stack([pooled(harmonic, coarser)[inside] for harmonic in around.transfer])  # (which, n, 3)
        lit = torch.einsum("jnhwc,jc->nhwc", around.unoccluded, now)
        missing = missing + pooled(lit, coarser)[inside]
        scale = seen.mean(-1) + DIM * self.exposure
        left = missing - torch.einsum("jnc,jc->nc", basis, now)
        weight = (ROBUST / (left.abs().mean(-1) / scale).clamp(min=ROBUST)) / scale**2
        matrix = torch.einsum("jnc,knc,n->cjk", basis, basis, weight)
        vector = torch.einsum("jnc,nc,n->cj", basis, missing, weight)
        shown = torch.einsum("jnc,nc,n->cj", torch.cat([basis, seen[None]]), seen, weight)
        equations = total(torch.cat([matrix, vector[..., None], shown[:, :-1, None]], -1))
        brightness = total(shown[:, -1])  # finite if the others are
        if not bool(equations.isfinite().all()):  # a single pixel of the renderer may be NaN, and equations are kept
            return
        self.matrix *= MEMORY
        self.vector *= MEMORY
        self.shown *= MEMORY
        self.matrix[:, torch.tensor(which)[:, None], which] += equations[..., :-2]
        self.vector[:, which] += equations[..., -2]
        self.shown[:, which] += equations[..., -1]
        self.shown[:, -1] += brightness
        told = self.matrix.diagonal(dim1=1, dim2=2)[:, which].mean(1)
        ridge = RIDGE * told[:, None, None] * torch.eye(BASIS).to(self.matrix)
        if bool((ridge.amax((1, 2)) > 0).all()):
            free = self.free if progress >= FINE else harmonics_up_to(BESIDE_FLASH, self.frames)
            right = self.vector[..., None] - self.matrix @ self.given.T[..., None]
            more = torch.linalg.solve((self.matrix + ridge)[:, free][:, :, free], right[:, free])[..., 0]
            self.harmonics = self.given.clone()
            self.harmonics[free] += self.believed(more, free) * more.T
            # A room with negative mean radiance is impossible: another part of the model is too bright then.
            self.harmonics[:, self.harmonics[0] < 0] = 0.0

    def believed(self, more: Tensor, free: list[int]) -> float:
        """Return the factor, 0 to 1, of room light that is believed. `more` (3, J): of the harmonics `free`, as solved.

        It is 1 if some photographs have no flash, and if the capture tells of a room. Otherwise it depends on the mean
        share of this light in the photographs and on its error: colours that differ tell how large that is, but it is
        at least `DOUBT`. The form is that of "Estimation with quadratic loss" (James and Stein 1961).
        """
        if self.alone or self.given.any():
            return 1.0
        shares = (more * self.shown[:, free]).sum(1) / self.shown[:, -1].clamp(min=1e-12)
        share, error = float(shares.mean()), float(shares.var() / 3) + DOUBT**2
        return max(0.0, 1 - error / share**2) if share > 0 else 0.0

    def doubted(self) -> Tensor:
        """Return the first harmonic (3,) [radiance] of a room as faint as one that is not believed.

        It is 0 if every room is believed, and before photographs were seen.
        """
        if self.alone or self.given.any():
            return self.harmonics.new_zeros(3)
        return torch.where(self.shown[:, 0] > 0, DOUBT * self.shown[:, -1] / self.shown[:, 0], 0.0)
