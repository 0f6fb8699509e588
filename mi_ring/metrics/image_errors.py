"""Measures the errors of predicted photographs: PSNR and SSIM."""

from collections.abc import Sequence

import numpy as np
from skimage.metrics import structural_similarity

from mi_ring.capture.capture import Capture, Observation
from mi_ring.capture.decoding import recorded
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface
from mi_ring.system.progress import progress

SPP = 64  #: default samples per pixel of predicted photographs
WINDOW = 11  #: width of the window of SSIM [px]


def compare_photographs(
    capture: Capture, ring: FittedObject, spp: int, index: Sequence[int] | None = None
) -> tuple[dict[str, float], list[dict]]:
    """Render photographs of the object `ring`, and compare them with the photographs of the capture.

    `index`: the photographs to compare; None: all. `spp`: samples per pixel. Returns (totals, list with one dict for
    each photograph). Totals are `psnr` [dB] of the mean squared error and the mean `ssim`; each photograph has both and
    its `name`. The comparison is in sRGB, with renderings rounded to 8 bits, at valid pixels; in a lit room, only
    inside the mask. `psnr` is missing if there is no error.
    """
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    squares = []
    views: list[dict] = []
    index = range(len(capture)) if index is None else index
    for k in progress(index, "comparing", len(index), unit="photograph"):
        rgb, _ = prediction.draw(
            surface, capture.photograph(k), spp=spp, shadows=capture.shadows, indirect=ring.indirect
        )
        predicted = to_bytes(linear_to_srgb(recorded(rgb[0].numpy(), capture.shots[k]))) / 255
        seen = capture.observe([k])
        observed = linear_to_srgb(recorded(seen.rgb[0].numpy(), capture.shots[k]))
        compared = comparable(capture, seen)
        views.append({"name": capture.names[k]})
        if compared.any():
            predicted = np.where(compared[..., None], predicted, observed)
            squares.append(np.mean((predicted - observed)[compared] ** 2))
            views[-1] |= {**decibels(squares[-1]), **ssim(predicted, observed, compared)}
    similar = [view["ssim"] for view in views if "ssim" in view]
    totals = decibels(np.mean(squares)) if squares else {}
    return totals | ({"ssim": float(np.mean(similar))} if similar else {}), views


def comparable(capture: Capture, seen: Observation) -> np.ndarray:
    """Return a boolean mask (H, W) of the pixels at which the first photograph of `seen` is compared with a rendering.

    It is True for valid pixels. In a lit room, it is True only inside the mask, if there is one.
    """
    valid = np.ones(seen.mask.shape[1:], bool) if seen.valid is None else seen.valid[0].numpy()
    return valid & (seen.mask[0].numpy() > 0.99) if seen.masked[0] and capture.lit_room else valid


def decibels(square: float) -> dict[str, float]:
    """Convert a mean squared error of values in [0, 1] to {`psnr`: PSNR [dB]}; {} if the error is 0."""
    return {"psnr": float(-10 * np.log10(square))} if square else {}


def ssim(a: np.ndarray, b: np.ndarray, compared: np.ndarray | None = None) -> dict[str, float]:
    """Compute the structural similarity of two images (H, W, 3) in [0, 1]. Returns a dict: {`ssim`: value}.

    The value is the mean over channels and over the pixels `compared` (H, W) bool; None: over all pixels whose window
    is inside the image. The dict is empty if the images are smaller than the window. The definition is that of Wang et
    al., Image Quality Assessment, IEEE TIP 2004: Gaussian window of 11 × 11 px, σ = 1.5 px.
    """
    if min(a.shape[:2]) < WINDOW:
        return {}
    wang = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    mean, local = structural_similarity(a, b, data_range=1, channel_axis=-1, full=True, **wang)
    return {"ssim": float(mean if compared is None or compared.all() else local[compared].mean())}
