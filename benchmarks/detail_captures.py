"""Make captures of an object with fine structure: embossed and printed strokes and grain. For `detail.py`.

    python benchmarks/detail_captures.py OUT [--only relief print both] [--strokes 2] [--level 9]

Writes three captures, and each of them again with cameras off by half a pixel: OUT/relief, of one colour with relief;
OUT/print, smooth with print; OUT/both, with relief and another print; OUT/relief-off and so on. The upper half of the
object has lines of text, the lower half grain of many wavelengths. All structure is in the mesh, not in textures;
truth/mesh.ply has the diffuse colour as well. A pixel is one of the photographs, where the object faces the camera.
There is no interreflection: fit with --no-indirect.
"""

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from mi_ring.capture.loading import load_capture
from mi_ring.capture.scenefile import recalibrated_xml
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.output.ply import write_ply
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.scene.shot import Shot
from mi_ring.synthesis.degradation import miscalibrated
from mi_ring.synthesis.object_on_table import load_object
from mi_ring.synthesis.options import SynthesizeConfig
from mi_ring.synthesis.path_traced_capture import write_capture
from mi_ring.system.files import write_file

# isort: split
import cv2
import numpy as np
import trimesh
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.special import sph_harm_y
from skimage.morphology import skeletonize

KINDS = "relief", "print", "both"
HARMONICS = {(2, 0): 0.12, (2, 1): 0.1, (3, 2): 0.16, (4, -3): 0.12}  #: (degree, order): part of the radius
PAPER, INK = np.array([0.72, 0.62, 0.48]), np.array([0.08, 0.1, 0.22])  #: linear colours
TEXT = "SPHINX OF BLACK QUARTZ, JUDGE MY VOW 0123456789 "
CAP, LEADING = 7, 1.8  #: height of capitals [width of a stroke], distance of lines [height of capitals]
WAVES, WAVELENGTHS = 120, (4.0, 32.0)  #: of the grain: number; range [px]
DOTS, SOFT = 8, 0.4  #: dots per pixel of the drawn text; standard deviation of the blur of its edges [px]


def text_at(azimuth: np.ndarray, latitude: np.ndarray, radius: float, widths: list[float], skip: int) -> np.ndarray:
    """Share of ink (V,) at points of the upper half of a sphere of this radius [px]. `skip`: letters of the text."""
    ink, place = np.zeros(len(azimuth)), 0.06
    for k in range(1000):
        width = widths[k % len(widths)]
        high = CAP * width
        place += LEADING * high / radius / 2
        if place > 1.1:
            break
        scale, size = high * DOTS / 21, (int(2 * np.pi * radius * np.cos(place) * DOTS), int(2 * high * DOTS))
        line = np.zeros(size[::-1], np.uint8)
        words = np.roll(list(TEXT * 20), -skip - 7 * k)
        cv2.putText(line, "".join(words), (0, int(1.5 * high * DOTS)), cv2.FONT_HERSHEY_SIMPLEX, scale, 255)
        strokes = distance_transform_edt(~skeletonize(line > 127)) < width * DOTS / 2  # whatever the font's own width
        soft = cv2.GaussianBlur(strokes.astype(np.float32), (0, 0), SOFT * DOTS)
        near = np.abs(latitude - place) * radius < high
        across = azimuth[near] / (2 * np.pi) % 1 * size[0]
        down = (high - (latitude[near] - place) * radius) * DOTS
        ink[near] = np.maximum(ink[near], map_coordinates(soft, [down, across], order=1))
        place += LEADING * high / radius / 2
    return ink


def grain_at(points: np.ndarray, rng: np.random.Generator, power: float) -> np.ndarray:
    """Grain (V,) at points (V, 3) [px]: waves of all directions with amplitudes ~ wavelength ** `power`.

    Power 0: of unit variance. Power 1: with a root mean square slope of 1 on a surface.
    """
    lengths = np.exp(rng.uniform(*np.log(WAVELENGTHS), WAVES))
    directions, phases = rng.normal(size=(WAVES, 3)), rng.uniform(0, 2 * np.pi, WAVES)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.zeros(len(points), np.float32)
    for length, direction, phase in zip(lengths, directions, phases):
        # A surface shows 2/3 of the mean squared gradient of waves in space.
        amplitude = np.sqrt(2 / WAVES) if power == 0 else np.sqrt(3 / WAVES) * length / (2 * np.pi)
        found += amplitude * np.cos((points @ (2 * np.pi / length * direction) + phase).astype(np.float32))
    return found


def smooth_object(level: int) -> tuple[trimesh.Trimesh, np.ndarray]:
    """The object without relief, with its farthest point at 1, and the directions (V, 3) of its vertices."""
    sphere = trimesh.creation.icosphere(subdivisions=level)
    d = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1, keepdims=True)
    polar, azimuth = np.arccos(d[:, 1]), np.arctan2(d[:, 0], d[:, 2])
    waves = (part * sph_harm_y(n, abs(m), polar, azimuth + m) for (n, m), part in HARMONICS.items())
    points = d * (1 + np.real(sum(waves)))[:, None]
    points -= (points.min(0) + points.max(0)) / 2
    return trimesh.Trimesh(points / np.linalg.norm(points, axis=1).max(), sphere.faces, process=False), d


def detailed(kind: str, options: argparse.Namespace, config: SynthesizeConfig) -> trimesh.Trimesh:
    """The object with its relief and its 8-bit colours."""
    mesh, d = smooth_object(options.level)
    mean = np.linalg.norm(mesh.vertices, axis=1).mean()
    focal = config.size[0] / 2 / np.tan(np.radians(config.fov / 2))
    pixel = (config.camera_distance / config.radius - mean) / focal
    azimuth, latitude = np.arctan2(d[:, 0], d[:, 2]), np.arcsin(d[:, 1])
    below = np.clip(-latitude / 0.06, 0, 1)  # grain fades out where the text begins
    colours = np.tile(PAPER, (len(d), 1))
    spacing = np.sqrt(2 / np.sqrt(3) * mesh.area / len(d)) / pixel
    print(f"{kind}: {len(d)} vertices, {spacing:.2f} px apart; mean radius {mean / pixel:.0f} px")
    if kind != "relief":
        ink = text_at(azimuth, latitude, mean / pixel, options.strokes, 11)[:, None]
        grain = grain_at(mesh.vertices / pixel, np.random.default_rng([options.seed, 0]), 0)
        colours *= np.exp(options.contrast * below * grain)[:, None]
        colours = np.clip((1 - ink) * colours + ink * INK, 0.02, 0.95)
    if kind != "print":
        slope = np.tan(np.radians(options.slope))
        height = options.height * text_at(azimuth, latitude, mean / pixel, options.strokes, 0)
        height += slope * below * grain_at(mesh.vertices / pixel, np.random.default_rng([options.seed, 1]), 1)
        normals = mesh.vertex_normals
        mesh = trimesh.Trimesh(mesh.vertices + pixel * height[:, None] * normals, mesh.faces, process=False)
        bent = np.degrees(np.arccos(np.clip((mesh.vertex_normals * normals).sum(1), -1, 1)))
        print(f"    height {height.std():.2f} px rms, up to {height.max():.1f}; slope {np.sqrt(np.mean(bent**2)):.0f}° "
              f"rms, {np.quantile(bent, 0.99):.0f}° at the steepest hundredth")  # fmt: skip
    mesh.visual.vertex_colors = to_bytes(linear_to_srgb(colours))
    return mesh


def reprojection(shots: Sequence[Shot], others: Sequence[Shot], points: np.ndarray) -> float:
    """Root mean square distance [px] between points (n, 3) in the cameras of two lists of photographs."""
    gaps = [a.camera.project(points)[0] - b.camera.project(points)[0] for a, b in zip(shots, others)]
    return float(np.sqrt(np.square(gaps).sum(-1).mean()))


def with_wrong_cameras(exact: Path, out: Path, points: np.ndarray, gap: float, seed: int) -> None:
    """Copy a capture; cameras in the copy move points (n, 3) by `gap` [px], and exact.xml has the exact ones."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(exact, out)
    (out / "scene.xml").rename(out / "exact.xml")
    capture = load_capture(out / "exact.xml", images=False)

    def turned(degrees: float) -> list[Shot]:
        return list(miscalibrated(capture.shots, np.zeros(3), np.random.default_rng(seed), degrees))

    degrees = 0.01
    for _ in range(2):  # almost linear
        degrees *= gap / reprojection(turned(degrees), capture.shots, points)
    xml = capture.xml.replace(b'"calibrated" value="true"', b'"calibrated" value="false"')
    write_file(out / "scene.xml", recalibrated_xml(xml, turned(degrees)))
    found = load_capture(out / "scene.xml", images=False).shots
    print(f"    cameras of {out.name}: off by {reprojection(found, capture.shots, points):.2f} px")


def make(kind: str, options: argparse.Namespace) -> None:
    """Write a capture, and the same with wrong cameras."""
    out = options.out / kind
    config = SynthesizeConfig(
        options.out / f"{kind}.ply", out, material="principled base_color=vertex_color roughness=0.4", fov=30.0,
        size=(options.size, options.size), views=options.views, novel=8, format="png8", depth=2, spp=options.spp,
        electrons=options.electrons, seed=options.seed,
    )  # fmt: skip
    write_file(config.mesh, detailed(kind, options, config).export(file_type="ply"))
    write_capture(config)
    mesh, colours, _ = load_object(config.mesh, config.radius, False)
    truth = mesh_of(mesh.vertices, mesh.faces)
    truth.add_attribute("vertex_diffuse", 3, np.ravel(colours))
    write_ply(truth, out / "truth/mesh.ply")
    with_wrong_cameras(out, options.out / f"{kind}-off", mesh.vertices[::997], options.gap, options.seed)


def main() -> None:
    """Write the captures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--strokes", nargs="+", type=float, default=[2.0], help="widths, line after line of text [px]")
    parser.add_argument("--height", type=float, default=0.7, help="of embossed strokes [px]")
    parser.add_argument("--slope", type=float, default=10.0, help="of the grain's relief, root mean square [deg]")
    parser.add_argument("--contrast", type=float, default=0.2, help="of the printed grain, root mean square")
    parser.add_argument("--level", type=int, default=9, help="of the icosphere")
    parser.add_argument("--size", type=int, default=512, help="of the photographs [px]")
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--electrons", type=float, default=10_000)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--gap", type=float, default=0.5, help="of wrong cameras, root mean square [px]")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for kind in options.only:
        make(kind, options)


if __name__ == "__main__":
    main()
