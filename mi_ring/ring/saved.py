"""`ring.pt`: a reconstructed object as a file, its networks by their registered names."""

import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.nets.registry import architecture_of, build
from mi_ring.ring.ring import Ring
from mi_ring.system.files import is_sealed
from mi_ring.version import __version__

FORMAT = 4  #: version of the file
ADVICE = "give the results folder of a fit, or its ring.pt"


def ring_state(ring: Ring, config: dict | None = None) -> dict:
    """What `ring.pt` holds, to be written by `torch.save`. Raises ValueError for networks that are not registered."""
    domain = None
    if not isinstance(ring.domain, Sphere):  # as tensors: numpy arrays are not among what torch loads safely
        domain = {"points": torch.tensor(ring.domain.points), "faces": torch.tensor(ring.domain.faces)}
    return {
        "format": FORMAT, "mi_ring": __version__, "networks": ring.state_dict(), "domain": domain,
        "shape_net": architecture_of(ring.shape_net), "brdf_net": architecture_of(ring.brdf_net),
        "bsdf": ring.bsdf, "indirect": ring.indirect, "subdivisions": ring.subdivisions, "config": config or {},
        "up": ring.up, "metres": ring.metres,
    }  # fmt: skip


def ring_of(state: dict) -> Ring:
    """The inverse of `ring_state`. Raises InputError for networks that are not registered here."""
    domain = state["domain"] and Domain(state["domain"]["points"], state["domain"]["faces"])
    ring = Ring(
        torch.zeros(3), 1.0, domain=domain, bsdf=state["bsdf"], indirect=state["indirect"],
        subdivisions=state["subdivisions"], networks=(build(state["shape_net"]), build(state["brdf_net"])),
        ground=state["networks"].get("ground"), up=state.get("up"), metres=state.get("metres"),
    )  # fmt: skip
    ring.load_state_dict(state["networks"])
    return ring


def migrated(state: dict) -> dict:
    """The state of a file of format 3, which mi_ring 0.1 wrote, as of today."""
    return state | {
        "format": FORMAT, "shape_net": {"name": "shapenet", "arguments": {"steps": state["steps"]}},
        "brdf_net": {"name": "brdfnet", "arguments": {"parameters": state["parameters"]}},
        "subdivisions": state["config"].get("subdivisions", 6),
    }  # fmt: skip


def read_state(path: Path, kind: str, advice: str) -> dict:
    """What `write_state` wrote. Raises InputError if there is no such file, if it is damaged or not of this `kind`.

    Files of before had no seal; they have but the checks of zip files.
    """
    try:
        content = path.read_bytes()
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        if not is_sealed(content):
            require_unsealed(content, state)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {advice}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {advice}") from error
    except Exception as error:  # what torch makes of other bytes is of any kind
        # Its words are advice to load files that may run anything.
        raise InputError(f"{path}: not {kind}, or damaged; {advice}") from error
    if not isinstance(state, dict):
        raise InputError(f"{path}: not {kind} (holds a {type(state).__name__}); {advice}")
    return state


def require_unsealed(content: bytes, state: Any) -> None:
    """Raise ValueError unless this is a whole file of the time before there were seals."""
    if isinstance(state, dict) and state.get("sealed"):
        raise ValueError("the seal is broken")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if damaged := archive.testzip():
            raise ValueError(f"{damaged} is damaged")


def load_fit(path: str | Path) -> Ring:
    """The object of a fit: from its results folder, or from a `ring.pt`.

    Raises InputError if there is none, if it was written by a newer mi_ring or by one that is too old, and if its
    networks are not registered here.
    """
    path = Path(path)
    path = path / "ring.pt" if path.is_dir() else path
    state = read_state(path, "a saved fit", ADVICE)
    if "format" not in state or "networks" not in state:
        raise InputError(f"{path}: not a saved fit; {ADVICE}")
    version = state["format"]
    if version not in (3, FORMAT):
        raise InputError(f"{path}: format version {version}, of mi_ring {state.get('mi_ring', '0.1 or older')}; this "
                         f"one, {__version__}, reads versions 3 and {FORMAT}")  # fmt: skip
    try:
        return ring_of(migrated(state) if version == 3 else state)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (KeyError, TypeError, RuntimeError) as error:
        raise InputError(f"{path}: damaged, or of other networks than it says ({error!r})") from error
