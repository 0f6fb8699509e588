"""A bumpy ball with two photographs, whose pictures and gradients are tested."""

import mitsuba as mi
import numpy as np
import torch
import trimesh

from mi_ring.rendering import prediction
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.rendering.surface import Surface
from mi_ring.system import machine

WIDTH, HEIGHT, COUNT = 35, 25, 2  # [px], photographs
CENTER = np.array([0.3, -0.2, 0.15])
OFF_CAMERA = [
    {"type": "point", "position": [2.6, 1.4, 2.5], "intensity": {"type": "rgb", "value": [20.0, 16.0, 12.0]}},
    {"type": "directional", "direction": [0.7, -0.5, -1.0], "irradiance": 2.0},
]
WALL = {
    "type": "rectangle",
    "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).rotate([0, 0, 1], 20).scale([0.9, 2.5, 1]),
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}},
}


class Setting:
    """A bumpy ball off the origin, two photographs of it, and two losses: random weightings of radiance and coverage.

    `unit` scales the world: lengths by `unit`, intensities by its square, so that the pictures stay the same.
    """

    def __init__(self, lights, shadows, wall=False, unit=1.0, room=False):
        self.shadows, self.unit = shadows, unit
        sensors = {f"sensor{k}": self.photograph(k, light) for k, light in enumerate(lights)}
        ball = {"type": "shapenet", "id": "ball", "subdivisions": 3, "bsdf": {"type": "cooktorrance"}}
        world = {"type": "scene", "ball": ball, **({"wall": WALL} if wall else {}), **sensors}
        self.scene = mi.load_dict(world, parallel=False)  # plugins in Python fail now and then in several threads
        shape = next(s for s in self.scene.shapes() if s.id() == "ball")
        self.surface = Surface(self.scene, shape)
        harmonics = np.random.default_rng(9).normal(0, 0.4, (BASIS, 3)) if room else None
        self.photographs = Photographs.of([sensor.shot for sensor in self.scene.sensors()], harmonics)
        ico = trimesh.creation.icosphere(subdivisions=3)
        self.s, self.faces = ico.vertices, ico.faces
        self.surface.set_faces(self.faces)
        x, y, z = self.s.T
        bumps = 1 + 0.1 * np.sin(3 * x + 1) + 0.08 * np.cos(4 * y - z) - 0.1 * np.exp(-6 * (z - 0.7) ** 2 - 4 * x**2)
        self.vertices = tensor(unit * (CENTER + 0.8 * self.s * bumps[:, None]))
        diffuse = tensor(np.stack([0.3 + 0.2 * np.sin(2 * x), 0.25 + 0.1 * y, 0.2 + 0.1 * np.cos(3 * z)], -1))
        self.material = {
            "diffuse": diffuse,
            "specular": tensor(0.1 + 0.05 * np.sin(2 * y)),
            "roughness": tensor(0.35 + 0.1 * np.cos(2 * x + z)),
        }
        random = np.random.default_rng(8)
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        tilt = 1 + 1.2 * np.sin(0.11 * u - 0.15 * v + 0.4)
        self.radiance_weight = tensor(tilt[..., None] + random.uniform(-0.3, 0.3, (COUNT, HEIGHT, WIDTH, 3)))
        self.coverage_weight = tensor(tilt[::-1] + random.uniform(-0.3, 0.3, (COUNT, HEIGHT, WIDTH)))

    def photograph(self, k, light):
        origin = [[1.4, 0.5, 3.2], [-1.1, 1.2, 3.0]][k]
        matrix = np.array(mi.ScalarTransform4f().look_at(origin, [0.2, -0.1, 0.1], [0.3 - k, 1, 0.2]).matrix)
        matrix[:3, 3] *= self.unit
        light = light or {"type": "point", "position": origin, "intensity": {"type": "rgb", "value": [12.0, 10.0, 9.0]}}
        if light["type"] == "point":
            colour = {"type": "rgb", "value": [self.unit**2 * c for c in light["intensity"]["value"]]}
            light = light | {"position": [self.unit * p for p in light["position"]], "intensity": colour}
        return {
            "type": "photograph", "id": f"{k:03}", "filename": "nowhere.png",
            "fx": 34.0, "fy": 29.0 + k, "cx": 16.2 + k, "cy": 13.4, "to_world": mi.ScalarTransform4f(matrix),
            "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}, "light": light,
        }  # fmt: skip

    def losses(self, vertices, material, spp, seed):
        rgb, alpha = prediction.render(self.surface, self.photographs, vertices, material, spp, seed, self.shadows)
        return (self.radiance_weight * rgb).sum(), (self.coverage_weight * alpha).sum()


def tensor(array):
    return torch.tensor(np.asarray(array), dtype=torch.float32, device=machine.device())
