"""Objects, sheet, table, room and flash of simulated phone captures, path traced by Mitsuba. Used by `phone.py`.

World: the sheet's [mm], origin in its middle, x right, y up the page, z out of the paper. Rays and paths are those of
`mi_ring.synthesis.tracing`. It shares no code and no model with the reconstruction, except the layout of a camera.
"""

import sys
import zlib
from functools import partial
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "scenes"))

import mi_ring  # noqa: F401  (before Mitsuba, for it chooses LLVM)

# isort: split
import cv2
import drjit as dr
import make_pot2
import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates

from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.synthesis.tracing import LensCamera, Trace, clamped_radiance_along, hits_along, pixel_means, radiance_along

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"
OBJECTS = {"pot2": ROOT / "scenes" / "pot2" / "truth" / "mesh.ply", "spot": DATA / "meshes" / "nvd_spot.obj",
           "bob": DATA / "meshes" / "nvd_bob_tri.obj",
           **{name: DATA / "captures" / name / "truth" / "mesh.ply" for name in ("bunny", "pig", "teapot")},
           }  # fmt: skip
POT2_MIDDLE = np.array([9.016756, 6.696120, 0.000585])  #: of its bounding box in the frame of its glaze [mm]
HEIGHT, WIDEST = 90.0, 130.0  #: of the object, and what it may measure sideways [mm]

PAGE = np.array([210.0, 297.0])  #: A4 [mm]
BOARD = (9, 13, 20.0, 15.0)  #: squares across and down, their side and that of a marker [mm]
PAPER, INK = 0.8, 0.05  #: albedos
TABLE, THICKNESS = np.array([1400.0, 1100.0]), 0.1  #: of the table; of the sheet above it [mm]
FINE, ROUND = 36, 10_000_019  #: paths per pixel where the object is, at least; between the seeds of their rounds
BACKDROP = 500.0  #: how far behind the turntable it stands [mm]
ROOM_COLOUR = np.array([1.12, 1.0, 0.88])  #: of the light in the room; the flash is white


# --- objects ---------------------------------------------------------------------------------------------------------


def load_object(name: str) -> tuple[trimesh.Trimesh, np.ndarray, np.ndarray, dict]:
    """An object by name, or a mesh file whose y is up: as it stands on the sheet [mm], colours (V, 3), roughness (V,).

    And further parameters of its `principled`.
    """
    path = OBJECTS.get(name, Path(name))
    if not path.is_file():
        sys.exit(f"--object: {path} does not exist; must be a mesh or one of {', '.join(OBJECTS)}")
    mesh = trimesh.load(path, force="mesh", process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    while len(mesh.vertices) < 10_000:
        mesh = mesh.subdivide_loop(1)
    if name == "pot2":
        colours, rough = make_pot2.glaze(mesh.vertices - mesh.bounds.mean(0) + POT2_MIDDLE)
        gloss = {"specular": 0.5, "clearcoat": 0.4, "clearcoat_gloss": 0.0}
    mesh.vertices = mesh.vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # (x, y, z) ↦ (x, -z, y)
    mesh.vertices *= min(HEIGHT / mesh.extents[2], WIDEST / mesh.extents[:2].max())
    mesh.vertices -= [*mesh.bounds.mean(0)[:2], mesh.bounds[0, 2]]
    mesh.vertices = mesh.vertices.astype(np.float32)
    if name != "pot2":
        colours, rough = painted(mesh.vertices, zlib.crc32(path.stem.encode()))
        gloss = {"specular": 0.5}
    return mesh, colours, rough, gloss


def painted(points: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Smooth colours (V, 3) and roughness (V,) of points: two paints that run into each other, and clouds in them."""
    rng = np.random.default_rng(seed)
    run, cloud, fine = (make_pot2.noise(points, wavelength, rng)[:, None] for wavelength in (55, 30, 9))
    one, other = rng.uniform(0.1, 0.65, (2, 3))
    share = 0.5 + 0.5 * np.tanh(3 * run)
    colours = (share * one + (1 - share) * other) * (1 + 0.15 * cloud + 0.1 * fine)
    return colours.clip(0.04, 0.8), (0.4 + 0.05 * cloud[:, 0]).clip(0.25, 0.55)


def shape_of(mesh: trimesh.Trimesh, colours: np.ndarray, rough: np.ndarray, gloss: dict) -> mi.Shape:
    """The object as Mitsuba sees it, with smooth normals."""
    attributes = {"base_color": "vertex_color", "roughness": "vertex_roughness"}
    bsdf = {key: {"type": "mesh_attribute", "name": name} for key, name in attributes.items()}
    shape = mesh_of(mesh.vertices, mesh.faces)
    shape.set_bsdf(mi.load_dict({"type": "principled", **bsdf, **gloss}))
    shape.add_attribute("vertex_color", 3, colours.astype(np.float32).ravel())
    shape.add_attribute("vertex_roughness", 1, rough.astype(np.float32).ravel())
    return shape


# --- what it stands on -----------------------------------------------------------------------------------------------


def board_page(dots: int = 14) -> np.ndarray:
    """Albedo (H, W) of a page with the ChArUco board in its middle, `dots` per mm."""
    columns, rows, square, marker = BOARD
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    size = round(columns * square * dots), round(rows * square * dots)
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, dictionary).generateImage(size, marginSize=0)
    page = np.full((round(PAGE[1] * dots), round(PAGE[0] * dots)), 255, np.uint8)
    top, left = (np.array(page.shape) - board.shape) // 2
    page[top : top + size[1], left : left + size[0]] = board
    return np.where(page > 127, PAPER, INK)


def random_page(rng: np.random.Generator, dots: int = 4) -> np.ndarray:
    """Albedo (H, W) of a page of black and white blots of all sizes."""
    shape = round(PAGE[1] * dots), round(PAGE[0] * dots)
    layers = [gaussian_filter(rng.normal(size=shape), sigma * dots) * sigma for sigma in (0.6, 1.5, 4, 10)]
    return np.where(sum(layers) > 0, PAPER, INK)


def wood(rng: np.random.Generator, dots: float = 2) -> np.ndarray:
    """Albedo (H, W, 3) of the table's top: boards with grain along x."""
    height, width = (round(side * dots) for side in TABLE[::-1])
    y = np.mgrid[:height, :width][0] / dots
    coarse = gaussian_filter(rng.normal(size=(height // 8, width // 8)), (12, 40))
    warp = map_coordinates(coarse / coarse.std(), np.mgrid[:height, :width] / 8, order=1, mode="nearest")
    plank = (y // 110).astype(int)
    tone = rng.normal(0, 0.08, plank.max() + 1)[plank]
    rings = np.sin(2 * np.pi * (y / 17 + 1.6 * warp + 5 * rng.uniform(size=plank.max() + 1)[plank]))
    fibres = gaussian_filter1d(gaussian_filter1d(rng.normal(size=(height, width)), 0.7, 0), 30, 1)
    value = 1 + tone + 0.10 * rings + 0.10 * fibres / fibres.std()
    value *= 1 - 0.6 * np.exp(-(((y % 110) / 0.8) ** 2))  # the gaps
    return np.clip(value[..., None] * [0.36, 0.22, 0.12], 0.01, 0.9)


def textured(albedo: np.ndarray) -> dict:
    """A texture of reflectances (H, W[, 3]) as they are, its first row at the top."""
    pixels = (albedo[..., None] if albedo.ndim == 2 else albedo)[::-1]
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels, np.float16))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}


def window(rows: int = 64) -> np.ndarray:
    """Radiance (rows, 2 rows, 3) of a dim room, of mean 1: a window in one wall, dark below, blurred shapes."""
    theta, phi = np.meshgrid((np.arange(rows) + 0.5) / rows * np.pi, (np.arange(2 * rows) + 0.5) / rows * np.pi,
                             indexing="ij")  # fmt: skip
    lobe = np.exp(-(((theta - 1.1) / 0.3) ** 2) - ((np.mod(phi, 2 * np.pi) - 2.0) / 0.45) ** 2)
    shapes = 0.25 * np.sin(3 * phi + 1) * np.sin(2 * theta) ** 2 + 0.15 * np.sin(5 * phi + 2 * np.cos(3 * theta))
    value = (0.7 + 0.3 * np.cos(theta) + shapes * np.sin(theta) + 7 * lobe)[..., None] * ROOM_COLOUR
    return value / (value.mean(2) * np.sin(theta)).sum() * np.sin(theta).sum()


# --- light -----------------------------------------------------------------------------------------------------------


class ConeFlash(mi.Emitter):
    """A point light whose intensity falls as cosⁿ of the angle from its axis. Set by `aim`, without a new scene."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.DeltaPosition
        self.aim(np.zeros(3), np.array([0, 0, 1]), 1.0, 0.0)

    def aim(self, position: np.ndarray, axis: np.ndarray, intensity: float, power: float) -> None:
        """Place it at (3,) [mm], along a unit vector (3,), so bright on its axis [mm²]. Power 0: alike everywhere."""
        self.position = mi.Point3f(*position.astype(np.float32).tolist())
        self.axis = mi.Vector3f(*axis.astype(np.float32).tolist())
        self.intensity, self.power = mi.Float(intensity), mi.Float(power)
        dr.make_opaque(self.position, self.axis, self.intensity, self.power)

    def sample_direction(self, it, sample=(0, 0), active=True):
        """Where it is from `it`, and its radiance · d⁻² there."""
        ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
        ds.p = mi.Point3f(self.position)
        to_light = ds.p - it.p
        ds.dist = dr.norm(to_light)
        ds.d, ds.pdf, ds.delta = to_light / ds.dist, mi.Float(1), mi.Bool(True)
        cosine = dr.maximum(-dr.dot(ds.d, self.axis), 0)
        falloff = dr.select(self.power > 0, dr.power(dr.maximum(cosine, 1e-6), self.power), 1)
        return ds, mi.Spectrum(self.intensity * falloff / dr.square(ds.dist)) & active

    def eval(self, si, active=True):
        """Nothing: it cannot be seen."""
        return mi.Spectrum(0)

    def pdf_direction(self, it, ds, active=True):
        """Nothing: it cannot be met."""
        return mi.Float(0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Empty: where it is changes."""
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        """Its name."""
        return "ConeFlash[]"


mi.register_emitter("cone_flash", ConeFlash)


# --- photographs -----------------------------------------------------------------------------------------------------


class Stage:
    """The object, what it stands on and the light, to be photographed.

    `sheet`: board, random, white, none, or bare: no table either. `turntable`: a plain backdrop stands behind.
    """

    #: Of what one path brings by way of other surfaces: white dots are brighter, and what a bright surface gets from
    #: white paper, 0.5 and more, is not.
    brightest = 4.0

    def __init__(self, name: str, sheet: str, turntable: bool, seed: int) -> None:
        rng = np.random.default_rng([seed, 1])
        self.mesh, *look = load_object(name)
        self.object = shape_of(self.mesh, *look)
        self.bare, self.turntable = sheet == "bare", turntable
        self.flash = mi.load_dict({"type": "cone_flash"})
        self.own, self.standing = {"object": self.object}, {}
        to_world = mi.ScalarTransform4f()
        if sheet in ("board", "random", "white"):
            white = np.full((2, 2), PAPER)
            albedo = board_page() if sheet == "board" else random_page(rng) if sheet == "random" else white
            self.own["sheet"] = mi.load_dict({
                "type": "rectangle", "to_world": to_world.scale([*(PAGE / 2).tolist(), 1.0]),
                "bsdf": {"type": "diffuse", "reflectance": textured(albedo)},
            })  # fmt: skip
        if not self.bare:
            self.standing["table"] = {"type": "rectangle", "bsdf": mi.load_dict({
                "type": "principled", "base_color": textured(wood(rng)), "roughness": 0.45,
                "specular": 0.4})}  # fmt: skip
        self.light = mi.Bitmap(window().astype(np.float32))
        self.turn(0.0)

    def turn(self, angle: float) -> None:
        """Turn table, backdrop and room about the object [radians]."""
        about = mi.ScalarTransform4f().rotate([0, 0, 1], float(np.degrees(angle)))
        half = (TABLE / 2).tolist()
        shapes = dict(self.own)
        for name, shape in self.standing.items():
            place = about @ mi.ScalarTransform4f().translate([0, 0, -THICKNESS]).scale([*half, 1.0])
            shapes[name] = mi.load_dict(shape | {"to_world": place})
        if self.turntable and not self.bare:
            place = about.translate([-BACKDROP, 0, 0]).rotate([0, 1, 0], 90).scale([1500.0, 1500.0, 1.0])
            shapes["backdrop"] = mi.load_dict({
                "type": "rectangle", "to_world": place,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.35}}})  # fmt: skip
        room = {"type": "envmap", "bitmap": self.light, "to_world": about.rotate([1, 0, 0], 90)}
        self.flashed = mi.load_dict({"type": "scene", **shapes, "flash": self.flash})
        self.lit = mi.load_dict({"type": "scene", **shapes, "room": room})

    def radiance(self, shot: LensCamera, spp: int, seed: int) -> np.ndarray:
        """Linear radiance (H, W, 3) by the flash as it is aimed."""
        flashed = partial(clamped_radiance_along, scene=self.flashed, depth=4, limit=self.brightest)
        if self.bare:
            return pixel_means(flashed, shot, shot.around(self.mesh.vertices), spp, seed)
        return self.pictured(flashed, shot, spp, seed)

    def room_radiance(self, shot: LensCamera, spp: int, seed: int) -> np.ndarray:
        """Linear radiance (H, W, 3) by the room, whose mean radiance is 1.

        Apart, for an integrator that chooses between two lights is much noisier.
        """
        return self.pictured(partial(radiance_along, scene=self.lit, depth=3), shot, spp, seed)

    def pictured(self, trace: Trace, shot: LensCamera, spp: int, seed: int) -> np.ndarray:
        """Radiance (H, W, 3) of paths by `trace`, many more where the object is.

        What sheet and table send to it comes by few bright paths: with few of them it would be dark with bright specks,
        which no photograph has, and darker to all who ask for medians.
        """
        near = shot.around(self.mesh.vertices)
        picture = pixel_means(trace, shot, (0, 0, *shot.camera.size), spp, seed)
        rounds = range(-(-FINE // spp))
        fine = np.mean([pixel_means(trace, shot, near, spp, seed + k * ROUND) for k in rounds], 0)
        left, top, right, bottom = near
        picture[top:bottom, left:right] = fine[top:bottom, left:right]
        return picture

    def coverage(self, shot: LensCamera, spp: int = 16) -> np.ndarray:
        """How much of each pixel shows the object (H, W)."""
        trace = partial(hits_along, scene=self.flashed, shape=self.object)
        return pixel_means(trace, shot, shot.around(self.mesh.vertices), spp, 0)[..., 0]
