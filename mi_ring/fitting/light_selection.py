"""Light selection: coarse fits under several kinds of light find out which kind lights the photographs."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import nnls

from mi_ring.calibration.unknowns import OWN_LIGHTS, UNKNOWNS
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.capture.turntable import object_turned
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.lighting import Lighting, exposures, is_unlit, require_compatible, with_found_lamps
from mi_ring.fitting.problem import held_out_photographs
from mi_ring.rendering.spherical_harmonics import PER_FRAME, envmap_directions, world_harmonics
from mi_ring.system.progress import progress

#: Settings of a coarse fit that do not depend on those of the fit.
COARSE: dict[str, Any] = {
    "levels": (3,), "widths": (64,), "shares": (1.0,), "iterations": 60, "holdout": 0, "detail": "none",
    "lobes": "1", "small_lights": 0,
    **{name: getattr(Config(), name) for name in (
        "loss", "optimizer", "learning_rate", "muon_rate", "decay", "velocity_decay", "steps", "spp", "batch")},
}  # fmt: skip
#: Coarse fits at most, by `Config.light`; most of them only in doubt.
FITS = {"auto": 8, "lamps": 6, "environment": 2, "turntable": 2}
LAST = 12  #: last iterations of a coarse fit whose mean error counts
ALIKE = 1.1  #: ratio of the lights' strengths above which a message is printed
#: Another light than the scene's is chosen only if its error is below this share of the error with the scene's lights.
#: An environment fixed in the camera looks much like a flash. Under a true flash its error was 1.3 to 1.7 times that of
#: the flash, in rooms with windows 0.65 to 0.83 times.
BETTER = 0.9
MOST = 3  #: lamps
APART = 30.0  #: between lamps, seen from the object [degrees], for them to be two
FEWER = 1.1  #: the fewest lamps are chosen whose error is at most this factor of the least
#: One material at first is chosen if its error is at most this factor of that of a varying one. Of objects of one
#: material it was 1.03 to 1.11, of striped ones 1.16 and more: their stripes would become grooves.
ONE_MATERIAL = 1.13
LOOSE = 0.35  #: progress at which one material begins to vary
FAINT = 0.1  #: least initial strength of a lamp, relative to the first
ROWS = 16  #: of the map of directions in which lamps are searched
RECORDING = {unknown.option for unknown in UNKNOWNS.values() if unknown.changes == "recording"}  #: options of it


def choose_lighting(capture: Capture, config: Config) -> Lighting:
    """Choose the lighting for a fit. If `Config.light` is "capture", it is the lights of the scene.

    Otherwise this runs coarse fits, which take minutes, and prints the result. Give the result to `Fit`. Raises
    InputError if nothing lights the object, or if the settings contradict the capture.
    """
    if config.light == "capture":
        return Lighting.of(capture, config)
    require_compatible(capture, config)
    held_out = held_out_photographs(capture, config.holdout)
    capture = capture.part(np.setdiff1d(np.arange(len(capture)), held_out))
    exposed = exposures(capture)
    if exposed.max() > ALIKE * exposed.min():
        print(f"Light: those of the scene differ in strength, by up to {exposed.max() / exposed.min():.2g} times, "
              "which an unknown light takes to be how the photographs were exposed")  # fmt: skip
    trials, turned = CoarseFits(capture, config), None
    if config.light in ("environment", "turntable"):
        found = Lighting(config.light)
    elif config.light == "lamps":
        found = trials.lamps()
    else:
        turned = object_turned(capture)
        if turned:
            print("Light: cameras are on rings and see the same background, so the object turned")
            turned = math.isfinite(trials.error(Lighting("turntable"))) or None
        elif turned is False:
            print("Light: cameras or background moved, so the object did not turn")
        found = trials.likeliest(turned)
        if found.kind in ("environment", "lamps"):  # several lamps are between one and an environment
            found = trials.best(found, trials.lamps())
    if math.isinf(trials.error(found)):
        raise trials.failures[-1]
    if found.kind != "capture":
        found = trials.with_material(found)
    errors = ", ".join(f"{lighting} {error:.3g}" for lighting, error in trials.errors.items())
    rule = f"; of lamps the fewest are believed that leave at most {FEWER:g} times the least" * bool(found.lamps)
    if Lighting("capture") in trials.errors:
        rule += f"; those of the scene are kept unless another leaves at most {BETTER:g} of their error"
    print(f"Light: taken to be {found} (--light {found.kind}); errors that coarse fits leave: {errors}{rule}")
    return found


class CoarseFits:
    """Runs coarse fits of a capture under several lightings, and compares their errors. No fit runs twice."""

    def __init__(self, capture: Capture, config: Config) -> None:
        """Prepare coarse fits of a capture. No fit runs yet. `config`: settings of the fit that will use the light."""
        self.capture, self.config = capture, config
        self.center, _ = capture.sphere()
        self.errors: dict[Lighting, float] = {}  #: mean error of each
        self.found: dict[Lighting, Lighting] = {}  #: each with the lamps that its fit has found
        self.failures: list[InputError] = []  #: of fits that failed
        #: harmonics (PER_FRAME, 3) of the environment that a fit has found, and information about each (PER_FRAME,)
        self.environment: tuple[np.ndarray, np.ndarray] | None = None

    def error(self, lighting: Lighting) -> float:
        """Return the mean error of the coarse fit under `lighting`; infinity if this fit fails.

        The fit runs now, if it has not run before.
        """
        if lighting in self.errors:
            return self.errors[lighting]
        refine = refined_under(lighting, self.config)
        weights = {"mask": self.config.weights["mask"], "settling": 0.0}
        config = replace(self.config, **COARSE, weights=weights, light=lighting.kind, refine=refine)
        try:
            fit = Fit(self.capture, config, lighting=lighting)
            doing = f"light, coarse fit {len(self.errors) + 1} of at most {FITS[self.config.light]} ({lighting})"
            iterations = progress(fit, doing, fit.schedule.iterations, unit="iteration")
            errors = [it.terms["rgb"] for it in iterations][-LAST:]
        except InputError as error:  # it diverged, or a lamp is inside the object: the light is another
            self.failures.append(error)
            self.errors[lighting], self.found[lighting] = math.inf, lighting
            return math.inf
        self.found[lighting] = with_found_lamps(lighting, fit.calibrated(), self.center)
        if lighting == Lighting("environment") and fit.model.calibration:
            room = fit.model.calibration.room
            information = room.matrix.diagonal(dim1=1, dim2=2).mean(0)
            self.environment = room.harmonics.numpy(force=True)[:PER_FRAME], information.numpy(force=True)[:PER_FRAME]
        finite = [error for error in errors if math.isfinite(error)]  # a renderer produces a NaN now and then
        self.errors[lighting] = float(np.mean(finite)) if finite else math.inf
        if not finite:
            self.failures.append(InputError(f"{self.capture.path}: a coarse fit ({lighting}) has no finite error"))
        return self.errors[lighting]

    def best(self, *lightings: Lighting) -> Lighting:
        """Return the lighting whose coarse fit has the smallest error.

        Runs the coarse fits that have not run before.
        """
        return min(lightings, key=self.error)

    def likeliest(self, turned: bool | None) -> Lighting:
        """Find the lighting that explains the photographs best, with one lamp at most. Runs coarse fits.

        `turned`: True if the object turned: no light is fixed in the world. False if it did not: none is fixed in the
        camera. None: not known.
        """
        likely = [] if turned is False else [Lighting("turntable")]
        if not turned:
            likely.insert(0, Lighting("environment"))
            if math.isfinite(self.error(likely[0])):  # the environment shows where lamps are
                likely.insert(1, self.brightest(1))
        if not is_unlit(self.capture):
            own = Lighting("capture")
            likely = [one for one in likely if self.error(one) < BETTER * self.error(own)] or [own]
        return self.best(*likely)

    def lamps(self) -> Lighting:
        """Find the smallest number of lamps, up to 3, that explains the photographs about as well as any.

        Runs coarse fits. The lamps start as far from the object as the cameras, or they are infinitely far.
        """
        several = [self.brightest(count) for count in range(1, MOST + 1)]
        enough = FEWER * min(self.error(some) for some in several if self.are_apart(some))
        lamps = next(some for some in several if self.are_apart(some) and self.error(some) <= enough)
        distant = self.brightest(len(lamps.lamps), distant=True)
        return self.best(lamps, distant) if self.are_apart(distant) else lamps

    def are_apart(self, lamps: Lighting) -> bool:
        """Test whether the lamps that a coarse fit has found are at least 30° apart, seen from the object.

        `lamps`: the lighting of this fit, which runs now if it has not run before. Two lamps in one direction model one
        lamp.
        """
        self.error(lamps)
        if len(lamps.lamps) < 2:
            return True
        vectors = np.array([vector for vector, _ in self.found[lamps].lamps])
        toward = -vectors if lamps.distant else vectors - self.center
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        cosines = (toward @ toward.T)[~np.eye(len(toward), dtype=bool)]
        return bool((cosines < math.cos(math.radians(APART))).all())

    def brightest(self, count: int, distant: bool = False) -> Lighting:
        """Make a lighting of `count` lamps in the brightest directions of the environment that a coarse fit has found.

        The lamps are so strong that the object's albedo is about 0.5. `distant`: True for lamps that are infinitely
        far, False for lamps as far from the object as the cameras. Raises InputError if the coarse fit has failed.
        """
        self.error(Lighting("environment"))
        if self.environment is None:
            raise self.failures[0]
        away = np.median([np.linalg.norm(shot.camera.position - self.center) for shot in self.capture.shots])
        directions, colours = brightest(*self.environment, count)
        vectors = -directions if distant else self.center + away * directions
        rgb = math.pi * self.capture.exposure() / ALBEDO * colours * (1.0 if distant else away**2)
        lamps = tuple((tuple(vector), tuple(one)) for vector, one in zip(vectors.tolist(), rgb.tolist()))
        return Lighting("lamps", lamps, distant)

    def with_material(self, lighting: Lighting) -> Lighting:
        """Decide whether a fit under `lighting` should begin with one material for the whole object.

        It should if a coarse fit with one material explains the photographs about as well as one with a varying
        material. Returns a copy of `lighting` with this decision and with the lamps that the coarse fit has found. Runs
        coarse fits.
        """
        one = lighting._replace(one_material_until=1.0)
        if self.error(one) >= ONE_MATERIAL * self.error(lighting) or not self.are_apart(one):
            return self.found[lighting]
        return self.found[one]._replace(one_material_until=LOOSE)


def refined_under(lighting: Lighting, config: Config) -> tuple[Any, ...]:
    """List the options of `--refine` for a coarse fit under `lighting`. `config`: settings of the real fit.

    From the options of the real fit, these are kept: `auto`, `gain`, the camera response, and the lights if they are
    those of the scene. With the scene's lights, `auto` also corrects cameras.
    """
    own = {*OWN_LIGHTS, "ambient"} if lighting.kind == "capture" else set()
    return tuple(name for name in config.refine if name in {"auto", "gain", *RECORDING, *own}) or ("none",)


def brightest(harmonics: np.ndarray, certainty: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Approximate an environment by `count` distant lamps. Returns (unit directions (count, 3), colours (count, 3)).

    `harmonics` (PER_FRAME, 3): spherical harmonics of the environment. `certainty` (PER_FRAME,): weight of each
    harmonic. Colours are relative to the strongest lamp, which is the first; it is white, because the object's colour
    is unknown. The method is weighted least squares with lamps and constant light. It moves one direction after the
    other to its optimum, until none moves.
    """
    shown = np.sqrt(np.maximum(certainty, 0))[:, None]
    seen = shown * harmonics
    directions, _ = envmap_directions(ROWS)
    lobes = shown * world_harmonics(directions)  # (harmonics, directions)
    grey = shown * np.eye(PER_FRAME)[:, :1]

    def fitted(chosen: list[int], colours: np.ndarray) -> tuple[np.ndarray, float]:
        """Return (strengths (n + 1, C) of the lamps and of constant light, sum of squared residuals)."""
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
