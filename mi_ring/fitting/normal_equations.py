"""Normal equations of least squares, and the places of all unknowns of a calibration in them."""

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor
from torch.nn import functional as F

from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.unknowns import Exposure

BLOCK = 8  #: width of blocks of pixels whose errors are taken to be correlated


class Layout:
    """The places of all unknowns of a calibration in one vector of all parameters. Its length is `count`."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration, self.first, self.count = calibration, {}, 0
        for name in calibration.widths:
            self.first[name] = self.count
            self.count += getattr(calibration, name).numel()
        #: the room's harmonics that are unknown; R, G, B of each
        self.room = calibration.room.free if "ambient" in calibration.refined else []
        self.first["ambient"] = self.count
        self.count += 3 * len(self.room)

    def places(self, name: str) -> np.ndarray:
        """Return the indices of all components of an unknown, or of the room's light "ambient"."""
        own = name != "ambient"
        count = getattr(self.calibration, name).numel() if own else 3 * len(self.room)
        return self.first[name] + np.arange(count)

    def values(self) -> np.ndarray:
        """Return the current parameters (N,). Powers and gains have mean 0. The room's light counts as 0."""
        unknowns = [getattr(self.calibration, name) for name in self.calibration.widths]
        values = [unknown.double().numpy(force=True).ravel() for unknown in unknowns]
        return self.centring() @ np.concatenate([*values, np.zeros(3 * len(self.room))])

    def centring(self) -> np.ndarray:
        """Return the matrix (N, N) that subtracts from powers and gains their means, as `Calibration` does."""
        result = np.eye(self.count)
        for name, unknown in self.calibration.unknowns.items():
            if isinstance(unknown, Exposure):
                for colour in range(3):
                    at = self.first[name] + 3 * self.calibration.rig.exposed[name].numpy() + colour
                    result[np.ix_(at, at)] -= 1 / max(len(at), 1)
        return result

    def of(self, index: np.ndarray) -> list[tuple[str, int, np.ndarray]]:
        """List the components of all unknowns that affect the photographs `index` (n,): (unknown, component, places).

        An unknown is given by its name, a component by its number. `places` (n,): for each photograph, the index of
        this component in the vector of all parameters. All or none of the photographs have a light of their own.
        """
        result, rig = [], self.calibration.rig
        for name, unknown in self.calibration.unknowns.items():
            if not unknown.concerns(rig, bool(rig.lit[index[0]])):
                continue
            for row in unknown.rows(rig, index):
                first = self.first[name] + unknown.components * row
                result += [(name, k, first + k) for k in range(unknown.components)]
        return result


class Equations:
    """The normal equations of least squares for N = `count` parameters, and the variance of the residuals.

    Photographs are added one by one. Each of the `patches` of the surface has L more unknowns of its own.
    """

    def __init__(self, count: int, patches: int, of_each: int) -> None:
        self.matrix, self.squares, self.pixels = np.zeros((count, count)), 0.0, 0
        self.vector = np.zeros(count)  #: products of the parameters with the errors
        self.own = np.zeros((patches, of_each, of_each))  #: products of a patch's unknowns
        self.cross = np.zeros((patches, of_each, count))  #: of these with the parameters
        self.own_vector = np.zeros((patches, of_each))  #: and of these with the errors

    def add(
        self, slopes: Tensor, error: Tensor, counted: Tensor, places: np.ndarray, local: Tensor, patch: np.ndarray
    ) -> None:
        """Add one photograph to the equations. Pixels of which a number is not finite are left out.

        `slopes` (K, H, W, C): derivatives of the prediction with respect to K parameters. `places` (K,): their indices
        among all N parameters. `error` (H, W, C): prediction minus photograph. `counted` (H, W) bool: True for pixels
        to use. `local` (L, H, W, C): derivatives with respect to the unknowns of the patch (H, W) of each pixel.
        """
        counted = counted & torch.cat([slopes, local, error[None]]).isfinite().all(-1).all(0)
        if not counted.any():
            return
        slopes, own, at = slopes[:, counted].double(), local[:, counted].double(), patch[counted.numpy()]
        flat, off = slopes.flatten(1), error[counted].double()
        np.add.at(self.matrix, np.ix_(places, places), (flat @ flat.T).numpy())
        np.add.at(self.vector, places, (flat @ off.flatten()).numpy())
        summed = csr_matrix((np.ones(len(at)), (at, np.arange(len(at)))), (len(self.own), len(at)))
        products = [torch.einsum("apc,bpc->pab", own, other).flatten(1).numpy() for other in (own, slopes, off[None])]
        self.own += (summed @ products[0]).reshape(self.own.shape)
        self.cross[:, :, places] += (summed @ products[1]).reshape(*self.own.shape[:2], len(places))
        self.own_vector += summed @ products[2]
        height, width, channels = error.shape
        error = torch.where(counted[..., None], error, 0.0).double()
        error = F.pad(error, (0, 0, 0, -width % BLOCK, 0, -height % BLOCK))
        blocks = error.unfold(0, BLOCK, BLOCK).unfold(1, BLOCK, BLOCK).sum((-2, -1))
        self.squares += float(blocks.square().sum())
        self.pixels += channels * int(counted.sum())

    def without_patches(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the normal equations of the N parameters alone, for all added photographs: (N, N) and (N,).

        The matrix is the Fisher information, the inverse of the covariance whatever the unknowns of the patches are.
        These have priors of standard deviation 1.
        """
        if not self.squares:
            return 0 * self.matrix, 0 * self.vector
        weight = self.pixels / self.squares
        own = np.eye(self.own.shape[1]) + weight * self.own
        solved = np.linalg.solve(own, weight * np.dstack([self.cross, self.own_vector]))
        explained = weight * np.tensordot(self.cross, solved, ((0, 1), (0, 1)))  # by the patches
        return weight * self.matrix - explained[:, :-1], explained[:, -1] - weight * self.vector
