"""What an iteration costs if 1, 2 or 4 processes share it, and when this pays.

    python benchmarks/processes.py [SCENE.xml] [--levels 5] [--widths 256] [--counts 1 2 4]

Prints a Markdown table with machine and date: processor time on one thread, which is meaningful also if processes share
few cores, and a model. Iterations with 2 and 8 photographs give the time per photograph. An iteration of two processes
gives the time of the points, which are shared. The rest (optimisers, regulariser, preparations of the renderer) is
repeated in every process. The model for N machines is

    fixed + photographs of the slowest · seconds of each + points / N · seconds of each
          + sums · 2 (N - 1) latency + 2 (N - 1) / N · bytes / bandwidth

because sums go around a ring ("Optimization of Collective Communication Operations in MPICH", Thakur, Rabenseifner and
Gropp 2005). Its first line is checked by the first of 4 processes. Its second line is not measured.
"""

import argparse
import datetime
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from accuracy import processor, table

#: Latency [s] and bandwidth [bytes/s].
NETWORKS = {"10 Gbit/s": (50e-6, 1.25e9), "1 Gbit/s": (200e-6, 1.25e8)}
REPEATED = 2


def measured(scene: Path, level: int, width: int, batch: int, repeated: int = REPEATED) -> dict:
    """Median processor time of an iteration [s], and bytes and number of its sums, in the first of the processes."""
    from mi_ring.capture.loading import load_capture
    from mi_ring.fitting.config import Config
    from mi_ring.fitting.fit import Fit
    from mi_ring.fitting.processes import joined
    from mi_ring.system.machine import threads_of

    with joined() as processes, threads_of(1):
        fit = Fit(load_capture(scene), Config(levels=(level,), widths=(width,), shares=(1.0,), batch=batch))
        fit.course.iteration = fit.iterations // 2
        seconds, exchanged, exchanges = [], [], []
        for _ in range(1 + repeated):
            before, count = processes.exchanged, processes.exchanges
            started = time.process_time()
            fit.step()
            seconds.append(time.process_time() - started)
            exchanged.append(processes.exchanged - before)
            exchanges.append(processes.exchanges - count)
        if processes.rank:
            sys.exit()
        return {"seconds": statistics.median(seconds[1:]), "bytes": exchanged[-1], "exchanges": exchanges[-1]}


def run(count: int, *arguments: object) -> dict:
    """`measured` by so many processes."""
    with tempfile.NamedTemporaryFile("r", suffix=".json") as file:
        own = [__file__, *arguments, "--one", file.name]
        start = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", count] if count > 1 else []
        subprocess.run([sys.executable, *map(str, [*start, *own])], check=True, stdout=subprocess.DEVNULL)
        return json.loads(file.read())


class Model(NamedTuple):
    """What an iteration is made of [s]."""

    fixed: float
    photograph: float
    points: float  #: of all of them

    def seconds(self, count: int, batch: int, found: dict, latency: float, bandwidth: float) -> float:
        """Of an iteration on `count` machines."""
        ring = 2 * (count - 1)
        exchange = found["exchanges"] * ring * latency + ring / count * found["bytes"] / bandwidth
        return self.fixed + -(-batch // count) * self.photograph + self.points / count + exchange


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", nargs="?", type=Path, default=Path("scenes/pot2.xml"))
    parser.add_argument("--levels", type=int, nargs="+", default=[5])
    parser.add_argument("--widths", type=int, nargs="+", default=[256])
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--batch", type=int, default=8, help=argparse.SUPPRESS)
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        found = measured(options.scene, options.levels[0], options.widths[0], options.batch)
        options.one.write_text(json.dumps(found))
        return
    print(f"{processor()}; {datetime.date.today()}; {options.scene}\n")
    rows = []
    for level, width in zip(options.levels, options.widths):
        stage = [options.scene, "--widths", width, "--levels", level]
        measurements = {count: run(count, *stage, "--batch", 8) for count in sorted({1, 2, *options.counts})}
        eight, halves = (measurements[count]["seconds"] for count in (1, 2))
        photograph = (eight - run(1, *stage, "--batch", 2)["seconds"]) / 6
        points = 2 * (eight - halves) - 8 * photograph
        model = Model(eight - 8 * photograph - points, photograph, points)
        print(f"Level {level}, width {width}: {1000 * model.fixed:.0f} ms fixed, {1000 * points:.0f} for all points, "
              f"{1000 * photograph:.0f} for each photograph")  # fmt: skip
        for count in options.counts:
            found = measurements[count]
            expected = model.seconds(count, 8, {"exchanges": 0, "bytes": 0}, 0, 1)
            row = [f"{level}, {width}", count, f"{1000 * found['seconds']:.0f}", f"{1000 * expected:.0f}",
                   found["exchanges"], f"{found['bytes'] / 2**20:.2f}"]  # fmt: skip
            for batch in (8, 32):
                alone = model.seconds(1, batch, found, 0, 1)
                for network in NETWORKS.values():
                    seconds = model.seconds(count, batch, found, *network)
                    row.append(f"{1000 * seconds:.0f} ({alone / seconds:.2f})")
            rows.append([str(cell) for cell in row])
    models = [f"{batch} photographs, {name}, ms" for batch in (8, 32) for name in NETWORKS]
    heads = ["level, width", "processes", "measured, ms", "model, ms", "sums", "MiB", *models]
    print("\n" + table(heads, rows))


if __name__ == "__main__":
    main()
