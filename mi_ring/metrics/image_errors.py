"""How near predicted photographs are to the files: PSNR and SSIM."""

from collections.abc import Sequence

import numpy as np
from skimage.metrics import structural_similarity

from mi_ring.capture.capture import Capture, Observation
from mi_ring.capture.decoding import recorded
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

SPP = 64  #: samples per pixel of predicted photographs, by default
WINDOW = 11  #: of SSIM [px]


def compare_photographs(
    capture: Capture, ring: FittedObject, spp: int, index: Sequence[int] | None = None
) -> tuple[dict[str, float], list[dict]]:
    """`psnr` [dB] and `ssim` of predictions as 8-bit sRGB against the files, sRGB in [0, 1].

    Of the photographs `index`, by default all, from the mean of their squared errors and as the mean of their SSIM, and
    of each. What is predicted is what `mi_ring.render` writes by default. Where it is exact there is no PSNR. In a room
    that was not black only what is wholly object by its mask counts: nobody predicts the rest.
    """
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    squares = []
    views: list[dict] = []
    for k in range(len(capture)) if index is None else index:
        name = capture.names[k]
        rgb, _ = prediction.draw(
            surface, capture.photograph(k), spp=spp, shadows=capture.shadows, indirect=ring.indirect
        )
        predicted = to_bytes(linear_to_srgb(recorded(rgb[0].numpy(), capture.shots[k]))) / 255
        seen = capture.observe([k])
        observed = linear_to_srgb(recorded(seen.rgb[0].numpy(), capture.shots[k]))
        telling = comparable(capture, seen)
        if not telling.any():
            views.append({"name": name})
            continue
        predicted = np.where(telling[..., None], predicted, observed)
        squares.append(np.mean((predicted - observed)[telling] ** 2))
        views.append({"name": name, **decibels(squares[-1]), **ssim(predicted, observed, telling)})
    similar = [view["ssim"] for view in views if "ssim" in view]
    totals = decibels(np.mean(squares)) if squares else {}
    return totals | ({"ssim": float(np.mean(similar))} if similar else {}), views


def comparable(capture: Capture, seen: Observation) -> np.ndarray:
    """(H, W) bool: which pixels of the first photograph seen can be as predicted."""
    telling = np.ones(seen.mask.shape[1:], bool) if seen.valid is None else seen.valid[0].numpy()
    if seen.masked[0] and capture.lit_room:
        return telling & (seen.mask[0].numpy() > 0.99)
    return telling


def decibels(square: float) -> dict[str, float]:
    """PSNR of a mean squared error."""
    return {"psnr": float(-10 * np.log10(square))} if square else {}


def ssim(a: np.ndarray, b: np.ndarray, telling: np.ndarray | None = None) -> dict[str, float]:
    """Structural similarity of images (H, W, 3) in [0, 1], mean over channels, none if they are less than its window.

    `telling` (H, W) bool: the pixels over which it is averaged; None: all of whose neighbours its window holds.

    Wang et al., Image Quality Assessment, IEEE TIP 2004: Gaussian window of 11 × 11 pixels, σ = 1.5 px.
    """
    if min(a.shape[:2]) < WINDOW:
        return {}
    wang = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    mean, local = structural_similarity(a, b, data_range=1, channel_axis=-1, full=True, **wang)
    return {"ssim": float(mean if telling is None or telling.all() else local[telling].mean())}
