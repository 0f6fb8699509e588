"""The light of the room as an unknown: spherical harmonics, by linear least squares in the course of a fit."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.fitting.processes import ALONE, Share
from mi_ring.rendering.bridge import Surroundings
from mi_ring.rendering.rooms import BASIS, FRAMES

MEMORY = 0.95  #: weight of what was seen before, by iteration: the surface was another
RIDGE = 0.01  #: pull toward what the capture says, by the mean of what the photographs say of a harmonic
DIM = 0.3  #: radiance, in units of the exposure, below which errors count no more than there
ROBUST = 0.2  #: relative error from which it counts as its root
SURELY = 0.99  #: share of a pixel that must be object
WHOLE = Share(ALONE, 1)
WIDEST = 64  #: width of the pictures that are compared [px]


class Room(nn.Module):
    """The harmonics of `mi_ring.rendering.rooms`, and the normal equations of all that was seen, which it forgets."""

    given: Tensor  #: (BASIS, 3) as the capture says
    harmonics: Tensor  #: (BASIS, 3) as found
    matrix: Tensor  #: (3, BASIS, BASIS) of the normal equations, by colour
    vector: Tensor  #: (3, BASIS), their right sides

    def __init__(self, given: Tensor, exposure: float, frames: Iterable[str] = ("world",)) -> None:
        """`exposure`: mean radiance of the object; `frames`: whose harmonics are unknown, the others are as given.

        Both at once could stand for a flash that is elsewhere, and for a reflectance that is another.
        """
        super().__init__()
        self.exposure = exposure
        self.free = sorted({k for frame in frames for k in FRAMES[frame]})
        self.register_buffer("given", given, persistent=False)
        self.register_buffer("harmonics", given.clone())
        self.register_buffer("matrix", torch.zeros(3, BASIS, BASIS))
        self.register_buffer("vector", torch.zeros(3, BASIS))

    @torch.no_grad()
    def see(
        self, around: Surroundings, predicted: Tensor, observed: Tensor, telling: Tensor, share: Share = WHOLE
    ) -> None:
        """Solve anew, with photographs (N, H, W, 3) as `observed` and as `predicted` without the room; linear.

        `telling` (N, H, W): where they say something of the object; `share`: what they are of all photographs.
        """
        assert around.harmonics is not None

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
        basis = torch.stack([pooled(harmonic, coarser)[inside] for harmonic in around.harmonics])  # (BASIS, n, 3)
        scale = light + DIM * self.exposure
        left = missing - torch.einsum("jnc,jc->nc", basis, self.harmonics)
        weight = (ROBUST / (left.abs().mean(-1) / scale).clamp(min=ROBUST)) / scale**2
        matrix = torch.einsum("jnc,knc,n->cjk", basis, basis, weight)
        vector = torch.einsum("jnc,nc,n->cj", basis, missing, weight)
        equations = share.sum(torch.cat([matrix, vector[..., None]], -1))
        self.matrix = MEMORY * self.matrix + equations[..., :-1]
        self.vector = MEMORY * self.vector + equations[..., -1]
        ridge = RIDGE * self.matrix.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(BASIS).to(self.matrix)
        if bool((ridge.amax((1, 2)) > 0).all()):
            free = self.free
            right = self.vector[..., None] - self.matrix @ self.given.T[..., None]
            more = torch.linalg.solve((self.matrix + ridge)[:, free][:, :, free], right[:, free])[..., 0]
            self.harmonics = self.given.clone()
            self.harmonics[free] += more.T
            # In the mean no room takes light away: where it would, what is too bright is another part of the model.
            self.harmonics[:, self.harmonics[0] < 0] = 0.0
