"""Inspection of a capture: a table of its photographs, a list of problems, and a contact sheet."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mi_ring.capture.capture import Capture
from mi_ring.geometry.camera import sphere_of_cameras
from mi_ring.geometry.hull import NoHull
from mi_ring.images import encoded_picture
from mi_ring.metrics.brightness_samples import BrightnessSampler
from mi_ring.metrics.capture_findings import capture_findings, facing, measure, quality_table, without_empty_masks
from mi_ring.metrics.light_findings import light_findings
from mi_ring.metrics.mask_agreement import agreements
from mi_ring.output.capture_sheet import capture_sheet
from mi_ring.system.files import write_file, writing
from mi_ring.system.progress import progress


@dataclass(frozen=True)
class Inspection:
    """The result of an inspection: a text, the problems and the contact sheet."""

    text: str  #: the table of photographs and the findings
    findings: list[str]  #: the problems to correct
    page: Image.Image  #: the contact sheet

    def save(self, path: Path, field: str) -> None:
        """Write the contact sheet as a PNG file. `field`: name of the command's option, for the error message.

        Raises InputError if the file cannot be written.
        """
        with writing(f"{path}: {field}"):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, encoded_picture(self.page))


def inspect(capture: Capture) -> Inspection:
    """Check a capture before a fit, and draw its contact sheet. Writes no file.

    Empty masks are reported as problems; the other checks then ignore them.
    """
    with progress(None, "inspecting", 4) as bar:
        return inspected(capture, bar.update)


def inspected(capture: Capture, advance: Callable[[], object]) -> Inspection:
    """Check a capture before a fit, and draw its contact sheet. Writes no file.

    `advance` is called without arguments after each of the four steps, for a progress bar.
    """
    capture, empty = without_empty_masks(capture)
    found = [f"{name}: its mask is empty: next to nothing in it is above 127" for name in empty]
    try:
        center, radius = capture.sphere()
    except NoHull as error:
        center, radius = sphere_of_cameras([shot.whole.camera for shot in capture.shots], str(capture.path))
        found += [] if capture.whole else [str(error)]
    advance()
    agreement, wrong = agreements(capture)
    advance()
    sampler = BrightnessSampler.of(capture, center, radius)
    rows = measure(capture, center, radius, agreement, sampler)
    advance()
    found += wrong or filter(None, [facing(capture, center)])
    found += capture_findings(capture, rows, center) + (light_findings(sampler.samples(center)) if sampler else [])
    page = capture_sheet(capture, rows, center, radius)
    advance()
    given = sum(capture.masks.given)
    if capture.threshold is not None:
        masks = "found by brightness, for the room was dark"
    else:
        masks = f"{given} of {len(rows)} photographs" + ("" if given else "; the start will be a guess")
    problems = [f"Problem: {line}" for line in found] or ["No problems found."]
    unit = "mm" if capture.shape.metres == 1e-3 else "scene units"
    place = "Object: centre ({:.5g}, {:.5g}, {:.5g}), radius about {:.5g}".format(*center, radius) + f" [{unit}]"
    photographs, light = capture.photographs, []
    if photographs.dark and not photographs.room_rows:
        light = ["Light: the photographs have no light of their own; mi-ring fit --light auto finds it"]
    elif photographs.mixed:
        dark = np.sum(~photographs.lit)
        light = [f"Light: {dark} of {len(rows)} photographs have none of their own; a fit finds the room's in them"]
    return Inspection("\n".join([quality_table(rows), "", f"Masks: {masks}", place, *light, *problems]), found, page)
