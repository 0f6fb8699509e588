"""Files of others: what declares more than it can hold is refused before that is allocated, and damage is one line."""

import io
import json
import shutil
import struct
import zlib

import mitsuba as mi
import numpy as np
import pytest
import tifffile
import torch
import trimesh
from PIL import ExifTags, Image, ImageFile

from mi_ring import foreign, image_headers, images
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting.checkpoint import FORMAT, read_checkpoint
from mi_ring.fitting.config import Config
from mi_ring.foreign import EXPANSION, SMALL, load_npy, load_npz, reading, require_plausible_size, require_readable
from mi_ring.geometry.meshes import read_mesh
from mi_ring.image_headers import BoundedFile
from mi_ring.images import write_image
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.frames import frames_of
from mi_ring.importers.photogrammetry import exif_values, exposures_of
from mi_ring.importers.reading import has_alpha, image_size, load_mat, pixels_of
from mi_ring.importers.transforms import Transforms
from mi_ring.metrics.capture_findings import findings_of_fit
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit, ring_state
from mi_ring.output.results import default_folder, read_log
from mi_ring.photogrammetry.folder import Picture
from mi_ring.rendering.measured_brdf import MerlNetwork
from mi_ring.system.files import write_state

HUGE = 60_000  #: sides of a picture of 10 GB [px]


def png(path, width, height):
    """One that declares this size and has an EXIF chunk after its pixels, which Pillow would read first."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(99))), (b"eXIf", b"II*\0\x08\0\0\0\0\0"), (b"IEND", b"")]
    packed = [
        struct.pack(">I", len(own)) + kind + own + struct.pack(">I", zlib.crc32(kind + own)) for kind, own in chunks
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))


def jpeg(path, width, height):
    Image.new("RGB", (8, 8)).save(path)
    content = path.read_bytes()
    place = content.index(b"\xff\xc0") + 5
    path.write_bytes(content[:place] + struct.pack(">HH", height, width) + content[place + 4 :])


def tiff(path, width, height):
    tifffile.imwrite(path, np.zeros((7, 5, 3), np.uint8), compression="zlib", photometric="rgb")
    retagged(path, {256: width, 257: height, 278: height})


def retagged(path, values):
    """Change tags of a TIFF file, which are of 12 bytes."""
    with tifffile.TiffFile(path) as file:
        places = {tag: file.pages.first.tags[tag].offset for tag in values}
    content = bytearray(path.read_bytes())
    for tag, value in values.items():
        content[places[tag] : places[tag] + 12] = struct.pack("<HHII", tag, 4, 1, value)
    path.write_bytes(content)


def exr(path, width, height):
    mi.Bitmap(np.zeros((7, 5, 3), np.float32)).write(str(path))
    content = path.read_bytes()
    window = struct.pack("<4i", 0, 0, 4, 6)
    assert content.count(window) == 2  # of the data and of the display
    path.write_bytes(content.replace(window, struct.pack("<4i", 0, 0, width - 1, height - 1)))


@pytest.mark.parametrize(("name", "write"), [("a.png", png), ("a.jpg", jpeg), ("a.tif", tiff), ("a.exr", exr)])
def test_pictures_that_declare_to_be_enormous(name, write, tmp_path, monkeypatch):
    """None of their readers is asked for pixels, not even for EXIF data or whether there is alpha."""
    path = tmp_path / name
    write(path, HUGE, HUGE)
    for reader in ((mi, "Bitmap"), (images.tifffile.TiffPage, "asarray"), (ImageFile.ImageFile, "load")):
        monkeypatch.setattr(*reader, lambda *_, **__: pytest.fail("was asked"))
    for ask in (pixels_of, has_alpha, exif_values):
        if (ask is exif_values and name in ("a.exr", "a.tif")) or (ask is has_alpha and name != "a.png"):
            assert not ask(path)  # says so without pixels
            continue
        with pytest.raises(InputError, match=rf"{name}: cannot be read as image \(declares [\d,]+ bytes, in a file of"):
            ask(path)
    assert Picture(path).exif_field(ExifTags.Base.ExposureTime) is None


@pytest.mark.parametrize(("width", "height", "channels"), [(7, 5, 1), (7, 5, 3), (6, 9, 4)])
def test_the_header_of_an_exr_is_what_its_pixels_are(width, height, channels, tmp_path):
    path = tmp_path / "a.exr"
    mi.Bitmap(np.zeros((height, width, channels), np.float32)).write(str(path))
    assert image_headers.exr_size(path) == (width, height, channels) == (*pixels_of(path).shape[1::-1], channels)
    assert image_size(path) == (width, height)
    bitmap = mi.Bitmap(np.zeros((height, width, channels), np.float32))
    bitmap.metadata()["comments"] = "of what was seen there " * 5000  # by the name's letter before the size
    bitmap.write(str(path))
    assert path.stat().st_size > 2**16
    assert image_headers.exr_size(path) == (width, height, channels)
    path.write_bytes(path.read_bytes()[: 2**16])
    with pytest.raises((ValueError, LookupError)):
        image_headers.exr_size(path)


def test_an_exr_of_one_row_that_is_enormous(tmp_path, monkeypatch):
    """Its reader has room for several of its chunks of 32 rows or more, though one row is all there is."""
    exr(tmp_path / "a.exr", 2**24, 1)
    monkeypatch.setattr(mi, "Bitmap", lambda *_, **__: pytest.fail("was asked"))
    with pytest.raises(InputError, match=r"declares [\d,]+ bytes, in a file of"):
        pixels_of(tmp_path / "a.exr")


def test_a_tiff_of_more_strips_than_bytes(tmp_path):
    """Each of which its reader would look for."""
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((7, 5, 3), np.uint8), compression="zlib", photometric="rgb")
    retagged(tmp_path / "a.tif", {257: 8_000_000, 278: 1})
    with pytest.raises(InputError, match=r"a.tif: cannot be read as image \(declares 8,000,000 strips or tiles"):
        pixels_of(tmp_path / "a.tif")


def test_photographs_of_phones_are_not_enormous(tmp_path):
    """200 million pixels; and what compresses well, as masks do, to a thousandth."""
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(2_000_000))
    require_plausible_size(path, 3 * 200_000_000)
    path.write_bytes(bytes(70_000))
    require_plausible_size(path, 50_000_000)
    for size in (SMALL + 1, EXPANSION * 70_000 + 1):
        if size > max(SMALL, EXPANSION * 70_000):
            with pytest.raises(ValueError, match="declares"):
                require_plausible_size(path, size)


def test_arrays_that_declare_more_than_there_is(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", np.zeros((3, 17)))
    content = (tmp_path / "a.npy").read_bytes()
    for shape in (b"(9999999999, 17)", b"(3, 18)"):
        header = content[:128].replace(b"(3, 17)", shape)
        header = header[: 127 - len(shape) + 7] + b"\n" if len(header) == 128 else header[:127] + b"\n"
        (tmp_path / "a.npy").write_bytes(header.ljust(128) + content[128:])
        with pytest.raises(InputError, match=r"a.npy: cannot be read as an array"):
            load_npy(tmp_path / "a.npy")
    for order in "<>":
        np.save(tmp_path / "a.npy", np.array(["abc", "\U0010ffff"], f"{order}U3"))
        assert load_npy(tmp_path / "a.npy").tolist() == ["abc", "\U0010ffff"]
        content = (tmp_path / "a.npy").read_bytes()
        (tmp_path / "a.npy").write_bytes(content[:-4] + b"\xff" * 4)
        with pytest.raises(InputError, match="a.npy: .* .has invalid characters"):
            load_npy(tmp_path / "a.npy")
    monkeypatch.setattr(foreign, "SMALL", 2**16)
    monkeypatch.setattr(foreign, "EXPANSION", 100)
    np.savez_compressed(tmp_path / "bomb.npz", a=np.zeros(2**17))
    with pytest.raises(InputError, match="bomb.npz: .* .declares 1,048,704 bytes"):
        load_npz(tmp_path / "bomb.npz")
    np.savez_compressed(tmp_path / "good.npz", a=np.eye(3), b=["x"])
    arrays = load_npz(tmp_path / "good.npz")
    assert (arrays["a"] == np.eye(3)).all() and arrays["b"].tolist() == ["x"]


def test_networks_that_are_damaged(tmp_path):
    """A member of the archive whose check sum is wrong; layers that are no numbers; names that are one word."""
    layers = {"w1": (6, 21), "b1": (21,), "w2": (21, 21), "b2": (21,), "w3": (21, 3), "b3": (3,)}
    arrays = {name: np.ones((1, *shape)) for name, shape in layers.items()}
    path = tmp_path / "nets.npz"
    for given in ({"w2": arrays["w2"].astype(str)}, {"names": np.array(3.0), "w1": np.ones(3)}):
        np.savez(path, **{"names": ["one"], **arrays, **given})
        with pytest.raises(InputError, match=r"nets.npz: w\d is of shape"):
            MerlNetwork(path, "one")
    np.savez(path, names=["one"], **arrays)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="nets.npz: cannot be read"):
        MerlNetwork(path, "one")


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".stl", ".obj"])
def test_meshes_are_read_as_before(suffix, tmp_path):
    path = tmp_path / f"ball{suffix}"
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.export(path)
    mesh = read_mesh(path, "domain")
    assert len(mesh.vertices) == 42 and mesh.is_watertight and mesh.volume == pytest.approx(ball.volume, rel=1e-5)


def test_meshes_whose_triangles_have_vertices_that_are_not_there(tmp_path):
    path = tmp_path / "ball.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
                     b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
                     b"0 0 0\n1 0 0\n0 1 0\n3 0 1 99\n")  # fmt: skip
    with pytest.raises(InputError, match="ball.ply: domain: cannot be read as a mesh"):
        read_mesh(path, "domain")


def test_exif_data_that_no_reader_stands(tmp_path, monkeypatch):
    assert np.isnan(exposures_of([{33434: 10**400, 34855: 100, 33437: 2.8}, {33434: 1}])[0])
    monkeypatch.setattr(Image, "open", lambda _: (_ for _ in ()).throw(OverflowError("as if")))
    assert not Picture(tmp_path / "a.png").exif


def test_what_other_runs_have_left_is_damaged(tmp_path, monkeypatch):
    """Nested 100,000 times, numbers of 400 digits, bytes that are no text: as if it were not there."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "out/pot"
    folder.mkdir(parents=True)
    for content in (b"[" * 100_000, b'{"scene": 3}', b"\xff\xfe", b"[3]"):
        (folder / "config.json").write_bytes(content)
        assert default_folder(tmp_path / "pot.xml").resolve() == folder
    for far in ("1" * 400, "[" * 100_000, '"x"'):
        (tmp_path / "calibration.json").write_text(f'{{"photographs": {{"a": {{"moved_px": {far}}}}}}}')
        assert findings_of_fit(tmp_path / "pot.xml", ["a"]) == ("", "")
    (folder / "log.jsonl").write_bytes(b'{"iteration": 1}\n\xff\xff\n{"iteration"')
    assert read_log(folder) == [{"iteration": 1}]


def test_an_error_is_one_line_whatever_it_echoes(tmp_path):
    for line_break in "\n\r\x0b\x0c\x1c\x85\u2028":
        assert str(InputError(f"a{line_break}b: no  such file")) == "a b: no  such file"
    with (
        pytest.raises(InputError, match=r"^x: cannot be read as a picture \(OverflowError\)$"),
        reading("x", "a picture"),
    ):
        raise OverflowError
    with pytest.raises(InputError, match=r"^as it was$"), reading("x", "a picture"):
        raise InputError("as it was")


def test_cameras_beside_photographs_are_of_strangers_too(tmp_path, monkeypatch):
    """`photos` takes them as `convert` does."""
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [{}]}))
    source = Transforms(tmp_path, tmp_path / "scene.xml")
    monkeypatch.setattr(Transforms, "frames", lambda self: (_ for _ in ()).throw(KeyError("x")))
    with pytest.raises(InputError, match=r"SRC: is damaged, or not of this format .KeyError: 'x'"):
        frames_of(source)


def test_each_of_520_changed_bits_is_noticed(tmp_path):
    """Of ring.pt and checkpoint.pt, from the first byte to the last."""
    torch.manual_seed(0)
    ring, config = tmp_path / "ring.pt", Config()
    write_state(ring_state(FittedObject([1.0, 2.0, 3.0], 2.5, steps=2)), ring)
    checkpoint = tmp_path / "checkpoint.pt"
    write_state(
        {"format": FORMAT, "settings": config.settings(), "files": {}, "fit": {"x": torch.ones(99)}}, checkpoint
    )
    random = np.random.default_rng(3)
    for path, read in ((ring, lambda: load_fit(ring)), (checkpoint, lambda: read_checkpoint(tmp_path, config))):
        content = path.read_bytes()
        read()
        for place in np.linspace(0, len(content) - 1, 260).astype(int):
            changed = bytearray(content)
            changed[place] ^= 1 << random.integers(8)
            path.write_bytes(changed)
            with pytest.raises(InputError, match=f"{path.name}: not a"):
                read()
        path.write_bytes(content)


def test_native_readers_that_crash_are_tried_elsewhere(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(bytes(8))
    for read, words in (
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "its reader ended with status -11"),
        ("raise OSError('as if')", "OSError: as if"),
        ("bytearray(2**33)", "MemoryError"),
    ):
        with pytest.raises(InputError, match=f"a.mat: not a MATLAB file, or damaged .{words}"):
            require_readable(read, path, 8, "a MATLAB file")
    require_readable("open(sys.argv[1], 'rb').read()", path, 8, "a MATLAB file")
    with pytest.raises(InputError, match="a.mat: not a MATLAB file, or damaged"):
        load_mat(path)


def test_a_name_that_no_file_can_have_is_that_of_none(small_capture, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(small_capture.parent, folder)
    scene = folder / small_capture.name
    scene.write_text(scene.read_text().replace("images/003.png", "c" * 300))
    with pytest.raises(InputError, match="no such file"):
        load_capture(scene)


def test_a_png_whose_pixels_declare_to_be_enormous_asks_for_no_more_than_it_has(tmp_path):
    file = tmp_path / "a.png"
    write_image(np.zeros((5, 7, 3), np.uint8), file)
    content = file.read_bytes()
    place = content.index(b"IDAT")
    file.write_bytes(content[: place - 4] + struct.pack(">I", 2**31 - 1) + content[place:])
    with BoundedFile(io.FileIO(file)) as stream:
        stream.read(5)
        assert len(stream.read(2**62)) == len(content) - 5 and stream.read(1) == b""
    assert image_size(file) == (7, 5)


def test_what_is_called_png_may_be_a_jpeg_but_no_brush(tmp_path):
    Image.new("RGB", (7, 5)).save(tmp_path / "a.png", "JPEG")
    assert image_size(tmp_path / "a.png") == (7, 5)
    (tmp_path / "b.png").write_bytes(struct.pack(">IIIII", 2**31, 2, 7, 5, 1) + b"GIMP" + bytes(60))
    with pytest.raises(InputError, match="its content is none of"):
        image_size(tmp_path / "b.png")


def test_a_panorama_of_colmap_is_refused():
    with pytest.raises(InputError, match="panorama"):
        Lens("EQUIRECTANGULAR", (70, 50), (70.0, 50.0))


@pytest.mark.parametrize("change", [{"settings": None}, {"settings": {"weights": 3}}, {"files": []}, {"fit": "none"}])
def test_a_checkpoint_whose_parts_are_none_is_refused(change, tmp_path):
    state = {"format": FORMAT, "settings": Config().settings(), "files": {}, "fit": {}}
    write_state(state | change, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match="holds no checkpoint"):
        read_checkpoint(tmp_path, Config())
