"""Makes Matplotlib's figures, and encodes them for web pages."""

import base64
import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> "Figure":
    """Make an empty figure of this size [inches]."""
    from matplotlib.figure import Figure  # a fit draws nothing before its end, and this import takes half a second

    return Figure(figsize=(width, height), layout="constrained")


def svg_uri(figure: "Figure") -> str:
    """Encode a figure as an SVG data URI. Equal figures give equal URIs."""
    from matplotlib import rc_context

    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "mi_ring"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
