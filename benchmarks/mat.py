"""Make photographs of a box on a mat that is full of features, with their truth: a large capture within minutes.

    python benchmarks/mat.py OUT [--views 80] [--size 4160x3120] [--seed 0]

Writes OUT/photos/ and the cameras, OUT/truth/transforms.json [mm]. Mat and box carry printed blots of all sizes, so
that each photograph has as many features as are kept. All faces are planes, drawn by homographies. A flash at the
camera, noise and JPEG make the photographs differ. For `matching.py`. The same seed gives the same files.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from phone_stage import random_page
from tqdm import tqdm

DOTS = 6  #: per mm of the print
BOX = np.array([70.0, 50.0, 80.0])  #: width, depth and height of the box [mm]
PAGE = np.array([210.0, 297.0])  #: of the mat [mm]
DISTANCE, VIEW_ANGLE = 350.0, 65.0  #: of the camera [mm]; horizontal [degrees]
RINGS = 20.0, 42.0, 64.0  #: elevations [degrees]
NOISE = 2.0  #: standard deviation [of 255]


def faces() -> list[np.ndarray]:
    """Corners (4, 3) [mm] of mat and box, as seen from outside: top left, top right, bottom right, bottom left."""
    x, y, z = BOX / [2, 2, 1]
    (u, v), turns = PAGE / 2, (0, 1, 2, 3)
    mat, top = (np.array([[-a, b, h], [a, b, h], [a, -b, h], [-a, -b, h]]) for a, b, h in ((u, v, 0), (x, y, z)))
    sides = [np.array([top[(k + 1) % 4], top[k], top[k] - [0, 0, z], top[(k + 1) % 4] - [0, 0, z]]) for k in turns]
    return [mat, top, *sides]


def pose_of(k: int, views: int, rng: np.random.Generator) -> np.ndarray:
    """Camera-to-world (4, 4), OpenCV's axes, of view `k`: on three rings, held by hand."""
    azimuth = 2 * np.pi * (k * len(RINGS) / views) + rng.normal(0, 0.03)
    elevation = np.radians(RINGS[k * len(RINGS) // views] + rng.normal(0, 3))
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    target = rng.uniform(-12, 12, 3) + np.array([0, 0, 0.4 * BOX[2]])
    forward, roll = -away, rng.normal(0, 0.07)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1] = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = forward, target + (DISTANCE + rng.uniform(-50, 50)) * away
    return pose


def draw(prints: list[np.ndarray], pose: np.ndarray, focal: float, size: tuple[int, int]) -> np.ndarray:
    """The photograph (H, W) uint8 without noise. Faces that look away from the camera are left out."""
    image = np.full(size[::-1], 25, np.uint8)
    for corners, page in zip(faces(), prints):
        normal = np.cross(corners[3] - corners[0], corners[1] - corners[0])
        away = pose[:3, 3] - corners.mean(0)
        cosine = normal @ away / np.linalg.norm(normal) / np.linalg.norm(away)
        if cosine <= 0:
            continue
        local = (corners - pose[:3, 3]) @ pose[:3, :3]
        pixels = local[:, :2] / local[:, 2:] * focal + np.array(size) / 2 - 0.5
        height, width = page.shape
        ends = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        turned = cv2.getPerspectiveTransform(ends.astype(np.float32), pixels.astype(np.float32))
        lit = (page * (cosine * (DISTANCE / np.linalg.norm(away)) ** 2) ** 0.45).astype(np.uint8)
        cv2.warpPerspective(lit, turned, size, image, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    return image


def main() -> None:
    """Write the photographs and their truth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=80)
    parser.add_argument("--size", default="4160x3120")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    size = width, height = tuple(int(side) for side in options.size.split("x"))
    focal = width / 2 / np.tan(np.radians(VIEW_ANGLE / 2))
    rng, prints = np.random.default_rng(options.seed), []
    for corners in faces():
        rows, columns = (round(np.linalg.norm(corners[k] - corners[1]) * DOTS) for k in (2, 0))
        prints.append((255 * random_page(rng, DOTS)[:rows, :columns] ** 0.45).astype(np.uint8))
    for folder in ("photos", "truth"):
        (options.out / folder).mkdir(parents=True, exist_ok=True)
    frames = []
    for k in tqdm(range(options.views), disable=None):
        pose = pose_of(k, options.views, rng)
        image = draw(prints, pose, focal, size)
        noise = np.zeros(image.shape, np.int16)
        cv2.setRNGSeed(options.seed * 10_000 + k)
        cv2.randn(noise, 0, NOISE)
        cv2.imwrite(f"{options.out / 'photos'}/{k:03}.jpg", cv2.add(image, noise, dtype=cv2.CV_8U))
        transform = (pose @ np.diag([1, -1, -1, 1])).tolist()  # OpenGL's axes
        frames.append({"file_path": f"../photos/{k:03}.jpg", "transform_matrix": transform})
    lens = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    (options.out / "truth/transforms.json").write_text(json.dumps(lens | {"frames": frames}, indent=1))


if __name__ == "__main__":
    main()
