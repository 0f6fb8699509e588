"""Reads and makes the content of `ring.pt`, the file of a fitted object. It stores the registered names of networks."""

import io
import math
import re
import zipfile
from pathlib import Path

import numpy as np
import torch
import trimesh

from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.nets import resnet  # noqa: F401  (registers it)
from mi_ring.nets.registry import architecture_of, build
from mi_ring.objects import detail, sharpened_material  # noqa: F401  (registers it)
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.system.files import is_sealed
from mi_ring.version import __version__

FORMAT = 4  #: version of the file format
MAX_LEVEL, MAX_STEPS = 8, 10_000  #: of the mesh; Euler steps
ADVICE = "give the results folder of a fit, or its ring.pt"
DETAILS = "detailed-flow", "detailed-material", "sharpened-material"  #: networks that add a grid to another network
TEXTURED = (
    "sharpened-material",
    "detailed-material",
)  #: outer and inner network: the only pair of these that may be nested


def ring_state(ring: FittedObject, config: dict | None = None) -> dict:
    """Make the content of `ring.pt`, a dict, from a fitted object. Writes no file.

    `config`: settings of the fit, if known. Raises ValueError if a network is not registered.
    """
    domain = None
    if not isinstance(ring.domain, Sphere):  # as tensors: torch loads no numpy arrays with `weights_only`
        domain = {"points": torch.tensor(ring.domain.points), "faces": torch.tensor(ring.domain.faces)}
    return {
        "format": FORMAT, "mi_ring": __version__, "networks": ring.state_dict(), "domain": domain,
        "shape_net": architecture_of(ring.shape_net), "brdf_net": architecture_of(ring.brdf_net),
        "bsdf": ring.bsdf, "indirect": ring.indirect, "subdivisions": ring.subdivisions, "config": config or {},
        "up": ring.up, "metres": ring.metres,
    }  # fmt: skip


def compact(state: dict) -> dict:
    """Return a copy of a result of `ring_state` in which details have 16 bits. Their rounding is below their noise."""
    networks = state["networks"].items()
    half = {name: value.half() for name, value in networks if re.search(r"\.grid\.values\.|\.directions\d", name)}
    return state | {"networks": state["networks"] | half}


def ring_of(state: dict) -> FittedObject:
    """Make a fitted object from the content of `ring.pt`, a dict.

    Raises InputError if a network is not registered, and for settings of older versions that were removed. Raises
    KeyError, RuntimeError, TypeError or ValueError if the state is damaged.
    """
    refuse("material_at", state.get("material_at", "domain"), "domain")
    shape_net = state["shape_net"]
    if shape_net["name"] == "shapenet":
        arguments = dict(shape_net["arguments"])
        refuse("solver", arguments.pop("solver", "euler"), "euler")
        shape_net = {**shape_net, "arguments": arguments}
    for tensor in [*state["networks"].values(), *(state["domain"] or {}).values()]:
        if isinstance(tensor, torch.Tensor):  # `expand` makes a few numbers look like many, which would be allocated
            require(tensor.nbytes <= tensor.untyped_storage().nbytes(), "a tensor repeats its numbers")
    domain = state["domain"] and Domain(state["domain"]["points"], state["domain"]["faces"])
    for name in ("shape_net", "brdf_net"):
        require_grids(state["networks"], name, state[name])
    material = state["brdf_net"]
    while "net" in material["arguments"]:  # without details and texture
        material = material["arguments"]["net"]
    for parameter in material["arguments"].get("parameters", ()):
        require(parameter[1] in (1, 3), f"{parameter[0]} has {parameter[1]} channels")
    ring = FittedObject(
        torch.zeros(3), 1.0, domain=domain, bsdf=state["bsdf"], indirect=state["indirect"],
        subdivisions=state["subdivisions"], networks=(build(shape_net), build(state["brdf_net"])),
        ground=state["networks"].get("ground"), up=state.get("up"), metres=state.get("metres"),
    )  # fmt: skip
    ring.load_state_dict(state["networks"])
    for name, value in [*ring.named_parameters(), *ring.named_buffers()]:
        found = state["networks"].get(name, value)  # some buffers are not in the file
        require(found.is_floating_point() == value.is_floating_point(), f"{name} has numbers of another kind")
    require_valid(ring)
    return ring


def refuse(name: str, found: object, supported: str) -> None:
    """Raise InputError if a setting of an older version has a value that this version does not support.

    `name`: the setting. `found`: its value. `supported`: the only value that is allowed.
    """
    if found != supported:
        raise InputError(f"{name}: is {found}, only {supported} is supported; fit again, or use the version of mi_ring "
                         "that wrote this file")  # fmt: skip


def require_grids(networks: dict, name: str, architecture: dict) -> None:
    """Raise ValueError if details have other sizes than their file says, or are details of others.

    So memory for wrong sizes is not allocated. `networks`: tensors of the file by name. `name`: "shape_net" or
    "brdf_net". `architecture`: its description.
    """
    kind, arguments = architecture["name"], architecture["arguments"]
    if kind not in DETAILS:
        return
    grid, inner = arguments["grid"], arguments["flow" if kind == "detailed-flow" else "net"]
    values = [value for key, value in networks.items() if key.startswith(f"{name}.grid.values.")]
    keys = [value for key, value in networks.items() if key.startswith(f"{name}.grid.keys")]
    found = [tuple(value.shape) for value in (*keys, *values)]
    stated = [(n,) for n in grid["nodes"]] + [(n, grid["channels"]) for n in grid["nodes"]]
    right = found == stated and min(grid["nodes"], default=0) > 0
    require(right, f"the details of {name} have other sizes than it says")
    require(inner["name"] not in DETAILS or (kind, inner["name"]) == TEXTURED, f"{name} has details of details")
    require_grids(networks, f"{name}.base", inner)


def require_valid(ring: FittedObject) -> None:
    """Raise ValueError if the object has a value that no fit produces, because its file is damaged or forged."""
    for name, value in [*ring.named_parameters(), *ring.named_buffers()]:
        require(bool(value.isfinite().all()), f"{name} is not finite")
    require(float(ring.radius) > 0, f"the radius is {float(ring.radius):.4g}")
    require(type(ring.subdivisions) is int and 0 <= ring.subdivisions <= MAX_LEVEL, f"level {ring.subdivisions}")
    steps = getattr(ring.shape_net, "steps", 1)
    require(type(steps) is int and 1 <= steps <= MAX_STEPS, f"{steps} steps")
    require(ring.metres is None or 0 < ring.metres < math.inf, f"a unit of {ring.metres} m")
    require(ring.ground is None or ring.ground.shape == (2, 3), "ground is no place and normal")
    require(ring.up is None or (len(ring.up) == 3 and all(map(math.isfinite, ring.up))), "up is no direction")
    require(isinstance(ring.bsdf, str), "the BSDF is no XML")
    points, faces = ring.domain.points, ring.domain.faces
    require(points.shape[1:] == faces.shape[1:] == (3,) and bool(np.isfinite(points).all()), "the domain is no mesh")
    require(len(faces) > 0 and faces.min() >= 0 and faces.max() < len(points), "the domain lacks vertices")
    closed = trimesh.Trimesh(points, faces, process=False, validate=False).is_watertight
    require(closed, "the domain is no closed surface")
    for grid in [part for part in ring.modules() if isinstance(part, detail.Grid)]:
        octaves = range(len(grid.cells))
        require(all(bool((grid.keys(k).diff() > 0).all()) for k in octaves), "details are not in order")
        if len(octaves) == 1:  # a texture has only what is seen
            continue
        for k in octaves[:2]:  # the coarsest cubes may be around all of the domain; the finest may miss some vertices
            inside = grid.octave_weights(torch.from_numpy(points), k)[0].sum(1) > 0.5
            require(bool(inside.float().mean() > 0.5), "details are elsewhere than the domain")
    for name, value in ring.named_buffers():
        if re.search(r"directions\d+$", name):
            require(bool((value.norm(dim=1) < 1.01).all()), f"{name} are longer than 1")


def require(condition: bool, otherwise: str) -> None:
    """Raise ValueError with the message `otherwise` if the condition is false."""
    if not condition:
        raise ValueError(otherwise)


def upgraded(state: dict) -> dict:
    """Convert the content of a `ring.pt` of format 3, which mi_ring 0.1 wrote, to the present format.

    Returns a new dict.
    """
    return state | {
        "format": FORMAT, "shape_net": {"name": "shapenet", "arguments": {"steps": state["steps"]}},
        "brdf_net": {"name": "brdfnet", "arguments": {"parameters": state["parameters"]}},
        "subdivisions": state["config"].get("subdivisions", 6),
    }  # fmt: skip


def read_state(path: Path, kind: str, advice: str) -> dict:
    """Read a file that mi_ring has written, such as ring.pt or a checkpoint. Returns its content, a dict.

    `kind`, `advice`: texts for messages: what the file should be, and what the user can do. Raises InputError if the
    file is missing, damaged or of another kind. Damage is found by the checksum of the file. Files of mi_ring 0.1 have
    only the checksums of the zip format.
    """
    try:
        content = path.read_bytes()
        intact = is_sealed(content)
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        if isinstance(state, dict) and state.pop("sealed", False) and not intact:
            raise ValueError("the checksum is wrong")
        if not intact:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                if damaged := archive.testzip():
                    raise ValueError(f"{damaged} is damaged")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {advice}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {advice}") from error
    except Exception as error:  # torch raises errors of many kinds for other files
        # Torch's message is left out: it advises an unsafe way to load the file.
        raise InputError(f"{path}: not {kind}, or damaged; {advice}") from error
    if not isinstance(state, dict):
        raise InputError(f"{path}: not {kind} (holds a {type(state).__name__}); {advice}")
    return state


def load_fit(path: str | Path) -> FittedObject:
    """Load the object of a fit. `path`: the results folder of the fit, or its `ring.pt`.

    Raises InputError if there is no such file, if it is damaged, if this version of mi_ring cannot read its format, or
    if its networks are not registered.
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
        return ring_of(upgraded(state) if version == 3 else state)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: damaged, or its networks do not match their names ({error!r})") from error
