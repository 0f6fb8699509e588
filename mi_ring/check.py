"""Check a capture: `python -m mi_ring.check SCENE.xml`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mi_ring.capture.loading import load_capture
from mi_ring.capture.reduction import WIDTH
from mi_ring.errors import InputError
from mi_ring.output.inspection import inspect
from mi_ring.system import command, files
from mi_ring.system.progress import Part, Steps


@dataclass(frozen=True)
class CheckConfig:
    """Check a capture before a fit: prints a table and findings, and writes a contact sheet.

    The table has a line per photograph with these numbers: distances of camera and light from the object [radii of the
    object]; angle between camera and light, seen from the object [deg]; share of the photograph that shows the object;
    shares of the object that are overexposed and dark; brightness of the background relative to the object; brightness
    of the object relative to the other photographs, after division by the strength of the light; share of the mask that
    the other masks confirm. On the contact sheet, masks have a green outline, invalid pixels are red and the visual
    hull is blue. The exit status is 1 if there is something to correct.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file that names the photographs, their cameras and lights."""
    out: Path | None = None
    """Contact sheet to write, a .png file with all photographs and masks. Without this option: out/check/NAME.png.
    NAME is the name of the scene file without .xml: pot for pot.xml. It is pot for pot/scene.xml, too."""
    masks: Literal["auto", "given", "none"] = "auto"
    """The masks to check. Set none if the masks of the scene file are wrong and the background is dark.
    given: the masks of the scene file. none: no masks of the file; in a dark room the bright pixels are the mask.
    auto: given if the scene file has masks, otherwise none."""


def main(arguments: Sequence[str]) -> int:
    """Run the command with these arguments of the command line. Returns its exit status.

    The status is 1 if the capture has a problem that the user should correct, otherwise 0.
    """
    config = command.parse(CheckConfig, arguments, "mi_ring.check")
    out = config.out or Path("out/check") / f"{command.scene_name(config.scene)}.png"
    with Steps([Part("reading masks", 0.5), Part("searching", 0.5)], [Part("reading", 5)], [Part("inspecting", 4)]):
        return checked(config, out)


def checked(config: CheckConfig, out: Path) -> int:
    """Check the capture, print the table and the findings, and write the contact sheet to the .png file `out`.

    Returns 1 if there is a finding, otherwise 0. Raises InputError if `out` cannot be written or is an image of the
    scene.
    """
    capture = load_capture(config.scene, masks=config.masks, width=WIDTH)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: --out: must end in .png")
    if out.resolve() in {file.resolve() for shot in capture.shots for file in shot.files if file}:
        raise InputError(f"{out}: --out: is one of the scene's own images; choose another file")
    files.require_place(out, "--out")
    inspection = inspect(capture)
    inspection.save(out, "--out")
    print(f"{inspection.text}\nContact sheet: {out}")
    return int(bool(inspection.findings))


if __name__ == "__main__":
    command.run("mi_ring.check", main)
