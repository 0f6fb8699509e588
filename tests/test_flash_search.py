"""The flash is found by highlights, which another program has made."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.matte_ball import pale_ball, photographed, plain

from mi_ring.capture.loading import load_capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.flash_search import find_flash
from mi_ring.rendering.surface import Surface

FLASH = 1.0  #: to the left of the lens; the cameras are at 4
GLOSS = {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.2, "material": "none",
         "specular_reflectance": 0.2}  # fmt: skip


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """A glossy and a matte ball."""
    made = {}
    for name, gloss in {"glossy": GLOSS, "matte": None}.items():
        folder = tmp_path_factory.mktemp(name)
        made[name] = load_capture(photographed(folder, plain, count=8, width=96, aside=FLASH, gloss=gloss), width=96)
    return made


def found(capture, stated):
    """Where the search puts the flash [left, up], if the capture states `stated`, and the fit a matte ball; or None."""
    shots = []
    for shot in capture.shots:
        pose = shot.camera.to_world
        place = shot.camera.position + stated[0] * pose[:3, 0] + stated[1] * pose[:3, 1]
        shots.append(dataclasses.replace(shot, light=shot.light._replace(vector=place)))
    config = dataclasses.replace(Config(), iterations=10, levels=(2,), widths=(28,), shares=(1.0,),
                                 refine=("light",), domain="sphere")  # fmt: skip
    fit = Fit(dataclasses.replace(capture, shots=shots), config)
    ring = pale_ball()
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(5))
    model = SimpleNamespace(ring=ring, calibration=fit.model.calibration)
    renderer = SimpleNamespace(show=lambda *_: surface)
    value = find_flash(fit.problem, model, renderer, 5)
    assert not fit.model.calibration.get_parameter("light").any()  # as before
    if value is None:
        return None
    return np.array(stated) + fit.model.calibration.widths["light"] * 4 * value[0, :2].numpy()


@pytest.mark.parametrize("stated", [(0.0, 0.0), (0.3, -0.8), (-1.2, 0.4)])
def test_highlights_tell_the_place(captures, stated):
    """The flash in a wrong place makes wrong matte shading, too. A second search is nearer."""
    first = found(captures["glossy"], stated)
    np.testing.assert_allclose(first, [FLASH, 0], atol=0.3)
    second = found(captures["glossy"], tuple(first))
    np.testing.assert_allclose(first if second is None else second, [FLASH, 0], atol=0.16)  # steps are 0.15


def test_a_flash_in_the_right_place_stays(captures):
    assert found(captures["glossy"], (FLASH, 0.0)) is None


def test_without_highlights_the_flash_stays(captures):
    assert found(captures["matte"], (0.3, 0.5)) is None


@pytest.mark.parametrize("alone, names", [(False, ["diffuse", "specular", "roughness"]), (True, ["reflectance"])])
def test_beside_other_lights_and_of_other_materials_highlights_are_not_known(alone, names):
    net = SimpleNamespace(bsdf_parameters=[SimpleNamespace(name=name) for name in names])
    calibration = SimpleNamespace(unknowns=["light"], flash_alone=alone)
    assert (
        find_flash(None, SimpleNamespace(ring=SimpleNamespace(brdf_net=net), calibration=calibration), None, 3) is None
    )
