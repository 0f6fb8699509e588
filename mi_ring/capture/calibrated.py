"""A capture whose cameras and lights are others than its scene file says."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.scenefile import load_element, photograph_element
from mi_ring.geometry.camera import Camera
from mi_ring.rendering.lights import Light, Lights
from mi_ring.rendering.photographs import Photographs


def with_calibration(
    capture: Capture, cameras: Sequence[Camera], lights: Sequence[Light], gamma: float = 1.0,
    room: np.ndarray | None = None, falloff: Sequence[float] | None = None, vignetting: float = 0.0,
    contrast: float = 1.0,
) -> Capture:  # fmt: skip
    """The same photographs with other cameras and lights, one each; their curves' `gamma` and `contrast` times these.

    `room`: light of the room, as `Photographs` has it; `falloff`: exponents of the flashes' cones, one each, by default
    as they are; `vignetting`: what is added to the exponents of the lenses'.
    """
    sensors = []
    cones = [sensor.cone for sensor in capture.sensors] if falloff is None else falloff
    for sensor, camera, light, cone in zip(capture.sensors, cameras, lights, cones, strict=True):
        element = photograph_element(
            sensor.id(), str(sensor.filename), camera, light, sensor.mask and str(sensor.mask),
            None if sensor.encoding == "auto" else sensor.encoding, sensor.saturation,
            sensor.valid and str(sensor.valid), sensor.gamma * gamma,
            falloff=cone, vignetting=sensor.vignetting + vignetting, contrast=sensor.contrast * contrast,
        )  # fmt: skip
        sensors.append(load_element(element))
    return replace(capture, sensors=sensors, photographs=Photographs.of(sensors, room))


def moved(capture: Capture, matrix: np.ndarray) -> Capture:
    """The same photographs, with the cameras and lights of a scene that a similarity (4, 4) has moved.

    What else the scene holds (a room, a table, lamps) stays as it is: for small motions.
    """
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    rotation = matrix[:3, :3] / scale
    cameras, lights, before = [], [], Lights.of(capture.sensors)
    for k, sensor in enumerate(capture.sensors):
        light = before[k]
        to_world = matrix @ sensor.camera.to_world
        to_world[:3, :3] /= scale
        cameras.append(sensor.camera._replace(to_world=to_world))
        if light.kind == "point":  # as bright as before from scaled distances
            lights.append(Light("point", matrix[:3, :3] @ light.vector + matrix[:3, 3], scale**2 * light.rgb))
        else:
            lights.append(light._replace(vector=rotation @ light.vector))
    return with_calibration(capture, cameras, lights, room=capture.photographs.room)
