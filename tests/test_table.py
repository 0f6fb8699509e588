"""The `table` shape: where its picture lies, and the light that it reflects, against Mitsuba's path tracer."""

import mitsuba as mi
import numpy as np
import pytest
from helpers.ellipsoid_pictures import CENTER, LENS, hit_ellipsoid, poses, rays_of, view

from mi_ring.capture.loading import load_capture
from mi_ring.capture.scenefile import scene_bytes, scene_element
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.images import linear_to_srgb, write_image
from mi_ring.importers.writer import Writer
from mi_ring.metrics.path_tracing import open_lit_scene, render_path
from mi_ring.photogrammetry.capture_files import OBJECT, PosedPicture, write_table
from mi_ring.photogrammetry.flash_light import FlashCalibration
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.table_plane import Plane, TexelGrid, estimate_albedo
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface
from mi_ring.scene.assembly import split_tables
from mi_ring.scene.lights import Light
from mi_ring.system import machine

TURNED = mi.ScalarTransform4f().translate([0.3, -0.2, -1.1]).rotate([1, 0.4, 0], 12).scale([6, 4, 1])
ROOM = '<emitter type="room"><string name="harmonics" value="0.4 0.3 0.2 {}"/></emitter>'.format("0 " * 24)
#: An ellipsoid that is lit from aside, above a table, red to the left, seen from below its middle.
SCENE = """<scene version="3.0.0">
  <integrator type="photometric"/>
  <shape type="shapenet" id="object">
    <transform name="to_world"><scale x="1" y="0.7" z="0.8"/><rotate x="1" y="2" z="0" angle="20"/></transform>
    <bsdf type="cooktorrance"><rgb name="diffuse" value="0.5, 0.6, 0.7"/><float name="specular" value="0.05"/>
      <float name="roughness" value="0.5"/></bsdf></shape>
  <sensor type="photograph" id="a"><string name="filename" value="a.png"/>
    <float name="fx" value="52"/><float name="fy" value="55"/><float name="cx" value="23.2"/>
    <float name="cy" value="18.4"/>
    <transform name="to_world"><lookat origin="0.5, -4, 0.4" target="0, 0, -0.1" up="0.1, 0.1, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="49"/><integer name="height" value="35"/></film>
    <emitter type="point"><point name="position" x="-1.5" y="-3" z="3"/><rgb name="intensity" value="40"/></emitter>
  </sensor>
  {table}{more}
</scene>"""
TABLE = """<shape type="table"><transform name="to_world"><matrix value="{}"/></transform><bsdf type="diffuse">
  <texture name="reflectance" type="bitmap"><string name="filename" value="table.png"/></texture></bsdf></shape>"""


def write(folder, table=True, more=""):
    matrix = " ".join(f"{v:.9g}" for v in np.array(TURNED.matrix).ravel())
    picture = np.zeros((5, 7, 3), np.uint8) + 190
    picture[:, :3] = 240, 90, 60
    picture[0, 6] = 10, 250, 90
    write_image(picture, folder / "table.png")
    (folder / "try.xml").write_text(SCENE.format(table=TABLE.format(matrix) if table else "", more=more))
    return folder / "try.xml"


def test_its_picture_has_its_first_row_at_the_bottom(tmp_path):
    scene = load_capture(write(tmp_path), images=False).scene
    table = next(shape for shape in scene.shapes() if getattr(shape, "of_tables", False))
    alone = split_tables(scene)[1]
    x, y = 2 * (6 + 0.5) / 7 - 1, 2 * 0.5 / 5 - 1  # the middle of the last pixel of the first row
    place, up = TURNED @ mi.ScalarPoint3f(x, y, 0), TURNED @ mi.ScalarNormal3f(0, 0, 1)
    si = alone.ray_intersect(mi.Ray3f(mi.Point3f(place) + mi.Vector3f(up), -mi.Vector3f(up)))
    assert si.is_valid()[0]
    np.testing.assert_allclose(np.array(si.t), 1, rtol=1e-5)
    srgb = np.array([10, 250, 90]) / 255
    linear = np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    atol = 2e-3 if machine.device().type == "cpu" else 4e-3  # a GPU's textures are interpolated with 8 bits
    np.testing.assert_allclose(np.array(table.bsdf().eval_diffuse_reflectance(si)).ravel(), linear, atol=atol)


@pytest.mark.parametrize("more", ["", ROOM], ids=["dark", "room"])
def test_the_light_that_it_reflects_is_that_of_a_path_tracer(tmp_path, more):
    capture = load_capture(write(tmp_path, more=more), images=False)
    surface = Surface(capture.scene, capture.shape)
    rgb, coverage = prediction.draw(surface, capture.photograph(0), spp=256, indirect=True)
    without = load_capture(write(tmp_path, table=False, more=more), images=False)
    alone, same = prediction.draw(Surface(without.scene, without.shape), without.photograph(0), spp=256,
                              indirect=True)  # fmt: skip
    np.testing.assert_array_equal(coverage, same)  # no camera sees it

    scene = mi.load_file(str(write(tmp_path, more=more)), optimize=False, parallel=False)
    sensor, batch = scene.sensors()[0], capture.photograph(0)
    channels = [np.array(c) for c in render_path(scene, batch, sensor, 1024, 3, 5)]
    traced = np.stack(channels, -1).reshape(rgb[0].shape)
    inside = coverage[0].numpy() == 1
    from_below, bounced = traced[inside], (rgb - alone)[0].numpy()[inside]
    assert bounced.mean() > 0.05 * from_below.mean()
    # Its light is drawn in few pixels and smoothed: compared as means of rows and of columns.
    for axis in (0, 1):
        weight = inside.sum(axis)
        ours, theirs = ((picture * inside[..., None]).sum(axis)[weight > 5] / weight[weight > 5, None]
                        for picture in (rgb[0].numpy(), traced))  # fmt: skip
        np.testing.assert_allclose(ours, theirs, rtol=0.05, atol=0.015)
    np.testing.assert_allclose(rgb[0].numpy()[inside].mean(0), from_below.mean(0), rtol=0.01)


def test_without_interreflection_a_table_changes_nothing(tmp_path):
    pictures = []
    for table in (True, False):
        capture = load_capture(write(tmp_path, table, ROOM), images=False)
        surface = Surface(capture.scene, capture.shape)
        pictures.append(prediction.draw(surface, capture.photograph(0), spp=16)[0].numpy())
        assert not split_tables(open_lit_scene(tmp_path / "try.xml")[0])[1]  # nor does it to `validate`
    np.testing.assert_allclose(*pictures, rtol=1e-5)


@pytest.mark.parametrize("scale", ['x="-1" y="1" z="1"', 'x="1" y="1" z="0"'])
def test_a_mirrored_or_flat_one_is_refused(scale):
    light = '<emitter type="area"><rgb name="radiance" value="1"/></emitter>'
    with pytest.raises(RuntimeError, match="has an emitter; give light to a rectangle"):
        mi.load_string(f'<shape type="table" version="3.0.0">{light}</shape>')
    with pytest.raises(RuntimeError, match="to_world is .* must be a <transform>"):
        mi.load_string('<shape type="table" version="3.0.0"><vector name="to_world" x="1" y="1" z="1"/></shape>')
    transform = f'<transform name="to_world"><scale {scale}/></transform>'
    with pytest.raises(RuntimeError, match="to_world is flat or a mirror"):
        mi.load_string(f'<shape type="table" version="3.0.0">{transform}</shape>')


UP = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
PLANE = Plane(UP, float(CENTER @ UP) - 3.0)


def albedo(points):
    x, y = (points - CENTER)[..., 0], (points - CENTER)[..., 1]
    return np.stack([0.4 + 0.02 * x, 0.5 - 0.015 * y, 0.3 + 0.005 * x + 0.01 * y], -1)


def flash_of(falloff=0.0, room=0.0, gamma=1.0):
    return FlashCalibration(np.zeros(3), falloff, np.full(3, room), gamma, np.ones(3), {})


def photographs_of_a_table(falloff=0.0, room=0.0, gamma=1.0):
    """A tilted plane, flashes beside the lenses, an object that hides it and casts shadows: pose, flash, sRGB, mask.

    The flashes shine like a power of the cosine from where the cameras look; `room`: irradiance by their intensity;
    `gamma`: of the camera.
    """
    random = np.random.default_rng(4)
    for pose in poses(14):
        camera = LENS.camera(pose)
        flash = Light("point", camera.position + pose[:3, 0] * 0.8, random.uniform(100, 160, 3))
        rays = rays_of(camera)
        t = (PLANE.offset - camera.position @ UP) / (rays @ UP)
        points = camera.position + t[:, None] * rays
        way = flash.vector - points
        away = np.linalg.norm(way, axis=1, keepdims=True)
        cone = ((-way / away) @ pose[:3, 2]).clip(1e-3)[:, None] ** falloff
        radiance = albedo(points) / np.pi * flash.rgb * (cone * (way @ UP)[:, None] / away**3 + room)
        radiance[random.uniform(size=len(t)) < 0.1] *= 0.05  # shadows
        object_ = np.isfinite(hit_ellipsoid(camera)[0])
        radiance[object_] = 0.4
        srgb = (255 * linear_to_srgb((radiance**gamma).clip(0, 1).astype(np.float32))).round().astype(np.uint8)
        mask = object_.reshape(LENS.size[::-1]).astype(np.uint8)
        yield pose, flash, srgb.reshape(*mask.shape, 3), mask


@pytest.mark.parametrize(("falloff", "room", "gamma"), [(0.0, 0.0, 1.0), (2.5, 8e-4, 1.2)])
def test_the_reflectance_of_a_table_is_found_under_what_stands_on_it_and_in_shadows(falloff, room, gamma):
    taken, flashes, pictures, hidden = zip(*photographs_of_a_table(falloff, room, gamma))
    views = [view(str(k), pose, srgb) for k, (pose, srgb) in enumerate(zip(taken, pictures))]
    ground = TexelGrid(PLANE, CENTER, 5.0, 40)
    found = estimate_albedo(views, flashes, hidden, ground, flash_of(falloff, room, gamma))
    near = np.linalg.norm(ground.points - CENTER, axis=1).reshape(40, 40) < 6
    assert np.median(np.abs(found - albedo(ground.points).reshape(found.shape))[near]) < 0.01
    assert estimate_albedo(views, flashes, [np.ones_like(mask) for mask in hidden], ground, flash_of()) is None


class Raw(Picture):
    """As a raw photograph is developed: linear, with no brightness of its own."""

    encoding = "linear"

    def stored(self):
        linear = srgb_to_linear(super().stored().astype(np.float32) / 255)
        return (0.3 * 65535 * linear).round().astype(np.uint16)


@pytest.mark.parametrize(("kind", "brightness"), [(Picture, 1.0), (Raw, 0.3)])
def test_the_table_of_a_capture_has_its_picture_where_the_table_is(kind, brightness, tmp_path):
    shots = []
    for k, (pose, flash, srgb, mask) in enumerate(photographs_of_a_table()):
        write_image(srgb, tmp_path / f"{k}.png")
        light = flash._replace(rgb=brightness * flash.rgb)
        shots.append(PosedPicture(kind(tmp_path / f"{k}.png"), LENS, pose, OBJECT * mask, light))
    writer = Writer(tmp_path / "capture/scene.xml")
    root = scene_element(write_table(writer, shots, PLANE, CENTER, flash_of()))
    writer.finish(scene_bytes(root))
    writer.close()
    _, table = split_tables(mi.load_file(str(tmp_path / "capture/scene.xml"), optimize=False, parallel=False))
    across = PLANE.axes()[:2]
    below = CENTER - PLANE.height(CENTER) * UP
    points = below + np.random.default_rng(1).uniform(-4, 4, (200, 2)) @ across
    rays = mi.Ray3f(mi.Point3f((points + 2 * UP).T.astype(np.float32)), mi.Vector3f((-UP).tolist()))
    si = table.ray_intersect(rays)
    assert np.array(si.is_valid()).all()
    np.testing.assert_allclose(np.array(si.t), 2, atol=1e-4)
    seen = np.array(si.bsdf().eval_diffuse_reflectance(si)).T
    assert np.median(np.abs(seen - albedo(points)), 0).max() < 0.012
    assert np.corrcoef(seen[:, 0], points[:, 0])[0, 1] > 0.8 and np.corrcoef(seen[:, 1], points[:, 1])[0, 1] < -0.8
