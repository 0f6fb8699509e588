"""The problem that a fit solves: photographs, lights and settings. It does not change during the fit."""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import torch

from mi_ring.capture.capture import Capture
from mi_ring.capture.loading import recompute_normals
from mi_ring.capture.pairs import camera_numbers
from mi_ring.capture.reduction import WIDTH, reduced
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.lighting import Lighting, environment_as_harmonics, with_lighting
from mi_ring.fitting.processes import Processes, current
from mi_ring.system.machine import device


@dataclass(frozen=True)
class Problem:
    """A capture, the lights that a fit assumes, and the settings of the fit."""

    given: Capture  #: the capture as it was handed in, with photographs of any size
    capture: Capture  #: lit by `lighting`
    seen: Capture  #: the photographs of `capture` that are fitted
    scene: mi.Scene  #: without the environment, if `environment` has it
    config: Config
    lighting: Lighting
    usual_loss: bool  #: Are `rgb` and `mask` the default terms of the loss?
    environment: np.ndarray | None  #: (BASIS, 3) of the scene's environment, see `environment_as_harmonics`
    fitted: np.ndarray  #: indices of the photographs that are fitted
    held_out: np.ndarray  #: indices of the others
    exposure: float  #: mean radiance of the object in the fitted photographs
    processes: Processes
    device: torch.device

    @classmethod
    def of(cls, capture: Capture, config: Config, lighting: Lighting, usual_loss: bool) -> "Problem":
        """Prepare the problem of a fit. Large photographs are reduced, and some photographs are held out.

        A deterministic fit changes the normals of the scene's meshes.

        `lighting`: the light that the fit assumes. `usual_loss`: its terms `rgb` and `mask` are the default ones.
        Raises InputError if no photograph is left to fit, or if the object is black, or clipped, in all photographs.
        """
        if config.deterministic:
            recompute_normals(capture.scene)
        given, capture = capture, reduced(capture, max(WIDTH, *config.widths))
        held_out = held_out_photographs(capture, config.holdout)
        fitted = np.setdiff1d(np.arange(len(capture)), held_out)
        as_lit, scene, environment = environment_as_harmonics(with_lighting(capture, lighting))
        seen = as_lit.part(fitted) if len(held_out) else as_lit
        return cls(given, as_lit, seen, scene, config, lighting, usual_loss, environment, fitted, held_out,
                   seen.exposure(), current(), device())  # fmt: skip


def held_out_photographs(capture: Capture, every: int) -> np.ndarray:
    """Choose the photographs that are held out of the fit: every n-th from index n // 2 on, with n = `every`.

    Photographs of one camera, with and without their own light, are held out together. Returns their indices. If n is
    0, no photograph is held out. Raises InputError if n > 0 and no photograph, or every photograph, would be held out.
    """
    several, cameras = len(capture), camera_numbers(capture)
    chosen = np.unique(cameras)[every // 2 :: every] if every else np.arange(0)
    found = np.flatnonzero(np.isin(cameras, chosen))
    if every and several < 2:
        raise InputError(f"{capture.path}: --holdout: there is one photograph alone; leave it out")
    if every and not 0 < len(found) < several:
        raise InputError(f"{capture.path}: --holdout: is {every}, which keeps {len(found)} of {several} photographs "
                         f"out; give 2 to {2 * several - 1}")  # fmt: skip
    return found
