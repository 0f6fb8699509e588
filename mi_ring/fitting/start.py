"""The start of a fit: its networks, its start surface and the normalising sphere; and checks of the input."""

import contextlib
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from mi_ring.capture.capture import Capture
from mi_ring.capture.reflectance import predicted_parameters
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.lighting import Lighting, require_lighting
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.refinement import Refinement
from mi_ring.geometry.domain import Domain, Sphere, closed_domain
from mi_ring.geometry.meshes import genus, load_closed_mesh
from mi_ring.nets.brdf_net import COAT, ROUGH, BRDFNet, MaterialNet
from mi_ring.nets.resnet import shape_net_of
from mi_ring.nets.shape_net import Flow
from mi_ring.objects.detail import DetailedFlow, DetailedMaterial
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_of
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.scene.assembly import has_table, lamps_of
from mi_ring.system.optional import installed

DISPROPORTIONATE = 20.0  #: ratio of size, or distance in radii, of start surface and normalising sphere: a mistake


def require_settings(capture: Capture, config: Config, lighting: Lighting | None) -> None:
    """Raise InputError if a setting contradicts the capture, or if an argument has another type."""
    for name, value, kind in (("capture", capture, Capture), ("config", config, Config)):
        if not isinstance(value, kind):
            raise InputError(f"{name}: is {type(value).__name__}, must be a mi_ring.{kind.__name__}")
    require_lighting(lighting)
    if not capture.images:
        raise InputError(f"{capture.path}: photographs: were not read; call load_capture without images=False")
    if {"curve", "contrast"} & set(config.refine) and any(shot.files.ambient for shot in capture.shots):
        raise InputError(f"{capture.path}: ambient: is subtracted by the curve that the scene says; leave out "
                         "--refine curve and contrast")  # fmt: skip
    if "masks" in config.refine and capture.threshold is not None:
        raise InputError(f"{capture.path}: --refine masks: they are those of a dark room, found by brightness; "
                         "leave it out, or give others")  # fmt: skip
    if "lamps" in config.refine and config.light != "lamps" and not lamps_of(capture.scene):
        raise InputError(f"{capture.path}: emitter: --refine lamps: the scene has none, point or directional, beside "
                         "the photographs' own lights; leave it out, or find them all by --light lamps")  # fmt: skip
    if config.lobes == "2" and (config.parameters or not hasattr(capture.shape.bsdf(), "lobes")):
        raise InputError(f"{capture.path}: --lobes 2: is for cooktorrance without --parameters; leave it out")


class StateError(InputError):
    """Error for a saved state that does not belong to the fit that is to continue from it."""


@contextlib.contextmanager
def restoring() -> Iterator[None]:
    """Context manager for reading the saved state of a fit.

    It turns errors that a wrong state causes into StateError.
    """
    try:
        yield
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise StateError("state: is of a fit with other settings, networks or photographs, or of none "
                         f"({error!r})") from error  # fmt: skip


def restored(state: dict[str, Any]) -> tuple[Lighting, FittedObject]:
    """Read (lighting, fitted object) from the saved state of a fit.

    Raises StateError if the state lacks one of them.
    """
    with restoring():
        return Lighting(*state["lighting"]), ring_of(state["ring"])


def starting_ring(problem: Problem, networks: tuple[Flow, MaterialNet] | None) -> FittedObject:
    """Make the object as it is before the first iteration. `networks`: (Shape-Net, BRDF-Net); None: those of the paper.

    Raises InputError if capture, settings and networks contradict each other.
    """
    capture, config = problem.seen, problem.config
    domain, center, radius = starting_surface(capture, config.domain)
    require_normalised(capture, domain, center, radius)
    require_view_from_outside(capture, domain, center, radius)
    rough = predicts(networks, ROUGH.name) if networks else config.diffuse == "rough"
    coat = predicts(networks, COAT[0].name) if networks else config.lobes == "2"
    parameters, bsdf = predicted_parameters(capture, config.parameters, rough, coat)
    if problem.lighting.kind != "capture":
        bsdf = with_fresnel(bsdf)
    reflectance, refined, power = refinement = Refinement.of(problem, center)
    bounded = all(math.isfinite(p.high) for p in parameters)
    if refinement.albedo >= 1 and bounded:
        raise InputError(f"{capture.path}: emitter: by the lights' intensities the object reflects "
                         f"{refinement.albedo:.3g} times the light that it gets, which the ranges of --parameters do "
                         "not reach; give the true intensities, or fit cooktorrance")  # fmt: skip
    if "scale" in refined and (bounded or not config.indirect):
        raise InputError(f"{capture.path}: --refine scale: what the power of the lights is tells interreflection "
                         "alone, and a reflectance without bounds; it goes neither with --no-indirect nor with "
                         "these --parameters")  # fmt: skip
    if "scale" in refined and has_table(capture.scene):
        raise InputError(f"{capture.path}: --refine scale: the scene has a table, whose reflectance tells how strong "
                         "the lights are; leave scale out, or remove the table")  # fmt: skip
    scale = reflectance / power
    indirect = config.indirect and math.pi * scale < 1
    if networks:
        if not (isinstance(networks, Sequence) and [isinstance(n, nn.Module) for n in networks] == [True, True]):
            raise InputError("networks: must be two instances of torch.nn.Module, (Shape-Net, BRDF-Net)")
        for network, needed in zip(networks, ("forward", "set_parameters"), strict=True):
            if not hasattr(network, needed):
                raise InputError(f"networks: {type(network).__name__}: has no {needed}; give (Shape-Net, BRDF-Net)")
        if isinstance(networks[0], DetailedFlow) or isinstance(networks[1], DetailedMaterial | SharpenedMaterial):
            raise InputError("networks: have details or a texture, which a fit adds itself; give the networks in them: "
                             "`base.network` of details, `base` of a texture")  # fmt: skip
        networks[1].set_parameters(parameters, scale)
    else:
        networks = (shape_net_of(config.shape_net, config.steps, config.encoding, config.frequencies),
                    BRDFNet(scale, parameters, config.encoding, config.frequencies))  # fmt: skip
    ring = FittedObject(center, radius, scale, domain, parameters, bsdf, indirect, config.steps, config.subdivisions,
                networks, capture.shape.ground, capture.shape.up, capture.shape.metres)  # fmt: skip
    require_networks(ring)
    return ring


def predicts(networks: object, name: str) -> bool:
    """Return True if the last of the given networks already predicts the BSDF parameter `name`."""
    last = networks[-1] if isinstance(networks, Sequence) else None
    return any(p.name == name for p in getattr(last, "bsdf_parameters", ()))


def with_fresnel(bsdf: str) -> str:
    """Switch on the Fresnel term of a BSDF `cooktorrance`, unless its XML says whether it is on.

    `bsdf`: the XML. Returns the changed XML. The term makes no difference for a flash at the camera. It makes one for
    light from other sides.
    """
    element = ElementTree.fromstring(bsdf)
    if element.find("boolean[@name='fresnel']") is None:
        ElementTree.SubElement(element, "boolean", name="fresnel", value="true")
    return ElementTree.tostring(element, "unicode")


def starting_surface(capture: Capture, choice: str | tuple[str, Path]) -> tuple[Domain, np.ndarray, float]:
    """Make the start surface of a fit. Returns (domain, centre (3,), radius) of the normalising sphere [scene units].

    `choice`: "auto", "hull", "sphere", or a tuple with the path of a mesh file. "auto" is the surface of the scene file
    if it has one, otherwise the visual hull or a sphere. Raises InputError if the surface cannot be made.
    """
    shape = capture.shape
    if isinstance(choice, tuple):
        return closed_domain(load_closed_mesh(choice[1], "--domain"), shape.center, shape.radius)
    if choice == "auto" and shape.domain:
        return shape.domain
    try:
        surface = capture.hull.surface() if choice != "sphere" and capture.whole and capture.hull else None
    except InputError:
        if choice == "hull" or shape.center is None or shape.radius is None:
            raise
        surface = None  # the masks give no hull, but the scene says where the object is
    if surface is None and choice == "hull":
        raise InputError(f"{capture.path}: --domain hull: there are no masks of the whole object from several sides; "
                         "give them, or --domain sphere")  # fmt: skip
    # Without the package for remeshing, a sphere is good enough in place of a hull without handles.
    if surface is not None and (choice == "hull" or installed("gpytoolbox") or genus(surface)):
        return closed_domain(surface, shape.center, shape.radius)
    return Sphere(), *capture.sphere()


def require_normalised(capture: Capture, domain: Domain, center: np.ndarray, radius: float) -> None:
    """Raise InputError if the start surface is far from the normalising sphere, or much larger or smaller than it.

    `center` (3,), `radius`: the normalising sphere [scene units]. `domain`: the start surface in units of this sphere.
    """
    low, high = domain.points.min(0), domain.points.max(0)
    size = float((high - low).max()) / 2
    if size <= 1 / DISPROPORTIONATE or np.abs(domain.points).max() >= DISPROPORTIONATE:
        given, middle = (", ".join(f"{c:.4g}" for c in place) for place in (center, center + radius * (low + high) / 2))
        raise InputError(f"{capture.path}: center and radius of the shapenet shape: are {given} and {radius:.4g}, but "
                         f"the surface that the fit starts from has a radius of {size * radius:.4g} about {middle}; "
                         "correct them or leave them out")  # fmt: skip


def require_view_from_outside(capture: Capture, domain: Domain, center: np.ndarray, radius: float) -> None:
    """Raise InputError if a camera or its light is inside the start surface, or if a camera faces away from it.

    `center` (3,), `radius`: the normalising sphere [scene units]. `domain`: the start surface in units of this sphere.
    """
    cameras, lights = [shot.camera for shot in capture.shots], capture.photographs.lights
    surface, near = center + radius * domain.points, lights.is_finite()
    near &= capture.photographs.lit | capture.photographs.dark
    ahead = [((surface - camera.position) @ camera.forward).max() for camera in cameras]
    if min(ahead) < 0:
        shot = capture.shots[int(np.argmin(ahead))]
        raise InputError(f'{capture.path}: photograph "{shot.name}", to_world: its camera looks away from the '
                         "surface that the fit starts from; see python -m mi_ring.check")  # fmt: skip
    places = {"to_world: its camera": np.stack([camera.position for camera in cameras]),
              "emitter: its light": np.where(near[:, None], lights.positions(), np.inf)}  # fmt: skip
    for what, points in places.items():
        if (inside := domain.contains((points - center) / radius)).any():
            shot = capture.shots[int(inside.argmax())]
            raise InputError(
                f'{capture.path}: photograph "{shot.name}", {what} is inside the surface that the fit starts from, '
                f"of radius {radius:.4g} about ({', '.join(f'{c:.4g}' for c in center)}); check its place and units"
            )


def require_networks(ring: FittedObject) -> None:
    """Raise InputError if Shape-Net or BRDF-Net of an object returns a tensor of wrong shape."""
    s = torch.zeros(2, 3, device=next(ring.parameters()).device)
    with torch.no_grad():
        moved = ring.shape_net(s)
        if moved.shape != s.shape:
            raise InputError(f"networks: {type(ring.shape_net).__name__}: gives {tuple(moved.shape)} for points (2, 3)")
        brdf_net = ring.brdf_net
        evaluate = getattr(brdf_net, "evaluate", None)  # networks may do without
        if evaluate and (found := evaluate(s).shape[-1]) != brdf_net.outputs:
            names = ", ".join(p.name for p in brdf_net.bsdf_parameters)
            raise InputError(f"networks: {type(brdf_net).__name__}: has {found} outputs, {names} need "
                             f"{brdf_net.outputs}")  # fmt: skip
