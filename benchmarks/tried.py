"""Print, as Markdown with machine and date, ways to compute the same thing faster: as it is, and as it was tried.

    python benchmarks/tried.py [--level 5] [--steps 3]

Of settings that change the result, see choices.py.
"""

import argparse
import datetime
import functools
import time

from accuracy import alone, median_seconds, peak_memory, processor, table, there_and_back

from mi_ring.fitting.config import Config
from mi_ring.fitting.muon import orthogonalised
from mi_ring.geometry.domain import Sphere
from mi_ring.images import blur
from mi_ring.nets import chunks, mlp, shape_net
from mi_ring.nets.brdf_net import BRDFNet
from mi_ring.nets.encoding import PosEnc
from mi_ring.system import machine

# isort: split
import torch
from torch.nn import functional as F

SLOPE = mlp.SLOPE
AUTOCAST = machine.autocast("auto", torch.device("cpu"))  # as in a fit
with AUTOCAST():
    DTYPE = torch.mm(torch.ones(1, 1), torch.ones(1, 1)).dtype


def by_autograd(net):
    """A network by torch's own layers."""

    def evaluate(x):
        h = net.encoding(x)
        for layer in net.hidden:
            h = F.leaky_relu(layer(h), SLOPE)
        return net.output(h)

    return evaluate


def euler_by_autograd(net):
    """The flow by torch's own layers."""
    direction = by_autograd(net)

    def flow(x):
        for _ in range(net.steps):
            x = x + shape_net.SPEED / net.steps * torch.tanh(direction(x).to(x.dtype))
        return x

    return flow


def flow_memory(by_hand: bool, level: int, steps: int) -> float:
    """GiB that forward and backward pass of the flow take."""
    machine.set_threads()
    net, (s, _) = shape_net.ShapeNet(steps), Sphere().sample(level)
    there_and_back(net, s[:100], AUTOCAST)()  # what is needed for the first time only
    before = peak_memory()
    there_and_back(net if by_hand else euler_by_autograd(net), s, AUTOCAST)()
    return peak_memory() - before


def chunked(net, s, points):
    """The flow in chunks of another size."""

    def run():
        before, chunks.CHUNK = chunks.CHUNK, points
        there_and_back(net, s, AUTOCAST)()
        chunks.CHUNK = before

    return run


def with_returned_memory(level: int, steps: int) -> float:
    """Seconds of the flow if freed memory goes back to the system, as is glibc's way."""
    machine.set_threads()
    torch.manual_seed(0)
    return median_seconds(there_and_back(shape_net.ShapeNet(steps), Sphere().sample(level)[0], AUTOCAST))[0]


def doubled(x):
    """PosEnc of (V, 3) points by doubling: cos and sin of (n + k) x from those of n x and of k x."""
    cosine, sine = x.cos()[:, None], x.sin()[:, None]
    for _ in range(4):
        c, s = cosine[:, -1:], sine[:, -1:]
        more = cosine * c - sine * s, sine * c + cosine * s
        cosine, sine = torch.cat([cosine, more[0]], 1), torch.cat([sine, more[1]], 1)
    return torch.cat([cosine.flatten(1), sine.flatten(1)], 1)


def convolved(images, sigma):
    """images.blur by two convolutions."""
    radius = int(3 * sigma + 0.5)
    kernel = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2)
    kernel = kernel / kernel.sum()
    images = F.conv2d(images[:, None], kernel[None, None, :, None], padding=(radius, 0))
    return F.conv2d(images, kernel[None, None, None, :], padding=(0, radius))[:, 0]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--level", type=int, default=5)
    parser.add_argument("--steps", type=int, default=Config.steps)
    arguments = parser.parse_args()
    returned = alone(with_returned_memory, arguments.level, arguments.steps)
    memory = [alone(flow_memory, by_hand, arguments.level, arguments.steps) for by_hand in (True, False)]
    machine.set_threads()
    machine.keep_memory()
    torch.manual_seed(0)
    s = Sphere().sample(arguments.level)[0]
    net = shape_net.ShapeNet(arguments.steps)
    rows = []

    def compare(idea, as_it_is, tried, note=""):
        rows.append([idea, *(f"{1000 * t:.3g}" for t in median_seconds(as_it_is, tried)), note])

    compare("flow: gradient by autograd instead of by hand", there_and_back(net, s, AUTOCAST),
            there_and_back(euler_by_autograd(net), s, AUTOCAST))  # fmt: skip
    brdf_net = BRDFNet()
    compare("BRDF-Net: gradient by autograd instead of by hand", there_and_back(brdf_net.evaluate, s, AUTOCAST),
            there_and_back(by_autograd(brdf_net), s, AUTOCAST))  # fmt: skip
    compare("flow: chunks of 2,048 points instead of 8,192 at most", there_and_back(net, s, AUTOCAST),
            chunked(net, s, 2048))  # fmt: skip
    matrices = [torch.randn(256, 256) for _ in range(8)]
    own = torch.no_grad()(functools.partial(orthogonalised, dtype=DTYPE))
    compare("Muon: eight matrices one after the other, each by all threads", lambda: chunks.in_parallel(own, matrices),
            lambda: [own(matrix) for matrix in matrices])  # fmt: skip
    kept = median_seconds(there_and_back(net, s, AUTOCAST))[0]
    rows.append(["flow: freed memory returned to the system", f"{1000 * kept:.3g}", f"{1000 * returned:.3g}",
                 "one after the other, not in turn"])  # fmt: skip

    encode = PosEnc()

    def step(x, *parameters):
        h = encode(x).to(DTYPE)
        for w, b in zip(parameters[:3], parameters[3:]):
            h = F.leaky_relu(F.linear(h, w, b), SLOPE)
        return h

    parameters = [w for kind in ("weight", "bias") for w in (getattr(h, kind).detach().to(DTYPE) for h in net.hidden)]
    compiled = torch.compile(step, dynamic=False)
    with torch.no_grad():
        before = time.perf_counter()
        compiled(s, *parameters)
        note = f"compiled in {time.perf_counter() - before:.0f} s; needs a C++ compiler"
        compare("hidden layers of a step, forward: torch.compile", lambda: step(s, *parameters),
                lambda: compiled(s, *parameters), note)  # fmt: skip
        h, w, b = torch.randn(len(s), 256).to(DTYPE), parameters[1], parameters[4]
        compare("a layer, forward: product, bias and leaky ReLU fused by oneDNN",
                lambda: F.leaky_relu_(F.linear(h, w, b), SLOPE),
                lambda: torch.ops.mkldnn._linear_pointwise(h, w, b, "leaky_relu", [SLOPE], ""),
                "not for users of torch")  # fmt: skip
        compare("encoding by doubling instead of cosines and sines", lambda: encode(s), lambda: doubled(s))
        images = torch.randn(8, 128, 128)
        compare("blur of the masks, 8 of 128², σ = 8 px, by convolutions", lambda: blur(images, 8.0),
                lambda: convolved(images, 8.0))  # fmt: skip
    print(f"{processor()}; {datetime.date.today()}; {len(s):,} vertices, {arguments.steps} steps, {DTYPE}, "
          f"{torch.get_num_threads()} threads\n")  # fmt: skip
    print(table(["tried", "as it is, ms", "tried, ms", ""], rows))
    print("\nMemory of the flow, gradient by hand: {:.2f} GiB, by autograd: {:.2f} GiB".format(*memory))


if __name__ == "__main__":
    main()
