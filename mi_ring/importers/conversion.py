"""Writes the scene file for an importer's frames. This is the work of `mi-ring convert`."""

import contextlib
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.errors import InputError
from mi_ring.image_fields import unused_fields
from mi_ring.image_headers import KINDS, encoding_of, encodings, require_whole
from mi_ring.images import mask_values
from mi_ring.importers.frames import Frame, Source, adapt_all, frames_of, require_frames, turn_masks
from mi_ring.importers.named_photographs import counted, few
from mi_ring.importers.photograph_files import parts_of, stem_of
from mi_ring.importers.reading import bits_of, pixels_of, read_as, saturations_of
from mi_ring.importers.writer import Writer, write_frame
from mi_ring.scene.shot import Shot
from mi_ring.system.progress import progress

#: Suffixes of pictures that are not read.
UNREAD = {
    ".hdr", ".pfm", ".jp2", ".jxl", ".jxr", ".gif", ".psd", ".tga", ".ppm", ".pgm", ".pnm", ".npy", ".mat", ".mp4",
    ".mov", ".raw", ".rwl", ".pef", ".srw", ".x3f", ".3fr", ".iiq",
}  # fmt: skip


def write_scene(source: Source) -> list[Frame]:
    """Read a capture of another tool, and write the scene file `source.scene` for it. Returns the imported frames.

    Images that must change, for example because of lens distortion, are written as new files. If the input is invalid,
    raises InputError and leaves no new files.
    """
    frames = frames_of(source)
    require_most(source, frames)
    adapt_all(source, frames)
    turn_masks(source, frames)
    require_frames(frames, source.src)
    for frame in frames:
        if source.encoding != "auto":
            frame.encoding = source.encoding
        if frame.pixels is None:
            read_as(frame.image, "image", require_whole)
            if bits_of(frame.image) == 32:
                pixels_of(frame.image)  # refuses NaN
        if frame.pixels is None and frame.encoding == "auto":
            read_as(frame.image, "image", encoding_of)  # refuses HDR curves and unknown profiles
    if mask := next((frame.mask for frame in frames if frame.mask not in (None, frame.image)), None):
        mask_values(pixels_of(mask), f"{mask}: mask")  # shows what is wrong with all
    note_saturation(source, frames)
    # Scene files take a $ for a parameter.
    names = [(frame.name or frame.image.stem).replace("$", "_") for frame in frames]
    if len({*names, "object"}) <= len(names):
        names = [f"{k:0{len(str(len(frames)))}}_{name}" for k, name in enumerate(names)]
    root = scene_element()
    if source.scene.suffix != ".xml" or source.scene.exists():
        what = "exists already; give another name" if source.scene.exists() else "must end in .xml"
        raise InputError(f"{source.scene}: SCENE.xml: {what}")
    try:
        with contextlib.closing(Writer(source.scene)) as writer:
            for frame, name in zip(progress(frames, "converting", unit="photograph", disable=None), names):
                files = write_frame(writer, frame, name, source.copy)
                if file := next((file for file in files if file and "$" in str(file)), None):
                    raise InputError(f"{file}: has a $ in its path, which scene files take for a parameter; rename it, "
                                     "or give --copy")  # fmt: skip
                root.append(photograph_element(Shot(name, frame.camera, frame.light, files=files,
                                                    encoding=frame.encoding, saturation=frame.saturation)))  # fmt: skip
            if truth := getattr(source, "truth", None):
                writer.write("truth/mesh.ply", lambda file: shutil.copyfile(truth, file))
            writer.finish(scene_bytes(root))
    except OSError as error:
        raise InputError(f"{source.scene}: cannot be written ({error.strerror or error})") from error
    return frames


def note_saturation(source: Source, frames: Sequence[Frame]) -> None:
    """Set the saturation of photographs with 10, 12 or 14 bits in files of 16 bits, and add a note about it.

    Raises InputError if their values are not linear: their curve is for 16 bits.
    """
    stored = [frame for frame in frames if frame.pixels is None and frame.saturation == 1]
    found, note = saturations_of({frame.image: frame.encoding for frame in stored})
    for frame in stored:
        frame.saturation = found.get(frame.image, 1.0)
    if note:
        source.notes.append(note)


def require_most(source: Source, frames: Sequence[Frame]) -> None:
    """Raise InputError if no photograph has a pose, or if more than half of the cameras have no photograph.

    `frames`: the photographs that have both.
    """
    if source.without_pose and not frames and not source.without_photograph:
        raise InputError(f"{source.src}: SRC: none of {len(source.without_pose)} photographs has a pose")
    if (lost := len(source.without_photograph)) > len(frames):
        other = unread(source) or "give --images, the folder of the photographs"
        raise InputError(f"{source.src}: SRC: {lost} of {lost + len(frames)} cameras have no photograph in "
                         f"{source.folder}: {few(source.without_photograph)}; {other}")  # fmt: skip


def unread(source: Source) -> str:
    """Return a clause for an error message that names formats which mi_ring cannot read; empty if there are none.

    These are the formats of files in `source.folder` that have the names of missing photographs.
    """
    stems = {stem_of(parts_of(name)[-1]) for name in source.without_photograph if parts_of(name)}
    found = (file for file in source.folder.rglob("[!.]*") if stem_of(file.name.lower()) in stems)
    kinds = {file.suffix.lower() for file in found if file.is_file()} & UNREAD
    return f"files {', '.join(sorted(kinds))} there are not read; give {KINDS}" if kinds else ""


def assumptions(frames: Sequence[Frame]) -> list[str]:
    """Return clauses that tell the user what the scene file assumes: encoding, lens distortion and lights."""
    found = encodings([frame.image for frame in frames if frame.encoding == "auto" and frame.pixels is None])
    found += [f"photographs are {what}, as said" for what in sorted({frame.encoding for frame in frames} - {"auto"})]
    curved = sum(not frame.lens.is_pinhole for frame in frames)
    found.append(f"distortion removed from {curved} photographs" if curved else "no lens distortion")
    lights = [frame.light for frame in frames]
    if not any(lights):
        found.append("light at the camera, of the same strength in all")
    else:
        strength = len({light.rgb.tobytes() for light in lights if light})
        found.append(f"lights of {strength} strengths" if strength > 1 else "lights of the same strength in all")
    return found


def unused_in(files: Iterable[Path]) -> list[str]:
    """Return sentences about metadata fields in image files that mi_ring does not use although they may matter.

    There is one sentence for each field, and at most five: those of the most frequent fields.
    """
    found = Counter(f"{name} ({why})" for file in files for name, why in read_as(file, "image", unused_fields).items())
    return [f"Not used in {count} photographs: {' '.join(what.split())[:99]}" for what, count in found.most_common(5)]


def report(source: Source, frames: Sequence[Frame]) -> str:
    """Return a report for the user: what was left out and why, what was used, what was assumed. Prints nothing.

    `frames`: what was imported from `source`.
    """
    lines = list(source.notes)
    total = len(frames) + len(source.without_pose)
    if source.without_pose:
        lines.append(f"{len(source.without_pose)} of {total} photographs left out, without a pose: "
                     f"{few(source.without_pose)}")  # fmt: skip
    if source.without_photograph:
        lines.append(f"{counted(source.without_photograph, 'camera')} left out, without a photograph in "
                     f"{source.folder}: {few(source.without_photograph)}"
                     + (f"; {other}" if (other := unread(source)) else ""))  # fmt: skip
    lines.extend(unused_in(frame.image for frame in frames if frame.pixels is None))
    used = {frame.image for frame in frames} | {frame.mask for frame in frames}
    posed = {stem_of(parts_of(name)[-1]) for name in source.without_pose if parts_of(name)}
    if unused := [f.name for f in source.available if f not in used and stem_of(parts_of(f.name)[-1]) not in posed]:
        lines.append(f"{counted(unused, 'image')} in {source.folder} left out, without a camera: {few(unused)}")
    masked = sum(frame.mask is not None for frame in frames)
    lines.append(f"{len(frames)} photographs, {masked} with masks, of {len({f.pose.tobytes() for f in frames})} "
                 f"cameras: {source.scene}")  # fmt: skip
    lines.append(f"Assumed: {'; '.join(assumptions(frames))}")
    return "\n".join(lines)
