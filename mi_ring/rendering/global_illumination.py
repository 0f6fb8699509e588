"""Interreflection and the light of the room: rendered in small pictures, which are enlarged for the photographs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.images import blur
from mi_ring.rendering.bridge import evaluated
from mi_ring.rendering.indirect_light import BOUNCES, render_indirect
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface

SMALL_WIDTH, PATHS = 32, 16  #: of the small pictures: width [px], and paths per pixel
TABLE_WIDTH, TABLE_PATHS = 128, 3  #: the same with a table, whose pattern glossy surfaces mirror


@dataclass(frozen=True)
class GlobalIllumination:
    """Interreflection and room light of N photographs, rendered as small pictures of h × w pixels.

    Methods enlarge these to H × W pixels, the size at which direct light is rendered. `transfer` is the radiance
    transfer of "Precomputed Radiance Transfer" (Sloan, Kautz and Snyder 2002).
    """

    radiance: Tensor  #: (N, h, w, 3) of interreflection
    rows: list[int]  #: rows of `Photographs.room_strengths`, n of them: harmonics and lobes of the room light
    #: (n, N, h, w, 3) radiance in a room whose radiance is one of these harmonics or lobes; 0 if the room's light does
    #: not reach a photograph
    transfer: Tensor
    #: (n, N, h, w, 3) once reflected light, that of harmonics as if nothing hid the room from the surface
    unoccluded: Tensor
    alpha: Tensor  #: (N, h, w) coverage
    coverage: Tensor  #: (N, H, W) coverage in the large pictures
    factor: int  #: how many times larger these are

    @classmethod
    def of(
        cls, surface: Surface, photographs: Photographs, coverage: Tensor, seed: int, width: int | None = None,
        paths: int | None = None, indirect: bool = True, rows: Sequence[int] = (),
    ) -> "GlobalIllumination":  # fmt: skip
        """Render small pictures of interreflection and room light for the current surface, without gradients.

        `photographs`: the N photographs. `coverage` (N, H, W): their coverage, rendered at full size. `width`: largest
        side of the small pictures [px]. `paths`: paths per pixel. If these are None: 32 px and 16 paths, or 128 px and
        3 paths if the scene has a table. This light varies slowly, so a few good pixels are better than many noisy
        ones. `indirect`: False: no interreflection; the room light then has its occlusion, but is reflected only once.
        `rows`: see the attribute; empty: no room light.
        """
        bounces = BOUNCES if indirect else 1
        table = surface.table if indirect else None  # a table reflects light; alone it would hide the room's
        usual = (SMALL_WIDTH, PATHS) if table is None else (TABLE_WIDTH, TABLE_PATHS)
        width, paths = width or usual[0], paths or usual[1]
        factor = -(-max(photographs.size) // width)
        small = photographs.select(np.array(photographs.index), photographs.size, factor).in_units(surface.unit)
        channels = evaluated(render_indirect(surface.scene, small, paths, seed, bounces, rows, table))
        *rgb, alpha = (channel.reshape(small.shape) for channel in channels[:4])
        basis = channels[4:] or [alpha.new_zeros(0)]
        transfer, unoccluded = torch.cat(basis).reshape(2, len(rows), 3, *small.shape).movedim(2, -1)
        reached = photographs.in_room[np.array(photographs.index)]
        if not reached.all():
            transfer, unoccluded = (part * torch.from_numpy(reached).to(part)[:, None, None, None]
                                    for part in (transfer, unoccluded))  # fmt: skip
        return cls(torch.stack(rgb, -1), list(rows), transfer, unoccluded, alpha, coverage, factor)

    @property
    def interreflection(self) -> Tensor:
        """Linear radiance (N, H, W, 3) that interreflection adds to the photographs at full size.

        Interreflection of room light is not included.
        """
        return self.upsampled(self.radiance)

    def room_light(self, room: Tensor) -> Tensor:
        """Compute the linear radiance (N, H, W, 3) that room light adds to the photographs at full size.

        It includes the shadows of the room light. `room`: as `Photographs.room_strengths`; only those in
        `rows` count.
        """
        return self.upsampled(torch.einsum("jnhwc,jc->nhwc", self.transfer, room[self.rows]))

    def occlusion(self, room: Tensor) -> Tensor:
        """Compute what to add to photographs at full size that contain room light that is reflected once.

        Returns linear radiance (N, H, W, 3): the shadows of harmonics, as negative values, and interreflection. `room`:
        as `Photographs.room_strengths`; only those in `rows` count.
        """
        difference = self.transfer - self.unoccluded
        return self.upsampled(torch.einsum("jnhwc,jc->nhwc", difference, room[self.rows]))

    def upsampled(self, rgb: Tensor) -> Tensor:
        """Enlarge small pictures `rgb` (N, h, w, 3) to the photographs' full size (N, H, W, 3), with sharp outlines.

        The outlines come from `coverage`, and the result has gradients with respect to `coverage` only: this light acts
        on the outline, but not on shape and material. A fit takes it into account for shape and material by its
        iterations, as in "Shape from Interreflections" (Nayar, Ikeuchi and Kanade, IJCV 1991).
        """
        images = torch.cat([rgb, self.alpha[..., None]], -1).movedim(-1, 1)
        images = blur(images.flatten(0, 1), 1.0).reshape(images.shape)
        images = F.interpolate(images, scale_factor=self.factor, mode="bilinear", align_corners=False)
        below, right = self.coverage.shape[1] - images.shape[2], self.coverage.shape[2] - images.shape[3]
        images = F.pad(images, (0, right, 0, below), mode="replicate")
        return (images[:, :3] / images[:, 3:].clamp(min=1e-2)).movedim(1, -1) * self.coverage[..., None]
