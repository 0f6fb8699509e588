"""The pictures of docs/tutorial/own-photographs.md, from the OUT of `benchmarks/skull.py PHOTOS OUT`.

python docs/make_skull.py PHOTOS OUT docs/skull
"""

import argparse
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pycolmap
from make_picture import labelled, opened
from PIL import Image

from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.rendering import prediction

SHOWN = "01", "09", "17", "25", "33", "42", "50", "58"  #: photographs that show each step
HELD_OUT = "05", "29", "61"  #: photographs that the fit has not seen, beside what it predicts
WIDTH, RESULT_WIDTH = 300, 400  #: of each, and of those beside predictions [px]


def table(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures (H, W, 3) in two rows."""
    half = len(pictures) // 2
    return np.concatenate([np.concatenate(row, 1) for row in (pictures[:half], pictures[half:])])


def photograph(path: Path) -> np.ndarray:
    """(H, WIDTH, 3) uint8."""
    image = Image.open(path).convert("RGB")
    return np.array(image.resize((WIDTH, round(WIDTH * image.height / image.width)), Image.Resampling.LANCZOS))


def outlined(path: Path, mask: Path) -> np.ndarray:
    """A photograph with its mask's outline in green, in red around what is unsure; what is outside is darker."""
    rgb = photograph(path)
    shade = np.array(Image.open(mask).resize(rgb.shape[1::-1], Image.Resampling.NEAREST))
    result = np.where((shade == 255)[..., None], rgb, rgb // 3)
    for value, colour in ((255, (60, 255, 60)), (128, (255, 60, 60))):
        lines, _ = cv2.findContours((shade == value).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        result = cv2.drawContours(np.ascontiguousarray(result), lines, -1, colour, 1)
    return result


def cameras(sparse: Path, picture: Path) -> None:
    """Cameras and points from above and from the side, in the frame of structure from motion."""
    model = pycolmap.Reconstruction(sparse)
    images = [image for image in model.images.values() if image.has_pose]
    centres = np.array([image.projection_center() for image in images])
    downs = np.array([image.cam_from_world().rotation.matrix()[1] for image in images])
    up = -downs.mean(0) / np.linalg.norm(downs.mean(0))
    across = np.linalg.svd(centres - centres.mean(0) - np.outer((centres - centres.mean(0)) @ up, up))[2][:2]
    axes = np.stack([*across, up])
    points = np.array([p.xyz for p in model.points3D.values() if p.track.length() > 3])
    figure, panels = plt.subplots(1, 2, figsize=(10, 4.5))
    for panel, (i, j), name in zip(panels, ((0, 1), (0, 2)), ("from above", "from the side")):
        panel.scatter(*(points @ axes.T).T[[i, j]], s=0.3, c="0.4")
        panel.scatter(*(centres @ axes.T).T[[i, j]], s=14, c="tab:orange")
        panel.set_aspect("equal")
        panel.set_title(name)
        spread = np.abs((centres - centres.mean(0)) @ axes.T).max() * 1.15
        middle = axes @ centres.mean(0)
        panel.set_xlim(middle[i] - spread, middle[i] + spread)
        panel.set_ylim(middle[j] - spread, middle[j] + spread)
        panel.set_xticks([])
        panel.set_yticks([])
    figure.tight_layout()
    figure.savefig(picture, dpi=80)


def results(out: Path) -> np.ndarray:
    """Photographs held out, beside what the fit predicts, the difference, its normals and its diffuse colour."""
    capture, ring, surface = opened(out / "fit_default")
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    rows = []
    for name in HELD_OUT:
        k = next(k for k, shot in enumerate(capture.shots) if shot.name == name)
        photograph = capture.photograph(k)
        maps = {what: values[0] for what, values in prediction.maps(surface, photograph).items()}
        rgb, coverage = prediction.draw(surface, photograph, indirect=ring.indirect)
        seen = coverage[0].numpy()[..., None] > 0.5
        diffuse = maps["diffuse"] / np.quantile(maps["diffuse"][seen[..., 0]], 0.99)
        observed = linear_to_srgb(capture.observe([k]).rgb[0].numpy())
        predicted = linear_to_srgb(rgb[0].numpy())
        pictures = {
            f"photograph {name}": observed,
            "prediction": predicted,
            "4 x difference": np.where(seen, 4 * np.abs(predicted - observed), 0),
            "normals": np.where(seen, maps["normal"] * 0.5 + 0.5, 0),
            "diffuse": linear_to_srgb(np.where(seen, diffuse, 0)),
        }
        rows.append(labelled({what: around(picture, seen[..., 0]) for what, picture in pictures.items()}))
    return np.concatenate(rows)


def around(picture: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The part (H, W, 3) of a picture around an object, as wide as all others. `inside` (H, W): the object's pixels."""
    rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
    half = 0.52 * max(np.ptp(rows), np.ptp(columns))
    middle = np.array([columns[[0, -1]].mean(), rows[[0, -1]].mean()])
    to_result = RESULT_WIDTH / (2 * half) * np.column_stack([np.eye(2), half - middle])
    size = RESULT_WIDTH, RESULT_WIDTH
    return cv2.warpAffine(picture.astype(np.float32), to_result, size, flags=cv2.INTER_AREA).clip(0, 1)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("photos", type=Path, help="the photographs")
    parser.add_argument("out", type=Path, help="folder that benchmarks/skull.py has written")
    parser.add_argument("pictures", type=Path)
    options = parser.parse_args()
    options.pictures.mkdir(exist_ok=True)
    files = {path.stem: path for path in options.photos.iterdir()}
    masks = options.out / "work/masks"
    sheets = {
        "photographs": table([photograph(files[name]) for name in SHOWN]),
        "masks": table([outlined(files[name], masks / f"{name}.png") for name in SHOWN]),
        "result": results(options.out),
    }
    for name, sheet in sheets.items():
        rgb = sheet if sheet.dtype == np.uint8 else to_bytes(sheet)
        Image.fromarray(rgb).save(options.pictures / f"{name}.jpg", quality=88)
    cameras(options.out / "work/sparse", options.pictures / "cameras.png")


if __name__ == "__main__":
    main()
