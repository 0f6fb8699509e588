"""Captures whose calibration is wrong by a known amount: what refinement finds, and what it is worth.

    python benchmarks/perturbed.py CAPTURE [MORE …] --wrong cameras|light|power|curve|contrast [--by 0.5]
        [--seeds 0 1 2] [--fits exact wrong refined …] [--preset default] [--out out/perturbed]

cameras: each turned about each of its axes by a normal angle of so many degrees, and moved along each by a normal share
of so many per cent of its distance from the object. light: all flashes by so many per cent of that distance, in one
random direction of the cameras' axes. power: each photograph's light by a lognormal factor of so many per cent. curve,
contrast: the exponent of the camera's curve, and how steep its S is, by a factor of 1 + so many per cent. For each
seed up to four fits: exact calibration as it is and refined (`again`), wrong calibration as it is and refined; in a
table the mean errors of normals and depth and the PSNR of novel views after rigid alignment, what is left of the
perturbation and, of cameras, the paper's Table 3. A capture is a folder with scene.xml, truth/mesh.ply and
truth/scene.xml. It goes on where it stopped.
"""

import argparse
import datetime
import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
from accuracy import processor, product_speed, scene_file, table, truth_of
from scipy.spatial.transform import Rotation

import mi_ring
from mi_ring.capture.scenefile import move_names, recalibrated_xml
from mi_ring.rendering.photograph_lights import Lights
from mi_ring.synthesis.degradation import miscalibrated

WRONG = "cameras", "light", "power", "curve", "contrast"
CURVES = {"curve": "gamma", "contrast": "contrast"}  #: as photographs call them
#: The paper's Table 3, its bunny with a poor calibration: normals, depth, and PSNR of photographs, it says not which.
PAPER = {"wrong": "10.3°, 1.34 %, 25.6 dB", "refined": "6.60°, 0.65 %, 32.9 dB"}
#: Fits: is calibration wrong, and is it refined?
FITS = {"exact": (False, False), "again": (False, True), "wrong": (True, False), "refined": (True, True)}


def perturbed(capture, wrong: str, by: float, seed: int):
    """The capture with other cameras or lights."""
    center, _ = capture.sphere()
    if wrong in CURVES:
        factor = {CURVES[wrong]: 1 + by / 100}
        shots = tuple(replace(shot, response=shot.response.changed(**factor)) for shot in capture.shots)
    else:
        amount = {{"cameras": "turned", "light": "shifted", "power": "scaled"}[wrong]: by}
        shots = miscalibrated(capture.shots, center, np.random.default_rng(seed), **amount)
    return replace(capture, shots=shots)


def write(capture, path: Path) -> None:
    """A scene file of a capture, with the photographs where they are."""
    root = ElementTree.parse(capture.path).getroot()
    move_names(root, capture.path.parent, path.parent)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(recalibrated_xml(ElementTree.tostring(root), capture.shots, capture.room))


def fitted(scene: Path, out: Path, truth: Path, refine: list[str], options: list[str]) -> dict:
    """Numbers of a fit, which is not made again if there is one with the same options."""
    result, words = out / "numbers.json", out.with_suffix(".txt")
    module = [sys.executable, "-m"]
    fit = [str(a) for a in (*module, "mi_ring.fit", scene, "--out", out, "--refine", *refine, *options)]
    if not (result.exists() and words.exists() and words.read_text() == " ".join(fit)):
        if status := subprocess.run(fit, stdout=sys.stderr).returncode:
            sys.exit(status)  # it has said why
        evaluate = [*module, "mi_ring.evaluate", out, "--mesh", truth / "mesh.ply", "--novel", truth / "scene.xml",
                    "--align", "rigid", "--spp", 4]  # fmt: skip
        done = subprocess.run([str(a) for a in evaluate], check=True, stdout=subprocess.PIPE)
        result.write_bytes(done.stdout)
        words.write_text(" ".join(fit))
    return json.loads(result.read_text())


def left(true, found, wrong: str) -> float:
    """What is left of the perturbation: [°] of cameras, [% of the distance] of lights, [%] of powers and curves."""
    center, _ = true.sphere()
    a, b = ([shot.camera for shot in capture.shots] for capture in (true, found))
    if wrong == "cameras":  # as a whole they may have turned
        turns = Rotation.from_matrix([x.to_world[:3, :3] @ y.to_world[:3, :3].T for x, y in zip(a, b)])
        return float(np.degrees(np.sqrt(np.mean((turns * turns.mean().inv()).magnitude() ** 2))))
    if wrong in CURVES:
        before, after = (getattr(capture.shots[0].response, CURVES[wrong]) for capture in (true, found))
        return 100 * (after / before - 1)
    lights = [Lights.of(capture.shots) for capture in (true, found)]
    if wrong == "light":
        own = [
            np.stack([c.to_world[:3, :3].T @ (p - c.position) for c, p in zip(cameras, light.positions())])
            for cameras, light in zip((a, b), lights)
        ]
        distance = np.median([np.linalg.norm(camera.position - center) for camera in a])
        return float(100 * np.linalg.norm((own[1] - own[0]).mean(0)) / distance)
    ratio = np.log(lights[1].rgb() / lights[0].rgb())
    return float(100 * (ratio - ratio.mean(0)).std())


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=scene_file)
    parser.add_argument("--wrong", choices=WRONG, required=True)
    parser.add_argument("--by", type=float, default=0.5)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--fits", nargs="+", choices=tuple(FITS), default=list(FITS))
    parser.add_argument("--out", type=Path, default=Path("out/perturbed"))
    options, rest = parser.parse_known_args()
    rows = []
    for path in options.captures:
        truth, name = truth_of(path), path.stem if path.stem != "scene" else path.parent.name
        true = mi_ring.load_capture(path, images=False)
        for seed in options.seeds:
            folder = options.out / f"{name}_{options.wrong}_{options.by}_{seed}"
            wrong = perturbed(true, options.wrong, options.by, seed)
            exact = options.out / f"{name}_exact.xml"
            write(true, exact)
            write(wrong, folder / "wrong.xml")
            cells, found = [f"{name}, seed {seed}"], wrong
            for fit in options.fits:
                is_wrong, is_refined = FITS[fit]
                # Of exact calibration there is one fit, whatever else is wrong.
                out = folder / fit if fit != "exact" else options.out / f"{name}_exact_{seed}"
                scene = folder / "wrong.xml" if is_wrong else exact
                refine = [options.wrong] if is_refined else ["none"]
                numbers = fitted(scene, out, truth, refine, [*rest, "--seed", str(seed)])
                cells.append("{normal_mean:.2f}°, {depth_mean:.3f} %, {psnr_novel:.1f} dB".format(**numbers))
                if fit == "refined":
                    found = mi_ring.load_capture(out / "scene.xml", images=False)
            cells.append(f"{left(true, wrong, options.wrong):.3f}")
            if found is not wrong:
                cells[-1] += f" → {left(true, found, options.wrong):.3f}"
            rows.append(cells)
            print(cells, file=sys.stderr, flush=True)
    import torch

    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}; {speed:.0f} GFLOP/s; {datetime.date.today()}; {options.wrong} wrong by {options.by}; "
          f"mi_ring.fit {' '.join(rest)}\n")  # fmt: skip
    if options.wrong == "cameras":
        rows.append(["the paper's bunny", *(PAPER.get(fit, "") for fit in options.fits), ""])
    print(table(["normals, depth, novel views", *options.fits, "wrong by, before → after"], rows))


if __name__ == "__main__":
    main()
