"""Edges of meshes and outlines of other shapes: found, placed and moved as geometry says."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_ring.rendering.edge_curves import outline_of
from mi_ring.rendering.edge_gradients import cast_shadow
from mi_ring.rendering.edge_selection import BORDER, CREASE, SMOOTH, Edges, paired_edges

mi.set_log_level(mi.LogLevel.Error)

# Edges of meshes.


def mesh_of(vertices, faces, normals=True, name="mesh"):
    mesh = mi.Mesh(name, len(vertices), len(faces), mi.Properties(), normals)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    params.update()
    return mesh


@pytest.mark.parametrize(
    "mesh", [trimesh.creation.icosphere(subdivisions=2), trimesh.creation.torus(3.0, 1.0, 7, 5)], ids=["ball", "torus"]
)
def test_edges_of_a_closed_mesh(mesh):
    faces = np.random.default_rng(6).permutation(mesh.faces)
    v0, v1, f0, f1, kind = paired_edges(faces, np.arange(len(mesh.vertices)))
    assert len(v0) == len(faces) * 3 // 2 and (kind == SMOOTH).all()
    assert set(map(frozenset, zip(v0.tolist(), v1.tolist()))) == set(map(frozenset, mesh.edges_unique.tolist()))
    sides = [{tuple(np.roll(face, k)[:2].tolist()) for k in range(3)} for face in faces]
    assert all((a, b) in sides[f] and (b, a) in sides[g] for a, b, f, g in zip(v0, v1, f0, f1))


SQUARE = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0.5]], float)


def kinds(edges):
    return np.bincount(np.array(edges.kind), minlength=3).tolist()


@pytest.mark.parametrize(
    "mesh, expected",
    [
        (mesh_of(SQUARE, [[0, 1, 2], [0, 2, 3]]), {SMOOTH: 1, BORDER: 4}),
        # the diagonal is there twice: a seam
        (mesh_of(SQUARE[[0, 1, 2, 0, 2, 3]], [[0, 1, 2], [3, 4, 5]]), {CREASE: 1, BORDER: 4}),
        (mesh_of(SQUARE, [[0, 1, 2], [0, 2, 3]], normals=False), {CREASE: 1, BORDER: 4}),
        # three triangles at one edge
        (mesh_of([*SQUARE, [1, 1, 1]], [[0, 1, 2], [0, 2, 3], [2, 0, 4]]), {BORDER: 1 + 6}),
        # two triangles that disagree about what is outside
        (mesh_of(SQUARE, [[0, 1, 2], [0, 3, 2]]), {BORDER: 5}),
    ],
    ids=["open", "seam", "flat", "three", "flipped"],
)
def test_kinds_of_edges(mesh, expected):
    edges = Edges(mi.load_dict({"type": "scene", "mesh": mesh}))
    assert kinds(edges) == [expected.get(kind, 0) for kind in (SMOOTH, CREASE, BORDER)]


def test_several_meshes_are_numbered_one_after_another():
    ball = trimesh.creation.icosphere(subdivisions=1)
    shapes = {"a": mesh_of(ball.vertices, ball.faces, name="a"), "b": {"type": "cube"}, "r": {"type": "rectangle"}}
    edges = Edges(mi.load_dict({"type": "scene", **shapes}))
    positions = np.array(edges.positions()).reshape(-1, 3)
    assert len(positions) == 42 + 24 and len(edges.others) == 1
    assert kinds(edges) == [120 + 6, 12, 0]  # the cube's edges are seams, the diagonals of its sides are not
    corners = np.array(edges.corners).reshape(-1, 3)
    for k in range(len(np.array(edges.v0))):
        ends = {tuple(positions[np.array(v)[k]].tolist()) for v in (edges.v0, edges.v1)}
        for f in (edges.f0, edges.f1):
            assert ends <= set(map(tuple, positions[corners[np.array(f)[k]]].tolist()))


def test_edges_are_kept_until_the_faces_change():
    mesh = mesh_of(SQUARE, [[0, 1, 2], [0, 2, 3]])
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    edges = Edges.of(scene)
    params = mi.traverse(scene)
    params["mesh.vertex_positions"] = mi.Float(2 * SQUARE.astype(np.float32).ravel())
    params.update()
    assert Edges.of(scene, edges) is edges
    params["mesh.faces"] = mi.UInt32([0, 1, 3, 1, 2, 3])
    params.update()
    assert Edges.of(scene, edges) is not edges
    assert Edges.of(mi.load_dict({"type": "scene", "r": {"type": "rectangle"}}), edges) is not edges


BALL_OF_VOXELS = mi.TensorXf((np.linalg.norm(np.mgrid[-1:1:6j, -1:1:6j, -1:1:6j], axis=0) - 0.7)[..., None])


def test_shapes_whose_outline_is_unknown_are_refused():
    scene = mi.load_dict({"type": "scene", "grid": {"type": "sdfgrid", "id": "grid", "normals": "smooth",
                                                    "grid": BALL_OF_VOXELS}})  # fmt: skip
    with pytest.raises(ValueError, match='shape "grid", a SDFGrid'):
        Edges(scene)


# Outlines of the other shapes.

TURN = mi.ScalarTransform4f().translate([0.3, -0.2, 0.4]).rotate([0.48, 0.8, 0.36], 50)
SHAPES = {
    "sphere": {"type": "sphere", "to_world": TURN.scale(0.7)},
    "disk": {"type": "disk", "to_world": TURN.scale([0.8, 0.5, 1])},
    "rectangle": {"type": "rectangle", "to_world": TURN.scale([0.8, 0.5, 1])},
    "cylinder": {"type": "cylinder", "to_world": TURN.scale([0.4, 0.4, 1.1])},
}
EYES = {
    "near": lambda view: (mi.Vector3f(1.5, 0.7, 3.0), mi.Bool(True)),
    "distant": lambda view: (mi.Vector3f(0.4, -0.3, 0.9), mi.Bool(False)),
}


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("name", SHAPES)
def test_outlines_lie_on_the_shape_where_it_turns_away(name, eye):
    shape = mi.load_dict(SHAPES[name])
    to_local = np.linalg.inv(np.array(SHAPES[name]["to_world"].matrix))
    where, finite = (np.array(v).ravel() for v in EYES[eye](0))
    e = to_local @ [*where, 1.0 if finite[0] else 0.0]
    for curve in outline_of(shape, EYES[eye], 2, seed=3):
        p = np.array(curve.point).T @ to_local[:3, :3].T + to_local[:3, 3]
        v = np.array(curve.tangent).T @ to_local[:3, :3].T
        assert np.array_equal(np.bincount(np.array(curve.view)), [256, 256])
        p, v = p[:256], v[:256]
        radius = np.hypot(p[:, 0], p[:, 1])
        view = e[:3] - (p if finite[0] else 0 * p)
        if name == "sphere":
            np.testing.assert_allclose((p**2).sum(1), 1, atol=1e-5)
            np.testing.assert_allclose((p * view).sum(1), 0, atol=1e-4)
        elif name == "disk":
            np.testing.assert_allclose(radius, 1, atol=1e-5)
            np.testing.assert_allclose(p[:, 2], 0, atol=1e-5)
        elif name == "rectangle":
            np.testing.assert_allclose(np.abs(p[:, :2]).max(1), 1, atol=1e-5)
            np.testing.assert_allclose(p[:, 2], 0, atol=1e-5)
        else:
            np.testing.assert_allclose(radius, 1, atol=1e-5)
            if np.abs(v[:, 2]).max() > 1e-6:  # a line along it, else the circle at one end
                np.testing.assert_allclose((p[:, :2] * view[:, :2]).sum(1), 0, atol=1e-4)
                assert p[:, 2].min() >= 0 and p[:, 2].max() <= 1
            else:
                assert np.ptp(p[:, 2]) < 1e-5 and min(abs(p[0, 2]), abs(p[0, 2] - 1)) < 1e-5
        # The pieces add up to the curve: around, or from one end of the cylinder to the other.
        line = name == "cylinder" and np.abs(v[:, 2]).max() > 1e-6
        np.testing.assert_allclose(v.sum(0), [0, 0, 1] if line else [0, 0, 0], atol=0.02)
        length = {"disk": 2 * np.pi, "rectangle": 8}.get(name)
        if length:
            assert np.linalg.norm(v, axis=1).sum() == pytest.approx(length, rel=1e-4)


GROUND = {"type": "rectangle", "id": "ground", "to_world": mi.ScalarTransform4f().rotate([0.96, 0.28, 0], 12).scale(30)}


@pytest.mark.parametrize("eye_name", EYES)
def test_a_shadow_is_the_projection_of_its_edge(eye_name):
    board = {"type": "rectangle", "id": "board", "to_world": mi.ScalarTransform4f().translate([0.3, 0.2, 1]).scale(0.3)}
    scene = mi.load_dict({"type": "scene", "board": board, "ground": GROUND})
    shape = next(s for s in scene.shapes() if s.id() == "board")
    (edge,) = outline_of(shape, EYES[eye_name], 1, seed=1)
    camera = lambda view: (mi.Vector3f(4, -3, 2.5), mi.Bool(True))  # noqa: E731
    shadow = cast_shadow(scene, edge, EYES[eye_name], camera)
    assert np.array(shadow.active).all()
    matrix = np.array(GROUND["to_world"].matrix)
    normal = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    where, finite = (np.array(v).ravel() for v in EYES[eye_name](0))

    def project(p):
        d = p - where if finite[0] else np.broadcast_to(-where, p.shape)
        return p - d * (p @ normal / (d @ normal))[:, None]

    p, v = np.array(edge.point).T.astype(float), np.array(edge.tangent).T.astype(float)
    np.testing.assert_allclose(np.array(shadow.point).T, project(p), atol=1e-4)
    step = (project(p + 1e-4 * v) - project(p - 1e-4 * v)) / 2e-4
    np.testing.assert_allclose(np.array(shadow.tangent).T, step, atol=1e-3 * np.abs(step).max())
    # What the board hides from another camera is left out.
    eye = np.array([2, 1, 4.0])
    shadow = cast_shadow(scene, edge, EYES[eye_name], lambda view: (mi.Vector3f(eye), mi.Bool(True)))
    q = project(p)
    crossing = eye + (q - eye) * ((1 - eye[2]) / (q[:, 2] - eye[2]))[:, None]
    beside = np.abs(crossing[:, :2] - [0.3, 0.2]).max(1) - 0.3
    assert (beside < 0).any() == (eye_name == "distant")
    clear = np.abs(beside) > 1e-3
    np.testing.assert_array_equal(np.array(shadow.active)[clear], beside[clear] > 0)


# How the pictures of these shapes change when they move.

SENSOR = {
    "type": "photograph", "id": "000", "filename": "nowhere.png", "fx": 66.0, "fy": 58.0, "cx": 30.2, "cy": 25.8,
    "to_world": mi.ScalarTransform4f().look_at([0.9, -0.6, 4.0], [0.1, 0, 0.2], [0.3, 1, 0.2]),
    "film": {"type": "hdrfilm", "width": 63, "height": 49, "pixel_format": "rgba", "component_format": "float32",
             "rfilter": {"type": "box"}},
    "sampler": {"type": "multijitter"},
    "light": {"type": "point", "position": [2.4, 1.5, 3.0], "intensity": 20.0},
}  # fmt: skip
CUBE = {"cube": {"type": "cube", "to_world": TURN.scale([0.5, 0.4, 0.6])}}


def moved(t):
    """A motion that is neither along nor across anything."""
    turn = mi.AffineTransform4f().rotate(mi.Vector3f(0.48, 0.36, 0.8), t * 40)
    return mi.AffineTransform4f().translate(t * mi.Vector3f(0.6, -0.4, 0.3)) @ turn


def derivative(scene, name, channels, count=6):
    """(gradient, difference, standard error) of a weighted sum of pixels when `name` moves; `count` of differences."""
    params = mi.traverse(scene)
    value = params[name]
    start = type(value)(value)
    v, u = np.mgrid[:49, :63]
    weights = np.zeros((49, 63, 4), np.float32)
    weights[..., channels] = (1.3 + np.sin(0.16 * u - 0.2 * v + 0.4))[..., None]

    def render(t, spp, seed):
        if isinstance(start, mi.Float):  # vertices
            moving = moved(t) @ mi.Point3f(dr.unravel(mi.Point3f, start))
            params[name] = dr.ravel(moving)
        else:
            params[name] = moved(t) @ start
        params.update()
        return mi.render(scene, params, spp=spp, seed=seed, seed_grad=seed + 1000)

    gradients, differences, step = [], [], 0.012
    for seed in range(8):
        t = mi.Float(0)
        dr.enable_grad(t)
        dr.backward(dr.sum(render(t, 36, seed) * mi.TensorXf(weights), axis=None))
        gradients.append(dr.grad(t)[0])
    for seed in range(count):
        high, low = (np.array(render(mi.Float(d), 256, seed), float) for d in (step, -step))
        differences.append(((high - low) * weights).sum() / (2 * step))
    error = np.hypot(np.std(gradients, ddof=1) / np.sqrt(8), np.std(differences, ddof=1) / np.sqrt(count))
    return np.mean(gradients), np.mean(differences), error


def check(a, b, error):
    """Gradient `a` is difference `b` within 1 %, beyond three standard errors. Single curves contribute hundreds."""
    scale = max(abs(b), 100)
    assert error < 0.03 * scale, f"too noisy to tell: {a:.5g} and {b:.5g} ± {error:.2g}"
    assert abs(a - b) < 0.01 * scale + 3 * error, f"{a:.5g}, not {b:.5g} ± {error:.2g}"


@pytest.mark.parametrize("name", [*SHAPES, "cube"])
def test_outline_moves_with_the_shape(name):
    """Coverage: nothing but the outline moves it."""
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "photometric"}, "sensor": SENSOR,
                          "shape": (SHAPES | CUBE)[name]})  # fmt: skip
    param = "shape.vertex_positions" if name == "cube" else "shape.to_world"
    a, b, error = derivative(scene, param, slice(3, 4))
    check(a, b, error)


@pytest.mark.parametrize(
    ("name", "param"),
    [
        *((name, "shape.to_world") for name in SHAPES),
        *((name, "ground.to_world") for name in ("sphere", "rectangle")),
        *((name, "000.to_world") for name in ("disk", "cylinder")),
    ],
)
def test_shadow_moves_with_the_shape_the_ground_and_the_camera(name, param):
    ground = GROUND | {"to_world": mi.ScalarTransform4f().translate([0, 0, -0.9]).rotate([0.96, 0.28, 0], 12).scale(30)}
    white = {"type": "diffuse", "reflectance": 0.8}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "photometric"}, "sensor": SENSOR,
                          "shape": SHAPES[name] | {"bsdf": white}, "ground": ground | {"bsdf": white},
                          "flash": {"type": "flash"}}, optimize=False)  # fmt: skip
    a, b, error = derivative(scene, param, slice(0, 3), 3 if param == "ground.to_world" else 6)
    check(a, b, error)


@pytest.mark.parametrize("kind", ["point", "spot", "directional"])
def test_shadows_of_the_scenes_own_lamps_move_with_them(kind):
    lamps = {
        "point": {"type": "point", "position": [2.4, 1.5, 3.0], "intensity": 20.0},
        "spot": {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([2.4, 1.5, 3.0], [0, 0, -0.5], [0, 1, 0]),
                 "intensity": 20.0, "cutoff_angle": 60.0},
        "directional": {"type": "directional", "direction": [-0.5, -0.3, -0.8], "irradiance": 1.5},
    }  # fmt: skip
    dim = {"type": "point", "position": [0.9, -0.6, 4.0], "intensity": 1e-6}
    ground = GROUND | {"to_world": mi.ScalarTransform4f().translate([0, 0, -0.9]).rotate([0.96, 0.28, 0], 12).scale(30)}
    white = {"type": "diffuse", "reflectance": 0.8}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "photometric"}, "sensor": SENSOR | {"light": dim},
                          "shape": {"type": "sphere", "radius": 0.5, "bsdf": white}, "ground": ground | {"bsdf": white},
                          "lamp": lamps[kind]}, optimize=False)  # fmt: skip
    a, b, error = derivative(scene, "lamp.position" if kind == "point" else "lamp.to_world", slice(0, 3), 3)
    check(a, b, error)
