"""A capture: the photographs, masks, cameras and lights of a scene file as tensors."""

import os
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import mitsuba as mi
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from mi_ring import mesh, photograph
from mi_ring.edges import Edges
from mi_ring.errors import InputError
from mi_ring.integrator import Photographs, check_attributes

#: Of small photographs, to save decoding them again. A pixel takes up to 200 bytes: what stays tears holes in memory.
REMEMBERED_PIXELS = 2**23


@dataclass
class Capture:
    """What a scene file gives to a fit. `images` hold the files' encoded pixels, decoded on demand by `observe`."""

    path: Path
    scene: mi.Scene
    shape: "mesh.ShapeNetMesh"
    sensors: list
    images: list[np.ndarray]  # (H, W, 3) uint8, uint16 or float32 each
    linear: list[bool]  # are the encoded pixels linear radiance, or sRGB?
    masks: list[np.ndarray | None]  # (H, W) uint8, 0 background, 255 object
    shadows: bool

    def __post_init__(self):
        self.photographs = Photographs.of(self.sensors)
        sizes = [sensor.size for sensor in self.sensors]
        self._decoded, self._remembered = {}, 0  # (scale, result of `decoded`) by photograph, and their pixels
        #: Indices of the photographs of each size (width, height); one launch renders photographs of one size.
        self.sizes = {size: np.array([i for i, s in enumerate(sizes) if s == size]) for size in dict.fromkeys(sizes)}

    def __len__(self) -> int:
        return len(self.sensors)

    @property
    def names(self) -> list[str]:
        """File names of the photographs, with folders where they would not tell one from another without."""
        files = [sensor.filename for sensor in self.sensors]
        names = [file.name for file in files]
        if len(set(names)) == len(names):
            return names
        common = os.path.commonpath([file.absolute().parent for file in files])
        return [file.absolute().relative_to(common).as_posix() for file in files]

    def spread(self, most: int = 200) -> list[int]:
        """Indices of at most so many photographs, evenly spread: enough to look at."""
        count = min(most, len(self))
        return [k * len(self) // count for k in range(count)]

    def photograph(self, k: int, scale: int = 1) -> Photographs:
        """Photograph `k` alone, to be rendered `scale` times smaller."""
        return self.photographs.select([k], self.sensors[k].size, scale)

    def observe(self, index, scale: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Photographs `index`, box-filtered `scale` times smaller.

        Returns linear radiance (n, H, W, 3); where it is clipped (n, H, W, 3) bool, the scene being at least this
        bright; the object's coverage (n, H, W) in [0, 1]; and which photographs have a mask (n,) bool, coverage being 0
        where there is none.
        """
        rgb, saturated, mask = zip(*(self.decoded(k, scale) for k in index))
        masked = torch.tensor([self.masks[k] is not None for k in index])
        return torch.stack(rgb), torch.stack(saturated), torch.stack(mask), masked

    def decoded(self, k: int, scale: int) -> tuple[Tensor, Tensor, Tensor]:
        """One photograph of `observe`. If smaller than the file and if it fits, it is remembered, at its last scale."""
        if k in self._decoded:
            before, result = self._decoded[k]
            if before == scale:
                return result
            self._remembered -= self._decoded.pop(k)[1][2].numel()
        linear, saturated = decode(self.images[k], self.linear[k], self.sensors[k].saturation)
        mask = np.zeros(linear.shape[:2], np.uint8) if self.masks[k] is None else self.masks[k]
        result = (
            shrink(torch.from_numpy(linear), scale),
            shrink(torch.from_numpy(saturated).float(), scale) > 0,
            shrink(torch.from_numpy(mask).float()[..., None] / 255, scale)[..., 0],
        )
        pixels = result[2].numel()
        if scale > 1 and self._remembered + pixels <= REMEMBERED_PIXELS:
            self._decoded[k] = scale, result
            self._remembered += pixels
        return result

    def exposure(self) -> float:
        """Mean linear radiance of the object's pixels (of all that are not black, where there are no masks).

        Of thousands of photographs a few hundred tell.
        """
        total, count = 0.0, 0
        for k in self.spread():
            rgb, _, mask, masked = self.observe([k], 4 if min(self.sensors[k].size) >= 16 else 1)
            inside = mask[0] > 0.5 if masked else rgb[0].mean(-1) > 0.02 * rgb.max()
            total, count = total + float(rgb[0][inside].sum()), count + 3 * int(inside.sum())
        if not total > 0:
            raise InputError(f"{self.path}: photographs: every pixel of the object is black; check exposure and masks")
        return total / count

    def reflectance(self, center, exposure: float) -> float:
        """Order of magnitude of ρ: what makes a surface at `center` as bright as `exposure` under these lights."""
        lights = np.array(self.photographs.lights).reshape(-1, 8)
        distance2 = np.where(lights[:, 3] > 0, 1.0, ((lights[:, :3] - center) ** 2).sum(1))
        return float(exposure / np.median(lights[:, 4:7].mean(1) / distance2))

    def sphere(self) -> tuple[np.ndarray, float]:
        """Normalising sphere (center (3,), radius) [scene units]: from the XML, else the masks, else the cameras."""
        if self.shape.center is not None and self.shape.radius is not None:
            return self.shape.center, self.shape.radius
        once = {}  # one photograph for all that share camera and mask
        for k, (mask, sensor) in enumerate(zip(self.masks, self.sensors)):
            if mask is not None:
                once.setdefault((id(mask), camera_of(sensor)[0].tobytes()), k)
        masked = list(once.values())
        center, radius = sphere_of_masks(self, masked) if masked else sphere_of_cameras(self)
        return (
            center if self.shape.center is None else self.shape.center,
            radius if self.shape.radius is None else self.shape.radius,
        )


def decode(image: np.ndarray, linear: bool, saturation: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance (float32) of encoded pixels and where they are at or above `saturation`, of `image`'s shape."""
    if image.dtype == np.float32:
        value = image
    else:
        full = np.iinfo(image.dtype).max
        value = np.arange(full + 1, dtype=np.float32) / full
    lookup = value if linear else srgb_to_linear(value)
    saturated = value >= saturation
    return (lookup, saturated) if image.dtype == np.float32 else (lookup[image], saturated[image])


def srgb_to_linear(v):
    """IEC 61966-2-1, on numpy arrays."""
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(v):
    """The inverse of `srgb_to_linear`, clipped to [0, 1]."""
    v = np.clip(v, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1 / 2.4) - 0.055)


def to_bytes(encoded: np.ndarray) -> np.ndarray:
    """[0, 1] to uint8."""
    return (np.clip(encoded, 0, 1) * 255 + 0.5).astype(np.uint8)


def shrink(image: Tensor, scale: int) -> Tensor:
    """(H, W, C) → (H // scale, W // scale, C), the mean over blocks."""
    if scale == 1:
        return image
    return F.avg_pool2d(image.permute(2, 0, 1), scale).permute(1, 2, 0)


def pixel_directions(matrix, focal, centre, pixels):
    """Numpy twin of `photograph.camera_ray`: unit directions (n, 3) in the world of pixel coordinates (n, 2)."""
    x, y = ((pixels - centre) / focal).T
    d = np.stack([-x, -y, np.ones_like(x)], 1) @ matrix[:3, :3].T
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def camera_of(sensor):
    """(to_world (4, 4), focal (2,), centre (2,)) of a photograph as numpy arrays."""
    matrix = np.array(sensor.to_world.matrix).reshape(4, 4)
    return matrix, np.array(sensor.focal).ravel(), np.array(sensor.centre).ravel()


def nearest_point(origins: np.ndarray, directions: np.ndarray, what: str) -> np.ndarray:
    """The point (3,) closest in the least-squares sense to lines (n, 3) + t (n, 3)."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix, right = across.sum(0), (across @ origins[:, :, None]).sum(0)[:, 0]
    if np.linalg.cond(matrix) > 1e6:
        raise InputError(f"{what}: all cameras look along one line, so the object's place is unknown; "
                         "give center and radius of the shapenet shape")  # fmt: skip
    return np.linalg.solve(matrix, right)


def sphere_of_masks(capture: Capture, masked: list[int], resolution: int = 48) -> tuple[np.ndarray, float]:
    """Centre of the masks' visual hull and 1.3 times the radius of the ball of the same volume [scene units].

    A start surface that is a little too large shrinks onto the object, which goes faster than growing limbs.
    """
    cameras = [camera_of(capture.sensors[k]) for k in masked]

    def pixels(k):  # found anew each time: those of thousands of masks would fill the memory
        rows, columns = np.nonzero(capture.masks[k] > 127)
        if not len(rows):
            raise InputError(f"{capture.sensors[k].mask}: mask: no object in it (no pixel above 127)")
        return np.stack([columns, rows], 1) + 0.5

    origins = np.stack([matrix[:3, 3] for matrix, _, _ in cameras])
    axes = [pixel_directions(*c, pixels(k).mean(0, keepdims=True))[0] for c, k in zip(cameras, masked)]
    center = nearest_point(origins, np.stack(axes), str(capture.path))
    reach = max(
        np.linalg.norm(np.cross(pixel_directions(*c, pixels(k)), center - o), axis=1).max()
        for c, k, o in zip(cameras, masked, origins)
    )
    axis = np.linspace(-reach, reach, resolution)
    grid = center + np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    votes = np.zeros(len(grid))
    for k, (matrix, focal, centre) in zip(masked, cameras):
        local = (grid - matrix[:3, 3]) @ matrix[:3, :3]
        mask = capture.masks[k]
        column, row = (np.floor(centre - focal * local[:, :2] / local[:, 2:])).astype(int).T
        height, width = mask.shape
        seen = (local[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        outside = mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] <= 127
        votes += seen & outside
    hull = grid[votes <= 0.02 * len(masked)]
    if not len(hull):
        raise InputError(f"{capture.path}: mask: no point in space is inside all masks; check to_world, fx, fy, cx, cy")
    volume = len(hull) * (2 * reach / (resolution - 1)) ** 3
    return hull.mean(0), float(1.3 * (3 * volume / (4 * np.pi)) ** (1 / 3))


def sphere_of_cameras(capture: Capture) -> tuple[np.ndarray, float]:
    """The point that all cameras look at, and half the radius of the ball there that every photograph holds."""
    cameras = [camera_of(sensor) for sensor in capture.sensors]
    origins = np.stack([matrix[:3, 3] for matrix, _, _ in cameras])
    center = nearest_point(origins, np.stack([matrix[:3, 2] for matrix, _, _ in cameras]), str(capture.path))
    half_angle = min(np.arctan(min(s.size) / 2 / f.max()) for s, (_, f, _) in zip(capture.sensors, cameras))
    return center, float(0.5 * np.sin(half_angle) * np.linalg.norm(origins - center, axis=1).min())


def load(path: str | Path, images: bool = True) -> Capture:
    """Open a scene of photographs. Raises InputError, one line, for anything that a fit would stumble over later.

    Without `images` only cameras and lights are read: enough to render.
    """
    path = Path(path)
    scene, sensors = open_scene(path)
    shapes = [s for s in scene.shapes() if isinstance(s, mesh.ShapeNetMesh)]
    if len(shapes) != 1:
        raise InputError(f'{path}: shape: found {len(shapes)} <shape type="shapenet">; a fit needs exactly one')
    try:
        for shape in scene.shapes():
            check_attributes(shape)
        if images:
            Edges(scene)  # refuses shapes without gradients
        reading = tqdm(sensors if images else [], desc="reading", unit="photograph", leave=False, disable=None)
        pixels = [read_image(s, path) for s in reading]
        linear = [is_linear(s, image) for s, image in zip(sensors, pixels)]
        files = {(s.mask, s.size, s.mask == s.filename): s for s in sensors if images}  # photographs may share a mask
        read = {key: read_mask(s, path) for key, s in files.items()}
        masks = [read[s.mask, s.size, s.mask == s.filename] for s in sensors] if images else []
        shadows = getattr(scene.integrator(), "shadows", True)
        return Capture(path, scene, shapes[0], sensors, pixels, linear, masks, shadows)
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(f"{path}: {error}") from error


def open_scene(path: Path) -> tuple[mi.Scene, list]:
    """A scene file and its photographs, one or more. Raises InputError, one line, if it cannot be read."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the XML file of a scene")
    try:
        scene = mi.load_file(str(path), optimize=False, parallel=False)
    except RuntimeError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    sensors = [s for s in scene.sensors() if isinstance(s, photograph.Photograph)]
    if not sensors:
        raise InputError(f'{path}: sensor: found no <sensor type="photograph">; one per photograph is needed')
    return scene, sensors


def reason(error: RuntimeError) -> str:
    """What Mitsuba's parser has to say, in one line."""
    text = str(error).split("] ", 1)[-1]
    if "Traceback" in text:  # one of our plugins refused: its message follows the name of the exception
        text = text.split("Error: ", 1)[-1]
    return " ".join(text.split())


def read_pixels(path: Path, field: str, sensor, scene: Path) -> np.ndarray:
    """Encoded pixels (H, W, C) of an image file: uint8, uint16 or float32, all the bits that the file has.

    Raises InputError if there is no such file, if it is no image or not as large as the film of `sensor`.
    """
    field = f'photograph "{sensor.id()}", {field}'
    if not path.is_file():
        raise InputError(f"{scene}: {field}: no such file: {path}")
    try:
        pixels = read_file(path)
    except Exception as error:
        raise InputError(f"{path}: {field}: cannot be read as an image ({' '.join(str(error).split())})") from error
    expected, found = sensor.size, pixels.shape[1::-1]
    if found != expected:
        found, expected = ("{} x {}".format(*size) for size in (found, expected))
        raise InputError(f"{path}: {field}: is {found} pixels, the film says {expected}")
    if not np.isfinite(pixels).all():
        raise InputError(f"{path}: {field}: contains NaN or infinite pixels")
    return pixels


def read_file(path: Path) -> np.ndarray:
    """Pixels (H, W, C) of an image file as they are: uint8, uint16, else float32."""
    # imageio reads PNGs of 16 bits as 8, silently; Mitsuba reads no TIFF.
    tiff = path.suffix.lower() in (".tif", ".tiff")
    pixels = np.array(imageio.imread(path) if tiff else mi.Bitmap(str(path)), copy=True)
    if pixels.dtype not in (np.uint8, np.uint16):
        pixels = pixels.astype(np.float32)
    return pixels if pixels.ndim == 3 else pixels[:, :, None]


def read_image(sensor, scene: Path) -> np.ndarray:
    """Encoded pixels (H, W, 3) of a photograph; one without colours is grey, and what is transparent is black."""
    pixels = read_pixels(sensor.filename, "filename", sensor, scene)
    channels = pixels.shape[2]
    rgb = pixels[:, :, :3] if channels >= 3 else np.repeat(pixels[:, :, :1], 3, 2)
    if channels not in (2, 4) or pixels.dtype == np.float32:  # EXR files have the product already
        return rgb
    full = np.iinfo(pixels.dtype).max
    linear = is_linear(sensor, pixels)
    radiance = decode(rgb, linear, 1.0)[0] * (pixels[:, :, -1:] / np.float32(full))
    return ((radiance if linear else linear_to_srgb(radiance)) * full + 0.5).astype(pixels.dtype)


def is_linear(sensor, pixels: np.ndarray) -> bool:
    """Is this image linear radiance? As its photograph says, else 8-bit files are not and others are."""
    return sensor.encoding == "linear" or (sensor.encoding == "auto" and pixels.dtype != np.uint8)


def read_mask(sensor, scene: Path) -> np.ndarray | None:
    """Mask (H, W) uint8 of a photograph, None if it has none. A photograph that is its own mask: its alpha channel."""
    if sensor.mask is None:
        return None
    pixels = read_pixels(sensor.mask, "mask", sensor, scene)
    if sensor.mask == sensor.filename and pixels.shape[2] not in (2, 4):
        raise InputError(f'{sensor.mask}: photograph "{sensor.id()}", mask: is the photograph itself, which has no '
                         "alpha channel")  # fmt: skip
    channel = pixels[:, :, -1 if sensor.mask == sensor.filename else 0]
    full = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(pixels.dtype, 1)
    return (channel.astype(np.float32) * (255 / full)).round().astype(np.uint8)
