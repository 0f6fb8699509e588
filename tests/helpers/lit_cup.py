"""A part of a sphere, seen and lit from inside, in which light bounces."""

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 70, 49  # [px]
CENTER, RADIUS, SHARE = np.array([0.3, -0.2, 0.4]), 0.9, 0.35  # of the cup; which share of the sphere it is
ALBEDO = np.array([0.8, 0.5, 0.2])


def cup(bsdf, rings=60, sectors=90):
    """The part below of a sphere about CENTER, tilted, to be seen from inside."""
    polar = np.arccos(1 - 2 * SHARE) * (np.arange(rings) + 1) / rings
    azimuth = 2 * np.pi * np.arange(sectors) / sectors
    p, a = (x.ravel() for x in np.meshgrid(polar, azimuth, indexing="ij"))
    points = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), -np.cos(p)], 1)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(rings - 1) * sectors, np.arange(sectors), indexing="ij"))
    k, pole = np.arange(sectors), len(points)
    corner, beside = i + j, i + (j + 1) % sectors
    faces = np.concatenate([
        np.stack([corner, corner + sectors, beside], 1),
        np.stack([beside, corner + sectors, beside + sectors], 1),
        np.stack([np.full(sectors, pole), k, (k + 1) % sectors], 1),
    ])  # fmt: skip
    turn = Rotation.from_euler("xyz", [15, 20, 40], degrees=True).as_matrix()
    points = CENTER + RADIUS * np.concatenate([points, [[0, 0, -1]]]) @ turn.T
    mesh = mi.Mesh("cup", len(points), len(faces), mi.Properties(), True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    params.update()
    mesh.set_bsdf(mi.load_dict(bsdf))
    return mesh


def material(diffuse, specular=0.0):
    diffuse = {"type": "rgb", "value": [float(d) for d in diffuse]}
    return {"type": "cooktorrance", "diffuse": diffuse, "specular": specular, "roughness": 0.35}


def photograph(k, light):
    return {
        "type": "photograph", "id": f"{k:03}", "filename": "nowhere.png", "fx": 66.0, "fy": 58.0,
        "cx": 37.2, "cy": 26.8,
        "to_world": mi.ScalarTransform4f().look_at([[0.9, -0.1, 2.6], [-0.5, 0.3, 2.4]][k], CENTER, [0.3, 1, 0.2]),
        "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}},
        "light": light,
    }  # fmt: skip


def load(lights, **shapes):
    sensors = {f"sensor{k}": photograph(k, light) for k, light in enumerate(lights)}
    return mi.load_dict({"type": "scene", **shapes, **sensors, "flash": {"type": "flash"}})


def pictures(channels, count=2):
    """(N, H, W, 4)"""
    return np.stack([np.array(c).reshape(count, HEIGHT, WIDTH) for c in channels], -1)


INTENSITY = np.array([[3.0, 2.0, 1.0], [1.0, 2.0, 4.0]])
