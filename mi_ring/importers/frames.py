"""Frames, which all importers produce: photographs with their cameras and lights. Also their checks."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from tyro.conf import Positional, Suppress, arg

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.geometry.camera import Camera
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.reading import image_size, orientation_of
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Encoding
from mi_ring.system import command

TURNED = "photographs turned upright by EXIF, as their cameras are"
MIN_FOCAL = 0.1  #: least focal length, by the longer side of the photograph: 157 degrees
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  #: from OpenGL's camera axes (x right, y up, z back) to OpenCV's


@dataclass
class Frame:
    """A photograph with its camera, light and mask, as an importer read them, before its distortion is removed."""

    image: Path
    lens: Lens
    pose: np.ndarray  #: (4, 4) camera-to-world, OpenCV's axes
    mask: Path | None = None  #: as large as the photograph; equal to `image` if the alpha channel is the mask
    light: Light | None = None  #: None: a point light of intensity 1 at the camera
    saturation: float = 1.0  #: encoded value from which pixels are clipped (1 = full scale)
    encoding: Encoding = "auto"
    name: str = ""  #: in the scene; empty: the file's name without suffix
    pixels: np.ndarray | None = None  #: (H, W, 3) float32, if `image` is a stack of photographs
    fill_mask: bool = False  #: fill the holes in the mask
    said: str = ""  #: the path of the photograph in the other tool's file; empty if that names no photographs
    orientation: int = 1  #: EXIF orientation by which the file's pixels are to be turned
    mask_orientation: int = 1  #: EXIF orientation by which the mask's pixels are to be turned

    @property
    def camera(self) -> Camera:
        """The pinhole camera of the photograph once its distortion is removed."""
        return self.lens.camera(self.pose)

    def at_camera(self, rgb: ArrayLike, offset: ArrayLike = (0, 0, 0)) -> Light:
        """Return a point light that is fixed to the camera of this frame, which does not change.

        `rgb` (3,): its intensity. `offset` (3,): its position relative to the lens: right, down, forward [scene units].
        """
        return Light("point", self.pose[:3, :3] @ np.array(offset, float) + self.pose[:3, 3], np.array(rgb, float))


@dataclass(frozen=True)
class Source:
    """Base class of all importers, with the options that all formats share. An instance is one import."""

    fields: ClassVar[Fields]  #: of the format

    src: Positional[Annotated[Path, arg(metavar="SRC")]]
    """The other tool's data: a file or a folder."""
    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Scene file to write, for example pot.xml. Other new files, such as undistorted photographs, go to pot/."""
    copy: bool = False
    """Copy the photographs beside the scene file, to keep everything in one place.
    Without this option the scene file refers to the originals, which must stay where they are."""
    encoding: Encoding = "auto"
    """How the files encode radiance. Set this option if auto is wrong. srgb: by the sRGB curve. linear: in proportion.
    auto: as the format of SRC says. If the format does not say: srgb for 8-bit files, linear for others.
    The command writes copies with 16 bits of linear 8-bit files."""
    photographs: Suppress[Sequence[Path] | None] = None
    """The photographs to import; other cameras are ignored. None: all, and each camera must have a photograph."""

    def frames(self) -> Iterator[Frame]:
        """Read the other tool's data, and yield the photographs with a pose. Raises InputError for invalid data."""
        raise NotImplementedError

    @cached_property
    def without_pose(self) -> set[str]:
        """Names of photographs without a pose. `frames` fills the set; it is complete at its end."""
        return set()

    @cached_property
    def without_photograph(self) -> list[str]:
        """Names of cameras whose photograph was not found. `frames` fills the list; it is complete at its end."""
        return []

    @cached_property
    def notes(self) -> list[str]:
        """Sentences for the user about choices and unused data. `frames` fills the list."""
        return []

    def tell_unused(self, file: Path, names: Iterable[str]) -> None:
        """Add a note for the user about fields of `file` that mi_ring does not use although they may matter.

        `names`: all fields that the file has. Fields that are used or harmless are not mentioned. Without other fields,
        no note is added.
        """
        if unused := self.fields.unused(names):
            words = [f"{' '.join(name.split())[:60]} ({why})" for name, why in unused.items()]
            self.notes.append(f"{file}: not used: {', '.join(words[:9])}{', …' * (len(words) > 9)}")

    @property
    def folder(self) -> Path:
        """Folder that contains the photographs."""
        return self.src

    @property
    def available(self) -> Sequence[Path]:
        """Image files that may be photographs, with or without a camera; empty if the format uses every image."""
        return []


def frames_of(source: Source) -> list[Frame]:
    """Read all frames of an importer. Any error in reading becomes an InputError that names the file."""
    try:
        return list(source.frames())
    except InputError:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise InputError(f"{source.src}: SRC: is damaged, or not of this format ({what})") from error


def is_scaled(size: Sequence[int], original: Sequence[int]) -> bool:
    """Return True if an image of `original` size was resized to `size` with equal proportions.

    Both are (width, height) [px]. Returns False if the sizes differ by less than 5 %.
    """
    factor = max(size) / max(original)
    return abs(factor - 1) > 0.05 and all(abs(a - factor * b) <= 1 for a, b in zip(size, original))


def adapt(frame: Frame, size: tuple[int, int], orientation: int) -> str:
    """Change the lens of a frame so that it fits the size of the image file. Returns what was changed, as a clause.

    `size`: (width, height) of the file [px]. `orientation`: EXIF orientation of the file, 1 to 8. If the photograph was
    resized, the lens is scaled. If the lens is for the photograph turned upright, the frame's orientation is set, too.
    If the proportions differ otherwise, nothing changes. The clause is empty if nothing was changed.
    """
    done = ""
    if size != frame.lens.size and orientation > 4 and (
        size[::-1] == frame.lens.size or is_scaled(size[::-1], frame.lens.size)
    ):  # fmt: skip
        frame.orientation, size = orientation, size[::-1]
        done = TURNED
    if size != frame.lens.size and is_scaled(size, frame.lens.size):
        done += "; " * bool(done) + "cameras scaled from {} x {} to the {} x {} pixels of their photographs".format(
            *frame.lens.size, *size)  # fmt: skip
        frame.lens = frame.lens.scaled(size)
    return done


def adapt_all(source: Source, frames: Sequence[Frame]) -> None:
    """Change the lenses of all frames so that they fit the sizes of the image files. Adds notes to `source`.

    A photograph whose lens is for the upright picture will be turned by its EXIF orientation. If sizes show that this
    is so for some photographs, it is also assumed where sizes cannot show it: for 180 degrees and for square
    photographs.
    """
    files = [frame for frame in frames if frame.pixels is None]
    turns = [orientation_of(frame.image) for frame in files]
    done = [adapt(frame, image_size(frame.image), turn) for frame, turn in zip(files, turns)]
    turned, left = any(frame.orientation > 1 for frame in files), 0
    for k, (frame, turn) in enumerate(zip(files, turns)):
        if turn > 1 == frame.orientation:
            if turned and (turn <= 4 or frame.lens.size[0] == frame.lens.size[1]):
                frame.orientation, done[k] = turn, "; ".join(filter(None, [TURNED, done[k]]))
            else:
                left += 1
    if left:
        source.notes.append(f"{left} photographs not turned by their EXIF orientation: cameras are taken to be of the "
                            "pixels as stored")  # fmt: skip
    source.notes.extend(f"{count} {what}" for what, count in Counter(filter(None, done)).items())


def turn_masks(source: Source, frames: Sequence[Frame]) -> None:
    """Set the orientations of the masks of photographs that are turned. May add a note to `source`.

    The size of a mask shows whether it is upright or as the photograph is stored. For 180 degrees and for square
    photographs it does not: then the masks of the others decide, if they agree, otherwise the mask's own EXIF data.
    """
    turned = [(f, f.mask) for f in frames if f.orientation > 1 and f.mask and f.mask != f.image]
    # True: as the photograph is stored. False: upright.
    shown = {mask: image_size(mask) != frame.lens.size for frame, mask in turned
             if frame.orientation > 4 and frame.lens.size[0] != frame.lens.size[1]}  # fmt: skip
    others, unknown = {*shown.values()}, 0
    for frame, mask in turned:
        if mask in shown or len(others) == 1:
            frame.mask_orientation = frame.orientation if shown.get(mask, True in others) else 1
        else:
            frame.mask_orientation = orientation_of(mask)
            unknown += frame.mask_orientation == 1
    if unknown:
        source.notes.append(f"{unknown} masks of photographs that EXIF turns are taken to be upright, because their "
                            "sizes do not tell; turn them if they are not")  # fmt: skip


def require_frames(frames: Sequence[Frame], source: Path) -> None:
    """Raise InputError if there are no frames, or if a frame is invalid.

    A frame is invalid if its pose, lens, light or file name is, or if the size of photograph or mask is not that of the
    camera. `source`: path of the import, for the message.
    """
    if not frames:
        raise InputError(f"{source}: SRC: found no photographs")
    require_cameras(frames)
    for frame in frames:
        for file, kind in ((None if frame.pixels is not None else frame.image, "photograph"), (frame.mask, "mask")):
            if not file or (size := image_size(file)) == frame.lens.size:
                continue
            if frame.orientation > 4 and size == frame.lens.size[::-1]:
                continue  # is turned when it is written
            why = "give photographs of the size of the cameras, or reduced ones"
            if kind == "mask":
                why = f"give masks of the size of the photographs, for {frame.image.name}"
            if size == frame.lens.size[::-1]:
                why = "the sides are exchanged: give the photographs as the other tool read them, turned or not turned"
            sizes = *size, *frame.lens.size
            raise InputError("{}: {}: is {} x {} pixels, but its camera {} x {}; {}".format(file, kind, *sizes, why))


def require_cameras(frames: Sequence[Frame]) -> None:
    """Raise InputError if a frame has an invalid pose, lens, light or file name."""
    for frame in frames:
        what = f"{frame.image}: camera"
        for file in (frame.image, frame.mask or frame.image):
            command.require_expressible_name(str(file))
        rotation = frame.pose[:3, :3]
        if not np.allclose(frame.pose[3], [0, 0, 0, 1], atol=1e-6):
            raise InputError(f"{what}: the last row of its pose is {frame.pose[3]}, must be 0 0 0 1; is it transposed?")
        if not np.isfinite(frame.pose).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise InputError(f"{what}: its pose is no rotation and translation")
        if np.linalg.det(rotation) < 0:
            raise InputError(f"{what}: its rotation is left-handed, a mirror; check the order and signs of its axes")
        if not np.isfinite(frame.lens.params).all() or min(frame.lens.focal) <= 0:
            raise InputError(f"{what}: its parameters are {', '.join(f'{p:g}' for p in frame.lens.params)}; must be "
                             "finite, with focal lengths above 0")  # fmt: skip
        if min(frame.lens.focal) < MIN_FOCAL * max(frame.lens.size) or not any(frame.lens.centre):
            numbers = " ".join(f"{number:.4g}" for number in (*frame.lens.focal, *frame.lens.centre))
            size = "{} x {}".format(*frame.lens.size)
            raise InputError(f"{what}: its focal lengths and principal point are {numbers}, but its photograph has "
                             f"{size} pixels; must be in pixels, from its upper left corner")  # fmt: skip
        if frame.light and frame.light.kind == "directional" and not frame.light.vector.any():
            raise InputError(f"{frame.image}: light: its direction is 0 0 0; must be the direction to the light")
        if frame.light and not (np.isfinite([frame.light.vector, frame.light.rgb]).all() and min(frame.light.rgb) >= 0):
            raise InputError(f"{frame.image}: light: is {frame.light.rgb} at {frame.light.vector}; "
                             "must be finite and not negative")  # fmt: skip
