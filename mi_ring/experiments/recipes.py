"""Where the captures of experiments come from: given, path traced, converted, made from others."""

import hashlib
import json
import os
import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mi_ring.capture.loading import load_capture
from mi_ring.capture.scenefile import move_names, recalibrated_xml, scene_bytes
from mi_ring.collection.jobs import written
from mi_ring.errors import InputError, require_file
from mi_ring.foreign import reading
from mi_ring.importers.conversion import write_scene
from mi_ring.importers.diligent_mv import DiligentMV
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.synthesis.degradation import miscalibrated
from mi_ring.synthesis.example_pot import VIEWS, pot, write_example
from mi_ring.synthesis.options import SynthesizeConfig, require_options
from mi_ring.synthesis.path_traced_capture import SETTINGS, claim, write_capture
from mi_ring.system.command import scene_name
from mi_ring.system.files import in_turn, partial_path, read_json, write_file, writing

POT2 = Path(__file__).parents[2] / "scenes" / "pot2.xml"  #: of a checkout
ORIGIN = "made_of.json"  #: in the folder of a capture: what it was made of


@dataclass(frozen=True)
class Recipe:
    """A capture that is there, or is made when it is needed, in a folder of its name beside the others."""

    name: str

    def folder_in(self, captures: Path) -> Path:
        """Its own folder, if it has one."""
        return captures / self.name

    def place(self, captures: Path) -> Path:
        """Where the scene file is, or will be."""
        return self.folder_in(captures) / "scene.xml"

    def made(self, captures: Path) -> Path:
        """The scene file, which is written if it is not there, but by one process at a time.

        Raises InputError if there can be none.
        """
        with in_turn(self.folder_in(captures)):  # other experiments may make the same
            return self.make(captures)

    def make(self, captures: Path) -> Path:
        """The same, while no other process does."""
        raise NotImplementedError

    def truth(self, captures: Path) -> Path:
        """The folder of mesh.ply and, perhaps, of scene.xml with novel views."""
        return self.folder_in(captures) / "truth"

    def compared(self, captures: Path) -> list[Path]:
        """The files with what a fit of it is compared with; not all need be there."""
        truth = self.truth(captures)
        return [truth / "mesh.ply", truth / "scene.xml"]

    @property
    def photographs(self) -> int:
        """How many it has."""
        raise NotImplementedError


@dataclass(frozen=True)
class Given(Recipe):
    """A capture of the user's, with its truth: in truth/ beside the scene file, or in NAME/truth/ beside NAME.xml."""

    scene: Path

    def place(self, captures: Path) -> Path:
        return self.scene

    def made(self, captures: Path) -> Path:
        return self.scene  # nobody makes it

    def truth(self, captures: Path) -> Path:
        return truth_of(self.scene)

    @property
    def photographs(self) -> int:
        return sensors_of(self.scene)


def given(path: Path) -> Given:
    """The capture that is meant, where its folder is given, too. Raises InputError without scene file or truth."""
    scene = path / "scene.xml" if path.is_dir() else path
    require_file(scene, "the folder of a capture with scene.xml and truth/mesh.ply, or its scene file")
    truth_of(scene)
    return Given(scene_name(scene), scene)


def sensors_of(scene: Path) -> int:
    """How many sensors a scene file has. Raises InputError if it is no XML."""
    with reading(scene, "XML"):
        return len(ElementTree.parse(scene).getroot().findall("sensor"))


def truth_of(scene: Path) -> Path:
    """The folder with the truth of a scene file. Raises InputError if there is none."""
    folders = [scene.with_suffix("") / "truth", scene.parent / "truth"]
    for folder in folders:
        if (folder / "mesh.ply").is_file():
            return folder
    raise InputError(f"{scene}: has no truth, neither {folders[0]}/mesh.ply nor {folders[1]}/mesh.ply; an experiment "
                     "compares with it, and mi-ring synthesize writes it")  # fmt: skip


def filled(folder: Path, write: Callable[[Path], object], of: dict) -> Path:
    """scene.xml of a folder that is written by a function, whole or not at all, unless it is there.

    `of`: what it is made of, in plain values; if that has changed, it is made again.
    """
    if not (folder / "scene.xml").is_file() or read_json(folder / ORIGIN) != of:
        with writing(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            growing = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
            try:
                write(growing)
                write_file(growing / ORIGIN, json.dumps(of))
                growing.chmod(0o755)
                shutil.rmtree(folder, ignore_errors=True)  # of something else, or the scene file was taken from it
                os.replace(growing, folder)
            finally:
                shutil.rmtree(growing, ignore_errors=True)
    return folder / "scene.xml"


@dataclass(frozen=True)
class Example(Recipe):
    """The small capture of a pot that `mi-ring example` writes."""

    def make(self, captures: Path) -> Path:
        return filled(self.folder_in(captures), write_example, {"views": VIEWS})

    @property
    def photographs(self) -> int:
        return VIEWS


def own() -> Recipe:
    """The capture that is at hand without any other data: pot2 in a checkout, else the example's pot."""
    return Given("pot2", POT2) if POT2.is_file() else Example("example")


@dataclass(frozen=True)
class Synthetic(Recipe):
    """A capture that `mi-ring synthesize` would make; without a mesh that of the example's pot."""

    config: SynthesizeConfig
    mesh: Path | None = None

    @property
    def photographs(self) -> int:
        return self.config.views

    def folder_in(self, captures: Path) -> Path:
        """By its settings, too: two meshes may have the same name, and two materials."""
        settings = repr((self.config, self.mesh and self.mesh.resolve()))
        return captures / f"{self.name}-{hashlib.blake2b(settings.encode(), digest_size=3).hexdigest()}"

    def complete(self, captures: Path) -> SynthesizeConfig:
        """With mesh and folder."""
        mesh = (self.mesh or captures / "pot.ply").resolve()
        return replace(self.config, mesh=mesh, out=self.folder_in(captures))

    def make(self, captures: Path) -> Path:
        config = self.complete(captures)
        require_options(config)
        if not self.mesh and not config.mesh.is_file():
            captures.mkdir(parents=True, exist_ok=True)
            vertices, faces, _ = pot()
            growing = partial_path(config.mesh)
            mesh_of(vertices, faces, normals=False).write_ply(str(growing))
            os.replace(growing, config.mesh)
        try:
            claim(config.out, config)
        except InputError:  # its name is by its settings: what a file of theirs holds has changed
            if not (config.out / SETTINGS).is_file():
                raise
            shutil.rmtree(config.out)
        if not (config.out / "scene.xml").is_file():  # which is written last
            write_capture(config)
        return config.out / "scene.xml"


@dataclass(frozen=True)
class Derived(Recipe):
    """The photographs of another capture, with its truth, by a scene file of its own."""

    source: Recipe

    def make(self, captures: Path) -> Path:
        scene = self.source.made(captures)
        changes = {k: v for k, v in vars(self).items() if k not in ("name", "source")}
        of = {"scene": str(scene.resolve()), "written": written(scene), **changes}
        return filled(self.folder_in(captures), lambda folder: self.write(scene, folder, captures), of)

    def truth(self, captures: Path) -> Path:
        return self.source.truth(captures)

    def write(self, scene: Path, folder: Path, captures: Path) -> None:
        """Its scene file, by that of the source."""
        raise NotImplementedError


@dataclass(frozen=True)
class Part(Derived):
    """So many of a capture's photographs, evenly from the first to the last."""

    count: int

    def write(self, scene: Path, folder: Path, captures: Path) -> None:
        """Its scene file, of the same photographs."""
        root = ElementTree.parse(scene).getroot()
        move_names(root, scene.parent, self.folder_in(captures))
        sensors = root.findall("sensor")
        kept = {round(k) for k in np.linspace(0, len(sensors) - 1, min(self.count, len(sensors)))}
        for k, sensor in enumerate(sensors):
            if k not in kept:
                root.remove(sensor)
        write_file(folder / "scene.xml", scene_bytes(root))


@dataclass(frozen=True)
class Perturbed(Derived):
    """A capture whose cameras are wrong, as `mi_ring.synthesis.degradation.miscalibrated` makes them."""

    degrees: float
    seed: int

    def write(self, scene: Path, folder: Path, captures: Path) -> None:
        """Its scene file, of the same photographs, which no longer says that it is calibrated."""
        capture = load_capture(scene, images=False)
        center, _ = capture.sphere()
        wrong = miscalibrated(capture.shots, center, np.random.default_rng(self.seed), turned=self.degrees)
        root = ElementTree.parse(scene).getroot()
        for sensor in root.findall("sensor"):
            for said in sensor.findall("boolean[@name='calibrated']"):
                sensor.remove(said)
        move_names(root, scene.parent, self.folder_in(captures))
        content = recalibrated_xml(ElementTree.tostring(root), wrong, capture.room)
        write_file(folder / "scene.xml", content)


@dataclass(frozen=True)
class DiligentObject(Recipe):
    """An object of DiLiGenT-MV, from its own folder."""

    folder: Path
    fill_holes: bool = False

    def make(self, captures: Path) -> Path:
        source = DiligentMV(self.folder, self.place(captures), fill_holes=self.fill_holes)
        if source.truth is None:
            raise InputError(f"{self.folder}: has no mesh_Gt.ply, the true surface; fetch DiLiGenT-MV as it is")
        files = [source.truth, self.folder / "Calib_Results.mat"]  # all that are read
        files += [file for kind in ("*.png", "light_*.txt") for file in self.folder.glob(f"view_*/{kind}")]
        of = {"folder": str(self.folder.resolve()), "fill_holes": self.fill_holes,
              "written": {file.relative_to(self.folder).as_posix(): written(file) for file in files}}  # fmt: skip
        return filled(self.folder_in(captures), lambda out: write_scene(replace(source, scene=out / "scene.xml")), of)
