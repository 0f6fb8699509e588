"""Files that are not read, or are saved by other programs: what was found, and what to do instead."""

import json
import struct

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers import photogrammetry_files
from helpers.foreign_captures import colmap_folder, converted

from mi_ring.errors import InputError
from mi_ring.geometry.meshes import read_mesh
from mi_ring.importers.formats import detect
from mi_ring.photogrammetry.folder import find_pictures
from mi_ring.synthesis.materials import load_material


def compressed_glb(path, extension):
    """A GLB file whose positions are in an extension that is needed to read them."""
    content = trimesh.creation.icosphere(subdivisions=1).export(file_type="glb")
    size = struct.unpack("<I", content[12:16])[0]
    top = json.loads(content[20 : 20 + size]) | {"extensionsUsed": [extension], "extensionsRequired": [extension]}
    for accessor in top["accessors"]:
        accessor.pop("bufferView", None)
    text = json.dumps(top).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + size :]
    path.write_bytes(b"glTF" + struct.pack("<3I", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest)
    return path


@pytest.mark.parametrize("extension", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_compressed_meshes(tmp_path, extension):
    with pytest.raises(InputError, match=f"--mesh: is compressed by {extension}; export it without compression"):
        read_mesh(compressed_glb(tmp_path / "a.glb", extension), "--mesh")
    assert len(read_mesh(compressed_glb(tmp_path / "b.glb", "KHR_materials_variants"), "--mesh").faces)


@pytest.mark.parametrize("suffix", [".fbx", ".usdz", ".blend"])
def test_meshes_of_other_programs(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(b"x" * 99)
    with pytest.raises(InputError, match="is no mesh in a format that is read; save it as PLY, OBJ, STL or GLB"):
        read_mesh(tmp_path / f"a{suffix}", "--mesh")


def test_materials_of_rgl(tmp_path):
    file = tmp_path / "satin.bsdf"
    file.write_bytes(b"tensor_file\0" + bytes(99))
    with pytest.raises(InputError, match="satin.bsdf: is a file .bsdf; give measured filename=FILE.bsdf"):
        load_material(str(file), "--material", False)
    with pytest.raises(RuntimeError, match="is of the RGL database, not of MERL; give Mitsuba's plugin measured"):
        mi.load_dict({"type": "merl", "filename": str(file)})
    (tmp_path / "wood.mtl").write_text("newmtl")
    with pytest.raises(InputError, match="is a file .mtl; give a file .xml with one <bsdf>"):
        load_material(str(tmp_path / "wood.mtl"), "--material", False)


def comma(cell):
    return cell.replace(".", ",") if cell.replace(".", "").replace("-", "").replace("e", "").isdigit() else cell


@pytest.mark.parametrize(("separator", "encoding", "change"), [
    (";", "utf-8", str), (";", "cp1252", comma), ("\t", "utf-16", comma), (",", "cp1252", str),
])  # fmt: skip
def test_tables_that_were_saved_by_other_programs(tmp_path, separator, encoding, change):
    """RealityCapture's table has the same cameras; names with umlauts are found."""
    path = photogrammetry_files.csv_table(tmp_path)
    expected = converted("realitycapture", path, tmp_path / "a.xml").shots
    (tmp_path / "a.JPG").rename(tmp_path / "Tür.JPG")
    text = path.read_text("utf-8-sig").replace("a.JPG", "Tür.JPG")
    lines = [separator.join(map(change, line.split(","))) for line in text.splitlines()]
    path.write_text("\n".join(lines), encoding=encoding)
    found = converted("realitycapture", path, tmp_path / "b.xml").shots
    assert {shot.name for shot in found} == {"Tür", "b", "c"}
    by_name = {shot.name.replace("Tür", "a"): shot.camera for shot in found}
    for shot in expected:
        np.testing.assert_array_equal(by_name[shot.name].to_world, shot.camera.to_world)
        np.testing.assert_array_equal(by_name[shot.name].focal, shot.camera.focal)
    assert detect(tmp_path) is not None


def test_photographs_in_formats_that_are_not_read(tmp_path, capsys):
    folder = colmap_folder(tmp_path)
    files = sorted((folder / "images/sub").iterdir())
    files[0].rename(files[0].with_suffix(".hdr"))
    converted("colmap", folder, tmp_path / "a.xml")
    assert "1 camera left out, without a photograph in" in (printed := capsys.readouterr().out)
    assert "1.jpg; files .hdr there are not read; give JPEG, PNG, TIFF, OpenEXR" in printed
    for file in files[1:]:
        file.rename(file.with_suffix(".jxl"))
    with pytest.raises(InputError, match="files .hdr, .jxl there are not read; give JPEG, PNG"):
        converted("colmap", folder, tmp_path / "b.xml")
    with pytest.raises(InputError, match="and files that are not read: 2 .jxl, 1 .hdr; at least 8 are needed"):
        find_pictures(folder / "images/sub")
