"""The notebooks run in order, as a reader would run them, but on an eighth of the photographs and for a moment."""

import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import nbformat
import numpy as np
import pytest
import trimesh
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbclient.util import run_sync

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "notebooks").glob("*.ipynb"))

#: What takes the place of each notebook's own parameters. View 2 of these is photograph 016.
SMALL = ["--iterations", "4", "--levels", "3", "--widths", "32", "--shares", "1", "--subdivisions", "3",
         "--refine", "none", "--no-indirect"]  # fmt: skip
SMALL_SETTINGS = {"iterations": 4, "levels": (3,), "widths": (32,), "shares": (1.0,), "subdivisions": 3,
                  "refine": ("none",), "indirect": False}  # fmt: skip
OWN = {"domain": "sphere", "shadows": False}  #: those of notebook 5
QUICK = {
    "1_first_fit": {"options": SMALL, "view": 2, "spp": 4},
    "2_plugins": {"size": 40, "spp": 4},
    "3_read_a_run": {"view": 2, "spp": 4},
    "4_relight_and_swap": {
        "settings": SMALL_SETTINGS,
        "size": 40, "spp": 4, "texels": 64, "turntable": 3,
    },
    "5_own_parts": {"settings": OWN | SMALL_SETTINGS, "every": 3, "view": 2},
}  # fmt: skip


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_notebook_is_stripped_and_portable(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    assert notebook.cells[0].cell_type == "markdown" and notebook.cells[0].source.startswith("# ")
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(code) <= 10
    assert [cell for cell in code if cell.outputs or cell.execution_count is not None] == []
    assert [k for k, cell in enumerate(code) if "parameters" in cell.metadata.get("tags", ())] == [0]
    assert not re.search(r"""["'(\s](/|~/|[A-Za-z]:\\)\w""", "\n".join(cell.source for cell in notebook.cells))
    before = "\n".join(cell.source for cell in code).partition("import mitsuba")[0]
    assert re.search(r"^(import|from) mi_ring\b", before, re.M)  # which chooses LLVM


def test_notebooks_are_all_run():
    assert [path.stem for path in FILES] == list(QUICK)


def copy(folder: Path) -> None:
    """The notebooks and what they need, with every eighth photograph of the pot."""
    shutil.copytree(ROOT / "notebooks", folder / "notebooks", ignore=shutil.ignore_patterns("out", ".*"))
    shutil.copytree(ROOT / "scenes" / "pot2", folder / "scenes" / "pot2")
    tree = ElementTree.parse(ROOT / "scenes" / "pot2.xml")
    for k, sensor in enumerate(tree.getroot().findall("sensor")):
        if k % 8:
            tree.getroot().remove(sensor)
    tree.write(folder / "scenes" / "pot2.xml")


@pytest.fixture
def kernel():
    """One for all notebooks, which spares each the imports. Each begins without the names of those before."""
    manager = AsyncKernelManager(kernel_name="python3")
    yield manager
    run_sync(manager.shutdown_kernel)(now=True)


def execute(folder: Path, name: str, kernel: AsyncKernelManager):
    """Run a notebook in its folder, and return it with its outputs. Fails with the cell that fails, and why."""
    notebook = nbformat.read(folder / "notebooks" / f"{name}.ipynb", as_version=4)
    place = 1 + next(k for k, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", ()))
    override = "\n".join(f"{key} = {value!r}" for key, value in QUICK[name].items())
    notebook.cells.insert(place, nbformat.v4.new_code_cell(override))
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))
    where = {"metadata": {"path": str(folder / "notebooks")}}
    try:
        NotebookClient(notebook, kernel, timeout=300, resources=where).execute()
    except CellExecutionError as error:
        failed = next(c for c in notebook.cells if any(o.output_type == "error" for o in c.get("outputs", ())))
        message = f"{name}: {error.ename}: {error.evalue}\n\nin the cell\n\n{failed.source}"
        raise AssertionError(message) from None
    return notebook


def printed(notebook) -> str:
    """All that the cells wrote to standard output."""
    return "".join(o.text for c in notebook.cells for o in c.get("outputs", ()) if o.get("name") == "stdout")


def pictures(notebook) -> int:
    """How many pictures the notebook shows."""
    return sum("image/png" in o.get("data", ()) for c in notebook.cells for o in c.get("outputs", ()))


@pytest.mark.slow
def test_notebooks_run_in_order(tmp_path, kernel):
    copy(tmp_path)
    run = tmp_path / "out" / "first_fit"

    with pytest.raises(AssertionError, match="FileNotFoundError.*first_fit.*run notebook 1_first_fit first"):
        execute(tmp_path, "3_read_a_run", kernel)

    first = execute(tmp_path, "1_first_fit", kernel)
    assert "Masks: 4 of 4 photographs" in printed(first)
    assert pictures(first) == 3  # contact sheet, start, a photograph beside its prediction
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert len(evaluation["views"]) == 4
    assert evaluation["iou"] > 0.9  # the start is the visual hull already
    assert min(view["normal_mean"] for view in evaluation["views"]) > 1  # in so few iterations it cannot be right

    second = execute(tmp_path, "2_plugins", kernel)
    assert pictures(second) == 3
    means = dict(re.findall(r"^(\w+, \w+) +mean radiance ([\d.]+)$", printed(second), re.M))
    means = {title: float(mean) for title, mean in means.items()}
    assert means["direct, left"] > 0.01
    assert means["photometric, left"] == pytest.approx(means["direct, left"], rel=0.02)
    assert means["path, left"] > 1.02 * means["direct, left"]

    third = execute(tmp_path, "3_read_a_run", kernel)
    assert pictures(third) == 4  # the log, the flow, the material, the evaluation
    mesh = trimesh.load(run / "mesh.ply")
    assert f"{len(mesh.vertices)} vertices, watertight: True" in printed(third)
    volumes = [float(v) for v in re.findall(r"level \d: .* volume (\d+)", printed(third))]
    assert len(volumes) == 4 and volumes[0] == pytest.approx(mesh.volume, rel=1e-3)  # level 3 is that of the mesh

    execute(tmp_path, "4_relight_and_swap", kernel)
    exported = trimesh.load(run / "object.glb", force="mesh")
    assert np.allclose(exported.bounds, mesh.bounds, atol=0.01 * mesh.scale)
    assert exported.visual.material.baseColorTexture.size == (64, 64)
    assert (run.parent / "other_glaze" / "ring.pt").is_file()
    assert (run / "turntable.mp4").read_bytes()[4:8] == b"ftyp"

    fifth = execute(tmp_path, "5_own_parts", kernel)
    assert pictures(fifth) == 1 and "silhouettes" in printed(fifth)
    assert json.loads((run.parent / "own_parts" / "log.jsonl").read_text().splitlines()[-1])["silhouettes"] > 0
    assert {path.name for path in tmp_path.iterdir()} == {"notebooks", "scenes", "out"}
    assert {path.suffix for path in (tmp_path / "notebooks").iterdir()} == {".ipynb"}  # nothing is left beside them
