"""Cameras in the files of Bundler, VisualSFM, OpenSfM, Polycam, Record3D and Blender, by their documentation.

Photographs have different lenses and sizes. `projections` gives where each program's own formulas put the points.
"""

import json

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from helpers.photogrammetry_files import NAMES, POINTS, cameras, photographs, text_of

SIZES = [(62, 52), (52, 90), (80, 61)]
FLIP = np.diag([1.0, -1.0, -1.0])  #: between cameras with y up, -z forward and cameras with y down, z forward


def seen(k):
    """The points in the axes of camera k: x right, y down, z forward."""
    R, t = list(cameras())[k]
    return POINTS @ R.T + t


def photographs_of_sizes(folder, names=NAMES, sizes=SIZES):
    for name, size in zip(names, sizes):
        photographs(folder, [name], size)
    return folder


# Bundler

BUNDLER = [(70.0, -0.2, 0.05), (95.0, 0.0, 0.0), (81.5, 0.1, -0.03)]


def bundler(folder, list_lines="{} 0 600.5"):
    """The manual of version 0.4. A camera without a pose is in the middle."""
    lines = ["# Bundle file v0.3", f"{len(NAMES) + 1} 1"]
    for (f, k1, k2), (R, t) in zip(BUNDLER, cameras()):
        lines += [text_of([f, k1, k2]), *map(text_of, FLIP @ R), text_of(FLIP @ t)]
    lines[7:7] = ["0 0 0"] * 5
    lines += ["1.5 2.5 -3", "255 0 9", "2 0 17 -5.5 3.25 1 8 2.5 1"]
    photographs_of_sizes(folder)
    listed = [list_lines.format(name) for name in NAMES]
    (folder / "list.txt").write_text("\n".join([listed[0], "lost one.jpg", *listed[1:], ""]))
    (folder / "bundle").mkdir()
    (folder / "bundle" / "bundle.out").write_text("\n".join([*lines, ""]))
    return folder / "bundle" / "bundle.out"


def bundler_pixels(k):
    f, k1, k2 = BUNDLER[k]
    P = seen(k) @ FLIP
    p = -P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(1, keepdims=True)
    x, y = (f * (1 + k1 * r2 + k2 * r2**2) * p).T
    return np.stack([SIZES[k][0] / 2 + x, SIZES[k][1] / 2 - y], 1)  # from the middle; y is up


# VisualSFM

VISUALSFM = [(70.0, -0.15), (95.0, 0.0), (81.5, 0.2)]
FIXED = (71.0, 30.25, 77.0, 27.5)  #: fx cx fy cy


def visualsfm(folder, fixed=False):
    """Two models, of which the second has more photographs."""
    lines = []
    for name, (f, r), (R, t) in zip(NAMES, VISUALSFM, cameras()):
        quaternion = np.roll(Rotation.from_matrix(R).as_quat(), 1)
        lines.append(f'my"photos\\{name}\t{f!r} {text_of(quaternion)} {text_of(-R.T @ t)} {r!r} 0')
    photographs_of_sizes(folder / "my photos", sizes=[SIZES[0]] * 3 if fixed else SIZES)
    first = f"NVM_V3 FixedK {text_of(FIXED)} 0" if fixed else "NVM_V3 "
    point = "1 2 3 255 0 9 2 0 17 -5.5 3.25 1 8 2.5 1"
    content = [first, "", "1", lines[1], "", "2", point, point, "", "3", *lines, "", "1", point, "", "0", "",
               "#the last part of NVM file points to the PLY files", "0"]  # fmt: skip
    (folder / "model.nvm").write_text("\n".join([*content, ""]))
    return folder / "model.nvm"


def visualsfm_pixels(k, fixed=False):
    """Where the undistorted measurement, m (1 + r |m|²), is the projection: found by bisection."""
    f, r = VISUALSFM[k]
    fx, cx, fy, cy = FIXED if fixed else (f, SIZES[k][0] / 2, f, SIZES[k][1] / 2)
    P = seen(k)
    straight = P[:, :2] / P[:, 2:]
    length = np.linalg.norm(straight, axis=1)
    low, high = np.zeros(len(length)), 2 * length
    for _ in range(80):
        middle = (low + high) / 2
        beyond = middle * (1 + r * middle**2) > length
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return straight * (low / length)[:, None] * (fx, fy) + (cx, cy)


# OpenSfM

C = {"c_x": -0.04, "c_y": 0.03}
OPENSFM = {
    "perspective": {"focal": 1.1, "k1": -0.2, "k2": 0.05},
    "brown": {"focal_x": 1.1, "focal_y": 1.25, **C, "k1": -0.2, "k2": 0.05, "k3": 0.02, "p1": 0.01, "p2": -0.02},
    "radial": {"focal_x": 1.1, "focal_y": 1.25, **C, "k1": -0.2, "k2": 0.05},
    "simple_radial": {"focal_x": 1.1, "focal_y": 1.25, **C, "k1": -0.2},
    "fisheye": {"focal": 1.1, "k1": 0.1, "k2": -0.05},
    "fisheye_opencv": {"focal_x": 1.1, "focal_y": 1.25, **C, "k1": 0.1, "k2": -0.05, "k3": 0.02, "k4": 0.01},
}


def opensfm(folder, kinds=("perspective", "brown", "fisheye_opencv"), edit=lambda models: None):
    """Two reconstructions, of which the second has more shots."""
    own = {"cameras": {}, "shots": {}, "points": {"9": {"color": [1, 2, 3], "coordinates": [1, 2, 3]}},
           "reference_lla": {"latitude": 1, "longitude": 2, "altitude": 3}}  # fmt: skip
    for k, (kind, name, (w, h), (R, t)) in enumerate(zip(kinds, NAMES, SIZES, cameras())):
        own["cameras"][f"v2 {k}"] = {"projection_type": kind, "width": w, "height": h, **OPENSFM[kind]}
        own["shots"][name] = {"rotation": Rotation.from_matrix(R).as_rotvec().tolist(), "translation": t.tolist(),
                              "camera": f"v2 {k}", "orientation": 1, "capture_time": 0.0, "scale": 1.0,
                              "gps_position": [1, 2, 3], "gps_dop": 15.0, "covariance": [], "merge_cc": 0}  # fmt: skip
    models = [{"cameras": own["cameras"], "shots": {"b.png": own["shots"]["b.png"]}, "points": {}}, own]
    edit(models)
    photographs_of_sizes(folder / "images")
    (folder / "opensfm").mkdir(exist_ok=True)
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps(models))
    return folder / "opensfm" / "reconstruction.json"


def opensfm_pixels(k, kind):
    """The page "Geometric Models" of the documentation."""
    own = {"focal_x": OPENSFM[kind].get("focal"), "focal_y": OPENSFM[kind].get("focal"), **OPENSFM[kind]}
    k1, k2, k3, k4, p1, p2, cx, cy = (own.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2", "c_x", "c_y"))
    X, Y, Z = seen(k).T
    if kind.startswith("fisheye"):
        r = np.hypot(X, Y)
        theta = np.arctan2(r, Z)
        d = 1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8
        x, y = d * theta * X / r, d * theta * Y / r
    else:
        a, b = X / Z, Y / Z
        r2 = a**2 + b**2
        d = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x = a * d + 2 * p1 * a * b + p2 * (r2 + 2 * a**2)
        y = b * d + 2 * p2 * a * b + p1 * (r2 + 2 * b**2)
    u, v = own["focal_x"] * x + cx, own["focal_y"] * y + cy
    w, h = SIZES[k]  # normalized coordinates: 1 is the longer side, 0 the middle
    return np.stack([u * max(w, h) + w / 2, v * max(w, h) + h / 2], 1)


# Rigs: the second camera of one is turned and shifted against the first

IN_RIG = Rotation.from_euler("xyz", [10, -25, 40], degrees=True).as_matrix(), np.array([0.4, -0.3, 0.2])  #: R, t
RIG = ["rig/left/1.png", "rig/right/1.png", "rig/left/2.png", "rig/right/2.png"]
RIG_LENSES = [(62, 52, 70.0, 76.0, 28.5, 27.25), (80, 61, 95.0, 90.0, 41.0, 29.0)]  #: w, h, fx, fy, cx, cy


def rig_poses():
    """World-to-camera, of both cameras in each of two places. R, t of IN_RIG: from the first camera to the second."""
    R2, t2 = IN_RIG
    for R, t in list(cameras())[:2]:
        yield R, t
        yield R2 @ R, R2 @ t + t2


def rig_pixels():
    for k, (R, t) in enumerate(rig_poses()):
        _, _, fx, fy, cx, cy = RIG_LENSES[k % 2]
        X, Y, Z = (POINTS @ R.T + t).T
        yield np.stack([fx * X / Z + cx, fy * Y / Z + cy], 1)


def photographs_of_rig(folder, names=RIG):
    for k, name in enumerate(names):
        photographs((folder / name).parent, [(folder / name).name], RIG_LENSES[k % 2][:2])


def rigid(R, t):
    """Quaternion w x y z and translation, as COLMAP writes them."""
    return text_of([*np.roll(Rotation.from_matrix(R).as_quat(), 1), *t])


def colmap_rig(folder, calibrated=True):
    """A text model of COLMAP 4, by the page on its output format."""
    photographs_of_rig(folder / "images")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(
        "\n".join(f"{k} PINHOLE {text_of(lens)}".replace(".0 ", " ", 2) for k, lens in enumerate(RIG_LENSES, 1))
    )
    (model / "rigs.txt").write_text(f"1 2 CAMERA 1 CAMERA 2 {f'1 {rigid(*IN_RIG)}' if calibrated else 0}\n")
    frames, images = "", ""
    for k, (name, (R, t)) in enumerate(zip(RIG, rig_poses()), 1):
        images += f"{k} {rigid(R, t)} {2 - k % 2} {name}\n\n"
        if k % 2:
            frames += f"{k} 1 {rigid(R, t)} 2 CAMERA 1 {k} CAMERA 2 {k + 1}\n"
    (model / "frames.txt").write_text(frames)
    (model / "images.txt").write_text(images)
    (model / "points3D.txt").touch()
    return model


def metashape_rig(folder, scale=1.0):
    """The second sensor has its pose in the axes of the first one; its cameras have a master and no pose."""
    R2, t2 = IN_RIG
    photographs_of_rig(folder / "images", names := [name.replace("rig/", "") for name in RIG])
    sensors, own = "", ""
    for k, (w, h, fx, fy, cx, cy) in enumerate(RIG_LENSES):
        place = f"<rotation>{text_of(R2.T)}</rotation><location>{text_of(-R2.T @ t2)}</location>"
        sensors += (f'<sensor id="{k}" label="s" type="frame" {"master_id=" + chr(34) + "0" + chr(34) if k else ""}>'
                    f'<resolution width="{w}" height="{h}"/>{place if k else ""}<calibration type="frame" '
                    f'class="adjusted"><resolution width="{w}" height="{h}"/><f>{fy}</f><b1>{fx - fy}</b1>'
                    f"<cx>{cx - w / 2}</cx><cy>{cy - h / 2}</cy></calibration></sensor>")  # fmt: skip
    for k, (name, (R, t)) in enumerate(zip(names, rig_poses())):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
        first = f"<transform>{text_of(pose)}</transform>"
        own += (f'<camera id="{k}" sensor_id="{k % 2}" label="{name}"' + (f' master_id="{k - 1}"/>' if k % 2 else
                f">{first}</camera>"))  # fmt: skip
    (folder / "rig.xml").write_text(f'<document version="2.0.0"><chunk><sensors>{sensors}</sensors><cameras>{own}'
        f"</cameras><transform><scale>{scale}</scale></transform></chunk></document>")  # fmt: skip
    return folder / "rig.xml"


# Phones: lenses are fx, fy, cx, cy

LENSES = [(70.0, 76.0, 28.5, 27.25), (95.0, 90.0, 27.0, 43.5), (81.5, 88.0, 42.5, 29.0)]


def pinhole_pixels(k, lens):
    fx, fy, cx, cy = lens
    X, Y, Z = seen(k).T
    return np.stack([fx * X / Z + cx, fy * Y / Z + cy], 1)


def opengl_pose(R, t):
    """Camera to world; the camera looks along -z, y is up."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T @ FLIP, -R.T @ t
    return pose


def polycam(folder, kind="corrected_", edit=lambda cameras: None):
    given = []
    for (w, h), (fx, fy, cx, cy), (R, t) in zip(SIZES, LENSES, cameras()):
        given.append({f"t_{i}{j}": opengl_pose(R, t)[i, j] for i in range(3) for j in range(4)})
        given[-1] |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": w, "height": h, "blur_score": 9.5,
                      "timestamp": 123, "neighbors": [1], "manual_keyframe": False}  # fmt: skip
    edit(given)
    (folder / "keyframes" / f"{kind}cameras").mkdir(parents=True)
    for k, own in enumerate(given):
        (folder / "keyframes" / f"{kind}cameras" / f"{k + 7}.json").write_text(json.dumps(own))
    photographs_of_sizes(folder / "keyframes" / f"{kind}images", ["7.jpg", "8.jpg", "9.jpg"])
    photographs(folder / "keyframes" / "images", ["7.jpg"])
    return folder


def record3d(folder, varying=True, edit=lambda metadata: None):
    """Quaternions x y z w; K by columns. Photographs have one size, and three or one lens."""
    fx, fy, cx, cy = LENSES[0]
    metadata = {"w": 62, "h": 52, "dw": 192, "dh": 256, "fps": 60, "initPose": [0, 0, 0, 1, 0, 0, 0],
                "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "poses": []}  # fmt: skip
    if varying:
        metadata["perFrameIntrinsicCoeffs"] = [list(lens) for lens in LENSES]
    for R, t in cameras():
        pose = opengl_pose(R, t)
        metadata["poses"].append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
    edit(metadata)
    photographs(folder / "rgb", ["0.jpg", "1.jpg", "2.jpg"])
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


def sdfstudio(folder, edit=lambda metadata: None):
    """The page on the data format. Matrices have OpenCV's axes; one of the intrinsics is 3 x 3, one has a mask."""
    metadata = {"camera_model": "OPENCV", "height": 52, "width": 62, "has_mono_prior": True, "pairs": "pairs.txt",
                "worldtogt": np.diag([2, 2, 2, 1]).tolist(), "frames": [],
                "scene_box": {"aabb": [[-1, -1, -1], [1, 1, 1]], "near": 0.5, "far": 4.5, "radius": 1.0,
                              "collider_type": "near_far"}}  # fmt: skip
    for k, ((R, t), (fx, fy, cx, cy)) in enumerate(zip(cameras(), LENSES)):
        K = np.array([[fx, -8e-5, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        pose = np.block([[R.T, (-R.T @ t)[:, None]], [np.eye(4)[3:]]])
        metadata["frames"].append({
            "rgb_path": f"{k:06}_rgb.png", "camtoworld": pose.tolist(),
            "intrinsics": K[: 3 + k % 2, : 3 + k % 2].tolist(),
            "mono_depth_path": f"{k:06}_depth.npy", "mono_normal_path": f"{k:06}_normal.npy",
        })  # fmt: skip
    metadata["frames"][1]["foreground_mask"] = "000001_foreground_mask.png"
    edit(metadata)
    photographs(folder, [f"{k:06}_rgb.png" for k in range(3)])
    Image.new("L", (62, 52), 255).save(folder / "000001_foreground_mask.png")
    (folder / "meta_data.json").write_text(json.dumps(metadata))
    return folder


# glTF: fields of view and aspect ratios of cameras, in a hierarchy

FOVS = [0.7, 1.1, 0.9]


def gltf(folder, suffix=".gltf", edit=lambda content: None):
    """One camera has a matrix, one a scaled and turned parent, one a child of its object with its name and more."""
    (pose, inner, child) = (opengl_pose(R, t) for R, t in cameras())
    names = [name.rsplit(".", 1)[0] for name in NAMES]
    parent = np.eye(4)
    parent[:3, :3] = 2.5 * Rotation.from_euler("xyz", [10, -25, 40], degrees=True).as_matrix()
    parent[:3, 3] = [3, -1, 8]
    inner = np.linalg.inv(parent) @ inner @ np.diag([2.5, 2.5, 2.5, 1])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()

    def parts(place, scale=1.0):
        rotation = place[:3, :3] / np.cbrt(np.linalg.det(place[:3, :3]))
        return {"translation": place[:3, 3].tolist(), "rotation": Rotation.from_matrix(rotation).as_quat().tolist(),
                "scale": [scale] * 3}  # fmt: skip

    content = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [1, 2, 3]}],
        "cameras": [{"type": "perspective", "name": f"camera {k}", "perspective": {
            "yfov": fov, "aspectRatio": w / h, "znear": 0.1, "zfar": 9.0}} for k, (fov, (w, h)) in
            enumerate(zip(FOVS, SIZES))],
        "nodes": [
            {"name": names[1], "camera": 1, **parts(inner)},
            {"name": names[0], "camera": 0, "matrix": pose.T.ravel().tolist()},
            {"name": "rig", "children": [0], **parts(parent, 2.5)},
            {"name": names[2], "children": [4], **parts(child @ np.linalg.inv(turn))},
            {"name": f"{names[2]}_Orientation", "camera": 2, "rotation": parts(turn)["rotation"]},
        ],
    }  # fmt: skip
    edit(content)
    photographs_of_sizes(folder)
    path = folder / f"cameras{suffix}"
    text = json.dumps(content).encode()
    if suffix == ".glb":
        text += b" " * (-len(text) % 4)
        text = b"glTF" + np.array([2, 20 + len(text), len(text)], "<u4").tobytes() + b"JSON" + text
    path.write_bytes(text)
    return path


def gltf_pixels(k):
    """The projection matrix of the specification, section 3.10.3.3, and a viewport of the photograph's size."""
    w, h = SIZES[k]
    X, Y, Z = (seen(k) @ FLIP).T
    x = X / (w / h * np.tan(0.5 * FOVS[k])) / -Z
    y = Y / np.tan(0.5 * FOVS[k]) / -Z
    return np.stack([(x + 1) / 2 * w, (1 - y) / 2 * h], 1)
