"""Compare gradients of `photometric` with finite differences.

    python benchmarks/gradients.py [--seeds 4] [--spp 256] > table.md

Prints Markdown tables with machine and date. Each cell is the derivative of a weighted sum of the pixels of one
picture, by `dr.backward` through `mi.render`, against the central difference of `mi.render` with the same seeds on both
sides: deviation ± standard error of the two together, in % of the finite difference. It takes half an hour.
"""

import argparse
import datetime
from itertools import product

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from accuracy import processor
from tqdm import tqdm

WIDTH, HEIGHT = 96, 80  # [px]
CAMERA, TARGET = np.array([0.7, 0.4, 4.4]), np.array([0.05, 0.1, 0.0])
LAMP, DIRECTION = np.array([3.0, 1.4, 2.6]), [-1.0, -0.5, -1.1]
BESIDE_LENS = np.array([0.25, 0.1, 0.02])
SHIFT, AXIS = [1.0, 0.3, -0.2], [0.48, 0.8, 0.36]  #: along which things are moved, about which they are turned

#: What moves, and by how much to either side in the finite difference.
STEPS = {
    "translate": 0.016, "scale": 0.016, "bump": 0.01, "camera moves": 0.016, "camera turns": 0.004,
    "focal length": 0.008, "principal point": 0.5, "distortion": 0.02, "light moves": 0.03, "intensity": 0.05,
    "falloff": 0.05, "room": 0.05,
}  # fmt: skip
MOVABLE = ("sensor.to_world", "sensor.focal", "sensor.centre", "sensor.distortion", "sensor.falloff", "sensor.light",
           "room")  # fmt: skip
CONE, BENT = 4.0, -0.3  #: exponent of the flash's, and distortion of the lens, where these change
ROOM = np.linspace(0.5, -0.3, 27)  #: harmonics of the room's light, where they change
LIGHTS, SHAPES = ("flash", "lamp", "directional"), ("sphere", "bumpy")


class Picture:
    """A picture as a function of how far (mi.Float) one thing has moved.

    The world is `unit` times as large and the light so much stronger that the picture stays the same. A flash is at
    the camera and moves with it. Only where the light itself is to move it starts a little beside the lens: exactly at
    the lens, shadows appear whichever way it goes, and there is no derivative.
    """

    def __init__(self, moved, light, wall, shape, unit=1.0, spp=64, level=5, rfilter="box"):
        self.moved, self.light, self.unit, self.spp = moved, light, unit, spp
        flash = CAMERA + (moved == "light moves") * BESIDE_LENS
        lamp = {"type": "point", "position": (unit * (flash if light == "flash" else LAMP)).tolist(),
                "intensity": {"type": "rgb", "value": [18 * unit**2, 15 * unit**2, 12 * unit**2]}}  # fmt: skip
        if light == "directional":
            lamp = {"type": "directional", "direction": DIRECTION, "irradiance": {"type": "rgb", "value": [1.2, 1, 1]}}
        pose = mi.ScalarTransform4f().look_at((unit * CAMERA).tolist(), (unit * TARGET).tolist(), [0.1, 1, 0.2])
        scene = {
            "type": "scene",
            "integrator": {"type": "photometric"},
            "object": {
                "type": "shapenet", "subdivisions": level,
                "bsdf": {"type": "cooktorrance", "diffuse": {"type": "rgb", "value": [0.3, 0.2, 0.1]},
                         "specular": 0.1, "roughness": 0.4},
            },
            "sensor": {
                "type": "photograph", "filename": "nowhere.png", "fx": 121.0, "fy": 109.0, "cx": 51.0, "cy": 42.0,
                "to_world": pose,
                "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgba",
                         "component_format": "float32", "rfilter": {"type": rfilter}},
                "sampler": {"type": "multijitter"}, "light": lamp,
            },
        }  # fmt: skip
        if moved == "distortion":
            scene["sensor"]["distortion"] = BENT
        if moved == "falloff":
            scene["sensor"]["falloff"] = CONE
        if moved == "room":
            scene["room"] = {"type": "room", "harmonics": " ".join(map(str, ROOM))}
        if wall:
            place = mi.ScalarTransform4f().translate([0, 0, -1.7 * unit]).rotate([0.28, 0.96, 0], 9).scale(20 * unit)
            paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}}
            scene["wall"] = {"type": "rectangle", "to_world": place, "bsdf": paint}
        self.scene = mi.load_dict(scene)
        self.params = mi.traverse(self.scene)
        self.vertices = next(name for name, _ in self.params if name.endswith("vertex_positions"))
        sphere = np.array(self.params[self.vertices], np.float64).reshape(-1, 3)
        x, y, z = sphere.T
        bumps = 0.22 * np.sin(5 * x + 1) * np.cos(4 * y - 2 * z) + 0.12 * np.cos(7 * z + 2 * x)
        radius = 1 + (shape == "bumpy") * bumps
        self.bump = mi.Float((unit * sphere * np.exp(-9 * ((sphere - [0.75, 0.2, 0.65]) ** 2).sum(1))[:, None]).ravel())
        self.params[self.vertices] = mi.Float((unit * sphere * radius[:, None]).ravel())
        self.params.update()
        movable = (*MOVABLE, self.vertices)
        self.before = {name: type(value)(value) for name, value in self.params if name.startswith(movable)}
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        # Brighter to the one side or the other, so that no derivative is a small difference of large parts.
        sign = 1 if moved in ("scale", "bump", "focal length", "intensity") else -1
        self.weights = np.stack([1.2 + sign * np.sin(0.03 * u + 0.015 * v - 2.1 + 0.1 * k) for k in range(4)], -1)

    def change(self, t):
        """The parameters, by the names of their ends, when the thing has moved by `t`."""
        far = t * self.unit * mi.Vector3f(*SHIFT)
        x, pose, focal = self.before[self.vertices], self.before["sensor.to_world"], self.before["sensor.focal"]
        centre = self.unit * mi.Point3f(0.1, -0.1, 0.05)
        position, irradiance = "sensor.light.position", "sensor.light.irradiance.value"
        match self.moved:
            case "translate":
                return {self.vertices: x + dr.tile(dr.ravel(far), dr.width(x) // 3)}
            case "scale":
                c = dr.tile(dr.ravel(centre), dr.width(x) // 3)
                return {self.vertices: c + (x - c) * (1 + t)}
            case "bump":
                return {self.vertices: x + t * self.bump}
            case "camera moves":
                change = {"sensor.to_world": mi.AffineTransform4f().translate(far) @ pose}
                return change | ({position: self.before[position] + far} if self.light == "flash" else {})
            case "camera turns":
                return {"sensor.to_world": pose @ turn(t)}
            case "focal length":
                return {"sensor.focal": focal * (1 + t)}
            case "principal point":
                return {"sensor.centre": self.before["sensor.centre"] + t * mi.Vector2f(*SHIFT[:2])}
            case "distortion":
                return {"sensor.distortion": self.before["sensor.distortion"] + t}
            case "falloff":
                return {"sensor.falloff": self.before["sensor.falloff"] + t}
            case "room":
                return {"room.harmonics": self.before["room.harmonics"] * (1 + t)}
            case "light moves" if self.light == "directional":
                return {"sensor.light.to_world": turn(t) @ self.before["sensor.light.to_world"]}
            case "light moves":
                return {position: self.before[position] + far}
            case "intensity":
                name = irradiance if self.light == "directional" else "sensor.light.intensity.value"
                return {name: self.before[name] * (1 + t)}

    def at(self, t, seed, spp):
        """The picture (H, W, 4) when the thing has moved by `t`."""
        for name, value in self.change(t).items():
            self.params[name] = value
        self.params.update()
        return mi.render(self.scene, self.params, spp=spp, seed=2 * seed, seed_grad=2 * seed + 1)

    def difference(self, seed, spp, channels):
        """Derivative of the weighted sum of these channels by central differences."""
        step = STEPS[self.moved]
        high, low = (np.array(self.at(mi.Float(t), seed, spp), np.float64) for t in (step, -step))
        return ((high - low) * self.weights)[..., channels].sum() / (2 * step)

    def gradient(self, seed, spp, channels):
        """The same by reverse-mode differentiation."""
        weights = np.zeros_like(self.weights, np.float32)
        weights[..., channels] = self.weights[..., channels]
        t = mi.Float(0)
        dr.enable_grad(t)
        dr.backward(dr.sum(self.at(t, seed, spp) * mi.TensorXf(weights), axis=None))
        return dr.grad(t)[0]


RADIANCE, COVERAGE = slice(0, 3), slice(3, 4)


def turn(t):
    """Rotation by `t` [rad], attached."""
    return mi.AffineTransform4f().rotate(mi.Vector3f(*AXIS), t * (180 / dr.pi))


def compare(picture, channels, gradients, differences, spp):
    """(gradient, finite difference, standard error of their difference), means of so many; `spp`: of a difference."""
    # Ten apart: parts of a picture have the seeds next to its own.
    a = [picture.gradient(100 + 10 * seed, 64, channels) for seed in range(gradients)]
    b = [picture.difference(seed, spp, channels) for seed in range(differences)]
    error = np.hypot(np.std(a, ddof=1) / np.sqrt(len(a)), np.std(b, ddof=1) / np.sqrt(len(b)))
    return np.mean(a), np.mean(b), error


def allowed(light, wall):
    """The largest relative deviation: more where a shadow's edge falls on the wall."""
    return 0.03 if wall and light != "flash" else 0.01


def cell(a, b, error, limit):
    """Deviation ± standard error in %, marked if it is above the limit and hardly noise."""
    if a == b == 0:
        return "0"
    mark = " **!**" if abs(a - b) > max(limit * abs(b), 3 * error) else ""
    return f"{100 * (a - b) / abs(b):+.2f} ± {100 * error / abs(b):.2f}{mark}"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--spp", type=int, default=256, help="of the finite differences")
    parser.add_argument("--moved", nargs="+", choices=STEPS, default=list(STEPS), help="what changes")
    parser.add_argument("--units", type=float, nargs="+", default=[1.0, 1000.0])
    options = parser.parse_args()
    print(f"{processor()}; {datetime.date.today()}; {WIDTH} × {HEIGHT} px, 10,242 vertices, finite differences with "
          f"{options.seeds} × {options.spp} spp\n")  # fmt: skip
    tables = [("Radiance", RADIANCE, (False, True), LIGHTS), ("Coverage", COVERAGE, (False,), ("flash",))]
    cells = len(options.moved) * len(SHAPES) * len(options.units) * sum(len(w) * len(li) for _, _, w, li in tables)
    with tqdm(total=cells, desc="derivatives") as bar:
        for (title, channels, walls, lights), unit in product(tables, options.units):
            columns = list(product(SHAPES, walls, lights))
            print(f"{title}, lengths × {unit:g}:\n")
            print("| | " + " | ".join(f"{s}, {'wall' if w else 'black'}, {light}" for s, w, light in columns) + " |")
            print("|---" * (len(columns) + 1) + "|", flush=True)
            for moved in options.moved:
                row = []
                for shape, wall, light in columns:
                    bar.update()
                    if moved == "falloff" and light == "directional":
                        row.append("")
                        continue
                    picture = Picture(moved, light, wall, shape, unit)
                    found = compare(picture, channels, 4 * options.seeds, options.seeds, options.spp)
                    row.append(cell(*found, allowed(light, wall)))
                print(f"| {moved} | " + " | ".join(row) + " |", flush=True)
            print(flush=True)


if __name__ == "__main__":
    main()
