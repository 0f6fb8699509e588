"""Datasets of experiments: captures with a known true surface. Users give them, or experiments make them."""

import json
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mi_ring.capture.loading import load_capture
from mi_ring.capture.scenefile import move_names, recalibrated_xml, scene_bytes
from mi_ring.collection.jobs import modified
from mi_ring.errors import InputError, require_file
from mi_ring.foreign import reading
from mi_ring.importers.conversion import write_scene
from mi_ring.importers.diligent_mv import DiligentMV
from mi_ring.synthesis.degradation import miscalibrated
from mi_ring.synthesis.example_pot import VIEWS, pot, write_example
from mi_ring.synthesis.options import SynthesizeConfig, require_options
from mi_ring.synthesis.path_traced_capture import SETTINGS, claim, write_capture
from mi_ring.system.command import scene_name
from mi_ring.system.files import locked, read_json, whole_folder, write_file

POT2 = Path(__file__).parents[2] / "scenes" / "pot2.xml"  #: in a checkout of the repository
ORIGIN = "made_of.json"  #: in the folder of a capture: what it was made from
WANTED = "the folder of a capture with scene.xml and truth/mesh.ply, or its scene file"


@dataclass(frozen=True)
class Dataset:
    """A capture with its true surface. Its method `prepare` writes the files, if they are not the user's."""

    name: str
    scene: Path  #: scene file
    truth: Path  #: folder with mesh.ply and, perhaps, scene.xml of novel views

    def prepare(self) -> None:
        """Write the files of the dataset if they are missing or outdated. If another process does it, wait for it.

        The files of a user's capture are not written. Raises InputError if a file is missing or cannot be written.
        """
        require_file(self.scene, WANTED)

    @property
    def truth_files(self) -> list[Path]:
        """Files of the ground truth: the true mesh and the scene file of novel views. Some may be missing."""
        return [self.truth / "mesh.ply", self.truth / "scene.xml"]

    @property
    def photographs(self) -> int:
        """Number of photographs. Raises InputError if the scene file is no XML."""
        with reading(self.scene, "XML"):
            return len(ElementTree.parse(self.scene).getroot().findall("sensor"))


def given(path: Path) -> Dataset:
    """Return the dataset of a user's capture. `path`: the folder of the capture, or its scene file.

    The true mesh is truth/mesh.ply beside the scene file NAME.xml, or NAME/truth/mesh.ply. Raises InputError if the
    scene file or the mesh is missing.
    """
    scene = path / "scene.xml" if path.is_dir() else path
    require_file(scene, WANTED)
    folders = [scene.with_suffix("") / "truth", scene.parent / "truth"]
    for folder in folders:
        if (folder / "mesh.ply").is_file():
            return Dataset(scene_name(scene), scene, folder)
    raise InputError(f"{scene}: has no true surface, neither {folders[0]}/mesh.ply nor {folders[1]}/mesh.ply; "
                     "mi-ring synthesize makes captures that have one")  # fmt: skip


def default_dataset(captures: Path) -> Dataset:
    """Return the dataset pot2 if this is a checkout of the repository, otherwise the pot of `mi-ring example`.

    `captures`: folder in which `prepare` will write the pot of `mi-ring example`.
    """
    return given(POT2) if POT2.is_file() else ExamplePot.of(captures / "example")


Cached = TypeVar("Cached", bound="CachedDataset")


@dataclass(frozen=True)
class CachedDataset(Dataset):
    """Base class of datasets that are written to a folder.

    If the files that they are made from change, it is written again.
    """

    @classmethod
    def of(cls: type[Cached], folder: Path, *fields: Any) -> Cached:
        """Return the dataset in `folder`. Nothing is written yet.

        `fields`: values of the fields that the subclass adds.
        """
        return cls(folder.name, folder / "scene.xml", folder / "truth", *fields)

    def prepare(self) -> None:
        folder = self.scene.parent
        with locked(folder, wait=True):
            origin = self.origin()
            if not self.scene.is_file() or read_json(folder / ORIGIN) != origin:
                with whole_folder(folder) as growing:
                    self.write(growing)
                    write_file(growing / ORIGIN, json.dumps(origin))
                    shutil.rmtree(folder, ignore_errors=True)  # outdated or incomplete

    def origin(self) -> dict[str, Any]:
        """Return what the dataset is made from, such as files with their modification times, as JSON values.

        If this changes, the dataset is written again.
        """
        raise NotImplementedError

    def write(self, folder: Path) -> None:
        """Write the dataset to `folder`, which is empty and temporary.

        The method `prepare` then moves it to its place.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class ExamplePot(CachedDataset):
    """The small capture that `mi-ring example` makes."""

    photographs = VIEWS

    def origin(self) -> dict[str, Any]:
        return {"views": VIEWS}

    def write(self, folder: Path) -> None:
        write_example(folder)


@dataclass(frozen=True)
class Synthetic(Dataset):
    """A capture that `mi-ring synthesize` makes by path tracing."""

    config: SynthesizeConfig
    of_pot: bool  #: whether it shows the example's pot, whose mesh is then written too

    @property
    def photographs(self) -> int:
        return self.config.views

    def prepare(self) -> None:
        config = self.config
        with locked(config.out, wait=True):
            require_options(config)
            if self.of_pot and not config.mesh.is_file():
                config.mesh.parent.mkdir(parents=True, exist_ok=True)
                write_file(config.mesh, pot().ply())
            try:
                claim(config.out, config)
            except InputError:  # the folder is named after the settings, so the content of a file has changed
                if not (config.out / SETTINGS).is_file():
                    raise
                shutil.rmtree(config.out)
            if not self.scene.is_file():  # it is written last
                write_capture(config)


@dataclass(frozen=True)
class Derived(CachedDataset):
    """Base class of datasets that change the scene file of another dataset, `source`.

    They share its photographs and its ground truth.
    """

    source: Dataset

    @classmethod
    def of(cls: type[Cached], folder: Path, *fields: Any) -> Cached:
        return cls(folder.name, folder / "scene.xml", fields[0].truth, *fields)

    def prepare(self) -> None:
        self.source.prepare()
        super().prepare()

    def origin(self) -> dict[str, Any]:
        own = {key: value for key, value in vars(self).items() if key not in ("name", "scene", "truth", "source")}
        scene = self.source.scene
        return {"scene": str(scene.resolve()), "written": modified(scene), **own}

    def write(self, folder: Path) -> None:
        root = ElementTree.parse(self.source.scene).getroot()
        move_names(root, self.source.scene.parent, self.scene.parent)
        write_file(folder / "scene.xml", self.changed(root))

    def changed(self, root: ElementTree.Element) -> bytes:
        """Return the content of this dataset's scene file.

        `root`: XML of the source's scene file, with file names relative to the new file. The method may change `root`.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Subset(Derived):
    """Some photographs of a capture, evenly spaced. The first and the last are among them."""

    count: int

    def changed(self, root: ElementTree.Element) -> bytes:
        sensors = root.findall("sensor")
        kept = {round(k) for k in np.linspace(0, len(sensors) - 1, min(self.count, len(sensors)))}
        for k, sensor in enumerate(sensors):
            if k not in kept:
                root.remove(sensor)
        return scene_bytes(root)


@dataclass(frozen=True)
class PerturbedCameras(Derived):
    """A capture with random errors of its camera poses. Its scene file does not say that the cameras are exact."""

    degrees: float  #: standard deviation of rotations [deg] and of positions [% of the distance]
    seed: int

    def changed(self, root: ElementTree.Element) -> bytes:
        capture = load_capture(self.source.scene, images=False)
        center, _ = capture.sphere()
        wrong = miscalibrated(capture.shots, center, np.random.default_rng(self.seed), turned=self.degrees)
        for shot in root.findall("sensor"):
            for flag in shot.findall("boolean[@name='calibrated']"):
                shot.remove(flag)
        return recalibrated_xml(ElementTree.tostring(root), wrong, capture.room, lobes=capture.lobes)


@dataclass(frozen=True)
class DiligentObject(CachedDataset):
    """An object of the data set DiLiGenT-MV, converted to a scene file."""

    source: Path  #: its folder in DiLiGenT-MV
    fill_holes: bool = False  #: in its masks

    def origin(self) -> dict[str, Any]:
        truth = DiligentMV(self.source, self.scene).truth
        if truth is None:
            raise InputError(f"{self.source}: has no mesh_Gt.ply, the true surface; download DiLiGenT-MV again")
        files = [truth, self.source / "Calib_Results.mat"]
        files += [file for kind in ("*.png", "light_*.txt") for file in self.source.glob(f"view_*/{kind}")]
        return {"folder": str(self.source.resolve()), "fill_holes": self.fill_holes,
                "written": {file.relative_to(self.source).as_posix(): modified(file) for file in files}}  # fmt: skip

    def write(self, folder: Path) -> None:
        write_scene(DiligentMV(self.source, folder / "scene.xml", fill_holes=self.fill_holes))
