"""Make a standing figure with its arms held out, as a mesh with thin limbs and no symmetry.

    python benchmarks/figure.py out/figure.ply
    mi-ring synthesize out/figure.ply out/figure --novel 4
    python benchmarks/accuracy.py out/figure --preset fast --seeds 0 1 2

Limbs are segments of varying radius, joined by a smooth minimum of their distances. Marching cubes make one closed
surface without handles [metres]. Prints nothing.
"""

import argparse
from pathlib import Path

import numpy as np
import skimage.measure
import trimesh

CELL = 0.006  #: of the grid
BLEND = 0.018  #: how far limbs melt into each other

#: Joints [m], y up, the figure looking along z.
JOINTS = {
    "crown": (0.02, 1.72, 0.03), "chin": (0.015, 1.56, 0.05), "neck": (0, 1.46, 0), "chest": (0, 1.28, 0.02),
    "waist": (-0.01, 1.06, 0.0), "hip": (0, 0.93, -0.01),
    "left shoulder": (0.19, 1.42, -0.01), "left elbow": (0.46, 1.47, -0.06), "left wrist": (0.69, 1.58, 0.03),
    "left hand": (0.79, 1.62, 0.07),
    "right shoulder": (-0.19, 1.41, 0.0), "right elbow": (-0.45, 1.33, 0.07), "right wrist": (-0.66, 1.24, 0.22),
    "right hand": (-0.74, 1.22, 0.31),
    "left thigh": (0.1, 0.9, 0), "left knee": (0.15, 0.49, 0.05), "left ankle": (0.18, 0.09, -0.02),
    "left toe": (0.21, 0.035, 0.15),
    "right thigh": (-0.1, 0.9, 0), "right knee": (-0.13, 0.5, 0.0), "right ankle": (-0.15, 0.09, -0.07),
    "right toe": (-0.21, 0.035, 0.09),
}  # fmt: skip
#: Segments between two joints, and the radius at each.
LIMBS = [
    ("crown", "chin", 0.085, 0.06), ("chin", "neck", 0.05, 0.055), ("neck", "chest", 0.07, 0.13),
    ("chest", "waist", 0.135, 0.105), ("waist", "hip", 0.105, 0.13),
    *[(f"{side} {a}", f"{side} {b}", r, s) for side in ("left", "right") for a, b, r, s in [
        ("shoulder", "elbow", 0.055, 0.04), ("elbow", "wrist", 0.04, 0.027), ("wrist", "hand", 0.03, 0.035),
        ("thigh", "knee", 0.085, 0.052), ("knee", "ankle", 0.052, 0.034), ("ankle", "toe", 0.036, 0.03),
    ]],
    ("left shoulder", "chest", 0.06, 0.11), ("right shoulder", "chest", 0.06, 0.11),
]  # fmt: skip


def distance(points: np.ndarray, limb: tuple[str, str, float, float]) -> np.ndarray:
    """(N,) about how far `points` (N, 3) are from a limb's surface [m], negative within."""
    a, b = np.array(JOINTS[limb[0]]), np.array(JOINTS[limb[1]])
    along = ((points - a) @ (b - a) / ((b - a) @ (b - a))).clip(0, 1)
    return np.linalg.norm(points - a - along[:, None] * (b - a), axis=1) - (limb[2] + along * (limb[3] - limb[2]))


def figure() -> trimesh.Trimesh:
    """The closed surface."""
    joints = np.array(list(JOINTS.values()))
    low, high = joints.min(0) - 0.15, joints.max(0) + 0.15
    axes = [np.arange(*ends, CELL) for ends in zip(low, high)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    near = sum(np.exp(-distance(points, limb) / BLEND) for limb in LIMBS)
    field = (-BLEND * np.log(near)).reshape([len(axis) for axis in axes])
    vertices, faces, _, _ = skimage.measure.marching_cubes(field, 0.0)
    return trimesh.Trimesh(low + CELL * vertices, faces)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="mesh to write: .ply, .obj")
    out = parser.parse_args().out
    mesh = figure()
    if not (mesh.is_watertight and mesh.euler_number == 2 and mesh.volume > 0):
        raise SystemExit("the figure is not one closed piece")
    out.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(out)
    print(f"{out}: {len(mesh.faces)} triangles, {mesh.extents.round(2).tolist()} m")


if __name__ == "__main__":
    main()
