"""Bring photographs in from other tools: `python -m mi_ring.convert FORMAT SRC SCENE.xml`."""

import shutil
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.errors import InputError
from mi_ring.importers.formats import FORMATS
from mi_ring.importers.frames import frames_of, require_frames
from mi_ring.importers.writer import Writer, place_frame
from mi_ring.system import command
from mi_ring.system.progress import progress

DESCRIPTION = """Write a scene file for photographs in the format of another tool.

Lens distortion is undone; units and frame stay as they are. mi_ring.convert FORMAT --help tells more."""
Formats: Any = Union[  # noqa: UP007
    tuple(Annotated[source, tyro.conf.subcommand(name)] for name, source in FORMATS.items())
]


def main(arguments: Sequence[str]) -> None:
    """The command."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in FORMATS:
        raise InputError(f"FORMAT: is {arguments[0]}; must be one of {', '.join(FORMATS)}")
    source = command.parse(Formats, arguments, "mi_ring.convert", description=DESCRIPTION)
    frames = frames_of(source)
    if source.left_out and not frames:
        raise InputError(f"{source.src}: SRC: none of {len(source.left_out)} photographs has a pose")
    require_frames(frames, source.src)
    names = [frame.name or frame.image.stem for frame in frames]
    if len({*names, "object"}) <= len(names):
        names = [f"{k:0{len(str(len(frames)))}}_{name}" for k, name in enumerate(names)]
    root = scene_element([])
    if source.scene.suffix != ".xml" or source.scene.exists():
        what = "exists already; give another name" if source.scene.exists() else "must end in .xml"
        raise InputError(f"{source.scene}: SCENE.xml: {what}")
    try:
        writer = Writer(source.scene)
        try:
            for frame, name in zip(progress(frames, "converting", unit="photograph", disable=None), names):
                encoding = source.encoding if source.encoding != "auto" else frame.encoding
                files = place_frame(writer, frame, name, source.copy, encoding)
                root.append(photograph_element(name, files.filename, frame.camera, frame.light, files.mask, encoding,
                                               frame.saturation, files.valid))  # fmt: skip
            if truth := getattr(source, "truth", None):
                writer.write("truth/mesh.ply", lambda file: shutil.copyfile(truth, file))
            writer.finish(scene_bytes(root))
        finally:
            writer.close()
    except OSError as error:
        raise InputError(f"{source.scene}: cannot be written ({error.strerror or error})") from error
    if source.left_out:
        some = sorted(source.left_out)
        print(f"{len(some)} of {len(some) + len(frames)} photographs left out, without a pose: {', '.join(some[:3])}"
              f"{', …' if len(some) > 3 else ''}")  # fmt: skip
    masked = sum(frame.mask is not None for frame in frames)
    print(f"{len(frames)} photographs, {masked} with masks, of {len({f.pose.tobytes() for f in frames})} cameras: "
          f"{source.scene}\nNow: python -m mi_ring.fit {source.scene}")  # fmt: skip


if __name__ == "__main__":
    command.run("mi_ring.convert", main)
