"""Writes the XML of emitters: lights of photographs, lamps, and the light of rooms."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike

from mi_ring.rendering.spherical_harmonics import MAX_ORDER, PER_FRAME
from mi_ring.scene.lights import Light
from mi_ring.scene.lobes import Lobes

Element = ElementTree.Element


def numbers(values: ArrayLike) -> str:
    """Format numbers as text for XML, separated by spaces."""
    return " ".join(f"{v:.9g}" for v in np.ravel(values))


def emitter_element(light: Light) -> Element:
    """Make the XML element of a light: an emitter of type `point` or `directional`."""
    emitter = ElementTree.Element("emitter", type=light.kind)
    tag, where, strength = {
        "point": ("point", "position", "intensity"), "directional": ("vector", "direction", "irradiance")
    }[light.kind]  # fmt: skip
    x, y, z = (numbers(v) for v in light.vector)
    ElementTree.SubElement(emitter, tag, name=where, x=x, y=y, z=z)
    ElementTree.SubElement(emitter, "rgb", name=strength, value=numbers(light.rgb))
    return emitter


def room_elements(room: np.ndarray, frames: Collection[str] = (), lobes: Lobes | None = None) -> list[Element]:
    """Make the XML of room light: one element for light that is fixed in world axes, one for light in camera axes.

    `room` (BASIS, 3): spherical harmonics, first in world axes, then in camera axes. An element whose light is black is
    left out, unless `frames` contains its axes, "world" or "camera". `lobes`: small lights, in either axes.
    """
    world, camera = room[:PER_FRAME], np.vstack([np.zeros_like(room[:1]), room[PER_FRAME:]])
    # Uniform light belongs to either part.
    if not world[1:].any() and (camera.any() or set(frames) == {"camera"}):
        world, camera = np.zeros_like(world), camera + np.vstack([room[:1], np.zeros_like(room[PER_FRAME:])])
    parts = {"world": world, "camera": camera}
    own = {frame: lobes and lobes.selected(lobes.in_camera == (frame == "camera")) for frame in parts}
    return [room_element(frame, part, own[frame]) for frame, part in parts.items()
            if part.any() or frame in frames or own[frame]]  # fmt: skip


def room_element(frame: str, harmonics: np.ndarray, lobes: Lobes | None = None) -> Element:
    """Make the XML of a `room` emitter: light from all around, in the axes `frame`, "world" or "camera".

    `harmonics` (n, 3): real spherical harmonics of its radiance; n at most PER_FRAME. `lobes`: small lights in these
    axes.
    """
    orders = [(order + 1) ** 2 for order in range(2, MAX_ORDER + 1)]
    harmonics = harmonics[: next(count for count in orders if not harmonics[count:].any())]
    element = ElementTree.Element("emitter", type="room")
    ElementTree.SubElement(element, "string", name="frame", value=frame)
    ElementTree.SubElement(element, "string", name="harmonics", value=numbers(harmonics))
    if lobes:
        ElementTree.SubElement(element, "string", name="lobes", value=numbers(lobes.values()))
    return element
