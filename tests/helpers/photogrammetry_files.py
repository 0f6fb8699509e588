"""Cameras in the files of photogrammetry programs, by their published formulas."""

import csv
import io
import json

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

SIZE = W, H = 62, 52
POINTS = np.array([5, -8, 110]) + np.random.default_rng(3).uniform(-4, 4, (40, 3))  # in the world [scene units]
NAMES = ["a.JPG", "b.png", "c.jpeg"]


def cameras():
    """World-to-camera rotations and translations, OpenCV's axes, of cameras that see the points."""
    random = np.random.default_rng(7)
    for R in Rotation.random(3, rng=random).as_matrix():
        yield R, np.array([1.0, -2.0, 30.0]) + random.uniform(-1, 1, 3) - R @ POINTS.mean(0)


def photographs(folder, names=NAMES, size=SIZE):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("RGB", size, (9, 8, 7)).save(folder / name)
    return folder


CHUNK = Rotation.from_euler("xyz", [20, -70, 130], degrees=True).as_matrix(), np.array([3.0, -1.0, 8.0]), 2.5
SENSOR = {"f": 70.0, "cx": -2.5, "cy": 1.25}
BROWN = {"b1": -4.0, "k1": -0.2, "k2": 0.05, "k3": 0.02, "p1": 0.01, "p2": -0.02}


def text_of(array):
    return " ".join(map(repr, np.ravel(array).tolist()))


def edited(path, old, new, count=-1):
    """The path of a file, in which `old` has become `new`."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))
    return path


def metashape(folder, terms=SENSOR, kind="frame", where="component", more=""):
    """Cameras in the frame of a chunk, of which three photographs have one."""
    turn, shift, scale = CHUNK if where else (np.eye(3), np.zeros(3), 1.0)
    transform = (f"<transform><rotation locked='0'>{text_of(turn)}</rotation>"
                 f"<translation>{text_of(shift)}</translation><scale>{scale!r}</scale></transform>")  # fmt: skip
    own = ""
    for k, (R, t) in enumerate(cameras()):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T @ R.T, turn.T @ (-R.T @ t - shift) / scale
        own += (f"<camera id='{k}' sensor_id='4' component_id='0' label='{NAMES[k].split('.')[0]}'>"
                f"<transform>{text_of(pose)}</transform></camera>")  # fmt: skip
    calibration = "".join(f"<{name}>{value!r}</{name}>" for name, value in terms.items())
    photographs(folder / "images")
    (folder / "cameras.xml").write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
  <sensors next_id="5"><sensor id="4" label="unknown" type="{kind}"><resolution width="{W}" height="{H}"/>
    <calibration type="{kind}" class="initial"><resolution width="{W}" height="{H}"/><f>99</f></calibration>
    <calibration type="{kind}" class="adjusted"><resolution width="{W}" height="{H}"/>{calibration}</calibration>
  </sensor></sensors>
  {f'<components><component id="0">{transform}</component></components>' if where == "component" else ""}
  <cameras next_id="9"><group id="0" label="Group 1">{own}</group>
    <camera id="7" sensor_id="4" label="lost"/>
  </cameras>{transform if where == "chunk" else ""}{more}
</chunk></document>""")
    return folder / "cameras.xml"


TERMS = {"k1": -0.2, "k2": 0.05, "k3": 0.02, "k4": 0.0, "t1": 0.01, "t2": -0.02}
FOCAL, CENTRE = 40.0, (-0.04, 0.03)


def capturing_reality(R, t, terms, size=SIZE):
    """RealityCapture XMP Camera Math, with the tangential terms as AliceVision's importer of XMP files has them."""
    X, Y, Z = (POINTS @ R.T + t).T
    x, y = X / Z, Y / Z
    r2 = x**2 + y**2
    radial = 1 + terms["k1"] * r2 + terms["k2"] * r2**2 + terms["k3"] * r2**3
    xd = x * radial + terms["t1"] * (r2 + 2 * x**2) + 2 * terms["t2"] * x * y
    yd = y * radial + terms["t2"] * (r2 + 2 * y**2) + 2 * terms["t1"] * x * y
    m = np.stack([FOCAL / 36 * xd + CENTRE[0], FOCAL / 36 * yd + CENTRE[1]], 1)
    return m * max(size) + np.array(size) / 2


def sidecars(folder, model="brown3t2", elements=False, **fields):
    photographs(folder, [*NAMES, "lost.png"])
    for name, (R, t) in zip(NAMES, cameras()):
        terms = text_of([*TERMS.values()])
        given = {"DistortionModel": model, "FocalLength35mm": FOCAL, "Skew": 0, "AspectRatio": 1,
                 "PrincipalPointU": CENTRE[0], "PrincipalPointV": CENTRE[1], "Rotation": text_of(R),
                 "Position": text_of(-R.T @ t), "DistortionCoeficients": terms, **fields}  # fmt: skip
        given = {key: value for key, value in given.items() if value is not None}
        inside = {"Rotation", "Position", "DistortionCoeficients"} | ({*given} if elements else set())
        attributes = " ".join(f'xcr:{key}="{value}"' for key, value in given.items() if key not in inside)
        children = "".join(f"<xcr:{key}>{value}</xcr:{key}>" for key, value in given.items() if key in inside)
        (folder / name).with_suffix(".xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f'<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" {attributes}>{children}'
            "</rdf:Description></rdf:RDF></x:xmpmeta>")  # fmt: skip
    return folder


def from_angles(yaw, pitch, roll):
    """World-to-camera: the formula of the makers' article on registration export and camera orientations."""
    cx, cy, cz = np.cos(np.deg2rad([roll, pitch, yaw]))
    sx, sy, sz = np.sin(np.deg2rad([roll, pitch, yaw]))
    return np.array([[cx * cz + sx * sy * sz, -cx * sz + cz * sx * sy, -cy * sx],
                     [-cy * sz, -cy * cz, -sy],
                     [cx * sy * sz - cz * sx, cx * cz * sy + sx * sz, -cx * cy]])  # fmt: skip


ANGLES = [(170.3, 85.2, -22.7), (-35.0, 60.0, 100.0), (12.0, -40.0, 5.0)]


def rig_of_angles():
    for angles in ANGLES:
        R = from_angles(*angles)
        yield R, np.array([1.0, -2.0, 30.0]) - R @ POINTS.mean(0)


def csv_table(folder, drop=(), **cells):
    photographs(folder, [*NAMES, "lost.png"])
    columns = ["#name", "x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", *TERMS]
    text = io.StringIO()
    writer = csv.writer(text)
    kept = [name for name in columns if name.lstrip("#") not in drop]
    writer.writerow(kept)
    for name, angles, (R, t) in zip(NAMES, ANGLES, rig_of_angles()):
        row = dict(zip(columns, [name, *(-R.T @ t), *angles, FOCAL, *CENTRE, *TERMS.values()])) | cells
        writer.writerow([row[column] for column in kept])
    (folder / "cameras.csv").write_text(f"#cameras {len(NAMES)}\n{text.getvalue()}", encoding="utf-8-sig")
    return folder / "cameras.csv"


def llff(folder, edit=lambda array: array, images="images", size=SIZE):
    rows = []
    for R, t in cameras():
        right, down, forward = R
        hwf = np.array([H, W, 70.0])
        rows.append([*np.stack([down, right, -forward, -R.T @ t, hwf], 1).ravel(), 1.0, 99.0])
    photographs(folder / images, size=size)
    np.save(folder / "poses_bounds.npy", edit(np.array(rows)))
    return folder


K = np.array([[70.0, 0, 28.5], [0, 76.0, 27.25], [0, 0, 1]])


def middlebury(folder, edit=lambda text: text):
    lines = [f"{name} {text_of(K)} {text_of(R)} {text_of(t)}" for name, (R, t) in zip(NAMES, cameras())]
    photographs(folder)
    (folder / "pot_par.txt").write_text(edit("\n".join(["3", *lines, ""])))
    return folder


def by_opencv(R, t, focal, centre, terms=(0, 0, 0, 0, 0), fisheye=False):
    """Pixels whose centres are integers, by the documentation of OpenCV; radial terms, then tangential ones."""
    X, Y, Z = (POINTS @ R.T + t).T
    x, y = X / Z, Y / Z
    r2 = x**2 + y**2
    if fisheye:
        theta = np.arctan(np.sqrt(r2))
        radial = (theta + sum(k * theta ** (2 * n + 3) for n, k in enumerate(terms))) / np.sqrt(r2)
        return np.stack([x * radial, y * radial], 1) * focal + centre
    k1, k2, k3, p1, p2 = terms
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([xd, yd], 1) * focal + centre


FX, FY, OFFSET, DISTORTION = 70.0, 76.0, np.array([-2.5, 1.25]), [-0.2, 0.05, 0.02, 0.01, -0.02]
SENSOR_WIDTH = 23.5


def alicevision(folder, version="1.2.14", own=None):
    """A scene of Meshroom, whose numbers are strings, as its library of JSON writes them."""
    intrinsic = {
        "intrinsicId": 5, "width": W, "height": H, "sensorWidth": SENSOR_WIDTH, "type": "pinhole", "locked": 0,
        "principalPoint": [*OFFSET], "distortionParams": "", "undistortionType": "none", "sensorHeight": 15.6,
        "serialNumber": "7", "initializationMode": "estimated", "undistortionOffset": [0, 0], "undistortionParams": "",
    }  # fmt: skip
    order = tuple(map(int, version.split(".")))
    if order < (1, 2, 2):
        intrinsic["pxFocalLength"] = FX if order < (1, 2, 0) else [FX, FY]
    else:
        ratio = FX / FY if order < (1, 2, 5) else FY / FX
        intrinsic |= {"focalLength": FX * SENSOR_WIDTH / W, "pixelRatio": ratio}
    if order < (1, 2, 1):
        intrinsic["principalPoint"] = [W / 2 + OFFSET[0], H / 2 + OFFSET[1]]
    intrinsic |= own or {}
    top = {"version": version.split("."), "views": [], "intrinsics": [intrinsic], "poses": []}
    for k, (name, (R, t)) in enumerate(zip(NAMES, cameras())):
        top["views"].append({"viewId": 10 + k, "poseId": 20 + k, "intrinsicId": 5, "path": f"D:\\photos\\{name}",
                             "width": W, "height": H, "metadata": ""})  # fmt: skip
        columns = np.ravel(R, order="F")  # as Eigen's matrices lie in memory
        transform = {"rotation": columns.tolist(), "center": (-R.T @ t).tolist()}
        own_pose = {"transform": transform, "locked": 1, "rotationOnly": False, "removable": True}
        top["poses"].append({"poseId": 20 + k, "pose": own_pose})
    top["views"].append({"viewId": 99, "poseId": 99, "intrinsicId": 5, "path": "/photos/lost.png"})
    photographs(folder / "images")
    (folder / "cameras.sfm").write_text(json.dumps(strings(top)))
    return folder / "cameras.sfm"


def strings(value):
    """As boost::property_tree writes it."""
    if isinstance(value, dict):
        return {key: strings(own) for key, own in value.items()}
    return [strings(own) for own in value] if isinstance(value, list) else str(value)


def openmvg(folder, kinds=("pinhole_radial_k3", "pinhole_brown_t2", "fisheye"), nested=True):
    """A scene of OpenMVG with one camera of each kind, then another of the first kind, whose name is not said again."""
    fields = {
        "pinhole": {}, "pinhole_radial_k3": {"disto_k3": DISTORTION[:3]}, "pinhole_brown_t2": {"disto_t2": DISTORTION},
        "fisheye": {"fisheye": [0.1, -0.05, 0.02, 0.01]},
    }  # fmt: skip
    top = {"sfm_data_version": "0.3", "root_path": "/gone", "views": [], "intrinsics": [], "extrinsics": []}
    seen: list[str] = []
    for k, (kind, name, (R, t)) in enumerate(zip(kinds, NAMES, cameras())):
        base = {"width": W, "height": H, "focal_length": FX, "principal_point": (np.array(SIZE) / 2 + OFFSET).tolist()}
        data = {"value0": base, **fields[kind]} if nested else {**base, **fields[kind]}
        first = {"polymorphic_name": kind} if kind not in seen else {}
        seen += [kind] * bool(first)
        number = seen.index(kind) + 1 + 2**31 * bool(first)
        top["intrinsics"].append({"key": k, "value": {"polymorphic_id": number, **first,
                                                      "ptr_wrapper": {"id": 2**31 + 9 + k, "data": data}}})  # fmt: skip
        view = {"local_path": "", "filename": name, "id_view": k, "id_intrinsic": k, "id_pose": k}
        top["views"].append({"key": k, "value": {"polymorphic_id": 2**30, "ptr_wrapper": {"id": 2**31, "data": view}}})
        top["extrinsics"].append({"key": k, "value": {"rotation": R.tolist(), "center": (-R.T @ t).tolist()}})
    lost = {"filename": "lost.png", "id_intrinsic": 0, "id_pose": 2**32 - 1}
    top["views"].append({"key": 9, "value": {"polymorphic_id": 2**30, "ptr_wrapper": {"id": 1, "data": lost}}})
    photographs(folder)
    (folder / "sfm_data.json").write_text(json.dumps(top))
    return folder / "sfm_data.json"
