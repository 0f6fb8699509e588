"""Renders the same photographs with mi_ring's `photometric` and with Mitsuba's path tracer, for a comparison."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.capture.loading import open_scene, photographs_in
from mi_ring.errors import InputError, SceneError
from mi_ring.plugins import flash, photograph, shapenet
from mi_ring.rendering.image_formation import render_photographs
from mi_ring.rendering.photographs import Photographs, pixel_rays
from mi_ring.scene.assembly import assembled, split_tables, top_level_emitters
from mi_ring.scene.lights import is_room
from mi_ring.scene.mesh_attributes import attributes_of, optional_of, require_attributes

BATCHES = 16  #: independent renderings of each photograph; their spread is the Monte Carlo noise
LANES = 1 << 21  #: most rays in one launch


@dataclass
class Pictures:
    """Pictures of one photograph by `photometric` and by Mitsuba's `path`, as linear radiance.

    Each field has 16 independent renderings of it, (16, H, W, 3), whose spread is the Monte Carlo noise.
    """

    photometric: np.ndarray
    unshadowed: np.ndarray  #: photometric without shadows, same samples
    path: np.ndarray
    direct: np.ndarray  #: direct light of `path`, same samples


def open_lit_scene(path: Path) -> tuple[mi.Scene, list]:
    """Load a scene file for a comparison of renderers. Returns (scene, list of its `photograph` sensors).

    Tables and room light are removed from the scene. A `flash` emitter is added, with which Mitsuba's own integrators
    use the photographs' lights. Raises InputError if the scene is not suitable, for example because a `shapenet` has no
    fitted object.
    """
    scene, shots = open_scene(path)
    try:
        for shape in scene.shapes():
            require_attributes(shape)
            needed = attributes_of(shape.bsdf()) - optional_of(shape.bsdf())
            if isinstance(shape, shapenet.ShapeNetMesh) and shape.ring is None and needed:
                raise SceneError(f"{shape.id()}: has no weights, so there is no object yet; give the folder of its fit")
        Photographs.of(shots)
        return with_flash(split_tables(scene)[0]), photographs_in(scene)
    except SceneError as error:
        raise InputError(f"{path}: {error}") from error


def with_flash(scene: mi.Scene) -> mi.Scene:
    """Return the scene with exactly one `flash` emitter and without `room` emitters, for Mitsuba's own integrators.

    A `flash` that belongs to a `shapenet` counts. Raises SceneError if the scene has several.
    """
    count = sum(isinstance(emitter, flash.Flash) for emitter in scene.emitters())
    if count > 1:
        raise SceneError(f"flash: found {count} of them, so the light would count {count} times; "
                         'set <boolean name="flash" value="false"/> in all shapenets but one')  # fmt: skip
    emitters = top_level_emitters(scene)
    others = [emitter for emitter in emitters if not is_room(emitter)]
    if count == 1 and len(others) == len(emitters):
        return scene
    return assembled(scene.shapes(), others if count else [mi.load_dict({"type": "flash"}), *others])


def render_both(
    scene: mi.Scene, photographs: Photographs, k: int, sensor: Any, scale: int, spp: int, depth: int, seed: int
) -> Pictures:
    """Render photograph `k` by `photometric` and by Mitsuba's `path`, 16 times each.

    `sensor`: the sensor of the photograph. `scale`: divides width and height of the pictures. `spp`: samples per pixel.
    `depth`: largest length of the light paths, Mitsuba's max_depth. Seeds are from `seed` to `seed` + 31; the two
    renderers have different ones. The film's filter is not used.
    """
    size = sensor.camera.size
    width, height = (s // scale for s in size)
    pixels = width * height
    group = max(1, min(BATCHES, LANES // (pixels * spp)))
    parts = []
    for first in range(0, BATCHES, group):
        batch = photographs.select([k] * min(group, BATCHES - first), size, scale)
        own, other = seed + 2 * first, seed + 2 * first + 1
        parts.append([
            render_photographs(scene, batch, spp, own),
            render_photographs(scene, batch, spp, own, shadows=False),
            render_path(scene, batch, sensor, spp, other, depth),
            render_path(scene, batch, sensor, spp, other, 2),
        ])  # fmt: skip
        dr.eval(parts[-1])
    return Pictures(*(
        np.concatenate([np.stack([np.array(c).reshape(-1, height, width) for c in p[:3]], -1) for p in which])
        for which in zip(*parts)
    ))  # fmt: skip


def render_path(
    scene: mi.Scene, photographs: Photographs, sensor: Any, spp: int, seed: int, depth: int
) -> list[mi.Float]:
    """Render a photograph by Mitsuba's `path`. Returns [R, G, B], Dr.Jit arrays with one radiance per pixel.

    `photographs`: the photograph of `sensor`, once or several times; pictures follow one another. `depth`: largest
    length of the light paths.
    """
    photograph.Photograph.current = sensor
    ray, _ = pixel_rays(photographs, spp, seed)
    ray.time = photograph.SHUTTER
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(ray))
    integrator = mi.load_dict({"type": "path", "max_depth": depth})
    radiance, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))
    dr.schedule(radiance)
    return [dr.block_sum(c, spp) / spp for c in radiance]
