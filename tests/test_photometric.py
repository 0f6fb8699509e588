"""`render_photographs` and `photometric`: every photograph as `direct` renders it, each under its own light."""

import mitsuba as mi
import numpy as np
import pytest

from mi_ring.rendering.image_formation import render_maps, render_photographs
from mi_ring.rendering.photographs import Photographs

WIDTH, HEIGHT = 35, 25  # [px]
CENTER, RADIUS = np.array([0.3, -0.2, 0.4]), 0.8
DIFFUSE, SPECULAR, ROUGHNESS = [0.3, 0.2, 0.05], 0.15, 0.3

MATERIAL = {
    "type": "cooktorrance",
    "diffuse": {"type": "rgb", "value": DIFFUSE},
    "specular": SPECULAR,
    "roughness": ROUGHNESS,
}
BALL = {"type": "shapenet", "id": "ball", "center": CENTER.tolist(), "radius": RADIUS, "bsdf": MATERIAL}
#: Behind the ball, to receive its shadow; the pictures look past its edge.
WALL = {
    "type": "rectangle",
    "id": "wall",
    "to_world": mi.ScalarTransform4f().translate([0.2, 0.1, -1]).rotate([0, 0, 1], 20).scale([1.6, 1.1, 1]),
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}},
}
LIGHTS = [
    {"type": "point", "position": [2.0, 1.5, 3.0], "intensity": {"type": "rgb", "value": [9.0, 7.0, 5.0]}},
    {"type": "directional", "direction": [-0.5, 0.6, -1.0], "irradiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
    None,
    {"type": "point", "position": [-1.0, 2.5, 2.0], "intensity": 6.0},
]


def photograph(k, light=None, size=(WIDTH, HEIGHT), **changed):
    """Camera `k` of a few around the ball, all rotated, off-centre and with fx != fy."""
    origin = [[1.5, 0.4, 3.6], [-1.2, 1.1, 3.2], [0.5, -1.6, 3.4], [0.9, 1.9, 2.8]][k]
    entries = {
        "type": "photograph",
        "id": f"{k:03}",
        "filename": "nowhere.png",
        "fx": 30.0 + 2 * k,
        "fy": 27.0,
        "cx": 16.2 + k,
        "cy": 13.4,
        "to_world": mi.ScalarTransform4f().look_at(origin, [0.2, 0.1, 0.0], [0.3, 1, 0.2]),
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        },
        **changed,
    }
    return entries | ({"light": light} if light else {})


def load(*shapes, lights=LIGHTS, **more):
    """A scene of these shapes and one photograph for every light."""
    sensors = {f"sensor{k}": photograph(k, light) for k, light in enumerate(lights)}
    return mi.load_dict({"type": "scene"} | {s["id"]: s for s in shapes} | sensors | more)


def many(scene, photographs, spp=16, seed=0, shadows=True):
    """`render_photographs` as (N, H, W, 4)."""
    channels = render_photographs(scene, photographs, spp, seed, shadows)
    width, height = photographs.size
    return np.stack([np.array(c).reshape(len(photographs), height, width) for c in channels], -1)


def one_by_one(scene, integrator, seed=0, spp=16):
    """`mi.render` of every sensor as (N, H, W, 4)."""
    integrator = mi.load_dict({"type": integrator})
    count = len(scene.sensors())
    return np.stack([np.array(mi.render(scene, sensor=k, integrator=integrator, spp=spp, seed=seed + 100 * k))
                     for k in range(count)])  # fmt: skip


class Estimate:
    """Mean of 16 renderings with their own seeds, and its standard error, per pixel."""

    def __init__(self, render):
        pictures = np.stack([render(seed) for seed in range(16)]).astype(np.float64)
        self.mean, self.variance = pictures.mean(0), pictures.var(0, ddof=1) / len(pictures)

    def map(self, f):
        """A linear `f`: a selection, or an average of pixels whose noise is independent."""
        other = object.__new__(Estimate)
        other.mean, other.variance = f(self.mean), f(self.variance)
        return other


def assert_same(a, b):
    """Equal within 7 standard errors in every pixel (exceeded once in 10⁷ by 30 degrees of freedom), 5 in the means.

    The floor of 1e-4 is for pixels without noise, where only float32 differs.
    """
    error = np.sqrt(a.variance + b.variance + (1e-4 * np.abs(b.mean).max()) ** 2)
    worst = np.abs(a.mean - b.mean) / error
    assert worst.max() < 7, f"pixel {np.unravel_index(worst.argmax(), worst.shape)}: {worst.max():.1f} standard errors"
    error = np.sqrt((a.variance + b.variance).mean((1, 2)) / (WIDTH * HEIGHT)) + 1e-4 * b.mean.mean((1, 2))
    worst = np.abs((a.mean - b.mean).mean((1, 2))) / error
    assert worst.max() < 5, f"mean: {worst} standard errors"


@pytest.fixture(scope="module")
def scene():
    return load(BALL, WALL)


@pytest.fixture(scope="module")
def estimate(scene):
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()])
    return Estimate(lambda seed: many(scene, photographs, seed=seed))


# The many-photograph wavefront against Mitsuba.


@pytest.mark.parametrize("integrator", ["direct", "photometric"])
def test_every_photograph_equals_mi_render(scene, estimate, integrator):
    assert (estimate.mean[..., :3].mean((1, 2, 3)) > 0.005).all()  # none is black
    assert_same(estimate, Estimate(lambda seed: one_by_one(scene, integrator, seed)))


def test_selection_chooses_and_orders(scene, estimate):
    order = [2, 0, 3, 2]
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()]).select(order, (WIDTH, HEIGHT))
    assert len(photographs) == 4
    assert_same(Estimate(lambda seed: many(scene, photographs, seed=50 + seed)), estimate.map(lambda x: x[order]))


def test_scale_is_a_box_average(scene, estimate):
    """Of an odd picture, the last row and column are left out."""
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()]).select(range(4), (WIDTH, HEIGHT), scale=2)
    assert photographs.size == (17, 12)
    halved = Estimate(lambda seed: many(scene, photographs, spp=64, seed=50 + seed))
    full = Estimate.map(estimate, lambda x: x[:, :24, :34].reshape(4, 12, 2, 17, 2, 4).mean((2, 4)))
    full.variance /= 4
    assert_same(halved, full)


def test_same_seed_same_picture_and_other_seed_another(scene):
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()])
    first, again, other = (many(scene, photographs, spp=2, seed=seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.1


def test_samples_are_stratified(scene):
    """Four samples per pixel have less noise than the mean of four pictures of one sample."""
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()])
    four = np.stack([many(scene, photographs, spp=4, seed=s) for s in range(8)])
    one = np.stack([many(scene, photographs, spp=1, seed=s) for s in range(100, 132)]).reshape(8, 4, *four.shape[1:])
    assert four.var(0).mean() < 0.7 * one.mean(1).var(0).mean()


# Closed forms.


def rays(k, subpixels=1):
    """Origin and directions (H, W, S, 3) of photograph `k`, S = subpixels² per pixel, by the contract's conventions."""
    sensor = photograph(k)
    matrix = np.array(sensor["to_world"].matrix)
    step = (np.arange(subpixels) + 0.5) / subpixels
    v, u, dv, du = np.meshgrid(np.arange(HEIGHT), np.arange(WIDTH), step, step, indexing="ij")
    x, y = (u + du - sensor["cx"]) / sensor["fx"], (v + dv - sensor["cy"]) / sensor["fy"]
    direction = np.stack([-x, -y, np.ones_like(x)], -1).reshape(HEIGHT, WIDTH, -1, 3) @ matrix[:3, :3].T
    return matrix[:3, 3], direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def ball_distance(origin, direction):
    """Distance to the ball along unit directions (..., 3), NaN where they miss it."""
    b = direction @ (CENTER - origin)
    with np.errstate(invalid="ignore"):
        return b - np.sqrt(b**2 - ((CENTER - origin) ** 2).sum() + RADIUS**2)


def test_alpha_is_the_coverage_of_the_ball():
    scene = load(BALL)
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()])
    alpha = many(scene, photographs, spp=256)[..., 3]
    reference = one_by_one(scene, "photometric", spp=256)[..., 3]
    for k in range(4):
        coverage = np.isfinite(ball_distance(*rays(k, 16))).mean(-1)
        assert 0.05 < coverage.mean() < 0.9
        # The icosphere of level 5 lies within the ball by up to 1/1000 of its radius: 0.01 px of an outline of 60 px,
        # and 256 stratified samples find the coverage of a pixel to about 1 / 64.
        np.testing.assert_allclose(alpha[k], coverage, atol=0.08)
        assert alpha[k].sum() == pytest.approx(coverage.sum(), abs=1)
        assert reference[k].sum() == pytest.approx(coverage.sum(), abs=3)  # its samples are not stratified


def test_maps_are_normals_and_material_at_the_pixel_centres():
    """Of the ball, and zero where the background is; the wall has no attributes."""
    scene = load(BALL, WALL)
    params = mi.traverse(scene)
    for name, value in (("diffuse", DIFFUSE), ("specular", [SPECULAR]), ("roughness", [ROUGHNESS])):
        params[f"ball.vertex_{name}"] = mi.Float(np.tile(value, 10242))
    params.update()
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()])
    maps = render_maps(scene, photographs, {"vertex_diffuse": 3, "vertex_specular": 1, "vertex_roughness": 1})
    maps = np.stack([np.array(m).reshape(4, HEIGHT, WIDTH) for m in maps], -1)
    for k in range(4):
        origin, direction = rays(k)
        t = ball_distance(origin, direction)
        normal = (origin + t[..., None] * direction - CENTER)[:, :, 0] / RADIUS
        inside = np.isfinite(t[..., 0]) & ((normal * -direction[:, :, 0]).sum(-1) > 0.2)  # away from the rim
        assert inside.sum() > 50
        np.testing.assert_allclose(maps[k][inside][:, :3], normal[inside], atol=0.01)  # faces of 2 degrees
        np.testing.assert_allclose(maps[k][inside][:, 3:], [[*DIFFUSE, SPECULAR, ROUGHNESS]] * inside.sum(), rtol=1e-6)
        assert (maps[k][~np.isfinite(t[..., 0])][:, 3:] == 0).all()


# Shadows.

BOARD = {
    "type": "rectangle",
    "id": "board",
    "to_world": mi.ScalarTransform4f().translate([0.5, 0.3, 0.6]).rotate([0, 0, 1], 35).scale([0.45, 0.3, 1]),
    "bsdf": {"type": "diffuse", "reflectance": 0.0},
}
GROUND = {
    "type": "rectangle",
    "id": "ground",
    "to_world": mi.ScalarTransform4f().scale(50),
    "bsdf": {"type": "diffuse", "reflectance": 0.4},
}
LAMPS = [
    {"type": "point", "position": [-1.5, 1.0, 2.2], "intensity": 5.0},
    {"type": "directional", "direction": [-0.8, 0.4, -1.0], "irradiance": 2.0},
    {"type": "point", "position": [-1.0, 0.4, 1.7], "intensity": 3.0},
]


def toward(lamp, p):
    """Unit direction to the lamp (..., 3) and irradiance at normal incidence (...) at points (..., 3)."""
    if lamp["type"] == "directional":
        away = np.array(lamp["direction"])
        return np.broadcast_to(-away / np.linalg.norm(away), p.shape), np.full(p.shape[:-1], lamp["irradiance"])
    d = np.array(lamp["position"]) - p
    distance = np.linalg.norm(d, axis=-1)
    return d / distance[..., None], lamp["intensity"] / distance**2


def on_board(p, direction):
    """Does the ray from points (..., 3) meet the board?"""
    inverse = np.linalg.inv(np.array(BOARD["to_world"].matrix))
    p, d = p @ inverse[:3, :3].T + inverse[:3, 3], direction @ inverse[:3, :3].T
    t = -p[..., 2] / d[..., 2]
    hit = p + t[..., None] * d
    return (t > 0) & (np.abs(hit[..., :2]) < 1).all(-1)


@pytest.mark.parametrize("shadows", [True, False])
def test_shadow_of_a_board_on_the_ground_is_its_projection(shadows):
    scene = load(BOARD, GROUND, lights=LAMPS)
    image = many(scene, Photographs.of([sensor.shot for sensor in scene.sensors()]), spp=256, shadows=shadows)
    for k, lamp in enumerate(LAMPS):
        origin, direction = rays(k, 16)
        p = origin + direction * (-origin[2] / direction[..., 2:])
        i, strength = toward(lamp, p)
        lit = ~on_board(p, i) if shadows else np.ones(i.shape[:-1], bool)
        radiance = 0.4 / np.pi * i[..., 2] * strength * lit * ~on_board(p, -direction)
        in_shadow = on_board(p, i) & ~on_board(p, -direction)
        assert in_shadow.all(-1).sum() > 20  # some of the shadow is seen beside the board
        # A pixel on an edge: 256 samples stratified here and there differ by some 1 / 64 each, five times that
        np.testing.assert_allclose(image[k, ..., 0], radiance.mean(-1), atol=0.08 * radiance.max())
        even = (lit.all(-1) | ~lit.any(-1)) & (~on_board(p, -direction)).all(-1)
        # two of the 256 may find the corner of a shadow that 16 x 16 points just miss
        np.testing.assert_allclose(image[k, ..., 0][even], radiance.mean(-1)[even], atol=0.01 * radiance.max())


def test_photometric_without_shadows_lights_what_the_board_hides():
    scene = load(BOARD, GROUND, lights=LAMPS)
    on, off = (
        np.stack([
            np.array(mi.render(scene, sensor=k, spp=16, integrator=mi.load_dict({"type": "photometric", "shadows": s})))
            for k in range(3)
        ])
        for s in (True, False)
    )  # fmt: skip
    np.testing.assert_allclose(
        off, many(scene, Photographs.of([sensor.shot for sensor in scene.sensors()]), shadows=False), atol=0.1
    )
    assert ((off - on)[..., 0] > 0.05).sum() > 30
    assert ((on - off)[..., 0] > 0.05).sum() == 0


# Light of the scene itself.


def test_environment_adds_its_light_to_every_photograph_and_to_the_background(scene, estimate):
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.5]}}
    under_sky = load(BALL, WALL, sky=sky)
    photographs = Photographs.of([sensor.shot for sensor in under_sky.sensors()])
    both = Estimate(lambda seed: many(under_sky, photographs, seed=seed, spp=32))
    assert_same(both, Estimate(lambda seed: one_by_one(under_sky, "direct", seed, spp=64)))
    background, inside = both.mean[..., 3] == 0, both.mean[..., 3] == 1
    np.testing.assert_allclose(both.mean[background][:, :3], [[0.2, 0.3, 0.5]] * background.sum(), rtol=1e-5)
    assert (both.mean[inside][:, :3].mean(0) > estimate.mean[inside][:, :3].mean(0) + 0.05).all()


def test_lamp_of_the_scene_casts_shadows_even_where_photographs_do_not(scene):
    lamp = {"type": "point", "position": [1.4, 2.0, 2.0], "intensity": 4.0}
    lit = load(BALL, WALL, lights=[None, None], lamp=lamp)  # flash at the camera: its shadows are hidden
    assert Photographs.of([sensor.shot for sensor in lit.sensors()]).colocated
    photographs = Photographs.of([sensor.shot for sensor in lit.sensors()])
    assert_same(
        Estimate(lambda seed: many(lit, photographs, seed=seed, shadows=False)),
        Estimate(lambda seed: one_by_one(lit, "direct", seed, spp=32)),
    )


# Which light it is.


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_colocated_means_every_light_is_at_its_camera(unit):
    def colocated(*lights):
        sensors = []
        for k, light in enumerate(lights):
            pose = np.array(photograph(k)["to_world"].matrix)
            pose[:3, 3] *= unit
            if isinstance(light, float):  # so far beside the camera, in its own distances from the origin
                position = pose[:3, 3] + light * np.linalg.norm(pose[:3, 3]) * pose[:3, 0]
                light = {"type": "point", "position": position.tolist(), "intensity": 2.0}
            sensors.append(mi.load_dict(photograph(k, light, to_world=mi.ScalarTransform4f(pose))))
        return Photographs.of([sensor.shot for sensor in sensors]).colocated

    assert colocated(None, None)
    assert colocated(0.0, None, 0.0)
    assert not colocated(0.0, 0.01)
    assert not colocated(0.01, 0.0)
    assert not colocated(None, {"type": "directional", "direction": [0.0, 0.3, -1.0], "irradiance": 1.0})


def test_a_direction_is_not_mistaken_for_a_position():
    """Not even where its numbers are those of the camera's centre."""
    pose = mi.ScalarTransform4f().look_at([0.6, 0.0, -0.8], [0, 0, 0], [0, 1, 0])
    light = {"type": "directional", "direction": [0.6, 0.0, -0.8], "irradiance": 1.0}
    assert not Photographs.of([mi.load_dict(photograph(0, light, to_world=pose)).shot]).colocated


@pytest.mark.parametrize(
    "light, kind",
    [
        ({"type": "spot", "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])}, "SpotLight"),
        ({"type": "constant"}, "ConstantBackgroundEmitter"),
    ],
)
def test_other_kinds_of_light_are_refused(light, kind):
    sensors = [mi.load_dict(photograph(0)), mi.load_dict(photograph(1, light))]
    with pytest.raises(ValueError, match=f'photograph "001".*{kind}.*"point" or "directional"'):
        Photographs.of([sensor.shot for sensor in sensors])
