"""Write a small capture of a pot, to try all commands with: `python -m mi_ring.example DIR`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ring.errors import InputError
from mi_ring.synthesis.example_pot import VIEWS, write_example
from mi_ring.system import command
from mi_ring.system.files import whole_folder, writing


@dataclass(frozen=True)
class ExampleConfig:
    """Write a small capture: flash photographs of a pot, their masks and scene file, and the true mesh."""

    folder: Positional[Annotated[Path, arg(metavar="DIR")]]
    """Folder to write. It must be new or empty."""


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    folder = command.parse(ExampleConfig, arguments, "mi_ring.example").folder
    with writing(folder):
        here = folder.resolve() == Path.cwd()  # it cannot be replaced
        if here or (folder.exists() and not (folder.is_dir() and not any(folder.iterdir()))):
            raise InputError(f"{folder}: DIR: is there already; give another name")
    print(f"Path tracing {VIEWS} photographs takes one to three minutes", flush=True)
    with whole_folder(folder) as growing:
        write_example(growing)
    print(f"{folder}/scene.xml, and the true surface in {folder}/truth/mesh.ply\n"
          f"Now: mi-ring fit {folder}/scene.xml --preset fast")  # fmt: skip


if __name__ == "__main__":
    command.run("mi_ring.example", main)
