"""Print, as Markdown with machine and date, what an iteration of a fit costs, and how that grows.

    python benchmarks/cost.py [SCENE.xml]

One setting at a time is varied about those of the first line: level of the sphere (four times the vertices each), width
of the photographs, photographs per iteration, steps of the flow, samples per pixel, photographs of the scene (its own,
again and again); the last lines are the last stage of the default preset, and the stages of `--preset paper`, all its
settings with them.
Each line is a process of its own; seconds of an iteration are the median of some. Photographs are as large as the scene
has them, at most: that of the default has 256 pixels.
"""

import argparse
import copy
import datetime
import statistics
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from accuracy import alone, peak_memory, processor, table, watch

from mi_ring.fitting.config import Config

VARIED = {
    "level": (3, 4, 6), "width": (64, 128, 512), "batch": (2, 4, 16), "steps": (5, 10, 20), "spp": (4,),
    "photographs": (500, 2000),
}  # fmt: skip
WARM_UP, ITERATIONS = 3, 7


def repeated(scene: Path, photographs: int, folder: Path) -> Path:
    """A scene file with so many photographs: those of `scene`, again and again."""
    tree = ElementTree.parse(scene)
    root, sensors = tree.getroot(), tree.findall("sensor")
    for sensor in sensors:
        root.remove(sensor)
        for element in sensor.iter("string"):
            if (file := scene.parent / element.get("value")).is_file():
                element.set("value", str(file.resolve()))
    for k in range(photographs):
        sensor = copy.deepcopy(sensors[k % len(sensors)])
        sensor.set("id", f"{k:05}")
        root.append(sensor)
    tree.write(folder / scene.name)
    return folder / scene.name


def iterations(scene: Path, preset: str, settings: dict) -> dict:
    """Median seconds of an iteration and of its parts, seconds until the first, peak memory [GiB]."""
    seconds = watch()
    from mi_ring import fit
    from mi_ring.capture.loading import load_capture
    from mi_ring.fitting.fit import Fit
    from mi_ring.system import machine

    width = settings["width"]
    words = {"preset": preset, "domain": "sphere", "levels": settings["level"], "widths": width, "shares": 1,
             "batch": settings["batch"], "steps": settings["steps"], "spp": settings["spp"]}  # fmt: skip
    config = fit.parse_options([str(scene), *(word for name, v in words.items() for word in (f"--{name}", str(v)))])
    machine.keep_memory()
    started = time.perf_counter()
    photographs = load_capture(scene)
    machine.set_threads()
    running = Fit(photographs, config)
    loading, times, parts = time.perf_counter() - started, [], []
    for k, shot in enumerate(running.capture.shots):  # as later in a fit, where what is decoded is remembered
        if width < shot.size[0]:
            running.capture.observe([k], -(-shot.size[0] // width))
    for _ in range(WARM_UP + ITERATIONS):
        started, already = time.perf_counter(), dict(seconds)
        running.step()
        times.append(time.perf_counter() - started)
        parts.append({name: seconds[name] - already[name] for name in seconds})
    median = {name: statistics.median(p[name] for p in parts[WARM_UP:]) for name in seconds}
    return {"parts": median, "total": statistics.median(times[WARM_UP:]), "loading": loading, "peak": peak_memory()}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", nargs="?", type=Path, default=Path("scenes/pot2.xml"))
    scene = parser.parse_args().scene
    own = len(ElementTree.parse(scene).findall("sensor"))
    base = {"level": 5, "width": 256, "batch": Config.batch, "steps": Config.steps, "spp": Config.spp,
            "photographs": own}  # fmt: skip
    lines = [("default", base | {name: value}) for name, values in VARIED.items() for value in values]
    lines += [("default", base | {"level": 6, "width": 512, "photographs": value}) for value in (own, 2000)]
    lines += [("paper", base | {"level": level, "width": 512, "steps": 20, "spp": 4}) for level in (5, 6)]
    rows = []
    for preset, settings in [("default", base), *lines]:
        named = [f"**{v}**" if v != base[name] else str(v) for name, v in settings.items()]
        named[0] += f" ({10 * 4 ** settings['level'] + 2:,})" + (", `paper`" if preset == "paper" else "")
        with tempfile.TemporaryDirectory() as folder:
            measured = alone(iterations, repeated(scene, settings["photographs"], Path(folder)), preset, settings)
        parts, total = measured["parts"], measured["total"]
        spent = [f"{1000 * s:.0f}" for s in (*parts.values(), total - sum(parts.values()), total)]
        rows.append([*named, *spent, f"{measured['loading']:.1f}", f"{measured['peak']:.2f}"])
    print(f"{processor()}; {datetime.date.today()}; {scene}\n")
    heads = ["level (vertices)", "width px", "photographs at once", "T", "spp", "photographs in all"]
    heads += [*(f"{part}, ms" for part in parts), "rest, ms", "iteration, ms", "loading, s", "GiB at most"]
    print(table(heads, rows))


if __name__ == "__main__":
    main()
