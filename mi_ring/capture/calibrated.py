"""A capture whose cameras and lights are others than its scene file says."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.scenefile import photograph_element
from mi_ring.geometry.camera import Camera, moved_pose
from mi_ring.rendering.photograph_lights import Lights
from mi_ring.rendering.photographs import Photographs
from mi_ring.scene.assembly import with_lamps
from mi_ring.scene.lights import Light
from mi_ring.scene.xml_elements import load_element


def with_calibration(
    capture: Capture, cameras: Sequence[Camera], lights: Sequence[Light], gamma: float = 1.0,
    room: np.ndarray | None = None, falloff: Sequence[float] | None = None, vignetting: float = 0.0,
    contrast: float = 1.0, gains: np.ndarray | float = 1.0, lamps: Iterable[Light] | None = None,
) -> Capture:  # fmt: skip
    """The same photographs with other cameras and lights, one each; their curves' `gamma` and `contrast` times these.

    `room`: light of the room, as `Photographs` has it; `falloff`: exponents of the flashes' cones, one each, by default
    as they are; `vignetting`: what is added to the exponents of the lenses'; `gains` (P, 3): factors of what the
    photographs record; `lamps`: point lights and distant ones of the scene, by default as they are.
    """
    sensors = []
    cones = [sensor.cone for sensor in capture.sensors] if falloff is None else falloff
    gains = np.broadcast_to(gains, (len(cameras), 3))
    for sensor, camera, light, cone, gain in zip(capture.sensors, cameras, lights, cones, gains, strict=True):
        element = photograph_element(
            sensor.id(), str(sensor.filename), camera, light, sensor.mask and str(sensor.mask),
            None if sensor.encoding == "auto" else sensor.encoding, sensor.saturation,
            sensor.valid and str(sensor.valid), sensor.gamma * gamma,
            calibrated=sensor.calibrated, falloff=cone, vignetting=sensor.vignetting + vignetting,
            contrast=sensor.contrast * contrast,
            ambient=sensor.ambient and str(sensor.ambient), gain=sensor.gain * gain,
        )  # fmt: skip
        sensors.append(load_element(element))
    scene = capture.scene if lamps is None else with_lamps(capture.scene, lamps)
    return replace(capture, scene=scene, sensors=sensors, photographs=Photographs.of(sensors, room))


def moved(capture: Capture, scale: float, rotation: np.ndarray, shift: np.ndarray) -> Capture:
    """The same photographs, with cameras and lights in another frame: x ↦ scale · rotation (3, 3) x + shift (3,).

    What else the scene holds (a room, a table, lamps) stays as it is: for small motions.
    """
    cameras, lights, before = [], [], Lights.of(capture.sensors)
    for k, sensor in enumerate(capture.sensors):
        light = before[k]
        cameras.append(sensor.camera._replace(to_world=moved_pose(sensor.camera.to_world, scale, rotation, shift)))
        if light.kind == "point":  # as bright as before from scaled distances
            lights.append(Light("point", scale * rotation @ light.vector + shift, scale**2 * light.rgb))
        else:
            lights.append(light._replace(vector=rotation @ light.vector))
    return with_calibration(capture, cameras, lights, room=capture.photographs.room)
