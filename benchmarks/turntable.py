"""A glossy object turns in rooms with windows. Are light, shape and colours found?

    python benchmarks/turntable.py MESH … [--rooms 3] [--views 36] [--size 200] [--out out/turntable]
                                   [OPTIONS OF mi-ring fit]

`mi-ring synthesize` path traces each mesh, of two glossy plastics in stripes, on a turntable in each room. The scene
file does not mention the light. The fit uses `--light auto`.

Prints a Markdown table with machine and date: the light that was chosen; errors of the normals, mean and median [deg];
correlation of the found diffuse reflectance with the true one over the surface; PSNR of the photographs [dB]; seconds.
"""

import argparse
import datetime
import sys
from pathlib import Path

import mi_ring

# isort: split
import numpy as np
import torch
from accuracy import measure, processor, product_speed, table
from environments import run
from gloss import LEVEL
from light_kinds import without_lights
from scipy.spatial import cKDTree

from mi_ring.geometry.meshes import read_mesh
from mi_ring.objects.ring_file import load_fit
from mi_ring.rendering.spherical_harmonics import frames_of

COLOURS = (0.6, 0.35, 0.1), (0.25, 0.12, 0.05)  #: of the stripes
ROUGHNESS, STRIPES = 0.2, 6
ROOM = ("--light", "none", "--room", 1, "--room-kind", "windows", "--wrong-room")


def true_albedo(points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Mean albedo (n,) of the stripes at `points` (n, 3) of the object with `vertices` (V, 3)."""
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    stripe = (STRIPES * (points[:, 1] - low) / (high - low)).astype(int).clip(0, STRIPES - 1) % 2
    return np.mean(COLOURS, 1)[stripe]


def correlation(fit: Path, truth: Path) -> float:
    """Correlation of the diffuse reflectance of a fit with the true one, at points of the surface."""
    ring = load_fit(fit)
    vertices = read_mesh(truth, "mesh").vertices
    with torch.no_grad():
        points, material = ring(ring.domain.sample(LEVEL)[0])
    found = material["diffuse"].mean(1).numpy()
    nearest = vertices[cKDTree(vertices).query(points.numpy())[1]]
    return float(np.corrcoef(found, true_albedo(nearest, vertices))[0, 1])


def kind_of(scene: Path) -> str:
    """The kind of light in the scene file that a fit has written."""
    capture = mi_ring.load_capture(scene, images=False)
    if not capture.photographs.dark:
        return "lights"
    return " and ".join(sorted(frames_of(capture.scene))).replace("camera", "turntable").replace("world", "environment")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--rooms", type=int, default=3)
    parser.add_argument("--views", type=int, default=36)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("out/turntable"))
    args, options = parser.parse_known_args()
    options = options or ["--preset", "fast"]
    first, second = (f"principled base_color={','.join(map(str, c))} roughness={ROUGHNESS}" for c in COLOURS)
    rows = []
    for mesh in args.meshes:
        name = mesh.resolve().parents[1].name if mesh.name == "mesh.ply" else mesh.stem
        for room in range(args.rooms):
            out = args.out / f"{name}-{room}"
            run("mi_ring.synthesize", mesh, out, "--material", first, "--second", second, "--bands", STRIPES,
                "--views", args.views, "--size", args.size, args.size, "--novel", 0, "--spp", 64, "--seed", room,
                "--smooth", "--cameras", "turntable", "--elevations", 25, *ROOM)  # fmt: skip
            fit = out / "fit"
            found = measure(without_lights(out / "scene.xml"), fit, [*options, "--light", "auto"], out / "truth")
            rows.append([name, str(room), kind_of(fit / "scene.xml"),
                         f"{found['normal_mean']:.2f} / {found['normal_median']:.2f}",
                         f"{correlation(fit, out / 'truth/mesh.ply'):.2f}",
                         f"{found['psnr_input']:.1f}", f"{found['fit s']:.0f}"])  # fmt: skip
            print(*rows[-1], sep=", ", file=sys.stderr, flush=True)
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}, {speed:.0f} GFLOP/s; {datetime.date.today()}; {args.views} photographs of {args.size}²; "
          f"mi-ring fit {' '.join(options)} --light auto\n")  # fmt: skip
    print(table(["mesh", "room", "light", "normals °", "albedo, correlation", "PSNR", "s"], rows))


if __name__ == "__main__":
    main()
