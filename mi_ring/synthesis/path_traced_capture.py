"""Path traces a synthetic capture of a known object: photographs, masks, scene file and ground truth."""

import hashlib
import json
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple, cast

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.capture import scenefile
from mi_ring.capture.emitter_elements import Element, emitter_element, numbers, room_elements
from mi_ring.capture.scenefile import move_names
from mi_ring.errors import InputError
from mi_ring.foreign import reading
from mi_ring.geometry.camera import Camera
from mi_ring.images import read_image, to_bytes, write_image
from mi_ring.rendering.spherical_harmonics import BASIS, room_envmap
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Files, Response, Shot
from mi_ring.scene.xml_elements import load_element
from mi_ring.synthesis import light_sources
from mi_ring.synthesis.degradation import HALF_LIMIT, encode, exposures, miscalibrated, with_noise
from mi_ring.synthesis.materials import COLOURED, PLAIN, load_material, pattern_of
from mi_ring.synthesis.object_on_table import ObjectOnTable, load_object, shape_of, table_elements
from mi_ring.synthesis.options import SynthesizeConfig
from mi_ring.synthesis.tracing import LensCamera
from mi_ring.synthesis.viewpoints import poses
from mi_ring.system.files import quoted, read_json, write_file, writing
from mi_ring.system.progress import progress

LAMP_SEED_STEP = 100_003  #: between the seeds of one photograph's images under different lamps
TRIALS, TRIAL_SCALE = 8, 8  #: number of photographs that determine the exposure, and factor by which they are smaller
SETTINGS = "truth/settings.json"  #: the options of a capture, to recognise the command that continues it
#: Patterns of the names of further files in files other than XML, by suffix.
REFERENCES = {
    ".obj": rb"^mtllib\s+(.+?)\s*$", ".mtl": rb"^\s*(?i:map_kd)\s+(.+?)\s*$",
    ".gltf": rb"\"uri\"\s*:\s*\"([^\"]{1,500})\"", ".ply": rb"^comment (?i:texturefile) (.+?)\s*$",
}  # fmt: skip


class PlannedPhotograph(NamedTuple):
    """A photograph to render: camera, light, names and random seed."""

    camera: Camera
    light: Light  #: brings 1 W/m² to the object
    name: str
    file: str  #: name of the image file
    seed: int


class Studio:
    """The object, lights, room and cameras that the options describe, and functions that render them.

    Its constructor reads the mesh and the materials. Raises InputError if a file cannot be read.
    """

    def __init__(self, config: SynthesizeConfig) -> None:
        self.config = config
        self.mesh, colours, self.placed = load_object(config.mesh, config.radius, config.smooth)
        default = PLAIN if colours is None else COLOURED
        bsdf, pattern = load_material(config.material or default, "--material", colours is not None), None
        if config.second:
            second = load_material(config.second, "--second", colours is not None)
            pattern = pattern_of(config.pattern, self.mesh.vertices, config.bands, "xyz".index(config.up), "--pattern")
            bsdf = pattern.blend(bsdf, second)
        self.shape = shape_of(self.mesh, colours, bsdf, pattern)
        self.environment = self.environment_element() if config.environment else None  #: replaces all other lights
        turning = config.cameras == "turntable"
        self.room, self.windows = light_sources.random_room(config.room_kind, turning, self.random(1))
        self.room_level = config.room / np.pi  #: mean radiance of the room; the photographs' light brings 1 W/m²
        self.tables: list[Element] = []  #: elements of the scene file
        self.spp = int(np.ceil(np.sqrt(config.spp))) ** 2  #: paths per pixel, a square number
        self.gains = exposures(config.views, config.wrong_exposure, self.random(6))  #: (views, 3)

    @property
    def lit(self) -> bool:
        """True if photographs have lights of their own."""
        return self.environment is None and self.config.light != "none"

    def random(self, *purpose: int) -> np.random.Generator:
        """Make a random generator from the option --seed and the integers `purpose`.

        Each purpose, such as cameras or noise, has its own integers. So an option changes no random numbers of other
        purposes.
        """
        return np.random.default_rng([self.config.seed, *purpose])

    @property
    def ground(self) -> np.ndarray:
        """Point (3,) of the table on the vertical axis through the origin, as low as the object's lowest vertex."""
        return self.config.up_axis * (self.mesh.vertices @ self.config.up_axis).min()

    def photographs(self, count: int, novel: bool = False) -> list[PlannedPhotograph]:
        """Plan `count` photographs: cameras, lights, names and seeds. Renders nothing.

        `novel`: True: photographs to test a fit with, as by a hand-held camera; False: from the viewpoints that
        --cameras names.
        """
        config = self.config
        pose = poses("free" if novel else config.cameras, count, config.radius, config.camera_distance, config.up_axis,
                     self.random(2, novel), config.elevations, config.table != "none")  # fmt: skip
        focal, size = config.size[0] / 2 / np.tan(np.radians(config.fov / 2)), config.size
        cameras = [Camera(to_world, np.full(2, focal), np.array(size) / 2, size) for to_world in pose]
        lights = light_sources.lights_of(config.light, cameras, config.offset, config.spread,
                                         self.random(3, novel and config.light != "lamp"),
                                         config.camera_distance)  # fmt: skip
        suffix = "exr" if config.format == "exr" else "png"
        return [PlannedPhotograph(camera, light, f"{k:03}", f"{k:03}.{suffix}",
                                  config.seed * 40_009 + 2 * (k + novel * 10_007))
                for k, (camera, light) in enumerate(zip(cameras, lights))]  # fmt: skip

    def further_lamps(self, first: Light) -> list[Light]:
        """Make all lamps that --lamps asks for, except `first`, which is the own light of each photograph."""
        return light_sources.further_lamps(self.config.lamps - 1, first, self.random(8))

    def environment_element(self, scale: float = 1.0) -> Element:
        """Make the XML element of the environment map that --environment names, and check that Mitsuba can load it.

        `scale`: factor of its radiance. Raises InputError if the file cannot be read.
        """
        file = Path(str(self.config.environment)).resolve()
        element = ElementTree.Element("emitter", type="envmap")
        ElementTree.SubElement(element, "string", name="filename", value=str(file))
        ElementTree.SubElement(element, "float", name="scale", value=numbers(scale))
        upright = np.eye(4)
        upright[:3, :3] = Rotation.align_vectors([self.config.up_axis], [[0.0, 1.0, 0.0]])[0].as_matrix()
        scenefile.add_pose(element, upright)
        with reading(f"{file}: --environment", "an EXR or HDR file of latitude and longitude"):
            if file.suffix.lower() == ".exr":
                read_image(file)  # checks how much memory it needs; Mitsuba does not
            load_element(element)
        return element

    def build(self, folder: Path) -> ObjectOnTable:
        """Make object and table, ready for rendering. Writes the textures of the table into `folder`.

        Stores the XML elements of the table in `tables`.
        """
        config, shapes = self.config, []
        if config.table != "none":
            self.tables = table_elements(folder, self.ground, config.up_axis, config.radius, config.table == "sheet")
        for element in map(deepcopy, self.tables):
            move_names(element, folder, Path.cwd())
            shapes.append(load_element(element))
        return ObjectOnTable(self.shape, self.mesh.vertices, shapes)

    def radiance(self, scene: ObjectOnTable, taken: PlannedPhotograph, spp: int, scale: int = 1) -> np.ndarray:
        """Render a photograph under all lamps or under the environment map, without the light of the room.

        Returns linear radiance (H, W, 3). The first lamp brings 1 W/m² to the object. `spp`: paths per pixel, a square
        number. `scale`: factor by which width and height of the picture are divided.
        """
        depth, view = self.config.depth, LensCamera(taken.camera.shrunk(scale))
        if self.config.light == "none":
            return np.zeros((*reversed(view.camera.size), 3))
        light = taken.light if self.environment is None else load_element(self.environment)
        picture = scene.radiance(view, light, spp, taken.seed, depth, hidden=self.environment is None)
        for n, lamp in enumerate(self.further_lamps(taken.light), 1):
            picture = picture + scene.radiance(view, lamp, spp, taken.seed + LAMP_SEED_STEP * n, depth)
        return picture

    def room_radiance(self, scene: ObjectOnTable, taken: PlannedPhotograph, spp: int, scale: int = 1) -> np.ndarray:
        """Render a photograph under the light of the room alone. Returns linear radiance (H, W, 3); 0 without a room.

        `spp`: paths per pixel, a square number. `scale`: factor by which width and height of the picture are divided.
        """
        view = LensCamera(taken.camera.shrunk(scale))
        if not self.config.room:
            return np.zeros((*reversed(view.camera.size), 3))
        room = self.room_level * room_envmap(self.room, taken.camera.to_world, lobes=self.windows)
        light = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(room.astype(np.float32))})
        return scene.radiance(view, light, spp, taken.seed + 1, self.config.depth)

    def exposure(self, scene: ObjectOnTable, photographs: list[PlannedPhotograph]) -> float:
        """Choose the exposure: the pixel value of radiance 1. It comes from the option --exposure or --clipped.

        --exposure gives the value. Without it, the share --clipped of the object's pixels is overexposed; to find this,
        some photographs are rendered in small size. Raises InputError if no pixel shows only the object, or if the
        object is black.
        """
        config = self.config
        if config.exposure is not None:
            return config.exposure * (1.0 if self.environment is not None else np.pi)
        values, scale = [], max(1, min(TRIAL_SCALE, min(config.size) // 8))
        for photograph in photographs[:: -(-len(photographs) // TRIALS)]:
            inside = scene.coverage(LensCamera(photograph.camera.shrunk(scale)), 16) > 0.9
            both = self.radiance(scene, photograph, 36, scale) + self.room_radiance(scene, photograph, 36, scale)
            values.append(both[inside].max(-1))
        if not np.concatenate(values).size:
            raise InputError(f"{config.mesh}: MESH: is so thin or so far away that no pixel shows only the object, to "
                             "determine the exposure; give --exposure, for instance 0.5")  # fmt: skip
        bright = float(np.quantile(np.concatenate(values), 1 - config.clipped))
        if not bright > 0:
            raise InputError(f"{config.mesh}: MESH: is black under all lights; do its faces point inward?")
        return 1 / bright


def write_capture(config: SynthesizeConfig) -> None:
    """Render and write the capture that the options describe. Photographs that exist already are not rendered again.

    The scene file is written last. Raises InputError if the folder contains other files, or if a file cannot be read or
    written.
    """
    out, studio = config.out, Studio(config)
    claim(out, config)
    for name in ("truth/images", "truth/masks", "images", "masks", *["ambient"] * config.pairs):
        with writing(out):
            (out / name).mkdir(parents=True, exist_ok=True)
    write_file(out / SETTINGS, json.dumps(settings_of(config), indent=1))  # first, so that the same command continues
    write_file(out / "truth/mesh.ply", cast(bytes, studio.mesh.export(file_type="ply")))
    scene = studio.build(out)
    seen, novel = studio.photographs(config.views), studio.photographs(config.novel, novel=True)
    exposure = studio.exposure(scene, seen)
    found = {"full_scale": 1 / exposure, "placed": studio.placed.tolist()}
    write_file(out / SETTINGS, json.dumps(settings_of(config) | {"found": found}, indent=1))
    todo = [(photograph, folder) for folder, photographs in ((out, seen), (out / "truth", novel))
            for photograph in photographs if not (folder / "images" / photograph.file).is_file()
            or not (folder / "masks" / f"{photograph.name}.png").is_file()]  # fmt: skip
    for photograph, folder in progress(todo, "photographing", unit="photograph", leave=True):
        ambient = studio.room_radiance(scene, photograph, studio.spp)
        pictures = {"images": exposure * (studio.radiance(scene, photograph, studio.spp) + ambient)}
        coverage = scene.coverage(LensCamera(photograph.camera))
        write_image(to_bytes(coverage[..., None] >= 0.5), folder / "masks" / f"{photograph.name}.png")
        if folder == out:  # novel views have neither noise nor errors
            if config.pairs:
                pictures = {"ambient": exposure * ambient} | pictures  # images last: `todo` looks for them
            for purpose, place in ((5, "images"), (7, "ambient")):
                if place in pictures:
                    pictures[place] *= studio.gains[int(photograph.name)]
                    if config.electrons or config.read:
                        random = studio.random(purpose, int(photograph.name))
                        pictures[place] = with_noise(pictures[place], config.electrons, config.read, random)
        for place, linear in pictures.items():
            write_image(encode(linear, config.format), folder / place / photograph.file)
    write_scenes(studio, seen, novel, exposure)


def write_scenes(
    studio: Studio, seen: list[PlannedPhotograph], novel: list[PlannedPhotograph], exposure: float
) -> None:
    """Write scene.xml with the photographs `seen`, and truth/scene.xml with the photographs `novel` that test a fit.

    If an option --wrong-… simulates errors, scene.xml has these errors, and truth/exact.xml is the same scene without
    them. `exposure`: pixel value of radiance 1.
    """
    config, out = studio.config, studio.config.out
    strength = exposure if studio.lit else 0.0
    emitters: list[Element] = []
    if studio.environment is not None:
        emitters = [studio.environment_element(exposure)]
    elif config.room:
        level = exposure * studio.room_level
        emitters = room_elements(level * studio.room, lobes=studio.windows and studio.windows.scaled(level))
    for lamp in studio.further_lamps((seen + novel)[0].light):
        emitters.append(emitter_element(lamp._replace(rgb=strength * lamp.rgb)))
    # For pairs the room is unknown, but not that it stood still while the object turned.
    turning = room_elements(np.zeros((BASIS, 3)), {"camera"}) if config.cameras == "turntable" else []
    up, ground = (config.up_axis, studio.ground) if config.table != "none" else (None, None)
    metres = 0.001 if config.table == "sheet" else None

    def scene(folder: Path, photographs: list[PlannedPhotograph], place: str, exact: bool) -> bytes:
        paired = config.pairs and photographs is seen
        gains = studio.gains if exact and photographs is seen else np.ones((len(photographs), 3))
        shots: Sequence[Shot] = [
            Shot(
                p.name, p.camera, p.light._replace(rgb=strength * p.light.rgb),
                response=Response(gain=tuple(gain.tolist())),
                files=Files(Path(place, "images", p.file), Path(place, "masks", f"{p.name}.png"),
                            ambient=Path("ambient", p.file) if paired else None),
                saturation=HALF_LIMIT if config.format == "exr" else 1.0, calibrated=exact,
            )
            for p, gain in zip(photographs, gains)
        ]  # fmt: skip
        if not exact:
            shots = miscalibrated(shots, np.zeros(3), studio.random(4), config.wrong_cameras, config.wrong_light,
                                  config.wrong_power)  # fmt: skip
            if config.light == "lamp":  # it does not move with a camera
                shots = [replace(shot, light=shot.own_light._replace(vector=p.light.vector))
                         for shot, p in zip(shots, photographs)]  # fmt: skip
        root = scenefile.scene_element(map(scenefile.photograph_element, shots), ground=ground, up=up, metres=metres)
        root.extend(turning if paired else [] if config.wrong_room and not exact else deepcopy(emitters))
        root.extend(deepcopy(studio.tables))
        move_names(root, out, folder)
        return scenefile.scene_bytes(root)

    if novel:
        write_file(out / "truth/scene.xml", scene(out / "truth", novel, "truth/", exact=True))
    if not config.exact:
        write_file(out / "truth/exact.xml", scene(out / "truth", seen, "", exact=True))
    write_file(out / "scene.xml", scene(out, seen, "", config.exact))


def digest(file: Path) -> str:
    """Hash the contents of a file and of all files that it names, such as textures. Returns 32 hexadecimal digits."""
    result, files = hashlib.blake2b(digest_size=16), [file]
    for each in files:  # the list grows in the loop
        content, kind = each.read_bytes(), each.suffix.lower()
        result.update(content)
        found = re.findall(REFERENCES.get(kind, b"(?!)"), content, re.M)
        for name in quoted(content) if kind == ".xml" else [name.decode(errors="replace") for name in found]:
            named = each.parent / name
            if os.path.isfile(named) and named.resolve() not in files:
                files.append(named.resolve())
    return result.hexdigest()


def settings_of(config: SynthesizeConfig) -> dict:
    """Return the options that affect a capture as a dictionary of JSON values.

    Its key `digests` has hashes of the files that the options name, by option.
    """
    values = asdict(config) | {"digests": {}}
    del values["out"]
    for name in ("mesh", "material", "second", "pattern", "environment"):
        text = str(getattr(config, name)).partition(".npz:")[0]
        # os.path.isfile, unlike Path.is_file, accepts texts that are too long for a file name.
        file = next((file for file in (text, f"{text}.npz") if os.path.isfile(file)), None)
        if file:
            values["digests"][name] = digest(Path(file))
    return json.loads(json.dumps(values, default=str))


def claim(out: Path, config: SynthesizeConfig) -> None:
    """Raise InputError if the folder `out` contains anything but a capture with these options, complete or not.

    A missing or empty folder is accepted. Writes nothing.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    found = read_json(out / SETTINGS)
    if not isinstance(found, dict):
        raise InputError(f"{out}: OUT: exists already, and is no capture of mi-ring synthesize; give another name")
    wanted = settings_of(config)
    hashed = {"mesh", "environment"} & wanted["digests"].keys()  # their content matters, not their path
    other = [name for name, value in wanted.items() if name not in hashed and found.get(name) != value]
    if other:
        raise InputError(f"{out}: OUT: has a capture with other options ({', '.join(other)}); give another name, or "
                         "remove it")  # fmt: skip
