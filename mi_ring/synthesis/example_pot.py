"""Makes the example capture: flash photographs of a pot, path traced by Mitsuba."""

from pathlib import Path
from typing import NamedTuple, cast

import mitsuba as mi
import numpy as np
import trimesh
from scipy.interpolate import CubicSpline

from mi_ring.capture.emitter_elements import Element
from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.geometry.camera import Camera
from mi_ring.images import linear_to_srgb, to_bytes, write_image
from mi_ring.scene.lights import Light
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.scene.shot import Files, Shot
from mi_ring.synthesis.object_on_table import ObjectOnTable
from mi_ring.synthesis.tracing import LensCamera
from mi_ring.synthesis.viewpoints import GOLDEN, look_at
from mi_ring.system.files import write_file
from mi_ring.system.progress import progress

CENTER, HEIGHT = np.array([40.0, -15.0, 110.0]), 80.0  #: of the pot [mm]; y is up
VIEWS, SIZE, FOCAL = 28, 192, 400.0  #: number of photographs, their width and height [px], focal length [px]
DISTANCE = 230.0  #: from a camera to the middle of the pot [mm]
FLASH = np.array([18.0, 12.0, 0.0])  #: position of the flash relative to the lens: left, up, forward [mm]
SPP, DEPTH = 64, 4  #: paths per pixel, and their greatest depth
BRIGHTNESS = 0.9  #: linear pixel value of a white surface that faces the flash

#: Profile of the pot, (radius, height) [height of the pot]: foot, belly, shoulder, neck, lip, closed top.
PROFILE = np.array([
    (0.0, -0.5), (0.19, -0.49), (0.19, -0.43), (0.24, -0.33), (0.36, -0.1), (0.31, 0.14), (0.18, 0.28), (0.16, 0.36),
    (0.23, 0.46), (0.16, 0.49), (0.0, 0.46),
])  # fmt: skip


class ColouredMesh(NamedTuple):
    """A mesh with linear RGB colours at its vertices."""

    vertices: np.ndarray  #: (V, 3) [mm]
    faces: np.ndarray  #: (F, 3)
    colours: np.ndarray  #: (V, 3)

    def ply(self) -> bytes:
        """Return the mesh as the bytes of a PLY file, without colours."""
        return cast(bytes, trimesh.Trimesh(self.vertices, self.faces, process=False).export(file_type="ply"))


def pot(level: int = 6) -> ColouredMesh:
    """Make the closed mesh of a pot in mm: a profile that is rotated about y, fluted, flattened and sheared.

    `level`: number of subdivisions of the icosphere that is deformed to the pot; it has 10 · 4^level + 2 vertices.
    """
    sphere = trimesh.creation.icosphere(subdivisions=level)
    x, y, z = sphere.vertices.T
    t, angle = np.arccos(np.clip(-y, -1, 1)) / np.pi, np.arctan2(z, x)  # position along the profile, and around y
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(PROFILE, axis=0), axis=1)))
    # At both ends the height has slope 0 and the radius has curvature 0, so that the surface is smooth there.
    radius, height = (
        CubicSpline(along / along[-1], values, bc_type=((order, 0.0), (order, 0.0)))(t)
        for values, order in zip(PROFILE.T, (2, 1))
    )
    radius *= 1 + 0.05 * np.cos(7 * angle + 9 * height) * np.exp(-(((height + 0.1) / 0.18) ** 2))
    place = np.stack([radius * np.cos(angle) + 0.06 * height, height, 0.92 * radius * np.sin(angle)], 1)
    mixed = 0.5 + 0.5 * np.tanh(6 * np.sin(5 * np.pi * height + 5 * radius * np.sin(2 * angle)))[:, None]
    colours = mixed * [0.55, 0.16, 0.08] + (1 - mixed) * [0.12, 0.3, 0.42]
    return ColouredMesh(CENTER + HEIGHT * place, sphere.faces, colours)


def cameras() -> list[Camera]:
    """Place `VIEWS` cameras evenly around the pot, all at the same distance. They look at the middle of the pot."""
    result = []
    for k in range(VIEWS):
        y = 1 - 2 * (k + 0.5) / VIEWS
        direction = np.array([np.cos(k * GOLDEN) * np.sqrt(1 - y * y), y, np.sin(k * GOLDEN) * np.sqrt(1 - y * y)])
        up = np.array([0.0, 1.0, 0.0] if abs(y) < 0.9 else [1.0, 0.0, 0.0])
        to_world = look_at(CENTER + DISTANCE * direction, CENTER, up)
        result.append(Camera(to_world, np.full(2, FOCAL), np.full(2, SIZE / 2), (SIZE, SIZE)))
    return result


def write_example(folder: Path, spp: int = SPP) -> None:
    """Render the example capture. Writes scene.xml, images/, masks/ and truth/mesh.ply into an existing, empty folder.

    `spp`: light paths per pixel, a square number.
    """
    vertices, faces, colours = pot()
    mesh = mesh_of(vertices, faces)
    mesh.add_attribute("vertex_color", 3, colours.ravel().tolist())
    glaze = {"type": "principled", "roughness": 0.45, "specular": 0.6,
             "base_color": {"type": "mesh_attribute", "name": "vertex_color"}}  # fmt: skip
    mesh.set_bsdf(mi.load_dict(glaze))
    for name in ("images", "masks", "truth"):
        (folder / name).mkdir()
    stream = mi.MemoryStream()  # Mitsuba's own files end in a RuntimeError on a full disk
    mesh.write_ply(stream)
    write_file(folder / "truth/mesh.ply", stream.raw_buffer())
    scene, elements = ObjectOnTable(mesh, vertices), list[Element]()
    for k, camera in enumerate(progress(cameras(), "photographing", unit="photograph", leave=True)):
        position = camera.position + camera.to_world[:3, :3] @ FLASH
        light = Light("point", position, np.full(3, np.pi * BRIGHTNESS * DISTANCE**2))
        name, view = f"{k:03}", LensCamera(camera)
        picture = scene.radiance(view, light, spp, k, DEPTH)
        write_image(to_bytes(linear_to_srgb(picture)), folder / "images" / f"{name}.png")
        write_image(to_bytes(scene.coverage(view)[..., None] >= 0.5), folder / "masks" / f"{name}.png")
        files = Files(Path(f"images/{name}.png"), Path(f"masks/{name}.png"))
        elements.append(photograph_element(Shot(name, camera, light, files=files, calibrated=True)))
    write_file(folder / "scene.xml", scene_bytes(scene_element(elements)))
