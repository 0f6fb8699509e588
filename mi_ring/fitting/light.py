"""What lights the photographs of a fit, where that is not what the scene says."""

import math

import numpy as np

from mi_ring.capture.calibrated import in_the_dark
from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import ALBEDO
from mi_ring.fitting.config import Config
from mi_ring.rendering.rooms import BASIS, frames_of
from mi_ring.rendering.shading import lamps


def lit(capture: Capture, config: Config) -> Capture:
    """The capture as `Config.light` has it: an unknown environment is grey and alike from all sides to begin with.

    How bright it is and how much the object reflects cannot be told apart: the object's albedo is taken to be about
    one half, in each colour.
    """
    if config.light == "capture":
        if capture.photographs.dark and capture.photographs.room is None and not lamps(capture.scene):
            raise InputError(f"{capture.path}: emitter: nothing lights the object; give lights, or --light environment")
        return capture
    harmonics = np.zeros((BASIS, 3))
    harmonics[0] = math.sqrt(4 * math.pi) * capture.exposure() / ALBEDO
    return in_the_dark(capture, harmonics)


def frames(capture: Capture, config: Config) -> set[str]:
    """In which axes the unknown light of a room is fixed."""
    return {"environment": {"world"}, "turntable": {"camera"}}.get(config.light) or frames_of(capture.scene)
