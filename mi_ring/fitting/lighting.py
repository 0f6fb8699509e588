"""What lights the photographs of a fit, where that is not what the scene says.

How bright an unknown light is and how much the object reflects cannot be told apart: the object's albedo is taken to be
about one half, in each colour.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from mi_ring.capture.calibrated import with_calibration
from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import ALBEDO
from mi_ring.fitting.config import Config
from mi_ring.rendering.lights import Light
from mi_ring.rendering.rooms import BASIS, frames_of
from mi_ring.rendering.shading import lamps
from mi_ring.system.progress import progress

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit

COARSE: dict[str, Any] = {"levels": (3,), "widths": (64,), "shares": (1.0,), "iterations": 60}  #: settings of a trial
LAST = 12  #: iterations of a trial that tell how well it explains the photographs
#: What the scene says is believed unless another light leaves less of its error than this. An environment that is fixed
#: in the camera looks much like a flash.
BETTER = {"environment": 0.9, "turntable": 0.6, "lamp": 0.9}


Kind: TypeAlias = Literal["capture", "environment", "turntable", "lamp"]


class Lighting(NamedTuple):
    """The lights of the photographs, as a fit begins."""

    kind: Kind  #: of `Config.light`, but for "auto"
    place: tuple[float, float, float] | None = None  #: of a lamp [scene units]


def lighting_of(capture: Capture, config: Config, trial: Callable[[Capture, Config], "Fit"]) -> Lighting:
    """What `Config.light` asks for; what is to be found out coarse fits by `trial` tell.

    Raises InputError where nothing lights the object, and for a BSDF that shows no environment.
    """
    unlit = capture.photographs.dark and capture.photographs.room is None and not lamps(capture.scene)
    if unlit and config.light == "capture":
        raise InputError(f"{capture.path}: emitter: nothing lights the object; give lights, or --light auto")
    if config.light != "capture" and not hasattr(capture.shape.bsdf(), "lobes"):
        raise InputError(f"{capture.path}: bsdf: --light {config.light} is for cooktorrance alone; give that")
    if config.light in ("capture", "environment", "turntable"):
        return Lighting(config.light)

    def tried(light: Kind) -> tuple[float, "Fit"]:
        """The error that a coarse fit leaves, and the fit."""
        fit = trial(capture, replace(config, **COARSE, light=light, holdout=0, refine=("none",)))
        iterations = progress(fit, f"trying --light {light}", fit.iterations, unit="iteration")
        errors = [it.terms["rgb"] for it in iterations]
        return float(np.mean(errors[-LAST:])), fit

    environment = tried("environment")
    if config.light == "lamp":
        return Lighting("lamp", brightest(environment[1]))
    errors: dict[Kind, float] = {
        "environment": environment[0],
        "turntable": tried("turntable")[0],
        "lamp": tried("lamp")[0],
    }
    likely = list(errors)
    if not unlit:
        errors["capture"] = tried("capture")[0]
        likely = [light for light in likely if errors[light] < BETTER[light] * errors["capture"]] or ["capture"]
    best = min(likely, key=lambda light: errors[light])
    left = ", ".join(f"{light} {error:.3g}" for light, error in errors.items())
    print(f"Light: taken to be --light {best}; errors that coarse fits leave: {left}")
    return Lighting(best, brightest(environment[1]) if best == "lamp" else None)


def brightest(fit: "Fit") -> tuple[float, float, float]:
    """Where a lamp would be that is as far from the object as the cameras, by the environment that a fit has found."""
    assert fit.calibration is not None
    center = fit.ring.center.numpy(force=True)
    first = fit.calibration.room.harmonics[1:4].mean(1).numpy(force=True)
    toward = -first[[2, 0, 1]] * [1, 1, -1]  # harmonics of degree 1 are as −y, z, −x
    away = np.median([np.linalg.norm(sensor.camera.position - center) for sensor in fit.capture.sensors])
    x, y, z = (center + away * toward / max(np.linalg.norm(toward), 1e-12)).tolist()
    return x, y, z


def lit(capture: Capture, lighting: Lighting) -> Capture:
    """The capture under these lights: an environment is grey and alike from all sides to begin with, a lamp white."""
    if lighting.kind == "capture":
        return capture
    cameras, exposure = [sensor.camera for sensor in capture.sensors], capture.exposure()
    if lighting.place:
        place, (center, _) = np.array(lighting.place), capture.sphere()
        strength = math.pi * exposure / ALBEDO * np.linalg.norm(place - center) ** 2
        return with_calibration(capture, cameras, [Light("point", place, np.full(3, strength))] * len(cameras),
                                falloff=[0.0] * len(cameras))  # fmt: skip
    harmonics = np.zeros((BASIS, 3))
    harmonics[0] = math.sqrt(4 * math.pi) * exposure / ALBEDO
    dark = [Light("point", camera.position, np.zeros(3)) for camera in cameras]
    return with_calibration(capture, cameras, dark, room=harmonics, falloff=[0.0] * len(cameras))


def frames(capture: Capture, lighting: Lighting) -> Collection[str]:
    """In which axes the unknown light of a room is fixed."""
    return {"environment": ["world"], "turntable": ["camera"]}.get(lighting.kind, frames_of(capture.scene))
