"""The README's picture: how the start becomes the object, and what is known of it in the end.

    python docs/make_picture.py out/pot2 docs/pot2.png [--photograph 7]
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from mi_ring import bridge, capture
from mi_ring.capture import linear_to_srgb, to_bytes
from mi_ring.ring import Ring


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--photograph", type=int, default=7)
    arguments = parser.parse_args()

    scene, ring = capture.load(arguments.run / "scene.xml"), Ring.load(arguments.run)
    surface = bridge.Surface(scene.scene, scene.shape, ring)
    k = arguments.photograph
    photograph = scene.photograph(k)
    s, faces = ring.domain.sample(6)
    surface.set_faces(faces)
    flow = []
    with torch.no_grad():
        for quarter in range(5):
            vertices = ring.center + ring.radius * ring.shape_net.flow(s, quarter * ring.shape_net.steps // 4)
            surface.write(vertices, ring.brdf_net(s))
            flow.append(linear_to_srgb(bridge.draw(surface, photograph, spp=64)[0][0].numpy()))
    maps = {name: m[0] for name, m in bridge.maps(surface, photograph).items()}
    seen = (maps["normal"] != 0).any(-1, keepdims=True)
    results = [
        linear_to_srgb(scene.observe([k])[0][0].numpy()),
        np.where(seen, maps["normal"] * 0.5 + 0.5, 0),
        linear_to_srgb(maps["diffuse"] / (2 * float(ring.brdf_net.scale))),
        np.repeat(maps["specular"][..., None] / maps["specular"].max(), 3, 2),
        np.repeat(maps["roughness"][..., None], 3, 2),
    ]
    sheet = np.concatenate([np.concatenate(row, 1) for row in (flow, results)], 0)
    Image.fromarray(to_bytes(sheet)).save(arguments.picture, optimize=True)


if __name__ == "__main__":
    main()
