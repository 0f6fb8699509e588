"""Writes a scene file and its images. After an error, none of them remains."""

import contextlib
import filecmp
import os
import shutil
import tempfile
from collections.abc import Callable, Hashable
from functools import partial
from pathlib import Path

import numpy as np
import scipy.ndimage

from mi_ring.capture.decoding import is_linear
from mi_ring.errors import InputError
from mi_ring.images import mask_values, oriented, write_image
from mi_ring.importers.frames import Frame
from mi_ring.importers.reading import bits_of, pixels_of
from mi_ring.importers.undistortion import undistort
from mi_ring.scene.shot import Files
from mi_ring.system.files import relative_to, write_file


class Writer:
    """Writes the files of a scene into a temporary folder. At the end, `finish` moves them to their final places.

    `scene`: final path of the scene file.
    """

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        #: The files of x/pot.xml go to x/pot/, those of x/scene.xml go to x/.
        self.folder = scene.parent if scene.stem == "scene" else scene.with_suffix("")
        self.new_folders = [folder for folder in (scene.parent, *scene.parent.parents) if not folder.exists()]
        scene.parent.mkdir(parents=True, exist_ok=True)
        self.staging = Path(tempfile.mkdtemp(prefix=f".{scene.stem}.", dir=scene.parent))
        self.files: list[Path] = []
        self.shared: dict = {}  #: relative paths of files that several photographs share, by folder and key

    def write(self, file: str, write: Callable[[Path], object]) -> Path:
        """Write a file of the scene into the temporary folder. Returns its final path.

        `file`: path relative to the scene's folder of files. `write`: function that writes to the path that it is
        given.
        """
        path = self.staging / file
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)
        self.files.append(Path(file))
        return self.folder / file

    def image(self, file: str, pixels: np.ndarray) -> Path:
        """Write an image into the temporary folder: float32 as EXR, other types as PNG. Returns its final path.

        `file`: path relative to the scene's folder of files, without suffix. `pixels`: (H, W, C).
        """
        suffix = ".exr" if pixels.dtype == np.float32 else ".png"
        return self.write(file + suffix, lambda path: write_image(pixels, path))

    def relative(self, path: Path) -> Path:
        """Return `path` relative to the folder of the scene file."""
        return Path(relative_to(self.scene.parent, path))

    def finish(self, xml: bytes) -> None:
        """Move all files to their final places, and then write the scene file. `xml`: its content.

        Raises InputError if a file with other content is already at such a place, because it may be a source. The same
        content is accepted: it may come from an interrupted run.
        """
        for file in self.files:
            place = self.folder / file
            if place.exists() and not filecmp.cmp(self.staging / file, place, shallow=False):
                raise InputError(f"{place}: exists already, with other content; remove it, or write elsewhere")
        for file in self.files:
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            os.replace(self.staging / file, self.folder / file)
        write_file(self.scene, xml)

    def close(self) -> None:
        """Remove the temporary folder, and those folders that this writer created, if they are empty."""
        shutil.rmtree(self.staging, ignore_errors=True)
        for folder in self.new_folders:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()


def write_frame(writer: Writer, frame: Frame, name: str, copy: bool) -> Files:
    """Write the files of a photograph that must change: image, mask and valid pixels. Returns the paths for the scene.

    Pixels change if the lens has distortion, if the photograph must be turned, or if the scene file cannot express the
    encoding. `name`: name of the new files without suffix. `copy`: True: also copy files that need not change; False:
    the scene refers to the originals.
    """
    straight, pixels, turn, encoding = frame.lens.is_pinhole, frame.pixels, frame.orientation, frame.encoding

    def place(folder: str, key: Hashable, path: Path, changed: Callable[[], np.ndarray | None]) -> Path:
        if (folder, key) not in writer.shared:
            if (pixels := changed()) is not None:
                path = writer.image(f"{folder}/{name}", pixels)
            elif copy:
                path = writer.write(f"{folder}/{name}{path.suffix}", partial(shutil.copyfile, path))
            writer.shared[folder, key] = writer.relative(path)
        return writer.shared[folder, key]

    if pixels is None and (not straight or turn > 1 or (encoding == "linear" and bits_of(frame.image) == 8)):
        pixels = oriented(pixels_of(frame.image, heed=encoding == "auto"), turn)
        if encoding == "linear" and pixels.dtype == np.uint8:  # the scene file would take 8 bits for sRGB
            pixels = pixels * np.uint16(257)
    valid = None
    if not straight:
        assert pixels is not None  # read above
        srgb = not is_linear(encoding, pixels)
        pixels, shown = undistort(pixels, frame.lens, srgb, frame.saturation)
        if not shown.all():
            valid = place("valid", frame.lens, Path(), lambda: np.uint8(255) * shown[..., None])
    image = place("images", name, frame.image, lambda: pixels)
    file = frame.mask
    if file is None or file == frame.image:
        return Files(image, image if file else None, valid)

    def mask() -> np.ndarray | None:
        if straight and not frame.fill_mask and frame.mask_orientation == 1:
            return None
        mask = oriented(mask_values(pixels_of(file), f"{file}: mask"), frame.mask_orientation)[..., None]
        if frame.fill_mask:
            mask = np.uint8(255) * scipy.ndimage.binary_fill_holes(mask[..., 0] > 127)[..., None]
        return mask if straight else undistort(mask, frame.lens, saturation=np.inf)[0]

    return Files(image, place("masks", (file, frame.lens, frame.mask_orientation), file, mask), valid)
