"""Draws the contact sheet of mi-ring validate, which compares mi_ring's own renderer with Mitsuba's path tracer."""

import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw

from mi_ring.images import encoded_picture, linear_to_srgb, to_bytes
from mi_ring.metrics.path_tracing import Pictures
from mi_ring.metrics.renderer_agreement import Comparison, percent, probability

THUMBNAIL = 128  #: largest side of the pictures [px]
COLUMNS = ("path", "photometric", "8 x difference", "shadows", "4 x interreflection", "32 x unexplained")
LEGEND = "Each photograph by its own exposure. Differences: red where photometric is brighter, blue where it is darker."


def strip(row: Comparison, pictures: Pictures) -> Image.Image:
    """Draw a row of the sheet for one photograph: pictures side by side, with the numbers of `row` above them.

    `pictures`: renderings by mi_ring's own renderer, photometric, and by Mitsuba's path tracer. Each row has its own
    exposure. Differences are red where photometric is brighter, and blue where it is darker.
    """
    photometric, unshadowed, path, direct = (p.mean(0) for p in vars(pictures).values())
    white = np.quantile(path[path > 0], 0.98) if (path > 0).any() else 1.0

    def signed(x: np.ndarray) -> np.ndarray:
        return colormaps["RdBu_r"](0.5 + 0.5 * x.mean(-1) / white)[..., :3]

    cells = [
        linear_to_srgb(path / white),
        linear_to_srgb(photometric / white),
        signed(8 * (photometric - path)),
        linear_to_srgb((unshadowed - photometric) / white),
        linear_to_srgb(4 * (path - direct) / white),
        signed(32 * (photometric - direct)),
    ]
    height, width = path.shape[:2]
    factor = THUMBNAIL / max(height, width)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    method = Image.Resampling.BOX if factor < 1 else Image.Resampling.NEAREST
    line = Image.new("RGB", (len(COLUMNS) * (THUMBNAIL + 4), size[1] + 18))
    for k, cell in enumerate(cells):
        line.paste(Image.fromarray(to_bytes(cell)).resize(size, method), (k * (THUMBNAIL + 4), 16))
    text = "   ".join([
        row.name, f"difference {percent(row.difference)}", f"shadows {percent(row.shadows)}",
        f"interreflection {percent(row.interreflection)}", f"unexplained {percent(row.unexplained)}",
        f"({probability(row.p_direct)})",
    ])  # fmt: skip
    ImageDraw.Draw(line).text((2, 2), text, fill=(255, 255, 255))
    return line


def validation_sheet(strips: list[Image.Image]) -> bytes:
    """Arrange strips of pictures in a contact sheet that is about square. Returns the bytes of a PNG file.

    `strips`: one for each photograph, at least one.
    """
    width, height = strips[0].width + 12, max(line.height for line in strips)
    stacks = max(1, round(np.sqrt(len(strips) * height / width)))
    rows = -(-len(strips) // stacks)
    stacks = -(-len(strips) // rows)
    page = Image.new("RGB", (stacks * width - 12, rows * height + 32))
    draw = ImageDraw.Draw(page)
    for k, title in enumerate(COLUMNS * stacks):
        stack, column = divmod(k, len(COLUMNS))
        draw.text((stack * width + column * (THUMBNAIL + 4) + 2, 18), title, fill=(255, 220, 120))
    draw.text((2, 2), LEGEND, fill=(255, 220, 120))
    for k, line in enumerate(strips):
        page.paste(line, (k // rows * width, 32 + k % rows * height))
    return encoded_picture(page)
