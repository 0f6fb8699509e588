"""What very many photographs, or a very fine mesh, cost in time and memory (Linux).

    python benchmarks/large.py CAPTURE.xml [--count 2000] [--size 3464] [--out out/large]
    python benchmarks/large.py RUN [--level 9] [--out out/large]

The first opens, checks and fits a capture: its photographs are scaled to --size, written as JPEG, and used again and
again under other names. The second exports surface and material of a finished fit as PLY.

Prints processor time and peak memory of each step, with machine and date.
"""

import argparse
import contextlib
import copy
import datetime
import io
import os
import re
import resource
import time
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from accuracy import processor

import mi_ring
from mi_ring import check, export
from mi_ring.fitting.config import Config
from mi_ring.images import linear_to_srgb, read_image, to_bytes

STEPS = 2  #: iterations


def enlarged(source: Path, target: Path, size: int) -> None:
    """A photograph or mask, `size` pixels wide, its colours as sRGB."""
    pixels = read_image(source)
    if pixels.dtype != np.uint8:
        pixels = to_bytes(linear_to_srgb(pixels / (65535 if pixels.dtype == np.uint16 else 1)))
    height = round(size * pixels.shape[0] / pixels.shape[1])
    target.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(target), cv2.resize(pixels, (size, height))[..., ::-1] if pixels.shape[2] > 1 else
                cv2.resize(pixels, (size, height)))  # fmt: skip


def write(path: Path, count: int, size: int, out: Path) -> Path:
    """A scene of so many photographs."""
    tree = ElementTree.parse(path)
    root = tree.getroot()
    sensors = root.findall("sensor")
    for sensor in sensors:
        root.remove(sensor)
    for k in range(count):
        sensor = copy.deepcopy(sensors[k % len(sensors)])
        sensor.set("id", f"{k:05}")
        for name, suffix in (("filename", ".jpg"), ("mask", ".png")):
            element = sensor.find(f"string[@name='{name}']")
            first = out / name / (Path(element.get("value")).stem + suffix)
            if not first.exists():
                enlarged(path.parent / element.get("value"), first, size)
            link = first.with_name(f"{k:05}{suffix}")
            if not link.exists():
                os.link(first, link)
            element.set("value", f"{name}/{link.name}")
        width, height = (sensor.find(f"film/integer[@name='{side}']") for side in ("width", "height"))
        scale = size / int(width.get("value"))
        height.set("value", str(round(scale * int(height.get("value")))))
        width.set("value", str(size))
        for number in sensor.findall("float"):
            if number.get("name") in ("fx", "fy", "cx", "cy"):
                number.set("value", repr(scale * float(number.get("value"))))
        root.append(sensor)
    tree.write(out / "scene.xml")
    return out / "scene.xml"


class Costs:
    """Rows of a table: what took how long since the one before, and the most memory until then."""

    def __init__(self) -> None:
        print("| | wall, s | processor, s | GiB at most |\n|---|---|---|---|", flush=True)
        self.before = time.perf_counter(), time.process_time()

    def row(self, what: str) -> None:
        """Print one."""
        now, memory = (time.perf_counter(), time.process_time()), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        wall, busy = (after - before for after, before in zip(now, self.before))
        print(f"| {what} | {wall:.1f} | {busy:.1f} | {memory / 2**20:.1f} |", flush=True)
        self.before = now


def measure_fit(scene: Path, costs: Costs) -> None:
    """Open, check and fit it."""
    capture = mi_ring.load_capture(scene)
    costs.row("opened")
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        status = check.main([str(scene), "--out", str(scene.with_name("check.png"))])
    costs.row(f"`mi-ring check`, {len(said.getvalue().splitlines())} lines, status {status}")
    fit = mi_ring.Fit(capture, Config.preset("fast", refine=("none",)))
    costs.row("hull, brightness")
    for _ in range(STEPS):
        fit.step()
    costs.row(f"{STEPS} iterations")


def measure_export(run: Path, level: int, out: Path, costs: Costs) -> None:
    """Write a fine mesh."""
    path = out / f"level{level}.ply"
    export.main([str(run), str(path), "--subdivisions", str(level)])
    with path.open("rb") as file:
        vertices, faces = (int(n) for n in re.findall(rb"element \w+ (\d+)", file.read(4096)))
    costs.row(f"{vertices:,} vertices, {faces:,} triangles, {path.stat().st_size / 2**20:,.0f} MiB")
    path.unlink()


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, metavar="CAPTURE.xml|RUN")
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--size", type=int, default=3464)
    parser.add_argument("--level", type=int, default=9)
    parser.add_argument("--out", type=Path, default=Path("out/large"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.source.is_dir():
        print(f"{processor()}; {datetime.date.today()}; level {options.level}\n")
        measure_export(options.source, options.level, options.out, Costs())
        return
    scene = write(options.source, options.count, options.size, options.out)
    print(f"{processor()}; {datetime.date.today()}; {options.count} photographs, {options.size} pixels wide\n")
    measure_fit(scene, Costs())


if __name__ == "__main__":
    main()
