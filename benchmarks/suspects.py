"""What faults of real photographs cost: each is imitated alone in a capture with known truth.

    python benchmarks/suspects.py CAPTURE [--out out/suspects] [--only NAME…] [OPTIONS OF mi-ring fit]

CAPTURE is a folder with scene.xml and truth/mesh.ply, whose flash is at the lens. The photographs are changed after
rendering; interreflection is not changed with them. Every other photograph is one capture of the object, the others are
a second one. Each is fitted twice: with `--refine light power ambient --diffuse lambert --lobes 1`, and with options
that should cure the fault. The last rows change the fit, or the choice of photographs, instead of the photographs.

Prints a Markdown table with machine and date: mean error of the normals against the truth (of both captures), and mean
and median angle between the normals of both surfaces at the nearest points. The same command continues after an
interruption.
"""

import argparse
import datetime
import io
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mi_ring.capture.emitter_elements import numbers
from mi_ring.capture.scenefile import move_names
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.images import linear_to_srgb
from mi_ring.plugins.matte_reflection import DARKER
from mi_ring.scene.tone_curve import contrasted

# isort: split
import mitsuba as mi
import numpy as np
import torch
import trimesh
from accuracy import processor, product_speed, table
from halves import fitted, half
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

BEFORE = "--refine light power ambient --diffuse lambert --lobes 1"  #: without what real photographs asked for
FLASHES = 12  #: points of an extended flash
POINTS, NEAR = 40_000, 0.01  #: of each surface; pairs of points farther apart do not count [diagonal]


class Lens(NamedTuple):
    """Directions of a photograph's pixels in the camera's axes, each (H, W), and random numbers of the photograph."""

    left: np.ndarray
    up: np.ndarray
    forward: np.ndarray
    facing: np.ndarray  #: (H, W) cosine between the surface's normal and the ray; 1 beside the object
    lit: Callable[[np.ndarray], np.ndarray]  #: what `Scene.lit` returns for a flash (3,) in the camera's axes
    random: np.random.Generator


def narrow(values: np.ndarray, lens: Lens) -> np.ndarray:
    """Light like a narrow flash that points down, as that of two real captures does."""
    return values * (lens.forward**38 * np.exp(-6 * lens.up) * 1.3)[..., None]


def rough(values: np.ndarray, lens: Lens) -> np.ndarray:
    """Light of a rough matte surface, as of `cooktorrance` with a `diffuse_roughness` of 0.25."""
    cosine = lens.facing.clip(0.2)  # pixels at outlines show more than one surface
    return values * ((1 + 0.25 * (1 - cosine**2) / cosine) / (1 + 0.25 * DARKER))[..., None]


def varnished(values: np.ndarray, lens: Lens) -> np.ndarray:
    """Light with a second, narrow lobe of highlights (Beckmann, roughness 0.1)."""
    tangent2 = 1 / lens.facing.clip(0.2) ** 2 - 1
    return values + 0.3 * np.exp(-tangent2 / 0.1**2)[..., None] * (lens.facing < 1)[..., None]


def extended(values: np.ndarray, lens: Lens) -> np.ndarray:
    """Light of a flash that is a disc, whose radius is 4 % of its distance."""
    angles = np.pi * (3 - 5**0.5) * np.arange(FLASHES)
    radii = 0.04 * np.sqrt((np.arange(FLASHES) + 0.5) / FLASHES)
    places = np.stack([radii * np.cos(angles), radii * np.sin(angles), 0 * radii], 1)
    places -= places.mean(0)
    point = lens.lit(np.zeros(3))
    ratio = sum(lens.lit(place) for place in places) / FLASHES / np.maximum(point, 1e-9)
    return values * np.where(point > 0, ratio.clip(0, 3), 1)[..., None]


class Scene:
    """A mesh as a camera sees it. `rays` (3, H, W): of the pixels, in the camera's axes."""

    def __init__(self, mesh: mi.Scene, pose: np.ndarray, rays: np.ndarray) -> None:
        along = np.tensordot(pose[:3, :3], rays, 1).reshape(3, -1).astype(np.float32)
        ray = mi.Ray3f(mi.Point3f(*pose[:3, 3].tolist()), mi.Vector3f(*map(mi.Float, along)))
        self.mesh, self.pose, self.size, self.si = mesh, pose, rays.shape[1:], mesh.ray_intersect(ray)
        self.seen = np.array(self.si.is_valid())
        self.distance = np.median(np.array(self.si.t)[self.seen])

    def facing(self) -> np.ndarray:
        """Cosines (H, W) between normals and rays; 1 where there is no mesh."""
        return np.where(self.seen, np.abs(np.array(self.si.wi.z)), 1).reshape(self.size)

    def lit(self, place: np.ndarray) -> np.ndarray:
        """Light (H, W) that a plain glossy surface reflects to the camera, with shadows; 0 where there is no mesh.

        `place` (3,): of the flash in the camera's axes, from the lens [distance of the surface].
        """
        flash = mi.Point3f(*(self.pose[:3, 3] + self.distance * self.pose[:3, :3] @ place).tolist())
        bsdf = mi.load_dict({"type": "cooktorrance", "diffuse": 0.3, "specular": 0.05, "roughness": 0.3,
                             "diffuse_roughness": 0.0})  # fmt: skip
        squared = mi.Vector3f(flash - self.si.p)
        squared = squared.x**2 + squared.y**2 + squared.z**2
        wo = self.si.to_local((flash - self.si.p) / (squared**0.5))
        value = bsdf.eval(mi.BSDFContext(), self.si, wo).x / squared
        shadow = self.mesh.ray_test(self.si.spawn_ray_to(flash))
        return np.where(self.seen & ~np.array(shadow), np.array(value), 0).reshape(self.size)


def compressed(values: np.ndarray) -> np.ndarray:
    """Encoded values after JPEG of low quality."""
    file = io.BytesIO()
    Image.fromarray((255 * values.clip(0, 1) + 0.5).astype(np.uint8)).save(file, "JPEG", quality=40)
    return np.asarray(Image.open(file), np.float64) / 255


def blocky(mask: np.ndarray) -> np.ndarray:
    """A mask (H, W) of whole blocks of 8 pixels."""
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % 8), (0, -width % 8)))
    blocks = padded.reshape(len(padded) // 8, 8, -1, 8).mean((1, 3)) > 64
    return np.kron(blocks, np.full((8, 8), 255)).astype(np.uint8)[:height, :width]


def moved(pose: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A pose (4, 4) turned by about 0.1° and moved by about 0.2 % of the distance from the origin."""
    pose = pose.copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.radians(0.1) * random.normal(size=3)).as_matrix()
    pose[:3, 3] += 0.002 * np.linalg.norm(pose[:3, 3]) * random.normal(size=3)
    return pose


class Suspect(NamedTuple):
    """A fault, and the options of a fit that should cure it."""

    cure: str = "--refine auto"
    before: str = BEFORE
    by_height: bool = False  #: one capture has the photographs from above, the other one those from below
    radiance: Callable[[np.ndarray, Lens], np.ndarray] = lambda values, lens: values  #: linear, (H, W, 3)
    encoded: Callable[[np.ndarray], np.ndarray] = lambda values: values
    mask: Callable[[np.ndarray], np.ndarray] = lambda mask: mask
    pose: Callable[[np.ndarray, np.random.Generator], np.ndarray] = lambda pose, random: pose


SUSPECTS = {
    "none": Suspect(),
    "narrow flash": Suspect(radiance=narrow),
    "rough material": Suspect(radiance=rough),
    "second gloss": Suspect(radiance=varnished),
    "vignetting": Suspect(radiance=lambda values, lens: values * lens.forward[..., None] ** 4),
    "clipped": Suspect(radiance=lambda values, lens: 3 * values),
    "exposures ± 15 %": Suspect(radiance=lambda values, lens: values * np.exp(0.15 * lens.random.normal())),
    "contrast": Suspect(encoded=lambda v: linear_to_srgb(contrasted(srgb_to_linear(v), 1.4))),
    "exponent": Suspect("--refine auto curve", encoded=lambda v: linear_to_srgb(srgb_to_linear(v) ** 1.2)),
    "JPEG": Suspect(encoded=compressed),
    "blocky masks": Suspect("--refine auto masks", mask=blocky),
    "poses": Suspect(pose=moved),
    "extended flash": Suspect(radiance=extended),
    "interreflection left out": Suspect(before="--refine auto --no-indirect"),
    "four times the regulariser": Suspect(before="--refine auto --weights.velocity 0.04"),
    "a quarter of the regulariser": Suspect(before="--refine auto --weights.velocity 0.0025"),
    "other places": Suspect(by_height=True),
}


def write(capture: Path, folder: Path, suspect: Suspect) -> Path:
    """The capture with a fault, in a folder. Returns its scene file."""
    scene = folder / "scene.xml"
    if scene.exists():
        return scene
    root = ElementTree.parse(capture / "scene.xml").getroot()
    mesh = mi.load_dict({"type": "scene", "object": {"type": "ply", "filename": str(capture / "truth/mesh.ply")}})
    for number, sensor in enumerate(root.findall("sensor")):
        random = np.random.default_rng(number)
        name, mask = (sensor.find(f"string[@name='{key}']") for key in ("filename", "mask"))
        fx, fy, cx, cy = (float(sensor.find(f"float[@name='{key}']").get("value")) for key in ("fx", "fy", "cx", "cy"))
        values = np.asarray(Image.open(capture / name.get("value")).convert("RGB"), np.float64) / 255
        y, x = np.mgrid[: len(values), : values.shape[1]] + 0.5
        rays = np.stack([(cx - x) / fx, (cy - y) / fy, np.ones_like(x)])
        rays /= np.linalg.norm(rays, axis=0)
        matrix = sensor.find("transform/matrix")
        pose = np.array(matrix.get("value").split(), float).reshape(4, 4)
        shown = Scene(mesh, pose, rays)
        lens = Lens(*rays, shown.facing(), shown.lit, random)
        values = suspect.encoded(linear_to_srgb(suspect.radiance(srgb_to_linear(values), lens).clip(0, 1)))
        silhouette = suspect.mask(np.asarray(Image.open(capture / mask.get("value")).convert("L")))
        for element, picture in ((name, (255 * values.clip(0, 1) + 0.5).astype(np.uint8)), (mask, silhouette)):
            path = folder / element.get("value")
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture).save(path)
        pose = suspect.pose(pose, random)
        matrix.set("value", numbers(pose.ravel()))
        point = sensor.find("emitter/point")  # the flash is at the lens
        for axis, value in zip("xyz", pose[:3, 3]):
            point.set(axis, str(value))
    if suspect.by_height:  # so that every other photograph is from above
        sensors = sorted(root.findall("sensor"), key=height_of)
        for sensor in sensors:
            root.remove(sensor)
        below, above = sensors[: len(sensors) // 2], sensors[len(sensors) // 2 :]
        root.extend(sensor for pair in zip(below, above) for sensor in pair)
    move_names(root, folder, folder)
    scene.write_bytes(ElementTree.tostring(root))
    return scene


def height_of(sensor: ElementTree.Element) -> float:
    """The camera's last coordinate."""
    return float(sensor.find("transform/matrix").get("value").split()[11])


def angles(one: Path, other: Path) -> np.ndarray:
    """Angles [degrees] between the normals of two meshes in the same frame, at nearest points."""
    sides = []
    for path in (one, other):
        mesh = trimesh.load(path, process=False)
        points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
        normals = (mesh.vertex_normals[mesh.faces[faces]] * weights[..., None]).sum(1)
        sides.append((points, normals / np.linalg.norm(normals, axis=1, keepdims=True)))
    (a, of_a), (b, of_b) = sides
    distance, nearest = cKDTree(a).query(b)
    near = distance < NEAR * np.linalg.norm(np.ptp(a, 0))
    return np.degrees(np.arccos((of_b * of_a[nearest]).sum(1).clip(-1, 1)))[near]


def measured(scene: Path, truth: Path, options: list[str]) -> str:
    """The cell of a table: fits of both halves of the photographs."""
    outs, errors = [], []
    for which in (0, 1):
        path = scene.parent / f"{which}.xml"
        half(scene, which, path)
        out = scene.parent / "".join([str(which), *options])
        fitted(path, out, options)
        command = [sys.executable, "-m", "mi_ring.evaluate", str(out), "--mesh", str(truth), "--spp", "1", "--align",
                   "rigid"]  # fmt: skip
        errors.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["normal_mean"])
        outs.append(out / "mesh.ply")
    apart = angles(*outs)
    return f"{np.mean(errors):.2f}°, {apart.mean():.2f}° / {np.median(apart):.2f}°"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/suspects"))
    parser.add_argument("--only", nargs="+", choices=SUSPECTS, default=[*SUSPECTS])
    arguments, options = parser.parse_known_args()
    rows, truth = [], arguments.capture / "truth/mesh.ply"
    for name in arguments.only:
        suspect = SUSPECTS[name]
        changes = suspect._replace(before=BEFORE, cure=SUSPECTS["none"].cure) != SUSPECTS["none"]
        folder = re.sub(r"\W+", "_", name if changes else "none")
        scene = write(arguments.capture, arguments.out / arguments.capture.name / folder, suspect)
        cells = [measured(scene, truth, [*own.split(), *options]) for own in (suspect.before, suspect.cure)]
        rows.append([name, f"`{suspect.before}`".replace(f"`{BEFORE}`", ""), cells[0], f"`{suspect.cure}`", cells[1]])
        print(*rows[-1], file=sys.stderr, flush=True)
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}; {speed:.0f} GFLOP/s; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n")
    print(f"First: fits with `{BEFORE}`, unless the table names other options.\n")
    print(table(["fault", "options", "error, apart", "cure", "error, apart"], rows))


if __name__ == "__main__":
    main()
