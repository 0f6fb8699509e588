"""What large photographs, or a very fine mesh, cost in time and memory (Linux).

    python benchmarks/large.py CAPTURE.xml [--count 66] [--size 4000] [--share 0.65] [--light] [--out out/large]
    python benchmarks/large.py CAPTURE.xml --preset default [--count 66] [--size 4000] [--share 0.65] [--out out/large]
    python benchmarks/large.py RUN [--level 9] [--out out/large]

The first writes photographs of --size × --size pixels: those of the capture are scaled so that their width is --share
of the frame, and used again and again. Then each command runs in a process of its own: `fit --preset fast` to its first
iteration with an empty cache, and again; `mi-ring check` with this cache and with an empty one; all of `fit --preset
fast`, and with --light of `fit --preset fast --light auto`. The second is all of a fit with another preset,
with details and without. The third exports a finished fit as PLY.

Prints wall time, processor time and peak memory of each process, with machine and date.
"""

import argparse
import copy
import datetime
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np

from mi_ring.images import linear_to_srgb, read_image, to_bytes
from mi_ring.system.machine import computer

FIRST_ITERATION = """
import sys
import mi_ring
from mi_ring.capture.loading import load_capture
from mi_ring.capture.reduction import WIDTH
from mi_ring.fitting.config import Config
from mi_ring.system.machine import keep_memory
keep_memory()
fit = mi_ring.Fit(load_capture(sys.argv[1], masks="auto", width=WIDTH), Config.preset("fast"))
fit.step()
"""


def framed(source: Path, size: int, share: float) -> np.ndarray:
    """A photograph or mask (size, size, C) of 8 bits, in sRGB: the file, `share` of the width, in the middle."""
    pixels = read_image(source)
    if pixels.dtype != np.uint8:
        pixels = to_bytes(linear_to_srgb(pixels / (65535 if pixels.dtype == np.uint16 else 1)))
    width = round(share * size)
    height = round(width * pixels.shape[0] / pixels.shape[1])
    result = np.zeros((size, size, pixels.shape[2]), np.uint8)
    left, top = (size - width) // 2, (size - height) // 2
    scaled = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_CUBIC)
    result[top : top + height, left : left + width] = scaled.reshape(height, width, -1)
    return result


def write(path: Path, count: int, size: int, share: float, out: Path) -> Path:
    """The scene of so many photographs. Returns its path."""
    tree = ElementTree.parse(path)
    root, files = tree.getroot(), {}
    sensors = root.findall("sensor")
    for sensor in sensors:
        root.remove(sensor)
    for k in range(count):
        sensor = copy.deepcopy(sensors[k % len(sensors)])
        sensor.set("id", f"{k:05}")
        for name, suffix in (("filename", ".jpg"), ("mask", ".png")):
            element = sensor.find(f"string[@name='{name}']")
            if element is None:  # it has no mask
                continue
            source, file = path.parent / element.get("value"), out / name / f"{k:05}{suffix}"
            file.parent.mkdir(parents=True, exist_ok=True)
            if (source, suffix) not in files:
                pixels = framed(source, size, share)[..., ::-1]
                files[source, suffix] = cv2.imencode(suffix, pixels)[1].tobytes()
            # Bytes after the end of a picture are ignored. They make each file another one for the cache.
            file.write_bytes(files[source, suffix] + k.to_bytes(4, "little"))
            element.set("value", f"{name}/{file.name}")
        for name in ("valid", "ambient"):
            for element in sensor.findall(f"string[@name='{name}']"):
                sensor.remove(element)
        numbers = {e.get("name"): e for e in sensor.findall("float")}
        sides = {side: sensor.find(f"film/integer[@name='{side}']") for side in ("width", "height")}
        given = {side: int(element.get("value")) for side, element in sides.items()}
        scale = round(share * size) / given["width"]
        for centre, side in (("cx", "width"), ("cy", "height")):
            if centre not in numbers:
                numbers[centre] = ElementTree.SubElement(sensor, "float", name=centre, value=str(given[side] / 2))
            corner = (size - round(scale * given[side])) // 2
            numbers[centre].set("value", repr(scale * float(numbers[centre].get("value")) + corner))
            sides[side].set("value", str(size))
        for focal in ("fx", "fy"):
            numbers[focal].set("value", repr(scale * float(numbers[focal].get("value"))))
        root.append(sensor)
    tree.write(out / "scene.xml")
    return out / "scene.xml"


def row(what: str, *command: str | Path, cache: Path) -> None:
    """Run a command and print what it costs."""
    started = time.perf_counter()
    process = subprocess.Popen([sys.executable, *map(str, command)], stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL, env=os.environ | {"MI_RING_CACHE": str(cache)})  # fmt: skip
    _, status, used = os.wait4(process.pid, 0)
    wall, failed = time.perf_counter() - started, f" (status {status})" if status else ""
    busy, memory = used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20
    print(f"| {what}{failed} | {wall:.0f} | {busy:.0f} | {memory:.1f} |", flush=True)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, metavar="CAPTURE.xml|RUN")
    parser.add_argument("--count", type=int, default=66)
    parser.add_argument("--size", type=int, default=4000)
    parser.add_argument("--share", type=float, default=0.65)
    parser.add_argument("--light", action="store_true", help="with the preset `fast`")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--level", type=int, default=9)
    parser.add_argument("--out", type=Path, default=Path("out/large"))
    options = parser.parse_args()
    out, cache = options.out, options.out / "cache"
    shutil.rmtree(cache, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
    what = f"level {options.level}"
    if not options.source.is_dir():
        scene = write(options.source, options.count, options.size, options.share, out)
        what = f"{options.count} photographs of {options.size}²"
    print(f"{computer()}; {datetime.date.today()}; {what}\n\n| | wall, s | processor, s | GiB |\n|---|---|---|---|")
    if options.source.is_dir():
        mesh = out / "mesh.ply"
        row("export", "-m", "mi_ring.export", options.source, mesh, "--subdivisions", str(options.level), cache=cache)
        mesh.unlink()
        return
    run = "-m", "mi_ring.fit", scene, "--preset", options.preset, "--out", out / "run"
    if options.preset != "fast":
        row(f"`fit --preset {options.preset}`", *run, cache=cache)
        row("the same with `--detail none`, photographs in the cache", *run, "--detail", "none", cache=cache)
        return
    row("`fit --preset fast`, first iteration", "-c", FIRST_ITERATION, scene, cache=cache)
    row("the same again", "-c", FIRST_ITERATION, scene, cache=cache)
    row("`check`, photographs in the cache", "-m", "mi_ring.check", scene, "--out", out / "check.png", cache=cache)
    shutil.rmtree(cache, ignore_errors=True)
    row("`check`", "-m", "mi_ring.check", scene, "--out", out / "check.png", cache=cache)
    row("`fit --preset fast`, all of it", *run, cache=cache)
    if options.light:
        row("`fit --preset fast --light auto`, all of it", *run, "--light", "auto", cache=cache)


if __name__ == "__main__":
    main()
