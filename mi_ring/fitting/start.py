"""Where a fit starts: the surface that is deformed, and the sphere that normalises it."""

from pathlib import Path

import numpy as np
import torch

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain, Sphere, closed_domain
from mi_ring.geometry.meshes import genus, load_closed_mesh
from mi_ring.ring.ring import Ring


def starting_surface(capture: Capture, choice: str | tuple[str, Path]) -> tuple[Domain, np.ndarray, float]:
    """The domain of a fit and the sphere that normalises it: what `--domain` asks for, else what the scene says."""
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
        surface = None  # the masks are of no use, but the scene says where the object is
    if surface is None and choice == "hull":
        raise InputError(f"{capture.path}: --domain hull: there are no masks of the whole object from several sides; "
                         "give them, or --domain sphere")  # fmt: skip
    if surface is not None and (choice == "hull" or genus(surface)):
        print(f"Start: the masks' visual hull, of genus {genus(surface)}")
        return closed_domain(surface, shape.center, shape.radius)
    return Sphere(), *capture.sphere()


def require_view_from_outside(capture: Capture, domain: Domain, center: np.ndarray, radius: float) -> None:
    """Raise InputError if a camera or its light is inside the start surface, or if a camera looks away from it."""
    cameras, lights = [sensor.camera for sensor in capture.sensors], capture.photographs.lights
    surface = center + radius * domain.points
    ahead = [((surface - camera.position) @ camera.forward).max() for camera in cameras]
    if min(ahead) < 0:
        sensor = capture.sensors[int(np.argmin(ahead))]
        raise InputError(f'{capture.path}: photograph "{sensor.id()}", to_world: its camera looks away from the '
                         "surface that the fit starts from; see python -m mi_ring.check")  # fmt: skip
    places = {"to_world: its camera": np.stack([camera.position for camera in cameras]),
              "emitter: its light": np.where(lights.is_finite()[:, None], lights.positions(), np.inf)}  # fmt: skip
    for what, points in places.items():
        if (inside := domain.contains((points - center) / radius)).any():
            sensor = capture.sensors[int(inside.argmax())]
            raise InputError(
                f'{capture.path}: photograph "{sensor.id()}", {what} is inside the surface that the fit starts from, '
                f"of radius {radius:.4g} about ({', '.join(f'{c:.4g}' for c in center)}); check its place and units"
            )


def require_networks(ring: Ring) -> None:
    """Raise InputError for networks whose outputs are not of the shapes that a fit needs."""
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
