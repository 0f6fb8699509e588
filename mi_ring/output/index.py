"""index.html: one page that shows many fits, with a picture and the figures of each report."""

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

from mi_ring.output.results import read_log
from mi_ring.system.files import relative_to, write_file
from mi_ring.version import __version__

SIDE = 160  #: of the pictures, at most [px]
#: Figures of the page by their names in a report, and what they are.
FIGURES = {
    "PSNR of the photographs": ("PSNR", "of the predicted photographs, sRGB; the more the better"),
    "Silhouettes": ("silhouettes", "intersection over union of the predicted ones and the masks; 1 is the best"),
    "Mesh": ("mesh", "its size"),
    "Fit time": ("time", "of the fit, without start and report"),
}
UNEXPLAINED = "unexplained", "share of the photographs' light that the fit does not predict, last; the less the better"
STATES = "done", "running", "interrupted", "waiting", "failed"  #: of fits


class Entry(NamedTuple):
    """A fit: how it is called, how far it is, what there is to say of it, and the folder of its results."""

    name: str
    state: str  #: of STATES
    text: str
    folder: Path
    log: Path  #: what the fit has printed


def write_index(out: Path, entries: Sequence[Entry], running: bool) -> None:
    """The page of all fits. While they are `running` a browser reads it anew now and then."""
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
    """What the page shows of a fit."""
    figures: dict[str, str] = {}
    picture, report = None, entry.folder / "report.html"
    with contextlib.suppress(OSError, ValueError):
        told, picture = shown_of(report, report.stat().st_mtime_ns)
        figures |= told
    with contextlib.suppress(OSError, LookupError, TypeError, ValueError):
        figures[UNEXPLAINED[0]] = f"{read_log(entry.folder)[-1]['unexplained']:.1%}"
    return {**entry._asdict(), "figures": figures, "picture": picture, "link": link_to(report, out),
            "log": link_to(entry.log, out)}  # fmt: skip


def link_to(file: Path, out: Path) -> str | None:
    """As the page in `out` has it; None if there is no such file."""
    return quote(relative_to(out.resolve(), file.resolve())) if file.is_file() else None


@functools.lru_cache(maxsize=4096)
def shown_of(report: Path, written: int) -> tuple[dict[str, str], str | None]:
    """Figures and picture of a report as it was `written`: the page is made anew whenever one of many fits goes on."""
    page = report.read_text("utf-8")
    return figures_of(page), thumbnail_of(page)


def figures_of(report: str) -> dict[str, str]:
    """The figures of a report, the explanations in brackets left out."""
    cells = re.findall(r"<tr><th>([^<]*)</th><td>([^<]*)</td></tr>", report)
    told = {html.unescape(name): html.unescape(value) for name, value in cells}
    return {short: re.split(r" \(|, | intersection", told[name])[0]
            for name, (short, _) in FIGURES.items() if name in told}  # fmt: skip


def thumbnail_of(report: str) -> str | None:
    """The prediction of a report's first photograph as a data URI, small."""
    found = re.search(r'class="over" src="data:image/\w+;base64,([^"]*)"', report)
    if not found:
        return None
    picture = Image.open(io.BytesIO(base64.b64decode(found[1]))).convert("RGB")
    picture.thumbnail((SIDE, SIDE))
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=85)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
