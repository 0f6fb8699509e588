"""The picture of the pot: how a sphere becomes the object, and what a fit with the default settings finds.

python -m mi_ring.fit scenes/pot2.xml
python -m mi_ring.fit scenes/pot2.xml --domain sphere --out out/pot2_sphere
python docs/make_picture.py out/pot2_sphere out/pot2 docs/pot2.png [--photograph 7]
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

import mi_ring
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

TIMES = {"0": 0.0, "¼": 0.25, "½": 0.5, "¾": 0.75, "1": 1.0}  #: of the flow
LABEL, SIZE = 30, 18  #: height of the labels above the pictures, and of their letters [px]


def opened(run: Path) -> tuple[mi_ring.Capture, mi_ring.FittedObject, Surface]:
    """A fit: its photographs, its object, and that in the scene of the photographs."""
    capture, ring = mi_ring.load_capture(run / "scene.xml"), mi_ring.load_fit(run)
    return capture, ring, Surface(capture.scene, capture.shape, ring)


def flow(run: Path, k: int) -> dict[str, np.ndarray]:
    """The surface of a fit on its way, seen and lit as in photograph `k`."""
    capture, ring, surface = opened(run)
    s, faces = ring.domain.sample(ring.subdivisions)
    found = {}
    for name, time in TIMES.items():
        surface.show(ring, s, faces, time)
        rgb, _ = prediction.draw(surface, capture.photograph(k), spp=64, indirect=ring.indirect)
        found[f"time {name}"] = linear_to_srgb(rgb[0].numpy())
    return found


def result(run: Path, k: int) -> dict[str, np.ndarray]:
    """Photograph `k` and what it sees of the fitted surface; grey is from 0 to about the highest value."""
    capture, ring, surface = opened(run)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    maps = {name: values[0] for name, values in prediction.maps(surface, capture.photograph(k)).items()}
    seen = (maps["normal"] != 0).any(-1)

    def relative(name):
        return maps[name] / np.quantile(maps[name][seen], 0.99)

    return {
        "photograph": linear_to_srgb(capture.observe([k]).rgb[0].numpy()),
        "normals": np.where(seen[..., None], maps["normal"] * 0.5 + 0.5, 0),
        "diffuse": linear_to_srgb(relative("diffuse")),
        "specular": np.repeat(relative("specular")[..., None], 3, 2),
        "roughness": np.repeat(relative("roughness")[..., None], 3, 2),
    }


def labelled(pictures: dict[str, np.ndarray]) -> np.ndarray:
    """Pictures in a row, each below its name, as bytes."""
    row = np.concatenate(list(pictures.values()), 1)
    row = np.pad(to_bytes(row), ((LABEL, 0), (0, 0), (0, 0)))
    image = Image.fromarray(row)
    draw, font = ImageDraw.Draw(image), ImageFont.truetype(findfont("DejaVu Sans"), SIZE)
    left = 0
    for name, picture in pictures.items():
        draw.text((left + picture.shape[1] / 2, LABEL / 2), name, fill=(230, 230, 230), font=font, anchor="mm")
        left += picture.shape[1]
    return np.array(image)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("flow", type=Path, help="results folder of a fit by --domain sphere, whose flow is shown")
    parser.add_argument("result", type=Path, help="results folder of the fit whose result is shown")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--photograph", type=int, default=7)
    arguments = parser.parse_args()
    k = arguments.photograph
    sheet = np.concatenate([labelled(flow(arguments.flow, k)), labelled(result(arguments.result, k))], 0)
    Image.fromarray(sheet).save(arguments.picture, optimize=True)


if __name__ == "__main__":
    main()
