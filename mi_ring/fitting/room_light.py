"""The light of the room as an unknown: spherical harmonics, by linear least squares in the course of a fit."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.fitting.processes import ALONE, Share
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.spherical_harmonics import BASIS, MAX_ORDER, harmonics_up_to

MEMORY = 0.95  #: weight of what was seen before, by iteration: the surface was another
RIDGE = 0.01  #: pull toward what the capture says, by the mean of what the photographs say of a harmonic
DIM = 0.3  #: radiance, in units of the exposure, below which errors count no more than there
ROBUST = 0.2  #: relative error from which it counts as its root
SURELY = 0.99  #: share of a pixel that must be object
WHOLE = Share(ALONE, 1)
WIDEST = 64  #: width of the pictures that are compared [px]
USUAL = 2  #: order of a room's light beside that of the photographs, of which little more is to be told
FINE = 0.3  #: progress from which light that is all there is has its finest order


class Room(nn.Module):
    """The harmonics of `mi_ring.rendering.spherical_harmonics`, and the normal equations of what was seen."""

    which: list[int]  #: harmonics that may not be 0
    given: Tensor  #: (BASIS, 3) as the capture says
    harmonics: Tensor  #: (BASIS, 3) as found
    matrix: Tensor  #: (3, BASIS, BASIS) of the normal equations, by colour
    vector: Tensor  #: (3, BASIS), their right sides

    def __init__(self, given: Tensor, exposure: float, frames: Iterable[str] = ("world",), alone: bool = False) -> None:
        """`exposure`: mean radiance of the object; `frames`: whose harmonics are unknown, the others are as given.

        Both at once could stand for a flash that is elsewhere, and for a reflectance that is another. `alone`: is
        there no other light? Then it is of a finer order, but while the shape is coarse.
        """
        super().__init__()
        self.exposure, self.frames, self.alone = exposure, tuple(frames), alone
        free = harmonics_up_to(MAX_ORDER if alone else USUAL, frames)
        self.which = sorted({*free, *given.abs().sum(1).nonzero()[:, 0].tolist()})
        self.register_buffer("given", given, persistent=False)
        self.register_buffer("harmonics", given.clone())
        self.register_buffer("matrix", torch.zeros(3, BASIS, BASIS))
        self.register_buffer("vector", torch.zeros(3, BASIS))

    def forget(self) -> None:
        """What was seen, but not what was made of it."""
        self.matrix.zero_()
        self.vector.zero_()

    @torch.no_grad()
    def see(
        self, around: GlobalIllumination, predicted: Tensor, observed: Tensor, telling: Tensor, share: Share = WHOLE,
        progress: float = 1.0,
    ) -> None:  # fmt: skip
        """Solve anew, with photographs (N, H, W, 3) as `observed` and as `predicted`; linear.

        The latter with what `prediction.render` makes of the room as it is, as if nothing were in the way of its light.
        `telling` (N, H, W): where they say something of the object; `share`: what they are of all photographs;
        `progress`: of the fit, in [0, 1].
        """

        def pooled(pictures: Tensor, factor: int) -> Tensor:
            means = F.avg_pool2d(pictures.movedim(-1, 1), factor, ceil_mode=True, count_include_pad=False)
            return means.movedim(1, -1)

        # Few paths for many pixels: their noise would make the room darker.
        coarser = max(1, max(around.alpha.shape[1:]) // WIDEST)
        alpha = pooled(around.alpha[..., None], coarser)[..., 0]
        height, width = alpha.shape[1:]

        def small(pictures: Tensor) -> Tensor:
            return pooled(pictures, around.factor * coarser)[:, :height, :width]

        inside = torch.minimum(small(telling.float()[..., None])[..., 0], alpha) > SURELY
        missing, light = small(observed - predicted)[inside], small(observed)[inside].mean(-1)
        which, now = around.harmonics, self.harmonics[around.harmonics]
        basis = torch.stack([pooled(harmonic, coarser)[inside] for harmonic in around.transfer])  # (which, n, 3)
        lit = torch.einsum("jnhwc,jc->nhwc", around.unoccluded, now)
        missing = missing + pooled(lit, coarser)[inside]
        scale = light + DIM * self.exposure
        left = missing - torch.einsum("jnc,jc->nc", basis, now)
        weight = (ROBUST / (left.abs().mean(-1) / scale).clamp(min=ROBUST)) / scale**2
        matrix = torch.einsum("jnc,knc,n->cjk", basis, basis, weight)
        vector = torch.einsum("jnc,nc,n->cj", basis, missing, weight)
        equations = share.sum(torch.cat([matrix, vector[..., None]], -1))
        if not bool(equations.isfinite().all()):  # the renderer may have a pixel that is none, and this is kept
            return
        self.matrix *= MEMORY
        self.vector *= MEMORY
        self.matrix[:, torch.tensor(which)[:, None], which] += equations[..., :-1]
        self.vector[:, which] += equations[..., -1]
        told = self.matrix.diagonal(dim1=1, dim2=2)[:, which].mean(1)
        ridge = RIDGE * told[:, None, None] * torch.eye(BASIS).to(self.matrix)
        if bool((ridge.amax((1, 2)) > 0).all()):
            free = harmonics_up_to(MAX_ORDER if self.alone and progress >= FINE else USUAL, self.frames)
            right = self.vector[..., None] - self.matrix @ self.given.T[..., None]
            more = torch.linalg.solve((self.matrix + ridge)[:, free][:, :, free], right[:, free])[..., 0]
            self.harmonics = self.given.clone()
            self.harmonics[free] += more.T
            # In the mean no room takes light away: where it would, what is too bright is another part of the model.
            self.harmonics[:, self.harmonics[0] < 0] = 0.0
