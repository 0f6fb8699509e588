"""Importer of Agisoft Metashape's cameras."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields, xml_names
from mi_ring.geometry.camera import moved_pose
from mi_ring.importers.camera_models import Lens, opencv_lens, pose_of
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import load_xml, matrix

KINDS = ("frame", "fisheye")  #: of sensors
MAX_SKEW = 0.1  #: largest shift of a pixel by b2 [px]


@dataclass(frozen=True)
class Metashape(Photogrammetry):
    """Metashape: File > Export > Export Cameras as Agisoft XML. The light is fixed to the camera.

    SRC is the XML file. The label of a camera is the name of its photograph, with any suffix. Disabled cameras count as
    cameras without a pose. In a rig, each camera has the pose of the master camera, followed by its sensor's rotation
    and location.
    """

    fields = Fields(
        used={
            "sensor@id sensor@type sensor/calibration calibration@type calibration@class": "lenses: frame or fisheye",
            "sensor/resolution calibration/resolution resolution@width resolution@height": "size of the photographs",
            "calibration/f calibration/cx calibration/cy calibration/b1": "intrinsics",
            "calibration/k[1-4] calibration/p[12]": "distortion",
            "camera@label camera@sensor_id camera@component_id": "photograph, lens and place in the world",
            "camera/transform": "pose, camera-to-world",
            "camera@master_id sensor@master_id sensor/rotation/* sensor/location/*": "rigs: the place by the master",
            "camera@enabled": "disabled photographs are left out",
            "component@id component/transform chunk/transform": "from the chunk to the world",
            "transform/rotation transform/translation transform/scale": "from the chunk to the world",
            "chunk/sensors sensors/sensor chunk/cameras cameras/camera": "hold the others",
            "cameras/group group/camera chunk/components components/component": "hold the others",
        },
        refused={
            "calibration/b2": "skew of more than 0.1 px",
            "calibration/p[34]": "tangential terms that OpenCV does not have",
            "sensor/property:rolling_shutter": "cameras that moved during the exposure",
        },
        told={
            "sensor/vignetting/*": "brightness of the corners; a fit may refine it",
            "sensor/corrections/*": "distortion beyond the model",
            "sensor/property:film_camera": "scanned film with marks",
        },
        harmless={
            "*@label *@next_id *@next_group_id *@active_id": "names and counters",
            "chunk@* camera@id camera@type group@* *@locked": "names and settings",
            "camera/rotation_covariance camera/location_covariance sensor/covariance/*": "errors",
            "camera/orientation": "how the camera was held; pixels are as stored",
            "camera/reference/* chunk/reference/* component/region/* component/reference/*": "measured places",
            "camera/photo/* camera/meta/* sensor/meta/* sensor/property:*": "EXIF data and settings",
            "sensor/bands/* sensor/data_type sensor/black_level sensor/sensitivity": "the sensor",
            "chunk/frames/* chunk/images/* chunk/masks/* chunk/markers/* chunk/scalebars/*": "other data of the chunk",
            "chunk/region/* chunk/settings/* chunk/meta/* component/partition/*": "other data of the chunk",
        },
    )

    def posed(self) -> Iterator[Frame]:
        if not (chunks := chunks_of(load_xml(self.src))):
            raise InputError(f"{self.src}: SRC: is no <document> with a <chunk>; must be what File > Export > Export "
                             "Cameras of Metashape writes as Agisoft XML")  # fmt: skip
        chunk = chunks[self.largest([[*own.iterfind("cameras//camera/transform")] for own in chunks], "chunks")]
        self.tell_unused(self.src, xml_names(chunk, self.fields.closed))
        sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
        if repeated := [own for own in chunk.iterfind("sensors/sensor") if sensors[own.get("id")] is not own]:
            raise InputError(f"{self.src}: sensor: two have the id {repeated[0].get('id')!r}; each needs its own")
        components = {component.get("id"): component for component in chunk.iterfind("components/component")}
        cameras = {camera.get("id"): camera for camera in chunk.iterfind("cameras//camera")}
        counts: Counter = Counter()
        for camera in chunk.iterfind("cameras//camera"):
            label = camera.get("label")
            what = f"{self.src}: camera {(label or camera.get('id'))!r}"
            if not label:
                raise InputError(f"{what}: label: is missing; must be the name of a photograph")
            master = cameras.get(camera.get("master_id", camera.get("id")))
            if master is None:
                raise InputError(f"{what}: master_id: is {camera.get('master_id')!r}; there is no such <camera>")
            if master.find("transform") is None or camera.get("enabled") in ("0", "false"):
                self.without_pose.add(label)
                continue
            sensor = sensors.get(camera.get("sensor_id"))
            if sensor is None:
                raise InputError(f"{what}: sensor_id: is {camera.get('sensor_id')!r}; there is no such <sensor>")
            pose = numbers(master, "transform", (4, 4), what)
            if master is not camera:
                pose = pose @ in_rig(sensor, master, f"{self.src}: sensor {sensor.get('id')!r}")
            # Old versions write no components, new ones no transform of the chunk.
            component = components.get(master.get("component_id"))
            counts[master.get("component_id")] += 1
            transform = first_child("transform", component, chunk)
            if transform is not None:
                if master is not camera and numbers(transform, "scale", (1,), what, np.ones(1))[0] != 1:
                    note = f"{self.src}: sensors: their places in rigs are taken in units of the chunk, not scaled"
                    self.notes.extend({note} - {*self.notes})
                pose = in_world(pose, transform, f"{self.src}: transform")
            if image := self.photograph(label, what):
                lens = lens_of(sensor, f"{self.src}: sensor {sensor.get('id')!r}")
                yield Frame(image, lens, pose, said=label)
        if len(counts) > 1:
            sizes = ", ".join(f"{count} of {name}" for name, count in counts.most_common())
            self.notes.append(f"{self.src}: component_id: photographs are {sizes}; components that are not aligned "
                              "with each other have places of their own: export one of them alone")  # fmt: skip


def chunks_of(root: ElementTree.Element) -> list[ElementTree.Element]:
    """Return the <chunk> elements of a Metashape XML file, whose root is given; empty for other XML files."""
    return root.findall("chunk") if root.tag == "document" else []


def first_child(path: str, *parents: ElementTree.Element | None) -> ElementTree.Element | None:
    """Return the first element at `path` in one of the elements `parents`, in their order; None if there is none.

    A parent may be None and is then skipped.
    """
    children = (parent.find(path) for parent in parents if parent is not None)
    return next((child for child in children if child is not None), None)


def numbers(
    parent: ElementTree.Element, name: str, shape: tuple[int, ...], what: str, default: np.ndarray | None = None
) -> np.ndarray:
    """Read the numbers in the child element `name` of the XML element `parent`. Returns an array of this `shape`.

    `default`: result if the child is missing; None: this is an error. Raises InputError if the numbers are missing or
    invalid. The message begins with `what`.
    """
    text = parent.findtext(name)
    if text is None and default is not None:
        return default
    flat = matrix(None if text is None else text.split(), (int(np.prod(shape)),), f"{what}: {name}")
    return flat.reshape(shape)


def in_world(pose: np.ndarray, transform: ElementTree.Element, what: str) -> np.ndarray:
    """Convert a camera-to-chunk pose (4, 4) to a camera-to-world pose (4, 4).

    `transform`: the XML element with rotation, translation and scale of the chunk. Each of these may be missing. Raises
    InputError if the scale is not positive. The message begins with `what`.
    """
    rotation = numbers(transform, "rotation", (3, 3), what, np.eye(3))
    shift = numbers(transform, "translation", (3,), what, np.zeros(3))
    scale = numbers(transform, "scale", (1,), what, np.ones(1))[0]
    if scale <= 0:
        raise InputError(f"{what}: scale: is {scale}; must be above 0")
    return moved_pose(pose, scale, rotation, shift)


def in_rig(sensor: ElementTree.Element, master: ElementTree.Element, what: str) -> np.ndarray:
    """Return the pose (4, 4) of a camera in a rig, relative to the rig's master camera.

    `sensor`: XML element of the camera's sensor, which has this pose. `master`: XML element of the master camera.
    Raises InputError if the pose is missing, or if it is relative to another sensor. The message begins with `what`.
    """
    if sensor.get("master_id") != master.get("sensor_id"):
        raise InputError(f"{what}: master_id: is {sensor.get('master_id')!r}, but the master of its camera has sensor "
                         f"{master.get('sensor_id')!r}; export the cameras as COLMAP or Bundler")  # fmt: skip
    return pose_of(numbers(sensor, "rotation", (3, 3), what), numbers(sensor, "location", (3,), what))


def lens_of(sensor: ElementTree.Element, what: str) -> Lens:
    """Make the lens of a <sensor> element, by the formulas in appendix D of Metashape's manual.

    Raises InputError if this kind of lens is not supported. The message begins with `what`.
    """
    if sensor.get("type", "frame") not in KINDS:  # a panorama has no calibration
        raise InputError(f"{what}: type: is {sensor.get('type')!r}; must be frame or fisheye; leave such "
                         "photographs out")  # fmt: skip
    shutter = sensor.find("property[@name='rolling_shutter']")
    if shutter is not None and (state := shutter.get("value", "")).lower() not in ("false", "0", "disabled"):
        raise InputError(f"{what}: rolling_shutter: is {state}, which is not supported; align without rolling shutter "
                         "compensation")  # fmt: skip
    calibration = sensor.find("calibration[@class='adjusted']")
    if calibration is None:
        calibration = sensor.find("calibration")
    if calibration is None:
        raise InputError(f"{what}: calibration: is missing; align the photographs first")
    resolution = first_child("resolution", calibration, sensor)
    sides = None if resolution is None else [resolution.get("width"), resolution.get("height")]
    width, height = matrix(sides, (2,), f"{what}: resolution")
    f = numbers(calibration, "f", (1,), what)[0]
    cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4 = (
        numbers(calibration, name, (1,), what, np.zeros(1))[0]
        for name in ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    )
    if f > 0 and abs(b2) * height / 2 / f > MAX_SKEW:
        raise InputError(f"{what}: b2: is {b2}, a skew, which is not supported; optimize the cameras without b2")
    if p3 or p4:
        raise InputError(f"{what}: {'p3' if p3 else 'p4'}: is {p3 or p4}; must be 0; optimize the cameras without it")
    intrinsics = (f + b1, f, width / 2 + cx, height / 2 + cy)
    kind = calibration.get("type", sensor.get("type"))
    if kind == "fisheye":
        return Lens("THIN_PRISM_FISHEYE", (width, height), (*intrinsics, k1, k2, p2, p1, k3, k4, 0, 0))
    if kind != "frame":
        raise InputError(f"{what}: type: is {kind!r}; must be frame or fisheye")
    if k4:
        raise InputError(f"{what}: k4: is {k4}; only a fisheye may have one; optimize the cameras without k4")
    return opencv_lens((width, height), intrinsics, (k1, k2, k3), (p2, p1))  # OpenCV's p1 and p2 are swapped
