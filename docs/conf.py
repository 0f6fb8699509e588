"""Sphinx's settings: `make docs`. Docstrings, `--help` and CONTRIBUTING.md are shown from where they are written."""

import builtins
import contextlib
import dataclasses
import importlib
import inspect
import io
import os
import pkgutil
import sys
import textwrap
from pathlib import Path
from typing import Annotated, TypeVar, get_args, get_origin

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ["COLUMNS"] = "100"  # of the commands' help

from docutils import nodes
from sphinx import addnodes
from sphinx.ext.napoleon import Config, GoogleDocstring
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import find_pending_xref_condition, make_refnode

import mi_ring
from mi_ring import image_fields, image_headers
from mi_ring.__main__ import COMMANDS, summary
from mi_ring.importers.formats import FORMATS
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.transforms import Transforms

project, author = "mi_ring", "the authors of mi_ring"
extensions = ["sphinx.ext.autodoc", "myst_parser", "sphinx_design"]
html_theme, html_title, html_static_path, html_css_files = "furo", "mi_ring", ["static"], ["mi_ring.css"]
html_show_copyright = html_copy_source = False
pygments_style = "friendly"
smartquotes = False  # "--" is how options begin
myst_heading_anchors = 3

# `name` in a docstring is a link where there is something of that name, else just code.
default_role = "py:obj"
nitpicky = True
nitpick_ignore_regex = [
    ("py:obj", ".*"),
    ("py:.*", r"(?!mi_ring\.).*"),  # types of other packages
]
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
toc_object_entries = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100

#: Where the names of the public API come from.
PUBLIC = {name: f"mi_ring.{module}.{name}" for name, module in mi_ring._API.items()}

#: Classes by the names of the plugins, whose pages are reference/plugins/<name>.rst.
PLUGINS = {
    "photograph": "mi_ring.plugins.photograph.Photograph",
    "flash": "mi_ring.plugins.flash.Flash",
    "room": "mi_ring.plugins.room.Room",
    "shapenet": "mi_ring.plugins.shapenet.ShapeNetMesh",
    "table": "mi_ring.plugins.table.Table",
    "cooktorrance": "mi_ring.plugins.cooktorrance.CookTorrance",
    "merl": "mi_ring.plugins.merl.Merl",
    "fine_attribute": "mi_ring.plugins.fine_attribute.FineAttribute",
    "photometric": "mi_ring.plugins.photometric.Photometric",
}


class Plugin(SphinxDirective):
    """`.. plugin:: shapenet`: the docstring of the plugin's class."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        path = PLUGINS[self.arguments[0]]
        module, name = path.rsplit(".", 1)
        plugin = getattr(importlib.import_module(module), name)
        self.env.note_dependency(inspect.getsourcefile(plugin))
        place = nodes.target("", "", ids=[path])
        self.env.domains.python_domain.note_object(path, "class", path, location=place)
        text = f"{inspect.getdoc(plugin)}\n\nIn Python the class `{path}`.\n"
        return [place, *self.parse_text_to_nodes(text)]


class Commands(SphinxDirective):
    """`.. commands::`: of every command what its `--help` prints."""

    def run(self) -> list[nodes.Node]:
        text = ""
        for command in COMMANDS:
            usage, sentence = summary(command)
            self.env.note_dependency(inspect.getsourcefile(importlib.import_module(f"mi_ring.{command}")))
            text += f"{title(f'``{usage}``', '-')}{sentence}.\n\n{literal(HELP[command,])}"
            if command == "convert":
                for name in FORMATS:
                    text += f"{title(f'``mi-ring convert {name}``', '~')}{literal(HELP[command, name])}"
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class Formats(SphinxDirective):
    """`.. formats::`: which image files are read, and the cameras of which tools."""

    def run(self) -> list[nodes.Node]:
        self.env.note_dependency(inspect.getsourcefile(image_headers))
        rows = [["image files", "suffixes"]]
        rows += [[kind, names(suffixes)] for kind, suffixes in image_headers.BY_KIND.items()]
        options = {"``--images``": "images", "``--masks``": "masks", "``--flash-offset``": "flash_offset"}
        cameras = [["cameras", "``convert``", "``photos`` finds them beside photographs", *options]]
        for name, source in FORMATS.items():
            known = {field.name for field in dataclasses.fields(source)}
            found = issubclass(source, (Photogrammetry, Transforms))
            marks = ["yes" if own else "no" for own in (True, found, *(field in known for field in options.values()))]
            cameras.append([f"``{name}``", *marks])
        return self.parse_text_to_nodes(table(rows) + table(cameras))


class Fields(SphinxDirective):
    """`.. fields::`: the fields of all formats, and what is done with them."""

    def run(self) -> list[nodes.Node]:
        tables = {f"``convert {name}``": source.fields for name, source in FORMATS.items()} | image_fields.FIELDS
        self.env.note_reread()
        text = ""
        for name, fields in tables.items():
            rows = [["fields", "", "meaning, or why"]]
            rows += [[names(own.split()), kind, why] for own, kind, why in fields.rows()]
            text += title(name, "-") + table(rows)
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class Modules(SphinxDirective):
    """`.. modules:: nets.shapenet errors`: what these modules of the package offer, each under a heading."""

    required_arguments, final_argument_whitespace = 1, True

    def run(self) -> list[nodes.Node]:
        text = ""
        for name in self.arguments[0].split():
            text += f"{title(f'``mi_ring.{name}``', '~')}.. automodule:: mi_ring.{name}\n   :members:\n\n"
            if public := [public for public, path in PUBLIC.items() if path.rpartition(".")[0] == f"mi_ring.{name}"]:
                names = ", ".join(f"`mi_ring.{name}`" for name in public)
                text += f"The public API, at the top of this page, has from here: {names}.\n\n"
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class Rooms(SphinxDirective):
    """`.. rooms::`: of each room what it is, by its docstring, and all its modules."""

    def run(self) -> list[nodes.Node]:
        self.env.note_reread()  # a module may have come
        text = ""
        for name in sorted(module.name for module in pkgutil.iter_modules(mi_ring.__path__) if module.ispkg):
            room = importlib.import_module(f"mi_ring.{name}")
            self.env.note_dependency(inspect.getsourcefile(room))
            about = inspect.getdoc(room).split("May import")[0]
            text += f"{title(f'``mi_ring.{name}``', '-')}{about}\n\n.. modules:: {' '.join(modules_of(room))}\n\n"
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def modules_of(package) -> list[str]:
    """The names of the modules in a package and in its packages, without `mi_ring.`"""
    found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    return sorted(module.name.partition(".")[2] for module in found if not module.ispkg)


def title(text: str, line: str) -> str:
    """A heading."""
    return f"{text}\n{line * len(text)}\n\n"


def names(words) -> str:
    """Words as code."""
    return " ".join(f"``{word}``" for word in words)


def table(rows: list[list[str]]) -> str:
    """A table, whose first row is its head."""
    lines = [".. list-table::", "   :header-rows: 1", ""]
    for row in rows:
        lines += [f"   {'*' if k == 0 else ' '} - {cell}" for k, cell in enumerate(row)]
    return "\n".join([*lines, "", ""])


def literal(text: str) -> str:
    """A block of plain text."""
    return ".. code-block:: text\n\n" + textwrap.indent(text, "   ") + "\n\n"


def help_of(command: str, *arguments: str) -> str:
    """What a command prints when it is asked for all its help, in lines of at most 100 characters."""
    asked = "--help-all" if command == "fit" else "--help"
    page = io.StringIO()
    with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit):
        importlib.import_module(f"mi_ring.{command}").main([*arguments, asked])
    lines = (textwrap.wrap(line, 100) or [""] if line[:1].isalpha() else [line] for line in page.getvalue().split("\n"))
    return "\n".join(line for wrapped in lines for line in wrapped).strip()


#: Of each command and of each format of `convert`.
HELP = {words: help_of(*words) for words in [(c,) for c in COMMANDS] + [("convert", name) for name in FORMATS]}


def plain(function) -> None:
    """Take from annotations what only the command line needs. It has been asked for its help by now."""
    bare = {name: get_args(a)[0] if get_origin(a) is Annotated else a for name, a in function.__annotations__.items()}
    function.__annotations__ = bare


def signature(app, what, name, documented, options, arguments, returned):
    """Where defaults are made anew the fields, below, say more than the arguments."""
    return ("", None) if "<factory>" in (arguments or "") else None


def skip(app, what, name, documented, skipped, options):
    """Plugins have pages of their own, and the public API has a section of its own."""
    if what == "module" and getattr(mi_ring, name, None) is documented and name in PUBLIC:
        return True
    path = f"{getattr(documented, '__module__', '')}.{getattr(documented, '__qualname__', '')}"
    return True if path in PLUGINS.values() else None


def clean(app, what, name, documented, options, lines):
    """What a NamedTuple says of its fields by itself is of no use; functions may have sections as Google's do."""
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()
    if what in ("function", "method"):
        lines[:] = GoogleDocstring(lines, Config(), app, what, name, documented, options).lines()


def link(app, env, node, content):
    """The name of a plugin, in single backticks, is a link to its page; one of the public API to what is said there."""
    here, target = node["refdoc"], node["reftarget"]
    if node["reftype"] == "obj" and target in PLUGINS and here != f"reference/plugins/{target}":
        return make_refnode(app.builder, here, f"reference/plugins/{target}", None, content)
    name = target.rpartition(".")[2]
    if target in (name, PUBLIC.get(name)) and name in PUBLIC:
        return make_refnode(app.builder, here, "reference/api", f"mi_ring.{name}", content)
    module = sys.modules.get(target.rpartition(".")[0])
    return content if isinstance(getattr(module, name, None), TypeVar) else None  # which are described nowhere


def leave_builtins(app, doctree):
    """`object` in a signature is Python's, also if a field somewhere has that name."""
    for node in list(doctree.findall(addnodes.pending_xref)):
        if node.get("reftarget") in vars(builtins):
            node.replace_self((find_pending_xref_condition(node, "resolved") or node).children)


def setup(app):
    """What Sphinx calls."""
    for name in modules_of(mi_ring):
        module = importlib.import_module(f"mi_ring.{name}")
        for found in list(vars(module).values()):
            if dataclasses.is_dataclass(found) and getattr(found, "__module__", "") == module.__name__:
                plain(found)
                plain(found.__init__)
    app.add_directive("plugin", Plugin)
    app.add_directive("commands", Commands)
    app.add_directive("formats", Formats)
    app.add_directive("fields", Fields)
    app.add_directive("modules", Modules)
    app.add_directive("rooms", Rooms)
    app.connect("autodoc-process-signature", signature)
    app.connect("autodoc-skip-member", skip)
    app.connect("autodoc-process-docstring", clean)
    app.connect("missing-reference", link)
    app.connect("doctree-read", leave_builtins)
    return {"parallel_read_safe": True}
