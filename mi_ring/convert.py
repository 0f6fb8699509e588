"""Import photographs with cameras from other tools: `python -m mi_ring.convert FORMAT SRC SCENE.xml`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Union

import tyro

from mi_ring.errors import InputError
from mi_ring.importers.conversion import report, write_scene
from mi_ring.importers.formats import FORMATS, guess
from mi_ring.system import command

DESCRIPTION = """Write a scene file for photographs in the format of another tool.

Lens distortion is removed. Units and frame do not change. For the options see mi_ring.convert FORMAT --help. Without
FORMAT, it is guessed from SRC: mi_ring.convert SRC SCENE.xml."""
Formats: Any = Union[  # noqa: UP007
    tuple(Annotated[source, tyro.conf.subcommand(name)] for name, source in FORMATS.items())
]


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in FORMATS:
        if not (src := Path(arguments[0])).exists():
            raise InputError(f"FORMAT: is {src}; must be one of {', '.join(FORMATS)}, or SRC, a file or folder")
        name, src = guess(src)
        print(f"{src}: taken for {name}")
        arguments = [name, str(src), *arguments[1:]]
    source = command.parse(Formats, arguments, "mi_ring.convert", description=DESCRIPTION)
    frames = write_scene(source)
    print(f"{report(source, frames)}\nNow: python -m mi_ring.fit {source.scene}")


if __name__ == "__main__":
    command.run("mi_ring.convert", main)
