"""The documentation: it builds, and what it says of plugins and commands is what they are."""

import ast
import contextlib
import dataclasses
import html
import importlib
import inspect
import io
import math
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh

import mi_ring
from mi_ring import __main__
from mi_ring.importers.formats import FORMATS
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.plugins import cooktorrance, fine_attribute, flash, merl, photograph, photometric, room, shapenet, table
from mi_ring.rendering.measured_brdf import LAYERS

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(path.relative_to(ROOT / "docs") for path in (ROOT / "docs").glob("*/*.md"))  #: the four parts


def plugins():
    """By name; the modules are loaded anew with each variant, so that they must be asked each time."""
    return {
        "photograph": photograph.Photograph, "flash": flash.Flash, "room": room.Room, "shapenet": shapenet.ShapeNetMesh,
        "cooktorrance": cooktorrance.CookTorrance, "merl": merl.Merl, "table": table.Table,
        "photometric": photometric.Photometric, "fine_attribute": fine_attribute.FineAttribute,
    }  # fmt: skip


#: What Mitsuba's own base classes expose of every sensor and every mesh.
MITSUBAS = {"shutter_open", "shutter_open_time", "silhouette_sampling_weight", "vertex_texcoords"}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The built pages. A warning is an error."""
    for package in ("sphinx", "furo", "myst_parser", "sphinx_design"):
        pytest.importorskip(package, reason="needs the optional dependencies 'docs'")
    folder = tmp_path_factory.mktemp("docs")
    # Sphinx keeps all that it makes: to look for garbage in it takes a fifth of its time.
    code = "import gc, sys; gc.disable(); from sphinx.cmd.build import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", code, "-W", "--keep-going", "-q", "-d", folder / "cache", "docs", folder / "html"],
        capture_output=True, text=True, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "html"


def squeezed(text: str) -> str:
    """Without the space that lines are broken at."""
    return re.sub(r"\s", "", text)


def text_of(page: Path) -> str:
    """Of an HTML page what is read, squeezed."""
    return squeezed(html.unescape(re.sub(r"<(script|style).*?</\1>|<[^>]*>", "", page.read_text("utf-8"), flags=re.S)))


@pytest.mark.parametrize("name", plugins())
def test_every_plugin_has_its_page(built, name):
    text = text_of(built / "reference" / "plugins" / f"{name}.html")
    first = inspect.getdoc(plugins()[name]).split("\n")[0]
    assert squeezed(first.replace("`", "")) in text
    assert f"({name})" in text and f'"{name}"' in text  # the heading, a snippet


def test_every_command_has_its_help_on_the_page(built):
    text = text_of(built / "reference" / "commands.html")
    for name in __main__.COMMANDS:
        usage, sentence = __main__.summary(name)
        assert squeezed(usage) in text and squeezed(sentence.replace("`", "")) in text
        assert f"usage:mi_ring.{name}[-h]" in text
    assert all(f"usage:mi_ring.convert{name}[-h]" in text for name in FORMATS)
    assert "--laplacian-scaleFLOAT" in text


def test_all_modules_of_the_rooms_are_on_the_python_page(built):
    page = (built / "reference" / "api.html").read_text("utf-8")
    plugins = ROOT / "mi_ring" / "plugins"  # have pages of their own
    modules = [path for path in (ROOT / "mi_ring").glob("*/*.py") if path.stem != "__init__" and path.parent != plugins]
    for path in modules:
        assert f'id="module-mi_ring.{path.parent.name}.{path.stem}"' in page
    assert len(modules) > 50 and 'id="module-mi_ring.errors"' in page
    assert all(f'id="mi_ring.{name}"' in page for name in mi_ring._API)


def test_the_first_page_leads_to_all_pages(built):
    page = (built / "index.html").read_text("utf-8")
    assert all(f'href="{name.with_suffix(".html").as_posix()}"' in page for name in DOCUMENTS)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", *(f"docs/{name.as_posix()}" for name in DOCUMENTS)])
def test_links_of_a_page_lead_somewhere(page):
    """On the web pages of the repository, too: files, pictures, and headings of pages."""
    for link in re.findall(r"\]\(([^)\s]+)\)", (ROOT / page).read_text("utf-8")):
        name, _, heading = link.partition("#")
        if "://" in link or not name:
            continue
        file = (ROOT / page).parent / name
        assert file.exists(), link
        headings = re.findall(r"^#+ (.*)$", file.read_text("utf-8"), re.M) if heading else []
        assert not heading or heading in {slug(text) for text in headings}, link


def slug(heading: str) -> str:
    """The anchor of a heading."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def count_words(*files: Path) -> int:
    """Words by hand: without blocks of code, which other tests run."""
    return sum(len(re.sub(r"```.*?```", "", file.read_text("utf-8"), flags=re.DOTALL).split()) for file in files)


def test_the_documentation_is_short():
    """What nobody reads is not written: words by hand, in README, CONTRIBUTING and the four parts."""
    assert count_words(ROOT / "README.md") <= 700
    assert count_words(ROOT / "CONTRIBUTING.md") <= 800
    assert (
        count_words(ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs" / name for name in DOCUMENTS))
        <= 15_000
    )


def options_of_commands() -> set[str]:
    """All options of all commands."""
    pages = [help_of(*words) for words in [("convert",), *PAGES]]
    found = re.findall(r"--[a-z][\w.-]*", re.sub("[│╭╮╰╯─]", " ", "".join(pages)))
    return {*found, "--version", "--traceback", "--help-all"}


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{part}" for part in ("tutorial", "how-to", "reference"))])
def test_options_on_the_pages_are_those_of_the_commands(page):
    files = [ROOT / page] if page.endswith(".md") else sorted((ROOT / page).glob("*.md"))
    lines = [line for file in files for line in file.read_text("utf-8").split("\n")]
    ours = [line for line in lines if not any(name in line for name in ("benchmarks/", "torchrun", "rdzv"))]
    named = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*", "\n".join(ours)))
    assert named - options_of_commands() == set()


def test_the_readme_gives_gradients_to_both_networks():
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    for integrator in ("photometric", "direct"):
        small = block.replace('"subdivisions": 4', '"subdivisions": 2').replace("sample(4)", "sample(2)")
        names = {}
        exec(small.replace('"photometric"', f'"{integrator}"'), names)
        for net in (names["ring"].shape_net, names["ring"].brdf_net):
            norm = sum(float(p.grad.norm()) for p in net.parameters() if p.grad is not None)
            assert math.isfinite(norm) and norm > 0


def test_the_python_of_the_pages_runs(small_capture, tmp_path, monkeypatch):
    """Block by block, as somebody would who reads the tutorial, then how to extend a fit, then about gradients."""
    monkeypatch.chdir(tmp_path)
    quick = "iterations=1, levels=(2,), widths=(28,), shares=(1,), subdivisions=2, domain='sphere', "
    quick += "refine=('none',), indirect=False"
    changed = {
        "scenes/pot2.xml": str(small_capture), 'preset("fast"': f'preset("fast", {quick}', "spp=64": "spp=1",
        "spp=16": "spp=1", '"subdivisions": 6': '"subdivisions": 2', "sample(5)": "sample(2)",
        "picture)\n": "picture, write_async=False)\n", '"out/mine': f'"{tmp_path}/out/mine',
    }  # fmt: skip
    names = {}
    for page in ("tutorial/python.md", "how-to/extend.md", "background/gradients.md"):
        for block in re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text("utf-8"), re.DOTALL):
            for old, new in changed.items():
                block = block.replace(old, new)
            exec(block, names)
    assert (tmp_path / "out/mine/mesh.ply").is_file() and (tmp_path / "out/pot.png").is_file()
    assert np.array(names["scene"].bbox().extents()).max() > 0 and names["jacobian"].shape[1:] == (3, 3)
    assert np.abs(np.array(names["dr"].grad(names["params"]["007.to_world"]).matrix)).max() > 0


def tables(plugin) -> dict[str, list[tuple[str, str, str, str]]]:
    """The tables of a docstring, rows of four cells, by the first cell of the heading."""
    found = {}
    for paragraph in re.split(r"\n\n", inspect.getdoc(plugin)):
        lines = paragraph.split("\n")
        if not lines[0].startswith("==="):
            continue
        starts = [m.start() for m in re.finditer("=+", lines[0])]
        ends = [*starts[1:], None]
        cells = [[line[a:b].strip() for a, b in zip(starts, ends)] for line in lines if not line.startswith("=")]
        rows = []
        for row in cells:
            if row[0]:
                rows.append(row)
            else:
                rows[-1] = [f"{a} {b}".strip() for a, b in zip(rows[-1], row)]
        found[rows[0][0]] = rows[1:]
    return found


def names(cell: str) -> list[str]:
    return re.findall("``(.*?)``", cell)


def save_networks(path: Path, material: str) -> None:
    np.savez(path, names=[material], **{name: np.zeros((1, *shape)) for name, shape in LAYERS.items()})


@pytest.fixture
def values(tmp_path):
    """Of each plugin a value for each parameter, none of them the default; what must not be together is apart."""
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.ply")
    ring = FittedObject(torch.tensor([1.0, -2.0, 3.0]), 1.5)
    torch.save(ring_state(ring), tmp_path / "ring.pt")
    networks = tmp_path / "networks.npz"
    save_networks(networks, "one")
    moved = mi.ScalarTransform4f().translate([3, -1, 2])
    film = {"type": "hdrfilm", "width": 7, "height": 5}
    light = {"type": "point", "position": [1, 2, 3], "intensity": {"type": "rgb", "value": [4, 5, 6]}}
    grey = {"type": "rgb", "value": [0.1, 0.2, 0.3]}
    return {
        "photograph": [{
            "filename": "a.png", "mask": "b.png", "valid": "c.png", "ambient": "d.png",
            "fx": 11.0, "fy": 12.0, "cx": 2.0, "cy": 3.0, "to_world": moved,
            "encoding": "linear", "saturation": 0.9, "gamma": 1.1, "contrast": 1.2, "toe": 0.1,
            "vignetting": 2.0, "gain": "1 2 0.5", "distortion": -0.01, "falloff": 3.0, "tilt": "0.5 -1",
            "calibrated": True, "film": film, "emitter": light,
        }],
        "flash": [{}],
        "room": [{"harmonics": " ".join(["0.1"] * 27), "frame": "camera", "lobes": "0 3 4 50 1 2 3"}],
        "shapenet": [
            {"weights": str(tmp_path / "ring.pt"), "subdivisions": 1, "to_world": moved, "flash": False},
            {"domain": str(tmp_path / "ball.ply"), "center": [1, 2, 3], "radius": 2.0, "subdivisions": 1,
             "ground": [1, 1, 3], "up": [0, 2, 0], "metres": 0.01,
             "bsdf": {"type": "cooktorrance", "diffuse": grey, "specular": 0.2, "roughness": 0.4}},
        ],
        "cooktorrance": [{"diffuse": grey, "specular": 0.2, "roughness": 0.4, "diffuse_roughness": 0.1,
                          "distribution": "beckmann", "fresnel": True, "coat": 0.1, "coat_roughness": 0.2}],
        "merl": [{"filename": str(networks), "material": "one"}],
        "table": [{"to_world": moved, "bsdf": {"type": "diffuse", "reflectance": grey}}],
        "photometric": [{"shadows": False}],
        "fine_attribute": [{"name": "vertex_colour", "scale": 2.0}],
    }  # fmt: skip


class Recorder(mi.Properties):
    """Properties that remember what they were asked for."""

    def __init__(self, name):
        super().__init__(name)
        self.asked = set()

    def get(self, name, *default):
        self.asked.add(name)
        return super().get(name, *default)

    def __getitem__(self, name):
        self.asked.add(name)
        return super().__getitem__(name)

    def __contains__(self, name):
        self.asked.add(name)
        return super().__contains__(name)


@pytest.mark.parametrize("name", plugins())
def test_documented_parameters_are_those_that_the_plugin_takes(name, values):
    plugin = plugins()[name]
    rows = tables(plugin).get("Parameter", [])
    documented = {parameter for row in rows for parameter in names(row[0])}
    nested = {row[1] for row in rows if row[0] == "(nested)"}
    given = set().union(*values[name])
    assert given == documented | nested
    for value in values[name]:  # Mitsuba raises for a property that nobody has asked for
        mi.load_dict({"type": name} | value)
    with pytest.raises(RuntimeError, match="nonsense"):
        mi.load_dict({"type": name, "nonsense": 1.0} | values[name][0])

    asked = set()
    for value in values[name]:
        props = Recorder(name)
        for key, v in value.items():
            props[key] = mi.load_dict(v) if isinstance(v, dict) else v
        plugin(props)
        asked |= props.asked
    if name == "photometric":  # what all of Mitsuba's differentiable integrators take, and this one does not use
        asked -= {"max_depth", "rr_depth"}
    assert asked - nested == documented


@pytest.mark.parametrize("name", ["photograph", "shapenet", "cooktorrance", "photometric"])
def test_flags_are_those_of_traverse(name, values):
    found = {}
    exposed = mi.traverse(mi.load_dict({"type": name} | values[name][-1]))
    for key in exposed.properties:
        first, flags = key.split(".")[0], exposed.flags(key)
        if first not in MITSUBAS:
            differentiable = not flags & mi.ParamFlags.NonDifferentiable.value
            discontinuous = bool(flags & mi.ParamFlags.Discontinuous.value)
            found.setdefault(first, {"P"}).update({"∂"} if differentiable else (), {"D"} if discontinuous else ())
    documented = {}
    for rows in tables(plugins()[name]).values():
        for first, _, description, flags in rows:
            if flags:
                as_what = re.search(r"exposed as\s+``(.*?)``", description)
                for key in [as_what[1]] if as_what else names(first):
                    documented[key] = set(flags.split(", "))
    assert documented == found


@pytest.mark.parametrize("name", plugins())
def test_snippets_load_and_say_the_same(name, tmp_path):
    torch.save(ring_state(FittedObject(torch.tensor([1.0, -2.0, 3.0]), 1.5)), tmp_path / "ring.pt")
    save_networks(tmp_path / "networks.npz", "gold-paint")
    blocks = {}
    for kind, block in re.findall(r"\.\. code-block:: (\w+)\n\n((?: {8}.*\n?|\n)+)", inspect.getdoc(plugins()[name])):
        blocks[kind] = re.sub(r"ring\.pt|networks\.npz", lambda m: str(tmp_path / m[0]), inspect.cleandoc(block))
    if name == "shapenet":  # the same, only faster
        blocks = {kind: re.sub(r"(subdivisions\W+(?:value=\W)?)6", r"\g<1>2", block) for kind, block in blocks.items()}
    element = ElementTree.fromstring(blocks["xml"])
    element.set("version", "3.0.0")
    by_xml = mi.load_string(ElementTree.tostring(element, "unicode"))
    by_dict = mi.load_dict(eval(blocks["python"], {"mi": mi}))
    assert type(by_xml) is type(by_dict) is plugins()[name]
    a, b = (dict(mi.traverse(plugin)) for plugin in (by_xml, by_dict))
    assert a.keys() == b.keys()
    for key in a:
        numbers = [np.array(v.matrix if hasattr(v, "matrix") else v, float).ravel() for v in (a[key], b[key])]
        assert numbers[0] == pytest.approx(numbers[1]), key


def help_of(name: str, *arguments: str) -> str:
    page, asked = io.StringIO(), "--help-all" if name == "fit" else "--help"
    with contextlib.redirect_stdout(page), pytest.raises(SystemExit) as stop:
        importlib.import_module(f"mi_ring.{name}").main([*arguments, asked])
    assert not stop.value.code
    return page.getvalue()


def config_of(name: str) -> type:
    """The dataclass that is the command line of a command."""
    module = importlib.import_module(f"mi_ring.{name}")
    (found,) = (c for key, c in vars(module).items() if key.lower() == f"{name}config")
    return found


PAGES = [(name,) for name in __main__.COMMANDS if name != "convert"] + [("convert", name) for name in FORMATS]


def descriptions(config: type) -> dict[str, str]:
    """What stands below each field of a dataclass, or of those that it is made of."""
    found = {}
    for base in reversed(config.__mro__[:-1]):
        body = ast.parse(inspect.getsource(base)).body[0].body
        for field, below in zip(body, body[1:]):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                found[field.target.id] = below.value.value
    return found


@pytest.mark.parametrize("words", PAGES, ids=" ".join)
def test_help_describes_every_field(words):
    config = FORMATS[words[1]] if words[1:] else config_of(words[0])
    text = squeezed(re.sub("[│╭╮╰╯─]", "", help_of(*words)))
    assert squeezed(inspect.getdoc(config)) in text
    described = descriptions(config)
    for field in dataclasses.fields(config):
        assert len(described[field.name].split()) > 1, field.name
        annotation = str(field.type)
        if "Suppress" in annotation:  # it is no option
            continue
        assert squeezed(described[field.name]) in text, field.name
        name = re.search("metavar='(.*?)'", annotation)[1] if "metavar" in annotation else f"--{field.name}"
        assert name.replace("_", "-") in text, field.name


def test_convert_lists_its_formats():
    text = help_of("convert")
    assert all(f"• {name} " in text or f"- {name} " in text for name in FORMATS)
    assert "scene file" in text.split("options")[0]


def test_the_program_says_what_each_command_does(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["mi-ring", "--help"])
    with pytest.raises(SystemExit) as stop:
        __main__.main()
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for name in __main__.COMMANDS:
        assert re.search(rf"^  mi-ring {name}( [A-Z]\S+.*)?\n      \S+ \S+", text, re.M), name


@pytest.mark.parametrize(
    "arguments, wrong", [([], "is missing"), (["fitt"], "is fitt; perhaps you meant fit; must be one of")]
)
def test_a_command_that_there_is_not_is_one_line(arguments, wrong, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["mi-ring", *arguments])
    with pytest.raises(SystemExit) as stop:
        __main__.main()
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert wrong in printed.err and printed.err.count("\n") == 1 and not printed.out
