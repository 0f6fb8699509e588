"""Meshroom's (AliceVision's) and OpenMVG's scenes."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from mi_ring.errors import InputError, is_file
from mi_ring.importers.camera_models import Lens, brown, inverse
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import load_json, matrix

#: Models of distortion: coefficients, of which two after three of Brown are tangential, by either program's names.
MODELS = {
    "pinhole": 0, "none": 0, "radial1": 1, "radialk1": 1, "radial3": 3, "radialk3": 3, "brown": 5, "fisheye4": 4,
    "fisheye": 4, "pinhole_radial_k1": 1, "pinhole_radial_k3": 3, "pinhole_brown_t2": 5,
}  # fmt: skip
COEFFICIENTS = ("disto_k1", "disto_k3", "disto_t2", "fisheye")  #: OpenMVG's fields of them


@dataclass(frozen=True)
class SfmData(Photogrammetry):
    """Meshroom's cameras.sfm or sfm.json, OpenMVG's sfm_data.json. The light is beside the camera.

    SRC is the file. Photographs are where it says, or in --images under the same names.
    """

    def posed(self) -> Iterator[tuple[str, Frame]]:
        top = load_json(self.src)
        if not isinstance(top, dict) or not isinstance(top.get("views"), list):
            raise InputError(f"{self.src}: views: is missing; must be a scene of Meshroom or OpenMVG")
        yield from self.openmvg(top) if "extrinsics" in top or "root_path" in top else self.alicevision(top)

    def alicevision(self, top: dict) -> Iterator[tuple[str, Frame]]:
        """Of Meshroom."""
        version = tuple(matrix(top.get("version", [1, 0, 0]), (3,), f"{self.src}: version"))
        intrinsics = self.by_key(top, "intrinsics", "intrinsicId")
        poses = self.by_key(top, "poses", "poseId")
        for k, view in enumerate(top["views"]):
            what = f"{self.src}: views[{k}]"
            file = text(entry(view, what), "path", what)
            own = poses.get(str(view.get("poseId", view.get("viewId"))))
            if own is None:
                self.left_out.add(PureWindowsPath(file).name)
                continue
            if str(view.get("isPoseIndependant", True)).lower() == "false":
                raise InputError(f"{what}: isPoseIndependant: is false; photographs of rigs are not supported")
            transform = entry(entry(own, what).get("pose"), f"{what}: pose").get("transform")
            transform = entry(transform, f"{what}: pose.transform")
            pose = np.eye(4)  # the rotation is world-to-camera, column by column
            pose[:3, :3] = matrix(transform.get("rotation"), (9,), f"{what}: pose.rotation").reshape(3, 3)
            pose[:3, 3] = matrix(transform.get("center"), (3,), f"{what}: pose.center")
            key = str(view.get("intrinsicId"))
            lens = alicevision_lens(found(intrinsics, key, what), version, f"{self.src}: intrinsic {key!r}")
            yield from self.frame(file, lens, pose, what)

    def openmvg(self, top: dict) -> Iterator[tuple[str, Frame]]:
        """Of OpenMVG, whose JSON is cereal's: names of types stand where they come first."""
        root = str(top.get("root_path", ""))
        intrinsics, types = self.by_key(top, "intrinsics", "key"), {}
        for own in intrinsics.values():
            value = entry(own.get("value"), f"{self.src}: intrinsics")
            if "polymorphic_name" in value:
                types[polymorphic(value, self.src)] = str(value["polymorphic_name"])
        poses = self.by_key(top, "extrinsics", "key")
        for k, own in enumerate(top["views"]):
            what = f"{self.src}: views[{k}]"
            view = cereal(own, what)
            file = text(view, "filename", what)
            file = str(Path(root, str(view.get("local_path", "")), file))
            pose = poses.get(str(view.get("id_pose")))
            if pose is None:
                self.left_out.add(PureWindowsPath(file).name)
                continue
            pose = entry(pose.get("value"), f"{what}: extrinsics")
            R = matrix(pose.get("rotation"), (3, 3), f"{what}: extrinsics.rotation")
            place = matrix(pose.get("center"), (3,), f"{what}: extrinsics.center")
            key = str(view.get("id_intrinsic"))
            intrinsic = found(intrinsics, key, what)
            kind = types.get(polymorphic(intrinsic["value"], self.src))
            lens = openmvg_lens(cereal(intrinsic, what), kind, f"{self.src}: intrinsic {key!r}")
            yield from self.frame(file, lens, inverse(R, -R @ place), what)

    def by_key(self, top: dict, name: str, key: str) -> dict[str, Any]:
        """A list of the file by the keys of its entries; empty if there is none."""
        values = top.get(name) or []
        if not isinstance(values, list):
            raise InputError(f"{self.src}: {name}: must be a list")
        return {str(entry(value, f"{self.src}: {name}").get(key)): value for value in values}

    def frame(self, file: str, lens: Lens, pose: np.ndarray, what: str) -> Iterator[tuple[str, Frame]]:
        """Of a photograph that may have been elsewhere, on another system, if it is meant."""
        path = self.src.parent / file
        own = path if is_file(path) and not self.images and self.photographs is None else self.photograph(file, what)
        if own:
            yield own.name, Frame(own, lens, pose)


def entry(value: Any, what: str) -> dict:
    """An object of a JSON file. Raises InputError for anything else."""
    if not isinstance(value, dict):
        raise InputError(f"{what}: is {'missing' if value is None else 'no object'}")
    return value


def found(values: dict[str, Any], key: str, what: str) -> dict:
    """The intrinsics of a view."""
    if key not in values:
        raise InputError(f"{what}: intrinsics {key!r}: there are none")
    return values[key]


def text(view: dict, name: str, what: str) -> str:
    """The name of a file."""
    if not isinstance(view.get(name), str) or not view[name]:
        raise InputError(f"{what}: {name}: is missing; must be the name of a photograph")
    return view[name]


def cereal(own: Any, what: str) -> dict:
    """What a pointer of cereal points to, fields of base classes included."""
    wrapper = entry(entry(entry(own, what).get("value"), what).get("ptr_wrapper"), f"{what}: ptr_wrapper")
    data = entry(wrapper.get("data"), f"{what}: data")
    return {**data.get("value0", {}), **data} if isinstance(data.get("value0", {}), dict) else data


def polymorphic(value: dict, path: Path) -> int:
    """The number of a type, whose highest bit says only that its name follows."""
    return int(matrix(value.get("polymorphic_id"), (), f"{path}: intrinsics: polymorphic_id")) & 0x7FFFFFFF


def alicevision_lens(own: dict, version: tuple, what: str) -> Lens:
    """Of AliceVision; pixels' centres are integers. What changed by version is in its sfmDataIO/CHANGES.md."""

    def number(name: str, default: float | None = None) -> float:
        return float(matrix(own.get(name, default), (), f"{what}: {name}"))

    size = np.array([number("width"), number("height")])
    if own.get("pxFocalLength") is not None:
        focal = own["pxFocalLength"]  # one or two
        fx, fy = matrix(focal if isinstance(focal, list) else [focal, focal], (2,), f"{what}: pxFocalLength")
    else:
        sensor, ratio = number("sensorWidth", 36.0), number("pixelRatio", 1.0)
        if min(sensor, ratio) <= 0:
            raise InputError(f"{what}: sensorWidth, pixelRatio: are {sensor:g} and {ratio:g}; must be above 0")
        fx = number("focalLength") / sensor * size[0]
        fy = fx * ratio if version >= (1, 2, 5) else fx / ratio
    centre = matrix(own.get("principalPoint"), (2,), f"{what}: principalPoint") + 0.5
    if version >= (1, 2, 1):
        centre = centre + size / 2
    kind = str(own.get("type"))
    if kind == "pinhole":
        kind = str(own.get("distortionType", kind))
    if str(own.get("undistortionType", "none")) != "none":
        raise InputError(f"{what}: undistortionType: is {own['undistortionType']!r}; must be none")
    return lens_of(size, (fx, fy, *centre), kind, own.get("distortionParams") or [], f"{what}: distortionParams")


def openmvg_lens(own: dict, kind: str | None, what: str) -> Lens:
    """Of OpenMVG; pixels' centres are integers."""
    focal = float(matrix(own.get("focal_length"), (), f"{what}: focal_length"))
    centre = matrix(own.get("principal_point"), (2,), f"{what}: principal_point") + 0.5
    size = matrix([own.get("width"), own.get("height")], (2,), f"{what}: width, height")
    given: Any = next((own[name] for name in COEFFICIENTS if name in own), [])
    return lens_of(size, (focal, focal, *centre), str(kind), given, f"{what}: distortion")


def lens_of(size: np.ndarray, intrinsics: tuple, kind: str, given: Any, what: str) -> Lens:
    """Of fx, fy, cx, cy [px] and a model of distortion; without coefficients there is none."""
    if kind not in MODELS:
        raise InputError(f"{what}: the camera is of type {kind!r}; must be one of {', '.join(MODELS)}")
    count = MODELS[kind]
    terms = [float(term) for term in matrix(given if given else [0.0] * count, (count,), what)]
    if kind.startswith("fisheye"):
        return Lens("OPENCV_FISHEYE", (size[0], size[1]), (*intrinsics, *terms))
    terms += [0.0] * (5 - count)
    return brown(size, intrinsics, terms[:3], terms[3:])
