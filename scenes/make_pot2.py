"""Make the synthetic capture "pot2": a glazed, lidded pot with one handle (genus 1), seen in flash photographs.

    python scenes/make_pot2.py [--out DIR] [--spp N] [--variant llvm_ad_rgb]

Writes, beside this file unless told otherwise,

    pot2.xml                              32 photographs: calibration, flash, file names
    pot2/images/, pot2/masks/             8-bit sRGB photographs, 8-bit masks (255 object, 0 background)
    pot2/truth/mesh.ply                   the true surface, millimetres
    pot2/truth/scene.xml, truth/images/   8 novel views

The pot is a signed distance field, meshed by marching cubes and relaxed on its zero set. Its material is Mitsuba's
`principled` and its light is path traced, shadows and interreflections included, so nothing in here shares code or
model with what reconstructs it. Everything is deterministic. Needs mitsuba, numpy, trimesh, Pillow and, for
`marching_cubes`, scikit-image.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh
from PIL import Image
from skimage.measure import marching_cubes

CENTER = np.array([18.0, -25.0, 140.0])  # of the pot's bounding box, scene units [mm]; y is up
VOXEL = 1.63  # marching-cubes cell [mm], about 20,000 vertices
SIZE = 256  # photographs are SIZE x SIZE pixels
FOCAL = 275.0  # fx = fy [px], a field of view of 49.9 degrees
VIEWS, NOVEL_VIEWS = 32, 8
SATURATED = 0.015  # share of the object's pixels that the flash overexposes


# --- shape: a signed distance field (negative inside), y up, millimetres ---------------------------------------------


def smooth_union(a, b, width):
    """Union of two distance fields, blended with a C2 fillet about `width` wide."""
    h = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - h**3 * width / 6


def smooth_step(lo, hi, x):
    """0 below lo, 1 above hi, C2 in between."""
    t = np.clip((x - lo) / (hi - lo), 0, 1)
    return t**3 * (t * (6 * t - 15) + 10)


def ellipsoid(p, center, radii):
    """First-order distance to an axis-aligned ellipsoid."""
    q = (p - center) / radii
    k = np.linalg.norm(q, axis=1)
    return k * (k - 1) / np.maximum(np.linalg.norm(q / radii, axis=1), 1e-9)


def disc(p, center, radius, half_height, rounding):
    """Distance to an upright cylinder with rounded edges."""
    q = p - center
    d = np.stack([np.hypot(q[:, 0], q[:, 2]) - radius + rounding, np.abs(q[:, 1]) - half_height + rounding])
    return np.minimum(d.max(0), 0) + np.linalg.norm(np.maximum(d, 0), axis=0) - rounding


def tube(p, path, radii):
    """Distance to a tube along a polyline, its radius given at each of the polyline's points."""
    best = np.full(len(p), np.inf)
    for a, b, ra, rb in zip(path[:-1], path[1:], radii[:-1], radii[1:], strict=True):
        t = np.clip((p - a) @ (b - a) / np.dot(b - a, b - a), 0, 1)
        best = np.minimum(best, np.linalg.norm(p - a - t[:, None] * (b - a), axis=1) - (ra + t * (rb - ra)))
    return best


def handle(p):
    """A chunky ear on the +x side, turned about the pot's axis and leaning sideways."""
    turn, lean = np.radians(28), np.radians(13)
    out, side = np.array([np.cos(turn), 0, np.sin(turn)]), np.array([-np.sin(turn), 0, np.cos(turn)])
    up = np.array([0, np.cos(lean), 0]) + np.sin(lean) * side
    side = np.cross(out, up)
    q = np.stack([p @ out, p @ up, p @ side / 1.25], axis=1)  # wider than thick
    corners = np.array([[30, 23, 0], [72, 46, 0], [88, 4, 0], [38, -26, 0]], float)  # of a Bezier curve
    t = np.linspace(0, 1, 49)[:, None]
    path = (1 - t) ** 3 * corners[0] + 3 * t * (1 - t) ** 2 * corners[1] + 3 * t**2 * (1 - t) * corners[2]
    return tube(q, path + t**3 * corners[3], 7.6 - 1.2 * t[:, 0])


def pot(p):
    """Signed distance (to first order) of points (N, 3) to the pot."""
    q = p / [1.04, 1.0, 0.95]  # a pot a little squashed
    angle, y = np.arctan2(q[:, 2], q[:, 0]), q[:, 1]
    flutes = smooth_step(-42, -22, y) * smooth_step(20, 0, y) * np.cos(12 * angle + 0.06 * y)
    d = ellipsoid(q, [0, -8, 0], [47, 43, 47]) + 0.8 * flutes
    d = smooth_union(d, disc(q, [0, -52, 0], 28, 5, 3.5), 10)  # foot
    d = smooth_union(d, disc(q, [0, 30, 0], 25, 10, 3), 14)  # neck
    d = smooth_union(d, handle(p), 9)
    lid = smooth_union(disc(q, [0.5, 40, 0], 30.5, 4, 3.5), ellipsoid(q, [0.5, 40, 0], [27, 14, 27]), 6)
    knob = smooth_union(disc(q, [1.5, 55, -1], 5.5, 6, 2), ellipsoid(q, [2.5, 63, -1.5], [10, 7.5, 10]), 6)
    return smooth_union(d, smooth_union(lid, knob, 8), 5)


def gradient(p, step=0.02):
    """Gradient of `pot` by central differences."""
    return np.stack([pot(p + e) - pot(p - e) for e in step * np.eye(3)], axis=1) / (2 * step)


def make_mesh():
    """Mesh the pot about its own axis.

    Marching cubes; then the vertices relax tangentially while Newton steps keep them on the surface.
    """
    lo, hi = np.array([-56.0, -62, -54]), np.array([92.0, 78, 72])
    axes = [np.arange(a, b, VOXEL) for a, b in zip(lo, hi, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = pot(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    v, f, _, _ = marching_cubes(field, 0.0, spacing=(VOXEL,) * 3, allow_degenerate=False)
    v = v.astype(float) + lo
    edges = trimesh.Trimesh(v, f, process=False).edges_unique
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    valence = np.bincount(i)[:, None]
    for _ in range(30):
        mean = np.stack([np.bincount(i, v[j, k]) for k in range(3)], axis=1) / valence
        v += 0.5 * (mean - v)
        for _ in range(3):
            g = gradient(v)
            v -= pot(v)[:, None] * g / (g**2).sum(1, keepdims=True)
    mesh = trimesh.Trimesh(v, f, process=False)
    if mesh.volume < 0:
        mesh.invert()
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1 and mesh.volume > 0
    assert mesh.euler_number == 0, "the pot must have genus 1"
    return mesh


def write_ply(mesh, path):
    """Binary PLY: float32 positions and triangles, nothing else."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    path.write_bytes(header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes())


# --- glaze -----------------------------------------------------------------------------------------------------------


def noise(p, wavelength, rng, waves=40):
    """Smooth random function with zero mean and unit variance."""
    k = rng.normal(size=(waves, 3))
    k *= 2 * np.pi / wavelength * rng.uniform(0.7, 1.4, (waves, 1)) / np.linalg.norm(k, axis=1, keepdims=True)
    return np.sqrt(2 / waves) * np.cos(p @ k.T + rng.uniform(0, 2 * np.pi, waves)).sum(1)


def glaze(p):
    """Base colour (N, 3) and roughness (N,) of points on the pot.

    A teal glaze that has run over a cream one, a rust band around the lid, a bare foot, speckle and brush marks.
    """
    rng = np.random.default_rng(7)
    run, cloud, brush = noise(p, 32, rng), noise(p, 45, rng), noise(p * [1, 3.5, 1], 30, rng)
    y = p[:, 1] - 7
    color = np.tile([0.66, 0.53, 0.34], (len(p), 1))  # cream
    rough = np.full(len(p), 0.36)

    def paint(where, rgb, roughness):
        color[:] += where[:, None] * (np.array(rgb) - color)
        rough[:] += where * (roughness - rough)

    teal = smooth_step(-7, 1, y + 5 * run)  # from above, its edge has run
    thin = smooth_step(-16, -11, y + 4 * run) * smooth_step(2, -5, y + 5 * run)  # where the teal thins out
    band = smooth_step(25, 29, y + brush) * smooth_step(41, 37, y + brush)
    band *= smooth_step(41, 37, np.hypot(p[:, 0], p[:, 2]))  # around the lid, not on the handle
    foot = smooth_step(-48, -53, y + 0.8 * run)
    paint(teal, [0.05, 0.30, 0.31], 0.27)
    paint(thin, [0.20, 0.42, 0.30], 0.30)
    paint(band, [0.50, 0.17, 0.05], 0.33)
    paint(foot, [0.44, 0.26, 0.15], 0.50)
    color *= (1 + 0.10 * cloud + 0.09 * brush).clip(0.6, 1.4)[:, None]
    spots, radius = p[rng.choice(len(p), 170, replace=False)], rng.uniform(1.2, 2.6, 170)
    speckle = np.zeros(len(p))
    for center, r in zip(spots, radius, strict=True):
        speckle = np.maximum(speckle, np.exp(-((p - center) ** 2).sum(1) / r**2))
    paint(0.75 * speckle, [0.16, 0.09, 0.05], 0.4)
    return color.clip(0.02, 0.9), (rough + 0.02 * cloud).clip(0.22, 0.55)


# --- photographs -----------------------------------------------------------------------------------------------------


def make_cameras(points, count, seed):
    """Camera-to-world matrices (x left, y up, z forward) on all sides, as near as the pot fits into the frame."""
    rng = np.random.default_rng(seed)
    cameras = []
    for k in range(count):
        height = 0.95 - 1.75 * (k + rng.uniform(0.1, 0.9)) / count  # sine of the elevation
        azimuth = 2.399963 * k + seed + rng.normal(0, 0.12)  # golden angle
        radius = np.sqrt(1 - height**2)
        forward = -np.array([radius * np.cos(azimuth), height, radius * np.sin(azimuth)])
        left = np.cross([0, 1, 0], forward) / radius
        up, roll = np.cross(forward, left), rng.uniform(-np.pi, np.pi)
        left, up = np.cos(roll) * left + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * left
        target = CENTER + rng.uniform(-4, 4, 3)
        x, y, z = np.array([left, up, forward]) @ (points - target).T
        half_width = rng.uniform(0.88, 0.97) * SIZE / 2
        distance = (FOCAL * np.maximum(abs(x), abs(y)) / half_width - z).max()
        to_world = np.eye(4)
        to_world[:3] = np.stack([left, up, forward, target - distance * forward], axis=1)
        cameras.append(np.array([[float(f"{value:.9g}") for value in row] for row in to_world]))  # as in the XML
    return cameras


def render(shape, to_world, spp, seed):
    """One photograph under a flash of 1 W/sr: linear radiance (SIZE, SIZE, 3) and coverage (SIZE, SIZE)."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 6},
            "shape": shape,
            "flash": {"type": "point", "position": to_world[:3, 3].tolist(), "intensity": 1.0},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f(to_world),
                "fov": float(np.degrees(2 * np.arctan(SIZE / 2 / FOCAL))),
                "fov_axis": "x",
                "near_clip": 1.0,
                "far_clip": 1000.0,
                "sampler": {"type": "independent", "sample_count": spp},
                "film": {
                    "type": "hdrfilm",
                    "width": SIZE,
                    "height": SIZE,
                    "pixel_format": "rgba",
                    "rfilter": {"type": "box"},  # every pixel by itself
                },
            },
        }
    )
    image = np.array(mi.render(scene, spp=spp, seed=seed))
    return image[..., :3], image[..., 3]


def srgb(linear):
    """8-bit sRGB of linear values, 1.0 = full scale."""
    x = np.clip(linear, 0, 1)
    return np.rint(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)).astype(np.uint8)


def write_png(path, pixels):
    """Write 8-bit pixels (SIZE, SIZE[, 3])."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, optimize=True)


def sensor_xml(name, folder, masked, to_world, intensity):
    """The `photograph` of one view: its image and mask, calibration and flash."""
    x, y, z = (f"{value:.9g}" for value in to_world[:3, 3])
    matrix = " ".join(f"{value:.9g}" for value in to_world.ravel())
    size = f'<integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>'
    lines = [
        f'  <sensor type="photograph" id="{name}">',
        f'    <string name="filename" value="{folder}images/{name}.png"/>',
        f'    <string name="mask" value="{folder}masks/{name}.png"/>' if masked else None,
        f'    <float name="fx" value="{FOCAL:.9g}"/> <float name="fy" value="{FOCAL:.9g}"/>',
        f'    <float name="cx" value="{SIZE / 2:.9g}"/> <float name="cy" value="{SIZE / 2:.9g}"/>',
        '    <boolean name="calibrated" value="true"/>',
        f'    <transform name="to_world"><matrix value="{matrix}"/></transform>',
        f'    <film type="hdrfilm">{size}</film>',
        f'    <emitter type="point"><point name="position" x="{x}" y="{y}" z="{z}"/>'
        f'<rgb name="intensity" value="{intensity:.9g}"/></emitter>',
        "  </sensor>",
    ]
    return "\n".join(line for line in lines if line)


def write_scene(path, folder, masked, cameras, intensity):
    """A scene file of our format: one `photograph` per camera."""
    sensors = [sensor_xml(f"{k:03d}", folder, masked, to_world, intensity) for k, to_world in enumerate(cameras)]
    head = [
        '<scene version="3.0.0">',
        '  <integrator type="photometric"/>',
        '  <shape type="shapenet" id="object"><bsdf type="cooktorrance"/></shape>',
    ]
    path.write_text("\n".join([*head, *sensors, "</scene>"]) + "\n")


def main():
    """Model, glaze and photograph the pot."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder to write to")
    parser.add_argument("--spp", type=int, default=1024, help="paths per pixel")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    args = parser.parse_args()
    mi.set_variant(args.variant)
    folder = args.out / "pot2"
    (folder / "truth").mkdir(parents=True, exist_ok=True)

    mesh = make_mesh()
    color, rough = glaze(mesh.vertices)
    mesh.vertices = (mesh.vertices + CENTER - mesh.bounds.mean(0)).astype(np.float32)
    write_ply(mesh, folder / "truth" / "mesh.ply")
    shape = mi.load_dict(
        {
            "type": "ply",
            "filename": str(folder / "truth" / "mesh.ply"),  # without normals: Mitsuba computes smooth ones
            "bsdf": {
                "type": "principled",
                "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
                "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
                "specular": 0.5,
                "clearcoat": 0.4,
                "clearcoat_gloss": 0.0,
            },
        }
    )
    shape.add_attribute("vertex_color", 3, color.astype(np.float32).ravel())
    shape.add_attribute("vertex_roughness", 1, rough.astype(np.float32).ravel())

    cameras = make_cameras(mesh.vertices, VIEWS, seed=1)
    novel = make_cameras(mesh.vertices, NOVEL_VIEWS, seed=2)
    views = [render(shape, to_world, args.spp, seed=k) for k, to_world in enumerate(cameras + novel)]
    brightness = np.concatenate([image.max(2)[alpha >= 0.5] for image, alpha in views[:VIEWS]])
    intensity = float(f"{1 / np.quantile(brightness, 1 - SATURATED):.3g}")  # one exposure for all photographs
    for k, (image, alpha) in enumerate(views):
        if k < VIEWS:
            write_png(folder / "images" / f"{k:03d}.png", srgb(intensity * image))
            write_png(folder / "masks" / f"{k:03d}.png", np.where(alpha >= 0.5, 255, 0).astype(np.uint8))
        else:
            write_png(folder / "truth" / "images" / f"{k - VIEWS:03d}.png", srgb(intensity * image))
    write_scene(args.out / "pot2.xml", "pot2/", True, cameras, intensity)
    write_scene(folder / "truth" / "scene.xml", "", False, novel, intensity)
    print(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, flash {intensity:g} W/sr")


if __name__ == "__main__":
    main()
