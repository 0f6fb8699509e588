"""Fit captures with one setting changed at a time and print, as Markdown with machine and date, what that does.

    python benchmarks/choices.py CAPTURE [MORE …] [--out out/choices] [OPTIONS OF mi_ring.fit]

All fits have the same number of iterations, so that a setting which makes them cheaper shows in the seconds. Give
`--preset fast` for an answer in an hour: the settings are chosen for it. The truth is found as in accuracy.py.
"""

import argparse
import datetime
import sys
from pathlib import Path

from accuracy import alone, processor, scene_file, table, truth_of, watched_fit

from mi_ring.system.command import scene_name

CHOICES = [
    "", "--seed 1", "--seed 2", "--domain sphere", "--velocity-decay 0.03", "--weights.mask 2", "--weights.mask 10",
    "--loss l2", "--loss l1", "--loss log", "--batch 4", "--batch 16", "--steps 5", "--steps 8",
    "--steps 20", "--optimizer adam", "--decay 0.3", "--decay 0.03", "--precision bfloat16",
]  # fmt: skip


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="+", type=scene_file)
    parser.add_argument("--out", type=Path, default=Path("out/choices"))
    arguments, options = parser.parse_known_args()
    truths = [truth_of(scene) for scene in arguments.scenes]
    rows = []
    for choice in CHOICES:
        row = [f"`{choice}`" if choice else "as it is"]
        for scene, truth in zip(arguments.scenes, truths):
            out = arguments.out / scene_name(scene) / (choice.strip("-").replace(" ", "_") or "as_it_is")
            fitted = alone(watched_fit, [str(scene), "--out", str(out), *options, *choice.split()], truth, 1)
            _, errors = fitted["curve"][-1]
            row += [f"{errors['normal_mean']:.2f}°", f"{errors['depth_mean']:.2f}", f"{fitted['fit_seconds']:.0f}"]
        rows.append(row)
        print("; ".join(row), file=sys.stderr)
    columns = ("normals, mean", "depth, mean %", "fit s")
    heads = ["changed", *(f"{scene_name(scene)}: {column}" for scene in arguments.scenes for column in columns)]
    print(f"\n{processor()}; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n\n{table(heads, rows)}")


if __name__ == "__main__":
    main()
