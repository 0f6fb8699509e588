"""Print, as Markdown with machine and date, the two limits of a fit's speed and how near it comes to them.

    python benchmarks/limits.py [SCENE.xml] [--level 5] [--steps 3]

The flow: arithmetic of one forward and backward pass of Shape-Net (three products per weight, step and vertex) over its
time, against the speed of plain products: of large square matrices, and of the hidden layers' own shape. The renderer:
what a picture of eight photographs takes with gradients, without them, and if rays were only traced.
"""

import argparse
import datetime
from pathlib import Path

from accuracy import median_seconds, processor, product_speed, table, there_and_back

from mi_ring import fit
from mi_ring.capture import loading
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.geometry.domain import Sphere
from mi_ring.nets.mlp import SLOPE
from mi_ring.nets.shape_net import ShapeNet
from mi_ring.rendering import prediction
from mi_ring.rendering.photographs import pixel_rays
from mi_ring.system import machine

# isort: split
import drjit as dr
import torch
from torch.nn import functional as F


def flow_speed(s, steps: int, precision: str) -> tuple[float, float]:
    """FLOP/s, and seconds, of forward and backward."""
    net = ShapeNet(steps)
    weights = sum(layer.weight.numel() for layer in [*net.hidden, net.output])
    t = median_seconds(there_and_back(net, s, machine.autocast(precision, s.device)))[0]
    return 3 * 2 * weights * steps * len(s) / t, t


def flow(level: int, steps: int) -> str:
    """The table of the flow."""
    s, _ = Sphere().sample(level)
    rows = []
    for dtype in (torch.float32, torch.bfloat16):
        precision = str(dtype).removeprefix("torch.")
        square, own = product_speed(4096, 4096, dtype), product_speed(len(s), 256, dtype)
        reached, t = flow_speed(s, steps, precision)
        speeds = [f"{speed / 1e9:.0f}" for speed in (square, own, reached)]
        shares = [f"{reached / square:.0%}", f"{reached / own:.0%}"]
        rows.append([precision, *speeds, f"{t * 1000:.0f}", *shares])
    heads = ["precision", "large products, GFLOP/s", "a hidden layer's product, GFLOP/s", "flow, GFLOP/s", "flow, ms",
             "of large products", "of a hidden layer's"]  # fmt: skip
    return f"{len(s):,} vertices, {steps} steps:\n\n" + table(heads, rows)


def layer(level: int) -> str:
    """The table of one hidden layer in bfloat16: what surrounds its three products."""
    count = len(Sphere().sample(level)[0])
    x, back, out = (torch.randn(count, 256).bfloat16() for _ in range(3))
    w, b = torch.randn(256, 256).bfloat16(), torch.randn(256).bfloat16()
    parts = {
        "plain product, into memory that is there": lambda: torch.mm(x, w, out=out),
        "product and bias": lambda: F.linear(x, w, b),
        "leaky ReLU": lambda: F.leaky_relu_(out, SLOPE),
        "back through the leaky ReLU": lambda: torch.ops.aten.leaky_relu_backward(back, x, SLOPE, True),
        "back through the product": lambda: back @ w,
        "gradient of the weights": lambda: back.T @ x,
        "gradient of the bias": lambda: back.sum(0),
    }
    times = dict(zip(parts, median_seconds(*parts.values())))
    plain, *others = times.values()
    lines = [[name, f"{1000 * t:.2f}"] for name, t in times.items()]
    lines.append(["all but the first row", f"{1000 * sum(others):.2f}"])
    lines.append(["share of that which three plain products take", f"{3 * plain / sum(others):.0%}"])
    return f"One hidden layer of {count:,} vertices in bfloat16:\n\n" + table(["part", "ms"], lines)


def rendering(running: Fit, level: int) -> str:
    """The table of the renderer, of the start surface."""
    surface, size = running.surface, running.capture.shots[0].size
    photographs = running.capture.photographs.select(running.capture.sizes[size][:8], size)
    s, faces = running.ring.domain.sample(level)
    surface.show(running.ring, s, faces)
    with torch.no_grad():
        vertices, material = running.ring(s)
    vertices.requires_grad_()
    material = {name: value.requires_grad_() for name, value in material.items()}

    def trace():
        ray, _ = pixel_rays(photographs, 1, 0)
        dr.eval(surface.scene.ray_intersect_preliminary(ray, coherent=True))
        dr.sync_thread()

    def gradients():
        rgb, coverage = prediction.render(surface, photographs, vertices, material, spp=1)
        (rgb.sum() + coverage.sum()).backward()

    def write():
        surface.write(vertices, material)
        dr.sync_thread()

    pixels = len(photographs) * size[0] * size[1]
    parts = {
        "write the vertices, rebuild the tree of triangles": write,
        "trace one ray per pixel, no more": trace,
        "a picture: rays, rays to the light, shading": lambda: prediction.draw(surface, photographs, spp=1),
        "a picture with all gradients: all of the above, edges, and back": gradients,
    }
    times = zip(parts, median_seconds(*parts.values()))
    rows = [[name, f"{1000 * t:.0f}", f"{pixels / t / 1e6:.1f}"] for name, t in times]
    what = f"{len(photographs)} photographs of {size[0]} × {size[1]} of {running.capture.path.name}"
    return f"{what}, {len(s):,} vertices:\n\n" + table(["part", "ms", "million pixels per second"], rows)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", nargs="?", type=Path, default=Path("scenes/pot2.xml"))
    parser.add_argument("--level", type=int, default=5)
    parser.add_argument("--steps", type=int, default=Config.steps)
    arguments = parser.parse_args()
    scene, config = loading.load_capture(arguments.scene), fit.parse_options([str(arguments.scene)])
    machine.set_threads()
    machine.keep_memory()
    print(f"{processor()}; {datetime.date.today()}; {torch.get_num_threads()} threads\n")
    print(flow(arguments.level, arguments.steps), end="\n\n")
    print(layer(arguments.level), end="\n\n")
    print(rendering(Fit(scene, config), arguments.level))


if __name__ == "__main__":
    main()
