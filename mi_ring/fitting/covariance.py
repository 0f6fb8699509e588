"""How sure a fit is of what it has refined besides surface and material, these taken as they are.

Least squares around what was found: how the photographs would change with each unknown, beside how far predictions are
from them, gives the covariance ("Bundle Adjustment: A Modern Synthesis", Triggs et al. 2000, section 8.1, there called
dispersion).
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.fitting.calibration import UNKNOWNS, Calibration
from mi_ring.fitting.terms import perceived
from mi_ring.rendering import bridge
from mi_ring.rendering.photographs import Photographs

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit

WIDTH, SPP = 96, 8  #: of the pictures that are compared
RECORDED = "curve", "contrast", "vignetting"  #: what changes nothing of the light that reaches the camera
STEP = 0.2  #: of the unknowns, to either side, in their priors' standard deviations
BLOCK = 8  #: pixels across which errors are taken to go together


class Entries:
    """Where the unknowns of a calibration have their place in one vector."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration, self.first, self.count = calibration, {}, 0
        for name in calibration.widths:
            self.first[name] = self.count
            self.count += getattr(calibration, name).numel()

    def rows(self, name: str, index: np.ndarray) -> list[np.ndarray]:
        """Which rows of an unknown are those of each photograph."""
        lens = dict.fromkeys(("focal", "principal", "distortion"), self.calibration.lens)
        shared = lens | {"light": self.calibration.place}
        if name in shared:
            return [shared[name][index].numpy()]
        if name in UNKNOWNS["lamps"]:  # all of them light all photographs
            return [np.full_like(index, k) for k in range(len(getattr(self.calibration, name)))]
        return [index if getattr(self.calibration, name).ndim else np.zeros_like(index)]

    def of(self, index: np.ndarray) -> list[tuple[str, int, np.ndarray]]:
        """Name, component and place (n,) of all that photographs depend on."""
        result = []
        for name in self.calibration.widths:
            unknown = getattr(self.calibration, name)
            components = unknown.shape[1] if unknown.ndim == 2 else 1
            for row in self.rows(name, index):
                first = self.first[name] + components * row
                result += [(name, k, first + k) for k in range(components)]
        return result


@torch.no_grad()
def deviations(fit: "Fit") -> dict[str, np.ndarray]:
    """Standard deviation of each unknown of `fit.calibration` in its own unit, shaped like it; not of the room's light.

    The surface must have been shown.
    """
    calibration = fit.calibration
    assert calibration is not None
    entries = Entries(calibration)
    if not entries.count:
        return {}
    colours, outlines = Equations(entries.count), Equations(entries.count)
    for index in fit.capture.together(fit.fitted):
        scale = -(-fit.capture.shots[index[0]].size[0] // WIDTH)
        compare(fit, calibration, index, scale, entries, colours, outlines)
    calibration.relight(fit.surface)  # as it was
    precision = np.eye(entries.count) + colours.information() + outlines.information()
    spread = np.sqrt(np.diag(np.linalg.inv(precision)))
    return {
        name: width * spread[entries.first[name] :][: getattr(calibration, name).numel()]
        .reshape(getattr(calibration, name).shape)
        for name, width in calibration.widths.items()
    }  # fmt: skip


class Equations:
    """The normal equations of all photographs, and the variance of what they leave unexplained."""

    def __init__(self, count: int) -> None:
        self.matrix, self.squares, self.pixels = np.zeros((count, count)), 0.0, 0

    def add(self, slopes: Tensor, error: Tensor, telling: Tensor, places: np.ndarray) -> None:
        """One photograph: how (K, H, W, C) it changes with the unknowns at `places` (K,), what is unexplained of it.

        `error` (H, W, C); `telling` (H, W): where.
        """
        slopes = slopes[:, telling].flatten(1).double()
        np.add.at(self.matrix, np.ix_(places, places), (slopes @ slopes.T).numpy())
        height, width, channels = error.shape
        error = torch.where(telling[..., None], error, 0.0).double()
        error = F.pad(error, (0, 0, 0, -width % BLOCK, 0, -height % BLOCK))
        blocks = error.unfold(0, BLOCK, BLOCK).unfold(1, BLOCK, BLOCK).sum((-2, -1))
        self.squares += float(blocks.square().sum())
        self.pixels += channels * int(telling.sum())

    def information(self) -> np.ndarray:
        """How precisely these photographs say what the unknowns are: (N, N)."""
        return self.matrix * (self.pixels / self.squares if self.squares else 0.0)


def compare(
    fit: "Fit", calibration: Calibration, index: np.ndarray, scale: int, entries: Entries, colours: Equations,
    outlines: Equations,
) -> None:  # fmt: skip
    """Photographs `index`, all of one size, with their predictions, at what was found and beside it."""
    seen = fit.capture.observe(index, scale)
    photographs = fit.capture.selected(index, scale)
    room = calibration.roomlight().cpu()
    # Where it is the only light it is part of what moves.
    photographs = replace(photographs, room=room.double().numpy() if photographs.dark else None)

    def calibrated() -> Photographs:
        calibration.relight(fit.surface)
        return bridge.calibrated(photographs, [tensor.to(fit.device) for tensor in calibration.scaled(scale)])

    def direct() -> tuple[Tensor, Tensor]:
        shadows = fit.config.shadows and fit.capture.shadows
        return bridge.draw(fit.surface, calibrated(), SPP, shadows=shadows, in_the_way=False)

    lit, coverage = direct()
    bounced, roomlight = torch.zeros_like(lit), torch.zeros_like(lit)
    if fit.ring.indirect or room.any():
        around = bridge.surroundings(fit.surface, calibrated(), coverage.to(fit.device), 1, spp=SPP,
                                     indirect=fit.ring.indirect, room=calibration.room.which)  # fmt: skip
        bounced = around.interreflection.cpu() if fit.ring.indirect else bounced
        added = around.in_the_way if photographs.dark else around.room
        roomlight = added(room.to(fit.device)).cpu() if room.any() else roomlight

    def picture(lit: Tensor, bounced: Tensor = bounced, gain: Tensor | float = 1.0) -> Tensor:
        light = gain * (lit + bounced + roomlight)
        return perceived(calibration.recorded(light, index, scale), fit.exposure, "log")

    slopes, unknowns = [], entries.of(index)  # of colours (n, H, W, 3) and coverage (n, H, W)
    for name, k, places in unknowns:
        sides = []
        for step in (STEP, -STEP):
            factor = float(np.exp(step * calibration.widths[name]))
            if name in ("power", "gain"):  # not by its unknowns, whose mean does not count
                colour = torch.ones(3)
                colour[k] = factor
                by_lights = name == "power"
                rgb = picture(lit * colour, bounced * colour) if by_lights else picture(lit, gain=colour)
                sides.append((rgb, coverage))
            elif name == "scale":
                sides.append((picture(lit, bounced / factor), coverage))
            else:
                unknown = getattr(calibration, name)
                found = unknown.detach().clone()
                unknown.view(-1)[torch.from_numpy(np.unique(places - entries.first[name]))] += step
                rgb, covered = (lit, coverage) if name in RECORDED else direct()
                sides.append((picture(rgb), covered))
                unknown.copy_(found)
        slopes.append([(plus - minus) / (2 * STEP) for plus, minus in zip(*sides)])
    changing, covering = (torch.stack(part) for part in zip(*slopes))
    own = np.stack([places for *_, places in unknowns], 1)
    error, off = picture(lit) - perceived(seen.rgb, fit.exposure, "log"), coverage - seen.mask
    surely = seen.surely(coverage) & ~seen.clipped.any(-1)
    known = torch.ones_like(surely) if seen.valid is None else seen.valid.bool()
    outlined = (covering.abs().amax(0) > 0) | (off != 0)  # beside and amid the object nothing can be wrong
    for n in range(len(index)):
        colours.add(changing[:, n], error[n], surely[n], own[n])
        if seen.masked[n] and fit.capture.threshold is None:
            outlines.add(covering[:, n, ..., None], off[n, ..., None], (known & outlined)[n], own[n])
