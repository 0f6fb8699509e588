"""Tests whether two renderers agree within Monte Carlo noise."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy import stats

from mi_ring.errors import InputError
from mi_ring.images import linear_to_srgb
from mi_ring.metrics.path_tracing import BATCHES, Pictures

BLOCK = 8  #: width and height of the blocks of pixels that are compared [px]
ROUNDING = 1e-6  #: relative difference between two computations of the same radiance in float32
IMPLAUSIBLE = 0.75  #: share of interreflection above which the intensities are doubted


@dataclass
class Comparison:
    """Differences between the renderers `photometric` and `path` in one photograph, or in all photographs together.

    `radiance` is a radiance, `psnr` is in dB, `p_direct` and `p_path` are probabilities. All other numbers are shares
    of the mean radiance of `path`.
    """

    name: str
    radiance: float  #: mean of `path` over all pixels and channels
    difference: float  #: mean of photometric − path
    absolute_difference: float  #: mean over pixels of abs(photometric − path)
    noise: float  #: part of the absolute difference that Monte Carlo noise explains
    psnr: float  #: photometric against path [dB], sRGB, at most 100
    shadows: float  #: light that shadows remove
    interreflection: float  #: light of `path` beyond direct light
    unexplained: float  #: mean of photometric − direct light of path
    unexplained_noise: float  #: its standard error
    p_direct: float  #: probability of this difference if photometric and the direct light of path agree
    p_path: float  #: the same for photometric and all light of path


def p_of_agreement(a: np.ndarray, b: np.ndarray) -> float:
    """Test the hypothesis that both renderers agree, by 16 independent pictures of each: a and b (16, H, W, 3) float64.

    Returns the p-value: the probability of so large a difference if they agree. It is the smaller one of two p-values,
    with Šidák's correction. The first one tests the mean of all pixels, by Student's t. The second one tests blocks of
    8 × 8 pixels. If the distributions are equal, each of the 16 differences d of a block is positive or negative with
    equal probability, even with heavy tails. Over all signs, (Σ d)² / Σ d² has mean 1 and variance 2 − 2 Σ d⁴ / (Σ
    d²)². Blocks are independent, so the sum over blocks has about a gamma distribution of known mean and variance.
    Channels share samples, so each block uses one channel: red, green, blue in turn.
    """
    whole, count = a.mean((1, 2, 3)) - b.mean((1, 2, 3)), len(a)
    error = np.hypot(whole.std(ddof=1) / np.sqrt(count), ROUNDING * (a.mean() + b.mean()))
    p_whole = 2 * stats.t.sf(abs(whole.mean()) / error, count - 1) if error else 1.0

    a, b = blocks(a), blocks(b)
    differ = (a != b).any(0)
    d, level = (a - b)[:, differ], (a + b).mean(0)[differ]
    energy = (d**2).sum(0)
    ratio = d.sum(0) ** 2 / (energy + (count * ROUNDING * level) ** 2)
    variance = (2 - 2 * ((d**2 / energy) ** 2).sum(0)).sum()
    if variance < 1e-6:  # at most one picture of each block differs: signs carry no information
        return float(p_whole)
    p_blocks = stats.gamma.sf(ratio.sum(), len(ratio) ** 2 / variance, scale=variance / len(ratio))
    return sidak([p_whole, p_blocks])


def blocks(x: np.ndarray) -> np.ndarray:
    """Sum pictures (16, H, W, 3) over blocks of 8 × 8 pixels. Returns (16, h, w), with one colour channel per block.

    Neighbouring blocks use different channels: red, green, blue in turn. Blocks at the border are smaller.
    """
    _, height, width, _ = x.shape
    x = np.pad(x, ((0, 0), (0, -height % BLOCK), (0, -width % BLOCK), (0, 0)))
    x = x.reshape(len(x), x.shape[1] // BLOCK, BLOCK, -1, BLOCK, 3).sum((2, 4))
    row, column = np.indices(x.shape[1:3])
    return x[:, row, column, (row + column) % 3]


def sidak(p: Sequence[float] | np.ndarray) -> float:
    """Return the smallest of several independent p-values, corrected for their number (Šidák 1967)."""
    return float(-np.expm1(len(p) * np.log1p(-min(p)))) if min(p) < 1 else 1.0


def compare_renderers(name: str, pictures: Pictures) -> Comparison:
    """Compare the pictures of both renderers for one photograph. `name`: its name.

    Raises InputError if pixels are NaN or infinite.
    """
    for which, picture in vars(pictures).items():
        if bad := int((~np.isfinite(picture)).any((0, 3)).sum()):
            raise InputError(f"{name}: {which}: {bad} pixels are NaN or infinite; check BSDF and mesh")
    photometric, unshadowed, path, direct = (p.astype(np.float64) for p in vars(pictures).values())
    level = path.mean() or photometric.mean() or 1.0
    difference, unexplained = photometric - path, photometric - direct
    noise = np.sqrt(2 / np.pi) * difference.std(0, ddof=1) / np.sqrt(BATCHES)  # mean of |x| for a normal x
    error = np.mean((linear_to_srgb(photometric.mean(0)) - linear_to_srgb(path.mean(0))) ** 2)
    shares = {
        "difference": difference.mean(), "absolute_difference": np.abs(difference.mean(0)).mean(),
        "noise": noise.mean(), "shadows": (unshadowed - photometric).mean(), "interreflection": (path - direct).mean(),
        "unexplained": unexplained.mean(),
        "unexplained_noise": unexplained.mean((1, 2, 3)).std(ddof=1) / np.sqrt(BATCHES),
    }  # fmt: skip
    return Comparison(
        name, float(path.mean()), psnr=float(-10 * np.log10(max(error, 1e-10))),
        p_direct=p_of_agreement(photometric, direct), p_path=p_of_agreement(photometric, path),
        **{key: float(value / level) for key, value in shares.items()},
    )  # fmt: skip


def all_as_one(rows: list[Comparison]) -> Comparison:
    """Combine the comparisons of all photographs to one, whose name is "all".

    Its shares are of the light in all photographs. Its p-values are corrected for the number of photographs.
    """
    column = {name: np.array([getattr(row, name) for row in rows]) for name in asdict(rows[0]) if name != "name"}
    weight = column["radiance"] / (column["radiance"].sum() or 1.0)
    shares = {name: float((weight * values).sum()) for name, values in column.items()}
    return Comparison(name="all", **shares | {
        "radiance": float(column["radiance"].mean()),
        "psnr": float(-10 * np.log10(np.mean(10 ** (-column["psnr"] / 10)))),
        "unexplained_noise": float(np.sqrt(((weight * column["unexplained_noise"]) ** 2).sum())),
        "p_direct": sidak(column["p_direct"]),
        "p_path": sidak(column["p_path"]),
    })  # fmt: skip


def percent(x: float) -> str:
    """Format a share, 0 to 1, as a percentage."""
    return f"{x:.2%}"


def probability(p: float) -> str:
    """Format a p-value, for example "p = 0.012"."""
    return "p < 1e-12" if p < 1e-12 else f"p = {p:.2g}"


def comparison_table(rows: list[Comparison]) -> str:
    """Format comparisons as a text table with one line each. Shares are in % of the path tracer's mean radiance."""
    cells: list[tuple[str, ...]] = [(
        "", "radiance", "difference %", "absolute %", "noise %", "PSNR", "shadows %", "interreflection %",
        "unexplained %", "p direct", "p path",
    )]  # fmt: skip
    cells += [(
        r.name, f"{r.radiance:.4g}", f"{100 * r.difference:+.2f}", f"{100 * r.absolute_difference:.2f}",
        f"{100 * r.noise:.2f}", f"{r.psnr:.1f} dB", f"{100 * r.shadows:.2f}", f"{100 * r.interreflection:.2f}",
        f"{100 * r.unexplained:+.3f} ± {100 * r.unexplained_noise:.3f}",
        *(probability(p).removeprefix("p ").removeprefix("= ") for p in (r.p_direct, r.p_path)),
    ) for r in rows]  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*cells)]
    return "\n".join("  ".join([c[0].ljust(widths[0]), *map(str.rjust, c[1:], widths[1:])]) for c in cells)


def verdict(rows: list[Comparison], everything: Comparison, significance: float) -> list[str]:
    """Return three sentences for the user: whether the renderers agree; how strong shadows are, and interreflection.

    `rows`: comparisons of single photographs. `everything`: comparison of all photographs together. `significance`:
    p-value below which the renderers disagree.
    """
    p = probability(everything.p_direct)
    if everything.p_direct >= significance:
        direct = f"direct light agrees with path ({p})"
    else:
        worst = min(rows, key=lambda row: (row.p_direct, -abs(row.unexplained)))
        way = "brighter" if worst.unexplained > 0 else "darker"
        direct = (f"direct light DISAGREES with path ({p}), most in {worst.name}: "
                  f"photometric is {percent(abs(worst.unexplained))} {way} on average")  # fmt: skip
    doubt = ": are the lights' intensities true?" if everything.interreflection > IMPLAUSIBLE else ""
    return [
        direct,
        f"shadows take away {percent(everything.shadows)} of the light",
        f"interreflection is {percent(everything.interreflection)} of the light{doubt}",
    ]
