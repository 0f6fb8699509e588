"""Compare a fit with the truth: `python -m mi_ring.evaluate RUN --mesh TRUTH.ply`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mitsuba as mi
import numpy as np
import trimesh
from tyro.conf import Positional, arg

from mi_ring import bridge, capture, command
from mi_ring.capture import linear_to_srgb, to_bytes
from mi_ring.domain import read_mesh
from mi_ring.errors import InputError
from mi_ring.integrator import Photographs, center_rays
from mi_ring.ring import Ring


@dataclass(frozen=True)
class EvaluateConfig:
    """Compare a finished fit with the truth and print the paper's numbers as one line of JSON."""

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit."""
    mesh: Path
    """True surface in the units and frame of the scene: PLY, OBJ or GLB."""
    novel: Path | None = None
    """Scene of photographs that the fit has not seen."""
    spp: int = 16
    """Samples per pixel of the predicted photographs."""


def load_mesh(path: Path) -> tuple[trimesh.Trimesh, mi.Scene]:
    """A mesh file and the scene that holds it alone, with smooth normals. Raises InputError if it cannot be read."""
    mesh = read_mesh(path, "mesh")
    return mesh, scene_of(mesh.vertices, mesh.faces)


def scene_of(vertices, faces) -> mi.Scene:
    """A scene that holds this mesh alone, with smooth normals."""
    shape = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=True)
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    params.update()
    return mi.load_dict({"type": "scene", "mesh": shape})


def hits(scene: mi.Scene, photographs: Photographs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where pixel centres see the surface (P,), at what distance (P,) [scene units], with what normal (P, 3)."""
    si = scene.ray_intersect(center_rays(photographs)[0])
    return np.array(si.is_valid()), np.array(si.t), np.array(si.sh_frame.n).T


def compare_surfaces(scene: capture.Capture, guess: mi.Scene, truth: mi.Scene, diagonal: float) -> dict[str, float]:
    """Angles between shading normals [deg], depths [% of `diagonal`] and silhouettes, at every pixel of every view.

    Normals and depths count where both surfaces are seen; `iou` is the mean over views.
    """
    angles, depths, ious = [], [], []
    for k in range(len(scene)):
        photograph = scene.photograph(k)
        (seen, t, n), (true_seen, true_t, true_n) = hits(guess, photograph), hits(truth, photograph)
        both = seen & true_seen
        ious.append(both.sum() / max(1, (seen | true_seen).sum()))
        angles.append(np.degrees(np.arccos(np.clip((n[both] * true_n[both]).sum(1), -1, 1))))
        depths.append(np.abs(t[both] - true_t[both]) / diagonal * 100)
    angle, depth = np.concatenate(angles), np.concatenate(depths)
    if not len(angle):
        raise InputError(f"{scene.path}: no pixel sees both the fit and the true mesh; are they in the same frame?")
    return {
        "normal_mean": float(angle.mean()), "normal_median": float(np.median(angle)),
        "depth_mean": float(depth.mean()), "depth_median": float(np.median(depth)), "iou": float(np.mean(ious)),
    }  # fmt: skip


def psnr(scene: capture.Capture, ring: Ring, subdivisions: int, spp: int) -> float:
    """Of all pixels of all photographs [dB]: predictions as 8-bit sRGB against the files, sRGB in [0, 1]."""
    surface = bridge.Surface(scene.scene, scene.shape, ring)
    surface.show(ring, *ring.domain.sample(subdivisions))
    errors = []
    for k in range(len(scene)):
        rgb, _ = bridge.draw(surface, scene.photograph(k), spp=spp, shadows=scene.shadows, indirect=ring.indirect)
        predicted = to_bytes(linear_to_srgb(rgb[0].numpy())) / 255
        errors.append(np.mean((predicted - linear_to_srgb(scene.observe([k])[0][0].numpy())) ** 2))
    return float(-10 * np.log10(np.mean(errors)))


def evaluate(run: Path, mesh: Path, novel: Path | None = None, spp: int = 16) -> dict[str, float]:
    """The paper's columns for the results folder `run`."""
    ring = Ring.load(run)
    subdivisions = json.loads((run / "config.json").read_text())["subdivisions"]
    scene = capture.load(run / "scene.xml")
    unseen = novel and capture.load(novel)
    truth_mesh, truth = load_mesh(mesh)
    _, guess = load_mesh(run / "mesh.ply")
    numbers = compare_surfaces(scene, guess, truth, float(np.linalg.norm(truth_mesh.extents)))
    numbers["psnr_input"] = psnr(scene, ring, subdivisions, spp)
    if unseen:
        numbers["psnr_novel"] = psnr(unseen, ring, subdivisions, spp)
    return numbers


def main(arguments: Sequence[str]) -> None:
    """The command."""
    config = command.parse(EvaluateConfig, arguments, "mi_ring.evaluate")
    if config.spp < 1:
        raise InputError(f"--spp: is {config.spp}, must be at least 1")
    for name in ("scene.xml", "mesh.ply", "config.json"):
        if not (config.run / name).is_file():
            raise InputError(f"{config.run}: has no {name}; give the results folder of a finished fit")
    numbers = evaluate(config.run, config.mesh, config.novel, config.spp)
    print(json.dumps({key: round(value, 4) for key, value in numbers.items()}))


if __name__ == "__main__":
    command.run("mi_ring.evaluate", main)
