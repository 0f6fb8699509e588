"""Folders of NeRF's format, and conversions."""

import json

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring import convert
from mi_ring.capture import loading

SIZE = W, H = 62, 52
POINTS = np.array([5, -8, 110]) + np.random.default_rng(3).uniform(-4, 4, (40, 3))  # in the world [scene units]


def cameras(count=3):
    """World-to-camera rotations and translations, OpenCV's axes, of cameras that see the points."""
    random = np.random.default_rng(7)
    for R in Rotation.random(count, rng=random).as_matrix():
        yield R, np.array([1.0, -2.0, 30.0]) + random.uniform(-1, 1, 3) - R @ POINTS.mean(0)


def converted(*arguments):
    """The scene that a conversion writes."""
    assert convert.main([str(a) for a in arguments]) is None
    return loading.load_capture(arguments[2])


def write(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(np.ascontiguousarray(pixels)).write(str(path))


def transforms(folder, top, frames, pixels):
    for frame, (R, t) in zip(frames, cameras()):
        c2w = np.linalg.inv(np.block([[R, t[:, None]], [0, 0, 0, 1]]))
        frame["transform_matrix"] = (c2w * [1, -1, -1, 1]).tolist()  # OpenGL: y up, z back
    for k, frame in enumerate(frames):
        name = frame["file_path"]
        write(folder / (name if "." in name[-4:] else f"{name}.png"), pixels(k))
    (folder / "transforms.json").write_text(json.dumps(top | {"frames": frames}))
    return folder
