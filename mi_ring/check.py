"""Say whether a capture is usable, and what is wrong with it: `python -m mi_ring.check SCENE.xml`."""

import copy
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image, ImageDraw
from scipy import ndimage
from tyro.conf import Positional, arg

from mi_ring import capture, command
from mi_ring.capture import Capture, camera_of, linear_to_srgb, to_bytes
from mi_ring.errors import InputError
from mi_ring.evaluate import hits, scene_of
from mi_ring.hull import WIDTH, Hull, NoHull, Silhouette, evenly, shrink, small, thinned
from mi_ring.results import replace, writing

CELL = 200  # of the contact sheet [px]
CLIPPED, DARK, AMBIENT, CONFORMS = 0.1, 0.5, 0.05, 0.9  # shares beyond which something is said


@dataclass(frozen=True)
class CheckConfig:
    """Say whether a capture is usable, and what is wrong with it: a table, findings and a contact sheet.

    The table: distance of the camera and of the light from the object, in its radii; angle between the two [deg]; share
    of the photograph that is object; shares of the object that are clipped, and dark; brightness of the background, in
    that of the object; brightness for the light it gets, in that of the others; share of the mask that the other masks
    agree to. The contact sheet: masks outlined in red, the visual hull in green. The exit status is 1 if there is
    something to mend.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs."""
    out: Path | None = None
    """Picture to write. Default: out/check/<name>.png."""
    masks: Literal["auto", "given", "none"] = "auto"
    """given: those of the scene, if any; auto: the same, but if it has none the object is what is brighter than a dark
    room; none: as if it had none."""


@dataclass
class Row:
    """What there is to say of one photograph. Distances are in radii of the normalising sphere."""

    name: str
    distance: float  #: from the camera to the object
    light: float  #: from the light to the object; infinite if it is distant
    angle: float  #: between light and camera, seen from the object [deg]
    object: float | None  #: share of the photograph that is object
    clipped: float  #: share of the object that is clipped
    dark: float  #: share of the object that is black, or nearly
    background: float | None  #: brightness of what is not object, in that of the object
    brightness: float  #: brightness of the object, for the light it gets
    agreement: float | None  #: share of the mask that the other masks agree to


HEADS = (
    "photograph", "distance", "light", "angle", "object", "clipped", "dark", "background", "brightness", "agreement",
)


def agreements(scene: Capture) -> tuple[dict[str, float], list[str]]:
    """Of each mask, by its file, the share that the others agree to; and what is wrong with all of them.

    A single one that is wrong spoils the hull for all. It is told by a hull for which some may be wrong.
    """
    if not scene.hull:
        return {}, []
    silhouettes = [small(silhouette) for silhouette in scene.silhouettes()]
    pixels = max(16, 12800 // len(silhouettes))

    def shares(hull):
        return (hull.shortfall(silhouettes, pixels) < 1).mean(1)

    agree, why = shares(scene.hull), None
    if scene.whole and agree.min() < CONFORMS:
        why = mistake(silhouettes) if np.median(agree) < CONFORMS else None
        if not why:
            tolerant = copy.copy(scene.hull)
            tolerant.wrong = max(0.1, 1.01 / len(tolerant.silhouettes))
            robust = shares(tolerant)
            if np.median(robust) >= CONFORMS:
                agree = robust
            else:
                why = "cameras or masks are wrong"
    wrong = [f"The masks agree to {agree.mean():.0%} only: {why}"] if why else []
    return {silhouette.name: float(a) for silhouette, a in zip(silhouettes, agree)}, wrong


def measure(scene: Capture, center: np.ndarray, radius: float, agreement: dict[str, float]) -> list[Row]:
    """The rows of all photographs."""
    lights = np.array(scene.photographs.lights).reshape(-1, 8)
    rows = []
    for k, (sensor, name, light) in enumerate(zip(scene.sensors, scene.names, lights)):
        to_camera = camera_of(sensor)[0][:3, 3] - center
        to_light = light[:3] if light[3] else light[:3] - center
        away = np.linalg.norm(to_light)
        cosine = to_camera @ to_light / (np.linalg.norm(to_camera) * max(away, 1e-12))
        rgb, saturated, mask, masked = (t[0].numpy() for t in scene.observe([k], -(-max(sensor.size) // WIDTH)))
        image = rgb.max(-1)
        inside = mask > 0.5 if masked else image > 0.02 * image.max()
        outside = ~ndimage.binary_dilation(inside, iterations=3) if masked else None
        level = float(np.quantile(image[inside], 0.9)) if inside.any() else 0.0  # what is lit, not in shadow
        around = None if outside is None or not outside.any() else float(np.median(image[outside]))
        received = float(light[4:7].mean()) / (1.0 if light[3] else max(away, 1e-12) ** 2)
        rows.append(Row(
            name=name, distance=float(np.linalg.norm(to_camera) / radius),
            light=float("inf") if light[3] else float(away / radius),
            angle=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
            object=float(inside.mean()) if masked else None,
            clipped=float(saturated.any(-1)[inside].mean()) if inside.any() else 0.0,
            dark=float((image[inside] < 0.02 * np.quantile(image[inside], 0.95)).mean()) if inside.any() else 1.0,
            background=None if around is None else around / max(level, 1e-9),
            brightness=level / max(received, 1e-30), agreement=agreement.get(scene.outline(k)),
        ))  # fmt: skip
    return rows


#: What a camera-to-world matrix may be by mistake, and the one that it should have been.
MATRICES = {
    "": lambda m: m,
    "to_world is world-to-camera: invert it": np.linalg.inv,
    "the rotation in to_world is transposed: transpose its upper left 3 x 3": lambda m: np.block(
        [[m[:3, :3].T, m[:3, 3:]], [m[3:]]]
    ),
}
AXES = {
    "": (1, 1, 1),
    "its axes are OpenCV's (COLMAP's), x right, y down: to_world @ diag(-1, -1, 1, 1)": (-1, -1, 1),
    "its axes are OpenGL's (NeRF's, Blender's), x right, y up: to_world @ diag(-1, 1, -1, 1)": (-1, 1, -1),
    "its y and z are flipped: to_world @ diag(1, -1, -1, 1)": (1, -1, -1),
}
#: Other mistakes: what a silhouette should have been.
OTHERS = {
    "cx and cy are exchanged": lambda s: s._replace(centre=s.centre[[1, 0]]),
    "fx, fy, cx, cy are for photographs of half the size: double them": lambda s: s._replace(
        focal=2 * s.focal, centre=2 * s.centre
    ),
    "fx, fy, cx, cy are for photographs of twice the size: halve them": lambda s: s._replace(
        focal=s.focal / 2, centre=s.centre / 2
    ),
    "photographs or masks are upside down": lambda s: s._replace(mask=s.mask[::-1]),
    "photographs or masks are mirrored": lambda s: s._replace(mask=s.mask[:, ::-1]),
}


def agreement(silhouettes: Sequence[Silhouette]) -> float:
    """Share of the masks' pixels that all masks agree to; 0 if there is no hull."""
    try:
        return float((Hull(silhouettes, "").shortfall(samples=48) < 1).mean())
    except InputError:
        return 0.0


def mistake(silhouettes: Sequence[Silhouette]) -> str | None:
    """The mistake with the cameras that explains why the masks do not agree, and its mend; None if none does."""
    some = thinned(silhouettes, 32, 96)
    guesses = {name: [change(s) for s in some] for name, change in OTHERS.items()}
    for first, change in MATRICES.items():
        for second, axes in AXES.items():
            name = "; then ".join(part for part in (first, second) if part)
            guesses[name] = [s._replace(matrix=change(s.matrix) @ np.diag([*axes, 1.0])) for s in some]
    as_it_is = agreement(guesses.pop(""))
    scores = {name: agreement(guess) for name, guess in guesses.items()}
    best = max(scores, key=scores.get)
    if scores[best] < max(CONFORMS, as_it_is + 0.05):
        return None
    return f"{best} (the masks then agree to {scores[best]:.0%})"


def half_pixel(hull: Hull) -> str | None:
    """Are all principal points off by half a pixel? Then outlines do not quite meet the hull.

    Of photographs that are shrunk for the hull it cannot be told, and matters little.
    """
    gaps, hull, some = {}, copy.copy(hull), evenly(len(hull.silhouettes), 32)
    silhouettes, hull.distances = ([values[k] for k in some] for values in (hull.silhouettes, hull.distances))
    for shift in (-0.5, 0.0, 0.5):
        hull.silhouettes = [s._replace(centre=s.centre + shift) for s in silhouettes]
        gaps[shift] = float(np.mean(hull.shortfall(pixels=50, samples=96, outline=True).clip(max=2)))
    best = min(gaps, key=gaps.get)
    if gaps[0.0] > 0.01 and gaps[best] < 0.5 * gaps[0.0]:
        do = "add 0.5 to" if best > 0 else "subtract 0.5 from"
        return f"principal points seem off by half a pixel: {do} cx and cy (the first pixel's centre is 0.5, 0.5)"
    return None


def units(scene: Capture, center: np.ndarray) -> str | None:
    """Are the lights in other units than the cameras?"""
    lights = np.array(scene.photographs.lights).reshape(-1, 8)
    cameras = np.stack([camera_of(sensor)[0][:3, 3] for sensor in scene.sensors])
    point = lights[:, 3] == 0
    if not point.any() or np.ptp(cameras, axis=0).max() == 0:
        return None
    away = np.linalg.norm(cameras[point] - center, axis=1)

    def beside(scale):  # distance from light to camera, for that from camera to object
        return float(np.median(np.linalg.norm(scale * lights[point, :3] - cameras[point], axis=1) / away))

    scale = min((0.001, 0.01, 0.1, 1, 10, 100, 1000), key=beside)
    if scale != 1 and beside(1) > 0.8 and beside(scale) < 0.5:
        return (f"lights are in other units than cameras: multiply their positions by {scale:g} "
                f"and their intensities by {scale**2:g}")  # fmt: skip
    return None


def facing(scene: Capture, center: np.ndarray) -> str | None:
    """Do the cameras look at the object?"""
    cameras = np.stack([camera_of(sensor)[0] for sensor in scene.sensors])
    away = ((center - cameras[:, :3, 3]) * cameras[:, :3, 2]).sum(1) < 0
    if away.mean() > 0.5:
        return (f"{away.sum()} of {len(away)} cameras look away from the object: z of to_world is forward, here; "
                "of OpenGL's (NeRF's, Blender's) axes: to_world @ diag(-1, 1, -1, 1)")  # fmt: skip
    return f"{', '.join(np.array(scene.names)[away][:5])}: looking away from the object" if away.any() else None


def findings(scene: Capture, rows: list[Row], center: np.ndarray) -> list[str]:
    """What is to be mended, each in one line."""
    found = []
    agree = [row.agreement for row in rows if row.agreement is not None]
    if scene.whole and agree and np.median(agree) >= CONFORMS:  # those of bright parts only need not agree
        strays = [row for row in rows if row.agreement is not None and row.agreement < CONFORMS]
        if not strays and max(sensor.size[0] for sensor in scene.sensors) <= WIDTH:
            found += filter(None, [half_pixel(scene.hull)])
        for row in strays:
            found.append(f"{row.name}: the others agree to {row.agreement:.0%} of its mask: pose or mask is wrong")
    found += filter(None, [units(scene, center)])
    lit = [row for row in rows if row.angle < 60 and row.brightness > 0]  # not from behind
    typical = np.median([row.brightness for row in lit]) if lit else 1.0
    for row in lit:
        if not typical / 4 < row.brightness < 4 * typical:
            times = f"{row.brightness / typical:.2g} times as bright as the others"
            found.append(f"{row.name}: is {times}, for the light it gets: its exposure or its light is wrong")
    for name, limit, text in (
        ("clipped", CLIPPED, "of the object is over-exposed; expose less"),
        ("dark", DARK, "of the object is black: under-exposed, or unlit"),
        ("background", AMBIENT, "of the object's brightness is in the background: the room was not dark"),
    ):
        shares = [value for row in rows if (value := getattr(row, name)) is not None]
        if shares and np.median(shares) > limit:
            found.append(f"{np.median(shares):.0%} {text}")
    views = len({camera_of(sensor)[0].tobytes() for sensor in scene.sensors})
    if views < 8:
        found.append(f"{views} views are few: about 30 from all around are needed for a closed surface")
    return found


def plan(scene: Capture, center: np.ndarray, radius: float) -> Image.Image:
    """Cameras (with the way they look), lights and the normalising sphere from above and from two sides."""
    cameras = np.stack([camera_of(sensor)[0] for sensor in scene.sensors])
    lights = np.array(scene.photographs.lights).reshape(-1, 8)
    reach = max(np.linalg.norm(cameras[:, :3, 3] - center, axis=1).max(), 1.5 * radius)
    away = np.where(lights[:, 3:4] > 0, center + reach * lights[:, :3], lights[:, :3])
    figure = Figure(figsize=(12, 4), dpi=100)
    canvas, panels = FigureCanvasAgg(figure), figure.subplots(1, 3)
    for panel, (a, b) in zip(panels, ((0, 1), (0, 2), (1, 2))):
        panel.add_patch(Circle(center[[a, b]], radius, color="tab:green", alpha=0.3))
        panel.scatter(*away[:, [a, b]].T, s=12, c="tab:orange", label="lights")
        panel.quiver(*cameras[:, [a, b], 3].T, *(0.25 * reach * cameras[:, [a, b], 2]).T, color="tab:blue", angles="xy",
                     scale_units="xy", scale=1, width=0.004, label="cameras")  # fmt: skip
        panel.set_xlabel("xyz"[a])
        panel.set_ylabel("xyz"[b])
        panel.set_aspect("equal", "datalim")
        panel.autoscale_view()
    panels[0].legend(loc="upper right", fontsize=8)
    figure.tight_layout()
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def sheet(scene: Capture, rows: list[Row], center: np.ndarray, radius: float) -> Image.Image:
    """The contact sheet: where everything is; on photographs the visual hull in green and the mask's outline in red."""
    top = plan(scene, center, radius)
    try:
        mesh = scene.hull.surface() if scene.hull else None
    except InputError:
        mesh = None
    hull = mesh and scene_of(mesh.vertices, mesh.faces)
    some = scene.spread()
    columns = max(1, min(top.width // CELL, len(some)))
    page = Image.new("RGB", (max(top.width, columns * CELL), top.height + -(-len(some) // columns) * (CELL + 16)))
    page.paste(top)
    white = 3 * scene.exposure()
    for place, k in enumerate(some):
        scale = max(1, max(scene.sensors[k].size) // CELL)
        observed, _, mask, masked = scene.observe([k], scale)
        picture = linear_to_srgb(observed[0].numpy() / white)
        if hull:
            seen = hits(hull, scene.photograph(k, scale))[0].reshape(picture.shape[:2])
            picture = 0.7 * picture + 0.3 * seen[..., None] * np.array([0.1, 1.0, 0.2])
        if masked:
            inside = mask[0].numpy() > 0.5
            picture[inside & ~ndimage.binary_erosion(inside)] = (1.0, 0.2, 0.2)
        cell = Image.fromarray(to_bytes(picture))
        cell.thumbnail((CELL, CELL))
        x, y = place % columns * CELL, top.height + place // columns * (CELL + 16)
        page.paste(cell, (x, y + 16))
        fits = "" if rows[k].agreement is None else f"  {rows[k].agreement:.0%}"
        good = rows[k].agreement is None or rows[k].agreement >= CONFORMS
        ImageDraw.Draw(page).text((x + 2, y + 2), rows[k].name + fits, fill=(255, 255, 255) if good else (255, 90, 90))
    return page


def table(rows: list[Row]) -> str:
    """The rows as text."""
    typical = np.median([row.brightness for row in rows])

    def cells(row):
        yield row.name
        yield f"{row.distance:.2f}"
        yield "distant" if np.isinf(row.light) else f"{row.light:.2f}"
        yield f"{row.angle:.0f}"
        for share in (row.object, row.clipped, row.dark, row.background):
            yield "-" if share is None else f"{share:.1%}"
        yield f"{row.brightness / typical:.2f}" if typical else "-"
        yield "-" if row.agreement is None else f"{row.agreement:.0%}"

    lines = [HEADS, *map(tuple, map(cells, rows))]
    widths = [max(map(len, column)) for column in zip(*lines)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in lines)


def drop_empty(scene: Capture) -> list[str]:
    """Forget masks with nothing in them and return the names of their photographs."""
    empty = [k for k, mask in enumerate(scene.masks) if mask is not None and not (shrink(mask, WIDTH)[0] > 127).any()]
    for k in empty:
        scene.masks[k] = None
    return [scene.names[k] for k in empty]


def main(arguments: Sequence[str]) -> int:
    """The command. Returns its exit status: 1 if there is something to mend."""
    config = command.parse(CheckConfig, arguments, "mi_ring.check")
    out = config.out or Path("out/check") / f"{command.name_of(config.scene)}.png"
    scene = capture.load(config.scene, masks=config.masks)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: --out: must end in .png")
    if out.resolve() in {file.resolve() for s in scene.sensors for file in (s.filename, s.mask) if file}:
        raise InputError(f"{out}: --out: is one of the scene's own pictures; choose another file")
    found = [f"{name}: its mask is empty: next to nothing in it is above 127" for name in drop_empty(scene)]
    try:
        center, radius = scene.sphere()
    except NoHull as error:
        center, radius = capture.sphere_of_cameras(scene)
        found += [] if scene.whole else [str(error)]
    agreement, wrong = agreements(scene)
    rows = measure(scene, center, radius, agreement)
    found += wrong or filter(None, [facing(scene, center)])
    found += findings(scene, rows, center)
    page = sheet(scene, rows, center, radius)
    with writing(f"{out}: --out"):
        out.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    page.save(buffer, "PNG")
    replace(out, buffer.getvalue())
    print(table(rows))
    given = sum(mask is not None for mask in scene.masks)
    if scene.threshold is not None:
        print("\nMasks: found by brightness, for the room was dark")
    else:
        print(f"\nMasks: {given} of {len(rows)} photographs" + ("" if given else "; the start will be a guess"))
    print("Object: centre ({:.5g}, {:.5g}, {:.5g}), radius about {:.5g}".format(*center, radius))
    print("\n".join(f"To mend: {line}" for line in found) or "Nothing to mend found.")
    print(f"Contact sheet: {out}")
    return int(bool(found))


if __name__ == "__main__":
    command.run("mi_ring.check", main)
