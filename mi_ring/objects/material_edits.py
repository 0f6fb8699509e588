"""Fitted materials: exchanged between objects, and edited."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from mi_ring.errors import InputError
from mi_ring.geometry.domain import Sphere
from mi_ring.geometry.sphere_map import SphericalMap
from mi_ring.nets.brdf_net import MaterialNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit

SPECULAR, ROUGHNESS = ("specular", "specular_reflectance"), ("roughness", "alpha")  #: Mitsuba's names


@dataclass(frozen=True, kw_only=True)
class MaterialOptions:
    """Another material for the object."""

    material: Path | None = None
    """Results folder of another fit, whose material this object gets.
    Both fits must start from the same domain or from surfaces without handles."""
    specular_scale: float = 1.0
    """Factor for the specular reflectance."""
    roughness_add: float = 0.0
    """Number that is added to the roughness."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors for red, green and blue."""


def dress(ring: FittedObject, options: MaterialOptions) -> None:
    """Give a ring the material that the options ask for. Raises InputError if it cannot have it."""
    if options.material:
        other = load_fit(options.material)
        ring.bsdf, ring.brdf_net = other.bsdf, other.brdf_net
        if not same_domain(ring, other):
            here = SphericalMap(ring.domain, "--material: the shape")
            there = SphericalMap(other.domain, f"{options.material}: --material")
            ring.brdf_net = Carried(ring.brdf_net, here, there)
        ring.indirect = ring.indirect and other.indirect
    gains: dict[str, ArrayLike] = {}
    offsets: dict[str, float] = {}
    if options.specular_scale != 1:
        at_least_0("--specular-scale", options.specular_scale)
        gains = dict.fromkeys(named(ring, "--specular-scale", SPECULAR), options.specular_scale)
    if options.tint != (1, 1, 1):
        at_least_0("--tint", options.tint)
        for name in named(ring, "--tint", [p.name for p in ring.brdf_net.bsdf_parameters if p.channels == 3]):
            gains[name] = np.multiply(gains.get(name, 1.0), options.tint)
    if options.roughness_add != 0:
        if not np.isfinite(options.roughness_add):
            raise InputError(f"--roughness-add: is {options.roughness_add}, must be a number")
        offsets = dict.fromkeys(named(ring, "--roughness-add", ROUGHNESS), options.roughness_add)
    if gains or offsets:
        ring.brdf_net = Edited(ring.brdf_net, gains, offsets)


def at_least_0(option: str, value: ArrayLike) -> None:
    """Raise InputError for a factor, or one of several, that is negative or not finite."""
    if not (np.isfinite(value).all() and np.min(value) >= 0):
        raise InputError(f"{option}: is {value!r}, must be 0 or more")


def named(ring: FittedObject, option: str, names: Sequence[str]) -> list[str]:
    """Which of these parameters the material has. Raises InputError if none."""
    parameters = [p.name for p in ring.brdf_net.bsdf_parameters]
    found = [name for name in parameters if name in names]
    if not found:
        raise InputError(f"{option}: this material has no such parameter; it has {', '.join(parameters)}")
    return found


def same_domain(a: FittedObject, b: FittedObject) -> bool:
    """Are two rings functions on the same surface?"""
    if isinstance(a.domain, Sphere) or isinstance(b.domain, Sphere):
        return type(a.domain) is type(b.domain)
    return np.array_equal(a.domain.points, b.domain.points) and np.array_equal(a.domain.faces, b.domain.faces)


class Carried(MaterialNet):
    """A BRDF-Net on another domain than its own, by way of the sphere."""

    def __init__(self, net: MaterialNet, here: SphericalMap, there: SphericalMap) -> None:
        super().__init__(net.bsdf_parameters, float(net.scale))
        self.net, self.here, self.there = net, here, there

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        own = self.there.to_domain(self.here.to_sphere(s.detach().reshape(-1, 3).cpu().numpy()))
        return self.net(torch.from_numpy(own).to(s).reshape(s.shape))


class Edited(MaterialNet):
    """A BRDF-Net with gains and offsets, by the names of its parameters, kept within the parameters' ranges."""

    def __init__(self, net: MaterialNet, gains: dict, offsets: dict) -> None:
        super().__init__(net.bsdf_parameters, float(net.scale))
        self.net, self.gains, self.offsets = net, gains, offsets

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        values = self.net(s)
        for p in self.bsdf_parameters:
            gain = values[p.name].new_tensor(self.gains.get(p.name, 1.0))
            value = gain * values[p.name] + self.offsets.get(p.name, 0.0)
            values[p.name] = value.clamp(p.low, p.high)
        return values
