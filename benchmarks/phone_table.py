"""What each disturbance of a simulated phone capture costs, and all of them at once, by `phone.py`.

    python benchmarks/phone_table.py OUT [--objects pot2 bunny spot] [--views 24] [--size 1440x1080] [--preset default]

A row for the exact capture, one for each disturbance alone, with exact calibration and masks, and one for all of them
at three strengths of the room's light, for which `mi_ring.photos` finds calibration and masks; all of them cropped to
the object. In each: mean error of the normals and of the depth where both surfaces are seen, after a similarity, how
often that of the exact capture the former is, and how much larger the object is than it should be. By `fast` errors of
masks are hidden by those of the preset. It goes on where it stopped.
"""

import argparse
import datetime
import json
import subprocess
import sys
from pathlib import Path

from accuracy import processor, product_speed, table
from phone import DISTURBANCES, crop

HERE = Path(__file__).parent
USUAL, AMBIENT = 0.03, (0.03, 0.0, 0.1)  #: light of the room, by the flash's
ALONE = [d for d in DISTURBANCES if d != "failures"]  # what fails does not belong to a calibrated capture


def run(*arguments: object, log: Path) -> str:
    """Standard output of a Python command; what else it says goes into a log.

    Raises RuntimeError with the last line of the log if it fails.
    """
    with log.open("a") as file:
        done = subprocess.run([sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, stderr=file, text=True)
    if done.returncode:
        raise RuntimeError(log.read_text().rstrip().splitlines()[-1])
    return done.stdout


def evaluated(scene: Path, preset: str, log: Path) -> dict[str, float]:
    """Errors of the fit of a scene whose truth is in truth/ of the capture's folder."""
    folder = log.parent
    run("-m", "mi_ring.fit", scene, "--preset", preset, "--out", scene.parent / "fit", log=log)
    mesh = folder / "truth/mesh.ply"
    numbers = json.loads(run("-m", "mi_ring.evaluate", scene.parent / "fit", "--mesh", mesh, "--spp", 1,
                             "--align", "similarity", log=log))  # fmt: skip
    return {name: numbers[name] for name in ("normal_mean", "depth_mean", "aligned_scale")}


def measure(folder: Path, made: list[object], found: bool, preset: str) -> dict[str, dict]:
    """Make a capture and fit it, by calibration that is `found` (and the exact one of the same views) or known."""
    result, log = folder / "result.json", folder / "log.txt"
    if result.exists():
        return json.loads(result.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    exact = found and made[made.index("--ambient") + 1] == USUAL  # it is the same whatever the room
    run(HERE / "phone.py", folder, *made, *["--no-exact"] * (not exact), log=log)
    numbers = {}
    if found:
        if exact:
            numbers["exact"] = evaluated(folder / "exact/scene.xml", preset, log)
        try:
            if not (folder / "found/scene.xml").exists():
                run("-m", "mi_ring.photos", folder / "photos", folder / "found", log=log)
            numbers["this"] = evaluated(folder / "found/scene.xml", preset, log)
        except RuntimeError as error:
            numbers["this"] = {"failed": str(error)}
    else:
        known = folder / "known/scene.xml"
        if not (folder / "known/cropped/done").exists():
            run("-m", "mi_ring.convert", "transforms", folder / "truth/transforms.json", known, log=log)
            crop(known)
            (folder / "known/cropped/done").touch()
        numbers["this"] = evaluated(known, preset, log)
    result.write_text(json.dumps(numbers))
    return numbers


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
    parser.add_argument("--objects", nargs="+", default=["pot2", "bunny", "spot"])
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--size", default="1440x1080")
    parser.add_argument("--preset", default="default")
    options = parser.parse_args()
    rows = {f"all, room {ambient:.0%}": ("all", ambient, True) for ambient in AMBIENT}
    rows |= {f"{name} alone": (name, USUAL, False) for name in ALONE}
    results = {}
    for row, (disturbances, ambient, found) in rows.items():
        for name in options.objects:
            made = ["--object", name, "--disturbances", disturbances, "--ambient", ambient, "--views", options.views,
                    "--size", options.size]  # fmt: skip
            folder = options.out / name / row.replace(", ", "_").replace(" ", "_").rstrip("%")
            results[row, name] = measure(folder, made, found, options.preset)
            print(f"{name}, {row}: {results[row, name]}", file=sys.stderr, flush=True)
    exact = {name: results["all, room 3%", name]["exact"] for name in options.objects}
    lines = [["exact", *(cell(exact[name], exact[name]) for name in options.objects)]]
    for row in rows:
        lines.append([row, *(cell(results[row, name]["this"], exact[name]) for name in options.objects)])
    import torch

    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}; {speed:.0f} GFLOP/s; {datetime.date.today()}; {options.views} photographs of {options.size} "
          f"px, --preset {options.preset}\n")  # fmt: skip
    print(table(["normals / depth (times exact), size", *options.objects], lines))


if __name__ == "__main__":
    main()
