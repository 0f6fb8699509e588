"""Write a sheet of markers to print and put under the object: `python -m mi_ring.board FILE`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mi_ring.errors import InputError
from mi_ring.images import encoded_picture
from mi_ring.photogrammetry.marker_sheet import DOTS, page
from mi_ring.system import command
from mi_ring.system.files import require_place, write_file


@dataclass(frozen=True)
class BoardConfig:
    """Write a sheet of markers. Print it and put it under the object before you take photographs.

    With the sheet in the photographs, mi-ring photos finds the scale and the position of the flash.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE")]]
    """File to write: .pdf to print, or .png."""
    paper: Literal["a4", "letter"] = "a4"
    """Size of the paper in the printer. a4: 210 × 297 mm. letter: 8.5 × 11 inches, as in North America."""


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    config = command.parse(BoardConfig, arguments, "mi_ring.board", needs_llvm=False)
    file, kind = config.file, config.file.suffix.lower()
    if kind not in (".pdf", ".png"):
        raise InputError(f"{file}: FILE: ends in {kind or 'nothing'}; must end in .pdf or .png")
    require_place(file)
    dpi = 25.4 * DOTS
    options = {"resolution": dpi, "title": "mi_ring board"} if kind == ".pdf" else {"dpi": (dpi, dpi)}
    write_file(file, encoded_picture(page(config.paper), kind[1:], **options))
    print(f'{file}\nPrint it at 100% ("actual size") and measure: five squares must be 100 mm long.')


if __name__ == "__main__":
    command.run("mi_ring.board", main)
