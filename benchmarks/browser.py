"""How near a browser's picture of an exported GLB comes to ours.

    python benchmarks/browser.py out/pot2 [--picture docs/glb.png]

The viewer of the run's report.html draws every photograph of the fit in headless Chromium. `photometric` renders the
same photographs from the networks. The viewer has neither shadows nor interreflection, so our first row has none.

Prints a Markdown table with machine and date: mean absolute difference of sRGB values in % of full scale, over all
pixels and over the pixels of the object, and PSNR. --picture writes three photographs side by side.
"""

import argparse
import base64
import datetime
import io
import shutil
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from accuracy import processor
from playwright.sync_api import sync_playwright

from mi_ring.capture import loading
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.objects.ring_file import load_fit
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface


def photograph(shot) -> dict:
    """A photograph as the viewer's `draw` takes it. Raises ValueError if its light is no point."""
    matrix, (fx, fy), (cx, cy), (width, height), _ = shot.camera
    light = shot.own_light
    if light.kind == "directional":
        raise ValueError("the viewer has a point light, this photograph a distant one")
    return {
        "to_world": matrix.ravel().tolist(), "fx": float(fx), "fy": float(fy), "cx": float(cx), "cy": float(cy),
        "width": width, "height": height, "light": {"position": light.vector.tolist(), "intensity": light.rgb.tolist()},
    }  # fmt: skip


def drawn(page_file: Path, shots) -> list[np.ndarray]:
    """The photographs (H, W, 3) that the viewer of a report draws, sRGB in [0, 1]."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium") or shutil.which("google-chrome"),
            args=["--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        page = browser.new_page()
        page.goto(page_file.resolve().as_uri())
        page.wait_for_function("window.viewer !== undefined")
        pictures = []
        for shot in shots:
            url = page.evaluate("photograph => window.viewer.draw(photograph)", photograph(shot))
            pictures.append(imageio.imread(io.BytesIO(base64.b64decode(url.split(",")[1])))[..., :3] / 255)
        browser.close()
    return pictures


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="results folder of a fit")
    parser.add_argument("--picture", type=Path, help="file for a picture of three photographs")
    arguments = parser.parse_args()
    scene, ring = loading.load_capture(arguments.run / "scene.xml", images=False), load_fit(arguments.run)
    theirs = drawn(arguments.run / "report.html", scene.shots)
    surface = Surface(scene.scene, scene.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    print(f"{processor()}; {datetime.date.today()}; {arguments.run.name}, {len(theirs)} photographs\n")
    print("| ours | all pixels, % | the object's, % | PSNR, dB |\n| --- | --- | --- | --- |")
    plain = None
    for title, options in {
        "direct light, no shadows": {"shadows": False},
        "all light": {"shadows": True, "indirect": True},
    }.items():
        ours, covered = zip(
            *(prediction.draw(surface, scene.photograph(k), spp=64, **options) for k in range(len(scene)))
        )
        ours = [linear_to_srgb(picture[0].numpy()) for picture in ours]
        plain = plain or ours
        difference = [np.abs(a - b) for a, b in zip(ours, theirs)]
        inside = np.concatenate([d[c[0].numpy() > 0.5] for d, c in zip(difference, covered)])
        square = np.mean([(d**2).mean() for d in difference])
        print(f"| {title} | {100 * np.mean([d.mean() for d in difference]):.2f} | {100 * inside.mean():.2f} "
              f"| {-10 * np.log10(square):.1f} |")  # fmt: skip
        sys.stdout.flush()
    if arguments.picture:
        some = [k * len(theirs) // 3 for k in range(3)]
        rows = [[pictures[k] for k in some] for pictures in (plain, theirs)]
        rows.append([4 * np.abs(a - b) for a, b in zip(*rows)])
        imageio.imwrite(arguments.picture, to_bytes(np.concatenate([np.concatenate(row, 1) for row in rows])))


if __name__ == "__main__":
    main()
