"""Small captures that the tests make themselves, and where the shared data is, if it is there."""

import gc
import os
import tempfile
import time
from pathlib import Path

# Each of several processes has cores of its own: with more threads than cores they mostly wait for one another.
if "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity"):
    worker, workers = int(os.environ["PYTEST_XDIST_WORKER"][2:]), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    available = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, available[worker::workers] or [available[worker % len(available)]])

import numpy as np
import pytest

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)
from mi_ring.doctor import OPTIONAL
from mi_ring.system.optional import installed

SHARED = Path(__file__).parents[2] / "shared"


def pytest_addoption(parser):
    parser.addoption("--variant", help="of Mitsuba, another than llvm_ad_rgb: for tests of rendering on a GPU")


def pytest_configure(config):
    folder = tempfile.TemporaryDirectory(prefix="mi_ring-cache-")  # instead of the user's
    os.environ["MI_RING_CACHE"] = folder.name
    config.add_cleanup(folder.cleanup)
    if variant := config.getoption("--variant"):
        import mitsuba as mi

        mi.set_variant(variant)


#: Fixtures of the tests that are marked as slow: packaging, sphinx, a browser, and processes that are killed.
SLOW = {"built", "program", "browser", "begun"}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark slow tests; mark those that share a fit, which `--dist loadgroup` then gives to one process."""
    for item in items:
        if SLOW & {*item.fixturenames}:
            item.add_marker("slow")
        fixtures = [found[-1] for found in item._fixtureinfo.name2fixturedefs.values()]
        if "finished" in item.fixturenames:
            item.add_marker(pytest.mark.xdist_group("finished"))
        elif any(fixture.scope == "module" for fixture in fixtures):
            item.add_marker(pytest.mark.xdist_group(item.module.__name__))


def free_garbage():
    """What is there afterwards stays: to look through all of it takes a quarter of a second each time."""
    gc.collect()
    gc.freeze()


def pytest_collection_finish():
    free_garbage()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item, nextitem):
    """Free also what fixtures of a module leave, after its last test."""
    result = yield
    if nextitem is None or nextitem.module is not item.module:
        gc.unfreeze()
        free_garbage()
    return result


@pytest.fixture(autouse=True)
def no_scenes_of_other_tests():
    """Free what a test leaves: as long as a scene lives, Dr.Jit compiles its objects into the kernels of all others.

    Not after the many tests that take no time, for looking for garbage takes longer.
    """
    started = time.process_time()
    yield
    if time.process_time() - started > 0.1:
        free_garbage()


def missing_package(error: BaseException | None) -> str | None:
    """The package of `OPTIONAL` that an error, or what it came from, could not import for it is not installed."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and error.name in OPTIONAL and not installed(error.name):
            return error.name
        error = error.__cause__ or error.__context__
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(call):
    """A test that needs a package which is not ready-made for every machine is skipped where it is missing."""
    if call.excinfo and (name := missing_package(call.excinfo.value)):
        skipped = pytest.skip.Exception(f"needs {name}")
        call.excinfo = pytest.ExceptionInfo.from_exc_info((type(skipped), skipped, call.excinfo.tb))


@pytest.fixture
def shared():
    """The folder of captures with known truth, which is not part of the repository."""
    if not (SHARED / "data" / "captures").is_dir():
        pytest.skip("needs the captures beside the repository (../shared/data/captures)")
    return SHARED


SENSOR = """
  <sensor type="photograph" id="{id}">
    <string name="filename" value="images/{id}.png"/>{mask}
    <float name="fx" value="{fx}"/> <float name="fy" value="{fy}"/> <float name="cx" value="{cx}"/> <float name="cy" value="{cy}"/>
    <transform name="to_world"><matrix value="{matrix}"/></transform>
    <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/></film>
    <emitter type="point"><point name="position" x="{x}" y="{y}" z="{z}"/><rgb name="intensity" value="{intensity}"/></emitter>
  </sensor>"""  # noqa: E501

SCENE = """<scene version="3.0.0">
  <integrator type="photometric"/>
  <shape type="shapenet" id="object"><bsdf type="cooktorrance"/></shape>{sensors}
</scene>
"""

#: The object of `small_capture`: an ellipsoid, its axes not those of the world, far from the origin [scene units].
CENTER, AXES = np.array([400.0, -150.0, 90.0]), np.array([30.0, 20.0, 24.0])


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory):
    """Path of a scene of twelve 56 × 40 photographs of a two-coloured ellipsoid, traced by stock Mitsuba."""
    import mitsuba as mi
    import trimesh
    from scipy.spatial.transform import Rotation

    from mi_ring.geometry.camera import Camera
    from mi_ring.images import linear_to_srgb, to_bytes
    from mi_ring.scene.lights import Light
    from mi_ring.scene.plain_mesh import mesh_of
    from mi_ring.synthesis.object_on_table import ObjectOnTable
    from mi_ring.synthesis.tracing import LensCamera
    from mi_ring.synthesis.viewpoints import look_at

    folder = tmp_path_factory.mktemp("small")
    (folder / "images").mkdir()
    (folder / "masks").mkdir()
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    ball = trimesh.creation.icosphere(subdivisions=5)
    vertices = CENTER + ball.vertices * AXES @ turn.T
    mesh = mesh_of(vertices, ball.faces)
    bands = 0.5 + 0.5 * np.sin(3 * ball.vertices[:, :1] + 2 * ball.vertices[:, 2:])
    colour = bands * [0.6, 0.2, 0.1] + (1 - bands) * [0.3, 0.4, 0.2]
    mesh.add_attribute("vertex_color", 3, colour.astype(np.float32).ravel())
    mesh.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}))
    scene = ObjectOnTable(mesh, vertices)
    width, height, fx, fy, cx, cy = 56, 40, 60.0, 66.0, 30.5, 18.0
    random, sensors = np.random.default_rng(5), []
    for k in range(12):
        direction = random.normal(size=3)
        direction /= np.linalg.norm(direction)
        origin = CENTER + random.uniform(120, 150) * direction
        target = CENTER + random.uniform(-3, 3, 3)
        matrix = look_at(origin, target, random.normal(size=3))
        light = origin + matrix[:3, :3] @ [15, 10, 0]
        intensity = 2.2 * np.linalg.norm(light - CENTER) ** 2
        view = LensCamera(Camera(matrix, np.array([fx, fy]), np.array([cx, cy]), (width, height)))
        radiance = scene.radiance(view, Light("point", light, np.full(3, intensity)), 16, k, 2)
        coverage = scene.coverage(view, 16)
        mi.Bitmap(to_bytes(linear_to_srgb(radiance))).write(str(folder / f"images/{k:03}.png"))
        mi.Bitmap((coverage[..., None] > 0.5).astype(np.uint8) * 255).write(str(folder / f"masks/{k:03}.png"))
        sensors.append(SENSOR.format(
            id=f"{k:03}", mask=f'\n    <string name="mask" value="masks/{k:03}.png"/>', fx=fx, fy=fy, cx=cx, cy=cy,
            matrix=" ".join(f"{v:.9g}" for v in matrix.ravel()), width=width, height=height,
            x=light[0], y=light[1], z=light[2], intensity=intensity,
        ))  # fmt: skip
    (folder / "small.xml").write_text(SCENE.format(sensors="".join(sensors)))
    return folder / "small.xml"


@pytest.fixture(scope="session")
def finished(small_capture, tmp_path_factory):
    """The results folder of a quick fit, for tests that only read it."""
    from helpers.quick_fits import ITERATIONS, SPHERE

    from mi_ring import fit

    folder = tmp_path_factory.mktemp("fit") / "small"
    assert fit.main([str(small_capture), "--out", str(folder), "--iterations", str(ITERATIONS), *SPHERE]) == 0
    return folder


@pytest.fixture
def broken_capture(small_capture, tmp_path):
    """A copy of the small capture to break, and a function that edits its XML."""
    import shutil

    folder = tmp_path / "broken"
    shutil.copytree(small_capture.parent, folder)
    path = folder / "small.xml"

    def edit(old, new, count=1):
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, count))

    return path, edit


def photographed_ellipsoid(folder, *options):
    """Path of the scene of a small path-traced capture of an ellipsoid, ten photographs, by options of synthesize."""
    import trimesh

    from mi_ring import synthesize

    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.vertices = ball.vertices * AXES
    ball.export(folder / "ball.ply")
    small = ["--views", "10", "--novel", "0", "--size", "40", "32", "--spp", "16"]
    material = ["--material", "diffuse reflectance=0.5"]
    synthesize.main([str(folder / "ball.ply"), str(folder / "capture"), *small, *material, *options])
    return folder / "capture/scene.xml"


@pytest.fixture(scope="session")
def in_an_environment(tmp_path_factory):
    """Path of a scene of an ellipsoid in the `lobe`, of which the scene says nothing."""
    from helpers.unknown_light import lobe

    folder = tmp_path_factory.mktemp("environment")
    return photographed_ellipsoid(folder, "--environment", str(lobe(folder / "lobe.exr")), "--wrong-room")


@pytest.fixture
def short_trials(monkeypatch):
    """Coarse fits of few iterations."""
    from mi_ring.fitting import light_selection

    brief = {"iterations": 9, "levels": (2,), "batch": 4}
    monkeypatch.setattr(light_selection, "COARSE", light_selection.COARSE | brief)
    monkeypatch.setattr(light_selection, "LAST", 7)
