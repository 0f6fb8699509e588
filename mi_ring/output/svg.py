"""Encodes Matplotlib figures for web pages."""

import base64
import io

from matplotlib import rc_context
from matplotlib.figure import Figure


def svg_uri(figure: Figure) -> str:
    """Encode a figure as an SVG data URI. Equal figures give equal URIs."""
    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "mi_ring"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
