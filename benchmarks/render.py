"""Time and noise of one gradient of eight photographs: `photometric` against Mitsuba's own integrators.

    python benchmarks/render.py [--rounds 5] [--seeds 48]

A bumpy sphere of 10,242 vertices, eight cameras with a lamp beside each, 128² pixels, 4 samples per pixel. One gradient
means: write the vertices, render, and differentiate a fixed weighted sum of all pixels with respect to positions and
material. `photometric` renders all photographs in one launch. The others need one `mi.render` per photograph, with
stock `perspective` sensors and a stock point light. `direct_projective` is measured as it is and with `sppi` = 0, as it
recommends here. Only `photometric` has the edges of the shadows of the bumps.

Prints a Markdown table with machine and date: processor time, summed over threads, methods in turn; and signal to
noise, |mean| / standard deviation over seeds: the median over vertices with a gradient, and the root mean square over
the root mean variance of all vertices.
"""

import argparse
import datetime
import time

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from accuracy import processor

from mi_ring.rendering.edge_selection import Edges
from mi_ring.rendering.image_formation import render_photographs
from mi_ring.rendering.photographs import Photographs

SIZE, SPP, VIEWS, FOV = 128, 4, 8, 40.0
INTENSITY = 12.0

METHODS = {
    "`photometric`": {"type": "photometric"},
    "`direct_projective`": {"type": "direct_projective"},
    "`direct_projective`, `sppi` 0": {"type": "direct_projective", "sppi": 0},
    "`direct`, no outlines": {"type": "direct"},
}


def around(turn):
    """Eight places around the object."""
    k = 2.4 * np.arange(VIEWS) + turn
    height = np.linspace(-0.8, 0.8, VIEWS)
    ring = np.sqrt(1 - height**2)
    return (3.6 * np.stack([ring * np.cos(k), height, ring * np.sin(k)], 1)).tolist()


CAMERAS, LAMPS = around(0.0), around(0.7)


class Scene:
    """The object with eight sensors; the pictures are those of `render`."""

    def __init__(self, integrator):
        scene = {"type": "scene", "object": {"type": "shapenet", "subdivisions": 5, "flash": False,
                                             "bsdf": {"type": "cooktorrance"}}}  # fmt: skip
        focal = SIZE / 2 / np.tan(np.radians(FOV / 2))
        for k, (origin, lamp) in enumerate(zip(CAMERAS, LAMPS)):
            pose = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0.1, 1, 0])
            film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
            sensor = {"type": "perspective", "fov": FOV}
            if integrator["type"] == "photometric":
                light = {"type": "point", "position": lamp, "intensity": INTENSITY}
                sensor = {"type": "photograph", "filename": "nowhere.png", "fx": focal, "fy": focal, "light": light}
            scene[f"sensor{k}"] = sensor | {"to_world": pose, "film": film}
        if integrator["type"] != "photometric":
            scene["light"] = {"type": "point", "position": [0, 0, 5], "intensity": INTENSITY}
            self.integrator = mi.load_dict(integrator)
        self.scene = mi.load_dict(scene)
        self.params = mi.traverse(self.scene)
        names = [name for name, _ in self.params]
        self.names = [next(n for n in names if n.endswith(end)) for end in
                      ("vertex_positions", "vertex_diffuse", "vertex_specular", "vertex_roughness")]  # fmt: skip
        sphere = np.array(self.params[self.names[0]], np.float64).reshape(-1, 3)
        x, y, z = sphere.T
        radius = 1 + 0.1 * np.sin(4 * x + 1) * np.cos(3 * y) + 0.08 * np.cos(5 * z + x)
        diffuse = np.tile([0.4, 0.3, 0.2], len(x))
        self.values = [(sphere * radius[:, None]).ravel(), diffuse, 0.05 + 0 * x, 0.35 + 0.1 * y]
        v, u = np.mgrid[:SIZE, :SIZE]
        waves = [np.sin(0.05 * u + 0.04 * v + k + 1.3 * c) for k in range(VIEWS) for c in range(3)]
        self.weights = np.stack(waves).reshape(VIEWS, 3, SIZE, SIZE).astype(np.float32)
        ours = integrator["type"] == "photometric"
        self.photographs = Photographs.of([sensor.shot for sensor in self.scene.sensors()]) if ours else None
        self.edges = None

    def gradient(self, seed):
        """Gradient with respect to the positions (V, 3)."""
        arrays = [mi.Float(value.astype(np.float32)) for value in self.values]
        dr.enable_grad(arrays)
        for name, array in zip(self.names, arrays):
            self.params[name] = array
        self.params.update()
        if self.photographs is not None:
            self.edges = Edges.of(self.scene, self.edges)
            channels = render_photographs(self.scene, self.photographs, SPP, seed, True, self.edges)
            weights = [mi.Float(self.weights[:, c].ravel()) for c in range(3)]
            dr.eval(channels)
            dr.backward(sum(dr.sum(channel * weight) for channel, weight in zip(channels, weights)))
        else:
            total = mi.Float(0)
            for k, lamp in enumerate(LAMPS):
                self.params["light.position"] = mi.Point3f(lamp)
                self.params.update()
                picture = mi.render(self.scene, self.params, sensor=k, integrator=self.integrator, spp=SPP,
                                    seed=2 * (VIEWS * seed + k), seed_grad=2 * (VIEWS * seed + k) + 1)  # fmt: skip
                weight = mi.TensorXf(np.ascontiguousarray(self.weights[k].transpose(1, 2, 0)))
                dr.eval(picture)
                total += dr.sum(picture * weight, axis=None).array
            dr.backward(total)  # together: the first one would cut the graph from the positions to the normals
        return np.array(dr.grad(arrays[0])).reshape(-1, 3)

    def mean(self, spp=256, seed=1):
        """Mean radiance of the pictures."""
        if self.photographs is not None:
            pixels = render_photographs(self.scene, self.photographs, spp, seed)[:3]
            return np.mean([np.array(channel, np.float64).mean() for channel in pixels])
        means = []
        for k, lamp in enumerate(LAMPS):
            self.params["light.position"] = mi.Point3f(lamp)
            self.params.update()
            picture = mi.render(self.scene, sensor=k, integrator=self.integrator, spp=spp, seed=seed + k)
            means.append(np.array(picture, np.float64)[..., :3].mean())
        return np.mean(means)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="of 4 gradients each, per method")
    parser.add_argument("--seeds", type=int, default=48, help="gradients for the signal to noise ratio")
    options = parser.parse_args()
    mi.set_log_level(mi.LogLevel.Error)
    methods = {name: Scene(integrator) for name, integrator in METHODS.items()}
    for scene in methods.values():  # compile
        for seed in range(3):
            scene.gradient(seed)
    cpu = {name: [] for name in methods}
    for _ in range(options.rounds):
        for name, scene in methods.items():
            started = time.process_time()
            for seed in range(4):
                scene.gradient(seed)
            cpu[name].append((time.process_time() - started) / 4)
    print(f"{processor()}; {datetime.date.today()}; {options.rounds} rounds of 4, {options.seeds} seeds\n")
    print("| integrator | CPU ms, median (least … most) | times `photometric` | S/N at a vertex | S/N of all |")
    print("|---|---|---|---|---|")
    for name, scene in methods.items():
        gradients = np.stack([scene.gradient(1000 + seed) for seed in range(options.seeds)]).astype(np.float64)
        mean, variance = gradients.mean(0), gradients.var(0, ddof=1).sum(-1)
        power = (mean**2).sum(-1) - variance / options.seeds  # without what is left of the noise in the mean
        seen = variance > 0
        each = np.sqrt(np.maximum(power[seen], 0) / variance[seen])
        times = 1e3 * np.array(cpu[name])
        ratio = np.median(cpu[name]) / np.median(cpu["`photometric`"])
        print(f"| {name} | {np.median(times):.0f} ({times.min():.0f} … {times.max():.0f}) | {ratio:.1f} | "
              f"{np.median(each):.2f} | {np.sqrt(power.sum() / variance.sum()):.2f} |", flush=True)  # fmt: skip
    ours, direct = (methods[name].mean() for name in ("`photometric`", "`direct`, no outlines"))
    print(f"\nMean radiance of the pictures: `photometric` {ours:.6f}, `direct` {direct:.6f}, "
          f"relative difference {abs(ours - direct) / direct:.1e}")  # fmt: skip


if __name__ == "__main__":
    main()
