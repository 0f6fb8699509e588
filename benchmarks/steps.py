"""Print, as Markdown with machine and date, what the flow costs by number of Euler steps.

    python benchmarks/steps.py [--level 5]

One forward and backward pass of Shape-Net in float32 on one thread, each in a process of its own: seconds of the
processor, and by how much the peak of memory rises.
"""

import argparse
import datetime
import time

from accuracy import alone, peak_memory, processor, table

CASES = 1, 3, 10, 20, 40


def cost(level: int, steps: int) -> tuple[int, float, float]:
    """Vertices, seconds and GiB."""
    from mi_ring.geometry.domain import Sphere
    from mi_ring.nets.shape_net import ShapeNet

    # isort: split
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(0)
    s, _ = Sphere().sample(level)
    net = ShapeNet(steps)
    net(s[:100]).sum().backward()  # what is needed for the first time only
    before, started = peak_memory(), time.process_time()
    net(s).sum().backward()
    return len(s), time.process_time() - started, peak_memory() - before


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--level", type=int, default=5)
    level, rows = parser.parse_args().level, []
    for steps in CASES:
        vertices, seconds, memory = alone(cost, level, steps)
        rows.append([str(steps), f"{seconds:.1f}", f"{memory:.2f}"])
    print(f"{processor()}; {datetime.date.today()}; {vertices:,} vertices\n")
    print(table(["T", "s", "GiB"], rows))


if __name__ == "__main__":
    main()
