"""What a second lobe of highlights is worth: glossy objects, fitted with one lobe, with two, and with `--lobes auto`.

    python benchmarks/gloss.py MESH [MATERIAL …] [--lobes 1 2 auto] [--views 30] [--size 160] [--out out/gloss]
                               [OPTIONS OF mi-ring fit]

`mi-ring synthesize` path traces flash photographs of the mesh in each material: by default polished brass, varnish over
wood, and a `cooktorrance` with one lobe. FILE.npz:NAME is a measured material.

Prints a Markdown table with machine and date: PSNR of kept-out photographs [dB]; errors of normals, mean and median
[deg]; standard deviation of the albedo relative to its mean, which is 0 in truth; correlation of albedo and strength of
highlights over the surface; mean strength and roughness of the coat; what `auto` measures; seconds of the iterations.
"""

import argparse
import datetime
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from accuracy import measure, processor, table

from mi_ring.objects.ring_file import load_fit

MATERIALS = ("brass", "varnish", "cooktorrance diffuse=0.15,0.08,0.03 specular=0.05 roughness=0.3")
LEVEL = 5  #: of the points at which materials are compared


def folder_name(material: str) -> str:
    """The last name in a material, for files."""
    return material.split()[0].rpartition(":")[2]


def synthesized(options: argparse.Namespace, material: str) -> Path:
    """The scene file of a capture; it is made if it is not there."""
    folder = options.out / "captures" / folder_name(material)
    size = [str(options.size)] * 2
    command = [sys.executable, "-m", "mi_ring.synthesize", str(options.mesh), str(folder), "--material", material]
    command += ["--smooth", "--views", str(options.views), "--novel", "0", "--size", *size, "--fov", "40"]
    if not (folder / "truth/mesh.ply").is_file() or not (folder / "scene.xml").is_file():
        subprocess.run([*command, "--clipped", "0.002"], check=True, stdout=sys.stderr)
    return folder / "scene.xml"


def material_numbers(run: Path) -> list[str]:
    """Spread of the albedo, its correlation with highlights, and the mean coat of a fit."""
    ring = load_fit(run)
    with torch.no_grad():
        found = {name: value.numpy() for name, value in ring.material(ring.domain.sample(LEVEL)[0]).items()}
    albedo, coat = found["diffuse"].mean(1), found.get("coat")
    together = np.corrcoef(albedo, found["specular"])[0, 1]
    mean = "–"
    if coat is not None:
        mean = f"{coat.mean() / found['specular'].mean():.2f}, {found['coat_roughness'].mean():.2f}"
    return [f"{albedo.std() / albedo.mean():.3f}", f"{together:.2f}", mean]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("materials", nargs="*", default=MATERIALS)
    parser.add_argument("--lobes", nargs="+", default=["1", "2", "auto"], choices=["1", "2", "auto"])
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--size", type=int, default=160)
    parser.add_argument("--out", type=Path, default=Path("out/gloss"))
    options, fit = parser.parse_known_args()
    fit = fit or ["--preset", "fast"]
    rows = []
    for material in options.materials:
        scene = synthesized(options, material)
        for lobes in options.lobes:
            run = options.out / f"{folder_name(material)}_{lobes}"
            found = measure(scene, run, [*fit, "--holdout", "8", "--lobes", lobes], scene.parent / "truth")
            entries = [json.loads(line) for line in (run / "log.jsonl").read_text("utf-8").splitlines()]
            share = entries[-1].get("second_lobe")
            rows.append([
                folder_name(material), lobes, f"{found['psnr_held_out']:.2f}",
                f"{found['normal_mean']:.2f} / {found['normal_median']:.2f}", *material_numbers(run),
                "–" if share is None else f"{share:.3f}", f"{found['fit s']:.0f}",
            ])  # fmt: skip
            print("; ".join(rows[-1]), file=sys.stderr, flush=True)
    print(f"{processor()}; {datetime.date.today()}; {options.views} photographs of {options.size}² px; mi-ring fit "
          f"{' '.join(fit)} --holdout 8\n")  # fmt: skip
    heads = ["material", "--lobes", "PSNR", "normals", "albedo varies", "with highlights",
             "coat / specular, roughness", "evidence", "s"]  # fmt: skip
    print(table(heads, rows))


if __name__ == "__main__":
    main()
