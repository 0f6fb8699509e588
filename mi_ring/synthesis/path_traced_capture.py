"""A capture of a known object, written picture by picture: photographs, masks, scene file, and the truth."""

import hashlib
import json
import os
import re
import xml.etree.ElementTree as ElementTree
from copy import deepcopy
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.capture.scenefile import (
    Element,
    add_pose,
    emitter_element,
    move_names,
    numbers,
    photograph_element,
    room_elements,
    scene_bytes,
    scene_element,
)
from mi_ring.errors import InputError
from mi_ring.foreign import reading
from mi_ring.geometry.camera import Camera
from mi_ring.images import read_image, to_bytes, write_image
from mi_ring.scene.lights import Light
from mi_ring.scene.xml_elements import load_element
from mi_ring.synthesis import light_sources
from mi_ring.synthesis.degradation import HIGHEST, encoded, exposures, miscalibrated, noisy
from mi_ring.synthesis.materials import COLOURED, PLAIN, load_material, pattern_of
from mi_ring.synthesis.options import SynthesizeConfig
from mi_ring.synthesis.stage import Stage, load_object, shape_of, table_elements
from mi_ring.synthesis.tracing import Shot
from mi_ring.synthesis.viewpoints import poses
from mi_ring.system.files import quoted, read_json, write_file, writing
from mi_ring.system.progress import progress

BETWEEN = 100_003  #: seeds of pictures of one photograph by different lamps
TRIALS, TRIAL = 8, 8  #: photographs, and how many times smaller they are, by which the exposure is found
SETTINGS = "truth/settings.json"  #: by which an interrupted capture is known
#: How files of a material or of a mesh, other than XML, name others that are read with them.
NAMED = {
    ".obj": rb"^mtllib\s+(.+?)\s*$", ".mtl": rb"^\s*(?i:map_kd)\s+(.+?)\s*$",
    ".gltf": rb"\"uri\"\s*:\s*\"([^\"]{1,500})\"", ".ply": rb"^comment (?i:texturefile) (.+?)\s*$",
}  # fmt: skip


class View(NamedTuple):
    """A photograph to be taken."""

    camera: Camera
    light: Light  #: brings 1 W/m² to the object
    name: str
    seed: int


class Production:
    """All that a capture is made of, by its options. Raises InputError for what cannot be read."""

    def __init__(self, config: SynthesizeConfig) -> None:
        self.config = config
        self.mesh, colours, self.placed = load_object(config.mesh, config.radius, config.smooth)
        usual = PLAIN if colours is None else COLOURED
        bsdf, pattern = load_material(config.material or usual, "--material", colours is not None), None
        if config.second:
            second = load_material(config.second, "--second", colours is not None)
            pattern = pattern_of(config.pattern, self.mesh.vertices, config.bands, "xyz".index(config.up), "--pattern")
            bsdf = pattern.of(bsdf, second)
        self.shape = shape_of(self.mesh, colours, bsdf, pattern)
        #: as XML, where it takes the place of the photographs' lights
        self.environment = self.environment_element() if config.environment else None
        self.room = light_sources.room_of(config.room_kind, config.cameras == "turntable", self.random(1))
        self.tables: list[Element] = []  #: elements of the scene file

    def random(self, *what: int) -> np.random.Generator:
        """Of one purpose, so that one option changes nothing else."""
        return np.random.default_rng([self.config.seed, *what])

    @property
    def ground(self) -> np.ndarray:
        """(3,) the object's lowest point, above the origin or below."""
        return self.config.axis * (self.mesh.vertices @ self.config.axis).min()

    def views(self, count: int, novel: bool = False) -> list[View]:
        """Photographs to be taken; `novel`: as if by hand, from elsewhere."""
        config, random = self.config, self.random(2, novel)
        kind = "free" if novel else config.cameras
        place = poses(kind, count, config.radius, config.away, config.axis, random, config.elevations,
                      config.table != "none")  # fmt: skip
        focal, size = config.size[0] / 2 / np.tan(np.radians(config.fov / 2)), config.size
        cameras = [Camera(to_world, np.full(2, focal), np.array(size) / 2, size) for to_world in place]
        lights = light_sources.lights_of(
            config.light,
            cameras,
            config.offset,
            config.spread,
            self.random(3, novel and config.light != "lamp"),
            config.away,
        )
        return [View(camera, light, f"{k:03}", config.seed * 40_009 + 2 * (k + novel * 10_007))
                for k, (camera, light) in enumerate(zip(cameras, lights))]  # fmt: skip

    def lamps_beside(self, view: View) -> list[Light]:
        """The lamps that light all photographs besides the one that a photograph says is its own."""
        return light_sources.others_of(self.config.lamps - 1, view.light, self.random(8))

    def environment_element(self, scale: float = 1.0) -> Element:
        """The environment as XML. Raises InputError if its file cannot be read."""
        file = Path(str(self.config.environment)).resolve()
        element = ElementTree.Element("emitter", type="envmap")
        ElementTree.SubElement(element, "string", name="filename", value=str(file))
        ElementTree.SubElement(element, "float", name="scale", value=numbers(scale))
        upright = np.eye(4)
        upright[:3, :3] = Rotation.align_vectors([self.config.axis], [[0.0, 1.0, 0.0]])[0].as_matrix()
        add_pose(element, upright)
        with reading(f"{file}: --environment", "an EXR or HDR file of latitude and longitude"):
            if file.suffix.lower() == ".exr":
                read_image(file)  # which bounds its memory
            load_element(element)
        return element

    def stage(self, folder: Path) -> Stage:
        """The object, and the tables below it, whose pictures are written into the `folder`."""
        config, shapes = self.config, []
        if config.table != "none":
            self.tables = table_elements(folder, self.ground, config.axis, config.radius, config.table == "sheet")
        for element in self.tables:
            own = deepcopy(element)
            move_names(own, folder, Path.cwd())
            shapes.append(load_element(own))
        return Stage(self.shape, self.mesh.vertices, shapes)

    def radiance(self, stage: Stage, view: View, camera: Camera, spp: int) -> tuple[np.ndarray, np.ndarray | float]:
        """Linear radiance (H, W, 3) where the photographs' light brings 1 W/m² to the object, and by the room."""
        config, shot = self.config, Shot(camera)
        light = view.light if self.environment is None else load_element(self.environment)
        picture = stage.radiance(shot, light, spp, view.seed, config.depth, hidden=self.environment is None)
        for n, lamp in enumerate(self.lamps_beside(view), 1):
            picture = picture + stage.radiance(shot, lamp, spp, view.seed + BETWEEN * n, config.depth)
        if not config.room:
            return picture, 0.0
        # Apart: paths that choose between two lights are much noisier.
        seen = light_sources.environment_of(self.room_level * light_sources.room_envmap(self.room, camera.to_world))
        return picture, stage.radiance(shot, seen, spp, view.seed + 1, config.depth)

    @property
    def room_level(self) -> float:
        """Mean radiance of the room where the photographs' light brings 1 W/m²."""
        return self.config.room / np.pi

    def exposure(self, stage: Stage, views: list[View]) -> float:
        """By what the radiance is multiplied: as asked for, or such that so much of the object is clipped."""
        config = self.config
        if config.exposure is not None:
            return config.exposure * (1.0 if self.environment is not None else np.pi)
        values = []
        scale = max(1, min(TRIAL, min(config.size) // 8))
        for view in views[:: -(-len(views) // TRIALS)]:
            camera = view.camera.shrunk(scale)
            inside = stage.coverage(Shot(camera), 16) > 0.9
            own, ambient = self.radiance(stage, view, camera, 36)
            values.append((own + ambient)[inside].max(-1))
        if not np.concatenate(values).size:
            raise InputError(f"{config.mesh}: MESH: is so thin or so far away that no pixel shows it alone, by which "
                             "the exposure would be chosen; give --exposure, for instance 0.5")  # fmt: skip
        bright = np.quantile(np.concatenate(values), 1 - config.clipped)
        if not bright > 0:
            raise InputError(f"{config.mesh}: MESH: is black, whatever the light; do its faces point inward?")
        return float(1 / bright)

    @cached_property
    def gains(self) -> np.ndarray:
        """(views, 3) how the photographs are exposed, by their mean."""
        return exposures(self.config.views, self.config.wrong_exposure, self.random(6))

    @cached_property
    def spp(self) -> int:
        """Paths per pixel: a square number."""
        return int(np.ceil(np.sqrt(self.config.spp))) ** 2


def write_capture(config: SynthesizeConfig) -> None:
    """Write a capture into its folder, or what is missing of it. The scene file comes last.

    Raises InputError for what cannot be read, and if the folder holds anything else.
    """
    out, production = config.out, Production(config)
    claim(out, config)
    for name in ("truth/images", "truth/masks", "images", "masks", *["ambient"] * config.pairs):
        with writing(out):
            (out / name).mkdir(parents=True, exist_ok=True)
    write_file(out / SETTINGS, json.dumps(settings_of(config), indent=1))  # by which the same command goes on
    write_file(out / "truth/mesh.ply", cast(bytes, production.mesh.export(file_type="ply")))
    stage = production.stage(out)
    seen, novel = production.views(config.views), production.views(config.novel, novel=True)
    exposure = production.exposure(stage, seen)
    found = {"full_scale": 1 / exposure, "placed": production.placed.tolist()}
    write_file(out / SETTINGS, json.dumps(settings_of(config) | {"found": found}, indent=1))
    todo = [(view, out, True) for view in seen] + [(view, out / "truth", False) for view in novel]
    todo = [(view, folder, fitted) for view, folder, fitted in todo
            if not (folder / "images" / photograph_name(config, view)).is_file()
            or not (folder / "masks" / f"{view.name}.png").is_file()]  # fmt: skip
    for view, folder, fitted in progress(todo, "photographing", unit="photograph", leave=True):
        own, ambient = production.radiance(stage, view, view.camera, production.spp)
        pictures = {"images": exposure * (own + ambient)}
        coverage = stage.coverage(Shot(view.camera))
        write_image(to_bytes(coverage[..., None] >= 0.5), folder / "masks" / f"{view.name}.png")
        if fitted:
            if config.pairs:
                pictures = {"ambient": exposure * ambient} | pictures  # by the last it is known what there is
            for purpose, place in ((5, "images"), (7, "ambient")):
                if place in pictures:
                    pictures[place] *= production.gains[int(view.name)]
                    if config.electrons or config.read:
                        random = production.random(purpose, int(view.name))
                        pictures[place] = noisy(pictures[place], config.electrons, config.read, random)
        for place, linear in pictures.items():
            write_image(encoded(linear, config.format), folder / place / photograph_name(config, view))
    write_scenes(production, seen, novel, exposure)


def write_scenes(production: Production, seen: list[View], novel: list[View], exposure: float) -> None:
    """Write scene.xml, the truth's own, and, where scene.xml is wrong, what it should say: truth/exact.xml."""
    config = production.config
    out = config.out
    strength = exposure if production.environment is None else 0.0
    extra: list[Element] = []
    if production.environment is not None:
        extra = [production.environment_element(exposure)]
    elif config.room:
        extra = room_elements(exposure * production.room_level * production.room)
    for lamp in production.lamps_beside((seen + novel)[0]):
        extra.append(emitter_element(lamp._replace(rgb=strength * lamp.rgb)))
    up, ground = (config.axis, production.ground) if config.table != "none" else (None, None)
    metres = 0.001 if config.table == "sheet" else None

    def scene(folder: Path, views: list[View], images: str, masks: str, exact: bool) -> bytes:
        paired = config.pairs and views is seen
        gains = production.gains if exact and views is seen else np.ones((len(views), 3))
        cameras, lights = [view.camera for view in views], [view.light for view in views]
        if not exact:
            cameras, lights = miscalibrated(
                cameras, lights, np.zeros(3), production.random(4), config.wrong_cameras, config.wrong_light,
                config.wrong_power,
            )  # fmt: skip
            if config.light == "lamp":  # which no camera takes along
                lights = [light._replace(vector=view.light.vector) for light, view in zip(lights, views)]
        elements = [
            photograph_element(
                view.name, f"{images}/{photograph_name(config, view)}", camera,
                light._replace(rgb=strength * light.rgb), f"{masks}/{view.name}.png",
                saturation=HIGHEST if config.format == "exr" else None, calibrated=exact, gain=gain,
                ambient=f"ambient/{photograph_name(config, view)}" if paired else None,
            )
            for view, camera, light, gain in zip(views, cameras, lights, gains)
        ]  # fmt: skip
        root = scene_element(elements, ground, up, metres)
        root.extend([] if paired or (config.wrong_room and not exact) else deepcopy(extra))
        for table in production.tables:
            root.append(deepcopy(table))
        move_names(root, out, folder)
        return scene_bytes(root)

    if novel:
        write_file(out / "truth/scene.xml", scene(out / "truth", novel, "truth/images", "truth/masks", True))
    if not config.exact:
        write_file(out / "truth/exact.xml", scene(out / "truth", seen, "images", "masks", True))
    write_file(out / "scene.xml", scene(out, seen, "images", "masks", config.exact))


def photograph_name(config: SynthesizeConfig, view: View) -> str:
    """Of its file."""
    return f"{view.name}.{'exr' if config.format == 'exr' else 'png'}"


def digest(file: Path) -> str:
    """Of a file and of those that it names, which are beside it: pictures of a material or of a mesh."""
    result, files = hashlib.blake2b(digest_size=16), [file]
    for each in files:  # which grow meanwhile
        content = each.read_bytes()
        result.update(content)
        for name in named_in(content, each.suffix.lower()):
            named = each.parent / name
            if os.path.isfile(named) and named.resolve() not in files:
                files.append(named.resolve())
    return result.hexdigest()


def named_in(content: bytes, kind: str) -> list[str]:
    """What a file of this kind, a suffix, says where names of other files stand."""
    if kind == ".xml":
        return quoted(content)
    return [name.decode(errors="replace") for name in re.findall(NAMED.get(kind, b"(?!)"), content, re.M)]


def settings_of(config: SynthesizeConfig) -> dict:
    """The options that a capture depends on, and what their files hold, as JSON has them."""
    values = asdict(replace(config, out=Path())) | {"digests": {}}
    del values["out"]
    for name in ("mesh", "material", "second", "pattern", "environment"):
        text = str(getattr(config, name)).partition(".npz:")[0]  # which may be longer than names of files are
        file = next((file for file in (text, f"{text}.npz") if os.path.isfile(file)), None)
        if file:
            values["digests"][name] = digest(Path(file))
    return json.loads(json.dumps(values, default=str))


def claim(out: Path, config: SynthesizeConfig) -> None:
    """Raise InputError if a folder holds anything but the same capture, whole or in part."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    found = read_json(out / SETTINGS)
    if not isinstance(found, dict):
        raise InputError(f"{out}: OUT: is there already, and is no capture of mi-ring synthesize; give another name")
    wanted = settings_of(config)
    named = {"mesh", "environment"} & wanted["digests"].keys()  # by what they hold, wherever they are
    other = [name for name, value in wanted.items() if name not in named and found.get(name) != value]
    if other:
        raise InputError(f"{out}: OUT: holds a capture that was made with other options ({', '.join(other)}); "
                         "give another name, or remove it")  # fmt: skip
