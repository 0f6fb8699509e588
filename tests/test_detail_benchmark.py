"""The benchmark of fine structure: its numbers for pictures whose errors are known in closed form, and its patterns."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.special import erf
from skimage.morphology import skeletonize

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)
from mi_ring.geometry.camera import Camera

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import detail
import detail_captures

CAMERA = Camera(np.eye(4), np.array([4000.0, 4000.0]), np.array([105.0, 75.0]), (210, 150))
SEEN = np.ones((150, 210), bool)
X = np.arange(210) + 0.5


def compared(fit: tuple, truth: tuple) -> dict:
    """The numbers of one view; each argument is (normals, colours)."""
    comparison = detail.Comparison()
    comparison.add((*fit, SEEN), (*truth, SEEN), CAMERA)
    return comparison.numbers()


def facing(slope: np.ndarray | float = 0.0) -> np.ndarray:
    """Normals (H, W, 3) toward the camera, turned by these angles [rad]."""
    angle = np.broadcast_to(slope, SEEN.shape)
    return np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], -1).astype(np.float32)


def striped(values: np.ndarray) -> np.ndarray:
    """A colour (H, W, 3) of these values (W,), different in each channel."""
    return np.broadcast_to(values[:, None] * [0.7, 0.5, 0.4], (*SEEN.shape, 3)).astype(np.float32)


def shares(wavelength: float) -> np.ndarray:
    """What each band keeps of the amplitude of a wave: the half-power Gaussians, in closed form."""
    low = [1.0, *(2 ** -((edge / wavelength) ** 2) for edge in (4, 8, 16, 32)), 0.0]
    return -np.diff(low)


@pytest.mark.parametrize("wavelength", [5.0, 11.0])
def test_a_lost_wave_counts_in_its_bands(wavelength):
    wave = np.sin(2 * np.pi * X / wavelength)
    truth = facing(0.05 * wave), striped(1 + 0.1 * wave)
    exact = compared(truth, truth)
    assert max(value for name, value in exact.items() if "error" in name) < 1e-3
    lost = compared((facing(), 3 * striped(np.ones(210))), truth)
    for band, share in zip(detail.BANDS[:4], shares(wavelength)):
        normals, colour = share / math.sqrt(2) * math.degrees(0.05), share / math.sqrt(2) * 10
        assert lost[f"normals {band}, error °"] == pytest.approx(normals, rel=0.04, abs=0.03)
        assert lost[f"normals {band}, none °"] == pytest.approx(normals, rel=0.04, abs=0.03)
        assert lost[f"colour {band}, error %"] == pytest.approx(colour, rel=0.04, abs=0.1)
    assert lost["colour, true %"] == pytest.approx(10 / math.sqrt(2), rel=0.03)
    assert lost["colour, standard deviation %"] < 1e-3


def test_a_blurred_stroke_is_wider_by_the_blur():
    def drawn(blur: float) -> np.ndarray:
        ink = (erf((X - 100) / blur / math.sqrt(2)) - erf((X - 112) / blur / math.sqrt(2))) / 2
        paper, black = detail_captures.PAPER, detail_captures.INK
        return np.broadcast_to(paper + ink[:, None] * (black - paper), (*SEEN.shape, 3)).astype(np.float32)

    found = compared((facing(), drawn(1.5)), (facing(), drawn(0.8)))
    assert found["edges of colour, true px"] == pytest.approx(2.563 * 0.8, abs=0.15)
    assert found["edges of colour, 10-90 % px"] == pytest.approx(2.563 * 1.5, abs=0.3)


def test_strokes_have_their_width():
    azimuth, latitude = np.meshgrid(np.linspace(0, 1, 1601), np.linspace(0, 0.5, 801))
    ink = detail_captures.text_at(azimuth.ravel(), latitude.ravel(), 200.0, [2.0], 0).reshape(azimuth.shape)
    widths = 2 * distance_transform_edt(ink > 0.5) * 200 / 1600  # 1 / 1600 between points at radius 200 px
    assert 0.1 < (ink > 0.5).mean() < 0.4
    assert np.median(widths[skeletonize(ink > 0.5)]) == pytest.approx(2, abs=0.25)


def test_the_slope_of_the_grain_is_one():
    random = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(400) / 2, np.arange(300) / 2)
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) @ np.linalg.qr(random.normal(size=(3, 3)))[0]
    slopes = np.gradient(detail_captures.grain_at(points, np.random.default_rng(1), 1).reshape(x.shape), 0.5)
    assert np.sqrt(np.mean(np.square(slopes).sum(0))) == pytest.approx(1, rel=0.1)
    assert detail_captures.grain_at(points, np.random.default_rng(1), 0).std() == pytest.approx(1, rel=0.1)
