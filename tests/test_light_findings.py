"""What `mi-ring check` says of room, curve and exposures, on brightness in closed form."""

import numpy as np
import pytest
import trimesh

from mi_ring.metrics.brightness_samples import BrightnessSamples, surface_points
from mi_ring.metrics.light_findings import Table, falloff_exponent, fit, light_findings
from mi_ring.scene.tone_curve import contrasted

NAMED, FLAT, FALLOFF = (
    "the room's light on the object is",
    "shading is flatter",
    "brightness falls too little with the flash's distance",
)


def sphere(nearest=2.5, farthest=5.0, seed=3):
    """Points of a lopsided sphere, seen from 24 cameras with a flash at the lens, and what each photograph gets there.

    The material is brighter on one side, from which the photographs are taken from farther away. Normals are a little
    wrong. Returns (samples of brightness 1 / π of the irradiance without a room, reflected share (K, M)).
    """
    random = np.random.default_rng(seed)
    directions = random.normal(size=(400, 3))
    normals = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    points = normals * np.array([1.0, 0.8, 0.6])
    normals = normals / np.array([1.0, 0.8, 0.6])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = np.exp(random.normal(0, 0.1, 400) + 0.4 * normals[:, 0])
    cameras = random.normal(size=(24, 3))
    cameras /= np.linalg.norm(cameras, axis=1, keepdims=True)
    away = np.clip(
        random.uniform(nearest, farthest, 24) + 0.3 * (farthest - nearest) * cameras[:, 0], nearest, farthest
    )
    toward = (cameras * away[:, None])[:, None] - points
    distance = np.linalg.norm(toward, axis=-1)
    toward /= distance[..., None]
    true = (normals * toward).sum(-1)
    rough = normals + random.normal(0, 0.01, normals.shape)
    cosine = (rough / np.linalg.norm(rough, axis=1, keepdims=True) * toward).sum(-1)
    irradiance = np.where(true > 0.1, np.median(away) ** 2 / distance**2, np.nan)
    noise = np.exp(random.normal(0, 0.02, irradiance.shape))
    place = np.stack([np.log((toward * cameras[:, None]).sum(-1)), *np.zeros((4, *cosine.shape))], -1)
    reflected = 0.1 * albedo * noise
    brightness = reflected * irradiance * true
    return BrightnessSamples(brightness, irradiance, cosine, place, np.zeros(cosine.shape, bool), away**-2.0), reflected


def test_nothing_is_said_of_brightness_that_follows_the_flash():
    samples, _ = sphere()
    assert not light_findings(samples)
    table = Table.of(samples)
    exponent, deviation = falloff_exponent(table, fit(table))
    assert abs(exponent - 1) < 0.1 and deviation < 0.05


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_room_is_named_with_its_share(share):
    samples, reflected = sphere()
    samples.brightness += reflected * share
    (text,) = light_findings(samples)
    assert text.startswith(NAMED) and f" {share:.0%} " in text


def test_a_room_in_photographs_of_free_exposures_is_named_too():
    """Between them, brightness is then no evidence; shading is."""
    samples, reflected = sphere()
    samples.brightness += reflected * 0.5
    samples.brightness *= np.random.default_rng(0).uniform(0.4, 1.6, (24, 1))
    (text,) = light_findings(samples)
    assert text.startswith(NAMED) and any(f" {share}% " in text for share in (40, 50, 60))


def test_a_room_without_a_flash_is_not_said_to_be_a_curve():
    """The light of each photograph is then not what the scene file says."""
    samples, reflected = sphere()
    samples.brightness = np.where(np.isfinite(samples.brightness), reflected, np.nan)
    (text,) = light_findings(samples)
    assert text.startswith(FLAT) and "light of the room and a flatter curve" in text and "better" not in text


@pytest.mark.parametrize("curve", [lambda b: 0.7 * b**0.7, lambda b: contrasted(b, 0.7)], ids=["power", "contrast"])
def test_a_flat_curve_is_no_room_of_some_share(curve):
    samples, _ = sphere()
    samples.brightness = curve(samples.brightness)
    (text,) = light_findings(samples)
    assert text.startswith(FLAT) and "%" not in text and "curve of the camera" in text


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_automatic_exposures_are_no_room(strength):
    samples, _ = sphere()
    samples.brightness *= (samples.falloff / np.median(samples.falloff))[:, None] ** -strength
    (text,) = light_findings(samples)
    assert text == f"{FALLOFF}: as by exposures that follow the distance"


def test_a_steep_curve_and_random_exposures_are_no_findings():
    """A fit finds both, and neither looks like a room."""
    samples, _ = sphere()
    plain = samples.brightness
    for changed in (contrasted(plain, 1.3), plain * np.random.default_rng(1).uniform(0.5, 1.5, (24, 1))):
        samples.brightness = changed
        assert not light_findings(samples)


def test_photographs_from_one_distance_say_nothing_of_exposures():
    samples, _ = sphere(3.0, 3.0)
    samples.brightness *= np.random.default_rng(1).uniform(0.5, 1.5, (24, 1))
    assert not light_findings(samples)


def test_clipped_pixels_are_no_room():
    """They are too dark where the flash is near. What is left must not be chosen by its brightness."""
    samples, _ = sphere()
    bright = 6 * samples.brightness
    samples.clipped = bright > 1
    samples.brightness = bright.clip(max=1)
    assert 0.1 < samples.clipped[np.isfinite(bright)].mean() < 0.4
    assert not light_findings(samples)


def test_too_few_photographs_say_nothing():
    samples, reflected = sphere()
    samples.brightness += reflected * 0.6
    samples.brightness[11:] = np.nan
    assert not light_findings(samples)


def test_points_are_even_by_area():
    box = trimesh.creation.box((1, 1, 8)).subdivide().subdivide()
    points, normals = surface_points(box, 340)
    assert abs(np.isclose(np.abs(points[:, 2]), 4).sum() - 20) <= 2
    assert np.allclose(np.linalg.norm(normals, axis=1), 1) and (normals * points).sum(1).min() > 0
    assert np.array_equal(points, surface_points(box, 340)[0])
