"""Ratios of photographs and predictions, at points of the surface."""

import warnings
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from mi_ring.objects.detail import Grid, corner_values

SOLVING = 4  #: steps to find the values of the corners of a grid
CERTAIN = 0.05  #: least share of the ratios that halves of the photographs have in common
PATCHES, PATCH = 300, 64  #: places at which photographs are compared with each other, and number of points of each
FEWEST, LEAST = 3, 0.01  #: number of photographs that are compared with each other; least weight of one
USUAL = 2.0  #: variances up to this multiple of their median are usual
FLAT = 1e-3  #: smaller differences of logarithms count as none
SAME = 1e-3  #: smaller variances, relative to what is usual in a patch, count as none


class Points(NamedTuple):
    """Points in the triangles of a mesh, at the centres of equal parts."""

    faces: np.ndarray  #: (F, 3)
    shares: np.ndarray  #: (n, 3) barycentric coordinates of the points of each triangle

    @classmethod
    def of(cls, faces: np.ndarray, divisions: int) -> "Points":
        """Make `divisions`² points in each triangle of `faces` (F, 3)."""
        steps = np.indices((divisions, divisions)).reshape(2, -1).T
        above = np.concatenate([steps[steps.sum(1) < divisions - k] + (k + 1) / 3 for k in range(2)]) / divisions
        return cls(faces, np.column_stack([1 - above.sum(1), above]).astype(np.float32))

    def at(self, values: np.ndarray, triangles: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Interpolate values (V, C) of the vertices at the points of triangles: (f, n, C) float32.

        `triangles` (f,): indices; by default all.
        """
        corners = values.astype(np.float32)[self.faces[triangles]]
        return sum(self.shares[:, k, None] * corners[:, None, k] for k in range(3))


def bilinear(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Interpolate a picture (H, W, C) at pixel coordinates (N, 2): (N, C) float32. All must be inside it."""
    rows = max(1, -(-len(pixels) // 4096))  # OpenCV takes no empty arrays
    maps = np.full((2, rows * 4096), 0.5, np.float32)
    maps[:, : len(pixels)] = pixels.T - 0.5
    across, down = maps.reshape(2, rows, 4096)
    found = cv2.remap(picture, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(rows * 4096, -1)[: len(pixels)]


class LowPass:
    """Means of values on a surface, around the corners of cubes.

    `points`: where the values are. `s` (V, 3): vertices on the domain. `cell`: side of the cubes, on the domain.
    """

    def __init__(self, points: Points, s: torch.Tensor, cell: float) -> None:
        centres = s[torch.from_numpy(points.faces)].mean(1)
        grid = Grid.around(torch.cat([s, centres]), cell, 1, 1)
        self.gather, self.spread = (grid.weights(at)[0] for at in (centres, s))

    def of(self, sums: np.ndarray, weights: np.ndarray, otherwise: float = 0.0) -> np.ndarray:
        """Return means (V, C) at the vertices. `sums` (F, C), `weights` (F,): of weighted values of the triangles.

        `otherwise`: the value of a vertex that has nothing around it.
        """
        both = self.spread @ (self.gather.T @ np.column_stack([sums, weights]))
        sums, total = both[:, :-1], both[:, -1:]
        return np.where(total > 0, sums / np.where(total > 0, total, 1), otherwise)


class Ratios:
    """Logarithms of ratios at n points of each triangle of a surface, from each half of the photographs."""

    def __init__(self, points: Points) -> None:
        self.points = points
        self.sums = np.zeros((2, len(points.faces), len(points.shares), 3), np.float32)
        self.weights = np.zeros(self.sums.shape[:3], np.float32)

    def add(self, half: int, triangles: np.ndarray, logarithms: np.ndarray, weights: np.ndarray) -> None:
        """Add what a photograph shows. `triangles` (f,): indices. `logarithms` (f, n, 3). `weights` (f, n)."""
        self.sums[half, triangles] += logarithms * weights[..., None]
        self.weights[half, triangles] += weights

    @torch.no_grad()
    def texture(self, s: torch.Tensor, coarse: float, fine: float) -> Grid | None:
        """Return what both halves show as a grid with the channels red, green and blue; None if this is nothing.

        `s` (V, 3): vertices of the triangles, on the domain. `coarse`: longer waves are left out. `fine`: side of the
        cubes of the grid. Both are lengths on the domain. Afterwards, the ratios are gone.
        """
        values, weights = self.agreed(LowPass(self.points, s, coarse)), self.weights.sum(0)
        del self.sums, self.weights  # before more memory is needed
        if values is None:
            return None
        shown = weights > 0
        at, values, weights = torch.from_numpy(self.points.at(s.numpy())[shown]), values[shown], weights[shown]
        grid = Grid.around(at, fine, 1, 3)
        (shares,) = grid.weights(at)
        found = corner_values(shares, values, weights, SOLVING)
        found = found.clip(values.min(0), values.max(0))  # a corner beside few points may be far off
        grid.values[0].copy_(torch.from_numpy(found))
        grid.latest.clear()  # the weights take more memory than the values
        return grid

    def agreed(self, low_pass: LowPass) -> np.ndarray | None:
        """Return what both halves show of fine ratios: (F, n, 3) logarithms. Replaces the sums by fine means.

        Coarse differences are subtracted. What remains is multiplied by the share of its variance nearby that the
        halves have in common: so noise is left out (Wiener's filter). Returns None if they have hardly anything in
        common.
        """
        means, total = self.sums, self.weights.sum(0)
        for own, weights in zip(means, self.weights):
            own /= np.maximum(weights, 1e-9)[..., None]
            # Of the ratios themselves: the fitted colour of a print is the mean of ink and paper, not of logarithms.
            coarse = low_pass.of((np.exp(own) * weights[..., None]).sum(1), weights.sum(1), otherwise=1.0)
            own -= self.points.at(np.log(coarse))
        both = np.where((self.weights > 0).all(0), total, 0)
        common = (both * means.prod(0).mean(-1)).sum(1)
        different = (both * np.square(means[0] - means[1]).mean(-1) / 4).sum(1)
        if not both.any() or common.sum() < CERTAIN * (common + different).sum():
            return None
        variances = low_pass.of(np.column_stack([common, different]), both.sum(1)).clip(min=0)
        share = self.points.at(variances[:, :1] / np.maximum(variances.sum(1, keepdims=True), 1e-12))
        return share * (means * self.weights[..., None]).sum(0) / np.maximum(total, 1e-9)[..., None]


class PatchRatios:
    """Ratios of each photograph in small patches of a surface. They show which photographs disagree with the others.

    `points`: those of the ratios; the first one in a triangle is used. `s` (V, 3): vertices on the domain. `count`:
    number of photographs.
    """

    def __init__(self, points: Points, s: np.ndarray, count: int) -> None:
        centres = s[points.faces].mean(1)
        some = np.linspace(0, len(centres) - 1, min(PATCHES, len(centres))).astype(int)
        near = cKDTree(centres).query(centres[some], min(PATCH, len(centres)))[1]
        self.triangles, self.number = near.reshape(len(some), -1), len(centres)  #: (patches, points); of triangles
        self.ratios = np.full((count, *self.triangles.shape, 3), np.nan, np.float32)

    def add(self, photograph: int, triangles: np.ndarray, logarithms: np.ndarray, weights: np.ndarray) -> None:
        """Add what a photograph shows. `triangles` (f,): indices. `logarithms` (f, n, 3). `weights` (f, n)."""
        place = np.full(self.number, -1)
        place[triangles] = np.arange(len(triangles))
        here = place[self.triangles]
        shown = (here >= 0) & (weights[here, 0] > 0 if len(weights) else False)
        self.ratios[photograph][shown] = logarithms[here[shown], 0]

    def trust(self) -> np.ndarray:
        """Return weights (count,) of the photographs: 1, or down to `LEAST` if one differs from the median of all.

        Of each patch, only differences from its mean count: light and shape of the fit are not exact. Each photograph
        sees other patches, so differences are divided by what is usual in their patch. The median times a factor, the
        photograph's contrast, is subtracted. What remains, divided by the contrast, counts. So a sharp photograph among
        blurred ones is not doubted.
        """
        seen = np.isfinite(self.ratios[..., 0])
        seen &= seen.sum(2, keepdims=True) >= self.triangles.shape[1] / 2
        seen &= seen.sum(0) >= FEWEST
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # some patches are seen by no photograph
            fine = np.where(seen[..., None], self.ratios, np.nan)
            fine -= np.nanmean(fine, 2, keepdims=True)
            median = np.nanmedian(fine, 0)
            differences = np.nanmean(np.square(fine - median), (2, 3))
            scale = np.sqrt(np.maximum(np.nanmedian(differences, 0), FLAT**2))[:, None, None]
            fine, median = fine / scale, np.where(seen[..., None], median / scale, np.nan)
            contrast = np.nansum(fine * median, (1, 2, 3)) / np.nansum(median**2, (1, 2, 3))
            contrast = np.clip(np.nan_to_num(contrast, nan=1.0), 1e-3, None)
            rest = fine - contrast[:, None, None, None] * median
            variance = np.nanmean(np.square(rest), (1, 2, 3)) / contrast**2
            usual = np.maximum(USUAL * np.nanmedian(variance), SAME)
        excess = np.where(variance > usual, variance / usual, 1.0)  # 1 where nothing can be compared
        return np.maximum(excess**-2, LEAST)
