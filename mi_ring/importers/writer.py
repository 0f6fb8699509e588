"""Writes frames as a scene file with its images, whole or not at all."""

import contextlib
import filecmp
import os
import shutil
import tempfile
from collections.abc import Callable, Hashable
from pathlib import Path

import numpy as np
import scipy.ndimage

from mi_ring.capture.decoding import is_linear
from mi_ring.errors import InputError
from mi_ring.images import write_image
from mi_ring.importers.frames import Frame
from mi_ring.importers.reading import pixels_of
from mi_ring.importers.undistortion import undistort
from mi_ring.scene.shot import Encoding, Files
from mi_ring.system.files import relative_to, write_file


class Writer:
    """Files of a scene: gathered in a folder of their own, moved to their places when all are there."""

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        #: What belongs to x/pot.xml is in x/pot/, what belongs to x/scene.xml is in x/.
        self.folder = scene.parent if scene.stem == "scene" else scene.with_suffix("")
        self.made = [folder for folder in (scene.parent, *scene.parent.parents) if not folder.exists()]
        scene.parent.mkdir(parents=True, exist_ok=True)
        self.staging = Path(tempfile.mkdtemp(prefix=f".{scene.stem}.", dir=scene.parent))
        self.files: list[Path] = []
        self.shared: dict = {}  # where masks are, by file and lens

    def write(self, file: str, write: Callable[[Path], object]) -> Path:
        """Have `write(path)` write a file and return where it is going to be."""
        path = self.staging / file
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)
        self.files.append(Path(file))
        return self.folder / file

    def image(self, file: str, pixels: np.ndarray) -> Path:
        """Write an image: PNG if it has integers, else EXR."""
        suffix = ".exr" if pixels.dtype == np.float32 else ".png"
        return self.write(file + suffix, lambda path: write_image(pixels, path))

    def relative(self, path: Path) -> Path:
        """As the scene names it."""
        return Path(relative_to(self.scene.parent, path))

    def finish(self, xml: bytes) -> None:
        """Move everything to its place. Raises InputError if there are other files, which may be the sources.

        Files that are the same are left by one that was ended here.
        """
        for file in self.files:
            place = self.folder / file
            if place.exists() and not filecmp.cmp(self.staging / file, place, shallow=False):
                raise InputError(f"{self.folder / file}: exists already and is another; remove it, or write elsewhere")
        for file in self.files:
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            os.replace(self.staging / file, self.folder / file)
        write_file(self.scene, xml)

    def close(self) -> None:
        """Remove what has not been moved, and folders that were made for nothing."""
        shutil.rmtree(self.staging, ignore_errors=True)
        for folder in self.made:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()


def place_frame(writer: Writer, frame: Frame, name: str, copy: bool, encoding: Encoding) -> Files:
    """The files of a frame, relative to the scene file; written anew where they must be."""
    straight = frame.lens.is_pinhole

    def placed(folder: str, path: Path, pixels: np.ndarray | None) -> Path:
        if pixels is not None:
            return writer.image(f"{folder}/{name}", pixels)
        if copy:
            return writer.write(f"{folder}/{name}{path.suffix}", lambda file: shutil.copyfile(path, file))
        return path

    def shared(folder: str, key: Hashable, path: Path, pixels: Callable[[], np.ndarray | None]) -> Path:
        """Of several photographs: written once."""
        if (folder, key) not in writer.shared:
            writer.shared[folder, key] = placed(folder, path, pixels())
        return writer.relative(writer.shared[folder, key])

    pixels = frame.pixels
    if pixels is None and (not straight or encoding == "linear"):
        pixels = pixels_of(frame.image)
        if encoding == "linear" and pixels.dtype == np.uint8:  # of which the scene file would say that it is sRGB
            pixels = pixels * np.uint16(257)
        elif straight:
            pixels = None  # the file will do
    valid = None
    if not straight:
        assert pixels is not None  # they were read above
        srgb = not is_linear(encoding, pixels)
        pixels, shown = undistort(pixels, frame.lens, srgb, frame.saturation)
        if not shown.all():
            white = np.where(shown, 255, 0).astype(np.uint8)[..., None]
            valid = shared("valid", frame.lens, Path(), lambda: white)
    image = writer.relative(placed("images", frame.image, pixels))
    file = frame.mask
    if file is None:
        return Files(image, None, valid)
    if file == frame.image:
        return Files(image, image, valid)

    def mask() -> np.ndarray | None:
        if straight and not frame.fill_mask:
            return None
        mask = pixels_of(file)
        if frame.fill_mask:
            mask = 255 * scipy.ndimage.binary_fill_holes(mask[..., 0] > 127)[..., None].astype(np.uint8)
        return mask if straight else undistort(mask, frame.lens, saturation=np.inf).pixels

    return Files(image, shared("masks", (file, frame.lens), file, mask), valid)
