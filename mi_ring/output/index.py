"""Writes index.html: a page that lists many fits, with a picture and numbers from the report of each fit."""

import base64
import contextlib
import functools
import html
import io
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import jinja2
from PIL import Image

from mi_ring.images import encoded_picture
from mi_ring.output.results import read_log
from mi_ring.system.files import relative_to, write_file
from mi_ring.version import __version__

SIDE = 160  #: largest side of the pictures [px]
#: Figures of the page: names in a report, names on the page, explanations.
FIGURES = {
    "PSNR of the photographs": ("PSNR", "of the predicted photographs, sRGB; higher is better"),
    "Silhouettes": ("silhouettes", "intersection over union of predictions and masks; 1 is best"),
    "Mesh": ("mesh", "its size"),
    "Fit time": ("time", "of the fit, without start and report"),
}
UNEXPLAINED = "unexplained", "share of the photographs' light that the fit does not predict; lower is better"
STATES = "done", "running", "interrupted", "waiting", "failed"  #: of fits


class Entry(NamedTuple):
    """A fit that the page lists in a row."""

    name: str
    state: str  #: of STATES
    text: str  #: its progress or its error
    folder: Path  #: its results
    log: Path  #: its output


def write_index(out: Path, entries: Sequence[Entry], running: bool) -> None:
    """Write index.html into the folder `out`, which is created if necessary. Reads the report of each fit.

    `running`: True while fits are running: browsers then reload the page regularly.
    """
    template = resources.files("mi_ring.output").joinpath("index.html.jinja").read_text("utf-8")
    rows = [row_of(entry, out) for entry in entries]
    states = [entry.state for entry in entries]
    page = jinja2.Environment(autoescape=True).from_string(template)
    counts = {state: states.count(state) for state in STATES if state in states}
    out.mkdir(parents=True, exist_ok=True)
    figures = dict([*FIGURES.values(), UNEXPLAINED])
    write_file(out / "index.html", page.render(rows=rows, figures=figures, counts=counts, running=running,
                                               version=__version__))  # fmt: skip


def row_of(entry: Entry, out: Path) -> dict:
    """Collect what the page shows about a fit. Returns a dictionary for the template of the page.

    Its keys are the fields of Entry, `figures` (texts by name), `picture` (a data URI or None), and `link` and `log`,
    the links to report and log for a page in the folder `out` (None if there is no such file).
    """
    figures: dict[str, str] = {}
    picture, report = None, entry.folder / "report.html"
    with contextlib.suppress(OSError, ValueError):
        reported, picture = report_summary(report, report.stat().st_mtime_ns)
        figures |= reported
    with contextlib.suppress(OSError, LookupError, TypeError, ValueError):
        figures[UNEXPLAINED[0]] = f"{read_log(entry.folder)[-1]['unexplained']:.1%}"
    return {**entry._asdict(), "figures": figures, "picture": picture, "link": link_to(report, out),
            "log": link_to(entry.log, out)}  # fmt: skip


def link_to(file: Path, out: Path) -> str | None:
    """Return a link to `file` for a page in the folder `out`; None if there is no such file."""
    return quote(relative_to(out.resolve(), file.resolve())) if file.is_file() else None


@functools.lru_cache(maxsize=4096)
def report_summary(report: Path, modified: int) -> tuple[dict[str, str], str | None]:
    """Read numbers and a picture from a report. Returns (numbers as texts by name, data URI of the picture or None).

    The picture is a thumbnail of the first predicted photograph. `modified`: modification time of the file [ns].
    Results are cached by path and modification time, because the index page is rewritten often.
    """
    page = report.read_text("utf-8")
    cells = re.findall(r"<tr><th>([^<]*)</th><td>([^<]*)</td></tr>", page)
    values = {html.unescape(name): html.unescape(value) for name, value in cells}
    figures = {short: re.split(r" \(|, | intersection", values[name])[0]
               for name, (short, _) in FIGURES.items() if name in values}  # fmt: skip
    found = re.search(r'class="over" src="data:image/\w+;base64,([^"]*)"', page)
    if not found:
        return figures, None
    picture = Image.open(io.BytesIO(base64.b64decode(found[1]))).convert("RGB")
    picture.thumbnail((SIDE, SIDE))
    return figures, "data:image/jpeg;base64," + base64.b64encode(encoded_picture(picture, "JPEG", quality=85)).decode()
