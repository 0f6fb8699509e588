"""Make a simulated phone capture with its truth: an object on the printed sheet, photographed by hand with the flash.

    python benchmarks/phone.py OUT [--object NAME|MESH] [--disturbances all|none|NAME,NAME…] [--ambient 0.03]
        [--views 40] [--size 1440x1080] [--seed 0] [--sheet board|random|white|none] [--turntable] [--spp N]
        [--no-exact]

Writes, in the frame of the sheet (mm, origin in its middle, x right, y up the page, z out of the paper):

    OUT/photos/                  the photographs as the phone writes them
    OUT/truth/mesh.ply           the object
    OUT/truth/masks/             true masks, with the distortion of the lens
    OUT/truth/transforms.json    cameras, lens, masks and flash (pl_pos [mm], pl_intensity with exposure and white
                                 balance), for `mi-ring convert transforms`: exact calibration
    OUT/truth/settings.json      settings, failed photographs, exposure and white balance
    OUT/exact/scene.xml          the same views without disturbances (but with the principal point), exactly
                                 calibrated, cropped as by `mi-ring photos`

Disturbances: sheet (sheet and table reflect light onto the object), ambient (room light), offset (the flash is beside
the lens), cone (the flash is weaker to the sides), lens (distortion), principal (point off the middle), exposure (and
white balance; EXIF has only the exposure), jpeg, noise, blur, failures (of 40 photographs one is blurred and one shows
something else). Without them: black room, flash in the lens, 8-bit PNG, object alone. With --turntable object and sheet
turn. The same seed gives the same files.
"""

import argparse
import json
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import phone_stage
from phone_stage import LensCamera, Stage

# isort: split
import mitsuba as mi
import numpy as np
from make_pot2 import write_ply
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from tqdm import tqdm

from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.geometry.camera import Camera
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.photogrammetry.capture_files import crop_windows
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Files, Shot

DISTURBANCES = (
    "sheet", "ambient", "offset", "cone", "lens", "principal", "exposure", "jpeg", "noise", "blur", "failures"
)  # fmt: skip
VIEW_ANGLE = 65.0  #: horizontal [degrees]
FLASH = np.array([20.0, 15.0, 0.0])  #: from the lens, camera's axes: left, up, forward [mm]
CONE = 2.0  #: power of the cosine
DISTORTION = -0.04, 0.006  #: k1, k2
PRINCIPAL = np.array([2.4, -1.8]) / 1440  #: off the middle [widths of the picture]
DISTANCE, SCATTER = 350.0, 50.0  #: from the camera to what it is aimed at, and how much that varies [mm]
WHITE = 0.85  #: what white paper that faces the flash at `DISTANCE` is in the file, linear
RINGS = (20.0, 42.0, 64.0)  #: elevations [degrees]
WELL, READ = 6000.0, 4.0  #: electrons of a white pixel and of the noise of reading
BLUR, SHAKEN = 0.5, 45 / 1440  #: motion during exposure [px], and of the photograph that fails [widths]
QUALITY, SHUTTER = 92, 1 / 50  #: of the JPEG; exposure time [s]
OPPOSITE = np.diag([-1.0, 1.0, -1.0, 1.0])  #: Mitsuba's camera axes in OpenGL's


@dataclass(frozen=True)
class Settings:
    """What to simulate."""

    object: str = "pot2"
    disturbances: tuple[str, ...] = DISTURBANCES
    ambient: float = 0.03  #: the room's light on the object, mean over all directions, by the flash's that faces it
    views: int = 40
    size: tuple[int, int] = (1440, 1080)
    seed: int = 0
    sheet: str = "board"
    turntable: bool = False
    spp: int = 4
    exact: bool = True  #: make the exact capture, too

    def has(self, disturbance: str) -> bool:
        """Is it switched on?"""
        return disturbance in self.disturbances

    @property
    def failed(self) -> dict[int, str]:
        """Photographs that are of no use, and why."""
        return {self.views // 3: "blurred", 2 * self.views // 3: "elsewhere"} if self.has("failures") else {}

    def rng(self, what: int, k: int = 0) -> np.random.Generator:
        """Of one purpose and photograph, so that a switch changes nothing else."""
        return np.random.default_rng([self.seed, what, k])


def poses(settings: Settings, height: float) -> Iterator[tuple[np.ndarray, float]]:
    """Camera-to-world matrices, Mitsuba's axes, and how far the room turned with the camera [radians]."""
    share = [0.5, 0.5] if settings.turntable else [0.4, 0.35, 0.25]
    ring = np.searchsorted(np.cumsum(share), (np.arange(settings.views) + 0.5) / settings.views)
    for k in range(settings.views):
        rng, own = settings.rng(2, k), np.flatnonzero(ring == ring[k])
        azimuth = 2 * np.pi * (k - own[0] + 0.37 * ring[k]) / len(own)
        if settings.turntable:
            elevation, distance, roll, aim = np.radians(28 + 24 * ring[k]), DISTANCE, 0.0, np.zeros(3)
        else:
            azimuth += rng.normal(0, 0.25 * 2 * np.pi / len(own))
            elevation = np.radians(np.clip(RINGS[ring[k]] + rng.normal(0, 3.5), 15, 70))
            distance = DISTANCE + rng.uniform(-SCATTER, SCATTER)
            roll, aim = rng.normal(0, np.radians(4)), rng.uniform(-12, 12, 3)
        away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        target = np.array([0, 0, 0.45 * height]) + aim
        position = target + distance * away
        if settings.failed.get(k) == "elsewhere":
            target = position + distance * np.array([-np.sin(azimuth), np.cos(azimuth), -0.8])
        forward = (target - position) / np.linalg.norm(target - position)
        left = np.cross([0, 0, 1], forward)
        left /= np.linalg.norm(left)
        up = np.cross(forward, left)
        to_world = np.eye(4)
        to_world[:3] = np.stack([np.cos(roll) * left + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * left,
                                 forward, position], 1)  # fmt: skip
        yield to_world, azimuth if settings.turntable else 0.0


def shot_of(settings: Settings, k: int, to_world: np.ndarray) -> LensCamera:
    """Photograph `k`: its camera, lens and motion."""
    width, height = settings.size
    focal = width / 2 / np.tan(np.radians(VIEW_ANGLE / 2))
    centre = np.array([width, height]) / 2 + (PRINCIPAL * width if settings.has("principal") else 0)
    length = BLUR if settings.has("blur") else 0.0
    length = SHAKEN * width if settings.failed.get(k) == "blurred" else length
    angle = settings.rng(3, k).uniform(0, 2 * np.pi)
    return LensCamera(Camera(to_world, np.full(2, focal), centre, settings.size),
                DISTORTION if settings.has("lens") else (0.0, 0.0),
                (length * np.cos(angle), length * np.sin(angle)))  # fmt: skip


def intensity() -> float:
    """Of the flash on its axis [mm²], in units of the file's full scale."""
    return WHITE * np.pi / phone_stage.PAPER * DISTANCE**2


def gains(settings: Settings, k: int) -> tuple[float, np.ndarray]:
    """Exposure of photograph `k`, and its white balance (3,)."""
    rng = settings.rng(4, k)
    exposure, balance = rng.uniform(0.9, 1.1), rng.uniform(0.96, 1.04, 3)
    return (exposure, balance) if settings.has("exposure") else (1.0, np.ones(3))


def flash_at(settings: Settings, camera: Camera) -> np.ndarray:
    """Where the flash is (3,) [mm]."""
    return camera.position + (camera.to_world[:3, :3] @ FLASH if settings.has("offset") else 0)


def photograph(stage: Stage, settings: Settings, shot: LensCamera, k: int) -> np.ndarray:
    """What the sensor sees of photograph `k`: linear (H, W, 3), 1 = full scale, noise and all."""
    camera = shot.camera
    power = CONE if settings.has("cone") else 0.0
    stage.flash.aim(flash_at(settings, camera), camera.forward, intensity(), power)
    seed, spp = settings.seed * 10_000 + 2 * k, settings.spp
    if settings.failed.get(k) == "blurred":
        spp = 36  # else one would see single samples
    linear = stage.radiance(shot, spp, seed)
    if settings.has("ambient") and settings.ambient:
        mean = settings.ambient * intensity() / DISTANCE**2 / np.pi
        linear = linear + mean * stage.room_radiance(shot, spp, seed + 1)
    exposure, balance = gains(settings, k)
    linear = linear * (exposure * balance)
    if settings.has("noise"):
        rng = settings.rng(5, k)
        linear = (rng.poisson(WELL * np.clip(linear, 0, 4)) + rng.normal(0, READ, linear.shape)) / WELL
    return linear


def write_photograph(path: Path, linear: np.ndarray, exposure: float) -> None:
    """As sRGB, 8 bits; a JPEG says how it was taken."""
    picture = Image.fromarray(to_bytes(linear_to_srgb(linear)))
    if path.suffix == ".png":
        return picture.save(path)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Simulated", "Simulated"
    exif.get_ifd(0x8769).update({
        0x829A: IFDRational(round(1e6 * SHUTTER * exposure), 10**6), 0x829D: IFDRational(18, 10), 0x8827: 200,
        0x9209: 1, 0x920A: IFDRational(57, 10), 0xA405: round(18 / np.tan(np.radians(VIEW_ANGLE / 2))),
    })  # fmt: skip
    return picture.save(path, quality=QUALITY, subsampling="4:2:0", exif=exif)


def write_mask(path: Path, coverage: np.ndarray) -> None:
    """255 where at least half of a pixel shows the object."""
    Image.fromarray(np.where(coverage >= 0.5, 255, 0).astype(np.uint8)).save(path)


def crop(scene: Path) -> None:
    """Crop photographs and masks of a scene file to the object, as `mi_ring.photos` does."""
    tree = ElementTree.parse(scene)
    sensors = tree.getroot().findall("sensor")

    def files(sensor: ElementTree.Element) -> dict[str, ElementTree.Element]:
        return {e.get("name"): e for e in sensor.findall("string") if e.get("name") in ("filename", "mask", "valid")}

    masks = [np.array(Image.open(scene.parent / files(sensor)["mask"].get("value"))) for sensor in sensors]
    for sensor, window in zip(sensors, crop_windows(masks, [mask.shape[::-1] for mask in masks])):
        left, top, width, height = window[:4]
        for kind, file in files(sensor).items():
            path = Path(f"cropped/{kind}/{sensor.get('id')}.png")
            (scene.parent / path).parent.mkdir(parents=True, exist_ok=True)
            picture = Image.open(scene.parent / file.get("value"))
            picture.crop((left, top, left + width, top + height)).save(scene.parent / path)
            file.set("value", str(path))
        for field, first in (("cx", left), ("cy", top)):
            centre = sensor.find(f"float[@name='{field}']")
            centre.set("value", str(float(centre.get("value")) - first))
        for field, side in (("width", width), ("height", height)):
            sensor.find(f"film/integer[@name='{field}']").set("value", str(side))
    tree.write(scene)


def make_capture(out: Path, settings: Settings) -> None:
    """Write a capture into a folder, whose former content is deleted."""
    photos, truth, exact = out / "photos", out / "truth", out / "exact"
    for folder in (photos, truth, exact):
        shutil.rmtree(folder, ignore_errors=True)
    for folder in (photos, truth / "masks", *[exact / "images", exact / "masks"] * settings.exact):
        folder.mkdir(parents=True)
    sheet = settings.sheet if settings.has("sheet") else "bare"
    stage = Stage(settings.object, sheet, settings.turntable, settings.seed)
    alone = stage if stage.bare else Stage(settings.object, "bare", False, settings.seed)
    write_ply(stage.mesh, truth / "mesh.ply")
    suffix = ".jpg" if settings.has("jpeg") else ".png"
    elements, frames, taken = [], [], {}
    for k, (to_world, angle) in enumerate(tqdm(list(poses(settings, stage.mesh.extents[2])), disable=None)):
        name, shot = f"{k:03}", shot_of(settings, k, to_world)
        if angle:
            stage.turn(angle)
        exposure, balance = gains(settings, k)
        write_photograph(photos / (name + suffix), photograph(stage, settings, shot, k), exposure)
        write_mask(truth / "masks" / f"{name}.png", stage.coverage(LensCamera(shot.camera, shot.distortion)))
        taken[name + suffix] = {"exposure": exposure, "balance": balance.tolist(), "failed": settings.failed.get(k)}
        if k in settings.failed:
            continue
        camera = shot.camera
        frames.append({
            "file_path": f"../photos/{name}{suffix}", "mask_path": f"masks/{name}.png",
            "transform_matrix": (to_world @ OPPOSITE).tolist(), "pl_pos": flash_at(settings, camera).tolist(),
            "pl_intensity": (intensity() * exposure * balance).tolist(),
        })  # fmt: skip
        if not settings.exact:
            continue
        pinhole = LensCamera(camera)
        alone.flash.aim(camera.position, camera.forward, intensity(), 0.0)
        linear = alone.radiance(pinhole, max(settings.spp, 9), settings.seed * 10_000 + 2 * k + 1)
        write_photograph(exact / "images" / f"{name}.png", linear, 1.0)
        write_mask(exact / "masks" / f"{name}.png", alone.coverage(pinhole))
        light = Light("point", camera.position, np.full(3, intensity()))
        files = Files(Path(f"images/{name}.png"), Path(f"masks/{name}.png"))
        elements.append(photograph_element(Shot(name, camera, light, files=files, calibrated=True)))
    if settings.exact:
        (exact / "truth").symlink_to("../truth")
        (exact / "scene.xml").write_bytes(scene_bytes(scene_element(elements)))
        crop(exact / "scene.xml")
    (fx, fy), (cx, cy), (k1, k2) = shot.camera.focal, shot.camera.centre, shot.distortion
    lens = {"camera_model": "OPENCV", "w": settings.size[0], "h": settings.size[1], "fl_x": fx, "fl_y": fy, "cx": cx,
            "cy": cy, "k1": k1, "k2": k2}  # fmt: skip
    (truth / "transforms.json").write_text(json.dumps(lens | {"frames": frames}, indent=1))
    (truth / "settings.json").write_text(json.dumps(asdict(settings) | {
        "flash_offset_mm": (FLASH * settings.has("offset")).tolist(), "cone_power": CONE * settings.has("cone"),
        "photographs": taken}, indent=1))  # fmt: skip


def parse(arguments: list[str] | None = None) -> tuple[Path, Settings]:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument("--object", default="pot2", help=f"mesh file, y up, or one of {', '.join(phone_stage.OBJECTS)}")
    parser.add_argument("--disturbances", default="all", help=f"all, none, or some of {','.join(DISTURBANCES)}")
    parser.add_argument("--ambient", type=float, default=Settings.ambient, help="light of the room by the flash's")
    parser.add_argument("--views", type=int, default=Settings.views, help="number of photographs")
    parser.add_argument("--size", default="1440x1080", help="WIDTHxHEIGHT [px]")
    parser.add_argument("--seed", type=int, default=Settings.seed)
    sheets = "board", "random", "white", "none"
    parser.add_argument("--sheet", default="board", choices=sheets, help="what lies on the table")
    parser.add_argument("--turntable", action="store_true", help="the object turns, camera and light stand")
    parser.add_argument("--spp", type=int, default=Settings.spp, help="paths per pixel, a square number")
    parser.add_argument("--no-exact", dest="exact", action="store_false", help="leave out the exact capture")
    options = vars(parser.parse_args(arguments))
    chosen = {"all": DISTURBANCES, "none": ()}.get(options["disturbances"], options["disturbances"].split(","))
    if unknown := set(chosen) - set(DISTURBANCES):
        parser.error(f"--disturbances: {', '.join(unknown)}: must be all, none, or some of {','.join(DISTURBANCES)}")
    options |= {"disturbances": tuple(chosen), "size": tuple(int(side) for side in options["size"].split("x"))}
    return options.pop("out"), Settings(**options)


if __name__ == "__main__":
    mi.set_log_level(mi.LogLevel.Warn)
    make_capture(*parse())
