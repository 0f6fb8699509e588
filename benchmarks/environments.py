"""How accurate is a fit under an unknown environment?

    python benchmarks/environments.py MESH … [--views 50] [--width 512] [--spp 64] [--maps overcast indoor sun]
        [--out out/environments] [-- OPTIONS OF FIT]

`mi-ring synthesize` path traces each mesh, of plastic, in three environments that this script makes: an overcast sky
(CIE: radiance 1 at the horizon, 3 at the zenith), a room with a window and two lamps, and a clear sky with the sun. The
scene file does not mention them. `--light environment` finds shape, material and light. The object is then lit by the
next of the three environments. --flash adds a flash capture of the same views.

Prints a Markdown table: errors of normals and depth; the angle between the brightest directions of the true and of the
found map, both blurred by about 10 degrees; the angle between the radiance-weighted mean directions; PSNR of the relit
object, after one factor per colour.
"""

import argparse
import datetime
import json
import subprocess
import sys
from pathlib import Path

import mi_ring

# isort: split
import numpy as np
import torch
from accuracy import processor, product_speed, table

from mi_ring.geometry.sphere_map import even_directions
from mi_ring.images import read_image, write_image
from mi_ring.rendering.spherical_harmonics import envmap_directions, room_envmap

ROWS = 128  #: of a map
BLUR, CANDIDATES = 60.0, 10_000  #: sharpness of a blurred light, and directions that are compared
PLASTIC = "principled base_color=0.6,0.45,0.3 roughness=0.4"
#: Photographs under another light, and paths per pixel. They are half as wide as others, so that so many are not too
#: slow: with fewer the noise of the sun's light would be larger than the error.
RELIT, SMOOTH = 4, 512


def directions(rows: int = ROWS) -> np.ndarray:
    """(rows, 2 rows, 3) of a map by latitude and longitude as Mitsuba's `envmap` has it, y up."""
    return envmap_directions(rows)[0].reshape(rows, 2 * rows, 3)


def window(away: np.ndarray, azimuth: float, elevation: float, size: tuple[float, float], rgb: tuple) -> np.ndarray:
    """A bright rectangle of a room [degrees]."""
    east = np.degrees(np.arctan2(away[..., 0], -away[..., 2]))
    high = np.degrees(np.arcsin(away[..., 1]))
    inside = (np.abs((east - azimuth + 180) % 360 - 180) < size[0]) & (np.abs(high - elevation) < size[1])
    return inside[..., None] * np.array(rgb)


def maps() -> dict[str, np.ndarray]:
    """The environments, (H, W, 3) radiance."""
    away = directions()
    up = away[..., 1:2]
    ground = up < 0
    overcast = np.where(ground, [0.1, 0.11, 0.09], (1 + 2 * up) / 3 * [0.95, 1.0, 1.08])
    indoor = (0.7 + 0.3 * up) * [0.12, 0.11, 0.1] + window(away, 50, 15, (22, 18), (4, 4.4, 5.2))
    indoor += window(away, -110, 40, (10, 8), (5, 4, 2.6)) + window(away, 170, -5, (14, 10), (0.6, 0.5, 0.4))
    sky = np.where(ground, [0.15, 0.13, 0.1], 0.35 * (1.3 - 0.6 * up) * [0.55, 0.75, 1.15])
    toward = np.array([0.5, 0.75, 0.45]) / np.linalg.norm([0.5, 0.75, 0.45])
    sun = np.degrees(np.arccos((away @ toward).clip(-1, 1)))[..., None] < 3.5
    return {"overcast": overcast, "indoor": indoor, "sun": sky + sun * np.array([55.0, 50, 42])}


def whole(radiance: np.ndarray) -> np.ndarray:
    """(3,) the direction from which the light of a map comes on the whole."""
    away, weight = envmap_directions(len(radiance))
    total = weight * radiance.mean(-1).ravel() @ away
    return total / np.linalg.norm(total)


def brightest(radiance: np.ndarray) -> np.ndarray:
    """(3,) the direction in which a map, blurred by about 10 degrees, is brightest."""
    away, weight = envmap_directions(len(radiance))
    grey, candidates = weight * radiance.mean(-1).ravel(), even_directions(CANDIDATES)
    blurred = [np.exp(BLUR * (some @ away.T - 1)) @ grey for some in np.array_split(candidates, 50)]
    return candidates[np.concatenate(blurred).argmax()]


def run(*arguments: object) -> str:
    """What a command of ours prints."""
    command = [sys.executable, "-m", *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def relit_psnr(fit: Path, truth: Path) -> float:
    """Of pictures of a fit under the light of a scene, after one factor for each colour."""
    run("mi_ring.render", fit, truth / "scene.xml", fit / "relit", "--spp", SMOOTH, "--integrator", "path")
    ours, theirs = [], []
    for path in sorted((truth / "images").glob("*.exr")):
        inside = read_image(truth / "masks" / f"{path.stem}.png").squeeze() > 127
        ours.append(read_image(fit / "relit" / path.name)[inside])
        theirs.append(read_image(path)[inside])
    mine, right = np.concatenate(ours).astype(float), np.concatenate(theirs).astype(float)
    mine *= (mine * right).sum(0) / (mine**2).sum(0)
    white = np.quantile(right, 0.99)
    return float(-10 * np.log10(np.mean((mine.clip(0, white) - right.clip(0, white)) ** 2) / white**2))


def main() -> None:
    """The command."""
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--views", type=int, default=50)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--maps", nargs="+", choices=list(maps()), default=list(maps()))
    parser.add_argument("--flash", action="store_true", help="fit a flash capture of each mesh, too")
    parser.add_argument("--out", type=Path, default=Path("out/environments"))
    args, options = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]
    args.out.mkdir(parents=True, exist_ok=True)
    own = maps()
    for name, radiance in own.items():
        write_image(radiance.astype(np.float32), args.out / f"{name}.exr")
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}, {speed:.0f} GFLOP/s; {datetime.date.today()}; {args.views} photographs of {args.width}²; "
          f"mi_ring.fit --light environment {' '.join(options)}\n", flush=True)  # fmt: skip
    rows = []
    for mesh in args.meshes:
        name = mesh.resolve().parents[1].name if mesh.name == "mesh.ply" else mesh.stem
        usual = ["--material", PLASTIC, "--novel", 0]
        for light in [*args.maps, *(["flash"] if args.flash else [])]:
            capture, fit = args.out / f"{name}-{light}", args.out / f"{name}-{light}-fit"
            lit = [] if light == "flash" else ["--environment", args.out / f"{light}.exr", "--wrong-room"]
            run("mi_ring.synthesize", mesh, capture, "--views", args.views, "--spp", args.spp,
                "--size", args.width, args.width, *usual, *lit)  # fmt: skip
            kind = [] if light == "flash" else ["--light", "environment"]
            run("mi_ring.fit", capture / "scene.xml", "--out", fit, *kind, *options)
            truth = capture / "truth/mesh.ply"
            numbers = json.loads(run("mi_ring.evaluate", fit, "--mesh", truth))
            seconds = json.loads((fit / "log.jsonl").read_text().splitlines()[-1])["seconds"]
            row = [name, light, f"{numbers['normal_mean']:.2f}", f"{numbers['normal_median']:.2f}",
                   f"{numbers['depth_mean']:.2f}"]  # fmt: skip
            if light == "flash":
                row += ["–", "–", "–"]
            else:
                other = list(own)[(list(own).index(light) + 1) % len(own)]
                relit = args.out / f"{name}-in-{other}"
                run("mi_ring.synthesize", mesh, relit, "--views", RELIT, "--seed", 7, *usual, "--spp", SMOOTH,
                    "--size", args.width // 2, args.width // 2, "--environment", args.out / f"{other}.exr")  # fmt: skip
                calibrated = mi_ring.load_capture(fit / "scene.xml", images=False)
                found = room_envmap(calibrated.room, np.eye(4), ROWS, calibrated.lobes)
                off = [np.degrees(np.arccos(np.clip(toward(own[light]) @ toward(found), -1, 1)))
                       for toward in (brightest, whole)]  # fmt: skip
                row += [*(f"{angle:.1f}" for angle in off), f"{relit_psnr(fit, relit):.1f}"]
            rows.append([*row, f"{seconds:.0f}"])
            print(*rows[-1], sep=", ", file=sys.stderr, flush=True)
    heads = [
        "mesh",
        "light",
        "normals, mean °",
        "median °",
        "depth, mean %",
        "brightest light off by °",
        "all light off by °",
        "relit dB",
        "fit s",
    ]
    print(table(heads, rows))


if __name__ == "__main__":
    main()
