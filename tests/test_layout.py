"""The import arrows of the layout: networks know nothing of rendering, plugins nothing of training."""

import ast
from pathlib import Path

import pytest

import mi_ring
from mi_ring.__main__ import COMMANDS

PACKAGE = Path(mi_ring.__file__).parent
NETWORKS = {"encoding", "mlp", "shapenet", "brdfnet"}
PLUGINS = {"photograph", "bsdf", "mesh", "integrator", "edges", "indirect"}
RESULTS = {"results", "report", "atlas", "gltf", "material"}
TRAINING = {"losses", "config", "command", "capture", "bridge"} | RESULTS | set(COMMANDS)


def imports(module: str) -> set[str]:
    """Top-level names of foreign packages and bare names of our own modules that a module imports."""
    found = set()
    for node in ast.walk(ast.parse((PACKAGE / f"{module}.py").read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.removeprefix("mi_ring.").split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.module == "mi_ring":
                found |= {alias.name for alias in node.names}
            else:
                found.add(node.module.removeprefix("mi_ring.").split(".")[0])
    return found


MODULES = sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__")


@pytest.mark.parametrize("module", sorted(NETWORKS | {"ring", "domain", "losses"}))
def test_networks_and_losses_know_nothing_of_rendering(module):
    assert not imports(module) & ({"mitsuba", "drjit"} | PLUGINS | {"bridge", "capture"})


@pytest.mark.parametrize("module", sorted(PLUGINS))
def test_plugins_know_nothing_of_training(module):
    assert not imports(module) & TRAINING


@pytest.mark.parametrize("module", sorted(PLUGINS - {"mesh"}))
def test_only_the_mesh_plugin_knows_torch(module):
    assert not imports(module) & (NETWORKS | {"torch", "ring"})


def test_the_bridge_is_the_only_seam():
    both = [m for m in MODULES if {"torch", "drjit"} <= imports(m)]
    assert set(both) == {"bridge", "fit"}  # fit sets the number of threads of both


def test_the_package_itself_does_not_import_the_command():
    assert not imports("__init__") & set(COMMANDS)  # `python -m mi_ring.fit` would warn
