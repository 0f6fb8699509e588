"""Join photographs with flash and others without: `python -m mi_ring.join FLASH.xml ROOM.xml OUT.xml`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ring.capture.joining import join_captures
from mi_ring.errors import InputError
from mi_ring.system import command
from mi_ring.system.files import require_place, write_file


@dataclass(frozen=True)
class JoinConfig:
    """Write one scene file for two captures of an object, with flash and in the light of the room alone.

    A fit then finds one surface, one material and both lights. The object must not move between the captures. Both
    need the same frame and unit: calibrate all photographs together. Cameras that agree to 0.01 pixels become equal:
    such photographs are pairs. Image files stay where they are.
    """

    flash: Positional[Annotated[Path, arg(metavar="FLASH.xml")]]
    """Scene file of the photographs with flash. What it says of object, table and emitters counts for all."""
    room: Positional[Annotated[Path, arg(metavar="ROOM.xml")]]
    """Scene file of the photographs without flash. Lights of its photographs are left out.
    A photograph without a mask gets that of the photograph with flash from the same place."""
    out: Positional[Annotated[Path, arg(metavar="OUT.xml")]]
    """Scene file to write. It must not exist."""


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    config = command.parse(JoinConfig, arguments, "mi_ring.join")
    out = config.out
    if out.suffix != ".xml" or out.exists():
        what = "exists already; give another name" if out.exists() else "must end in .xml"
        raise InputError(f"{out}: OUT.xml: {what}")
    joined = join_captures(config.flash, config.room, out.parent)
    require_place(out, "OUT.xml")
    write_file(out, joined.xml)
    for note in joined.notes:
        print(note)
    counts = f"{joined.lit} photographs with flash, {joined.dark} in the light of the room alone, {joined.pairs} pairs"
    print(f"{counts}: {out}\nNow: python -m mi_ring.fit {out}")


if __name__ == "__main__":
    command.run("mi_ring.join", main)
