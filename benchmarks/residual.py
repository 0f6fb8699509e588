"""What the difference between predictions and real photographs consists of.

    python benchmarks/residual.py PHOTOS MASKS RENDERED [--pictures FOLDER]

Three folders with files of the same names, whatever their suffixes: 8-bit sRGB photographs, masks of the judged pixels
(255), and predictions, which may be smaller. Values are compared as encoded.

Prints a Markdown table. Each row gives the predictions one freedom that a possible cause would explain, and the PSNR
that results. A freedom that does not help is not a cause.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from accuracy import table
from PIL import Image
from scipy.ndimage import gaussian_filter, shift
from scipy.optimize import minimize

from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.images import linear_to_srgb

BLURS = 1, 2, 4, 8, 16, 32  #: [px]


class Pair(NamedTuple):
    """A photograph and the picture of it; (H, W, 3), encoded."""

    name: str
    photo: np.ndarray
    rendered: np.ndarray  #: the picture as it is
    picture: np.ndarray  #: and at its best exposure
    judged: np.ndarray  #: (H, W) bool

    @property
    def drawn(self) -> np.ndarray:
        """(H, W) bool: what is judged and not black."""
        return self.judged & (self.rendered.max(-1) > 0)

    @property
    def error(self) -> np.ndarray:
        """(H, W, 3)"""
        return self.photo - self.picture


def pairs(photos: Path, masks: Path, rendered: Path) -> Iterator[Pair]:
    """Each photograph that has a mask, with its picture."""
    for mask in sorted(masks.glob("*.png")):
        photo, picture = (
            Image.open(next(file for file in sorted(folder.iterdir()) if file.stem == mask.stem)).convert("RGB")
            for folder in (photos, rendered)
        )
        judged = np.asarray(Image.open(mask).convert("L").resize(picture.size, Image.Resampling.NEAREST)) > 127
        a, b = (
            np.asarray(image, np.float64) / 255 for image in (photo.resize(picture.size, Image.Resampling.BOX), picture)
        )
        x, y = srgb_to_linear(a)[judged], srgb_to_linear(b)
        gain = (x * y[judged]).sum() / (y[judged] ** 2).sum()
        exposed = linear_to_srgb(np.clip(gain * y, 0, 1)).astype(float)
        yield Pair(mask.stem, a, b, exposed, judged)


def psnr(errors: list[np.ndarray]) -> str:
    """Mean over photographs [dB]."""
    return f"{np.mean([-10 * np.log10(np.mean(error**2)) for error in errors]):.2f}"


def smooth_gain(pair: Pair, order: int) -> np.ndarray:
    """What is left after the polynomial of the place in the picture that makes it as bright as the photograph."""
    y, x = (
        2 * (place / size - 0.5)
        for place, size in zip(np.mgrid[: pair.judged.shape[0], : pair.judged.shape[1]], pair.judged.shape)
    )
    basis = np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], -1)[pair.drawn]
    seen, drawn = pair.photo[pair.drawn], pair.picture[pair.drawn]
    factors = np.linalg.lstsq(basis * drawn.mean(-1, keepdims=True), seen.mean(-1), rcond=None)[0]
    return seen - (basis @ factors)[:, None] * drawn


def best_shift(pair: Pair) -> np.ndarray:
    """What is left after a translation of the picture by a few pixels that brings it near."""

    def left(by: np.ndarray) -> np.ndarray:
        return (pair.photo - shift(pair.picture, (*by, 0), order=1))[pair.drawn]

    first = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    found = minimize(
        lambda by: (left(by) ** 2).mean(), first[0], method="Nelder-Mead", options={"initial_simplex": first}
    )
    return left(found.x)


def blurred(pair: Pair, sigma: float) -> np.ndarray:
    """The difference without what is finer."""
    inside = pair.drawn.astype(float)
    weight = np.maximum(gaussian_filter(inside, sigma), 1e-6)[..., None]
    return (gaussian_filter(pair.error * inside[..., None], (sigma, sigma, 0)) / weight)[pair.drawn]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for folder in ("photos", "masks", "rendered"):
        parser.add_argument(folder, type=Path)
    parser.add_argument("--pictures", type=Path, help="photograph, picture and twice their difference, side by side")
    options = parser.parse_args()
    several = list(pairs(options.photos, options.masks, options.rendered))
    raw = [(pair.photo - pair.rendered)[pair.judged] for pair in several]
    curve = np.polyfit(
        *(np.concatenate([getattr(p, side)[p.drawn].ravel() for p in several]) for side in ("picture", "photo")), 4
    )
    drawn = [pair.error[pair.drawn] for pair in several]
    answered = [(pair.photo - np.polyval(curve, pair.picture))[pair.drawn] for pair in several]
    rows = [
        ["as they are", raw],
        ["one factor for each photograph: exposure", [pair.error[pair.judged] for pair in several]],
        ["without what pictures leave black: shadows, missing parts", drawn],
        ["and one curve for all: response", answered],
        ["or the best shift of each picture: cameras", [best_shift(pair) for pair in several]],
    ]
    for order in 1, 2, 4:
        left = [smooth_gain(pair, order) for pair in several]
        rows.append([f"or a polynomial of order {order} over each picture: falloff, room", left])
    for sigma in BLURS:
        rows.append([f"or without what is finer than {sigma} px: resolution", [blurred(p, sigma) for p in several]])
    rows = [[what, psnr(left)] for what, left in rows]
    print(table(["", "PSNR, dB"], rows))
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        for pair in several:
            sides = pair.photo, pair.picture, np.clip(0.5 + 2 * pair.error, 0, 1)
            beside = np.concatenate([side * pair.judged[..., None] for side in sides], 1)
            Image.fromarray((255 * beside).astype(np.uint8)).save(options.pictures / f"{pair.name}.png")


if __name__ == "__main__":
    main()
