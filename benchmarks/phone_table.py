"""What the disturbances of a simulated phone capture cost, all together or one at a time (`phone.py`).

    python benchmarks/phone_table.py OUT [--rows all|alone] [--objects pot2 bunny spot] [--views 24] [--size 1440x1080]
        [--paths 36] [OPTIONS OF mi-ring fit]

--rows all: every disturbance, with room light of two strengths, calibration and masks by `mi-ring photos`, and the
exact capture of the same views. --rows alone: no disturbance, all that exact calibration undoes, and each of the
others, with exact calibration and masks. All captures are cropped to the object. The preset `fast` hides errors of
masks.

Prints a Markdown table with machine and date. Each cell has the mean error of normals and depth where both surfaces are
seen, after a similarity; the ratio of the first to that of the exact capture; and the error of the scale. The same
command continues after an interruption.
"""

import argparse
import datetime
import json
import shutil
import subprocess
import sys
from pathlib import Path

from accuracy import processor, product_speed, table
from phone import crop

HERE = Path(__file__).parent
USUAL, AMBIENT = 0.03, (0.03, 0.1)  #: light of the room, by the flash's
#: Rows with one disturbance each, but for what exact calibration undoes, which is together.
ALONE = {
    "none": "none", "calibration": "offset,lens,principal,exposure", "sheet": "sheet", "room 3%": "ambient",
    "cone": "cone", "JPEG": "jpeg", "noise": "noise", "blur": "blur",
}  # fmt: skip


def run(*arguments: object, log: Path) -> str:
    """Standard output of a Python command; what else it says goes into a log.

    Raises RuntimeError with the last line of the log if it fails.
    """
    with log.open("a") as file:
        done = subprocess.run([sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, stderr=file, text=True)
    if done.returncode:
        raise RuntimeError(log.read_text().rstrip().splitlines()[-1])
    return done.stdout


def evaluated(scene: Path, options: list[str], log: Path) -> dict[str, float]:
    """Errors of the fit of a scene whose truth is in truth/ of the capture's folder."""
    folder = log.parent
    run("-m", "mi_ring.fit", scene, "--out", scene.parent / "fit", *options, log=log)
    mesh = folder / "truth/mesh.ply"
    numbers = json.loads(run("-m", "mi_ring.evaluate", scene.parent / "fit", "--mesh", mesh, "--spp", 1,
                             "--align", "similarity", log=log))  # fmt: skip
    return {name: numbers[name] for name in ("normal_mean", "depth_mean", "aligned_scale")}


def found(folder: Path, made: list[object], fit: list[str], exact: bool) -> dict[str, dict]:
    """Make a capture and fit it by what `mi_ring.photos` finds, and perhaps the exact one of the same views."""
    log, numbers = folder / "log.txt", {}
    run(HERE / "phone.py", folder, *made, *["--no-exact"] * (not exact), log=log)
    if exact:
        numbers["exact"] = evaluated(folder / "exact/scene.xml", fit, log)
    try:
        run("-m", "mi_ring.photos", folder / "photos", folder / "found", log=log)
        numbers["this"] = evaluated(folder / "found/scene.xml", fit, log)
    except RuntimeError as error:
        numbers["this"] = {"failed": str(error)}
    return numbers


def known(folder: Path, made: list[object], fit: list[str]) -> dict[str, dict]:
    """Make a capture and fit it by exact calibration and masks."""
    log, scene = folder / "log.txt", folder / "known/scene.xml"
    run(HERE / "phone.py", folder, *made, "--no-exact", log=log)
    run("-m", "mi_ring.convert", "transforms", folder / "truth/transforms.json", scene, log=log)
    crop(scene)
    return {"this": evaluated(scene, fit, log)}


def cell(numbers: dict, exact: dict) -> str:
    """Normals, depth, the normals' ratio to the exact capture's, and the object's size by the true one."""
    if "failed" in numbers:
        return numbers["failed"]
    ratio, larger = numbers["normal_mean"] / exact["normal_mean"], 100 * (numbers["aligned_scale"] - 1)
    return f"{numbers['normal_mean']:.2f}° / {numbers['depth_mean']:.2f} % ({ratio:.2f}), {larger:+.2f} %"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--rows", choices=("all", "alone"), default="all")
    parser.add_argument("--objects", nargs="+", default=["pot2", "bunny", "spot"])
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--size", default="1440x1080")
    parser.add_argument("--paths", default="36", help="per pixel of the captures, a square number")
    options, fit = parser.parse_known_args()
    if options.rows == "all":
        rows = {f"all, room {ambient:.0%}": ("all", ambient) for ambient in AMBIENT}
    else:
        rows = {name: (disturbances, USUAL) for name, disturbances in ALONE.items()}
    results = {}
    for row, (disturbances, ambient) in rows.items():
        for name in options.objects:
            made = ["--object", name, "--disturbances", disturbances, "--ambient", ambient, "--views", options.views,
                    "--size", options.size, "--spp", options.paths]  # fmt: skip
            folder = options.out / name / row.replace(", ", "_").replace(" ", "_").rstrip("%")
            kept, words = folder / "result.json", " ".join(map(str, [*made, *fit]))
            numbers = json.loads(kept.read_text()) if kept.exists() else {}
            if numbers.get("made") != words:
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                if options.rows == "all":
                    numbers = found(folder, made, fit, ambient == USUAL)  # the exact one is alike whatever the room
                else:
                    numbers = known(folder, made, fit)
                if "failed" not in numbers["this"]:
                    kept.write_text(json.dumps(numbers | {"made": words}))
            results[row, name] = numbers
            print(f"{name}, {row}: {numbers}", file=sys.stderr, flush=True)
    reference = "exact" if options.rows == "all" else "this"  # of the first row
    exact = {name: results[next(iter(rows)), name][reference] for name in options.objects}
    lines = [["exact", *(cell(exact[name], exact[name]) for name in options.objects)]] if options.rows == "all" else []
    for row in rows:
        lines.append([row, *(cell(results[row, name]["this"], exact[name]) for name in options.objects)])
    import torch

    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}; {speed:.0f} GFLOP/s; {datetime.date.today()}; {options.views} photographs of {options.size} "
          f"px, {options.paths} paths per pixel; mi_ring.fit {' '.join(fit)}\n")  # fmt: skip
    print(table(["normals / depth (times exact), size", *options.objects], lines))


if __name__ == "__main__":
    main()
