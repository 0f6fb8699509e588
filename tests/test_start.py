"""Where a fit starts: from the sphere, the hull or a mesh, with captures of every kind."""

import re

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from conftest import AXES, CENTER
from helpers.quick_fits import BRIEF, QUICK, SPHERE, distance

from mi_ring import fit
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import checkpoint, start
from mi_ring.fitting.fit import Fit
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.objects.ring_file import load_fit
from mi_ring.output import results

PLAIN = [*QUICK, "--refine", "none", "--no-indirect"]  #: surface and material alone


def masks_on_some(path):
    text = path.read_text()
    for k in range(0, 12, 2):
        text = text.replace(f'<string name="mask" value="masks/{k:03}.png"/>', "")
    path.write_text(text)


def no_masks(path):
    path.write_text(re.sub(r'<string name="mask" value="[^"]*"/>', "", path.read_text()))


def two_sizes(path):
    """The first photograph loses its last 3 columns and 5 rows, film and mask as well."""
    for folder in ("images", "masks"):
        file = path.parent / folder / "000.png"
        mi.Bitmap(np.ascontiguousarray(np.array(mi.Bitmap(str(file)))[:-5, :-3])).write(str(file))
    film = '<integer name="width" value="56"/><integer name="height" value="40"/>'
    path.write_text(path.read_text().replace(film, film.replace("56", "53").replace("40", "35"), 1))


def torus_domain(path):
    trimesh.creation.torus(20, 8).apply_translation(CENTER).export(path.parent / "torus.ply")
    bsdf = '<bsdf type="cooktorrance"/>'
    path.write_text(path.read_text().replace(bsdf, '<string name="domain" value="torus.ply"/>' + bsdf))


def distant_lights(path):
    light = '<emitter type="directional"><vector name="direction" x="1" y="0.2" z="-2"/></emitter>'
    path.write_text(re.sub(r"<emitter.*?</emitter>", light, path.read_text()))


@pytest.mark.parametrize("change", [masks_on_some, no_masks, two_sizes, torus_domain, distant_lights])
def test_captures_of_every_kind_are_fitted(change, broken_capture, tmp_path):
    path, _ = broken_capture
    change(path)
    quick = SPHERE if change in (two_sizes, distant_lights) else PLAIN  # which take longer, from a hull or a mesh
    assert fit.main([str(path), "--out", str(tmp_path / "run"), "--iterations", "6", *quick]) == 0
    log = results.read_log(tmp_path / "run")
    assert all(np.isfinite(entry["loss"]) for entry in log)
    mesh = trimesh.load(tmp_path / "run" / "mesh.ply", process=False)
    assert mesh.is_watertight and mesh.euler_number == (0 if change is torus_domain else 2)


def test_start_from_the_visual_hull(small_capture, tmp_path):
    run = tmp_path / "run"
    assert fit.main([str(small_capture), "--out", str(run), "--iterations", "6", "--domain", "hull", *PLAIN]) == 0
    assert distance(run / "mesh.ply") < 0.04  # hardly a fit: it is the start that is near
    mesh = trimesh.load(run / "mesh.ply", process=False)
    assert mesh.is_watertight and mesh.euler_number == 2
    domain = load_fit(run).domain
    assert type(domain) is Domain and np.linalg.norm(domain.points, axis=1).mean() == pytest.approx(1, abs=0.01)
    again = mi.load_dict({"type": "shapenet", "weights": str(run / "ring.pt"), "subdivisions": 3})
    vertices = np.array(mi.traverse(again)["vertex_positions"]).reshape(-1, 3)
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-3)


def test_fits_from_a_hull_go_on_from_the_same_hull(small_capture, tmp_path, monkeypatch):
    config = fit.parse_options(
        [str(small_capture), "--out", str(tmp_path), "--domain", "hull", "--iterations", "6", *QUICK]
    )
    before = Fit(load_capture(small_capture), config)
    assert before.iterations == 5  # of six: 3.6 of the first stage become 1.2, 2.4 of the second 3.4
    for _ in range(3):
        before.step()
    checkpoint.write_checkpoint(before, {}, tmp_path)
    monkeypatch.setattr(start, "starting_surface", None)  # the domain is that of the checkpoint
    after = Fit(load_capture(small_capture), config, state=checkpoint.read_checkpoint(tmp_path, config)["fit"])
    for level in (2, 3):
        (s, faces), (again, same) = before.ring.domain.sample(level), after.ring.domain.sample(level)
        assert torch.equal(s, again) and np.array_equal(faces, same)
    with torch.no_grad():
        torch.testing.assert_close(before.ring.surface(s), after.ring.surface(s))
    drawn = [f.ring.domain.sample(2, f.sampler.random["rotations"])[0] for f in (before, after)]
    assert torch.equal(*drawn)


def test_start_from_a_mesh(small_capture, tmp_path):
    trimesh.creation.torus(20, 8).apply_translation(CENTER).export(tmp_path / "torus.ply")
    run = tmp_path / "run"
    domain = ["--domain", "mesh", str(tmp_path / "torus.ply")]
    assert fit.main([str(small_capture), "--out", str(run), "--iterations", "4", *domain, *PLAIN]) == 0
    assert trimesh.load(run / "mesh.ply", process=False).euler_number == 0


def test_auto_takes_the_hull(small_capture):
    scene = load_capture(small_capture)
    domain, center, radius = start.starting_surface(scene, "auto")
    assert type(domain) is Domain and trimesh.Trimesh(domain.points, domain.faces).euler_number == 2
    np.testing.assert_allclose(center, CENTER, atol=2)
    assert radius == pytest.approx(AXES.mean(), rel=0.1)
    assert type(start.starting_surface(scene, "sphere")[0]) is Sphere


def test_where_the_scene_says_where_the_object_is_bad_masks_do_not_stop_a_fit(broken_capture):
    path, _ = broken_capture
    mi.Bitmap(np.zeros((40, 56, 1), np.uint8)).write(str(path.parent / "masks/004.png"))
    with pytest.raises(InputError, match="mask: is empty"):
        start.starting_surface(load_capture(path), "auto")
    bsdf = '<bsdf type="cooktorrance"/>'
    place = '<point name="center" x="400" y="-150" z="90"/><float name="radius" value="30"/>'
    path.write_text(path.read_text().replace(bsdf, bsdf + place))
    domain, center, radius = start.starting_surface(load_capture(path), "auto")
    assert type(domain) is Sphere and center.tolist() == CENTER.tolist() and radius == 30
    with pytest.raises(InputError, match="mask: is empty"):
        start.starting_surface(load_capture(path), "hull")


def test_a_domain_of_the_scene_does_not_normalise_another(broken_capture):
    path, _ = broken_capture
    torus_domain(path)
    scene = load_capture(path)
    assert start.starting_surface(scene, "auto")[0] is scene.shape.domain[0]
    domain, _, radius = start.starting_surface(scene, "sphere")
    assert type(domain) is Sphere and radius == pytest.approx(scene.sphere()[1]) != scene.shape.domain[2]


def test_without_masks_the_object_is_what_is_bright(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    no_masks(path)
    run = tmp_path / "run"
    assert fit.main([str(path), "--out", str(run), "--iterations", "24", *PLAIN]) == 0
    assert '"mask"' in (run / "log.jsonl").read_text() and distance(run / "mesh.ply") < 0.05
    with pytest.raises(InputError, match="--domain hull: there are no masks of the whole object"):
        fit.main([str(path), "--out", str(run), "--domain", "hull", "--masks", "given", *QUICK])
    for file in path.parent.glob("images/*.png"):
        mi.Bitmap(np.maximum(np.array(mi.Bitmap(str(file))), 90)).write(str(file))
    assert fit.main([str(path), "--out", str(tmp_path / "bright"), "--iterations", "1", *BRIEF]) == 0
    assert "the room was too bright to find masks" in capsys.readouterr().out
