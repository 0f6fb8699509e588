"""Captures in the formats of other methods, and conversions."""

import json

import mitsuba as mi
import numpy as np
import scipy.io
from PIL import Image
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


K = np.array([[70.0, 0, 28.5], [0, 76.0, 27.25], [0, 0, 1]])  # fx, fy and the principal point are all different


def noise(dtype, channels=3, seed=0, size=SIZE):
    full = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, full, (size[1], size[0], channels), dtype, endpoint=True)


def disc():
    """A mask: a disc off the middle."""
    y, x = np.mgrid[:H, :W]
    return np.where((x - 33) ** 2 + (y - 24) ** 2 < 200, 255, 0).astype(np.uint8)[..., None]


DIRECTIONS = np.array([[-0.06, -0.45, 0.89], [0.3, 0.2, 0.93], [-0.4, 0.1, 0.91], [0.1, 0.6, 0.79]])
INTENSITIES = np.array([[1.2, 1.1, 0.9], [0.9, 0.8, 0.7], [0.7, 0.6, 0.5], [1.5, 1.4, 1.3]])


def diligent_folder(tmp_path):
    folder = tmp_path / "bearPNG"
    calibration = {"KK": K}
    for v, (R, t) in enumerate(cameras(), 1):
        calibration |= {f"Rc_{v}": R, f"Tc_{v}": t[:, None]}
        view = folder / f"view_{v:02}"
        for light in range(1, 5):
            write(view / f"{light:03}.png", noise(np.uint16, seed=10 * v + light))
        hole = disc()
        hole[22:26, 30:33] = 0
        write(view / "mask.png", hole)
        np.savetxt(view / "light_directions.txt", DIRECTIONS)
        np.savetxt(view / "light_intensities.txt", INTENSITIES)
    scipy.io.savemat(folder / "Calib_Results.mat", calibration)
    (folder / "mesh_Gt.ply").write_bytes(b"ply")
    return folder


def colmap_folder(tmp_path):
    """A model in both forms, written by COLMAP's own library."""
    import pycolmap

    folder = tmp_path / "colmap"
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=W, height=H, params=[70, 76, 28.5, 27.25], camera_id=1)
    )
    for k, (R, t) in enumerate(cameras(), 1):
        pose = pycolmap.Rigid3d(np.hstack([R, t[:, None]]))
        name = f"sub/{k}.jpg"
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=k), pose)
        (folder / "images/sub").mkdir(parents=True, exist_ok=True)
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({33434: 1 / (50 * k), 33437: 2.8, 34855: 100 * k * k})
        Image.fromarray(noise(np.uint8, seed=k)).save(folder / "images" / name, exif=exif)
        write(folder / f"masks/{name}.png", disc())
    (folder / "sparse/0").mkdir(parents=True)
    (folder / "text").mkdir()
    model.write_binary(str(folder / "sparse/0"))
    model.write_text(str(folder / "text"))
    return folder


def neus(folder, scale=6.0, **more):
    arrays = dict(more)
    for k, (R, t) in enumerate(cameras()):
        sign = -2.5 if k == 1 else 1.0  # a projection matrix is known up to a factor
        arrays[f"world_mat_{k}"] = np.vstack([sign * K @ np.hstack([R, t[:, None]]), [0, 0, 0, 1]])
        arrays[f"scale_mat_{k}"] = np.block([[scale * np.eye(3), POINTS.mean(0)[:, None]], [0, 0, 0, 1]])
        write(folder / f"image/{k:03}.png", noise(np.uint8, seed=k))
        write(folder / f"mask/{k:03}.png", disc())
    np.savez(folder / "cameras_sphere.npz", **arrays)
    return folder


def iron(folder, edit=lambda dictionary: None):
    dictionary = {}
    for k, (R, t) in enumerate(cameras()):
        K4, W2C = np.eye(4), np.eye(4)
        K4[:3, :3], W2C[:3, :3], W2C[:3, 3] = K, R, t
        dictionary[f"{k}.png"] = {"K": K4.ravel().tolist(), "W2C": W2C.ravel().tolist(), "img_size": [W, H]}
        write(folder / f"train/image/{k}.exr", noise(np.uint8, seed=k).astype(np.float32))
    edit(dictionary)
    (folder / "train/cam_dict_norm.json").write_text(json.dumps(dictionary))
    return folder
