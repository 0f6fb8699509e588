"""Say whether a capture is usable, and what is wrong with it: `python -m mi_ring.check SCENE.xml`."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mi_ring.capture import capture
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.geometry.hull import NoHull
from mi_ring.metrics.captures import capture_findings, drop_empty, facing, measure, quality_table
from mi_ring.metrics.mask_agreement import agreements
from mi_ring.output.capture_sheet import capture_sheet
from mi_ring.system import command
from mi_ring.system.files import write_file, writing


@dataclass(frozen=True)
class CheckConfig:
    """Say whether a capture is usable, and what is wrong with it: a table, findings and a contact sheet.

    The table: distance of the camera and of the light from the object, in its radii; angle between the two [deg]; share
    of the photograph that is object; shares of the object that are clipped, and dark; brightness of the background, in
    that of the object; brightness for the light it gets, in that of the others; share of the mask that the other masks
    agree to. The contact sheet: masks outlined in red, the visual hull in green. The exit status is 1 if there is
    something to mend.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs."""
    out: Path | None = None
    """Picture to write. Default: out/check/<name>.png."""
    masks: Literal["auto", "given", "none"] = "auto"
    """given: those of the scene, if any; auto: the same, but if it has none the object is what is brighter than a dark
    room; none: as if it had none."""


def main(arguments: Sequence[str]) -> int:
    """The command. Returns its exit status: 1 if there is something to mend."""
    config = command.parse(CheckConfig, arguments, "mi_ring.check")
    out = config.out or Path("out/check") / f"{command.scene_name(config.scene)}.png"
    scene = load_capture(config.scene, masks=config.masks)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: --out: must end in .png")
    if out.resolve() in {file for sensor in scene.sensors for file in sensor.files}:
        raise InputError(f"{out}: --out: is one of the scene's own pictures; choose another file")
    found = [f"{name}: its mask is empty: next to nothing in it is above 127" for name in drop_empty(scene)]
    try:
        center, radius = scene.sphere()
    except NoHull as error:
        center, radius = capture.sphere_of_cameras(scene)
        found += [] if scene.whole else [str(error)]
    agreement, wrong = agreements(scene)
    rows = measure(scene, center, radius, agreement)
    found += wrong or filter(None, [facing(scene, center)])
    found += capture_findings(scene, rows, center)
    page = capture_sheet(scene, rows, center, radius)
    with writing(f"{out}: --out"):
        out.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    page.save(buffer, "PNG")
    write_file(out, buffer.getvalue())
    print(quality_table(rows))
    given = sum(mask is not None for mask in scene.masks)
    if scene.threshold is not None:
        print("\nMasks: found by brightness, for the room was dark")
    else:
        print(f"\nMasks: {given} of {len(rows)} photographs" + ("" if given else "; the start will be a guess"))
    print("Object: centre ({:.5g}, {:.5g}, {:.5g}), radius about {:.5g}".format(*center, radius))
    print("\n".join(f"To mend: {line}" for line in found) or "Nothing to mend found.")
    print(f"Contact sheet: {out}")
    return int(bool(found))


if __name__ == "__main__":
    command.run("mi_ring.check", main)
