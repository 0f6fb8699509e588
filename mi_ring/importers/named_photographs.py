"""Base class of importers whose camera file names the image file of each photograph."""

import os
import re
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from mi_ring.errors import InputError, is_file
from mi_ring.importers.frames import Frame, Source
from mi_ring.importers.photograph_files import MASKS, PhotographFiles, name_of, refuse_twins
from mi_ring.importers.reading import first_file, has_alpha, images_below

MASK_AFFIX = re.compile(r"^masks?[-_. ]|[-_. ]masks?$", re.IGNORECASE)  #: in the names of masks, without suffix
MASK_LIKE = re.compile("mask|segment|matte|alpha", re.IGNORECASE)  #: in the names of folders that may hold masks


@dataclass(frozen=True)
class NamedPhotographs(Source):
    """Base class of importers whose camera file names the image files. Subclasses implement `posed`."""

    names: ClassVar[tuple[str, ...]] = ()  #: of the file of cameras, where SRC is a folder

    images: Path | None = None
    """Folder of the photographs. The command searches it for the file names in SRC. If several files have one name,
    the names of their folders decide.
    Without this option: the places that SRC names, or the nearest folder `images` beside or above SRC."""
    masks: Path | None = None
    """Folder of masks: photo.jpg has the mask photo.jpg.png, photo.png, photo.jpg or photo_mask.png.
    Without this option: the masks that SRC names, alpha channels, a folder `masks` beside the photographs, or
    photo_mask.png among them."""

    def posed(self) -> Iterator[Frame]:
        """Read the camera file, and yield the photographs that have a pose. Subclasses implement it.

        An implementation finds each image file by `photograph`. It sets `Frame.said` to the path that the camera file
        gives.
        """
        raise NotImplementedError

    @property
    def cameras(self) -> Path:
        """Path of the camera file: SRC itself, or if SRC is a folder, the first of the usual `names` that exists in it.

        Raises InputError if none exists.
        """
        return first_file([self.src / name for name in self.names], "SRC") if self.src.is_dir() else self.src

    @property
    def beside(self) -> Path:
        """Folder of the camera file; SRC itself if the format has a folder of camera files."""
        return self.src if self.src.is_dir() and not self.names else self.cameras.parent

    @property
    def folder(self) -> Path:
        """Folder of the photographs: the one of --images. Without it: a folder `images`, beside the camera file or one
        level above. Without both: the folder of the camera file.
        """
        candidates = (self.beside / "images", self.beside.parent / "images")
        return self.images or next((folder for folder in candidates if folder.is_dir()), self.beside)

    @cached_property
    def photograph_files(self) -> PhotographFiles:
        """Index of the image files that may be photographs.

        These are `photographs`, or if that is None, all image files in and below the folder of the photographs.
        """
        if self.photographs is not None:
            return PhotographFiles(self.photographs, self.photographs[0].parent if self.photographs else Path())
        return PhotographFiles(images_below(self.folder), self.folder)

    @property
    def available(self) -> Sequence[Path]:
        return self.photograph_files.ordinary

    def photograph(self, path: str, what: str, relative: bool = False) -> Path | None:
        """Find the image file of a photograph. `path`: its path in the camera file, perhaps of another computer.

        If no file matches, returns None and adds `path` to `without_photograph`. `relative`: True: first try `path`
        relative to the folder of the camera file. Raises InputError if several files match equally well. The message
        begins with `what`.
        """
        if relative and self.photographs is None and self.images is None and is_file(self.beside / path):
            return Path(os.path.normpath(self.beside / path))  # equal to the one in `available`
        try:
            found = self.photograph_files.find(path)[0]
        except InputError as error:
            raise InputError(f"{what}: {error}") from error
        if found is None:
            self.without_photograph.append(path)
        return found

    def largest(self, models: Sequence[Sized], what: str) -> int:
        """Return the index of the longest of several models, whose length is their number of photographs.

        Adds a note for the user if other models are not used. `what`: the plural noun for models in this note.
        """
        sizes = [len(model) for model in models]
        best = sizes.index(max(sizes))
        if others := ", ".join(f"number {k + 1} ({size})" for k, size in enumerate(sizes) if k != best):
            self.notes.append(f"{self.src}: of its {len(sizes)} {what} number {best + 1} is taken, with {sizes[best]} "
                              f"photographs; not used: {others}")  # fmt: skip
        return best

    def mask_at(self, path: str, image: Path, what: str) -> Path:
        """Find the mask file of the photograph `image`. `path`: the mask's path in the camera file.

        It may be relative to the camera file. Otherwise the file is searched in and below --masks, or the folder of the
        camera file. Raises InputError if there is none. The message begins with `what`.
        """
        if is_file(file := self.beside / path):
            return file
        folder = self.masks or self.beside
        found, agrees = PhotographFiles([f for f in images_below(folder) if f != image], folder).find(path)
        if found and agrees:
            return found
        raise InputError(f"{what}: no mask {path!r} in {folder}; give --masks, its folder, or take it out of the file")

    def frames(self) -> Iterator[Frame]:
        frames = list(self.posed())
        files = self.photograph_files
        known = {*files.files}
        claims = [(f.image, f.said, f.image not in known or files.find(f.said)[1]) for f in frames]
        lost = refuse_twins(claims)
        self.without_photograph.extend(frame.said for frame in frames if frame.said in lost)
        frames = [frame for frame in frames if frame.said not in lost]
        if self.photographs is None:
            self.find_masks(frames)
        yield from frames

    def find_masks(self, frames: list[Frame]) -> None:
        """Find the masks of all frames, and set the field `mask` of each frame.

        With --masks, they come from this folder; raises InputError if a photograph has no mask there. Without it, they
        are the alpha channels of the photographs, then files in a folder of masks beside the photographs, then files
        such as photo_mask.png among the photographs. In these cases, a photograph may have no mask. Adds notes for the
        user.
        """
        folder, root = self.masks, self.photograph_files.root
        if folder is None:
            for frame in frames:
                if frame.mask is None and has_alpha(frame.image):
                    frame.mask = frame.image
            if all(frame.mask for frame in frames):  # or none at all
                return
            folder = self.masks_beside(root, frames[0].image.stem)
        elif not folder.is_dir():
            raise InputError(f"{folder}: --masks: no such folder")
        among = [file for file in self.photograph_files.files if MASK_AFFIX.search(file.stem)]
        listed, shown = images_below(folder) if folder else among, {frame.image for frame in frames}
        files = [file for file in listed if file not in shown]
        if folder is None and not files:
            return
        folder = folder or root
        masks = PhotographFiles(files or listed, folder, MASK_AFFIX)
        wanted = [frame for frame in frames if frame.mask is None or self.masks is not None]
        paths = [f.image.relative_to(root).as_posix() if f.image.is_relative_to(root) else f.image.name for f in wanted]
        found = [masks.find(path) for path in paths]
        claims = {(file, frame.pose.tobytes()): (file, path, agrees)  # photographs from one place may share a mask
                  for frame, path, (file, agrees) in zip(wanted, paths, found) if file}  # fmt: skip
        lost = refuse_twins(claims.values(), "mask of two photographs", "put masks in folders like the photographs'")
        for frame, path, (file, _) in zip(wanted, paths, found):
            frame.mask = None if path in lost else file
            if frame.mask is None and self.masks is not None:
                image = frame.image
                raise InputError(f"{folder}: --masks: has no mask of {image.name}, such as {image.name}.png or "
                                 f"{image.stem}.png; give all, or leave the photograph out")  # fmt: skip
        used = {frame.mask for frame in frames}
        if self.masks is None and not used & {*masks.files} and masks.files:
            self.notes.append(f"{folder}: none of its {len(masks.files)} images is named after a photograph; not used "
                              f"as masks")  # fmt: skip
            return
        without = [frame.image.name for frame in frames if frame.mask is None]
        if without:
            self.notes.append(f"{counted(without, 'photograph')} without a mask in {folder}: {few(without)}")
        if unused := [file.name for file in masks.files if file not in used]:
            self.notes.append(f"{counted(unused, 'mask')} in {folder} of no photograph: {few(unused)}")

    def masks_beside(self, root: Path, stem: str) -> Path | None:
        """Return the folder of masks in or beside the folder of the photographs, `root`; None if there is none.

        It has a usual name, such as masks, or masks_2 beside images_2. `stem`: name of a photograph without suffix.
        Other folders with such a file may contain masks; a note for the user names them.
        """
        around = [place for above in (root.parent, root) for place in sorted(above.glob("[!.]*"))]
        places = [place for place in around if place.is_dir() and place != root]
        usual = dict.fromkeys(["masks" + root.name.lower().removeprefix("images"), *MASKS])
        known = [place for name in usual for place in places if place.name.lower() == name]
        like = [place for place in places if MASK_LIKE.search(place.name) and place not in known]
        if others := [place for place in like if any(f.name.startswith(stem) for f in place.glob("*"))]:
            self.notes.append(f"{', '.join(map(str, others[:3]))}: not used; give --masks if it holds the masks")
        return next(iter(known), None)


def counted(things: Sized, word: str) -> str:
    """Return the number of `things` with a noun, for example "1 mask" or "3 masks". `word`: the noun in singular."""
    return f"{len(things)} {word}{'s' * (len(things) != 1)}"


def few(names: Iterable[str]) -> str:
    """Return the first three file names in alphabetical order, as a text for a message, without their folders."""
    some = sorted({" ".join(name_of(name).split())[:99] for name in names})
    return ", ".join(some[:3]) + (", …" if len(some) > 3 else "")
