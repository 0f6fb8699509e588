"""The `photograph` sensor: its rays by the contract's conventions, and its light, which is its own alone."""

import json
import subprocess
import sys

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_ring.geometry.camera import Camera
from mi_ring.rendering.pinhole import Pinhole

WIDTH, HEIGHT, FX, FY, CX, CY = 7, 5, 9.5, 7.25, 3.1, 2.8  # [px]; nothing in the middle, nothing square
POSE = np.array(mi.ScalarTransform4f().look_at([1.3, -0.7, 2.9], [0.2, 0.1, -0.3], [0.2, 1, 0.1]).matrix)


def photograph(**changed):
    """The sensor above as a dictionary, with some entries changed, or left out where None."""
    entries = {
        "type": "photograph",
        "filename": "nowhere.png",
        "fx": FX,
        "fy": FY,
        "cx": CX,
        "cy": CY,
        "to_world": mi.ScalarTransform4f(POSE),
        "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}},
    }
    return {key: value for key, value in (entries | changed).items() if value is not None}


def pinhole(u, v, pose=POSE, fx=FX, fy=FY, cx=CX, cy=CY):
    """Origin and unit direction (N, 3) through pixels (N,), from the matrices that OpenCV would have."""
    camera_to_world = pose @ np.diag([-1, -1, 1, 1])  # x right, y down, z forward
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    direction = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(intrinsics).T @ camera_to_world[:3, :3].T
    return camera_to_world[:3, 3], direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def pixel_centres(width=WIDTH, height=HEIGHT):
    """(u, v) of all pixel centres [px], row by row."""
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    return u.ravel(), v.ravel()


def rays_of(sensor, u, v, size=(WIDTH, HEIGHT)):
    """Origins and directions (N, 3) of a sensor's rays through pixels (N,) of its (crop of the) film."""
    sample = mi.Point2f(mi.Float(u.astype(np.float32)) / size[0], mi.Float(v.astype(np.float32)) / size[1])
    ray, _ = sensor.sample_ray(0.0, 0.0, sample, mi.Point2f(0))
    return np.array(ray.o).T, np.array(ray.d).T


def camera():
    """The camera above."""
    return Pinhole(mi.Matrix4f(POSE), mi.Point2f(FX, FY), mi.Point2f(CX, CY))


# Rays. float32 keeps about seven digits: 1e-5 leaves room for a few operations.


def test_a_ray_is_that_of_the_pinhole_of_the_conventions():
    u, v = np.random.default_rng(1).uniform([0, 0], [WIDTH, HEIGHT], (50, 2)).T
    origin, direction = camera().ray(mi.Point2f(mi.Float(u), mi.Float(v)))
    expected_origin, expected = pinhole(u, v)
    np.testing.assert_allclose(np.array(direction).T, expected, atol=1e-5)
    np.testing.assert_allclose(np.array(origin).ravel(), expected_origin, atol=1e-5)


def test_a_pixel_further_right_looks_further_right_and_a_lower_one_further_down():
    _, axis = camera()._replace(to_world=mi.Matrix4f(np.eye(4))).ray(mi.Point2f(CX + 2, CY + 1))
    # By hand, camera frame x left, y up, z forward: (-2 / fx, -1 / fy, 1), normalised
    expected = np.array([-2 / FX, -1 / FY, 1]) / np.sqrt((2 / FX) ** 2 + (1 / FY) ** 2 + 1)
    np.testing.assert_allclose(np.array(axis).ravel(), expected, atol=1e-6)


def test_project_inverts_ray():
    random = np.random.default_rng(2)
    u, v = random.uniform([0, 0], [WIDTH, HEIGHT], (50, 2)).T
    origin, direction = pinhole(u, v)
    depth = random.uniform(0.5, 20, 50)
    point = origin + direction * (depth / (direction @ POSE[:3, 2]))[:, None]
    pixel, z = camera().project(mi.Point3f(*point.T.astype(np.float32)))
    np.testing.assert_allclose(np.array(pixel).T, np.stack([u, v], -1), atol=1e-4)  # [px], of numbers below 10
    np.testing.assert_allclose(np.array(z), depth, rtol=1e-5)


@pytest.mark.parametrize("distortion", [-0.3, -0.05, 0.4])
def test_a_lens_bends_rays_as_opencvs_does(distortion):
    """Where a point is photographed, by OpenCV; the ray through there meets the point, and it projects there."""
    local = np.random.default_rng(3).uniform([-0.3, -0.3, 1], [0.3, 0.3, 1], (50, 3)) * 4  # x right, y down, z forward
    matrix = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    terms = np.array([distortion, 0, 0, 0])
    photographed = cv2.projectPoints(local, np.zeros(3), np.zeros(3), matrix, terms)[0][:, 0]
    there = local * [-1, -1, 1] @ POSE[:3, :3].T + POSE[:3, 3]
    lens = camera()._replace(distortion=mi.Float(distortion))
    pixel, depth = lens.project(mi.Point3f(*there.T.astype(np.float32)))
    np.testing.assert_allclose(np.array(pixel).T, photographed, atol=1e-4)
    np.testing.assert_allclose(np.array(depth), 4, rtol=1e-5)
    ours = Camera(POSE, np.array([FX, FY]), np.array([CX, CY]), (WIDTH, HEIGHT), distortion)
    np.testing.assert_allclose(ours.project(there)[0], photographed, atol=1e-9)
    away = there - POSE[:3, 3]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    np.testing.assert_allclose(ours.directions(photographed), away, atol=1e-9)
    _, rays = lens.ray(mi.Point2f(*photographed.T.astype(np.float32)))
    np.testing.assert_allclose(np.array(rays).T, away, atol=1e-5)
    u, v = pixel_centres()
    inside = (ours.directions(np.stack([u, v], 1)) @ POSE[:3, 2]).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(ours.cosines(), inside, atol=1e-9)
    if distortion < -0.1:
        return  # its corners would be seen twice
    _, direction = rays_of(mi.load_dict(photograph(distortion=distortion)), u, v)
    np.testing.assert_allclose(direction, ours.directions(np.stack([u, v], 1)), atol=1e-5)


def test_a_step_along_an_edge_is_photographed_by_a_lens_as_finite_differences_say():
    point, tangent = np.array([0.4, 0.1, -0.2]), np.array([0.3, -0.5, 0.2])
    ours = Camera(POSE, np.array([FX, FY]), np.array([CX, CY]), (WIDTH, HEIGHT), -0.2)
    high, low = (ours.project((point + t * tangent)[None])[0][0] for t in (1e-5, -1e-5))
    found = (
        camera()
        ._replace(distortion=mi.Float(-0.2))
        .project_tangent(mi.Point3f(point.tolist()), mi.Vector3f(tangent.tolist()))
    )
    np.testing.assert_allclose(np.array(found).ravel(), (high - low) / 2e-5, rtol=1e-4)


def test_what_is_beyond_the_fold_of_a_lens_is_not_seen():
    """A point 1.8 focal lengths off the axis would be photographed beside the principal point, were it not told."""
    ours = Camera(np.eye(4), np.array([FX, FY]), np.array([CX, CY]), (WIDTH, HEIGHT), -0.3)
    assert np.isnan(ours.project(np.array([[1.8, 0.0, 1.0]]))[0]).all()
    lens = camera()._replace(to_world=mi.Matrix4f(np.eye(4)), distortion=mi.Float(-0.3))
    pixel, _ = lens.project(mi.Point3f(1.8, 0, 1))
    assert abs(pixel.x[0] - CX) > 1e3


def test_a_lens_that_folds_the_picture_is_refused():
    with pytest.raises(Exception, match="distortion is -2, must be within"):
        mi.load_dict(photograph(distortion=-2.0))


def test_sensor_rays_pass_through_the_pixels():
    u, v = pixel_centres()
    origin, direction = rays_of(mi.load_dict(photograph()), u, v)
    expected_origin, expected = pinhole(u, v)
    np.testing.assert_allclose(direction, expected, atol=1e-5)
    np.testing.assert_allclose(origin, np.broadcast_to(expected_origin, origin.shape), atol=1e-5)


def test_principal_point_defaults_to_the_middle():
    u, v = pixel_centres()
    _, direction = rays_of(mi.load_dict(photograph(cx=None, cy=None)), u, v)
    np.testing.assert_allclose(direction, pinhole(u, v, cx=3.5, cy=2.5)[1], atol=1e-5)


def test_cropped_film_sees_its_part_of_the_picture():
    crop = {"crop_width": 3, "crop_height": 2, "crop_offset_x": 4, "crop_offset_y": 1}
    sensor = mi.load_dict(photograph(film={"type": "hdrfilm", "width": WIDTH, "height": HEIGHT} | crop))
    u, v = pixel_centres(3, 2)
    _, direction = rays_of(sensor, u, v, size=(3, 2))
    np.testing.assert_allclose(direction, pinhole(u + 4, v + 1)[1], atol=1e-5)


@pytest.mark.parametrize("centre", [(3.5, 2.5), (3.1, 2.9)])
def test_equals_the_stock_perspective_sensor(centre):
    """Where that one can express the camera: square pixels. Its offset is how far the picture moves."""
    ours = mi.load_dict(photograph(fx=FX, fy=FX, cx=centre[0], cy=centre[1]))
    stock = mi.load_dict({
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(WIDTH / 2 / FX))),
        "fov_axis": "x",
        "principal_point_offset_x": (WIDTH / 2 - centre[0]) / WIDTH,
        "principal_point_offset_y": (HEIGHT / 2 - centre[1]) / HEIGHT,
        "to_world": mi.ScalarTransform4f(POSE),
        "film": photograph()["film"],
    })  # fmt: skip
    u, v = pixel_centres()
    (origin, direction), (stock_origin, stock_direction) = rays_of(ours, u, v), rays_of(stock, u, v)
    np.testing.assert_allclose(direction, stock_direction, atol=1e-5)
    # The stock rays start at the near plane, somewhere along ours.
    np.testing.assert_allclose(np.cross(stock_origin - origin, direction), 0, atol=1e-5)


def test_without_emitter_the_light_is_at_the_camera():
    light = mi.traverse(mi.load_dict(photograph()).light)
    np.testing.assert_allclose(np.array(light["position"]).ravel(), POSE[:3, 3], atol=1e-6)
    assert np.array(light["intensity.value"]).ravel() == pytest.approx(1)


# What is refused.


def point(position, intensity=1.0):
    return {"type": "point", "position": [float(p) for p in position], "intensity": float(intensity)}


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"to_world": mi.ScalarTransform4f(POSE) @ mi.ScalarTransform4f().scale(1.1)}, "without scale"),
        ({"to_world": mi.ScalarTransform4f(POSE @ np.diag([1, -1, 1, 1]))}, "mirror"),
        ({"to_world": mi.ScalarTransform4f(np.where(np.eye(4)[::-1] > 0, np.nan, POSE))}, "to_world"),
        ({"fxx": 3.0}, "fxx"),
        ({"fx": None}, "fx is missing"),
        ({"fx": "wide"}, "fx is wide, must be a positive number"),
        ({"saturation": "high"}, "saturation is high, must be a positive number"),
        ({"to_world": "there"}, "to_world.* has the wrong type"),
        ({"filename": None}, "filename"),
        ({"encoding": "gamma"}, '"gamma", must be "srgb" or "linear"'),
        ({"gain": "1 0 1"}, 'gain is "1 0 1", must be above 0'),
        ({"gain": "1 2"}, 'gain is "1 2", must be 1 or 3 numbers'),
        ({"one": point([0, 0, 1]), "two": point([0, 1, 0])}, "2 nested emitters"),
    ],
    ids=[
        "scale",
        "mirror",
        "NaN",
        "typo",
        "no fx",
        "fx in words",
        "saturation in words",
        "to_world in words",
        "no filename",
        "encoding",
        "no gain",
        "two gains",
        "two lights",
    ],
)
def test_refuses(changed, message):
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": "scene", "sensor": photograph(**changed)})


# The nested light, seen on a Lambertian plane z = 0.

ALBEDO = np.array([0.8, 0.5, 0.2])
LIGHT, INTENSITY = np.array([1.0, -0.6, 2.5]), 3.0
TRAVEL, IRRADIANCE = np.array([0.3, -0.2, -1.0]) / np.sqrt(1.13), 1.7
ABOVE = np.array(mi.ScalarTransform4f().look_at([0.4, 0.3, 4], [0.1, -0.2, 0], [0.3, 1, 0]).matrix)
STOCK = {"type": "perspective", "fov": 5.0, "to_world": mi.ScalarTransform4f(ABOVE), "film": photograph()["film"]}
DISTANT = {"type": "directional", "direction": TRAVEL.tolist(), "irradiance": IRRADIANCE}
INTEGRATORS = {
    "direct": {"type": "direct"},
    "path": {"type": "path", "max_depth": 2},
    "photometric": {"type": "photometric"},
}


def plane_scene(**more):
    """The plane, and out of sight the `shapenet` that lets integrators see the lights of photographs."""
    return mi.load_dict({
        "type": "scene",
        "plane": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(500),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO.tolist()}},
        },
        "object": {"type": "shapenet", "subdivisions": 1, "center": [90, 90, 1], "bsdf": {"type": "cooktorrance"}},
        **more,
    })  # fmt: skip


def telephoto(**changed):
    """A photograph of the plane from above; its pixels are so small that radiance is linear across each."""
    return photograph(fx=200.0, fy=170.0, to_world=mi.ScalarTransform4f(ABOVE), **changed)


def plane_points():
    """Points (H * W, 3) of the plane at the centres of the pixels of `telephoto`."""
    origin, direction = pinhole(*pixel_centres(), pose=ABOVE, fx=200.0, fy=170.0)
    return origin + direction * (-origin[2] / direction[:, 2:])


def lit_by_point(position, intensity):
    """Radiance (H, W, 3) of the plane: albedo / π · n·i · intensity / d²."""
    to_light = position - plane_points()
    distance = np.linalg.norm(to_light, axis=1)
    return (ALBEDO / np.pi * (to_light[:, 2] / distance**3 * intensity)[:, None]).reshape(HEIGHT, WIDTH, 3)


def lit_from_afar():
    """Radiance (H, W, 3) of the plane: albedo / π · n·i · irradiance."""
    return np.broadcast_to(ALBEDO / np.pi * -TRAVEL[2] * IRRADIANCE, (HEIGHT, WIDTH, 3))


def picture(scene, integrator, sensor=0, spp=64):
    return np.array(mi.render(scene, integrator=mi.load_dict(INTEGRATORS[integrator]), sensor=sensor, spp=spp, seed=3))


# Radiance changes by at most 1 % across a pixel; the mean over 64 random positions in it is then good to 0.3 % / 8.
CLOSE = {"rtol": 2e-3}


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_every_integrator_sees_the_nested_light(integrator):
    scene = plane_scene(a=telephoto(light=point(LIGHT, INTENSITY)), b=telephoto(light=DISTANT), c=telephoto())
    expected = [lit_by_point(LIGHT, INTENSITY), lit_from_afar(), lit_by_point(ABOVE[:3, 3], 1.0)]
    for k in (0, 1, 2, 0):  # each by its own light, whichever came before
        np.testing.assert_allclose(picture(scene, integrator, k), expected[k], **CLOSE)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_other_sensors_are_not_lit_by_a_photographs_light(integrator):
    scene = plane_scene(a=telephoto(light=point(LIGHT, INTENSITY)), b=STOCK)
    for k in (0, 1, 0, 1):
        mean = picture(scene, integrator, k, spp=4).mean()
        assert (mean > 0.01) if k == 0 else (mean == 0)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_lamps_of_the_scene_light_every_sensor(integrator):
    lamp = [0.2, 0.9, 3.0]
    scene = plane_scene(a=telephoto(light=point(LIGHT, INTENSITY)), b=STOCK, lamp=point(lamp, 2.0))
    both = lit_by_point(LIGHT, INTENSITY) + lit_by_point(np.array(lamp), 2.0)
    # `path` chooses one of the two lights at random: the noise of 4096 samples is about 1 %, five of them below 5 %
    np.testing.assert_allclose(picture(scene, integrator, 0, spp=4096), both, rtol=0.05)
    assert picture(scene, integrator, 1, spp=256).mean() == pytest.approx(
        lit_by_point(np.array(lamp), 2.0).mean(), rel=0.05
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_shadow_of_a_blocker_far_away_toward_a_directional_light(integrator):
    """300 units of 2-unit objects: Mitsuba's own reach of a light that was never told the scene's size is 2 units."""
    foot = np.array([3.0, -2.0, 0.0])
    blocker = foot - 300 * TRAVEL
    facing = mi.ScalarTransform4f().look_at(blocker.tolist(), foot.tolist(), [0, 1, 0])
    pose = np.array(mi.ScalarTransform4f().look_at([20, 35, 120], [5, -4, 0], [0.3, 1, 0]).matrix)
    width, height, focal = 35, 25, 60.0
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    scene = plane_scene(
        blocker={"type": "rectangle", "to_world": facing @ mi.ScalarTransform4f().scale([12, 7, 1])},
        a=photograph(
            fx=focal, fy=focal, cx=16.0, cy=13.0, to_world=mi.ScalarTransform4f(pose), film=film, light=DISTANT
        ),
    )
    axes = np.array(facing.matrix)[:3, :2]
    in_shadow = []
    for du, dv in [(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)]:  # the corners of each pixel
        u, v = pixel_centres(width, height)
        origin, direction = pinhole(u + du, v + dv, pose, focal, focal, 16.0, 13.0)
        across = (origin + direction * (-origin[2] / direction[:, 2:]) - foot) @ axes
        in_shadow.append((np.abs(across) < [12, 7]).all(1).reshape(height, width))
    image = picture(scene, integrator, spp=4)
    all_of_it, some_of_it = np.all(in_shadow, 0), np.any(in_shadow, 0)
    assert all_of_it.sum() > 50 and some_of_it.sum() < width * height - 50
    assert (image[all_of_it] == 0).all()
    np.testing.assert_allclose(image[~some_of_it] - lit_from_afar()[0, 0], 0, atol=1e-5)  # float32


# Every variant.

SWITCH = """
import json, sys
import mi_ring, mitsuba as mi, numpy as np
for variant in sys.argv[1:]:
    mi.set_variant(variant)
    # Mitsuba's list of plugins is not made for threads that load their first one at the same time.
    scene = mi.load_file("scene.xml", parallel=False)
    kinds = ["path", "direct"] + ["photometric"] * (not variant.startswith("scalar"))
    pictures = [mi.render(scene, integrator=mi.load_dict({"type": kind}), spp=256) for kind in kinds]
    attributes = sum("vertex_" in key for key in mi.traverse(scene).keys())
    print(json.dumps([variant, attributes, [np.array(p)[2, 3, :3].tolist() for p in pictures]]))
"""

SCENE = """<scene version="3.0.0">
  <integrator type="photometric"/>
  <shape type="shapenet" id="object"><integer name="subdivisions" value="2"/><point name="center" x="9" y="9" z="0"/>
    <bsdf type="cooktorrance"/></shape>
  <shape type="rectangle"><bsdf type="cooktorrance"><float name="diffuse" value="0.2"/>
    <float name="specular" value="0"/><float name="roughness" value="0.5"/></bsdf></shape>
  <sensor type="photograph" id="000">
    <string name="filename" value="000.png"/> <float name="fx" value="300"/> <float name="fy" value="300"/>
    <transform name="to_world"><lookat origin="0.1, 0.2, 2" target="0.1, 0.2, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="7"/><integer name="height" value="5"/></film>
  </sensor>
</scene>
"""


def test_scenes_open_in_every_variant_and_after_switching(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    variants = ["scalar_rgb", "llvm_ad_spectral", "llvm_ad_rgb", "llvm_ad_spectral"]
    done = subprocess.run(
        [sys.executable, "-c", SWITCH, *variants], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert [line[0] for line in lines] == variants
    for variant, attributes, pictures in lines:
        assert attributes >= 6  # of the mesh itself and as read by the BSDF
        for pixel in pictures:
            # 0.2 · 1 / 2² facing the light; white in a spectral variant up to the noise of 256 × 4 wavelengths
            assert pixel == pytest.approx([0.05] * 3, rel=0.1 if "spectral" in variant else 1e-3), variant


def test_gradients_pass_through_rays():
    """Against central differences, in the parameters that a calibration would refine."""
    pose = mi.Matrix4f(POSE)

    def pixel_x(cx, fx, distortion):
        _, d = Pinhole(pose, mi.Point2f(fx, FY), mi.Point2f(cx, CY), distortion).ray(mi.Point2f(5.2, 1.4))
        return d.x

    cx, fx, distortion = mi.Float(CX), mi.Float(FX), mi.Float(-0.3)
    dr.enable_grad(cx, fx, distortion)
    dr.backward(pixel_x(cx, fx, distortion))
    step = 0.05  # float32: rounding 1e-7 / 0.1, truncation below 1e-5
    for given, name in ((cx, "cx"), (fx, "fx"), (distortion, "distortion")):
        at = {"cx": mi.Float(CX), "fx": mi.Float(FX), "distortion": mi.Float(-0.3)}
        high, low = pixel_x(**at | {name: at[name] + step}), pixel_x(**at | {name: at[name] - step})
        assert dr.grad(given)[0] == pytest.approx((high - low)[0] / (2 * step), rel=1e-3)


LOOKED_UP = """
import sys, mi_ring, mitsuba as mi
from pathlib import Path
from mi_ring.capture import loading
from mi_ring.metrics import path_tracing
from mi_ring.rendering import direct_light
from mi_ring import validate, render
mi.set_variant("scalar_rgb")
mi.set_variant("llvm_ad_rgb")
scene, sensors = path_tracing.open_lit_scene(Path(sys.argv[1]))
assert len(sensors) == 1 and not direct_light.shared_emitters(scene)
assert sum(isinstance(e, path_tracing.flash.Flash) for e in scene.emitters()) == 1
assert loading.load_capture(sys.argv[1], images=False).shots
"""


def test_after_a_switch_of_variant_photographs_and_flashes_are_known(tmp_path):
    """Their classes belong to one variant: whoever asks for them looks them up anew."""
    (tmp_path / "scene.xml").write_text("""<scene version="3.0.0">
      <integrator type="photometric"/><shape type="shapenet" id="object"><bsdf type="diffuse"/></shape>
      <sensor type="photograph" id="0"><string name="filename" value="a.png"/><float name="fx" value="9"/>
        <float name="fy" value="9"/>
        <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="7"/><integer name="height" value="5"/></film></sensor>
    </scene>""")
    done = subprocess.run([sys.executable, "-c", LOOKED_UP, tmp_path / "scene.xml"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
