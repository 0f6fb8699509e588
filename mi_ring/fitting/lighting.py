"""What lights the photographs of a fit, where that is not what the scene says.

How bright an unknown light is and how much the object reflects cannot be told apart: the object's albedo is taken to be
about one half, in each colour.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from scipy.optimize import nnls

from mi_ring.capture.calibrated import with_calibration
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import OF_LIGHTS
from mi_ring.fitting.config import Config
from mi_ring.rendering.lights import Light
from mi_ring.rendering.rooms import BASIS, directions_of, frames_of, harmonics_in, without_environment
from mi_ring.rendering.shading import shared_emitters
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
BETTER = {"environment": 0.9, "turntable": 0.6, "lamps": 0.9}
MOST = 3  #: lamps
FEWER = 1.05  #: Fewer lamps are believed that leave no more of the error of the best than this.
SHOWN = 1, 2 / 3, 1 / 4  #: of the harmonics of each degree by a diffuse surface
FAINT = 0.02  #: the least strength of a lamp to begin with, by the first
ROWS = 16  #: of a map of the directions in which lamps are sought

Kind: TypeAlias = Literal["capture", "environment", "turntable", "lamps"]


class Lighting(NamedTuple):
    """The lights of the photographs, as a fit begins."""

    kind: Kind  #: of `Config.light`, but for "auto"
    #: In which directions from the object they are, unit vectors, and how strong each colour is, by the first's.
    lamps: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = ()
    distant: bool = False  #: Are they infinitely far away, and not as far as the cameras?

    def __str__(self) -> str:
        """For people: environment, 1 lamp, 2 distant lamps."""
        count = len(self.lamps)
        return f"{count} {'distant ' * self.distant}lamp{'s' * (count > 1)}" if count else self.kind


def require_unknown(capture: Capture, config: Config) -> None:
    """Raise InputError for what does not go with `Config.light`."""
    others, own = shared_emitters(capture.scene), OF_LIGHTS & set(config.refine)
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
    wrong = own & {"falloff"} if config.light == "lamps" else own
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

    left: dict[Lighting, float] = {}  #: errors that coarse fits leave

    def tried(lighting: Lighting) -> "Fit":
        refine = config.refine if lighting.kind == "capture" else recording(config)
        fit = trial(capture, replace(config, **COARSE, light=lighting.kind, refine=refine), lighting=lighting)
        iterations = progress(fit, f"trying {lighting}", fit.iterations, unit="iteration")
        errors = [it.terms["rgb"] for it in iterations][-LAST:]
        left[lighting] = float(np.nan_to_num(np.mean(errors), nan=np.inf))
        return fit

    fit = tried(Lighting("environment"))
    lamp = Lighting("lamps", brightest(fit, 1))
    tried(lamp)
    likely = [lamp]
    if config.light == "auto":
        tried(Lighting("turntable"))
        likely = [*left]
        if not unlit(capture):
            tried(Lighting("capture"))
            own = left[Lighting("capture")]
            likely = [one for one in likely if left[one] < BETTER[one.kind] * own] or [Lighting("capture")]
    best = min(likely, key=lambda one: left[one])
    if best.kind in ("environment", "lamps"):  # of which more lamps are between
        several = [lamp] + [Lighting("lamps", brightest(fit, count)) for count in range(2, MOST + 1)]
        for more in several[1:]:
            tried(more)
        enough = FEWER * min(left[one] for one in several)
        lamp = next(one for one in several if left[one] <= enough)
        distant = lamp._replace(distant=True)
        tried(distant)
        best = min([best, lamp, distant] if config.light == "auto" else [lamp, distant], key=lambda one: left[one])
    errors = ", ".join(f"{lighting} {error:.3g}" for lighting, error in left.items())
    print(f"Light: taken to be {best} (--light {best.kind}); errors that coarse fits leave: {errors}")
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


def brightest(fit: "Fit", count: int) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    """So many lamps, as `Lighting` has them, that light the object as an environment does which a fit has found.

    Of its harmonics up to degree 2, which are what diffuse surfaces show ("An Efficient Representation for Irradiance
    Environment Maps", Ramamoorthi and Hanrahan 2001), by least squares, beside light that is alike from all sides: each
    direction in turn is put where it is best, until none moves.
    """
    assert fit.calibration is not None
    shown = np.repeat(SHOWN, [2 * degree + 1 for degree in range(len(SHOWN))])[:, None]
    seen = shown * fit.calibration.room.harmonics[: len(shown)].double().numpy(force=True)
    directions, _ = directions_of(ROWS)
    lobes = shown * harmonics_in(directions, len(SHOWN) - 1)  # (harmonics, directions)
    grey = np.eye(len(shown))[:, :1]

    def fitted(chosen: list[int], colours: np.ndarray) -> tuple[np.ndarray, float]:
        """Strengths (n + 1, C) and what is left."""
        design = np.concatenate([lobes[:, chosen], grey], 1)
        solved = [nnls(design, colour) for colour in colours.T]
        return np.stack([strengths for strengths, _ in solved], 1), sum(rest**2 for _, rest in solved)

    chosen: list[int] = []
    mean = seen.mean(1, keepdims=True)
    while len(chosen) < count:
        chosen.append(-1)
        before: list[int] = []
        while chosen != before:
            before = [*chosen]
            for k in reversed(range(len(chosen))):
                others = [c for n, c in enumerate(chosen) if n != k and c >= 0]
                rest = [fitted([*others, c], mean)[1] for c in range(len(directions))]
                chosen[k] = int(np.argmin(rest))
    strengths, _ = fitted(chosen, seen)
    order = np.argsort(-strengths[:-1].mean(1))
    # The first is white: which colour it has nobody can tell from the object's.
    relative = strengths / np.maximum(strengths[order[0]], FAINT * strengths[order[0]].mean() + 1e-12)
    relative = relative.clip(FAINT, 1 / FAINT)
    relative[order[0]] = 1.0
    return tuple((tuple(directions[chosen[k]].tolist()), tuple(relative[k].tolist())) for k in order)


def lit(capture: Capture, lighting: Lighting) -> Capture:
    """The capture under these lights: an environment is grey and alike from all sides to begin with, a lamp white.

    More lamps than one are the scene's.
    """
    if lighting.kind == "capture":
        return capture
    cameras, exposure = [sensor.camera for sensor in capture.sensors], capture.exposure()
    if lighting.lamps:
        center, _ = capture.sphere()
        away = 1.0 if lighting.distant else np.median([np.linalg.norm(camera.position - center) for camera in cameras])
        lights = []
        for direction, colour in lighting.lamps:
            toward, rgb = away * np.array(direction), math.pi * exposure / ALBEDO * away**2 * np.array(colour)
            lights.append(Light("directional", -toward, rgb) if lighting.distant else
                          Light("point", center + toward, rgb))  # fmt: skip
        return with_calibration(capture, cameras, lights[:1] * len(cameras), falloff=[0.0] * len(cameras),
                                gains=exposures(capture), lamps=lights[1:] or None)  # fmt: skip
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
    own = {"environment": ["world"], "lamps": ["world"], "turntable": ["camera"]}
    return own.get(lighting.kind, frames_of(capture.scene))
