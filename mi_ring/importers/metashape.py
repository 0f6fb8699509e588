"""Agisoft Metashape's cameras."""

from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens, brown
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import load_xml, matrix

SKEW = 0.1  #: most that b2 may move any pixel by [px]


@dataclass(frozen=True)
class Metashape(Photogrammetry):
    """Metashape: File > Export > Export Cameras as Agisoft XML. The light is beside the camera.

    SRC is the XML file. Photographs are found by the labels of the cameras, with any suffix. Disabled cameras have no
    pose.
    """

    def posed(self) -> Iterator[tuple[str, Frame]]:
        chunk = chunk_of(load_xml(self.src))
        if chunk is None:
            raise InputError(f"{self.src}: SRC: is no <document> with a <chunk>; must be what File > Export > Export "
                             "Cameras of Metashape writes as Agisoft XML")  # fmt: skip
        sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
        components = {own.get("id"): own for own in chunk.iterfind("components/component")}
        for camera in chunk.iterfind("cameras//camera"):
            label = camera.get("label")
            what = f"{self.src}: camera {(label or camera.get('id'))!r}"
            if not label:
                raise InputError(f"{what}: label: is missing; must be the name of a photograph")
            if camera.find("transform") is None or camera.get("enabled") in ("0", "false"):
                self.left_out.add(label)
                continue
            sensor = sensors.get(camera.get("sensor_id"))
            if sensor is None:
                raise InputError(f"{what}: sensor_id: is {camera.get('sensor_id')!r}; there is no such <sensor>")
            pose = numbers(camera, "transform", (4, 4), what)
            frame = components.get(camera.get("component_id"))
            for outer in (frame, chunk):  # old versions have no components, new ones no transform of the chunk
                transform = None if outer is None else outer.find("transform")
                if transform is not None:
                    pose = in_world(pose, transform, f"{self.src}: transform")
                    break
            if (image := self.photograph(label, what)) is None:
                continue
            yield image.name, Frame(image, lens(sensor, f"{self.src}: sensor {sensor.get('id')!r}"), pose)


def chunk_of(root: ElementTree.Element) -> ElementTree.Element | None:
    """Of an XML file, if it is one of Metashape's."""
    return root.find("chunk") if root.tag == "document" else None


def numbers(parent: ElementTree.Element, name: str, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Those of a child, row by row. Raises InputError if they are missing or others."""
    text = parent.findtext(name)
    flat = matrix(None if text is None else text.split(), (int(np.prod(shape)),), f"{what}: {name}")
    return flat.reshape(shape)


def in_world(pose: np.ndarray, transform: ElementTree.Element, what: str) -> np.ndarray:
    """A pose (4, 4) in the frame of a chunk, of which `transform` says where it is; parts of it may be missing."""
    turn = numbers(transform, "rotation", (3, 3), what) if transform.find("rotation") is not None else np.eye(3)
    shift = numbers(transform, "translation", (3,), what) if transform.find("translation") is not None else np.zeros(3)
    scale = numbers(transform, "scale", (1,), what)[0] if transform.find("scale") is not None else 1.0
    if scale <= 0:
        raise InputError(f"{what}: scale: is {scale}; must be above 0")
    pose = pose.copy()
    pose[:3, 3] = scale * turn @ pose[:3, 3] + shift
    pose[:3, :3] = turn @ pose[:3, :3]
    return pose


def lens(sensor: ElementTree.Element, what: str) -> Lens:
    """The calibration of a sensor; its formulas are in appendix D of Metashape's manual."""
    calibration = sensor.find("calibration[@class='adjusted']")
    if calibration is None:
        calibration = sensor.find("calibration")
    if calibration is None:
        raise InputError(f"{what}: calibration: is missing; align the photographs first")
    resolution = calibration.find("resolution")
    if resolution is None:
        resolution = sensor.find("resolution")
    sides = None if resolution is None else [resolution.get("width"), resolution.get("height")]
    width, height = matrix(sides, (2,), f"{what}: resolution")
    names = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    there = [name for name in names if calibration.find(name) is not None]
    given = {name: float(numbers(calibration, name, (1,), what)[0]) for name in there}
    f = float(numbers(calibration, "f", (1,), what)[0])
    cx, cy, b1, b2, k1, k2, k3, k4, p1, p2, p3, p4 = (given.get(name, 0.0) for name in names)
    if f > 0 and abs(b2) * height / 2 / f > SKEW:
        raise InputError(f"{what}: b2: is {b2}, pixels are sheared, which no photograph can be here; optimize the "
                         "cameras without b2")  # fmt: skip
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
    return brown((width, height), intrinsics, (k1, k2, k3), (p2, p1))  # p1 and p2 are those of OpenCV swapped
