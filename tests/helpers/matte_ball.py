"""A matte ball and photographs of it, with colours and relief that are known."""

import mitsuba as mi
import numpy as np
import torch
import trimesh

from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.geometry.camera import Camera
from mi_ring.images import linear_to_srgb, to_bytes, write_image
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Files, Shot

PALE = np.array([0.5, 0.4, 0.3])  #: colour without print, linear
MATTE = PALE / np.pi  #: the diffuse parameter of `cooktorrance` for it


def plain(points):
    return np.tile(PALE, (len(points), 1))


def photographed(folder, colours, count=12, surface=lambda points: points, width=160, aside=0.4, gloss=None):
    """A scene file with photographs of a matte ball in a dark room, which Mitsuba's path tracer makes.

    `colours`, `surface`: functions of points (V, 3) of the unit sphere, reflectances and places. `aside`: distance of
    the flash from the lens. `gloss`: a BSDF of Mitsuba that covers half of it.
    """
    ico = trimesh.creation.icosphere(6)
    mesh = mi.Mesh("ball", len(ico.vertices), len(ico.faces), props=mesh_props(gloss))
    params = mi.traverse(mesh)
    params["vertex_positions"] = surface(ico.vertices).ravel().astype(np.float32)
    params["faces"] = ico.faces.ravel().astype(np.uint32)
    params.update()
    mesh.add_attribute("vertex_colour", 3, colours(ico.vertices).ravel().astype(np.float32))
    elements = []
    for k in range(count):
        height = 1 - (2 * k + 1) / count
        around = np.array([np.cos(2.4 * k), np.sin(2.4 * k)]) * np.sqrt(1 - height**2)
        eye = 4 * np.array([*around, height])
        pose = np.array(mi.ScalarTransform4f().look_at(eye.tolist(), [0, 0, 0], [0.1, 0.2, 0.9]).matrix)
        camera = Camera(pose, np.full(2, 300 * width / 160), np.array([width / 2, width / 2 - 4]), (width, width - 10))
        light = Light("point", eye + pose[:3, 0] * aside, np.array([30.0, 32.0, 34.0]))
        picture = render(mesh, camera, light)
        write_image(to_bytes(linear_to_srgb(picture)), folder / f"{k:02}.png")
        elements.append(photograph_element(Shot(f"{k:02}", camera, light, files=Files(folder / f"{k:02}.png"))))
    (folder / "scene.xml").write_bytes(scene_bytes(scene_element(elements, np.zeros(3), 1.0)))
    return folder / "scene.xml"


def mesh_props(gloss):
    props = mi.Properties()
    matte = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_colour"}}
    blend = {"type": "blendbsdf", "weight": 0.5, "matte": matte}
    props["bsdf"] = mi.load_dict(blend | {"gloss": gloss} if gloss else matte)
    return props


def render(mesh, camera, light):
    """By stock plugins. Mitsuba counts the offset of the principal point upward."""
    width, height = camera.size
    sensor = {
        "type": "perspective", "to_world": mi.ScalarTransform4f(camera.to_world),
        "fov": float(np.degrees(2 * np.arctan(width / 2 / camera.focal[0]))), "fov_axis": "x",
        "principal_point_offset_y": float((height / 2 - camera.centre[1]) / height),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
    }  # fmt: skip
    lamp = {"type": "point", "position": light.vector.tolist(),
            "intensity": {"type": "rgb", "value": light.rgb.tolist()}}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "mesh": mesh, "camera": sensor, "lamp": lamp,
                          "integrator": {"type": "path", "max_depth": 2}})  # fmt: skip
    return np.array(mi.render(scene, spp=16))[..., :3]


def pale_ball():
    """What a fit without any fine texture finds: a smooth matte ball of one colour."""
    ring = FittedObject(np.zeros(3), 1.0, subdivisions=5)
    with torch.no_grad():
        for parameter in ring.parameters():
            parameter.zero_()
        last = [p for p in ring.brdf_net.parameters() if p.shape == (5,)][-1]
        last.copy_(torch.tensor([*np.log(np.expm1(MATTE)), -30.0, 0.0]))
    return ring
