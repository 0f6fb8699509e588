"""Compare `photometric` with Mitsuba's path tracer: `python -m mi_ring.validate SCENE.xml` or `… RUN`."""

import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw
from scipy import stats
from tqdm import tqdm
from tyro.conf import Positional, arg

from mi_ring import capture, command, photograph
from mi_ring.bsdf import attributes_of, check_attributes
from mi_ring.capture import linear_to_srgb, to_bytes
from mi_ring.errors import InputError
from mi_ring.integrator import Photographs, pixel_rays, render_photographs
from mi_ring.mesh import ShapeNetMesh
from mi_ring.results import replace, writing

BATCHES = 16  #: independent pictures of each photograph; their spread is the Monte Carlo noise
BLOCK = 8  #: width and height of the blocks of pixels that are compared [px]
LANES = 1 << 21  #: rays per launch, at most
ROUNDING = 1e-6  #: two ways to compute the same radiance in float32 may differ by this much, relative
IMPLAUSIBLE = 0.75  #: share of interreflection that hardly any object has
THUMBNAIL = 128  #: width and height of the contact sheet's pictures, at most [px]


@dataclass(frozen=True)
class ValidateConfig:
    """Compare `photometric` with Mitsuba's path tracer on every photograph: shadows, interreflection, disagreement.

    Prints a line for each photograph and one for all. In % of path's mean radiance: the mean difference of the two, the
    mean of its absolute value and how much of that Monte Carlo noise explains, what shadows take away, what
    interreflection adds, and what is left unexplained, the difference of direct light. "p direct" is how likely so
    large a difference is if both renderers' direct light is the same, "p path" likewise of photometric and all light of
    path: tiny where there is interreflection.

    Writes validate.png, a contact sheet, and validate.json, all numbers. Exit status: 1 if the direct light of the two
    differs by more than Monte Carlo noise, 2 if there is nothing to compare.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml|RUN")]]
    """Mitsuba XML file with photographs, or results folder of a fit."""
    out: Path | None = None
    """Folder of the results. Default: RUN/validate, for a scene file out/validate/<name>."""
    photographs: tuple[str, ...] = ()
    """Only these, by id or name of the image file. Default: all."""
    width: int = 128
    """Width and height of the pictures, at most [px]."""
    spp: int = 64
    """Samples per pixel, rounded up to a multiple of 16."""
    depth: int = 6
    """Longest paths, `max_depth` of the path tracer: 3 or more, for 2 is direct light. -1: no limit."""
    significance: float = 0.01
    """Chance that renderers which agree are said to disagree."""
    seed: int = 0
    """Of all samples."""

    def __post_init__(self):
        for name in ("width", "spp"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name}: is {getattr(self, name)}, must be at least 1")
        if self.depth < 3 and self.depth != -1:
            raise InputError(f"--depth: is {self.depth}, must be at least 3, or -1 for no limit")
        if not 0 < self.significance < 1:
            raise InputError(f"--significance: is {self.significance}, must be between 0 and 1")
        if not 0 <= self.seed < 1 << 31:
            raise InputError(f"--seed: is {self.seed}, must be 0 to {(1 << 31) - 1}")


@dataclass
class Comparison:
    """What is found out about one photograph, or about all. Shares are of the mean radiance of `path`."""

    name: str
    radiance: float  #: mean of `path` over all pixels and channels
    difference: float  #: mean of photometric − path
    absolute_difference: float  #: mean over pixels of the size of photometric − path, of which …
    noise: float  #: … Monte Carlo noise explains this much
    psnr: float  #: photometric against path [dB], sRGB, at most 100
    shadows: float  #: what photometric without shadows has too much
    interreflection: float  #: what path has beyond direct light
    unexplained: float  #: mean of photometric − direct light of path
    unexplained_noise: float  #: its standard error
    p_direct: float  #: of a difference this large if photometric and the direct light of path agree
    p_path: float  #: likewise of photometric and all of path


@dataclass
class Pictures:
    """Independent renderings (16, H, W, 3) of one photograph: linear radiance."""

    photometric: np.ndarray
    unshadowed: np.ndarray  #: same samples as photometric
    path: np.ndarray
    direct: np.ndarray  #: the direct light of `path`, same samples


def open_scene(path: Path) -> tuple[mi.Scene, list]:
    """The scene with its photographs, lit for stock integrators too. Raises InputError, one line."""
    scene, sensors = capture.open_scene(path)
    try:
        for shape in scene.shapes():
            check_attributes(shape)
            if isinstance(shape, ShapeNetMesh) and shape.ring is None and attributes_of(shape.bsdf()):
                raise ValueError(f"{shape.id()}: has no weights, so there is no object yet; give the folder of its fit")
        Photographs.of(sensors)
        return with_flash(scene), sensors
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def with_flash(scene: mi.Scene) -> mi.Scene:
    """The scene with one `flash` emitter, through which stock integrators see the light of a photograph.

    A `shapenet` brings it along; a scene of other shapes is assembled anew. Raises ValueError if there are several,
    each of which would add the light once more.
    """
    count = sum(isinstance(emitter, photograph.Flash) for emitter in scene.emitters())
    if count > 1:
        raise ValueError(f"flash: found {count} of them, so that the light would count {count} times; "
                         'set <boolean name="flash" value="false"/> in all shapenets but one')  # fmt: skip
    if count == 1:
        return scene
    lamps = [e for e in scene.emitters() if not mi.has_flag(e.flags(), mi.EmitterFlags.Surface)]  # shapes have theirs
    parts = {f"part{k}": part for k, part in enumerate([*scene.shapes(), *lamps])}
    return mi.load_dict({"type": "scene", "flash": {"type": "flash"}, **parts}, optimize=False, parallel=False)


def render(scene, photographs, k, sensor, scale, spp, depth, seed) -> Pictures:
    """Photograph `k`, taken by `sensor`, `scale` times smaller: 16 times, each with `spp` samples per pixel of its own.

    `photometric` and `path` have different samples, but both along rays of ours: the film's filter has no part in it.
    Seeds up to `seed` + 31 are used.
    """
    width, height = (s // scale for s in sensor.size)
    pixels = width * height
    group = max(1, min(BATCHES, LANES // (pixels * spp)))
    parts = []
    for first in range(0, BATCHES, group):
        batch = photographs.select([k] * min(group, BATCHES - first), sensor.size, scale)
        own, other = seed + 2 * first, seed + 2 * first + 1
        parts.append([
            render_photographs(scene, batch, spp, own),
            render_photographs(scene, batch, spp, own, shadows=False),
            render_path(scene, batch, sensor, spp, other, depth),
            render_path(scene, batch, sensor, spp, other, 2),
        ])  # fmt: skip
        dr.eval(parts[-1])
    return Pictures(*(
        np.concatenate([np.stack([np.array(c).reshape(-1, height, width) for c in p[:3]], -1) for p in which])
        for which in zip(*parts)
    ))  # fmt: skip


def render_path(scene, photographs, sensor, spp, seed, depth):
    """Like `render_photographs`, by `path`: [R, G, B]. All selected photographs must be that of `sensor`."""
    photograph.Photograph.current = sensor
    ray, _ = pixel_rays(photographs, spp, seed)
    ray.time = photograph.SHUTTER
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(ray))
    integrator = mi.load_dict({"type": "path", "max_depth": depth})
    radiance, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))
    dr.schedule(radiance)
    return [dr.block_sum(c, spp) / spp for c in radiance]


def agreement(a: np.ndarray, b: np.ndarray) -> float:
    """Probability that independent pictures a, b (16, H, W, 3) float64 differ this much if equally distributed.

    The lesser of two p-values, corrected (Šidák): of the mean of all pixels, by Student's t, and of all blocks of
    8 × 8 pixels, as follows. If a and b agree, each of the 16 differences d of a block is as likely as −d, however
    heavy its tails. Over all choices of signs, (Σ d)² / Σ d² has the mean 1 and the variance 2 − 2 Σ d⁴ / (Σ d²)²;
    blocks are independent, so that their sum follows a gamma distribution of known mean and variance. Channels share
    their samples and would not be independent, so blocks take turns: red, green, blue.
    """
    whole, count = a.mean((1, 2, 3)) - b.mean((1, 2, 3)), len(a)
    error = np.hypot(whole.std(ddof=1) / np.sqrt(count), ROUNDING * (a.mean() + b.mean()))
    p_whole = 2 * stats.t.sf(abs(whole.mean()) / error, count - 1) if error else 1.0

    a, b = blocks(a), blocks(b)
    differ = (a != b).any(0)
    d, level = (a - b)[:, differ], (a + b).mean(0)[differ]
    energy = (d**2).sum(0)
    ratio = d.sum(0) ** 2 / (energy + (count * ROUNDING * level) ** 2)
    variance = (2 - 2 * ((d**2 / energy) ** 2).sum(0)).sum()
    if variance < 1e-6:  # no block differs more than once: signs say nothing
        return float(p_whole)
    p_blocks = stats.gamma.sf(ratio.sum(), len(ratio) ** 2 / variance, scale=variance / len(ratio))
    return sidak([p_whole, p_blocks])


def blocks(x: np.ndarray) -> np.ndarray:
    """Sums (16, h, w) over blocks of pixels, each in one channel, of (16, H, W, 3); the last may be cut off."""
    _, height, width, _ = x.shape
    x = np.pad(x, ((0, 0), (0, -height % BLOCK), (0, -width % BLOCK), (0, 0)))
    x = x.reshape(len(x), x.shape[1] // BLOCK, BLOCK, -1, BLOCK, 3).sum((2, 4))
    row, column = np.indices(x.shape[1:3])
    return x[:, row, column, (row + column) % 3]


def sidak(p: Sequence[float]) -> float:
    """Probability that the least of so many independent p-values is as small as this (Šidák 1967)."""
    return float(-np.expm1(len(p) * np.log1p(-min(p)))) if min(p) < 1 else 1.0


def compare(name: str, pictures: Pictures) -> Comparison:
    """The numbers of one photograph. Raises InputError if there are pixels that are no numbers."""
    for which, picture in vars(pictures).items():
        if bad := int((~np.isfinite(picture)).any((0, 3)).sum()):
            raise InputError(f"{name}: {which}: {bad} pixels are NaN or infinite; check BSDF and mesh")
    photometric, unshadowed, path, direct = (p.astype(np.float64) for p in vars(pictures).values())
    level = path.mean() or photometric.mean() or 1.0
    difference, unexplained = photometric - path, photometric - direct
    noise = np.sqrt(2 / np.pi) * difference.std(0, ddof=1) / np.sqrt(BATCHES)  # mean of |x| for a normal x
    error = np.mean((linear_to_srgb(photometric.mean(0)) - linear_to_srgb(path.mean(0))) ** 2)
    return Comparison(
        name=name,
        radiance=float(path.mean()),
        difference=float(difference.mean() / level),
        absolute_difference=float(np.abs(difference.mean(0)).mean() / level),
        noise=float(noise.mean() / level),
        psnr=float(-10 * np.log10(max(error, 1e-10))),
        shadows=float((unshadowed - photometric).mean() / level),
        interreflection=float((path - direct).mean() / level),
        unexplained=float(unexplained.mean() / level),
        unexplained_noise=float(unexplained.mean((1, 2, 3)).std(ddof=1) / np.sqrt(BATCHES) / level),
        p_direct=agreement(photometric, direct),
        p_path=agreement(photometric, path),
    )


def total(rows: list[Comparison]) -> Comparison:
    """All photographs as one: shares of all the light, p-values corrected for their number."""
    column = {name: np.array([getattr(row, name) for row in rows]) for name in asdict(rows[0]) if name != "name"}
    weight = column["radiance"] / (column["radiance"].sum() or 1.0)
    shares = {name: float((weight * values).sum()) for name, values in column.items()}
    return Comparison(**shares | {
        "name": "all",
        "radiance": float(column["radiance"].mean()),
        "psnr": float(-10 * np.log10(np.mean(10 ** (-column["psnr"] / 10)))),
        "unexplained_noise": float(np.sqrt(((weight * column["unexplained_noise"]) ** 2).sum())),
        "p_direct": sidak(column["p_direct"]),
        "p_path": sidak(column["p_path"]),
    })  # fmt: skip


def percent(x: float) -> str:
    """A share."""
    return f"{100 * x:.2f} %"


def probability(p: float) -> str:
    """A p-value as far as it means anything."""
    return "p < 1e-12" if p < 1e-12 else f"p = {p:.2g}"


def table(rows: list[Comparison]) -> str:
    """The numbers as text, one line each; shares are of the radiance of `path`."""
    cells = [("", "radiance", "difference %", "absolute %", "noise %", "PSNR", "shadows %", "interreflection %",
              "unexplained %", "p direct", "p path")]  # fmt: skip
    cells += [(
        r.name, f"{r.radiance:.4g}", f"{100 * r.difference:+.2f}", f"{100 * r.absolute_difference:.2f}",
        f"{100 * r.noise:.2f}", f"{r.psnr:.1f} dB", f"{100 * r.shadows:.2f}", f"{100 * r.interreflection:.2f}",
        f"{100 * r.unexplained:+.3f} ± {100 * r.unexplained_noise:.3f}",
        *(probability(p).removeprefix("p ").removeprefix("= ") for p in (r.p_direct, r.p_path)),
    ) for r in rows]  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*cells)]
    return "\n".join("  ".join([c[0].ljust(widths[0]), *map(str.rjust, c[1:], widths[1:])]) for c in cells)


def verdict(rows: list[Comparison], everything: Comparison, significance: float) -> list[str]:
    """The findings in words."""
    p = probability(everything.p_direct)
    if everything.p_direct >= significance:
        direct = f"direct light agrees with path ({p})"
    else:
        worst = min(rows, key=lambda row: (row.p_direct, -abs(row.unexplained)))
        way = "brighter" if worst.unexplained > 0 else "darker"
        direct = (f"direct light DISAGREES with path ({p}), most of all in {worst.name}: "
                  f"photometric is {percent(abs(worst.unexplained))} {way} on average")  # fmt: skip
    doubt = ": are the lights' intensities true?" if everything.interreflection > IMPLAUSIBLE else ""
    return [
        direct,
        f"shadows take away {percent(everything.shadows)} of the light",
        f"interreflection is {percent(everything.interreflection)} of the light{doubt}",
    ]


COLUMNS = ("path", "photometric", "8 x difference", "shadows", "4 x interreflection", "32 x unexplained")
LEGEND = "Each photograph by its own exposure. Differences: red where photometric is brighter, blue where it is darker."


def strip(row: Comparison, pictures: Pictures) -> Image.Image:
    """One photograph's line of the contact sheet, exposed for itself. Red: photometric is brighter."""
    photometric, unshadowed, path, direct = (p.mean(0) for p in vars(pictures).values())
    white = np.quantile(path[path > 0], 0.98) if (path > 0).any() else 1.0

    def signed(x):
        return colormaps["RdBu_r"](0.5 + 0.5 * x.mean(-1) / white)[..., :3]

    cells = [
        linear_to_srgb(path / white),
        linear_to_srgb(photometric / white),
        signed(8 * (photometric - path)),
        linear_to_srgb((unshadowed - photometric) / white),
        linear_to_srgb(4 * (path - direct) / white),
        signed(32 * (photometric - direct)),
    ]
    height, width = path.shape[:2]
    factor = THUMBNAIL / max(height, width)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    method = Image.Resampling.BOX if factor < 1 else Image.Resampling.NEAREST
    line = Image.new("RGB", (len(COLUMNS) * (THUMBNAIL + 4), size[1] + 18))
    for k, cell in enumerate(cells):
        line.paste(Image.fromarray(to_bytes(cell)).resize(size, method), (k * (THUMBNAIL + 4), 16))
    text = "   ".join([
        row.name, f"difference {percent(row.difference)}", f"shadows {percent(row.shadows)}",
        f"interreflection {percent(row.interreflection)}", f"unexplained {percent(row.unexplained)}",
        f"({probability(row.p_direct)})",
    ])  # fmt: skip
    ImageDraw.Draw(line).text((2, 2), text, fill=(255, 255, 255))
    return line


def sheet(strips: list[Image.Image]) -> bytes:
    """The contact sheet as PNG: the lines below each other, in so many stacks that the sheet is about square."""
    width, height = strips[0].width + 12, max(line.height for line in strips)
    stacks = max(1, round(np.sqrt(len(strips) * height / width)))
    rows = -(-len(strips) // stacks)
    stacks = -(-len(strips) // rows)
    page = Image.new("RGB", (stacks * width - 12, rows * height + 32))
    draw = ImageDraw.Draw(page)
    for k, title in enumerate(COLUMNS * stacks):
        stack, column = divmod(k, len(COLUMNS))
        draw.text((stack * width + column * (THUMBNAIL + 4) + 2, 18), title, fill=(255, 220, 120))
    draw.text((2, 2), LEGEND, fill=(255, 220, 120))
    for k, line in enumerate(strips):
        page.paste(line, (k // rows * width, 32 + k % rows * height))
    buffer = io.BytesIO()
    page.save(buffer, "PNG")
    return buffer.getvalue()


def choose(sensors: list, names: Sequence[str]) -> list[int]:
    """Indices of the photographs with these ids or image names, all if there are none. Raises InputError."""
    for name in names:
        if not any(name in (s.id(), s.filename.name) for s in sensors):
            raise InputError(f"--photographs: there is no {name}; the first is called {sensors[0].id()}")
    return [k for k, s in enumerate(sensors) if not names or {s.id(), s.filename.name} & set(names)]


def main(arguments: Sequence[str]) -> int:
    """The command."""
    config = command.parse(ValidateConfig, arguments, "mi_ring.validate")
    path, out = config.scene, Path("out/validate") / command.name_of(config.scene)
    if path.is_dir():
        path, out = path / "scene.xml", path / "validate"
        if not path.is_file():
            raise InputError(f"{config.scene}: has no scene.xml; give the folder of a finished fit or a scene file")
    out = config.out or out
    scene, sensors = open_scene(path)
    chosen = choose(sensors, config.photographs)
    with writing(f"{out}: --out"):
        out.mkdir(parents=True, exist_ok=True)

    photographs, spp = Photographs.of(sensors), -(-config.spp // BATCHES)
    names = [sensor.filename.name for sensor in sensors]
    rows, strips = [], []
    for k in tqdm(chosen, desc="comparing", unit="photograph"):
        size = sensors[k].size
        scale = -(-max(size) // config.width)
        if min(size) < scale:
            raise InputError(f"--width: is {config.width}, too small for {names[k]} of {size[0]} x {size[1]} pixels")
        seed = 2 * BATCHES * (config.seed * len(sensors) + k) % 2**32
        pictures = render(scene, photographs, k, sensors[k], scale, spp, config.depth, seed)
        rows.append(compare(names[k], pictures))
        strips.append(strip(rows[-1], pictures))
    if not any(row.radiance > 0 or row.difference for row in rows):
        raise InputError(f"{path}: every photograph is black; check where the object is, cameras and lights")
    everything = total(rows)
    numbers = {
        "scene": str(path), "spp": spp * BATCHES, "width": config.width, "depth": config.depth, "seed": config.seed,
        "significance": config.significance, "all": asdict(everything), "photographs": [asdict(row) for row in rows],
    }  # fmt: skip
    replace(out / "validate.json", json.dumps(numbers, indent=1) + "\n")
    replace(out / "validate.png", sheet(strips))
    print(table([*rows, everything]))
    print("\n".join(verdict(rows, everything, config.significance)))
    print(f"{out}/validate.png, {out}/validate.json")
    return int(everything.p_direct < config.significance)


if __name__ == "__main__":
    command.run("mi_ring.validate", main)
