"""What the priors are worth: small captures, fitted with and without each.

    python benchmarks/priors.py [--only NAME] [--weights 0 0.03] [--seeds 0 1] [--iterations 150] [--level 4]
                                [--width 96] [--batch 8] [--out out/priors]

Each prior has its capture: a faceted body for `normal_variation`, and a body whose gloss follows its colour for
`material_rank`. They are path traced with `cooktorrance` from few sides, with much noise, so that the photographs leave
something open.

Prints a Markdown table with machine and date. Errors are those of the whole surface: normals in degrees; colour, gloss
and roughness as shares of the true mean, at the nearest points.
"""

import argparse
import datetime
import sys
from pathlib import Path

import numpy as np
import trimesh
from accuracy import processor, table

from mi_ring.capture.loading import load_capture
from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.geometry.domain import gpytoolbox, transfer_points
from mi_ring.geometry.meshes import read_mesh
from mi_ring.images import linear_to_srgb, to_bytes, write_image
from mi_ring.scene.lights import Light
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.scene.shot import Files, Shot
from mi_ring.synthesis import example_pot
from mi_ring.synthesis.object_on_table import ObjectOnTable
from mi_ring.synthesis.tracing import LensCamera

# isort: split
import mitsuba as mi
import torch

EVERY = 3  #: of the example's cameras, so many are one here
NOISE = 0.05  #: standard deviation of the linear radiance, 1 is white
WEIGHTS = {"normal_variation": (0.0, 0.01, 0.03), "material_rank": (0.0, 0.005, 0.01)}


def body(name: str) -> tuple[trimesh.Trimesh, dict[str, np.ndarray]]:
    """The object of a prior [mm], and its material at the vertices, (V, 3) or (V,)."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    x, y, z = ball.vertices.T
    if name == "normal_variation":
        normals = trimesh.creation.icosahedron().vertices  # those of a dodecahedron's faces
        mesh = trimesh.Trimesh(ball.vertices / (ball.vertices @ normals.T).max(1)[:, None], ball.faces, process=False)
        share = np.zeros(len(x))
    else:
        mesh = trimesh.Trimesh(ball.vertices * (1.0, 0.8, 1.2), ball.faces, process=False)
        share = 0.5 + 0.25 * (np.sin(3 * x + 2 * y) + np.sin(4 * z - x))
    mesh.apply_scale(32)
    mesh.apply_translation(example_pot.CENTER)
    one, other = np.array([0.45, 0.12, 0.06]), np.array([0.1, 0.25, 0.4])
    colour = share[:, None] * one + (1 - share[:, None]) * other
    return mesh, {"diffuse": colour, "specular": 0.02 + 0.1 * share, "roughness": 0.45 - 0.2 * share}


def write_capture(name: str, folder: Path) -> None:
    """Photographs of the body, with noise, and the true mesh and material."""
    truth, material = body(name)
    mesh = mesh_of(truth.vertices, truth.faces, normals=name != "normal_variation")
    textures = {}
    for key, value in material.items():
        attribute = f"vertex_{key}"
        mesh.add_attribute(attribute, value[0].size, np.asarray(value, np.float32).ravel())
        textures[key] = {"type": "mesh_attribute", "name": attribute}
    mesh.set_bsdf(mi.load_dict({"type": "cooktorrance", **textures}))
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    scene, random, elements = ObjectOnTable(mesh, truth.vertices), np.random.default_rng(0), []
    for k, camera in enumerate(example_pot.cameras()[::EVERY]):
        position = camera.position + camera.to_world[:3, :3] @ example_pot.FLASH
        light = Light("point", position, np.full(3, 2 * example_pot.DISTANCE**2))
        picture = scene.radiance(LensCamera(camera), light, 36, k, 2)
        noisy = picture + random.normal(0, NOISE, picture.shape)
        files = Files(Path(f"images/{k:03}.png"), Path(f"masks/{k:03}.png"))
        write_image(to_bytes(linear_to_srgb(noisy.clip(0, 1))), folder / files.filename)
        write_image(to_bytes(scene.coverage(LensCamera(camera))[..., None] >= 0.5), folder / files.mask)
        elements.append(photograph_element(Shot(f"{k:03}", camera, light, files=files, calibrated=True)))
    truth.export(folder / "truth.ply")
    np.savez(folder / "truth.npz", **material)
    (folder / "scene.xml").write_bytes(scene_bytes(scene_element(elements)))


def errors(fit: Fit, folder: Path) -> list[float]:
    """Mean errors of normals [deg] and, relative, of diffuse, specular and roughness."""
    truth, material = read_mesh(folder / "truth.ply", "truth"), np.load(folder / "truth.npz")
    s, faces = fit.ring.domain.sample(5)
    with torch.no_grad():
        vertices, found = fit.ring(s)
    guess = trimesh.Trimesh(vertices.numpy().astype(float), faces, process=False)
    mesh = np.asarray(truth.vertices), np.asarray(truth.faces, np.int32)
    _, nearest, _ = gpytoolbox().squared_distance(guess.triangles_center, *mesh, use_cpp=True)
    cosines = (guess.face_normals * truth.face_normals[nearest]).sum(1)
    result = [float(np.degrees(np.arccos(cosines.clip(-1, 1))).mean())]
    for name in ("diffuse", "specular", "roughness"):
        values = material[name].reshape(len(truth.vertices), -1)
        wanted = transfer_points(guess.vertices, truth.vertices, truth.faces, np.broadcast_to(values, (len(values), 3)))
        given = found[name].numpy().reshape(len(s), -1)
        result.append(float(np.abs(given - wanted).mean() / values.mean()))
    return result


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", choices=WEIGHTS)
    parser.add_argument("--iterations", type=int, default=150)
    parser.add_argument("--level", type=int, default=4)
    parser.add_argument("--width", type=int, default=96)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--weights", type=float, nargs="+", help="Default: those that were found to be of use.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--out", type=Path, default=Path("out/priors"))
    arguments = parser.parse_args()
    rows = []
    for prior in [arguments.only] if arguments.only else WEIGHTS:
        folder = arguments.out / prior
        if not (folder / "scene.xml").is_file():
            write_capture(prior, folder)
        capture = load_capture(folder / "scene.xml")
        for weight in arguments.weights or WEIGHTS[prior]:
            found = []
            for seed in arguments.seeds:
                fit = Fit(capture, Config(
                    iterations=arguments.iterations, levels=(arguments.level,), widths=(arguments.width,),
                    shares=(1.0,), batch=arguments.batch, seed=seed, domain="sphere", indirect=False,
                    weights={prior: weight},
                ))  # fmt: skip
                found.append(errors(fit, folder) if all(fit) else [])
            normal, *rest = np.mean(found, 0)
            rows.append([f"`{prior}`", f"{weight:g}", f"{normal:.2f}°", *(f"{x:.1%}" for x in rest)])
            print("; ".join(rows[-1]), file=sys.stderr, flush=True)
    print(f"\n{processor()}; {datetime.date.today()}; {len(capture)} photographs, noise {NOISE}, "
          f"{arguments.iterations} iterations of {arguments.batch} at level {arguments.level} / {arguments.width} px, "
          f"seeds {arguments.seeds}\n")  # fmt: skip
    print(table(["prior", "weight", "normals", "diffuse", "specular", "roughness"], rows))


if __name__ == "__main__":
    main()
