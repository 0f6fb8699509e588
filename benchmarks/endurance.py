"""Does the renderer keep memory, or compile kernels again, in a long fit?

    python benchmarks/endurance.py [--iterations 500]

Each iteration rotates the domain at random, writes 10,242 vertices and their material, renders eight photographs of
128² pixels under lamps beside the camera with shadows and interreflection, and takes all gradients.

Prints a Markdown table with machine and date: memory and number of compiled kernels after some iterations.
"""

import argparse
import datetime
import os
from pathlib import Path

from mi_ring.geometry.domain import Sphere
from mi_ring.rendering import prediction
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.surface import Surface

# isort: split
import drjit as dr
import mitsuba as mi
import torch
from accuracy import processor
from render import METHODS, Scene


def resident() -> float:
    """Memory that this process holds [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--iterations", type=int, default=500)
    options = parser.parse_args()
    print(f"{processor()}; {datetime.date.today()}\n")
    scene = Scene(METHODS["`photometric`"])
    surface = Surface(scene.scene, next(s for s in scene.scene.shapes() if s.is_mesh()))
    domain, random = Sphere(), torch.Generator().manual_seed(0)
    weights = torch.from_numpy(scene.weights).permute(0, 2, 3, 1)
    surface.set_faces(domain.sample(5)[1])
    compiled = 0
    print("| iteration | memory held, MiB | kernels compiled so far |\n|---|---|---|")
    for iteration in range(1, options.iterations + 1):
        s, _ = domain.sample(5, random)
        x, y, z = s.T
        radius = 1 + 0.1 * torch.sin(4 * x + 0.01 * iteration) * torch.cos(3 * y) + 0.08 * torch.cos(5 * z + x)
        material = {"diffuse": 0.3 + 0.1 * s, "specular": 0.05 + 0.01 * y, "roughness": 0.35 + 0.1 * z}
        tensors = [t.requires_grad_() for t in (s * radius[:, None], *material.values())]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            rgb, coverage = prediction.render(
                surface, scene.photographs, tensors[0], dict(zip(material, tensors[1:])), 1, iteration
            )
            rgb = rgb + GlobalIllumination.of(surface, scene.photographs, coverage, iteration).interreflection
            ((rgb * weights).sum() + coverage.sum()).backward()
            compiled += sum(not kernel["cache_hit"] for kernel in dr.kernel_history([dr.KernelType.JIT]))
        if iteration in (1, 10) or iteration % 50 == 0:
            print(f"| {iteration} | {resident():.0f} | {compiled} |", flush=True)


if __name__ == "__main__":
    mi.set_log_level(mi.LogLevel.Error)
    main()
