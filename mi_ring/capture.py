"""A capture: the photographs, masks, cameras and lights of a scene file as tensors."""

import functools
import os
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import mitsuba as mi
import numpy as np
import scipy.ndimage
import torch
from skimage.filters import threshold_otsu
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from mi_ring import mesh, photograph
from mi_ring.bsdf import check_attributes
from mi_ring.edges import Edges
from mi_ring.errors import InputError, require_file
from mi_ring.hull import Hull, NoParallax, Silhouette, evenly, nearest_point
from mi_ring.integrator import Photographs

#: Of small photographs, to save decoding them again. A pixel takes up to 200 bytes: what stays tears holes in memory.
REMEMBERED_PIXELS = 2**23


@dataclass
class Capture:
    """What a scene file gives to a fit. `images` hold the files' encoded pixels, decoded on demand by `observe`."""

    path: Path
    scene: mi.Scene
    shape: "mesh.ShapeNetMesh"
    sensors: list
    images: list[np.ndarray]  #: (H, W, 3) uint8, uint16 or float32 each
    linear: list[bool]  #: are the encoded pixels linear radiance, or sRGB?
    masks: list[np.ndarray | None]  #: (H, W) uint8, 0 background, 255 object
    shadows: bool
    threshold: float | None = None  #: radiance by which masks were found in the photographs; None if they were not

    def __post_init__(self):
        self.photographs = Photographs.of(self.sensors)
        sizes = [sensor.size for sensor in self.sensors]
        self._decoded, self._remembered = {}, 0  # (scale, result of `decoded`) by photograph, and their pixels
        #: Indices of the photographs of each size (width, height); one launch renders photographs of one size.
        self.sizes = {size: np.array([i for i, s in enumerate(sizes) if s == size]) for size in dict.fromkeys(sizes)}

    def __len__(self) -> int:
        return len(self.sensors)

    @functools.cached_property
    def names(self) -> list[str]:
        """File names of the photographs, with folders where they would not tell one from another without."""
        files = [Path(os.path.abspath(sensor.filename)) for sensor in self.sensors]
        names = [file.name for file in files]
        if len(set(names)) == len(names):
            return names
        common = os.path.commonpath([file.parent for file in files])
        return [file.relative_to(common).as_posix() for file in files]

    def spread(self, most: int = 200) -> list[int]:
        """Indices of at most so many photographs, evenly spread: enough to look at."""
        return evenly(len(self), most)

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

    @property
    def up(self) -> np.ndarray:
        """The mean direction (3,) that is up in the photographs; in the first if they were held in every way."""
        ups = np.stack([camera_of(sensor)[0][:3, 1] for sensor in self.sensors])
        up = ups.mean(0) if np.linalg.norm(ups.mean(0)) > 0.1 else ups[0]
        return up / np.linalg.norm(up)

    def silhouettes(self) -> list[Silhouette]:
        """The masks with their cameras, one for all photographs that share both."""
        once = {}
        for k, (mask, sensor) in enumerate(zip(self.masks, self.sensors)):
            if mask is not None:
                once.setdefault((id(mask), camera_of(sensor)[0].tobytes()), k)
        return [Silhouette(self.masks[k], *camera_of(self.sensors[k]), self.outline(k)) for k in once.values()]

    @functools.cached_property
    def hull(self) -> Hull | None:
        """The visual hull of the masks, if there are any and they are seen from more than one side."""
        silhouettes = self.silhouettes()
        try:
            return Hull(silhouettes, str(self.path), 0.02 if self.whole else 0.25) if silhouettes else None
        except NoParallax:
            return None

    @property
    def whole(self) -> bool:
        """Do masks show the whole object? Those that were found do not show what is in shadow."""
        return self.threshold is None or self.photographs.colocated

    def outline(self, k: int) -> str:
        """The file that photograph `k` has its mask from."""
        return str(self.sensors[k].mask or self.sensors[k].filename)

    def sphere(self) -> tuple[np.ndarray, float]:
        """Normalising sphere (center (3,), radius) [scene units]: from the XML, else the masks, else the cameras."""
        center, radius = self.shape.center, self.shape.radius
        if center is None or radius is None:
            middle, ball = sphere_of_masks(self.hull) if self.hull else sphere_of_cameras(self)
            center, radius = middle if center is None else center, ball if radius is None else radius
        return center, radius


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


def camera_of(sensor):
    """(to_world (4, 4), focal (2,), centre (2,)) of a photograph as numpy arrays."""
    matrix = np.array(sensor.to_world.matrix).reshape(4, 4)
    return matrix, np.array(sensor.focal).ravel(), np.array(sensor.centre).ravel()


def sphere_of_masks(hull: Hull) -> tuple[np.ndarray, float]:
    """Centre of the masks' visual hull and 1.3 times the radius of the ball of the same volume [scene units].

    A start surface that is a little too large shrinks onto the object, which goes faster than growing limbs.
    """
    center, radius = hull.ball()
    return center, 1.3 * radius


def sphere_of_cameras(capture: Capture) -> tuple[np.ndarray, float]:
    """The point that all cameras look at, and half the radius of the ball there that every photograph holds."""
    cameras = [camera_of(sensor) for sensor in capture.sensors]
    origins = np.stack([matrix[:3, 3] for matrix, _, _ in cameras])
    center = nearest_point(origins, np.stack([matrix[:3, 2] for matrix, _, _ in cameras]), str(capture.path))
    half_angle = min(np.arctan(min(s.size) / 2 / f.max()) for s, (_, f, _) in zip(capture.sensors, cameras))
    return center, float(0.5 * np.sin(half_angle) * np.linalg.norm(origins - center, axis=1).min())


def load(path: str | Path, images: bool = True, masks: str = "given") -> Capture:
    """Open a scene of photographs. Raises InputError, one line, for anything that a fit would stumble over later.

    Without `images` only cameras and lights are read: enough to render. `masks`: those "given" by the scene; if there
    are none, "auto" finds them by brightness where the room was dark; "none" does so even if there are.
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
        given = []
        if images:
            of_each = [(s.mask, s.size, s.mask == s.filename) for s in sensors]  # photographs may share a mask
            once = dict(zip(of_each, sensors)) if masks != "none" else {}
            read = {key: read_mask(s, path) for key, s in once.items()}
            given = [read.get(key) for key in of_each]
        shadows = getattr(scene.integrator(), "shadows", True)
        capture = Capture(path, scene, shapes[0], sensors, pixels, linear, given, shadows)
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(f"{path}: {error}") from error
    if images and masks != "given" and all(mask is None for mask in given):
        find_masks(capture)
    return capture


def find_masks(capture: Capture) -> None:
    """Give the photographs masks of what is brighter than a dark room, if it was dark when they were taken.

    Such a mask shows what the light reaches of the object; the rest of the object may be as dark as the room.
    """
    some = [small_brightness(capture, k) for k in capture.spread(50)]
    values = np.concatenate([image.ravel() for image in some])
    if values.max() <= 0:
        return
    floor = values[values > 0].min()
    split = float(np.exp(threshold_otsu(np.log(np.maximum(values, floor)))))
    dark, bright = values[values <= split], values[values > split]
    border = np.concatenate([np.concatenate([i[0], i[-1], i[:, 0], i[:, -1]]) for i in some])
    # Above the noise of the dark: of what is not near to anything bright.
    apart = [image[scipy.ndimage.maximum_filter(image, 7) <= split] for image in some]
    if not sum(map(len, apart)) or np.median(dark) > 0.05 * np.median(bright) or (border > split).mean() > 0.2:
        return
    noise = float(np.quantile(np.concatenate(apart), 0.999))
    capture.threshold = max(4 * noise, 1e-3 * float(np.median(bright)))
    largest = []
    for k in range(len(capture)):
        seen = brightness(capture, k) > capture.threshold
        pieces, _ = scipy.ndimage.label(seen)
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        capture.masks[k] = np.where(sizes[pieces] > 0.01 * sizes.max(), 255, 0).astype(np.uint8)
        largest.append(sizes.max() / seen.size)
    for k, share in enumerate(largest):
        if share <= 0.02 * np.median(largest):  # a few hot pixels: the light did not reach the object
            capture.masks[k] = None


def small_brightness(capture: Capture, k: int) -> np.ndarray:
    """`brightness` of about 256 × 256 pixels, the means of blocks."""
    image = torch.from_numpy(brightness(capture, k))[..., None]
    return shrink(image, max(1, min(image.shape[:2]) // 256))[..., 0].numpy()


def brightness(capture: Capture, k: int) -> np.ndarray:
    """Radiance (H, W) of the brightest colour of each pixel."""
    return decode(capture.images[k], capture.linear[k], 1.0)[0].max(-1)


def open_scene(path: Path) -> tuple[mi.Scene, list]:
    """A scene file and its photographs, one or more. Raises InputError, one line, if it cannot be read."""
    require_file(path, "the XML file of a scene")
    try:
        path.read_text("utf-8")
        scene = mi.load_file(str(path), optimize=False, parallel=False)
    except UnicodeError as error:
        raise InputError(f"{path}: is not UTF-8 at byte {error.start} ({error.reason}); convert it") from error
    except RuntimeError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    sensors = [s for s in scene.sensors() if isinstance(s, photograph.Photograph)]
    if not sensors:
        raise InputError(f'{path}: sensor: found no <sensor type="photograph">; one per photograph is needed')
    return scene, sensors


def recompute_normals(scene: mi.Scene) -> None:
    """Sum the vertex normals of meshes whose files have none anew: one thread does so in one order, several in any."""
    for shape in scene.shapes():
        if not shape.is_mesh() or not shape.has_vertex_normals():
            continue
        parameters = mi.traverse(shape)
        before = np.array(parameters["vertex_normals"])
        shape.recompute_vertex_normals()
        if not np.allclose(before, np.array(parameters["vertex_normals"]), atol=1e-5):  # they were the file's own
            parameters["vertex_normals"] = before
            parameters.update()


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
    if sensor.encoding == "linear" and pixels.dtype == np.uint8:
        raise InputError(f'{scene}: photograph "{sensor.id()}", encoding: is linear, but {sensor.filename.name} has 8 '
                         "bits, as sRGB has; leave it out, or give 16 bits or EXR if it is linear indeed")  # fmt: skip
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
