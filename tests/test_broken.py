"""Broken inputs: each gives one line that names file and field, and exit status 2, before anything is written."""

import errno
import os
import re

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.quick_fits import BRIEF

from mi_ring import fit
from mi_ring.errors import InputError
from mi_ring.fitting import session
from mi_ring.output import results
from mi_ring.system import command, files


def xml(pattern, new, count=1):
    """Change the scene file by a regular expression that must match."""

    def edit(path):
        text, changed = re.subn(pattern, new, path.read_text(), count=count, flags=re.DOTALL)
        assert changed
        path.write_text(text)

    return edit


def included(path):
    """Move the scene's content to a file that the scene includes."""
    path.with_name("inner.xml").write_text(path.read_text())
    path.write_text('<scene version="3.0.0"><include filename="inner.xml"/></scene>')


def image(file, pixels):
    return lambda path: mi.Bitmap(np.asarray(pixels)).write(str(path.parent / file))


def content(file, data):
    return lambda path: (path.parent / file).write_bytes(data)


def pose(change):
    """Change the first camera's matrix."""

    def edit(path):
        text = path.read_text()
        old = re.search(r'<matrix value="([^"]*)"', text)[1]
        matrix = change(np.array(old.split(), float).reshape(4, 4))
        path.write_text(text.replace(old, " ".join(map(str, matrix.ravel())), 1))

    return edit


def all_of(*edits):
    return lambda path: [edit(path) for edit in edits]


def add(element, before="<sensor"):
    return xml(f"(?={before})", element)


def half(path):
    file = path.parent / "images/004.png"
    file.write_bytes(file.read_bytes()[:900])


def foreign_names(path):
    """A scene whose text is not UTF-8, as its <?xml …?> would have to say."""
    (path.parent / "images/004.png").rename(path.parent / "images/f\u00fcr.png")
    path.write_bytes(path.read_text().replace("images/004.png", "images/f\u00fcr.png").encode("latin-1"))


def wire(path):
    (path.parent / "wire.txt").write_text("".join(f"{x} 0 0 0.1\n" for x in range(5)))
    add('<shape type="bsplinecurve" id="wire"><string name="filename" value="wire.txt"/></shape>')(path)


def open_mesh(path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.update_faces(np.arange(len(ball.faces)) > 3)
    ball.export(path.parent / "open.ply")


SHAPE = '<shape type="shapenet" id="object">'
IMAGE, MASK = np.zeros((40, 56, 3), np.uint8), np.zeros((40, 56, 1), np.uint8)
NAN = np.full((40, 56, 3), np.nan, np.float32)
POSITION, INTENSITY = r'(<point name="position" x=")[^"]*', r'(<rgb name="intensity" value=")[^"]*'
SPHERE = '<point name="center" x="400" y="-150" z="90"/><float name="radius" value="{}"/>'

#: What is done to a good capture, options, and words of the complaint.
BROKEN = {
    "no scene": (lambda path: path.unlink(), [], ["small.xml", "no such file"]),
    "a folder instead": (lambda path: (path.unlink(), path.mkdir()), [], ["small.xml", "is a folder"]),
    "a photograph": (lambda path: path.rename(path.with_name("small.jpg")) and path.with_name("small.xml").mkdir(), [],
                     ["small.xml", "mi-ring photos makes one"]),
    "a folder with a scene": (lambda path: (path.rename(path.with_name("scene.xml")), path.mkdir(),
                                            path.with_name("scene.xml").rename(path / "scene.xml")), [],
                              ["small.xml: is a folder; give ", "scene.xml"]),
    "a picture without a file, of which Mitsuba crashes": (
        xml("<bsdf[^>]*/>", '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"/></bsdf>'), [],
        ["small.xml: bitmap: filename is missing"]),
    "no XML": (xml("<shape.*", "<shape"), [], ["small.xml: ", "XML"]),
    "an empty file": (content("small.xml", b""), [], ["small.xml: ", "XML"]),
    "a picture as scene": (lambda path: mi.Bitmap(IMAGE).write(str(path), mi.Bitmap.FileFormat.PNG), [],
                           ["small.xml: ", "UTF-8"]),
    "not UTF-8": (foreign_names, [], ["small.xml", "UTF-8"]),
    "unknown plugin": (xml('type="photograph"', 'type="fotograph"'), [], ["small.xml", "fotograph"]),
    "unknown property of a photograph": (xml('name="fx"', 'name="fxx"'), [], ["small.xml", '"000"', "fx"]),
    "unknown property of the object": (xml(SHAPE, SHAPE + '<float name="size" value="1"/>'), [], ["small.xml", "size"]),
    "unknown property of the BSDF": (xml('<bsdf type="cooktorrance"/>', '<bsdf type="cooktorrance"><float name="gloss" '
                                         'value="1"/></bsdf>'), [], ["small.xml", "gloss"]),
    "unknown property of the integrator": (xml('<integrator type="photometric"/>', '<integrator type="photometric">'
                                               '<integer name="bounces" value="1"/></integrator>'), [],
                                           ["small.xml", "bounces"]),
    "no photographs": (xml("<sensor.*</sensor>", ""), [], ["small.xml", "sensor"]),
    "no shapenet": (xml('type="shapenet"', 'type="sphere"'), [], ["small.xml", "shapenet"]),
    "two objects": (add('<shape type="shapenet" id="b"><bsdf type="cooktorrance"/></shape>'), [],
                    ["small.xml", "2", "shapenet"]),
    "the same id twice": (xml('id="001"', 'id="000"'), [], ["small.xml", '"000"']),
    "a finished fit as start": (xml(SHAPE, SHAPE + '<string name="weights" value="ring.pt"/>'), [],
                                ["ring.pt", "no such file"]),
    "wrong attribute": (xml('<bsdf type="cooktorrance"/>', '<bsdf type="cooktorrance"><texture type="mesh_attribute" '
                            'name="diffuse"><string name="name" value="vertex_color"/></texture></bsdf>'), [],
                        ["small.xml", "vertex_color"]),
    "shape without gradients": (wire, [], ["small.xml", '"wire"', "BSplineCurve", "meshes"]),
    "missing photograph": (lambda path: (path.parent / "images/004.png").unlink(), [],
                           ["images/004.png", 'photograph "004"', "filename"]),
    "empty photograph": (content("images/004.png", b""), [], ["004.png", "filename"]),
    "truncated photograph": (half, [], ["004.png", "filename"]),
    "text as photograph": (content("images/004.png", b"not a picture"), [], ["004.png", "filename"]),
    "a folder as photograph": (xml("images/004.png", "images"), [], ['"004"', "filename", "images"]),
    "photograph of another size": (image("images/004.png", np.zeros((41, 56, 3), np.uint8)), [],
                                   ["004.png", "filename", "56 x 41", "56 x 40"]),
    "film of another size": (xml('name="width" value="56"', 'name="width" value="57"'), [],
                             ["000.png", "filename", "56 x 40", "57 x 40"]),
    "no film": (xml('<film type="hdrfilm">.*?</film>', ""), [], ["000.png", "filename", "56 x 40"]),
    "photograph with NaN": (all_of(xml("images/004.png", "images/004.exr"), image("images/004.exr", NAN)), [],
                            ["004.exr", "NaN"]),
    "photograph of a nova": (all_of(xml("images/004.png", "images/004.exr"),
                                    image("images/004.exr", np.full((40, 56, 3), 1e38, np.float32))), [],
                             ["004.exr", "above 1e+18"]),
    "all black": (all_of(*(image(f"images/{k:03}.png", IMAGE) for k in range(12))), [], ["small.xml", "black"]),
    "all over-exposed": (all_of(*(image(f"images/{k:03}.png", IMAGE + 255) for k in range(12))), [],
                         ["small.xml", "over-exposed"]),
    "8 bits declared linear": (xml('images/004.png"/>', 'images/004.png"/><string name="encoding" value="linear"/>'),
                               [], ["small.xml", '"004"', "encoding", "8 bits"]),
    "unknown encoding": (xml('images/004.png"/>', 'images/004.png"/><string name="encoding" value="raw"/>'), [],
                         ["small.xml", '"004"', "encoding", "raw"]),
    "saturation 0": (xml('images/004.png"/>', 'images/004.png"/><float name="saturation" value="0"/>'), [],
                     ["small.xml", '"004"', "saturation"]),
    "missing mask": (lambda path: (path.parent / "masks/005.png").unlink(), [], ["005.png", '"005"', "mask"]),
    "mask of another size": (image("masks/005.png", MASK[:, :55]), [], ["005.png", "mask", "55 x 40", "56 x 40"]),
    "empty mask": (image("masks/005.png", MASK), [], ["005.png", "mask"]),
    "photograph as its own mask": (xml("masks/005.png", "images/005.png"), [], ["005.png", '"005"', "mask", "alpha"]),
    "no focal length": (xml('<float name="fx" value="60.0"/>', ""), [], ['"000"', "fx is missing"]),
    "zero focal length": (xml('name="fy" value="66.0"', 'name="fy" value="0"'), [], ['"000"', "fy is 0"]),
    "negative focal length": (xml('name="fy" value="66.0"', 'name="fy" value="-66"'), [], ['"000"', "fy is -66"]),
    "NaN as focal length": (xml('name="fy" value="66.0"', 'name="fy" value="nan"'), [], ["small.xml", "fy is nan"]),
    "NaN as principal point": (xml('name="cx" value="30.5"', 'name="cx" value="nan"'), [], ["small.xml", "cx is nan"]),
    "words as focal length": (xml('name="fy" value="66.0"', 'name="fy" value="wide"'), [], ["small.xml", "wide"]),
    "NaN in a pose": (pose(lambda m: m * np.where(np.eye(4, k=3), np.nan, 1)), [], ["small.xml", '"000"', "to_world"]),
    "left-handed pose": (pose(lambda m: m @ np.diag([-1, 1, 1, 1])), [], ["small.xml", '"000"', "to_world", "mirror"]),
    "scaled pose": (pose(lambda m: m @ np.diag([2, 2, 2, 1])), [], ["small.xml", '"000"', "to_world", "scale"]),
    "pose of nine numbers": (xml('<matrix value="[^"]*"', '<matrix value="1 0 0 0 1 0 0 0 1 0"'), [],
                             ["small.xml: ", "matrix"]),
    "no poses": (xml('<transform name="to_world">.*?</transform>', "", 0), [],
                 ["small.xml", '"000"', "to_world is missing"]),
    "one pose is missing": (xml('<transform name="to_world">.*?</transform>', "", 1), [],
                            ["small.xml", '"000"', "to_world is missing"]),
    "a light that is nowhere": (xml('<point name="position"[^>]*>', "", 1), [],
                                ["small.xml", '"000"', "emitter", "position is missing"]),
    "a light without direction": (all_of(xml('<emitter type="point">', '<emitter type="directional">', 1),
                                         xml('<point name="position"[^>]*>', "", 1),
                                         xml("intensity", "irradiance", 1)), [],
                                  ["small.xml", '"000"', "emitter", "direction is missing"]),
    "a transposed pose": (pose(lambda m: m.T), [], ["small.xml", '"000"', "to_world", "last row", "transposed?"]),
    "a pose without a place": (pose(lambda m: m[:3, :3]), [],
                               ["small.xml", '"000"', "to_world", "9 numbers", "give 16"]),
    "a photograph of two cameras": (xml("images/003.png", "images/../images/001.png"), [],
                                    ["small.xml", '"001" and "003"', "filename", "give each its own"]),
    "an included pose is missing": (all_of(xml('<transform name="to_world">.*?</transform>', "", 1), included), [],
                                    ["inner.xml", '"000"', "to_world is missing"]),
    "another encoding than is said": (xml("<scene", '<?xml version="1.0" encoding="utf-16"?><scene', 1), [],
                                      ["small.xml: is no XML", "encoding"]),
    "an encoding that nobody knows": (xml("<scene", '<?xml version="1.0" encoding="klingon"?><scene', 1), [],
                                      ["small.xml: is no XML", "encoding"]),
    "an attribute twice": (xml("<scene ", '<scene id="a" id="b" ', 1), [], ["small.xml: is no XML", "duplicate"]),
    "two scenes": (xml("</scene>", "</scene><scene/>", 1), [], ["small.xml: is no XML", "junk after"]),
    "a control character": (xml("<scene ", "<scene id='a\x01' ", 1), [], ["small.xml: is no XML", "token"]),
    "a flat photograph": (xml('name="height" value="40"', 'name="height" value="2"', 1), [],
                          ["small.xml", '"000"', "film: is 56 x 2 pixels"]),
    "a name of two lines": (xml('value="images/000.png"', 'value="images/0\n0.png"', 1), [], ["no such file"]),
    "cameras turned away": (pose(lambda m: m @ np.diag([-1, 1, -1, 1])), [], ["small.xml", "to_world"]),
    "camera inside the object": (all_of(pose(lambda m: np.c_[m[:, :3], [400, -150, 95, 1]]),
                                        xml(SHAPE, SHAPE + SPHERE.format(25))), [], ["small.xml", '"000"', "to_world"]),
    "light inside the object": (xml(POSITION + '" y="[^"]*" z="[^"]*', r'\g<1>401" y="-149" z="88'), [],
                                ["small.xml", '"000"', "emitter"]),
    "light at infinity": (xml(POSITION, r"\g<1>inf"), [], ["small.xml", '"000"', "light"]),
    "light without a place": (xml(POSITION, r"\g<1>nan"), [], ["small.xml", '"000"', "light"]),
    "negative light": (xml(INTENSITY, r"\g<1>-5"), [], ["small.xml", '"000"', "light", "positive"]),
    "light switched off": (xml(INTENSITY, r"\g<1>0"), [], ["small.xml", '"000"', "light", "positive"]),
    "spot light": (xml("<emitter.*?</emitter>", '<emitter type="spot"/>'), [], ['"000"', "SpotLight", "directional"]),
    "a focal length that is infinite in float32": (xml('name="fx" value="[^"]*"', 'name="fx" value="1e39"', 1), [],
                                                   ["small.xml", '"000"', "fx is 1e+39"]),
    "a principal point far off": (xml('name="cy" value="[^"]*"', 'name="cy" value="1e6"', 1), [],
                                  ["small.xml", '"000"', "cy is 1e+06", "pixels?"]),
    "a radius that is infinite in float32": (xml(SHAPE, SHAPE + SPHERE.format(1e39)), [], ["small.xml", "radius is"]),
    "radius 0": (xml(SHAPE, SHAPE + SPHERE.format(0)), [], ["small.xml", "radius is 0"]),
    "another radius than the object's": (xml(SHAPE, SHAPE + SPHERE.format(1e-3)), [],
                                         ["small.xml: center and radius of the shapenet shape: are 400, -150, 90 and "
                                          "0.001, but", "correct them or leave them out"]),
    "another place than the object's": (xml(SHAPE, SHAPE + SPHERE.format(30).split("<float")[0].replace("400", "4e5")),
                                        [], ["small.xml: center and radius of the shapenet shape: are 4e+05, -150, 90",
                                             "has a radius of 2", "leave them out"]),
    "another place than the object's, with its radius": (
        xml(SHAPE, SHAPE + SPHERE.format(30).replace("400", "4e5")), [],
        ["small.xml: center and radius of the shapenet shape: are 4e+05, -150, 90 and 30, but", "leave them out"]),
    "NaN as radius": (xml(SHAPE, SHAPE + SPHERE.format("nan")), [], ["small.xml", "radius is nan"]),
    "NaN as centre": (xml(SHAPE, SHAPE + SPHERE.format(30).replace("-150", "nan")), [], ["small.xml", "center is"]),
    "missing domain": (xml(SHAPE, SHAPE + '<string name="domain" value="none.ply"/>'), [],
                       ["none.ply: domain: no such file"]),
    "open domain": (all_of(open_mesh, xml(SHAPE, SHAPE + '<string name="domain" value="open.ply"/>')), [],
                    ["open.ply: domain: is not a closed surface"]),
    "picture as domain": (lambda path: None, ["--domain", "mesh", "{folder}/images/000.png"],
                          ["000.png: --domain: is no mesh in a format that is read; save it as PLY"]),
    "hull without masks": (xml('<string name="mask"[^>]*>', "", 0), ["--domain", "hull", "--masks", "given"],
                           ["small.xml", "--domain hull", "masks"]),
    "nothing to resume": (lambda path: None, ["--resume"], ["checkpoint.pt", "--resume"]),
    "misspelt option": (lambda path: None, ["--iteration", "3"], ["--iteration"]),
    "a scene that includes others": (add('<include filename="other.xml"/>'), [], ["small.xml", "other.xml"]),
}  # fmt: skip


def run(arguments, capsys):
    """Exit status of `python -m mi_ring.fit …` and what it complains of."""
    with pytest.raises(SystemExit) as stop:
        command.run("mi_ring.fit", fit.main, list(map(str, arguments)))
    return stop.value.code, capsys.readouterr().err


@pytest.mark.parametrize("case", BROKEN)
def test_one_line_and_status_2_before_anything_is_written(case, broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    breaking, options, words = BROKEN[case]
    breaking(path)
    before = sorted(tmp_path.rglob("*"))
    options = [option.format(folder=path.parent) for option in options]
    status, complaint = run([path, "--out", tmp_path / "out", "--iterations", 1, *options], capsys)
    assert status == 2
    assert complaint.startswith("mi_ring.fit: ") and complaint.count("\n") == 1, complaint
    assert all(word in complaint for word in words), complaint
    assert sorted(tmp_path.rglob("*")) == before


def test_names_that_are_not_utf_8(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    odd = path.with_name(os.fsdecode(b"sm\xe4ll.xml"))
    path.rename(odd)
    for arguments in ([odd, "--out", tmp_path / "out"], [path, "--out", odd.with_suffix("")]):
        status, complaint = run([*arguments, "--iterations", 1], capsys)
        assert status == 2 and complaint.count("\n") == 1 and "UTF-8" in complaint and "sm\ufffdll" in complaint


@pytest.mark.parametrize("out", ["/dev/null/out", "/proc/out"])  # read-only, whoever asks
def test_a_folder_that_cannot_be_written(out, broken_capture, capsys):
    status, complaint = run([broken_capture[0], "--out", out, "--iterations", 1], capsys)
    assert status == 2 and complaint.count("\n") == 1 and out in complaint and "--out" in complaint


@pytest.fixture
def full_disk(monkeypatch):
    """A function that has a file of this name meet a full disk when it is written the n-th time, and any later time."""
    genuine, written = files.partial_path, []

    def meets(name, nth=1):
        def partial(path):
            place = genuine(path)
            written.append(path.name)
            if path.name == name and written.count(name) >= nth:
                os.symlink("/dev/full", place)
            return place

        monkeypatch.setattr(files, "partial_path", partial)

    return meets


@pytest.mark.parametrize("file", ["config.json", "checkpoint.pt", "ring.pt", "mesh.ply", "report.html"])
def test_a_full_disk(file, small_capture, tmp_path, capsys, full_disk):
    out = tmp_path / "out"
    full_disk(file)
    quick = ["--iterations", 5, *BRIEF]
    status, complaint = run([small_capture, "--out", out, *quick], capsys)
    assert status == 2, complaint
    complaint = complaint.splitlines()[-1]
    assert f"out/{file}: cannot be written ({os.strerror(errno.ENOSPC)})" in complaint
    assert not [f for f in out.iterdir() if f.name.startswith(".") or f.name == file]


def test_a_log_that_cannot_be_continued(tmp_path):
    os.symlink("/dev/full", tmp_path / "log.jsonl")
    with pytest.raises(InputError, match="log.jsonl: cannot be written"):
        results.add_to_log(tmp_path, {"iteration": 5})


def test_after_a_full_disk_the_fit_goes_on(small_capture, tmp_path, monkeypatch, capsys, full_disk):
    out = tmp_path / "out"
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0)
    full_disk("checkpoint.pt", nth=4)
    status, complaint = run([small_capture, "--out", out, "--iterations", 6, *BRIEF], capsys)
    assert status == 2 and "checkpoint.pt: cannot be written" in complaint.splitlines()[-1]
    monkeypatch.undo()
    status, _ = run([small_capture, "--out", out, "--iterations", 6, *BRIEF, "--resume"], capsys)
    assert status == 0
    assert results.read_log(out)[-1]["iteration"] == 6
