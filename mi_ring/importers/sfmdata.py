"""Importer of scenes of Meshroom (AliceVision) and OpenMVG."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields, json_names
from mi_ring.importers.camera_models import Lens, opencv_lens, pose_of
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import load_json, matrix, require_object

#: Number of coefficients of each distortion model, by both programs' names. Of five, the last two are tangential.
MODELS = {
    "pinhole": 0, "none": 0, "radial1": 1, "radialk1": 1, "radial3": 3, "radialk3": 3, "brown": 5, "fisheye4": 4,
    "fisheye": 4, "pinhole_radial_k1": 1, "pinhole_radial_k3": 3, "pinhole_brown_t2": 5,
}  # fmt: skip
COEFFICIENTS = ("disto_k1", "disto_k3", "disto_t2", "fisheye")  #: OpenMVG's fields of the coefficients


@dataclass(frozen=True)
class SfmData(Photogrammetry):
    """Meshroom's cameras.sfm or sfm.json, OpenMVG's sfm_data.json. The light is fixed to the camera.

    SRC is the file. It names the photographs. If they were moved, give --images.
    """

    fields = Fields(
        used={
            "version": "Meshroom: which conventions hold",
            "views/path views/poseId views/viewId views/intrinsicId": "Meshroom: photograph, pose and lens",
            "poses/poseId poses/pose pose/transform transform/rotation transform/center": "Meshroom: camera-to-world",
            "pose/rotationOnly": "Meshroom: such photographs have no place, and are left out",
            "views/isPoseIndependant views/rigId views/subPoseId rigs/rigId": "Meshroom: photographs of rigs",
            "subPoses/status subPoses/pose pose/rotation pose/center": "Meshroom: places of the cameras in a rig",
            "intrinsics/intrinsicId intrinsics/width intrinsics/height": "Meshroom: size of the photographs",
            "intrinsics/sensorWidth intrinsics/focalLength intrinsics/pxFocalLength intrinsics/pixelRatio": "Meshroom",
            "intrinsics/principalPoint": "Meshroom: intrinsics",
            "intrinsics/type intrinsics/distortionType intrinsics/distortionParams": "Meshroom: distortion",
            "root_path data/local_path data/filename data/id_intrinsic data/id_pose": "OpenMVG: photograph, lens, pose",
            "value/rotation value/center": "OpenMVG: pose, world-to-camera",
            "value/polymorphic_id value/polymorphic_name": "OpenMVG: the kind of lens",
            "data/width data/height data/focal_length data/principal_point": "OpenMVG: intrinsics",
            "value0/width value0/height value0/focal_length value0/principal_point": "OpenMVG: intrinsics",
            "data/disto_k1 data/disto_k3 data/disto_t2 data/fisheye": "OpenMVG: distortion",
            "views poses intrinsics rigs rigs/subPoses extrinsics": "hold the others",
            "*/key */value value/ptr_wrapper ptr_wrapper/data data/value0": "hold the others",
        },
        refused={
            "intrinsics/undistortionType": "a second model of the lens",
        },
        harmless={
            "views/frameId views/resectionId views/ancestor* views/imageGroup*": "numbers",
            "views/width views/height": "the size is the lens's",
            "views/metadata/*": "EXIF data",
            "pose/locked pose/removable intrinsics/*[lL]ocked": "settings",
            "intrinsics/initial* intrinsics/pxInitialFocalLength intrinsics/distortionInitializationMode": "guesses",
            "intrinsics/serialNumber intrinsics/sensorHeight": "the camera",
            "intrinsics/undistortionOffset intrinsics/undistortionParams": "of undistortionType",
            "intrinsics/fisheyeC* intrinsics/fisheyeR*": "where a fisheye's picture ends",
            "structure/* control_points/* controlPoints/* landmarks/* constraints*": "points",
            "rotationpriors/* surveypoints/* featuresFolders matchesFolders": "of the alignment",
            "sfm_data_version ptr_wrapper/id data/id_view": "numbers",
            "data/use_pose_* data/center* data/rotation*": "measured places and directions",
        },
    )  # fmt: skip

    def posed(self) -> Iterator[Frame]:
        if self.src.suffix.lower() == ".abc":
            raise InputError(f"{self.src}: SRC: is an Alembic file, which is not read; convert it to .sfm by "
                             "Meshroom's node ConvertSfMFormat")  # fmt: skip
        top = load_json(self.src)
        if not isinstance(top, dict) or not isinstance(top.get("views"), list):
            raise InputError(f"{self.src}: views: is missing; must be a scene of Meshroom or OpenMVG")
        self.tell_unused(self.src, json_names(top, self.fields.closed))
        yield from self.openmvg(top) if "extrinsics" in top or "root_path" in top else self.alicevision(top)

    def alicevision(self, top: dict) -> Iterator[Frame]:
        """Yield the photographs with a pose in a Meshroom file. `top`: its top-level JSON object."""
        version = tuple(matrix(top.get("version", [1, 0, 0]), (3,), f"{self.src}: version"))
        intrinsics = self.by_key(top, "intrinsics", "intrinsicId")
        poses, rigs = self.by_key(top, "poses", "poseId"), self.by_key(top, "rigs", "rigId")
        for k, view in enumerate(top["views"]):
            what = f"{self.src}: views[{k}]"
            file = file_name(require_object(view, what), "path", what)
            if (pose := view_pose(poses, rigs, view, what)) is None:
                self.without_pose.add(PureWindowsPath(file).name)
                continue
            key = str(view.get("intrinsicId"))
            intrinsic = require_object(intrinsics.get(key), f"{what}: intrinsics {key!r}")
            lens = alicevision_lens(intrinsic, version, f"{self.src}: intrinsic {key!r}")
            yield from self.frame(file, lens, pose, what)

    def openmvg(self, top: dict) -> Iterator[Frame]:
        """Yield the photographs with a pose in an OpenMVG file. `top`: its top-level JSON object.

        OpenMVG writes with the library cereal. This names a polymorphic type where it is first used, and later gives
        only its number.
        """
        root = str(top.get("root_path", ""))
        intrinsics, types = self.by_key(top, "intrinsics", "key"), {}
        for own in intrinsics.values():
            value = require_object(own.get("value"), f"{self.src}: intrinsics")
            if "polymorphic_name" in value:
                types[type_number(value, self.src)] = str(value["polymorphic_name"])
        poses = self.by_key(top, "extrinsics", "key")
        for k, own in enumerate(top["views"]):
            what = f"{self.src}: views[{k}]"
            view = pointed_to(require_object(own, what), what)
            file = str(Path(root, str(view.get("local_path", "")), file_name(view, "filename", what)))
            pose = poses.get(str(view.get("id_pose")))
            if pose is None:
                self.without_pose.add(PureWindowsPath(file).name)
                continue
            pose = require_object(pose.get("value"), f"{what}: extrinsics")
            R = matrix(pose.get("rotation"), (3, 3), f"{what}: extrinsics.rotation")
            center = matrix(pose.get("center"), (3,), f"{what}: extrinsics.center")
            key = str(view.get("id_intrinsic"))
            intrinsic = require_object(intrinsics.get(key), f"{what}: intrinsics {key!r}")
            kind = types.get(type_number(intrinsic["value"], self.src))
            lens = openmvg_lens(pointed_to(intrinsic, what), kind, f"{self.src}: intrinsic {key!r}")
            yield from self.frame(file, lens, pose_of(R.T, center), what)

    def by_key(self, top: dict, name: str, key: str) -> dict[str, Any]:
        """Return the objects in the list `top[name]`, by the value of their field `key`; empty if there is no list.

        `top`: the top-level JSON object. Raises InputError if two objects have the same value.
        """
        values = top.get(name) or []
        if not isinstance(values, list):
            raise InputError(f"{self.src}: {name}: must be a list")
        found = {str(require_object(value, f"{self.src}: {name}").get(key)): value for value in values}
        if len(found) < len(values):
            raise InputError(f"{self.src}: {name}: two entries have the same {key}; each needs its own")
        return found

    def frame(self, file: str, lens: Lens, pose: np.ndarray, what: str) -> Iterator[Frame]:
        """Yield the frame of the photograph that the file calls `file`, or nothing if no image file is found for it.

        `pose` (4, 4): camera-to-world, OpenCV's axes. `what`: beginning of error messages.
        """
        if own := self.photograph(file, what, relative=True):
            yield Frame(own, lens, pose, said=file)


def file_name(view: dict, field: str, what: str) -> str:
    """Return the text `view[field]`, the name of a photograph. Raises InputError if it is missing.

    `view`: JSON object of a photograph. The message begins with `what`.
    """
    if not isinstance(view.get(field), str) or not view[field]:
        raise InputError(f"{what}: {field}: is missing; must be the name of a photograph")
    return view[field]


def pointed_to(own: dict, what: str) -> dict:
    """Return the JSON object to which a smart pointer refers, as the library cereal writes it.

    `own`: JSON object with the pointer. Fields of the base class are included. Raises InputError if there is no such
    object. The message begins with `what`.
    """
    wrapper = require_object(require_object(own.get("value"), what).get("ptr_wrapper"), f"{what}: ptr_wrapper")
    data = require_object(wrapper.get("data"), f"{what}: data")
    return {**data.get("value0", {}), **data} if isinstance(data.get("value0", {}), dict) else data


def type_number(value: dict, path: Path) -> int:
    """Return the number of the polymorphic type of a JSON object that the library cereal has written.

    Its highest bit is removed, which only says that a name follows. `path`: the file, for the message. Raises
    InputError if there is no number.
    """
    return int(matrix(value.get("polymorphic_id"), (), f"{path}: intrinsics: polymorphic_id")) & 0x7FFFFFFF


def view_pose(poses: dict[str, Any], rigs: dict[str, Any], view: dict, what: str) -> np.ndarray | None:
    """Return the camera-to-world pose (4, 4) of a photograph; None if AliceVision has not found it.

    `poses`, `rigs`: JSON objects by number. `view`: JSON object of the photograph. Raises InputError if they are
    invalid. The message begins with `what`.
    """
    own = poses.get(str(view.get("poseId", view.get("viewId"))))
    if own is None:
        return None
    place = require_object(own.get("pose"), f"{what}: pose")
    if str(place.get("rotationOnly")).lower() in ("true", "1"):
        return None
    pose = alicevision_pose(place.get("transform"), f"{what}: pose")
    if str(view.get("isPoseIndependant", True)).lower() not in ("false", "0"):
        return pose
    in_rig = rig_pose(rigs, view, what)  # `pose` is that of the rig
    return None if in_rig is None else pose @ in_rig


def alicevision_pose(transform: Any, what: str) -> np.ndarray:
    """Return the pose (4, 4) in a JSON object of AliceVision: camera-to-world, or camera-to-rig.

    Raises InputError if it is invalid. The message begins with `what`.
    """
    own = require_object(transform, what)
    # The file has the rotation of world to camera by columns. Read by rows, it is the rotation of camera to world.
    R = matrix(own.get("rotation"), (9,), f"{what}.rotation").reshape(3, 3)
    return pose_of(R, matrix(own.get("center"), (3,), f"{what}.center"))


def rig_pose(rigs: dict[str, Any], view: dict, what: str) -> np.ndarray | None:
    """Return the camera-to-rig pose (4, 4) of a photograph; None if AliceVision has not found it.

    `rigs`: JSON objects of the rigs by number. `view`: JSON object of the photograph. Raises InputError if there is no
    such rig or camera. The message begins with `what`.
    """
    rig, number = str(view.get("rigId")), matrix(view.get("subPoseId"), (), f"{what}: subPoseId")
    cameras = require_object(rigs.get(rig), f"{what}: rigs {rig!r}").get("subPoses")
    if not isinstance(cameras, list) or number not in range(len(cameras)):
        raise InputError(f"{what}: subPoseId: is {number:g}; rig {rig} has no such camera")
    camera = require_object(cameras[int(number)], f"{what}: subPoses")
    if str(camera.get("status")).lower() == "uninitialized":
        return None
    return alicevision_pose(camera.get("pose"), f"{what}: subPoses[{number:g}].pose")


def alicevision_lens(own: dict, version: tuple, what: str) -> Lens:
    """Make a lens from the JSON object `own` of an AliceVision camera. In AliceVision, pixel centres are integers.

    `version`: three numbers of the file's version, on which the meaning of fields depends; see sfmDataIO/CHANGES.md of
    AliceVision. Raises InputError if a field is invalid. The message begins with `what`.
    """

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
    """Make a lens from the JSON object `own` of an OpenMVG camera. In OpenMVG, pixel centres are integers.

    `kind`: name of its type, which says the distortion model. Raises InputError if a field is invalid. The message
    begins with `what`.
    """
    focal = float(matrix(own.get("focal_length"), (), f"{what}: focal_length"))
    centre = matrix(own.get("principal_point"), (2,), f"{what}: principal_point") + 0.5
    size = matrix([own.get("width"), own.get("height")], (2,), f"{what}: width, height")
    given: Any = next((own[name] for name in COEFFICIENTS if name in own), [])
    return lens_of(size, (focal, focal, *centre), str(kind), given, f"{what}: distortion")


def lens_of(size: np.ndarray, intrinsics: tuple, kind: str, given: Any, what: str) -> Lens:
    """Make a lens with a distortion model of AliceVision or OpenMVG.

    `size`: (width, height) [px]. `intrinsics`: fx, fy, cx, cy [px]. `kind`: name of the model, a key of `MODELS`.
    `given`: coefficients of the model, read from a file; empty: all 0. Raises InputError if the model is unknown or
    `given` is invalid. The message begins with `what`.
    """
    if kind not in MODELS:
        raise InputError(f"{what}: the camera is of type {kind!r}; must be one of {', '.join(MODELS)}")
    count = MODELS[kind]
    terms = [float(term) for term in matrix(given if given else [0.0] * count, (count,), what)]
    if kind.startswith("fisheye"):
        return Lens("OPENCV_FISHEYE", (size[0], size[1]), (*intrinsics, *terms))
    terms += [0.0] * (5 - count)
    return opencv_lens(size, intrinsics, terms[:3], terms[3:])
