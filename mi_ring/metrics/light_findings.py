"""Finds out whether the brightness of photographs follows the stated light; if it does not, what may be the reason.

Brightness of a point of the surface, in a photograph, is explained as albedo · exposure · (irradiance · shading). All
albedos and exposures are free, as are the shading, a function of the rough normal's angle to the light, and cone, tilt
and offset of the flash. Alternatives add one number each:

- a room: irradiance that is equal in all photographs; it lifts dark shading, the more the farther the flash is;
- a curve: a power of the irradiance, or the S-curve of `ToneCurve`; it flattens all shading alike.

Exposures that depend on the flash's distance are the third reason. Those errors that the samples of a photograph share
are why photographs count, not samples: standard deviations come from leaving out each photograph, and one
alternative is better than another if it is so in most photographs.
"""

from dataclasses import dataclass

import numpy as np

from mi_ring.metrics.brightness_samples import BrightnessSamples
from mi_ring.scene.tone_curve import contrasted

#: Photographs, and points in a photograph. Of 16 exact photographs from one side a wrong falloff was found.
FEWEST, FEWEST_POINTS = 20, 10
SEEN = 3  #: least number of photographs of a point
GRAZING = 0.2  #: least cosine between normal and light
COSINES = np.array([0.2, 0.35, 0.5, 0.65, 0.8, 0.92, 1.0])  #: between which the shading is linear in its logarithm
#: Prior standard deviations of exponent of the cone, of two tilts, and of two offsets [radii]
PLACE = np.array([20.0, 3.0, 3.0, 0.15, 0.15])
LOWEST, HIGHEST = 0.004, 0.6  #: of predicted brightness; curves, noise and clipping change the rest
FLATTEST = 0.5  #: least exponent or contrast of a curve
LIMITS = {"room": (-0.15, 50.0), "power": (FLATTEST, 2.0), "contrast": (FLATTEST, 2.0)}  #: of what the alternatives add
NEUTRAL = {"room": 0.0, "power": 1.0, "contrast": 1.0}
# Calibrated on captures with and without a room, and on those whose photographs were given curves and exposures.
CLEARLY, BETTER = 3.0, 2.5  #: standard deviations that a finding, or the better of two alternatives, must have
LEAST_ROOM, LEAST_NAMED = 0.1, 0.2  #: shares of the flash: of a finding, and of one that names the room alone
LEAST_CURVE = 0.1  #: a flat curve: what is missing to 1 in its exponent
LEAST_EXPOSURE = 0.25  #: exponent of automatic exposures, above which there is a finding
#: By so much times the exponent of its cone, a flash beside the lens, at a fifth of the distance, changes the falloff.
CONE = 0.02


@dataclass
class Table:
    """The usable samples as a list of n samples: what `fit` needs of them."""

    log_brightness: np.ndarray  #: (n,)
    log_irradiance: np.ndarray  #: (n,)
    shading: np.ndarray  #: (n, cosines - 1) weights of the values of the shading at `COSINES`; at the last it is 0
    place: np.ndarray  #: (n, 5) see `BrightnessSamples`
    clipped: np.ndarray  #: (n,) bool
    photograph: np.ndarray  #: (n,) index
    point: np.ndarray  #: (n,) index
    log_falloff: np.ndarray  #: (K,) of the photographs that are left
    count: int  #: K, the number of photographs

    @classmethod
    def of(cls, samples: BrightnessSamples) -> "Table | None":
        """Choose the usable samples. Returns None if there are too few photographs."""
        usable = (samples.brightness > 1e-3) & (samples.cosine > GRAZING)  # False for NaN, too
        for _ in range(3):
            good = usable & ~samples.clipped
            usable = usable & (good.sum(0) >= SEEN)
            usable = usable & ((usable & ~samples.clipped).sum(1) >= FEWEST_POINTS)[:, None]
        rows, columns = np.nonzero(usable)
        kept, photograph = np.unique(rows, return_inverse=True)
        if len(kept) < FEWEST:
            return None
        cosine = samples.cosine[usable]
        shading = np.stack([np.interp(cosine, COSINES, one) for one in np.eye(len(COSINES))[:-1]], 1)
        return cls(np.log(samples.brightness[usable].clip(max=1)), np.log(samples.irradiance[usable]), shading,
                   samples.place[usable], samples.clipped[usable], photograph,
                   np.unique(columns, return_inverse=True)[1], np.log(samples.falloff[kept]), len(kept))  # fmt: skip


@dataclass
class Explanation:
    """One explanation of the brightness."""

    value: float  #: of what the alternative adds, see `NEUTRAL`
    deviation: float  #: its standard deviation, by leaving out photographs
    log_exposures: np.ndarray  #: (K,)
    cone: float  #: exponent of the flash's cone
    scale: float  #: robust standard deviation of the logarithm of brightness
    residuals: np.ndarray  #: (n,)
    used: np.ndarray  #: (n,) bool: which samples count

    def costs(self, table: Table, scale: float) -> np.ndarray:
        """Return the mean robust cost of the residuals in each photograph (K,). `scale`: their standard deviation."""
        cost = np.log1p((self.residuals[self.used] / (2 * scale)) ** 2)
        of_photograph = table.photograph[self.used]
        number = np.bincount(of_photograph, minlength=table.count)
        return np.bincount(of_photograph, cost, table.count) / np.maximum(number, 1)


def without_albedo(values: np.ndarray, table: Table, weight: np.ndarray) -> np.ndarray:
    """Subtract from `values` (n,) or (n, m) its weighted mean at each point of the surface."""
    total = np.bincount(table.point, weight)
    columns = values.reshape(len(values), -1).T
    means = [(np.bincount(table.point, weight * column) / total)[table.point] for column in columns]
    return values - np.stack(means, -1).reshape(values.shape)


def contrast_slope(log_brightness: np.ndarray) -> np.ndarray:
    """Return the derivative of log C(brightness) by the contrast at 1. C: the S-curve of `ToneCurve`."""
    x, step = np.exp(log_brightness).clip(1e-3, 0.98), 1e-3
    return (np.log(contrasted(x, 1 + step)) - np.log(contrasted(x, 1 - step))) / (2 * step)


def fit(table: Table, alternative: str | None = None, iterations: int = 14) -> Explanation:
    """Explain the samples by robust least squares, with what `alternative` of `NEUTRAL` adds; None: nothing."""
    bent, placed = table.shading.shape[1], table.place.shape[1]
    exposed = bent + placed
    known = np.zeros(exposed + table.count)
    known[:bent] = np.log(COSINES[:-1])
    deviations = np.concatenate([np.full(bent, 1e3), PLACE, np.ones(table.count), [1e3] if alternative else []])
    centred = np.r_[np.zeros(bent, bool), np.ones(len(deviations) - bent, bool)]  # priors about 0
    one_each = np.eye(table.count)[table.photograph]
    value, neutral = (0.0, 0.0) if alternative is None else (NEUTRAL[alternative],) * 2
    used, weight, scale, predicted = ~table.clipped, np.ones(len(table.point)), 0.2, table.log_brightness
    for step_number in range(iterations):
        power = value if alternative == "power" else 1.0
        own = np.exp(power * table.log_irradiance + table.shading @ known[:bent] + table.place @ known[bent:exposed])
        total = np.maximum(own + (value if alternative == "room" else 0.0), 1e-3)
        share = (own / total)[:, None]
        columns = [table.shading * share, table.place * share, one_each]
        expected = np.log(total) + known[exposed:][table.photograph]
        if alternative == "room":
            columns.append(1 / total[:, None])
        elif alternative == "power":
            columns.append(table.log_irradiance[:, None] * share)
        elif alternative == "contrast":
            columns.append(contrast_slope(predicted)[:, None])
            expected = expected + (value - neutral) * columns[-1][:, 0]
        jacobian = np.concatenate(columns, 1)
        number = np.maximum(np.bincount(table.photograph, used, table.count), 1)
        balance = used.sum() / table.count / number[table.photograph]  # each photograph counts the same
        now = weight * balance * used / scale**2 + 1e-9
        prior = deviations**-2.0
        pull = -prior * centred * np.append(known, [value - neutral] if alternative else [])
        difference = table.log_brightness - expected
        step, residuals = solved(jacobian, difference, table, now, prior, pull)
        limited = step.clip(-0.5, 0.5)
        limited[bent:exposed] = step[bent:exposed]
        known += limited[: len(known)]
        if alternative:
            value = float(np.clip(value + limited[-1], *LIMITS[alternative]))
        scale = max(1.4826 * float(np.median(np.abs(residuals[used]))), 1e-3)
        weight = 1 / (1 + (residuals / (2 * scale)) ** 2)
        predicted = table.log_brightness - residuals
        if step_number >= 2:  # by prediction: what is left out by its brightness would bend the rest
            used = (predicted > np.log(LOWEST)) & (predicted < np.log(HIGHEST))
    deviation = np.inf
    if alternative:
        left = np.array([solved(jacobian, difference, table, now * (table.photograph != k) + 1e-9, prior, pull)[0][-1]
                         for k in range(table.count)])  # fmt: skip
        deviation = float(np.sqrt((table.count - 1) * left.var()))
    return Explanation(value, deviation, known[exposed:], float(known[bent]), scale, residuals, used)


def solved(
    jacobian: np.ndarray, difference: np.ndarray, table: Table, weight: np.ndarray, prior: np.ndarray, pull: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve weighted least squares with free albedos. Returns (step (m,), residuals (n,)).

    `jacobian` (n, m), `difference` (n,): of the logarithm of brightness. `weight` (n,). `prior` (m,): inverse
    variances. `pull` (m,): gradient of the priors.
    """
    columns, rest = (without_albedo(part, table, weight) for part in (jacobian, difference))
    matrix = (columns * weight[:, None]).T @ columns + np.diag(prior)
    step = np.linalg.solve(matrix, (columns * weight[:, None]).T @ rest + pull)
    return step, rest - columns @ step


def falloff_exponent(table: Table, plain: Explanation) -> tuple[float, float]:
    """Return how exposures follow the falloff of the flash with its distance, with standard deviation: 1 is right.

    It is 0 if the object is equally bright at all distances.
    """
    far = table.log_falloff - table.log_falloff.mean()
    square = far @ far
    if square < 1e-6 * table.count:
        return 1.0, np.inf
    slope = far @ plain.log_exposures / square
    rest = plain.log_exposures - plain.log_exposures.mean() - slope * far
    return 1 + float(slope), float(np.sqrt(rest @ rest / (table.count - 2) / square + (CONE * plain.cone) ** 2))


def light_findings(samples: BrightnessSamples) -> list[str]:
    """Say what the brightness of the photographs tells of room, curve and exposures: at most one sentence.

    It is an empty list if brightness follows the light that the scene file states, or if it does not tell.
    """
    table = Table.of(samples)
    if table is None:
        return []
    plain = fit(table)
    room, power, contrast = (fit(table, alternative) for alternative in NEUTRAL)
    scale = min(one.scale for one in (plain, room, power, contrast))
    best = min((room, power, contrast), key=lambda one: one.costs(table, scale).mean())

    def worse(one: Explanation) -> float:
        """By how many standard deviations an explanation is worse than the best one."""
        more = one.costs(table, scale) - best.costs(table, scale)
        return float(more.mean() / max(more.std() / np.sqrt(table.count), 1e-9))

    if best is room:
        flat = room.value > LEAST_ROOM + 2 * room.deviation
    else:
        flat = 1 - best.value > LEAST_CURVE + 2 * best.deviation + CONE * abs(plain.cone)
    if flat and worse(plain) > CLEARLY:
        # A curve as flat as can be stands for a room without a flash, too.
        if best is not room and best.value > FLATTEST and worse(room) > BETTER:
            return ["shading is flatter than the flash explains: a flatter curve of the camera explains it better than "
                    "light of the room; a fit decides"]  # fmt: skip
        sure = room.value > LEAST_NAMED + 2 * room.deviation
        if best is room and sure and min(worse(power), worse(contrast)) > BETTER:
            share = f"about {round(room.value, 1):.0%} of" if room.value < 1 else "stronger than"
            return [f"the room's light on the object is {share} the flash's: dim the room; a fit finds its light, but "
                    "not perfectly"]  # fmt: skip
        return ["shading is flatter than the flash explains: light of the room and a flatter curve of the camera "
                "explain it about equally well; a fit decides"]  # fmt: skip
    exponent, deviation = falloff_exponent(table, plain)
    if 1 - exponent > max(LEAST_EXPOSURE, CLEARLY * deviation):
        middle = (1 + exponent) / 2
        bent = power.value - CLEARLY * power.deviation < middle
        bent = bent or contrast.value - CLEARLY * contrast.deviation < middle
        lifted = (room.value + CLEARLY * room.deviation) > (1 - middle) / middle
        also = [*["a flatter curve of the camera"] * bent, *["light of the room"] * lifted]
        reasons = " and ".join([", ".join(["exposures that follow the distance", *also[:-1]]), *also[-1:]])
        many = f"{reasons} explain it about equally well; a fit decides" if also else f"as by {reasons}"
        return [f"brightness falls too little with the flash's distance: {many}"]
    return []
