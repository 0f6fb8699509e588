"""Do the standard deviations of calibration cover the truth? Small captures with known truth are made and fitted.

    python benchmarks/coverage.py MESH … [--out out/coverage] [--count 20] [--materials MATERIAL …]
                                  [--curve EXPONENT CONTRAST TOE] [OPTIONS OF mi-ring fit]

Capture number k shows MESH and MATERIAL number k, in turn. The flash is beside the place that the scene file says, and
its power varies. About every other capture has a room, brighter from some sides, of which the scene file knows nothing.
With --curve, photographs have another tone curve than sRGB. Each is fitted by `fast`.

Prints a Markdown table with machine and date: of each unknown the largest error, the median of the stated standard
deviations, and how often the truth is within 1.645 of them, which is nine times of ten if they are right; then the
median correlations of pairs of unknowns. The fit must refine light, power and ambient. The same command continues
after an interruption.
"""

import argparse
import datetime
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from accuracy import processor, product_speed, table
from halves import fitted
from PIL import Image

import mi_ring
from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.rig import Rig
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.images import linear_to_srgb
from mi_ring.scene.tone_curve import STRAIGHT, ToneCurve

MATERIALS = ["principled base_color=0.6,0.3,0.1 roughness=0.4", "principled base_color=0.2,0.4,0.5 roughness=0.7"]
ROOM, LIGHT, POWER = 0.1, 3.0, 10.0  #: options of mi-ring synthesize
SHOWN = 0.3  #: least correlation that is printed
WITHIN = 1.645  #: standard deviations that hold nine of ten normally distributed errors


def synthesized(mesh: str, material: str, number: int, out: Path) -> Path:
    """A capture of a mesh. Returns its folder."""
    if not (out / "truth/exact.xml").exists():
        options = ["--views", 24, "--novel", 0, "--size", 160, 160, "--cameras", "free", "--wrong-light", LIGHT,
                   "--wrong-power", POWER, "--format", "png8", "--spp", 25, "--seed", number]  # fmt: skip
        if np.random.default_rng(number).random() < 0.5:
            options += ["--room", ROOM, "--room-kind", "harmonics", "--wrong-room"]
        command = ["-m", "mi_ring.synthesize", mesh, out, "--material", material, *options]
        subprocess.run([sys.executable, *map(str, command)], check=True, stdout=subprocess.DEVNULL)
    return out


def recorded(folder: Path, curve: ToneCurve) -> Path:
    """A capture recorded with another curve than sRGB, beside its folder. Returns the new folder."""
    out = folder.with_name("-".join(map(str, [folder.name, *curve])))
    if not out.exists():
        part = out.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        shutil.copytree(folder, part, ignore=shutil.ignore_patterns("fit*"))
        for file in (part / "images").iterdir():
            encoded = linear_to_srgb(curve.applied(srgb_to_linear(np.asarray(Image.open(file), float) / 255)))
            Image.fromarray((255 * encoded + 0.5).astype(np.uint8)).save(file)
        part.rename(out)
    return out


def errors(folder: Path, out: Path, curve: ToneCurve) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of each unknown of a fit: (errors, standard deviations), in units that do not depend on the object's size."""
    found = json.loads((out / "calibration.json").read_text())
    given, true = (mi_ring.load_capture(folder / name) for name in ("scene.xml", "truth/exact.xml"))
    center, _ = true.sphere()
    rig, exact = (Rig(capture, center, true.exposure()) for capture in (given, true))
    unknowns = found["unknowns"]
    place = exact.upright.numpy()
    light, std = (100 / rig.distance * np.array(unknowns["light"][name]) for name in ("after", "std"))
    error = light - 100 / rig.distance * place
    result = {"flash, % of the distance": [error[:2], std[:2]], "flash ahead": [error[2:], std[2:]]}
    strengths = [np.array([shot.own_light.rgb for shot in capture.shots]) for capture in (true, given)]
    power = np.log(strengths[0] / strengths[1])
    power -= power.mean(0)
    of_photographs = [found["photographs"][name] for name in given.names]
    now, std = (np.array([of(entry) for entry in of_photographs])
                for of in (lambda entry: entry["power"], lambda entry: entry["std"]["power"]))  # fmt: skip
    result["power, %"] = [100 * (np.log(now) - power), 100 * std / now]
    calibration = Calibration(true, (), exact)
    share = calibration.room_share(calibration.room_harmonics()).numpy()
    result["room, % of the flash"] = [100 * (np.array(unknowns["ambient"]["after"]) - share),
                                      100 * np.array(unknowns["ambient"]["std"])]  # fmt: skip
    for name, truth in {"falloff": 0, "contrast": curve.contrast, "curve": curve.gamma, "toe": curve.toe}.items():
        if name in unknowns:
            result[name] = [np.array([unknowns[name]["after"] - truth]), np.array([unknowns[name]["std"]])]
    return {name: (np.ravel(error), np.ravel(std)) for name, (error, std) in result.items()}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+")
    parser.add_argument("--out", type=Path, default=Path("out/coverage"))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--materials", nargs="+", default=MATERIALS)
    parser.add_argument("--curve", type=float, nargs=3, default=STRAIGHT)
    options, of_fit = parser.parse_known_args()
    curve = ToneCurve(*options.curve)
    correlations: dict[str, list[float]] = {}
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for k in range(options.count):
        mesh, material = (names[k % len(names)] for names in (options.meshes, options.materials))
        folder = synthesized(mesh, material, k, options.out / str(k))
        folder = folder if curve == STRAIGHT else recorded(folder, curve)
        out = folder / "-".join(["fit", *of_fit]).replace("/", "_")
        for pair in fitted(folder / "scene.xml", out, ["--preset", "fast", *of_fit])["correlations"]:
            correlations.setdefault(" and ".join(sorted(pair["options"])), []).append(pair["value"])
        for name, both in errors(folder, out, curve).items():
            found.setdefault(name, []).append(both)
            print(k, name, *both, file=sys.stderr, flush=True)
    rows = []
    for name, several in found.items():
        error, std = (np.concatenate(part) for part in zip(*several))
        rows.append([name, f"{np.abs(error).max():.2g}", f"{np.median(std):.2g}",
                     f"{np.mean(np.abs(error) <= WITHIN * std):.0%} of {len(error)}"])  # fmt: skip
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}; {speed:.0f} GFLOP/s; {datetime.date.today()}; {options.count} captures {' '.join(of_fit)}\n")
    print(table(["unknown", "largest error", "stated deviation", "truth within 1.645"], rows), "\n")
    medians = sorted(((float(np.median(values)), pair) for pair, values in correlations.items()), reverse=True)
    print(table(["pair", "correlation"], [[pair, f"{value:.2f}"] for value, pair in medians if value > SHOWN]))


if __name__ == "__main__":
    main()
