"""What light that bounces between surfaces is worth to a fit: a glossy bowl, fitted with and without it.

    python benchmarks/interreflection.py [--out out/interreflection] [--spp N] [OPTIONS OF mi_ring.fit]

Makes the capture OUT/bowl/ unless it is there: 28 flash photographs of 256 x 256, path traced by stock Mitsuba with
another material than ours (`principled`), and 8 novel ones. Prints the table of `accuracy.py`, one line per fit. The
camera is that of `scenes/make_pot2.py`.
"""

import argparse
import datetime
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "scenes"))

import mi_ring  # noqa: F401  (before Mitsuba, for it chooses LLVM)

# isort: split
import make_pot2
import mitsuba as mi
import numpy as np
import trimesh
from accuracy import COLUMNS, cells, measure, processor, table
from scipy.interpolate import CubicSpline

CENTER = np.array([-21.0, 33.0, 95.0])  # of the bowl's bounding box, scene units [mm]
VIEWS, NOVEL_VIEWS = 28, 8
SATURATED = 0.01  # share of the object's pixels that the flash overexposes

#: Half the bowl's cross section, (radius, height) [mm]: from below along the outside, over the rim, down the inside.
PROFILE = [(0, -30), (17, -30), (36, -20), (47, 0), (51.5, 20), (50.5, 25.5), (46.5, 23), (41, 2), (30, -12.5),
           (15, -19.5), (0, -21)]  # fmt: skip


def bowl(rings=160, sectors=288):
    """The bowl: a closed surface of revolution, then fluted, squashed, given a spout and tilted."""
    points = np.array(PROFILE, float)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    curve = CubicSpline(length, points, bc_type=(((1, (1.0, 0.0))), ((1, (-1.0, 0.0)))))
    radius, height = curve(np.linspace(0, length[-1], rings + 2))[1:-1].T[:, :, None]
    angle = 2 * np.pi * np.arange(sectors) / sectors + 0 * radius
    spout = np.exp(-(((angle - 2.2) / 0.33) ** 2)) * make_pot2.smooth_step(-8, 26, height)
    flutes = np.cos(11 * angle) * make_pot2.smooth_step(-22, -4, height) * make_pot2.smooth_step(22, 8, height)
    radius = radius * (1 + 0.05 * np.cos(2 * angle + 0.4) + 0.14 * spout) + 0.7 * flutes
    height = height + 3 * spout + 0 * angle
    grid = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings - 1) * sectors, np.arange(sectors), indexing="ij")
    a, b = (i + j).ravel(), (i + (j + 1) % sectors).ravel()
    bottom, top, k = len(grid), len(grid) + 1, np.arange(sectors)
    first, last = k, (rings - 1) * sectors + k
    faces = [np.stack([a, a + sectors, b], 1), np.stack([b, a + sectors, b + sectors], 1),
             np.stack([np.full(sectors, bottom), first, np.roll(first, -1)], 1),
             np.stack([np.full(sectors, top), np.roll(last, -1), last], 1)]  # fmt: skip
    mesh = trimesh.Trimesh([*grid, [0, PROFILE[0][1], 0], [0, PROFILE[-1][1], 0]], np.concatenate(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == 2
    return mesh


def glaze(p):
    """Base colour (N, 3) and roughness (N,): a bright glaze, apricot that has run into cream, and brush marks."""
    rng = np.random.default_rng(3)
    run, cloud, brush = (
        make_pot2.noise(p * [1, stretch, 1], size, rng) for stretch, size in ((1, 40), (1, 50), (4, 28))
    )
    share = make_pot2.smooth_step(-1.0, 1.0, run + 0.03 * p[:, 1])[:, None]
    color = share * [0.82, 0.62, 0.40] + (1 - share) * [0.80, 0.75, 0.62]
    color *= 1 - 0.25 * make_pot2.smooth_step(1.2, 1.8, brush)[:, None]
    return color.clip(0, 0.9), (0.34 + 0.03 * cloud).clip(0.25, 0.45)


def cameras(points, count, seed):
    """Camera-to-world matrices: most look into the bowl, some at it from below; as near as it fits into the frame."""
    rng = np.random.default_rng(seed)
    result = []
    for k in range(count):
        height = 0.97 - 1.5 * (k + rng.uniform(0.1, 0.9)) / count  # sine of the elevation
        azimuth = 2.399963 * k + seed + rng.normal(0, 0.12)  # golden angle
        away = np.array([np.sqrt(1 - height**2) * np.cos(azimuth), height, np.sqrt(1 - height**2) * np.sin(azimuth)])
        target = CENTER + rng.uniform(-4, 4, 3)
        look = mi.ScalarTransform4f().look_at(target + away, target, rng.normal(size=3))
        to_world = np.array(look.matrix)
        x, y, z = ((points - target) @ to_world[:3, :3]).T
        half_width = rng.uniform(0.88, 0.97) * make_pot2.SIZE / 2
        distance = (make_pot2.FOCAL * np.maximum(abs(x), abs(y)) / half_width - z).max()
        to_world[:3, 3] = target + distance * away
        result.append(np.array([[float(f"{value:.9g}") for value in row] for row in to_world]))  # as in the XML
    return result


def make_capture(folder, spp):
    """Photograph the bowl into `folder`: scene.xml, images/, masks/ and truth/."""
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    mesh = bowl()
    color, rough = glaze(mesh.vertices)
    mesh.apply_transform(trimesh.transformations.euler_matrix(0.2, 0.5, -0.12))
    mesh.vertices = (mesh.vertices + CENTER - mesh.bounds.mean(0)).astype(np.float32)
    make_pot2.write_ply(mesh, folder / "truth" / "mesh.ply")
    shape = mi.load_dict({
        "type": "ply",
        "filename": str(folder / "truth" / "mesh.ply"),
        "bsdf": {
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
            "specular": 0.6,
        },
    })  # fmt: skip
    shape.add_attribute("vertex_color", 3, color.astype(np.float32).ravel())
    shape.add_attribute("vertex_roughness", 1, rough.astype(np.float32).ravel())
    seen, novel = cameras(mesh.vertices, VIEWS, seed=1), cameras(mesh.vertices, NOVEL_VIEWS, seed=2)
    views = [make_pot2.render(shape, to_world, spp, seed=k) for k, to_world in enumerate(seen + novel)]
    brightness = np.concatenate([image.max(2)[alpha >= 0.5] for image, alpha in views[:VIEWS]])
    intensity = float(f"{1 / np.quantile(brightness, 1 - SATURATED):.3g}")  # one exposure for all photographs
    for k, (image, alpha) in enumerate(views):
        name, place = (k, folder) if k < VIEWS else (k - VIEWS, folder / "truth")
        make_pot2.write_png(place / "images" / f"{name:03d}.png", make_pot2.srgb(intensity * image))
        if k < VIEWS:
            mask = np.where(alpha >= 0.5, 255, 0).astype(np.uint8)
            make_pot2.write_png(folder / "masks" / f"{name:03d}.png", mask)
    make_pot2.write_scene(folder / "truth" / "scene.xml", "", False, novel, intensity)
    make_pot2.write_scene(folder / "scene.xml", "", True, seen, intensity)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/interreflection"))
    parser.add_argument("--spp", type=int, default=512, help="paths per pixel of the photographs")
    arguments, options = parser.parse_known_args()
    scene = arguments.out / "bowl" / "scene.xml"
    if not scene.is_file():
        make_capture(scene.parent, arguments.spp)
    print(f"{processor()}; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n")
    print(table(["fit", *(c.replace("_", " ") for c in COLUMNS), "fit s"], []), flush=True)
    for option in ("--no-indirect", "--indirect"):
        row = measure(scene, arguments.out / option.strip("-"), [option, *options], scene.parent / "truth")
        numbers = cells([*(row[c] for c in COLUMNS), row["fit_seconds"]])
        print(f"| `{option}` | {' | '.join(numbers)} |", flush=True)


if __name__ == "__main__":
    main()
