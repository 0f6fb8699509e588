"""Print, as Markdown, what an iteration of each stage takes on this processor, and as if it had less of one.

    python benchmarks/processors.py [SCENE.xml]

The stages are those of the default preset, the last of which needs a scene of photographs 512 pixels wide; the first
line is the floor, 642 vertices and photographs 128 pixels wide. As far as PyTorch goes a server then behaves like a
laptop; Dr.Jit's kernels stay as they are. Each line is a process of its own, the kinds in turn; speed is that of a
float32 product of 4096³ in the same process.
"""

import argparse
import datetime
import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from accuracy import alone, processor, product_speed, table
from cost import iterations

from mi_ring.fitting.config import Config

STAGES = (3, 128), (4, 128), (5, 256), (6, 512)  #: level and width
AVX2 = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
KINDS: dict[str, dict[str, str]] = {
    "as it is": {}, "without AMX": {"ONEDNN_MAX_CPU_ISA": "AVX512_CORE"}, "AVX2 alone": AVX2,
}  # fmt: skip


def one(scene: Path, settings: dict, variables: dict[str, str]) -> dict:
    """The numbers of `cost.iterations`, and the speed of this process [FLOP/s]."""
    os.environ.update(variables)  # before PyTorch is imported
    measured = iterations(scene, "default", settings)
    import torch

    return measured | {"speed": product_speed(4096, 4096, torch.float32)}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", nargs="?", type=Path, default=Path("scenes/pot2.xml"))
    scene = parser.parse_args().scene
    widest = max(int(width.get("value")) for width in ElementTree.parse(scene).findall("sensor/film/*[@name='width']"))
    rows, names = [], []
    for level, width in STAGES:
        settings = {"level": level, "width": width, "batch": Config.batch, "steps": Config.steps, "spp": Config.spp}
        for kind, variables in KINDS.items():
            measured = alone(one, scene, settings, variables)
            parts, total = measured["parts"], measured["total"]
            names = list(parts)
            shares = [f"{1000 * s:.0f} ({s / total:.0%})" for s in (*parts.values(), total - sum(parts.values()))]
            speed = f"{measured['speed'] / 1e9:.0f}"
            rows.append(
                [f"{level} ({10 * 4**level + 2:,}), {min(width, widest)}", kind, *shares, f"{1000 * total:.0f}", speed]
            )
    print(f"{processor()}; {datetime.date.today()}; {scene}\n")
    heads = ["level (vertices), width", "processor", *(f"{part}, ms" for part in names), "rest, ms", "iteration, ms"]
    print(table([*heads, "GFLOP/s"], rows))


if __name__ == "__main__":
    main()
