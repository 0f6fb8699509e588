"""Compares photographs with their predictions: errors, and the derivatives with respect to all unknowns."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.fitting.local_unknowns import Patches
from mi_ring.fitting.losses import perceived
from mi_ring.fitting.normal_equations import Equations, Layout
from mi_ring.fitting.problem import Problem
from mi_ring.rendering import prediction
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.lobe_light import LobeLight
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.plain_mesh import NORMALS, POSITIONS

SPP = 4  #: samples per pixel
ROOM, DIM = 10.0, 0.01  #: prior and step of the room's light [exposure]
CHANGED = 0.5, 2.0  #: least and greatest factor of other light: at grazing angles the quotient is noisy
STEP = 0.2  #: of the unknowns to either side [standard deviations of their priors]


@dataclass(frozen=True)
class Group:
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

    def local_slopes(self, lit: Tensor, picture: Callable[[Tensor, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Return derivatives with respect to the unknowns of each pixel's patch: (L, n, H, W, 3), and (1, n, H, W).

        The first are of `picture`, a function of direct light and of a factor of all other light, which an unknown of
        the material changes as it changes direct light `lit`. The second are of the coverage, with respect to the
        displacement.
        """
        moving = torch.zeros(0)
        slopes: list[Tensor] = []
        for unknown in self.patches.unknowns:
            sides: list[tuple[Tensor, Tensor]] = []
            for step in (STEP, -STEP):
                with self.patches.changed(unknown, step):
                    changed, coverage = self.direct()
                factor = torch.ones_like(lit)
                if unknown.name not in (NORMALS, POSITIONS):
                    factor = torch.where(lit > 0, changed / lit, 1.0).clamp(*CHANGED)
                sides.append((picture(changed, factor), coverage))
            slope, covering = ((plus - minus) / (2 * STEP) for plus, minus in zip(*sides))
            moving = covering if unknown.name == POSITIONS else moving
            slopes += [slope * channel for channel in torch.eye(3)] if unknown.channels == 3 else [slope]
        return torch.stack(slopes), moving[None]


def lobe_fluxes(photographs: Photographs) -> Tensor:
    """Return the fluxes (n, 3) of the lobes of the room light."""
    return torch.zeros(0, 3) if photographs.lobes is None else torch.from_numpy(photographs.lobes.flux).float()


def compare(at: Group, layout: Layout, colours: Equations, silhouettes: Equations) -> None:
    """Compare the photographs of the group `at` with their predictions, and add the result to normal equations.

    Errors of colours are added to `colours`, errors of silhouettes to `silhouettes`. Both are changed in place.
    `layout`: the places of all unknowns in the vector of parameters.
    """
    problem, calibration, index = at.problem, at.calibration, at.index
    unknowns = layout.of(index)
    if not (unknowns or layout.room):
        return  # these photographs tell nothing
    seen = problem.capture.observe(index, at.scale)
    lit, coverage = at.direct()
    bounced, room_light, transfer = at.other(lit, coverage)

    def picture(
        lit: Tensor, bounced: Tensor = bounced, gain: Tensor | float = 1.0, reflected: Tensor | float = 1.0
    ) -> Tensor:
        light = gain * (lit + reflected * (bounced + room_light))
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

    slopes = []  # of colours (n, H, W, 3) and coverage (n, H, W)
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
    local, moving = at.local_slopes(lit, lambda changed, factor: picture(changed, reflected=factor))
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
