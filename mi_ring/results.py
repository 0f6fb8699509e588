"""The results of a fit: everything that is written into its folder."""

import contextlib
import errno
import io
import json
import os
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np
import torch
from PIL import Image, ImageDraw

from mi_ring import bridge, gltf, report
from mi_ring.capture import linear_to_srgb, to_bytes
from mi_ring.config import Config
from mi_ring.errors import InputError
from mi_ring.mesh import mesh_of
from mi_ring.reflectance import bsdf_element
from mi_ring.ring import Ring

VIEWED, TEXELS = 5, 1024  #: level of the report's object, and texels across its textures


@contextlib.contextmanager
def writing(what: Path | str):
    """Turns what the system has against writing a file, a full disk for instance, into an InputError."""
    try:
        yield
    except OSError as error:
        advice = "make room" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "choose another place"
        raise InputError(f"{what}: cannot be written ({error.strerror}); {advice}") from error


def require_place(path: Path, field: str = "") -> None:
    """Make the folder of a file that is to come after long work. Raises InputError if nothing can be written there."""
    with writing(f"{path}: {field}" if field else path):
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()


def replace(path: Path, content: bytes | str) -> None:
    """Write a file so that it is there whole or not at all. Raises InputError if it cannot be written."""
    partial = path.with_name(f".{path.name}.partial")
    with writing(path):
        try:
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


def write_image(pixels: np.ndarray, path: Path) -> None:
    """An image (H, W, C) as PNG, JPEG or EXR, by the file's name, whole or not at all."""
    formats = mi.Bitmap.FileFormat
    kind = {".png": formats.PNG, ".exr": formats.OpenEXR}.get(path.suffix.lower(), formats.JPEG)
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(pixels)).write(stream, kind)
    replace(path, stream.raw_buffer())


def save(state: dict, path: Path) -> None:
    """`torch.save`, whole or not at all."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    replace(path, buffer.getvalue())


def prepare(folder: Path, config: Config) -> None:
    """Make the folder and write config.json. A folder that holds another result is moved aside, not overwritten.

    Raises InputError if the folder cannot be written or holds the scene.
    """
    folder = folder.resolve()
    if folder in config.scene.resolve().parents:
        raise InputError(f"{folder}: --out: holds the scene file {config.scene.name} itself; choose another folder")
    with writing(f"{folder}: --out"):
        if not config.resume and any((folder / name).exists() for name in ("ring.pt", "checkpoint.pt")):
            aside = next(p for n in range(1, 10**6) if not (p := folder.with_name(f"{folder.name}.{n}")).exists())
            folder.rename(aside)
            print(f"The results that were in {folder}/ are now in {aside}/")
        folder.mkdir(parents=True, exist_ok=True)
    replace(folder / "config.json", config.to_json())


def start_log(folder: Path, iteration: int) -> None:
    """Make log.jsonl, or take those entries out that are after `iteration`: they will be written again."""
    entries = read_log(folder) if iteration and (folder / "log.jsonl").exists() else []
    text = "".join(json.dumps(entry) + "\n" for entry in entries if entry["iteration"] <= iteration)
    replace(folder / "log.jsonl", text)


def log(folder: Path, entry: dict) -> None:
    """One more line of log.jsonl."""
    path = folder / "log.jsonl"
    with writing(path), path.open("a") as file:
        file.write(json.dumps(entry) + "\n")


def read_log(folder: Path) -> list[dict]:
    """The entries of log.jsonl; a line that was cut off when the process was killed is none."""
    lines = (folder / "log.jsonl").read_text().splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("}\n")]


def write_inputs(path: Path, fit) -> None:
    """inputs.png: the start surface drawn over photographs, in green, where mask or pose errors show at once."""
    s, faces = fit.ring.domain.sample(4)
    fit.surface.show(fit.ring, s, faces)
    fit.stage = None  # the mesh is no longer that of the stage
    some = fit.capture.spread()
    columns = min(10, len(some))
    cell = 160
    sheet = Image.new("RGB", (columns * cell, -(-len(some) // columns) * cell))
    for place, k in enumerate(some):
        scale = max(1, max(fit.capture.sensors[k].size) // cell)
        observed = fit.capture.observe([k], scale)[0]
        _, coverage = bridge.draw(fit.surface, fit.capture.photograph(k, scale), spp=4, shadows=False)
        tint = 0.35 * coverage[0, ..., None].numpy() * np.array([0.1, 1.0, 0.2])
        picture = Image.fromarray(to_bytes(linear_to_srgb(observed[0].numpy()) * 0.65 + tint))
        picture.thumbnail((cell, cell))
        ImageDraw.Draw(picture).text((3, 2), fit.capture.names[k], fill=(255, 255, 255))
        sheet.paste(picture, (place % columns * cell, place // columns * cell))
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG")
    replace(path, buffer.getvalue())


def write(folder: Path, fit, fitted_scene: bytes) -> None:
    """ring.pt, mesh.ply, scene.xml and report.html of a fit, finished or not."""
    save(fit.ring.state(fit.config.settings()), folder / "ring.pt")
    write_mesh(fit.ring, fit.config.subdivisions, folder / "mesh.ply")
    replace(folder / "scene.xml", fitted_scene)
    s, faces = fit.ring.domain.sample(fit.config.subdivisions)
    fit.surface.show(fit.ring, s, faces)
    print("Writing the report", flush=True)
    replace(folder / "report.html", report.html(fit, read_log(folder), viewed(fit.ring)))
    print(f"Surface: {folder}/mesh.ply   Report: {folder}/report.html   Scene for Mitsuba: {folder}/scene.xml")


def viewed(ring: Ring) -> bytes | None:
    """The object for the report's viewer as GLB, where that is possible."""
    level = min(VIEWED, ring.subdivisions)
    try:
        return gltf.glb(ring, level, max(64, TEXELS >> (VIEWED - level)))
    except Exception as error:  # whatever it is, the report is worth more
        print(f"The report goes without a view of the object: {' '.join(str(error).split())}")
        return None


def write_mesh(ring: Ring, subdivisions: int, path: Path, time: float = 1.0) -> None:
    """The surface as PLY in scene units, with the parameters of its BSDF as vertex attributes (vertex_diffuse, …)."""
    s, faces = ring.domain.sample(subdivisions)
    with torch.no_grad():
        s = s.to(ring.center.device)
        vertices, material = ring.surface(s, time), ring.brdf_net(s)
    mesh = mesh_of(vertices.cpu().numpy(), faces)
    for name, value in material.items():
        mesh.add_attribute(f"vertex_{name}", value[0].numel(), value.cpu().numpy().ravel())
    write_ply(mesh, path)


def write_ply(mesh: mi.Mesh, path: Path) -> None:
    """A mesh as PLY, whole or not at all."""
    stream = mi.MemoryStream()
    mesh.write_ply(stream)
    replace(path, stream.raw_buffer())


def scene_xml(source: Path, folder: Path, subdivisions: int, bsdf: str) -> bytes:
    """The scene file `source` with the fitted object and its `bsdf`, file names rewritten to be relative to `folder`.

    Raises InputError for a scene that cannot be rewritten, and for a shapenet that a fit has no use for.
    """
    tree = ElementTree.parse(source)
    old_bsdf, _ = bsdf_element(tree.getroot(), source)
    for element in tree.iter("string"):
        file = source.parent / element.get("value", "")
        if element.get("value") and file.is_file():
            element.set("value", Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix())
    shape = next(e for e in tree.iter("shape") if e.get("type") == "shapenet")
    for element in list(shape):
        if element.get("name") in ("weights", "to_world"):
            raise InputError(f"{source}: shapenet, {element.get('name')}: is for finished fits; remove it to fit anew")
        if element.get("name") in ("weights", "subdivisions", "domain", "center", "radius"):
            shape.remove(element)
    shape.remove(old_bsdf)
    shape.append(ElementTree.fromstring(bsdf))
    ElementTree.SubElement(shape, "integer", name="subdivisions", value=str(subdivisions))
    ElementTree.SubElement(shape, "string", name="weights", value="ring.pt")
    ElementTree.indent(tree)
    return ElementTree.tostring(tree.getroot(), "utf-8")

