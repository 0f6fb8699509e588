"""How well reflectance models can describe measured materials, lit from the camera.

    python benchmarks/measured_slices.py SLICES.npz

SLICES.npz has `names` (M,), `theta_h_rad` (A,) and `values_rgb` (M, A, 3): BRDFs measured with light and viewer at one
place, as `shared/data/brdf/merl_colocated_slice.npz` does for the 100 materials of MERL. Each model is fitted to each
material by least squares of the logarithm of reflected light, up to 80°, weighted by projected area.

Prints Markdown tables: the root mean square error of the logarithm over all materials; the materials that the rough
diffuse term helps most. Then the quartiles of its roughness σ.
"""

import argparse
import itertools

import numpy as np
from accuracy import table
from scipy.optimize import least_squares, nnls
from scipy.special import expit, logit

import mi_ring  # noqa: F401  (chooses Mitsuba's variant)
from mi_ring.plugins.matte_reflection import DARKER

STEEPEST = np.radians(80)
HELPED = 10  #: number of materials in the second table
DARK = 0.02  #: radiance, in units of the median, that is added before the logarithm
#: Models: whether the diffuse term is rough, and the number of glossy lobes.
MODELS = {
    "Lambert and one lobe, as in the paper": (False, 1),
    "rough diffuse and one lobe": (True, 1),
    "Lambert and two lobes": (False, 2),
    "rough diffuse and two lobes": (True, 2),
}
WIDTHS, ROUGH = np.geomspace(0.03, 0.95, 10), (0.01, 0.1, 0.3, 0.8)  #: of lobes and of the diffuse term, to start from


def gloss(cosine: np.ndarray, width: float) -> np.ndarray:
    """D G / (π (n·i)(n·o)) of GGX, as in `cooktorrance`, for i = o."""
    squared = width**2
    density = squared / (cosine**2 * (squared - 1) + 1) ** 2
    masking = 2 / (1 + np.sqrt(1 + squared * (1 - cosine**2) / cosine**2))
    return density * masking**2 / (np.pi * cosine**2)


def diffuse(cosine: np.ndarray, sigma: float) -> np.ndarray:
    """The rough diffuse term of `cooktorrance` for ρᵈ = 1 and i = o."""
    return (1 + sigma * (1 - cosine**2) / cosine) / (1 + DARKER * sigma)


def reflectance(parameters: np.ndarray, cosine: np.ndarray, rough: bool, lobes: int) -> np.ndarray:
    """A model at i = o: logarithms of ρᵈ and of ρᵞ of each lobe, logits of r of each lobe and, if `rough`, of σ."""
    strengths, widths = np.exp(parameters[: 1 + lobes]), expit(parameters[1 + lobes :])
    matte = diffuse(cosine, widths[lobes] if rough else 0.0)
    glossy = [s * gloss(cosine, max(w, 0.02)) for s, w in zip(strengths[1:], widths)]
    return np.sum([strengths[0] * matte, *glossy], axis=0)


def fitted(values: np.ndarray, angles: np.ndarray, rough: bool, lobes: int) -> tuple[float, float]:
    """Error of the best fit of a model to a material's BRDF (A,), and its σ."""
    cosine = np.cos(angles)
    weight = np.sqrt(np.gradient(angles) * np.sin(2 * angles))
    weight /= np.linalg.norm(weight)
    floor = DARK * np.median(values * cosine)

    def error(parameters: np.ndarray) -> np.ndarray:
        shown = reflectance(parameters, cosine, rough, lobes) * cosine
        return weight * np.log((shown + floor) / (values * cosine + floor))

    starts = []
    relative = weight * cosine / (values * cosine + floor)
    for widths in itertools.combinations(WIDTHS, lobes):
        for sigma in ROUGH if rough else (0.0,):
            parts = np.column_stack([diffuse(cosine, sigma), *(gloss(cosine, width) for width in widths)])
            strengths, _ = nnls(parts * relative[:, None], values * relative)
            shapes = [*widths, sigma] if rough else widths
            start = np.concatenate([np.log(strengths + 1e-6 * values.min()), logit(shapes)])
            starts.append((np.linalg.norm(error(start)), start.tolist()))
    found = [least_squares(error, start, max_nfev=300) for _, start in sorted(starts)[:3]]
    best = min(found, key=lambda one: one.cost)
    return float(np.sqrt(2 * best.cost)), float(expit(best.x[-1])) if rough else 0.0


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("slices")
    options = parser.parse_args()
    with np.load(options.slices) as file:
        names, angles, values = (file[name] for name in ("names", "theta_h_rad", "values_rgb"))
    chosen = angles < STEEPEST
    materials = np.maximum(values[:, chosen].mean(-1), 1e-5)
    found = np.array([[fitted(one, angles[chosen], *model) for one in materials] for model in MODELS.values()])
    errors, sigma = found[..., 0], found[1, :, 1]
    rows = [[name, f"{of.mean():.3f}", f"{np.median(of):.3f}", f"{np.quantile(of, 0.9):.3f}"]
            for name, of in zip(MODELS, errors)]  # fmt: skip
    print(table(["model", "mean error", "median", "worst tenth from"], rows))
    gain = errors[0] - errors[1]
    rows = [[names[k], f"{errors[0, k]:.3f}", f"{errors[1, k]:.3f}", f"{errors[2, k]:.3f}", f"{sigma[k]:.2f}"]
            for k in np.argsort(-gain)[:HELPED]]  # fmt: skip
    print(table(["material", "as in the paper", "rough diffuse", "two lobes", "σ"], rows))
    print(f"quartiles of σ: {', '.join(f'{s:.2f}' for s in np.quantile(sigma, [0.25, 0.5, 0.75]))}")


if __name__ == "__main__":
    main()
