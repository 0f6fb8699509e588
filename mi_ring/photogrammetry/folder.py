"""The photographs of a folder: which there are, their pixels and what their EXIF data say."""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from mi_ring.errors import InputError
from mi_ring.foreign import require_plausible_size
from mi_ring.images import HEIF, PLAIN, RAW, linear_to_srgb, open_image, read_image, srgb_to_linear
from mi_ring.importers.photogrammetry import exposure_of
from mi_ring.importers.reading import image_size, read_as
from mi_ring.scene.shot import Encoding
from mi_ring.system import command
from mi_ring.system.optional import need

TRANSPARENT = (".png", ".tif", ".tiff")  #: what may have an alpha channel
FLIPS = {0: 1, 3: 3, 5: 8, 6: 6}  #: LibRaw's numbers of how a raw photograph is turned, as orientations of EXIF
FEWEST = 8  #: photographs that a reconstruction needs at least


@dataclass(frozen=True)
class Picture:
    """A photograph."""

    path: Path
    upright: bool = True  #: turned as EXIF says; else as the file has it, which other tools' cameras refer to

    @property
    def name(self) -> str:
        """That of the file, without suffix."""
        return self.path.stem

    @cached_property
    def pixels(self) -> np.ndarray:
        """(H, W, C) uint8 sRGB, or uint16: linear of raw files, else as the file has it.

        Raises InputError if it cannot be read.
        """
        return turned(self.stored(), self.orientation)

    def stored(self) -> np.ndarray:
        """`pixels` before they are turned."""
        suffix = self.path.suffix.lower()
        if suffix in RAW:
            return read_as(self.path, "raw photograph", develop)
        if suffix in HEIF:
            let_open(self.path)
            return read_as(self.path, "HEIF photograph", decode_heif)
        pixels = read_as(self.path, "image", read_image)
        if pixels.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.path}: has {pixels.dtype} pixels; photographs must have 8 or 16 bits")
        return np.repeat(pixels[:, :, :1], 3, 2) if pixels.shape[2] < 3 else pixels

    @property
    def orientation(self) -> int:
        """By EXIF's numbers, how the pixels of the file are still to be turned; HEIF's reader has done so."""
        return self.held if self.upright and self.path.suffix.lower() not in HEIF else 1

    @cached_property
    def held(self) -> int:
        """By EXIF's numbers, how the camera was held, whoever turns the pixels, if anybody does."""
        suffix = self.path.suffix.lower()
        if suffix in HEIF:
            let_open(self.path)
            return read_as(self.path, "HEIF photograph", turned_before)
        if suffix in RAW:
            return FLIPS.get(read_as(self.path, "raw photograph", flip), 1)
        value = self.exif.get(ExifTags.Base.Orientation)
        return value if isinstance(value, int) and 1 <= value <= 8 else 1

    @property
    def axes(self) -> np.ndarray:
        """(3, 3): from the axes of the sensor, x right, y down, z forward, to those of `pixels`."""
        return axes_of(self.held if self.upright or self.path.suffix.lower() in HEIF else 1)

    @cached_property
    def exif(self) -> Image.Exif:
        """EXIF data, empty where there are none."""
        try:
            let_open(self.path)
            with open_image(self.path) as image:
                exif = image.getexif()
                exif.get_ifd(ExifTags.IFD.Exif)  # read while the file is open
                return exif
        except Exception:  # damaged, in one of many ways, or a raw format that Pillow does not know
            return Image.Exif()

    @cached_property
    def exposure(self) -> float:
        """By EXIF, NaN where it says nothing."""
        found = exposure_of(self.exif.get_ifd(ExifTags.IFD.Exif)) or 0.0
        return found if found > 0 else np.nan

    @property
    def encoding(self) -> Encoding:
        """`linear` or `srgb`: what the numbers mean."""
        return "linear" if self.path.suffix.lower() in RAW else "srgb"

    @cached_property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]"""
        let_open(self.path)
        raw = self.path.suffix.lower() in RAW
        width, height = read_as(self.path, "raw photograph", developed_size) if raw else image_size(self.path)
        return (height, width) if self.orientation > 4 else (width, height)

    def grey(self, longest: int) -> np.ndarray:
        """For features: (h, w) uint8 of so many pixels at most, each the mean of as many whole ones."""
        rgb = self.srgb()
        scale = -(-max(rgb.shape[:2]) // longest)
        height, width = (n // scale * scale for n in rgb.shape[:2])
        return np.array(Image.fromarray(rgb[:height, :width]).convert("L").reduce(scale))

    def srgb(self) -> np.ndarray:
        """(H, W, 3) uint8 sRGB."""
        rgb = self.pixels[:, :, :3]
        if rgb.dtype == np.uint8:
            return rgb
        value = np.arange(2**16, dtype=np.float32) / 65535
        lookup = linear_to_srgb(value / self.white) if self.encoding == "linear" else value
        return (lookup * 255 + 0.5).astype(np.uint8)[rgb]

    @cached_property
    def white(self) -> float:
        """Of raw data, that has no brightness of its own: what is to look white, a share of full scale."""
        return max(float(np.quantile(self.pixels[::8, ::8, :3], 0.995)) / 65535, 1e-3)

    def linear(self) -> np.ndarray:
        """(H, W, 3) float32 linear radiance, 1.0 = full scale."""
        rgb = self.pixels[:, :, :3]
        value = np.arange(np.iinfo(rgb.dtype).max + 1, dtype=np.float32) / np.iinfo(rgb.dtype).max
        return (value if self.encoding == "linear" else srgb_to_linear(value))[rgb]

    def mask(self, source: str | Path) -> np.ndarray | None:
        """The object as the user brings it, (H, W) uint8, 255 the object; None if this photograph has none.

        `source`: "alpha", the channel of the photograph itself; "rembg", what that package thinks; else a folder with
        masks called like the photographs. Raises InputError if one cannot be had or is of another size.
        """
        if source == "alpha":
            alpha = self.pixels[:, :, 3] if self.pixels.shape[2] == 4 else None
            return None if alpha is None else (alpha // (np.iinfo(alpha.dtype).max // 255)).astype(np.uint8)
        if source == "rembg":
            return np.array(rembg()(Image.fromarray(self.srgb())))
        file = self.mask_file(Path(source))
        if file is None:
            return None
        mask = Picture(file, self.upright).pixels[:, :, 0]
        if mask.shape[::-1] != self.size:
            sizes = *mask.shape[::-1], *self.size
            raise InputError("{}: is {} x {} pixels, its photograph {} x {}".format(file, *sizes))
        return (mask // (np.iinfo(mask.dtype).max // 255)).astype(np.uint8)

    def mask_file(self, folder: Path) -> Path | None:
        """That of a folder that is called like this photograph; None if there is none."""
        files = (folder / f"{self.path.name}.png", folder / f"{self.name}.png")
        return next((file for file in files if file.is_file()), None)

    def close(self) -> None:
        """Let go of the pixels."""
        self.__dict__.pop("pixels", None)


def let_open(path: Path) -> None:
    """See that Pillow can open a file, if that is HEIF."""
    if path.suffix.lower() in HEIF:
        need("pillow_heif", f"{path}").register_heif_opener()


def decode_heif(path: Path) -> np.ndarray:
    """A HEIF photograph (H, W, 3) uint8, upright."""
    with open_image(path) as image:
        return np.array(image.convert("RGB"))


def turned_before(path: Path) -> int:
    """By EXIF's numbers, how a HEIF photograph would have to be turned, had its reader not done so."""
    with open_image(path) as image:
        return image.info.get("original_orientation") or 1


@cache
def rembg() -> Callable[[Image.Image], Image.Image]:
    """What that package makes masks of photographs with; its network is loaded once."""
    package = need("rembg", "--masks rembg")
    return partial(package.remove, session=package.new_session(), only_mask=True)


def develop(path: Path) -> np.ndarray:
    """A raw photograph (H, W, 3) uint16, linear radiance in sRGB's primaries, white balance as the camera chose it."""
    rawpy = need("rawpy", f"{path}")
    with rawpy.imread(str(path)) as raw:
        require_plausible_size(path, 6 * raw.sizes.raw_width * raw.sizes.raw_height)
        return raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True, user_flip=0)


def developed_size(path: Path) -> tuple[int, int]:
    """(width, height) of what `develop` makes of a raw photograph."""
    with need("rawpy", f"{path}").imread(str(path)) as raw:
        return raw.sizes.iwidth, raw.sizes.iheight


def flip(path: Path) -> int:
    """How a raw photograph is turned, by LibRaw's numbers."""
    with need("rawpy", f"{path}").imread(str(path)) as raw:
        return raw.sizes.flip


def mirrors(orientation: int) -> tuple[bool, int, int]:
    """What turns a picture of an orientation by EXIF: are rows columns, then the signs of columns and rows."""
    columns, rows = [(1, 1), (-1, 1), (-1, -1), (1, -1)][(orientation - 1) % 4]
    return orientation > 4, columns, rows


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels (H, W, …) of an orientation by EXIF as they are to be shown."""
    across, columns, rows = mirrors(orientation)
    return np.ascontiguousarray((pixels.swapaxes(0, 1) if across else pixels)[::rows, ::columns])


def axes_of(orientation: int) -> np.ndarray:
    """(3, 3): from the axes of the sensor, x right, y down, z forward, to those of the photograph as it is shown."""
    across, columns, rows = mirrors(orientation)
    return np.diag([columns, rows, 1.0]) @ np.eye(3)[[1, 0, 2] if across else [0, 1, 2]]


def turned_with(pictures: Sequence[Picture], vector: np.ndarray) -> dict[str, np.ndarray]:
    """A direction (3,) of the camera that is given as most photographs show it, in the axes of each, by its name.

    Several are the columns of a matrix (3, n).
    """
    usual, _ = Counter(picture.held for picture in pictures).most_common(1)[0]
    return {p.name: p.axes @ axes_of(usual).T @ vector for p in pictures}


def ups(pictures: Sequence[Picture]) -> dict[str, np.ndarray]:
    """Where up is as each photograph is to be shown (3,), in the axes of its pixels, by its name."""
    return {p.name: p.axes @ axes_of(p.held).T @ [0, -1, 0] for p in pictures}


def find_pictures(folder: Path, upright: bool = True) -> list[Picture]:
    """The photographs of a folder, by name, turned or not.

    Raises InputError if there is no such folder, if they are too few or if some are the same.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: FOLDER: {'is a file' if folder.exists() else 'no such folder'}; give the folder "
                         "of the photographs")  # fmt: skip
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        kind = path.suffix.lower()
        if kind not in PLAIN + HEIF + RAW or path.name.startswith(".") or not path.is_file():
            continue
        command.require_utf8(str(path))
        if "$" in path.name:
            raise InputError(f"{path}: FOLDER: has a $ in its name, which scene files take for a parameter; rename it")
        # A camera that writes both raw and JPEG: the raw one is linear.
        if path.stem not in found or kind in RAW:
            found[path.stem] = path
    if len(found) < FEWEST:
        raise InputError(f"{folder}: FOLDER: has {len(found)} photographs ({', '.join(PLAIN + HEIF)} or raw); at least "
                         f"{FEWEST} are needed, better 40, from all around")  # fmt: skip
    if "object" in found:
        raise InputError(f'{found["object"]}: FOLDER: "object" is what the scene calls the surface; rename the file')
    require_different(list(found.values()))
    return [Picture(path, upright) for path in found.values()]


def require_different(files: Sequence[Path]) -> None:
    """Raise InputError, which says which, if files have the same content."""
    sizes = Counter(path.stat().st_size for path in files)
    alike = defaultdict(list)
    for path in files:
        if sizes[path.stat().st_size] > 1:
            alike[hashlib.sha256(path.read_bytes()).digest()].append(path.name)
    for names in alike.values():
        if len(names) > 1:
            raise InputError(f"{files[0].parent}: FOLDER: {', '.join(names)} are the same photograph; keep one of them")


def focal_35mm(pictures: Sequence[Picture]) -> float | None:
    """The focal length by EXIF, as of a frame 36 mm wide, of the first photograph that says; None if none does."""
    for picture in pictures:
        value = picture.exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
        if isinstance(value, int | float) and value > 0:
            return float(value)
    return None


def exposures(pictures: Sequence[Picture]) -> np.ndarray:
    """(N,) by EXIF, NaN where it says nothing."""
    return np.array([picture.exposure for picture in pictures])


def without_exposure(pictures: Sequence[Picture]) -> list[str]:
    """Which photographs do not say their exposure, where others do."""
    missing = np.isnan(exposures(pictures))
    return [] if missing.all() else [picture.path.name for picture, lacks in zip(pictures, missing) if lacks]


def relative_exposures(pictures: Sequence[Picture], untold: float = 1.0) -> np.ndarray:
    """(N,) by EXIF, 1 for the one in the middle, and `untold` where nothing is said."""
    found = exposures(pictures)
    known = np.isfinite(found)
    return np.where(known, found / np.median(found[known]) if known.any() else 1.0, untold)


def unlit(pictures: Sequence[Picture]) -> list[str]:
    """In which photographs the flash did not fire, by EXIF, where it fired in most; else in none: it may be a torch."""
    fired = [picture.exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.Flash) for picture in pictures]
    off = [p.path.name for p, value in zip(pictures, fired) if isinstance(value, int) and not value & 1]
    return off if sum(isinstance(value, int) and value & 1 for value in fired) > len(pictures) / 2 else []


def models(pictures: Sequence[Picture]) -> dict[str, int]:
    """With which models of camera, by EXIF, how many photographs were taken."""
    return dict(Counter(str(m) for picture in pictures if (m := picture.exif.get(ExifTags.Base.Model))))
