"""Edits fitted materials and transfers them to other objects."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from mi_ring.errors import InputError
from mi_ring.geometry.sphere_map import SphericalMap
from mi_ring.nets.brdf_net import ROUGHNESS, SPECULAR, MaterialNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit


@dataclass(frozen=True, kw_only=True)
class MaterialOptions:
    """Options that change the material of an object."""

    material: Path | None = None
    """Results folder of another fit. The object gets the material of that fit. Without this option: its own material.
    Both fits must start from the same surface, or from surfaces without handles (like a sphere, not like a ring)."""
    specular_scale: float = 1.0
    """Factor of the specular reflectance, 0 or more. Above 1, for example 2: stronger highlights. 0: no highlights."""
    roughness_add: float = 0.0
    """Number to add to the roughness, for example 0.1 or -0.1. Above 0: wider highlights. Below 0: narrower highlights.
    The command clips the sum to the range of the material's roughness, at most 0 to 1."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of red, green and blue in the object's colours, 0 or more. 1 1 1: no change. 1 0.8 0.8: more red."""


def edit_material(ring: FittedObject, options: MaterialOptions) -> None:
    """Change the material of `ring` in place. `options`: factors and offsets, or another fit whose material it gets.

    Raises InputError if an option is out of range, or if the material lacks the parameter that an option changes.
    """
    if options.material:
        other = load_fit(options.material)
        ring.bsdf, ring.brdf_net = other.bsdf, other.brdf_net
        a, b = ring.domain, other.domain
        same = type(a) is type(b) and np.array_equal(a.points, b.points) and np.array_equal(a.faces, b.faces)
        if not same:
            here, there = SphericalMap(a, "--material: the shape"), SphericalMap(b, f"{options.material}: --material")
            ring.brdf_net = TransferredMaterial(ring.brdf_net, here, there)
        ring.indirect = ring.indirect and other.indirect
    gains: dict[str, ArrayLike] = {}
    offsets: dict[str, float] = {}
    colours = [p.name for p in ring.brdf_net.bsdf_parameters if p.channels == 3]
    scaled = ("--specular-scale", options.specular_scale, SPECULAR), ("--tint", options.tint, colours)
    for option, gain, names in scaled:
        if np.equal(gain, 1).all():
            continue
        if not (np.isfinite(gain).all() and np.min(gain) >= 0):
            raise InputError(f"{option}: is {gain!r}, must be 0 or more")
        for name in parameters_among(ring, option, names):
            gains[name] = np.multiply(gains.get(name, 1.0), gain)
    if options.roughness_add != 0:
        if not np.isfinite(options.roughness_add):
            raise InputError(f"--roughness-add: is {options.roughness_add}, must be a number")
        offsets = dict.fromkeys(parameters_among(ring, "--roughness-add", ROUGHNESS), options.roughness_add)
    if gains or offsets:
        ring.brdf_net = EditedMaterial(ring.brdf_net, gains, offsets)


def parameters_among(ring: FittedObject, option: str, names: Sequence[str]) -> list[str]:
    """List those of `names` that are parameters of the object's material.

    Raises InputError if there is none. The message begins with `option`, the option that changes them.
    """
    parameters = [p.name for p in ring.brdf_net.bsdf_parameters]
    found = [name for name in parameters if name in names]
    if not found:
        raise InputError(f"{option}: this material has no such parameter; it has {', '.join(parameters)}")
    return found


class TransferredMaterial(MaterialNet):
    """The material of another fit, evaluated at points of this object's domain.

    `net`: BRDF-Net of the other fit. `here`, `there`: maps of this domain and of the other fit's domain to the unit
    sphere. Points of both domains correspond to each other if they are mapped to one point of the sphere.
    """

    def __init__(self, net: MaterialNet, here: SphericalMap, there: SphericalMap) -> None:
        super().__init__(net.bsdf_parameters, float(net.scale))
        self.net, self.here, self.there = net, here, there

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        return self.net(self.corresponding(s))

    def texture(self, s: Tensor) -> Tensor | None:
        return self.net.texture(self.corresponding(s))

    def texture_cell(self) -> float | None:
        return self.net.texture_cell()  # about: domains are equally large, but the map between them stretches

    def corresponding(self, s: Tensor) -> Tensor:
        """Return the points (..., 3) of the other domain that correspond to points (..., 3) of this one."""
        points = self.there.to_domain(self.here.to_sphere(s.detach().reshape(-1, 3).cpu().numpy()))
        return torch.from_numpy(points).to(s).reshape(s.shape)


class EditedMaterial(MaterialNet):
    """The material of the BRDF-Net `net`, in which each parameter is multiplied by its gain, and its offset is added.

    `gains`, `offsets`: dicts from names of parameters to numbers. Results are clipped to the ranges of the parameters.
    """

    def __init__(self, net: MaterialNet, gains: dict, offsets: dict) -> None:
        super().__init__(net.bsdf_parameters, float(net.scale))
        self.net, self.gains, self.offsets = net, gains, offsets

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        return self.edited(self.net(s))

    def texture(self, s: Tensor) -> Tensor | None:
        return self.net.texture(s)

    def texture_cell(self) -> float | None:
        return self.net.texture_cell()

    def edited(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        """Apply gains and offsets to parameters, in place. Returns them."""
        for p in self.bsdf_parameters:
            gain = values[p.name].new_tensor(self.gains.get(p.name, 1.0))
            value = gain * values[p.name] + self.offsets.get(p.name, 0.0)
            values[p.name] = value.clamp(p.low, p.high)
        return values
