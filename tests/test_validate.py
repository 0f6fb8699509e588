"""`validate`: the comparison with Mitsuba's path tracer against closed forms, and that its p-values can be trusted."""

import io
import json

import mitsuba as mi
import numpy as np
import pytest
import torch
from PIL import Image
from scipy import stats

from mi_ring import __main__, validate
from mi_ring.errors import InputError
from mi_ring.metrics import path_tracing, renderer_agreement
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.output import validation_sheet
from mi_ring.plugins.cooktorrance import CookTorrance
from mi_ring.rendering.photographs import Photographs
from mi_ring.system import files

WIDTH, HEIGHT, FOCAL, CENTRE = 35, 25, (30.0, 27.0), (16.2, 13.4)  # [px]
SCENE = '<scene version="3.0.0">{body}</scene>'
POINT = """<emitter type="point"><point name="position" x="{0[0]}" y="{0[1]}" z="{0[2]}"/>
  <rgb name="intensity" value="{1}"/></emitter>"""
DISTANT = """<emitter type="directional"><vector name="direction" x="-0.5" y="0.6" z="-1"/>
  <rgb name="irradiance" value="1, 2, 3"/></emitter>"""


def sensor(name, origin, target, light="", size=(WIDTH, HEIGHT)):
    origin, target = (", ".join(map(str, p)) for p in (origin, target))
    return f"""<sensor type="photograph" id="{name}"><string name="filename" value="{name}.png"/>
      <float name="fx" value="{FOCAL[0]}"/><float name="fy" value="{FOCAL[1]}"/>
      <float name="cx" value="{CENTRE[0]}"/><float name="cy" value="{CENTRE[1]}"/>
      <transform name="to_world"><lookat origin="{origin}" target="{target}" up="0.3, 1, 0.2"/></transform>
      <film type="hdrfilm"><integer name="width" value="{size[0]}"/><integer name="height" value="{size[1]}"/></film>
      {light}</sensor>"""


def shapenet(bsdf="cooktorrance"):
    """A turned ellipsoid with a highlight, off the origin."""
    return f"""<shape type="shapenet" id="object">
      <transform name="to_world"><scale x="1" y="0.6" z="0.8"/><rotate x="1" y="2" z="0" angle="40"/>
      <translate x="0.3" y="-0.2" z="0.4"/></transform>
      <bsdf type="{bsdf}"><rgb name="diffuse" value="0.2, 0.1, 0.05"/><float name="specular" value="0.1"/>
      <float name="roughness" value="0.4"/></bsdf></shape>"""


ELLIPSOID = shapenet()
CONVEX = [
    sensor("a", [1.5, 0.4, 3.6], [0.3, -0.2, 0.4], POINT.format([2.0, 1.5, 3.0], "9, 7, 5")),
    sensor("b", [-1.2, 1.1, 3.2], [0.2, 0.1, 0.0], DISTANT),
    sensor("c", [0.5, -1.6, 3.4], [0.2, 0.1, 0.3], size=(49, 52)),  # a flash at the camera
]


def write(folder, *body, name="try.xml"):
    (folder / name).write_text(SCENE.format(body="\n".join(body)))
    return folder / name


def run(path, *options, out="out"):
    """The command: its status and what it wrote into validate.json."""
    folder = path.parent / out
    status = validate.main([str(path), "--out", str(folder), *options])
    return status, json.loads((folder / "validate.json").read_text())


def comparison(scene, sensors, k=0, depth=6, spp=4):
    pictures = path_tracing.render_both(
        path_tracing.with_flash(scene),
        Photographs.of([sensor.shot for sensor in sensors]),
        k,
        sensors[k],
        1,
        spp,
        depth,
        32 * k,
    )
    return renderer_agreement.compare_renderers("this", pictures)


# What it says of scenes with a known answer.


def test_on_a_convex_object_photometric_is_all_of_path(tmp_path, capsys):
    path = write(tmp_path, ELLIPSOID, *CONVEX)
    status, numbers = run(path)
    assert status == 0
    assert [row["name"] for row in numbers["photographs"]] == ["a.png", "b.png", "c.png"]
    scene = mi.load_file(str(path), parallel=False)
    for k, row in enumerate([*numbers["photographs"], numbers["all"]]):
        assert row["p_direct"] > 0.001 and row["p_path"] > 0.001
        assert row["interreflection"] == pytest.approx(0, abs=1e-6)
        assert abs(row["unexplained"]) < 5 * row["unexplained_noise"] < 0.01
        if k < 3:
            picture = mi.render(scene, sensor=k, integrator=mi.load_dict({"type": "path"}), spp=256)
            assert row["radiance"] == pytest.approx(np.array(picture)[..., :3].mean(), rel=0.02)
    assert "direct light agrees with path" in capsys.readouterr().out


def rays(origin, target, subpixels=16):
    """Unit directions (H, W, S, 3) of `sensor`'s pixels by the README's conventions, S = subpixels² per pixel."""
    step = (np.arange(subpixels) + 0.5) / subpixels
    v, u, dv, du = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), step, step, indexing="ij")
    local = np.stack([-(u + du - CENTRE[0]) / FOCAL[0], -(v + dv - CENTRE[1]) / FOCAL[1], np.ones_like(u + du)], -1)
    z = np.subtract(target, origin) / np.linalg.norm(np.subtract(target, origin))
    x = np.cross([0.3, 1, 0.2], z)
    x /= np.linalg.norm(x)
    d = local.reshape(HEIGHT, WIDTH, -1, 3) @ np.stack([x, np.cross(z, x), z])
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


@pytest.mark.parametrize("depth", [3, 5])
def test_interreflection_inside_a_ball_is_the_closed_form(tmp_path, capsys, depth):
    """Inside a Lambertian ball of radius r, indirect irradiance is (a + a² + …) I / r² everywhere, a bounce each."""
    albedo, radius, middle = np.array([0.6, 0.3, 0.1]), 2.0, np.array([0.5, -1.0, 3.0])
    light, strength = middle + np.array([0.9, 0.5, -0.6]), 7.0
    origin, target = middle + np.array([-0.4, 0.7, 0.5]), middle + np.array([1.0, -0.3, 0.2])
    ball = f"""<shape type="sphere"><boolean name="flip_normals" value="true"/><float name="radius" value="{radius}"/>
      <point name="center" x="{middle[0]}" y="{middle[1]}" z="{middle[2]}"/>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.3, 0.1"/></bsdf></shape>"""
    path = write(tmp_path, ball, sensor("in", origin, target, POINT.format(light, strength)))
    status, numbers = run(path, "--depth", str(depth))
    row = numbers["photographs"][0]

    direction = rays(origin, target, 4)
    b = direction @ (middle - origin)
    t = b + np.sqrt(b**2 - ((middle - origin) ** 2).sum() + radius**2)
    p = origin + t[..., None] * direction
    toward, normal = light - p, (middle - p) / radius
    squared = (toward**2).sum(-1)
    direct = strength * (toward * normal).sum(-1) / squared**1.5
    bounces = sum(albedo**k for k in range(1, depth - 1)) * strength / radius**2
    direct, indirect = (albedo / np.pi * direct.mean()).mean(), (albedo / np.pi * bounces).mean()

    assert status == 0 and row["p_direct"] > 0.001 and row["p_path"] < 1e-12
    assert row["radiance"] == pytest.approx(direct + indirect, rel=0.01)
    share = indirect / (direct + indirect)
    assert 0.2 < share < 0.8
    assert row["interreflection"] == pytest.approx(share, rel=0.02)
    assert row["difference"] == pytest.approx(-share, rel=0.02)
    assert row["absolute_difference"] == pytest.approx(share, rel=0.02)  # photometric is darker everywhere
    assert row["shadows"] == pytest.approx(0, abs=1e-3)
    said = capsys.readouterr().out
    assert f"interreflection is {100 * row['interreflection']:.2f}% of the light" in said


def test_share_of_a_shadow_is_that_of_its_projection(tmp_path):
    """A black board between the light and the ground: no light goes back and forth."""
    origin, target, light, height = [2.6, -1.0, 3.0], [0.0, 0.4, 0.0], np.array([-1.5, 1.0, 2.2]), 0.6
    board = f"""<shape type="rectangle"><transform name="to_world"><scale x="0.45" y="0.3"/>
      <rotate z="1" angle="35"/><translate x="0.2" y="0.3" z="{height}"/></transform>
      <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>"""
    ground = """<shape type="rectangle"><transform name="to_world"><scale value="90"/></transform>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.4"/></bsdf></shape>"""
    path = write(tmp_path, board, ground, sensor("one", origin, target, POINT.format(light, 5)))
    status, numbers = run(path, "--spp", "256")
    row = numbers["photographs"][0]

    turn = np.radians(35)
    inverse = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def on_board(p, q):
        """Does the way from the ground at p (..., 3) to q meet the board?"""
        hit = p + (height / q[2]) * (q - p)
        local = (hit[..., :2] - [0.2, 0.3]) @ inverse.T
        return (np.abs(local) < [0.45, 0.3]).all(-1)

    direction = rays(origin, target)
    t = -origin[2] / direction[..., 2]
    assert (t > 0).all()
    p = origin + t[..., None] * direction
    squared = ((light - p) ** 2).sum(-1)
    radiance = np.where(on_board(p, np.array(origin)), 0, 0.4 / np.pi * 5 * light[2] / squared**1.5)
    shadow = np.where(on_board(p, light), radiance, 0).mean()
    assert status == 0 and row["p_direct"] > 0.001 and row["p_path"] > 0.001
    assert row["radiance"] == pytest.approx(radiance.mean() - shadow, rel=0.01)
    assert shadow > 0.05 * radiance.mean()
    assert row["shadows"] == pytest.approx(shadow / (radiance.mean() - shadow), rel=0.02)
    assert row["interreflection"] == pytest.approx(0, abs=1e-6)


class Lopsided(CookTorrance):
    """A broken BSDF: what `path` asks (`eval_pdf`) is `factor` times what `photometric` asks (`eval`), in blue."""

    factor = 1.0

    def eval_pdf(self, ctx, si, wo, active=True):
        value, pdf = super().eval_pdf(ctx, si, wo, active)
        return value * mi.Color3f(1, 1, self.factor), pdf


mi.register_bsdf("lopsided", Lopsided)


@pytest.mark.parametrize("factor, way", [(0.97, "brighter"), (1.015, "darker")])
def test_a_small_error_of_one_channel_is_found(tmp_path, capsys, monkeypatch, factor, way):
    monkeypatch.setattr(Lopsided, "factor", factor)
    status, numbers = run(write(tmp_path, shapenet("lopsided"), *CONVEX[:1]))
    assert status == 1
    assert numbers["all"]["p_direct"] < 1e-4
    said = capsys.readouterr().out
    assert "direct light DISAGREES with path" in said and "a.png" in said and way in said


def test_the_same_bsdf_without_the_error_passes(tmp_path, monkeypatch):
    assert run(write(tmp_path, shapenet("lopsided"), *CONVEX[:1]))[0] == 0


def test_lamps_and_sky_of_the_scene_light_both(tmp_path):
    """In a scene of stock shapes too, which is put together anew: every lamp is there once."""
    lamp = """<emitter type="constant"><rgb name="radiance" value="0.2, 0.3, 0.5"/></emitter>
      <emitter type="point"><point name="position" x="-2" y="1" z="3"/><rgb name="intensity" value="4"/></emitter>
      <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><translate z="6"/></transform>
      <emitter type="area"><rgb name="radiance" value="2"/></emitter></shape>"""
    ball = '<shape type="sphere"><float name="radius" value="0.8"/><bsdf type="diffuse"/></shape>'
    path = write(tmp_path, ball, lamp, CONVEX[0])
    scene, sensors = path_tracing.open_lit_scene(path)
    kinds = sorted(emitter.class_name() for emitter in scene.emitters())
    original = mi.load_file(str(path), parallel=False)
    assert kinds == sorted([*(emitter.class_name() for emitter in original.emitters()), "Emitter"])
    row = comparison(scene, sensors, spp=16)
    assert row.p_direct > 0.001
    # Stock `direct` sees all lights of the original but the photograph's own, and that alone in the other scene.
    own = mi.load_dict({"type": "scene", "ball": original.shapes()[0], "flash": {"type": "flash"}})
    direct = mi.load_dict({"type": "direct"})
    both = sum(mi.render(s, sensor=sensors[0], integrator=direct, spp=256) for s in (original, own))
    assert row.radiance == pytest.approx(np.array(both)[..., :3].mean(), rel=0.01)


def test_pictures_of_several_launches_are_those_of_one(tmp_path, monkeypatch):
    scene, sensors = path_tracing.open_lit_scene(write(tmp_path, ELLIPSOID, *CONVEX))
    photographs = Photographs.of([sensor.shot for sensor in sensors])
    one = path_tracing.render_both(scene, photographs, 0, sensors[0], 1, 4, 3, 0)
    monkeypatch.setattr(path_tracing, "LANES", 5 * 4 * WIDTH * HEIGHT)  # 5 + 5 + 5 + 1
    many = path_tracing.render_both(scene, photographs, 0, sensors[0], 1, 4, 3, 1000)
    for a, b in zip(vars(one).values(), vars(many).values()):
        assert a.shape == b.shape == (16, HEIGHT, WIDTH, 3)
        assert renderer_agreement.p_of_agreement(a.astype(float), b.astype(float)) > 0.001
        assert len({x.tobytes() for x in b}) == 16


# The p-values.


@pytest.mark.parametrize("noise", ["normal", "heavy", "rare"])
def test_p_values_are_uniform_where_there_is_no_difference(noise):
    random = np.random.default_rng(3)
    lit = np.zeros((43, 61, 1))
    lit[7:40, 10:50] = 1

    def pictures():
        shape = (16, *lit.shape[:2], 1)
        value = {
            "normal": lambda: 1 + 0.1 * random.normal(size=(*shape[:3], 3)),
            "heavy": lambda: random.exponential(size=shape) ** 4 * [1, 0.5, 0.2],  # all channels the same sample
            "rare": lambda: (random.random(shape) < 0.01) * np.ones(3),
        }[noise]()
        return value * lit

    p = np.array([renderer_agreement.p_of_agreement(pictures(), pictures()) for _ in range(300)])
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert (p < 0.01).sum() <= 10  # 3 are expected, more than 10 once in 3,000


def test_p_values_of_photometric_and_path_are_uniform(tmp_path):
    """Of a convex object's photographs, which the two see alike."""
    scene, sensors = path_tracing.open_lit_scene(write(tmp_path, ELLIPSOID, *CONVEX))
    photographs, p = Photographs.of([sensor.shot for sensor in sensors]), []
    for seed in range(25):
        for k in range(3):
            pictures = path_tracing.render_both(scene, photographs, k, sensors[k], 1, 4, 2, 32 * (3 * seed + k))
            p.append(renderer_agreement.p_of_agreement(pictures.photometric.astype(float), pictures.path.astype(float)))
    assert stats.kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("where", ["everywhere", "in one place", "in one channel"])
def test_differences_are_found(where):
    random = np.random.default_rng(4)
    a, b = (1 + 0.3 * random.normal(size=(16, 40, 56, 3)) for _ in range(2))
    assert renderer_agreement.p_of_agreement(a, b) > 0.01
    if where == "everywhere":
        b *= 1.005  # 5 standard errors of the mean, a tenth of that of a block
    elif where == "in one place":
        b[:, 8:16, 16:24] *= 1.15
    else:
        b *= [1.05, 1, 1 / 1.05]
    assert renderer_agreement.p_of_agreement(a, b) < 1e-3


def test_pictures_without_noise_may_differ_by_rounding_only():
    a = np.full((16, 20, 30, 3), 0.7)
    assert renderer_agreement.p_of_agreement(a, a) == 1
    assert renderer_agreement.p_of_agreement(a, a * (1 + 1e-7)) > 0.5
    assert renderer_agreement.p_of_agreement(a, a * (1 + 1e-4)) < 1e-6
    assert renderer_agreement.p_of_agreement(0 * a, 0 * a) == 1
    assert renderer_agreement.p_of_agreement(a, 0 * a) < 1e-6


def test_least_of_many_p_values_is_corrected_for_their_number():
    random = np.random.default_rng(5)
    p = [renderer_agreement.sidak(random.random(7)) for _ in range(1000)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert renderer_agreement.sidak([0.01, 0.5]) == pytest.approx(1 - 0.99**2)
    assert renderer_agreement.sidak([1e-30, 0.5, 1.0]) == pytest.approx(3e-30)
    assert renderer_agreement.sidak([1.0]) == 1


def test_all_photographs_together_are_weighted_by_their_light():
    def row(radiance, share, p):
        return renderer_agreement.Comparison(
            "x", radiance, -share, share, 0.1, 20.0, 2 * share, share, 0.0, 0.3, p, 0.5
        )

    all_ = renderer_agreement.all_as_one([row(1.0, 0.1, 0.02), row(3.0, 0.3, 0.9)])
    assert all_.radiance == 2
    assert all_.interreflection == pytest.approx((1 * 0.1 + 3 * 0.3) / 4)
    assert all_.unexplained_noise == pytest.approx(np.hypot(0.3 * 1, 0.3 * 3) / 4)
    assert all_.p_direct == pytest.approx(1 - 0.98**2)
    assert all_.psnr == pytest.approx(20)


# The command.


def test_folder_of_a_fit_and_its_default_out(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    folder.mkdir()
    torch.manual_seed(0)
    files.write_state(ring_state(FittedObject([0.3, -0.2, 0.4], 0.8, scale=0.2)), folder / "ring.pt")
    ring = """<shape type="shapenet" id="object"><string name="weights" value="ring.pt"/>
      <bsdf type="cooktorrance"/></shape>"""
    write(folder, ring, *CONVEX, name="scene.xml")
    with pytest.raises(SystemExit) as stop:
        monkeypatch.setattr("sys.argv", ["mi-ring", "validate", str(folder), "--photographs", "c", "a.png"])
        __main__.main()
    assert stop.value.code == 0
    numbers = json.loads((folder / "validate/validate.json").read_text())
    assert [row["name"] for row in numbers["photographs"]] == ["a.png", "c.png"]
    assert sorted(p.name for p in (folder / "validate").iterdir()) == ["validate.json", "validate.png"]


def test_pictures_are_at_most_as_wide_as_asked_for(tmp_path):
    """By an integer factor, and their mean is the photograph's."""
    path = write(tmp_path, ELLIPSOID, CONVEX[2])
    sizes = []
    for width in (64, 20):
        _, numbers = run(path, "--width", str(width), out=f"out{width}")
        sizes.append(numbers["photographs"][0]["radiance"])
    # 49 x 52 a third: 16 x 17, without the last column and row, where the object is not
    assert sizes[1] == pytest.approx(sizes[0] * (49 * 52) / (48 * 51), rel=0.02)


def test_contact_sheet_shows_who_is_brighter_in_red_and_blue(tmp_path):
    random = np.random.default_rng(6)
    path = 0.5 + 0.01 * random.random((16, 40, 20, 3))
    photometric, direct = path.copy(), path.copy()
    photometric[:, :20] += 0.04
    direct[:, 20:] += 0.01
    pictures = path_tracing.Pictures(photometric, photometric + 0.1, path, direct)
    line = validation_sheet.strip(renderer_agreement.compare_renderers("this", pictures), pictures)
    cell = validation_sheet.THUMBNAIL + 4
    image = np.array(line).astype(int)[16:]
    top, bottom = image[20, 10 + 2 * cell], image[100, 10 + 2 * cell]
    assert top[0] > top[2] + 50 and abs(bottom - 247).max() < 5  # photometric - path: red, nothing
    top, bottom = image[20, 10 + 5 * cell], image[100, 10 + 5 * cell]
    assert top[0] > top[2] + 50 and bottom[2] > bottom[0] + 50  # photometric - direct: red, blue
    assert image.shape[0] == 130 and image[50, 70 : cell - 1].max() == 0  # 20 x 40 px are shown as 64 x 128


def test_contact_sheet_of_many_photographs_is_about_square():
    line = Image.new("RGB", (792, 146))
    for count in (1, 2, 53, 200):
        page = Image.open(io.BytesIO(validation_sheet.validation_sheet([line] * count)))
        assert page.width * page.height >= count * 792 * 146
    assert 0.5 < page.width / page.height < 2


BROKEN = [
    ("no such file", lambda folder: folder / "nowhere.xml", []),
    ("has no scene.xml", lambda folder: folder, []),
    ("found no <sensor", lambda folder: write(folder, ELLIPSOID), []),
    ("every photograph is black", lambda folder: write(folder, *CONVEX), []),
    ("--photographs: there is no d", lambda folder: write(folder, ELLIPSOID, *CONVEX), ["--photographs", "a", "d"]),
    ("found 2 of them", lambda folder: write(folder, ELLIPSOID, ELLIPSOID.replace("object", "other"), *CONVEX), []),
    ("vertex_gloss", lambda folder: write(folder, ELLIPSOID.replace(
        '<rgb name="diffuse" value="0.2, 0.1, 0.05"/>',
        '<texture name="diffuse" type="mesh_attribute"><string name="name" value="vertex_gloss"/></texture>'), *CONVEX), []),  # noqa: E501
    ("--depth: is 2", lambda folder: write(folder, ELLIPSOID, *CONVEX), ["--depth", "2"]),
    ("--significance: is 1.0", lambda folder: write(folder, ELLIPSOID, *CONVEX), ["--significance", "1"]),
    ("--spp: is 0", lambda folder: write(folder, ELLIPSOID, *CONVEX), ["--spp", "0"]),
    ("--width: is 1, too small for a.png", lambda folder: write(folder, ELLIPSOID, *CONVEX), ["--width", "1"]),
    ("cannot be written", lambda folder: write(folder, ELLIPSOID, *CONVEX), ["--out", "{folder}/try.xml"]),
]  # fmt: skip


@pytest.mark.parametrize("complaint, path, options", BROKEN, ids=[entry[0] for entry in BROKEN])
def test_mistakes_are_answered_in_one_line(tmp_path, complaint, path, options):
    options = [option.format(folder=tmp_path) for option in options] or ["--out", str(tmp_path / "out")]
    if "--out" not in options:
        options += ["--out", str(tmp_path / "out")]
    with pytest.raises(InputError) as error:
        validate.main([str(path(tmp_path)), *options])
    assert complaint in str(error.value) and "\n" not in str(error.value)


def test_a_scene_that_was_not_fitted_yet_is_refused(small_capture):
    with pytest.raises(InputError, match="object: has no weights.*give the folder of its fit"):
        validate.main([str(small_capture)])


def test_capture_with_interreflection(shared, tmp_path):
    """Concave and glossy: direct light agrees all the same."""
    folder = shared / "data/captures/teapot/truth"
    text = (folder / "scene.xml").read_text()
    mesh = f"""<shape type="ply"><string name="filename" value="{folder / "mesh.ply"}"/>
      <bsdf type="roughconductor"/></shape>"""
    old = '<shape type="shapenet" id="object"><bsdf type="cooktorrance"/></shape>'
    assert old in text
    (tmp_path / "teapot.xml").write_text(text.replace(old, mesh))
    status, numbers = run(tmp_path / "teapot.xml", "--photographs", "003", "005", "031")
    assert status == 0
    assert numbers["all"]["interreflection"] > 0.02 and numbers["all"]["p_path"] < 1e-12
