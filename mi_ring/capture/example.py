"""A small capture of the package's own making: flash photographs of a pot, path traced by stock Mitsuba."""

from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import trimesh
from tqdm import tqdm

from mi_ring.capture.scenefile import Element, photograph_element, scene_bytes, scene_element
from mi_ring.geometry.camera import Camera
from mi_ring.images import linear_to_srgb, to_bytes, write_image
from mi_ring.rendering.lights import Light
from mi_ring.rendering.plain_mesh import mesh_of

CENTER, HEIGHT = np.array([40.0, -15.0, 110.0]), 80.0  #: of the pot [mm]; y is up
VIEWS, SIZE, FOCAL = 28, 192, 400.0  #: photographs, their pixels and focal length [px]
DISTANCE = 230.0  #: from the camera to the pot [mm]
FLASH = np.array([18.0, 12.0, 0.0])  #: beside the lens: to the left and above [mm]
SPP = 49  #: samples per pixel
BRIGHTNESS = 0.9  #: linear radiance of a white surface that faces the flash, in the pictures


class Object(NamedTuple):
    """A mesh with colours."""

    vertices: np.ndarray  #: (V, 3) [mm]
    faces: np.ndarray  #: (F, 3)
    colours: np.ndarray  #: (V, 3)


def pot(level: int = 6) -> Object:
    """A closed pot: a profile with foot, belly, neck and lip, turned about y, fluted and leaning a little."""
    sphere = trimesh.creation.icosphere(subdivisions=level)
    x, y, z = sphere.vertices.T
    t, angle = np.arccos(np.clip(-y, -1, 1)) / np.pi, np.arctan2(z, x)  # along the profile, from the foot up; around it
    belly = 0.33 * np.sin(np.pi * t) ** 0.55 * (1 + 0.28 * np.cos(2 * np.pi * (t - 0.34)))
    lip = 0.05 * np.exp(-(((t - 0.86) / 0.05) ** 2))
    flutes = 1 + 0.05 * np.cos(7 * angle + 6 * t) * np.exp(-(((t - 0.42) / 0.2) ** 2))
    radius = HEIGHT * (belly * flutes + lip)
    lean = 0.06 * HEIGHT * (t - 0.5)
    place = np.stack([radius * np.cos(angle) + lean, HEIGHT * (t - 0.5), 0.92 * radius * np.sin(angle)], 1)
    mixed = 0.5 + 0.5 * np.tanh(6 * np.sin(5 * np.pi * t + 1.5 * np.sin(2 * angle)))[:, None]
    return Object(CENTER + place, sphere.faces, mixed * [0.55, 0.16, 0.08] + (1 - mixed) * [0.12, 0.3, 0.42])


def cameras() -> list[Camera]:
    """From all around, evenly: points of a Fibonacci spiral."""
    result = []
    for k in range(VIEWS):
        y = 1 - 2 * (k + 0.5) / VIEWS
        turn = k * np.pi * (3 - np.sqrt(5))
        direction = np.array([np.cos(turn) * np.sqrt(1 - y * y), y, np.sin(turn) * np.sqrt(1 - y * y)])
        up = [0.0, 1.0, 0.0] if abs(y) < 0.9 else [1.0, 0.0, 0.0]
        look = mi.ScalarTransform4f().look_at((CENTER + DISTANCE * direction).tolist(), CENTER.tolist(), up)
        result.append(Camera(np.array(look.matrix), np.full(2, FOCAL), np.full(2, SIZE / 2), (SIZE, SIZE)))
    return result


def photographed(scene: mi.Scene, camera: Camera, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """What a camera sees by `path`: linear radiance (H, W, 3) and coverage (H, W), means over the pixels' squares."""
    width, height = camera.size
    n = int(np.sqrt(spp))
    y, x = (np.mgrid[: height * n, : width * n] + 0.5) / n
    rays = camera.directions(np.stack([x.ravel(), y.ravel()], 1))
    origin, direction = mi.Point3f(*camera.position.tolist()), mi.Vector3f(*rays.T.astype(np.float32))
    ray = mi.RayDifferential3f(mi.Ray3f(origin, direction))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(rays))
    radiance, hit, _ = mi.load_dict({"type": "path", "max_depth": 4}).sample(scene, sampler, ray)
    picture = np.array(radiance).T.reshape(height, n, width, n, 3).mean((1, 3))
    return picture, np.array(hit).reshape(height, n, width, n).mean((1, 3))


def write_example(folder: Path, spp: int = SPP) -> None:
    """Write scene.xml, images/, masks/ and truth/mesh.ply into a folder that is there."""
    shown = pot()
    mesh = mesh_of(shown.vertices, shown.faces)
    mesh.add_attribute("vertex_color", 3, shown.colours.ravel().tolist())
    glaze = {"type": "principled", "roughness": 0.35, "specular": 0.6,
             "base_color": {"type": "mesh_attribute", "name": "vertex_color"}}  # fmt: skip
    mesh.set_bsdf(mi.load_dict(glaze))
    for name in ("images", "masks", "truth"):
        (folder / name).mkdir()
    mesh.write_ply(str(folder / "truth" / "mesh.ply"))
    elements: list[Element] = []
    for k, camera in enumerate(tqdm(cameras(), desc="photographing", unit="photograph")):
        position = camera.position + camera.to_world[:3, :3] @ FLASH
        light = Light("point", position, np.full(3, np.pi * BRIGHTNESS * DISTANCE**2))
        intensity = {"type": "rgb", "value": light.rgb.tolist()}
        lamp = {"type": "point", "position": position.tolist(), "intensity": intensity}
        scene = mi.load_dict({"type": "scene", "pot": mesh, "lamp": lamp})
        picture, coverage = photographed(scene, camera, spp)
        write_image(to_bytes(linear_to_srgb(picture)), folder / "images" / f"{k:03}.png")
        write_image(to_bytes(coverage > 0.5)[..., None], folder / "masks" / f"{k:03}.png")
        elements.append(photograph_element(f"{k:03}", f"images/{k:03}.png", camera, light, f"masks/{k:03}.png"))
    (folder / "scene.xml").write_bytes(scene_bytes(scene_element(elements)))
