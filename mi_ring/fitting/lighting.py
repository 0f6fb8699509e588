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
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import OF_LIGHTS
from mi_ring.fitting.config import Config
from mi_ring.rendering.lights import Light
from mi_ring.rendering.rooms import BASIS, frames_of, without_environment
from mi_ring.rendering.shading import lamps
from mi_ring.system.progress import progress

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit

#: Settings of a trial: those that decide alike, whatever the fit's own are.
COARSE: dict[str, Any] = {
    "levels": (3,), "widths": (64,), "shares": (1.0,), "iterations": 60, "holdout": 0, "weights": {},
    **{name: getattr(Config(), name) for name in (
        "loss", "optimizer", "learning_rate", "muon_rate", "decay", "velocity_decay", "steps", "spp", "batch")},
}  # fmt: skip
LAST = 12  #: iterations of a trial that tell how well it explains the photographs
ALIKE = 1.1  #: times that lights may differ in strength without a word
#: What the scene says is believed unless another light leaves less of its error than this. An environment that is fixed
#: in the camera looks much like a flash.
BETTER = {"environment": 0.9, "turntable": 0.6, "lamp": 0.9}


Kind: TypeAlias = Literal["capture", "environment", "turntable", "lamp"]


class Lighting(NamedTuple):
    """The lights of the photographs, as a fit begins."""

    kind: Kind  #: of `Config.light`, but for "auto"
    place: tuple[float, float, float] | None = None  #: of a lamp [scene units]


def require_unknown(capture: Capture, config: Config) -> None:
    """Raise InputError for what does not go with `Config.light`."""
    others, own = lamps(capture.scene), OF_LIGHTS & set(config.refine)
    if config.light == "capture":
        if own and capture.photographs.dark:
            raise InputError(f"{capture.path}: --refine {min(own)}: is of the photographs' own lights, of which there "
                             "are none; leave it out")  # fmt: skip
        if unlit(capture) and not others:
            raise InputError(f"{capture.path}: emitter: nothing lights the object; give lights, or --light auto")
        return
    if not hasattr(capture.shape.bsdf(), "lobes"):
        raise InputError(f"{capture.path}: bsdf: --light {config.light} is for cooktorrance alone; give that")
    if others:
        raise InputError(f"{capture.path}: emitter: --light {config.light} finds all the light there is; take the "
                         "lamps of the scene out, or leave --light out")  # fmt: skip
    if any(sensor.ambient for sensor in capture.sensors):
        raise InputError(f"{capture.path}: ambient: is subtracted, which leaves the photographs' own lights alone; "
                         f"leave out --light {config.light}, or `ambient` in all photographs")  # fmt: skip
    wrong = own & {"falloff"} if config.light == "lamp" else own
    if wrong:
        raise InputError(f"--refine {min(wrong)}: is of the photographs' own lights, in the place of which --light "
                         f"{config.light} puts another; leave it out")  # fmt: skip


def unlit(capture: Capture) -> bool:
    """Have photographs neither lights of their own nor a room?"""
    return capture.photographs.dark and capture.photographs.room is None


def lighting_of(capture: Capture, config: Config, trial: Callable[..., "Fit"]) -> Lighting:
    """What `Config.light` asks for; what is to be found out coarse fits tell, made by `trial`.

    Raises InputError where nothing lights the object, and for what does not go together.
    """
    require_unknown(capture, config)
    exposed = exposures(capture)
    if config.light != "capture" and exposed.max() > ALIKE * exposed.min():
        print(f"Light: those of the scene differ in strength, by up to {exposed.max() / exposed.min():.2g} times, "
              "which an unknown light takes to be how the photographs were exposed")  # fmt: skip
    if config.light in ("capture", "environment", "turntable"):
        return Lighting(config.light)

    def tried(lighting: Lighting) -> tuple[float, "Fit"]:
        """The error that a coarse fit leaves, and the fit."""
        refine = config.refine if lighting.kind == "capture" else recording(config)
        fit = trial(capture, replace(config, **COARSE, light=lighting.kind, refine=refine), lighting=lighting)
        iterations = progress(fit, f"trying --light {lighting.kind}", fit.iterations, unit="iteration")
        errors = [it.terms["rgb"] for it in iterations]
        return float(np.nan_to_num(np.mean(errors[-LAST:]), nan=np.inf)), fit

    environment, fit = tried(Lighting("environment"))
    lamp = Lighting("lamp", brightest(fit))
    if config.light == "lamp":
        return lamp
    found = {lighting: tried(lighting)[0] for lighting in (Lighting("turntable"), lamp)}
    found[Lighting("environment")] = environment
    likely = list(found)
    if not unlit(capture):
        capture_error = found[Lighting("capture")] = tried(Lighting("capture"))[0]
        likely = [one for one in likely if found[one] < BETTER[one.kind] * capture_error] or [Lighting("capture")]
    best = min(likely, key=lambda lighting: found[lighting])
    left = ", ".join(f"{lighting.kind} {error:.3g}" for lighting, error in found.items())
    print(f"Light: taken to be --light {best.kind}; errors that coarse fits leave: {left}")
    return best


def recording(config: Config) -> tuple[Any, ...]:
    """What a coarse fit under an unknown light refines of what `Config.refine` has: exposures alone."""
    return tuple(name for name in config.refine if name in ("auto", "gain")) or ("none",)


def exposures(capture: Capture) -> np.ndarray:
    """(P, 3) how strong the photographs' own lights are, by their mean: under one light that is how they were exposed.

    1 where the scene does not say.
    """
    strengths = capture.photographs.lights.rgb()
    kinds = capture.photographs.lights.is_finite()
    if kinds.any() != kinds.all() or not (strengths > 0).all():
        return np.ones_like(strengths)
    return strengths / strengths.mean(0)


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
                                falloff=[0.0] * len(cameras), gains=exposures(capture))  # fmt: skip
    harmonics = np.zeros((BASIS, 3))
    harmonics[0] = math.sqrt(4 * math.pi) * exposure / ALBEDO
    dark = [Light("point", camera.position, np.zeros(3)) for camera in cameras]
    return with_calibration(capture, cameras, dark, room=harmonics, falloff=[0.0] * len(cameras),
                            gains=exposures(capture))  # fmt: skip


def smoothed(capture: Capture) -> tuple[Capture, Any, np.ndarray | None]:
    """The capture with the environment that its scene says among its room's harmonics, and the scene without it.

    And these harmonics (BASIS, 3); None if there are none. What a surface reflects of them has no noise. That the
    environment may be seen beside the object, which is not predicted then, does not matter where all photographs have
    masks; else it stays as it is, to be sampled, and where the reflectance is another than `cooktorrance`.
    """
    if not all(capture.masks.given) or not hasattr(capture.shape.bsdf(), "lobes"):
        return capture, capture.scene, None
    scene, known = without_environment(capture.scene)
    if known is None:
        return capture, scene, None
    room = known if capture.photographs.room is None else capture.photographs.room + known
    return replace(capture, photographs=replace(capture.photographs, room=room)), scene, known


def frames(capture: Capture, lighting: Lighting) -> Collection[str]:
    """In which axes the unknown light of a room is fixed."""
    own = {"environment": ["world"], "lamp": ["world"], "turntable": ["camera"]}
    return own.get(lighting.kind, frames_of(capture.scene))
