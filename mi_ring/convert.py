"""Import photographs with cameras from other tools: `python -m mi_ring.convert FORMAT SRC SCENE.xml`."""

from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from mi_ring.errors import InputError
from mi_ring.importers.conversion import write_scene
from mi_ring.importers.formats import FORMATS
from mi_ring.system import command

DESCRIPTION = """Write a scene file for photographs in the format of another tool.

Lens distortion is removed. Units and frame do not change. For the options see mi_ring.convert FORMAT --help."""
Formats: Any = Union[  # noqa: UP007
    tuple(Annotated[source, tyro.conf.subcommand(name)] for name, source in FORMATS.items())
]


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in FORMATS:
        raise InputError(f"FORMAT: is {arguments[0]}; must be one of {', '.join(FORMATS)}")
    source = command.parse(Formats, arguments, "mi_ring.convert", description=DESCRIPTION)
    frames = write_scene(source)
    if source.without_pose:
        some = sorted(source.without_pose)
        print(f"{len(some)} of {len(some) + len(frames)} photographs left out, without a pose: {', '.join(some[:3])}"
              f"{', …' if len(some) > 3 else ''}")  # fmt: skip
    masked = sum(frame.mask is not None for frame in frames)
    print(f"{len(frames)} photographs, {masked} with masks, of {len({f.pose.tobytes() for f in frames})} cameras: "
          f"{source.scene}\nNow: python -m mi_ring.fit {source.scene}")  # fmt: skip


if __name__ == "__main__":
    command.run("mi_ring.convert", main)
