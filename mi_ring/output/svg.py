"""Makes Matplotlib's figures, and encodes them for web pages."""

import base64
import io
from typing import Any

from mi_ring.system.optional import LazyPackage

# A fit draws nothing before its end, and their import takes half a second.
matplotlib, matplotlib_figure = (LazyPackage(name, "charts") for name in ("matplotlib", "matplotlib.figure"))


def new_figure(width: float, height: float) -> Any:
    """Make an empty matplotlib.figure.Figure of this size [inches]."""
    return matplotlib_figure.Figure(figsize=(width, height), layout="constrained")


def svg_uri(figure: Any) -> str:
    """Encode a figure as an SVG data URI. Equal figures give equal URIs."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "mi_ring"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
