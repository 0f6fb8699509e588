"""Say whether a capture is usable, and what is wrong with it: `python -m mi_ring.check SCENE.xml`."""

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


@dataclass(frozen=True)
class CheckConfig:
    """Say whether a capture is usable and what is wrong with it: a table, findings and a contact sheet.

    The table has a line for each photograph: distance of camera and light from the object, in radii of the object;
    angle between the two [deg]; share of the photograph that is object; shares of the object that are clipped and dark;
    brightness of the background, relative to the object; brightness for the light it gets, relative to the other
    photographs; share of the mask that the other masks confirm. The contact sheet has masks outlined in red, invalid
    pixels in yellow and the visual hull in green. The exit status is 1 if there is something to correct.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs."""
    out: Path | None = None
    """Picture to write, .png. Without it: out/check/NAME.png."""
    masks: Literal["auto", "given", "none"] = "auto"
    """Which masks are used.
    given: those of the scene, if it has any. auto: the same, otherwise what is brighter than a dark room.
    none: the scene's masks are ignored, the object is what is brighter than a dark room.
    Use none if the scene's masks are wrong and the background is dark."""


def main(arguments: Sequence[str]) -> int:
    """Run the command. Returns its exit status: 1 if there is something to mend."""
    config = command.parse(CheckConfig, arguments, "mi_ring.check")
    out = config.out or Path("out/check") / f"{command.scene_name(config.scene)}.png"
    capture = load_capture(config.scene, masks=config.masks, width=WIDTH)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: --out: must end in .png")
    if out.resolve() in {file.resolve() for shot in capture.shots for file in shot.files if file}:
        raise InputError(f"{out}: --out: is one of the scene's own pictures; choose another file")
    files.require_place(out, "--out")
    inspection = inspect(capture)
    inspection.save(out, "--out")
    print(f"{inspection.text}\nContact sheet: {out}")
    return int(bool(inspection.findings))


if __name__ == "__main__":
    command.run("mi_ring.check", main)
