"""A capture whose cameras and lights are others than its scene file says."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.scenefile import load_element, photograph_element
from mi_ring.geometry.camera import Camera
from mi_ring.rendering.lights import Light
from mi_ring.rendering.photographs import Photographs


def with_calibration(
    capture: Capture, cameras: Sequence[Camera], lights: Sequence[Light], gamma: float = 1.0,
    room: np.ndarray | None = None,
) -> Capture:  # fmt: skip
    """The same photographs with other cameras and lights, one each; the exponents of their curves times `gamma`.

    `room`: light of the room, as `Photographs` has it.
    """
    sensors = []
    for sensor, camera, light in zip(capture.sensors, cameras, lights, strict=True):
        element = photograph_element(
            sensor.id(), str(sensor.filename), camera, light, sensor.mask and str(sensor.mask),
            None if sensor.encoding == "auto" else sensor.encoding, sensor.saturation,
            sensor.valid and str(sensor.valid), sensor.gamma * gamma,
        )  # fmt: skip
        sensors.append(load_element(element))
    return replace(capture, sensors=sensors, photographs=Photographs.of(sensors, room))
