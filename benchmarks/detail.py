"""How much fine structure a fit finds, by band of spatial frequency.

    python benchmarks/detail.py CAPTURE RUN [MORE …]

CAPTURE is one that `detail_captures.py` has written, RUN a results folder, or a mesh with diffuse colours. In each
photograph's exact camera the maps of normals and of diffuse colour are compared with the true ones, where both surfaces
are seen at less than 60°. Colours are compared after one scale per channel, in % of the mean colour. Novel views are
compared inside the object. A fit with a texture finer than its mesh gets a second column, with this texture.

Prints a Markdown table with a column for each RUN, and then one line of JSON. The row "none" of a band is the error of
a fit that has nothing in this band. The last column is the limit that the photographs' noise sets: the Cramér-Rao bound
of normal and colour of each pixel of the surface, if camera, light and everything else were known.
"""

import argparse
import json
import math
from pathlib import Path

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import recorded
from mi_ring.capture.loading import load_capture
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.geometry.camera import Camera
from mi_ring.images import linear_to_srgb
from mi_ring.objects.ring_file import load_fit
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.rendering import prediction
from mi_ring.rendering.image_formation import render_maps
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.mesh_texture import remove_texture
from mi_ring.scene.shot import Shot
from mi_ring.scene.visibility import MaskedCamera, Visibility

# isort: split
import cv2
import mitsuba as mi
import numpy as np
from accuracy import table
from scipy.ndimage import gaussian_filter, map_coordinates
from tqdm import tqdm

EDGES = 4, 8, 16, 32  #: wavelengths that separate the bands [px]
BANDS = "< 4 px", "4-8 px", "8-16 px", "16-32 px", "> 32 px"
HALF = math.sqrt(math.log(2) / 2) / math.pi  #: a Gaussian of this standard deviation [wavelength] halves a wave
FINE = 8  #: the wavelength below which errors of novel views count as fine [px]
SAMPLES = 2  #: rays per pixel and axis of a map
MARGIN, FACING = 6, 0.5  #: of the region that is compared: from its border [px]; least cosine toward the camera
STEEP = 0.06  #: least gradient of red / (red + blue) at the edge of a stroke [1/px]; grain has none
ALONG = np.arange(-2, 6.01, 0.05)  #: of profiles across such edges [px]
POINTS, DARK = 2000, 0.01  #: of the surface, for the limit by noise; least cosine between normal and light
VISIBLE = 0.02  #: least contrast at which an edge has a width [of the true contrast]


def finer(camera: Camera) -> Photographs:
    """The view of a camera with `SAMPLES`² pixels for each of its pixels."""
    width, height = camera.size
    camera = camera._replace(focal=SAMPLES * camera.focal, centre=SAMPLES * camera.centre,
                             size=(SAMPLES * width, SAMPLES * height))  # fmt: skip
    return Photographs.of([Shot("view", camera)])


def averaged(values: np.ndarray) -> np.ndarray:
    """The means (H, W, C) of the pixels of a finer picture."""
    height, width, channels = values.shape
    blocks = values.reshape(height // SAMPLES, SAMPLES, width // SAMPLES, SAMPLES, channels)
    return blocks.mean((1, 3), dtype=np.float64).astype(np.float32)


class Maps:
    """Maps of a surface and of its diffuse colour: those of a mesh file, or of a results folder.

    `textured`: with the texture of the fit that is finer than its mesh, instead of the colours of the vertices.
    """

    def __init__(self, path: Path, capture: Capture, textured: bool = False) -> None:
        self.surface, self.ring = None, None
        if path.is_dir():
            self.ring = load_fit(path)
            self.surface = Surface(capture.scene, capture.shape, self.ring)
            self.surface.show(self.ring, *self.ring.domain.sample(self.ring.subdivisions))
            if not textured:
                remove_texture(self.surface.shape)
        else:
            self.scene = mi.load_dict({"type": "scene", "mesh": {"type": "ply", "filename": str(path)}})

    def of(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Normals (H, W, 3), diffuse colour (H, W, 3), and which pixels show nothing but the surface (H, W)."""
        view = finer(camera)
        if self.surface is not None:
            found = prediction.maps(self.surface, view)
            normal, diffuse = found["normal"][0], found["diffuse"][0]
        else:
            channels = np.stack([np.array(c) for c in render_maps(self.scene, view, {"vertex_diffuse": 3})], -1)
            normal, diffuse = np.split(channels.reshape(*view.shape[1:], 6), 2, -1)
        seen = averaged((np.abs(normal).sum(-1, keepdims=True) > 0).astype(np.float32))[..., 0] > 0.999
        normal = averaged(normal)
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9), averaged(diffuse), seen


def smoothed(picture: np.ndarray, inside: np.ndarray, wavelength: float) -> np.ndarray:
    """Low-pass of a picture (H, W, C) by its values `inside` (H, W): waves of this wavelength [px] are halved."""
    weights = inside.astype(np.float32)
    both = np.dstack([picture * weights[..., None], weights]).astype(np.float32)
    blurred = np.dstack([cv2.GaussianBlur(np.ascontiguousarray(both[..., k]), (0, 0), HALF * wavelength)
                         for k in range(both.shape[-1])])  # fmt: skip
    return blurred[..., :-1] / np.maximum(blurred[..., -1:], 1e-6)


def bands(picture: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """The `BANDS` of a picture (H, W, C). Their sum is the picture."""
    levels = [picture, *(smoothed(picture, inside, wavelength) for wavelength in EDGES)]
    return [fine - coarse for fine, coarse in zip(levels, levels[1:])] + [levels[-1]]


def profiles(truth: np.ndarray, fit: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Sums of profiles across the true edges of strokes, and their number: (2, `ALONG`, 4), dark side first."""
    hue = truth[..., 0] / np.maximum(truth[..., 0] + truth[..., 2], 1e-6)
    gy, gx = (gaussian_filter(hue, 0.7, order=order) for order in ((1, 0), (0, 1)))
    steep = np.hypot(gx, gy)
    y, x = np.nonzero(inside & (steep > STEEP))
    direction = np.stack([gy, gx])[:, y, x] / steep[y, x]
    before, here, after = (map_coordinates(steep, [y, x] + step * direction, order=1) for step in (-1, 0, 1))
    ridge = (here > before) & (here >= after)
    shift = 0.5 * (before - after) / (before - 2 * here + after - 1e-12)
    y, x = ([y, x] + shift * direction)[:, ridge]
    direction = direction[:, ridge]
    where = np.stack([c[:, None] + s[:, None] * ALONG for c, s in zip((y, x), direction)])
    sums = [[map_coordinates(picture[..., c], where, order=3).sum(0) for c in range(3)]
            + [np.full(len(ALONG), len(y))] for picture in (truth, fit)]  # fmt: skip
    return np.moveaxis(np.array(sums), 1, 2)


def rise(profile: np.ndarray) -> tuple[float, float]:
    """Distance [px] in which a profile, over `ALONG`, rises from 10 to 90 % of its contrast; and that contrast."""
    low = int(np.argmin(profile[ALONG < 0.5]))
    high = low + int(np.argmax(profile[low:]))
    part = profile[low : high + 1]
    share = (part - part[0]) / max(part[-1] - part[0], 1e-12)
    start, end = (int(np.argmax(share >= level)) for level in (0.1, 0.9))
    return float(ALONG[end] - ALONG[start]), float(part[-1] - part[0])


class Comparison:
    """Sums over all views, for the true maps and for one fit."""

    def __init__(self) -> None:
        self.turned, self.bent = np.zeros(len(BANDS)), np.zeros(len(BANDS))  #: squares: errors of normals, true normals
        self.colour = np.zeros((len(BANDS), 3, 3))  #: band, product (fit², fit · truth, truth²), channel
        self.whole, self.mean = np.zeros((3, 3)), np.zeros((2, 3))  #: the same without bands; sums of fit and truth
        self.pixels, self.edges = 0, np.zeros((2, len(ALONG), 4))

    def add(self, fit: tuple, truth: tuple, camera: Camera) -> None:
        """Compare two results of `Maps.of`."""
        both = fit[2] & truth[2]
        y, x = np.mgrid[: camera.size[1], : camera.size[0]] + 0.5
        rays = camera.directions(np.stack([x.ravel(), y.ravel()], 1)).reshape(*both.shape, 3)
        core = cv2.erode(both.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2), borderValue=0) > 0
        core &= (-rays * smoothed(truth[0], both, EDGES[-1])).sum(-1) > FACING
        self.pixels += core.sum()
        for k, (a, b) in enumerate(zip(bands(fit[0], both), bands(truth[0], both))):
            self.turned[k] += np.square(a - b)[core].sum()
            self.bent[k] += np.square(b)[core].sum()
        for k, (a, b) in enumerate(zip(bands(fit[1], both), bands(truth[1], both))):
            self.colour[k] += [(p * q)[core].sum(0) for p, q in ((a, a), (a, b), (b, b))]
        a, b = fit[1][core].astype(float), truth[1][core].astype(float)
        self.whole += [(a * a).sum(0), (a * b).sum(0), (b * b).sum(0)]
        self.mean += [a.sum(0), b.sum(0)]
        self.edges += profiles(truth[1], fit[1], core)

    def numbers(self) -> dict[str, float | None]:
        """Errors by name; None for the width of edges that cannot be seen."""
        scale, mean, found = self.whole[1] / self.whole[0], self.mean / self.pixels, {}
        for k, band in enumerate(BANDS):
            found[f"normals {band}, error °"] = np.degrees(np.sqrt(self.turned[k] / self.pixels))
            if k < len(EDGES):
                found[f"normals {band}, none °"] = np.degrees(np.sqrt(self.bent[k] / self.pixels))
        for k, band in enumerate(BANDS):
            squares = scale**2 * self.colour[k, 0] - 2 * scale * self.colour[k, 1] + self.colour[k, 2]
            for what, square in (("error", squares), ("none", self.colour[k, 2])):
                if what == "error" or k < len(EDGES):
                    value = np.sqrt(np.mean(np.maximum(square, 0) / self.pixels / mean[1] ** 2))
                    found[f"colour {band}, {what} %"] = 100 * value
        variation = np.sqrt(np.maximum(self.whole[[0, 2]] / self.pixels - mean**2, 0)) / mean
        found["colour, standard deviation %"], found["colour, true %"] = 100 * variation.mean(1)
        if self.edges[0, 0, 3]:
            (true, full), (width, contrast) = (rise((e[:, :3] * s).mean(1)) for e, s in zip(self.edges, (1, scale)))
            found |= {
                "edges of colour, 10-90 % px": width if contrast > VISIBLE * full else None,
                "edges of colour, true px": true,
                "contrast of edges, % of the true": 100 * contrast / full,
            }
        return {name: None if value is None else float(value) for name, value in found.items()}


def noise_limit(capture: Capture, truth: Path, electrons: float) -> dict[str, float]:
    """The least errors that noise allows, by the names of `Comparison.numbers`.

    `truth`: mesh with diffuse colours. `electrons`: of a white pixel. Photographs have 8 bits.
    """
    params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(truth)}))
    vertices, normals, colours, faces = (
        np.array(params[name]).reshape(-1, 3)
        for name in ("vertex_positions", "vertex_normals", "vertex_diffuse", "faces")
    )
    seen_by = Visibility(vertices, faces, []).seen_by
    some = np.random.default_rng(0).integers(len(vertices), size=POINTS)
    points, normals, colours = (values[some].astype(float) for values in (vertices, normals, colours))
    across = np.cross(normals, np.roll(normals, 1, 1))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    tangents = np.stack([across, np.cross(normals, across)], 1)
    information = np.zeros((POINTS, 5, 5))
    for shot in capture.shots:
        seen = seen_by(MaskedCamera(shot.camera, None), points, normals)
        away, light = shot.camera.position - points, shot.own_light
        assert light.kind == "point"
        lit = light.vector - points
        cosine = (normals * lit).sum(1) / np.linalg.norm(lit, axis=1)
        seen &= cosine > DARK
        cosine = cosine.clip(DARK)
        value = colours / np.pi * light.rgb * (cosine / (lit**2).sum(1))[:, None]
        step = np.gradient(srgb_to_linear(np.arange(256) / 255))[(255 * linear_to_srgb(value.clip(0, 1))).astype(int)]
        noise = value / electrons + step**2 / 12
        slope = np.einsum("nkc,nc->nk", tangents, lit) / (cosine * np.linalg.norm(lit, axis=1))[:, None]
        # Of a value: by the logarithm of each colour, and by both slopes.
        change = np.concatenate([np.broadcast_to(np.eye(3), (POINTS, 3, 3)), slope[:, None].repeat(3, 1)], 2)
        seen &= (value < 1).all(1)
        pixels = seen * (normals * away).sum(1) / np.linalg.norm(away, axis=1)
        information += np.einsum("n,nc,nci,ncj->nij", pixels, value**2 / noise, change, change)
    eigenvalues = np.linalg.eigvalsh(information)  # least first
    told = information[eigenvalues[:, 0] > 1e-6 * eigenvalues[:, -1].max()]
    variances = np.diagonal(np.linalg.inv(told), axis1=1, axis2=2)
    bent = np.degrees(np.sqrt(np.median(variances[:, 3:].sum(1))))
    coloured = 100 * np.sqrt(np.median(variances[:, :3].mean(1)))
    white = np.random.default_rng(0).normal(size=(256, 256, 1)).astype(np.float32)
    found = {}
    for name, band in zip(BANDS, bands(white, np.ones(white.shape[:2], bool))):
        found[f"normals {name}, error °"] = float(bent * band.std())
        found[f"colour {name}, error %"] = float(coloured * band.std())
    return found


def novel_errors(maps: Maps, novel: Capture) -> dict[str, float]:
    """PSNR [dB] of predicted novel views inside the object, of all and of what is finer than `FINE` pixels."""
    squares = []
    for k in range(len(novel)):
        rgb, _ = prediction.draw(maps.surface, novel.photograph(k), shadows=novel.shadows, indirect=maps.ring.indirect)
        seen = novel.observe([k])
        a, b = (linear_to_srgb(np.clip(recorded(picture, novel.shots[k]), 0, 1))
                for picture in (rgb[0].numpy(), seen.rgb[0].numpy()))  # fmt: skip
        inside = seen.mask[0].numpy() > 0.99
        fine = (a - b) - smoothed(a - b, inside, FINE)
        squares.append([np.square(d[inside]).mean() for d in (a - b, fine)])
    total, fine = -10 * np.log10(np.mean(squares, 0))
    return {"novel views dB": float(total), f"novel views, finer than {FINE} px dB": float(fine)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--electrons", type=float, default=10_000, help="of a white pixel, see detail_captures.py")
    options = parser.parse_args()
    truth = options.capture / "truth"
    exact = next(file for file in (options.capture / "exact.xml", options.capture / "scene.xml") if file.is_file())
    capture = load_capture(exact, images=False)
    true, columns = Maps(truth / "mesh.ply", capture), {}
    found = {str(run): (Maps(run, capture), Comparison()) for run in options.runs}
    for run, (maps, _) in list(found.items()):
        if maps.ring is not None and isinstance(maps.ring.brdf_net, SharpenedMaterial):
            found[f"{run}, texture"] = Maps(Path(run), capture, textured=True), Comparison()
    for shot in tqdm(capture.shots, disable=None):
        expected = true.of(shot.camera)
        for maps, comparison in found.values():
            comparison.add(maps.of(shot.camera), expected, shot.camera)
    for run, (maps, comparison) in found.items():
        columns[run] = comparison.numbers()
        if maps.ring is not None and (truth / "scene.xml").is_file():
            columns[run] |= novel_errors(maps, load_capture(truth / "scene.xml"))
    columns["limit by noise"] = noise_limit(capture, truth / "mesh.ply", options.electrons)
    names = dict.fromkeys(name for numbers in columns.values() for name in numbers)
    values = ((name, [numbers.get(name) for numbers in columns.values()]) for name in names)
    rows = [[name, *("-" if value is None else f"{value:.2f}" for value in row)] for name, row in values]
    print(table([options.capture.name, *columns], rows))
    print(json.dumps(columns))


if __name__ == "__main__":
    main()
