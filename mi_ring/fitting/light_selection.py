"""Coarse fits, which find out what lights the photographs."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import nnls

from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import OF_LIGHTS
from mi_ring.fitting.config import Config
from mi_ring.fitting.covariance import RECORDED
from mi_ring.fitting.lighting import Lighting, exposures, moved, require_unknown, unlit
from mi_ring.rendering.spherical_harmonics import COUNT, directions_of, harmonics_in
from mi_ring.system.progress import progress

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit

#: Settings of a trial: those that decide alike, whatever the fit's own are.
COARSE: dict[str, Any] = {
    "levels": (3,), "widths": (64,), "shares": (1.0,), "iterations": 60, "holdout": 0,
    **{name: getattr(Config(), name) for name in (
        "loss", "optimizer", "learning_rate", "muon_rate", "decay", "velocity_decay", "steps", "spp", "batch")},
}  # fmt: skip
LAST = 12  #: iterations of a trial that tell how well it explains the photographs
ALIKE = 1.1  #: times that lights may differ in strength without a word
#: What the scene says is believed unless another light leaves less of its error than this. An environment that is fixed
#: in the camera looks much like a flash.
BETTER = {"environment": 0.9, "turntable": 0.6, "lamps": 0.9}
MOST = 3  #: lamps
APART = 30.0  #: between lamps, seen from the object [degrees], for them to be two
FEWER = 1.1  #: Fewer lamps are believed that leave no more of the error of the best than this.
PLAIN = 1.2  #: One material is believed at first if it leaves no more of the error of many than this.
LOOSE = 0.35  #: progress at which the material may vary, where it has been taken to be one
FAINT = 0.1  #: the least strength of a lamp to begin with, by the first
ROWS = 16  #: of a map of the directions in which lamps are sought


def lighting_of(capture: Capture, config: Config, trial: Callable[..., "Fit"]) -> Lighting:
    """What `Config.light` asks for; what is to be found out coarse fits tell, made by `trial`.

    Raises InputError where nothing lights the object, and for what does not go together.
    """
    require_unknown(capture, config)
    if config.light == "capture":
        return Lighting("capture")
    exposed = exposures(capture)
    if exposed.max() > ALIKE * exposed.min():
        print(f"Light: those of the scene differ in strength, by up to {exposed.max() / exposed.min():.2g} times, "
              "which an unknown light takes to be how the photographs were exposed")  # fmt: skip
    trials = Trials(capture, config, trial)
    if config.light in ("environment", "turntable"):
        found = Lighting(config.light)
    elif config.light == "lamps":
        found = trials.lamps()
    else:
        likely = [Lighting("environment"), Lighting("turntable")]
        if math.isfinite(trials.left(likely[0])):  # by which lamps are sought
            likely.insert(1, trials.brightest(1))
        if not unlit(capture):
            own = trials.left(Lighting("capture"))
            likely = [one for one in likely if trials.left(one) < BETTER[one.kind] * own] or [Lighting("capture")]
        found = trials.best(*likely)
        if found.kind in ("environment", "lamps"):  # several lamps are between the two
            found = trials.best(found, trials.lamps())
    if math.isinf(trials.left(found)):
        raise trials.failures[-1]
    if found.kind != "capture":
        found = trials.plain(found)
    errors = ", ".join(f"{lighting} {error:.3g}" for lighting, error in trials.errors.items())
    rule = f"; of lamps the fewest are believed that leave at most {FEWER:g} times the least" * bool(found.lamps)
    print(f"Light: taken to be {found} (--light {found.kind}); errors that coarse fits leave: {errors}{rule}")
    return found


class Trials:
    """Coarse fits of a capture under different lights, each made once."""

    def __init__(self, capture: Capture, config: Config, trial: Callable[..., "Fit"]) -> None:
        """`config`: of the fit that they are for; `trial`: makes one."""
        self.capture, self.config, self.trial = capture, config, trial
        self.center, _ = capture.sphere()
        self.errors: dict[Lighting, float] = {}  #: that they leave of the photographs
        self.found: dict[Lighting, Lighting] = {}  #: where each has its lamps in the end
        self.failures: list[InputError] = []  #: of those that came to no end
        #: harmonics (COUNT, 3) that a fit under one has found, and how much photographs tell of each (COUNT,)
        self.environment: tuple[np.ndarray, np.ndarray] | None = None

    def left(self, lighting: Lighting) -> float:
        """The error that a coarse fit leaves."""
        if lighting in self.errors:
            return self.errors[lighting]
        refine = refined_under(lighting, self.config)
        weights = {"mask": self.config.weights["mask"], "settling": 0.0}
        config = replace(self.config, **COARSE, weights=weights, light=lighting.kind, refine=refine)
        try:
            fit = self.trial(self.capture, config, lighting=lighting)
            iterations = progress(fit, f"trying {lighting}", fit.iterations, unit="iteration")
            errors = [it.terms["rgb"] for it in iterations][-LAST:]
        except InputError as error:  # it diverged, or has a lamp within the object: that light it is not
            self.failures.append(error)
            self.errors[lighting], self.found[lighting] = math.inf, lighting
            return math.inf
        self.found[lighting] = moved(lighting, fit.calibrated(), self.center)
        if lighting == Lighting("environment") and fit.calibration:
            room = fit.calibration.room
            told = room.matrix.diagonal(dim1=1, dim2=2).mean(0)
            self.environment = room.harmonics.numpy(force=True)[:COUNT], told.numpy(force=True)[:COUNT]
        finite = [error for error in errors if math.isfinite(error)]  # a renderer has one now and then that is not
        self.errors[lighting] = float(np.mean(finite)) if finite else math.inf
        if not finite:
            self.failures.append(InputError(f"{self.capture.path}: a coarse fit ({lighting}) has no finite error"))
        return self.errors[lighting]

    def best(self, *lightings: Lighting) -> Lighting:
        """That which leaves the least."""
        return min(lightings, key=self.left)

    def lamps(self) -> Lighting:
        """As few as explain the photographs about as well as more, as far away as the cameras or infinitely far."""
        several = [self.brightest(count) for count in range(1, MOST + 1)]
        enough = FEWER * min(self.left(some) for some in several if self.apart(some))
        lamps = next(some for some in several if self.apart(some) and self.left(some) <= enough)
        distant = self.brightest(len(lamps.lamps), distant=True)
        return self.best(lamps, distant) if self.apart(distant) else lamps

    def apart(self, lamps: Lighting) -> bool:
        """Are they, seen from the object, where a coarse fit has moved them? Else two stand for one elsewhere."""
        self.left(lamps)
        if len(lamps.lamps) < 2:
            return True
        vectors = np.array([vector for vector, _ in self.found[lamps].lamps])
        toward = -vectors if lamps.distant else vectors - self.center
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        cosines = (toward @ toward.T)[~np.eye(len(toward), dtype=bool)]
        return bool((cosines < math.cos(math.radians(APART))).all())

    def brightest(self, count: int, distant: bool = False) -> Lighting:
        """So many lamps that light the object as the environment does, and as strongly as makes its albedo a half."""
        self.left(Lighting("environment"))
        if self.environment is None:
            raise self.failures[0]
        away = np.median([np.linalg.norm(shot.camera.position - self.center) for shot in self.capture.shots])
        directions, colours = brightest(*self.environment, count)
        vectors = -directions if distant else self.center + away * directions
        rgb = math.pi * self.capture.exposure() / ALBEDO * colours * (1.0 if distant else away**2)
        lamps = tuple((tuple(vector), tuple(one)) for vector, one in zip(vectors.tolist(), rgb.tolist()))
        return Lighting("lamps", lamps, distant)

    def plain(self, lighting: Lighting) -> Lighting:
        """As a coarse fit has it in the end; at first on one material if that explains the photographs as well."""
        one = lighting._replace(plain=1.0)
        if self.left(one) >= PLAIN * self.left(lighting) or not self.apart(one):
            return self.found[lighting]
        return self.found[one]._replace(plain=LOOSE)


def refined_under(lighting: Lighting, config: Config) -> tuple[Any, ...]:
    """What a coarse fit refines of what `Config.refine` has: how photographs were recorded, and their own lights."""
    own = {*OF_LIGHTS, "ambient"} if lighting.kind == "capture" else set()
    return tuple(name for name in config.refine if name in {"auto", "gain", *RECORDED, *own}) or ("none",)


def brightest(harmonics: np.ndarray, certainty: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """So many directions (count, 3) of lamps that light an object as an environment does, and colours (count, 3).

    Colours are by the first's, which is white: which colour it has nobody can tell from the object's. `harmonics`
    (COUNT, 3) of the environment, and how much photographs tell of each, `certainty` (COUNT,). By least squares,
    beside light that is alike from all sides: each direction in turn is put where it is best, until none moves.
    """
    shown = np.sqrt(np.maximum(certainty, 0))[:, None]
    seen = shown * harmonics
    directions, _ = directions_of(ROWS)
    lobes = shown * harmonics_in(directions)  # (harmonics, directions)
    grey = shown * np.eye(COUNT)[:, :1]

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
    first = strengths[order[0]]
    colours = (strengths[order] / np.maximum(first, FAINT * first.mean() + 1e-12)).clip(FAINT, 1 / FAINT)
    colours[0] = 1.0
    return directions[chosen][order], colours
