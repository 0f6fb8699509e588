"""Writes the results folder of a fit."""

import contextlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from mi_ring.capture.capture import Capture
from mi_ring.capture.reduction import whole_mask
from mi_ring.capture.scenefile import (
    fitted_scene_xml,
    recalibrated_xml,
    remasked_xml,
    updated,
    with_missing_photographs,
)
from mi_ring.errors import InputError
from mi_ring.images import encoded_picture, linear_to_srgb, to_bytes, write_image
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import compact, ring_state
from mi_ring.output import calibration_panel, gltf, report
from mi_ring.output.fit_result import FitResult
from mi_ring.output.ply import write_mesh
from mi_ring.rendering import prediction
from mi_ring.rendering.spherical_harmonics import room_envmap
from mi_ring.rendering.surface import Surface
from mi_ring.scene.lights import shared_emitters
from mi_ring.scene.visibility import MaskedCamera
from mi_ring.system.command import scene_name
from mi_ring.system.files import locked, read_json, relative_to, write_file, write_state, writing

PRECIOUS = "ring.pt", "checkpoint.pt", "checkpoint.before.pt"  #: a folder with one of these is moved aside
OWN_SCENE = Path("capture", "scene.xml")  #: in the folder of a fit: the scene file of a capture from arrays
VIEWED, TEXELS = 6, 1024  #: finest level of the object in the report's viewer, and width of its textures [px]


def default_folder(scene: Path) -> Path:
    """Return the default results folder of a scene file: out/NAME, relative to the working directory.

    NAME is the file name without suffix; for NAME/scene.xml it is the name of the folder. Raises InputError if out/NAME
    contains the results of another scene.
    """
    folder, other = Path("out") / scene_name(scene), None
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # config.json is missing or damaged
        other = folder / read_json(folder / "config.json")["scene"]
    if other and other.is_file() and scene.is_file() and not other.samefile(scene):
        raise InputError(f"{folder}: holds the results of another scene, {relative_to(Path(), other)}; give another "
                         "folder with --out")  # fmt: skip
    return folder


def prepare_folder(folder: Path, scene: Path, options: dict, resume: bool = False) -> None:
    """Create the results folder, and write config.json into it. If it has earlier results, rename it first.

    `scene`: the scene file. `options`: content of config.json; the path of `scene` relative to the folder is added.
    `resume`: keep a folder with earlier results as it is. Raises InputError if the folder cannot be written or if it
    contains the scene file.
    """
    if folder.resolve() in scene.resolve().parents:
        raise InputError(f"{folder.resolve()}: --out: holds the scene file {scene.name} itself; choose another folder")
    make_folder(folder.resolve(), scene, options, resume)


def make_folder(folder: Path, scene: Path, options: dict, resume: bool = False) -> None:
    """Create the results folder, and write config.json into it. If it has earlier results, rename it first.

    `scene`: the scene file, which may lie in the folder. `options`: content of config.json; the path of `scene`
    relative to the folder is added. `resume`: keep a folder with earlier results as it is. Raises InputError if the
    folder cannot be written.
    """
    with writing(f"{folder}: --out"):
        if not resume and any((folder / name).exists() for name in PRECIOUS):
            move_aside(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for partial in folder.glob(".*.partial"):  # left by a killed process: no other process writes here
            partial.unlink(missing_ok=True)
    options = options | {"scene": relative_to(folder, scene.resolve())}
    write_file(folder / "config.json", json.dumps(options, indent=2, default=str))


def move_aside(folder: Path) -> None:
    """Rename an existing folder to the first free one of NAME.1, NAME.2, …, and print the new name."""
    aside = next(p for n in range(1, 10**6) if not (p := folder.with_name(f"{folder.name}.{n}")).exists())
    folder.rename(aside)
    print(f"The results that were in {folder}/ are now in {aside}/")


def save(folder: Path, result: FitResult) -> None:
    """Write all results of a fit into `folder`. If the folder contains earlier results, it is renamed first.

    A capture that was made from arrays is written, too, with its scene file capture/scene.xml in the folder. Raises
    InputError if a file cannot be written, and ValueError if a network of the object has no registered name.
    """
    capture = result.given
    ring_state(result.ring)  # raises for networks without a name before anything is moved
    if not capture.in_memory:
        fitted_scene(capture, result.ring, folder)  # raises for a scene that cannot be rewritten
    with locked(folder):
        if capture.in_memory:
            make_folder(folder.resolve(), folder / OWN_SCENE, result.settings)
            capture = capture.save(folder / OWN_SCENE)
        else:
            prepare_folder(folder, capture.path, result.settings)
        write_log(folder, result.log)
        write(folder, result, fitted_scene(capture, result.ring, folder))


def fitted_scene(capture: Capture, ring: FittedObject, folder: Path) -> bytes:
    """Make the content of scene.xml for the results in `folder`: the given scene with the fitted object.

    Writes no file. Photographs of pairs that it lacks are added. The calibration stays as given. Paths are relative to
    `folder`. Raises InputError if the scene cannot be rewritten.
    """
    scene = fitted_scene_xml(capture.path, folder, ring.subdivisions, ring.bsdf)
    return with_missing_photographs(scene, capture.shots, folder)


def write_log(folder: Path, entries: Iterable[dict]) -> None:
    """Write log.jsonl into `folder`, one line for each entry. An existing file is replaced."""
    write_file(folder / "log.jsonl", "".join(json.dumps(entry) + "\n" for entry in entries))


def add_to_log(folder: Path, entry: dict) -> None:
    """Append an entry to log.jsonl in `folder` as a line. Raises InputError if the file cannot be written."""
    path = folder / "log.jsonl"
    with writing(path), path.open("a") as file:
        file.write(json.dumps(entry) + "\n")


def read_log(folder: Path) -> list[dict]:
    """Read the entries of log.jsonl in `folder`. Incomplete lines, as after a full disk, are left out."""
    entries = []
    for line in (folder / "log.jsonl").read_bytes().splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            entries.append(json.loads(line))
    return entries


def write_inputs(path: Path, capture: Capture, start: Surface) -> None:
    """Write a contact sheet: photographs with the start surface in green. It makes wrong masks and poses visible.

    `path`: the PNG file. `start`: the start surface, ready for rendering.
    """
    some = capture.spread()
    columns = min(10, len(some))
    cell, line = 160, 16
    sheet = Image.new("RGB", (columns * cell, line + -(-len(some) // columns) * cell))
    ImageDraw.Draw(sheet).text((3, 2), "green: where the fit starts", fill=(26, 255, 51))
    for index in capture.together(some):
        scale = max(1, max(capture.shots[index[0]].size) // cell)
        _, covered = prediction.draw(start, capture.selected(index, scale), spp=4, shadows=False)
        for k, observed, coverage in zip(index, capture.observe(index, scale).rgb, covered):
            tint = 0.35 * coverage[..., None].numpy() * np.array([0.1, 1.0, 0.2])
            picture = Image.fromarray(to_bytes(linear_to_srgb(observed.numpy()) * 0.65 + tint))
            picture.thumbnail((cell, cell))
            ImageDraw.Draw(picture).text((3, 2), capture.names[k], fill=(255, 255, 255))
            place = some.index(k)
            sheet.paste(picture, (place % columns * cell, line + place // columns * cell))
    write_file(path, encoded_picture(sheet))


def write(folder: Path, result: FitResult, scene: bytes) -> None:
    """Write ring.pt, mesh.ply, scene.xml, calibration.json and report.html of a fit, which may be unfinished.

    Also writes masks and an environment map if the fit refined them. `folder`: an existing results folder. `scene`:
    scene file (XML) with the fitted object and the given calibration; this function puts in what the fit refined.
    """
    ring, capture = result.ring, result.capture
    write_state(compact(ring_state(ring, result.settings)), folder / "ring.pt")
    views = capture.views
    unseen = write_mesh(ring, ring.subdivisions, folder / "mesh.ply", views=views)
    scene = updated(scene, ring.subdivisions, ring.bsdf)  # details and a second lobe have changed them
    if result.summary:
        scene = recalibrated_xml(scene, capture.shots, result.room, result.room_frames, result.lamps, result.lobes)
    if result.masks:
        scene = remasked_xml(scene, capture.shots, write_masks(folder / "masks", capture, result.masks))
    write_file(folder / "scene.xml", scene)
    if not capture.photographs.lit.all() and capture.room is not None and not shared_emitters(capture.scene):
        # The room is the only light of some photographs.
        radiance = room_envmap(capture.room, np.eye(4), lobes=capture.lobes).clip(min=0)
        write_image(radiance.astype(np.float32), folder / "environment.exr")
    print("Writing the report", flush=True)
    names = [capture.names[k] for k in result.held_out]
    if result.calibration or result.validation:
        record = result.calibration or {"refined": [], "unknowns": {}, "photographs": {}}
        record = record | ({"held_out": {"photographs": names, **result.validation}} if names else {})
        write_file(folder / "calibration.json", json.dumps(record, indent=1))
    if names:
        print(f"Photographs kept out: {calibration_panel.held_out_text(result.validation)}")
    write_file(folder / "report.html", report.report_html(result, viewed(ring, views), unseen))
    print(f"Surface: {folder}/mesh.ply   Report: {folder}/report.html   Scene for Mitsuba: {folder}/scene.xml")


def write_masks(folder: Path, capture: Capture, index: Iterable[int]) -> dict[int, str]:
    """Write masks as PNG files into `folder`: NAME.png for a photograph NAME.

    `index`: indices of the photographs whose masks are written. Returns the file names with these indices as keys. They
    are relative to the parent of `folder`.
    """
    names = {}
    for k in index:
        path = folder / f"{capture.names[k]}.png"
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        mask = capture.masks[k]
        assert mask is not None
        write_image(whole_mask(mask, capture.shots[k].window)[..., None], path)
        names[k] = relative_to(folder.parent, path)
    return names


def viewed(ring: FittedObject, views: Sequence[MaskedCamera] | None = None) -> bytes | None:
    """Make the GLB file for the viewer in the report. Returns its bytes. If that fails, prints why and returns None.

    `views`: cameras and masks of photographs; the file then marks the vertices that one of them shows. None: no marks.
    """
    level = min(VIEWED, ring.subdivisions)  # on a coarser mesh, rims have jagged black fringes
    try:
        return gltf.glb(ring, level, max(64, TEXELS >> (VIEWED - level)), views=views)
    except Exception as error:  # the report must be written in any case
        print(f"The report has no view of the object: {' '.join(str(error).split())}")
        return None
