"""All that reads files of others, and small whole files for each; what a reader may raise is InputError alone."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)

# isort: split
import mitsuba as mi
import torch
import trimesh
from helpers import foreign_captures, merl_tables, photogrammetry_files, structure_files

from mi_ring.capture.loading import load_capture
from mi_ring.capture.scenefile import fitted_scene_xml
from mi_ring.colour_profiles import primaries_profile
from mi_ring.errors import InputError
from mi_ring.fit import planned_before
from mi_ring.fit_config import FitConfig
from mi_ring.fitting.checkpoint import FORMAT, read_checkpoint
from mi_ring.fitting.config import Config
from mi_ring.foreign import reading
from mi_ring.geometry.meshes import load_closed_mesh
from mi_ring.image_fields import unused_fields
from mi_ring.image_headers import bits_of, statement_of
from mi_ring.importers import colmap, formats
from mi_ring.importers.diligent_mv import DiligentMV
from mi_ring.importers.frames import Source, frames_of, require_frames
from mi_ring.importers.iron import Iron
from mi_ring.importers.llff import Llff
from mi_ring.importers.metashape import Metashape
from mi_ring.importers.middlebury import Middlebury
from mi_ring.importers.neus import Neus
from mi_ring.importers.photogrammetry import exif_values
from mi_ring.importers.reading import has_alpha, image_size, orientation_of, pixels_of
from mi_ring.importers.realitycapture import RealityCapture
from mi_ring.importers.sfmdata import SfmData
from mi_ring.importers.transforms import Transforms
from mi_ring.metrics.capture_findings import findings_of_fit
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit, ring_state
from mi_ring.output.results import read_log
from mi_ring.photogrammetry.folder import Picture
from mi_ring.rendering.measured_brdf import CELLS, MerlNetwork, MerlTable
from mi_ring.synthesis.options import SynthesizeConfig
from mi_ring.synthesis.path_traced_capture import Studio
from mi_ring.system.files import write_state

SIZE = W, H = 7, 5  #: of pictures [px]


@dataclass(frozen=True)
class Reader:
    """Whole files, which one at a time are to be damaged, and what reads them."""

    files: Sequence[Path]
    read: Callable[[], object]


def imported(kind: type[Source], **options: object) -> Callable[[Path], Callable[[], None]]:
    """A reader of a format of cameras."""

    def of(path: Path) -> Callable[[], None]:
        def read() -> None:
            source = kind(path, Path("scene.xml"), **options)
            require_frames(frames_of(source), path)

        return read

    return of


def photographs(folder: Path, names: Sequence[str]) -> None:
    """Pictures of these names, with EXIF data."""
    exif = Image.Exif()
    exif[274] = 6
    exif.get_ifd(0x8769).update({33434: 0.01, 33437: 2.8, 34855: 100, 41989: 28, 37385: 1})
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(colours(k)).save(folder / name, exif=exif)


def colours(seed: int, kind: type = np.uint8, channels: int = 3) -> np.ndarray:
    """A picture (5, 7, channels) of noise."""
    return np.random.default_rng(seed).integers(0, np.iinfo(kind).max, (H, W, channels), kind)


# Cameras of other tools


def metashape(folder: Path) -> Reader:
    path = photogrammetry_files.metashape(
        folder, terms=photogrammetry_files.SENSOR | photogrammetry_files.BROWN, where="chunk"
    )
    return Reader([path], imported(Metashape)(path))


def sidecars(folder: Path) -> Reader:
    photogrammetry_files.sidecars(folder)
    return Reader([folder / "a.xmp"], imported(RealityCapture)(folder))


def table(folder: Path) -> Reader:
    path = photogrammetry_files.csv_table(folder)
    return Reader([path], imported(RealityCapture)(path))


def llff(folder: Path) -> Reader:
    photogrammetry_files.llff(folder)
    return Reader([folder / "poses_bounds.npy"], imported(Llff)(folder))


def middlebury(folder: Path) -> Reader:
    photogrammetry_files.middlebury(folder)
    return Reader([folder / "pot_par.txt"], imported(Middlebury)(folder))


def alicevision(folder: Path) -> Reader:
    files = []
    for version in ("1.2.0", "1.2.14"):
        own = {"distortionType": "radialk3", "type": "radial3", "distortionParams": [0.1, 0.02, 0.01]}
        path = photogrammetry_files.alicevision(folder, version, own)
        top = json.loads(path.read_text())
        top["views"][0] |= {"isPoseIndependant": "false", "rigId": "3", "subPoseId": "0"}
        pose = {"rotation": ["1", "0", "0", "0", "1", "0", "0", "0", "1"], "center": ["1", "2", "3"]}
        top["rigs"] = [{"rigId": "3", "subPoses": [{"status": "constant", "pose": pose}]}]
        files.append(path.with_name(f"{version}.sfm"))
        files[-1].write_text(json.dumps(top))
    return Reader(files, lambda: [imported(SfmData)(path)() for path in files])


def openmvg(folder: Path) -> Reader:
    path = photogrammetry_files.openmvg(folder)
    return Reader([path], imported(SfmData)(path))


def transforms(folder: Path) -> Reader:
    frames = [
        {"file_path": "train/r_0", "pl_pos": [1, 2, 3], "pl_intensity": [4, 5, 6], "fl_x": 70, "w": 62, "h": 52},
        {"file_path": "r_1.png", "camera_angle_x": 0.8, "k1": 0.1, "p1": 0.01, "mask_path": "r_1.png"},
    ]
    top = {"camera_model": "OPENCV", "fl_x": 70.0, "fl_y": 71.0, "cx": 30.0, "cy": 25.0}
    foreign_captures.transforms(folder, top, frames, lambda k: foreign_captures.noise(np.uint8, 4, k))
    return Reader([folder / "transforms.json"], imported(Transforms)(folder))


def neus(folder: Path) -> Reader:
    foreign_captures.neus(folder, max_intensity=0.9, **{f"light_energy_{k}": [2.0, 3.0, 4.0] for k in range(3)})
    return Reader([folder / "cameras_sphere.npz"], imported(Neus)(folder))


def wildlight(folder: Path) -> Reader:
    neus(folder)
    np.save(
        folder / "images.npy", np.random.default_rng(1).uniform(0, 7, (3, *foreign_captures.SIZE[::-1], 3)).astype("f4")
    )
    return Reader([folder / "images.npy"], imported(Neus)(folder))


def iron(folder: Path) -> Reader:
    foreign_captures.iron(folder)
    return Reader([folder / "train/cam_dict_norm.json"], imported(Iron)(folder))


def diligent(folder: Path) -> Reader:
    foreign_captures.diligent_folder(folder)
    folder /= "bearPNG"
    view = folder / "view_01"
    files = [folder / "Calib_Results.mat", view / "light_directions.txt", view / "light_intensities.txt"]
    return Reader(files, imported(DiligentMV, views=(1,), lights=(1,))(folder))


def colmap_text(folder: Path) -> Reader:
    return colmap_of(folder, "text", ".txt")


def colmap_binary(folder: Path) -> Reader:
    return colmap_of(folder, "sparse/0", ".bin")


def colmap_of(folder: Path, model: str, suffix: str) -> Reader:
    """The model of the tests, in one of its forms."""
    foreign_captures.colmap_folder(folder)
    folder /= "colmap"
    return Reader(
        sorted((folder / model).glob(f"*{suffix}")), imported(colmap.Colmap, images=folder / "images")(folder / model)
    )


def colmap_rig(folder: Path) -> Reader:
    model = structure_files.colmap_rig(folder)
    return Reader(sorted(model.glob("*.txt")), imported(colmap.Colmap)(folder))


def metashape_rig(folder: Path) -> Reader:
    path = structure_files.metashape_rig(folder, 2.5)
    return Reader([path], imported(Metashape)(path))


def bundler(folder: Path) -> Reader:
    path = structure_files.bundler(folder)
    return Reader([path, folder / "list.txt"], imported(formats.FORMATS["bundler"])(path))


def structure(name: str) -> Callable[[Path], Reader]:
    """A reader of a format that is one file of `structure_files`."""

    def of(folder: Path) -> Reader:
        path = getattr(structure_files, name)(folder)
        return Reader([path], imported(formats.FORMATS[name])(path))

    return of


def glb(folder: Path) -> Reader:
    path = structure_files.gltf(folder, ".glb")
    return Reader([path], imported(formats.FORMATS["gltf"])(path))


def polycam(folder: Path) -> Reader:
    structure_files.polycam(folder)
    return Reader(sorted(folder.rglob("*.json")), imported(formats.FORMATS["polycam"])(folder))


def record3d(folder: Path) -> Reader:
    structure_files.record3d(folder)
    return Reader([folder / "metadata.json"], imported(formats.FORMATS["record3d"])(folder))


def sdfstudio(folder: Path) -> Reader:
    structure_files.sdfstudio(folder)
    return Reader([folder / "meta_data.json"], imported(formats.FORMATS["sdfstudio"])(folder))


def guessed(folder: Path) -> Reader:
    """All that `convert` looks for without a format."""
    structure_files.polycam(folder)
    structure_files.record3d(folder)
    files = [
        structure_files.bundler(folder),
        structure_files.visualsfm(folder),
        structure_files.opensfm(folder),
        structure_files.gltf(folder),
        folder / "metadata.json",
    ]
    return Reader(files, lambda: documented(lambda: formats.guess(folder)))


def detected(folder: Path) -> Reader:
    """All that is looked for beside photographs."""
    files = [
        photogrammetry_files.metashape(folder),
        photogrammetry_files.csv_table(folder),
        photogrammetry_files.alicevision(folder),
    ]
    photogrammetry_files.sidecars(folder)
    return Reader([*files, folder / "a.xmp"], lambda: formats.detect(folder))


# Pictures


def picture(name: str, write: Callable[[Path], object]) -> Callable[[Path], Reader]:
    """A reader of an image file, as photograph and as mask."""

    def of(folder: Path) -> Reader:
        path = folder / name
        write(path)

        def read() -> None:
            for ask in (image_size, has_alpha, exif_values, orientation_of, stated):
                documented(lambda ask=ask: ask(path))
            one = Picture(path)
            for ask in ("exif", "camera_orientation", "size", "encoding", "pixels", "mask_pixels"):
                documented(lambda ask=ask: getattr(one, ask))

        return Reader([path], read)

    return of


def stated(path: Path) -> None:
    """The pixels as the file says that they are encoded, and what `convert` says of them."""
    pixels_of(path, heed=True)
    with reading(path, "image"):
        bits_of(path), statement_of(path), unused_fields(path)


def documented(call: Callable[[], object]) -> None:
    """One of several questions, the others of which are asked as well."""
    try:
        call()
    except InputError as error:
        if beyond(error):
            raise


def transparent() -> Image.Image:
    """A picture with an alpha channel."""
    return Image.fromarray(colours(2, channels=4))


def wide() -> bytes:
    """A colour profile that is not sRGB's."""
    return primaries_profile((0.3127, 0.3290), (0.680, 0.320, 0.265, 0.690, 0.150, 0.060))


def write_heif(path: Path) -> None:
    import pillow_heif

    pillow_heif.from_pillow(Image.fromarray(np.kron(colours(1), np.ones((13, 10, 1), np.uint8)))).save(path, quality=50)


def write_dng(path: Path) -> None:
    mosaic = np.random.default_rng(3).integers(0, 30000, (48, 64), np.uint16)
    matrix = np.stack([np.diag([10000] * 3).ravel(), np.full(9, 10000)], 1).ravel().tolist()
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=[
        (274, 3, 1, 6, True), (33421, 3, 2, (2, 2), True), (33422, 1, 4, (0, 1, 1, 2), True),
        (50706, 1, 4, (1, 4, 0, 0), True), (50708, 2, 0, "none", True), (50721, 10, 9, matrix, True),
        (50728, 5, 3, (1, 1, 1, 1, 1, 1), True), (50717, 3, 1, 65535, True),
    ])  # fmt: skip


# What is ours


def scene(folder: Path) -> Reader:
    """Two photographs, one with all that a photograph may have."""
    from conftest import SCENE, SENSOR

    mi.set_variant("llvm_ad_rgb")
    photographs(folder, ["images/000.png", "images/001.png"])
    Image.fromarray(255 * (colours(5)[..., 0] > 99).astype(np.uint8)).save(folder / "mask.png")
    poses = ["-1 0 0 0  0 1 0 0  0 0 -1 5  0 0 0 1", "1 0 0 0  0 1 0 0  0 0 1 -5  0 0 0 1"]
    more = ['<string name="mask" value="mask.png"/><string name="encoding" value="srgb"/>'
            '<float name="saturation" value="0.9"/><float name="gamma" value="1.1"/>'
            '<float name="falloff" value="2"/><string name="tilt" value="1 -0.5"/>'
            '<float name="vignetting" value="1.5"/>', ""]  # fmt: skip
    sensors = [SENSOR.format(id=f"{k:03}", fx=9.0, fy=9.5, cx=3.3, cy=2.2, matrix=poses[k], width=W, height=H,
                             mask=more[k], x=1, y=0.5, z=5 - 10 * k, intensity=25) for k in range(2)]  # fmt: skip
    path = folder / "scene.xml"
    path.write_text(SCENE.format(sensors="".join(sensors)).replace(
        '<bsdf type="cooktorrance"/>', '<float name="radius" value="1"/><point name="center" x="0" y="0" z="0"/>'
        '<integer name="subdivisions" value="1"/><bsdf type="cooktorrance"/>'))  # fmt: skip

    def read() -> None:
        capture = load_capture(path)
        _ = [capture.images[k] for k in range(len(capture))], [capture.masks[k] for k in range(len(capture))]
        fitted_scene_xml(path, folder, 2, '<bsdf type="cooktorrance"/>')

    return Reader([path], read)


def small_ring() -> FittedObject:
    """With a domain of its own."""
    from mi_ring.geometry.domain import Domain

    torch.manual_seed(0)
    ball = trimesh.creation.icosphere(subdivisions=1)
    return FittedObject(
        [1.0, 2.0, 3.0], 2.5, domain=Domain(ball.vertices, ball.faces), steps=2, subdivisions=2, up=[0, 0, 1.0]
    )


def ring(folder: Path) -> Reader:
    path = folder / "ring.pt"
    write_state(ring_state(small_ring()), path)
    return Reader([path], lambda: load_fit(path))


def checkpoint(folder: Path) -> Reader:
    path, config = folder / "checkpoint.pt", Config()
    state = {"fit": {"iteration": 3, "rates": [0.1], "networks": small_ring().state_dict()}, "files": {"a": "b"}}
    write_state({"format": FORMAT, "settings": config.settings(), **state}, path)
    return Reader([path], lambda: read_checkpoint(folder, config))


def settings(folder: Path) -> Reader:
    path = folder / "config.json"
    path.write_text(json.dumps({"scene": "scene.xml", **Config(domain=("mesh", Path("a.ply"))).settings()}))
    return Reader([path], lambda: Config.load(folder))


def results(folder: Path) -> Reader:
    """What a fit and `check` look for in folders of results."""
    names = ("config.json", "log.jsonl", "calibration.json")
    move = {"moved_px": 0.3, "power": [1.1, 1.0, 0.9]}
    contents = ('{"scene": "../scene.xml", "minutes": 3, "preset": "fast", "iterations": 9}', '{"iteration": 1}\n' * 3,
                '{"refined": ["power"], "photographs": {"000": %s, "001": %s}}')  # fmt: skip
    for name, content in zip(names, contents):
        (folder / name).write_text(content.replace("%s", str(move).replace("'", '"')))

    config = FitConfig(scene=folder / "scene.xml", minutes=3)

    def read() -> None:
        read_log(folder)
        findings_of_fit(folder / "scene.xml", ["000", "001"])
        planned_before(config, [config], folder)

    return Reader([folder / name for name in names], read)


def merl(folder: Path) -> Reader:
    path = folder / "table.binary"
    path.write_bytes(np.array(CELLS, "<i4").tobytes() + b"\0" * 99)
    return Reader([path], lambda: plugin_error(lambda: MerlTable(path)))


def networks(folder: Path) -> Reader:
    path = folder / "networks.npz"
    merl_tables.networks(path)
    return Reader([path], lambda: plugin_error(lambda: MerlNetwork(path, "one")))


def synthesized(folder: Path) -> Reader:
    """All that `synthesize` reads: a mesh with colours, two materials, the picture of a pattern, an environment."""
    mi.set_variant("llvm_ad_rgb")
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.visual.vertex_colors = np.random.default_rng(1).integers(0, 255, (len(ball.vertices), 3), np.uint8)
    photographs(folder, ["pattern.png", "colours.png"])
    names = ("ball.ply", "material.xml", "networks.npz", "pattern.png", "sky.exr")
    files = mesh_file, material, measured, pattern, sky = [folder / name for name in names]
    ball.export(mesh_file)
    material.write_text('<bsdf type="principled"><float name="roughness" value="0.3"/><texture type="bitmap" '
                        'name="base_color"><string name="filename" value="colours.png"/></texture></bsdf>')  # fmt: skip
    merl_tables.networks(measured)
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(sky))
    config = SynthesizeConfig(mesh_file, folder / "out", material=str(material), second=f"{measured}:one",
                              pattern=str(pattern), environment=sky)  # fmt: skip
    return Reader(files, lambda: Studio(config))


def plugin_error(call: Callable[[], object]) -> None:
    """Plugins raise ValueError, which Mitsuba passes on; with the name of the file it is documented."""
    try:
        call()
    except ValueError as error:
        raise InputError(str(error)) from error


def mesh(suffix: str) -> Callable[[Path], Reader]:
    """A reader of domains and truths."""

    def of(folder: Path) -> Reader:
        path = folder / f"ball{suffix}"
        trimesh.creation.icosphere(subdivisions=1).export(path)
        return Reader([path], lambda: load_closed_mesh(path, "domain"))

    return of


READERS: dict[str, Callable[[Path], Reader]] = {
    "metashape": metashape, "realitycapture-xmp": sidecars, "realitycapture-csv": table, "llff": llff,
    "middlebury": middlebury, "sfmdata-alicevision": alicevision, "sfmdata-openmvg": openmvg, "transforms": transforms,
    "neus": neus, "wildlight": wildlight, "iron": iron, "diligent-mv": diligent, "colmap-text": colmap_text,
    "colmap-binary": colmap_binary, "colmap-rig": colmap_rig, "metashape-rig": metashape_rig, "bundler": bundler,
    "visualsfm": structure("visualsfm"), "opensfm": structure("opensfm"), "gltf-cameras": structure("gltf"),
    "glb-cameras": glb, "polycam": polycam, "record3d": record3d, "sdfstudio": sdfstudio, "guess": guessed,
    "detect": detected, "scene": scene, "ring.pt": ring, "checkpoint.pt": checkpoint,
    "results": results, "config.json": settings, "merl-networks": networks, "synthesize": synthesized,
    "merl-table": merl, "ply": mesh(".ply"), "obj": mesh(".obj"),
    "stl": mesh(".stl"), "glb": mesh(".glb"),
    "png": picture("a.png", lambda path: photographs(path.parent, ["a.png"])),
    "png-16": picture("a.png", lambda path: mi.Bitmap(colours(1, np.uint16, 4)).write(str(path))),
    "jpeg": picture("a.jpg", lambda path: photographs(path.parent, ["a.jpg"])),
    "tiff": picture("a.tif", lambda path: photographs(path.parent, ["a.tif"])),
    "tiff-compressed": picture("a.tif", lambda path: tifffile.imwrite(
        path, colours(2, np.uint16, 4), compression="zlib", predictor=True, photometric="rgb")),
    "exr": picture("a.exr", lambda path: mi.Bitmap(colours(3).astype(np.float32)).write(str(path))),
    "png-palette": picture("a.png", lambda path: transparent().quantize(method=Image.Quantize.FASTOCTREE).save(path)),
    "png-profile": picture("a.png", lambda path: transparent().save(path, icc_profile=wide(), gamma=1 / 2.2)),
    "jpeg-profile": picture("a.jpg", lambda path: Image.fromarray(colours(1)).save(path, icc_profile=wide())),
    "jpeg-cmyk": picture("a.jpg", lambda path: Image.fromarray(colours(1)).convert("CMYK").save(path)),
    "tiff-float": picture("a.tif", lambda path: tifffile.imwrite(
        path, colours(2).astype(np.float16), photometric="rgb", iccprofile=wide())),
    "tiff-planar": picture("a.tif", lambda path: tifffile.imwrite(
        path, colours(2, np.uint16).transpose(2, 0, 1), photometric="rgb", planarconfig="separate", bigtiff=True)),
    "tiff-palette": picture("a.tif", lambda path: Image.fromarray(colours(2)).quantize(9).save(path)),
    "webp": picture("a.webp", lambda path: transparent().save(path, icc_profile=wide())),
    "avif": picture("a.avif", lambda path: transparent().save(path)),
    "bmp": picture("a.bmp", lambda path: Image.fromarray(colours(2)).save(path)),
    "heif": picture("a.heic", write_heif), "raw": picture("a.dng", write_dng),
}  # fmt: skip


def beyond(error: InputError) -> str:
    """Why an InputError is a finding all the same: it was made of one that nobody has foreseen. Empty if it is none."""
    text = str(error)
    if "\n" in text:
        return "of several lines"
    if "is damaged, or not of this format (" in text:
        return text.split("not of this format (", 1)[1]
    cause: BaseException | None = error
    while cause := cause.__cause__:
        if isinstance(cause, MemoryError) or "bad_alloc" in str(cause) or "llocate" in str(cause):
            return f"memory: {cause!r}"
    return ""
