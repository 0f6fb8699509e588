"""Figures of matplotlib in web pages."""

import base64
import io

from matplotlib.figure import Figure


def svg_uri(figure: Figure) -> str:
    """A figure as an SVG data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg")
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
