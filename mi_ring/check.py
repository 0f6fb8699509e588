"""Say whether a capture is usable, and what is wrong with it: `python -m mi_ring.check SCENE.xml`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.output.inspection import inspect
from mi_ring.system import command, files


@dataclass(frozen=True)
class CheckConfig:
    """Say whether a capture is usable, and what is wrong with it: a table, findings and a contact sheet.

    The table: distance of the camera and of the light from the object, in its radii; angle between the two [deg]; share
    of the photograph that is object; shares of the object that are clipped, and dark; brightness of the background, in
    that of the object; brightness for the light it gets, in that of the others; share of the mask that the other masks
    agree to. The contact sheet: masks outlined in red, what says nothing in yellow, the visual hull in green. The exit
    status is 1 if there is something to mend.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs."""
    out: Path | None = None
    """Picture to write. Default: out/check/<name>.png."""
    masks: Literal["auto", "given", "none"] = "auto"
    """given: those of the scene, if any; auto: the same, but if it has none the object is what is brighter than a dark
    room; none: as if it had none."""


def main(arguments: Sequence[str]) -> int:
    """Run the command. Returns its exit status: 1 if there is something to mend."""
    config = command.parse(CheckConfig, arguments, "mi_ring.check")
    out = config.out or Path("out/check") / f"{command.scene_name(config.scene)}.png"
    capture = load_capture(config.scene, masks=config.masks)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: --out: must end in .png")
    if out.resolve() in {file for sensor in capture.sensors for file in sensor.files}:
        raise InputError(f"{out}: --out: is one of the scene's own pictures; choose another file")
    files.require_place(out, "--out")
    inspection = inspect(capture)
    inspection.save(out, "--out")
    print(f"{inspection.text}\nContact sheet: {out}")
    return int(bool(inspection.findings))


if __name__ == "__main__":
    command.run("mi_ring.check", main)
