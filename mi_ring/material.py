"""Fitted materials: exchanged between objects, and edited."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor, nn

from mi_ring.domain import Sphere
from mi_ring.errors import InputError
from mi_ring.ring import Ring

SPECULAR, ROUGHNESS = ("specular", "specular_reflectance"), ("roughness", "alpha")  #: Mitsuba's names


@dataclass(frozen=True, kw_only=True)
class MaterialOptions:
    """Another material for the object."""

    material: Path | None = None
    """Results folder of another fit: its material, on the shape of this one. Both must start from the same domain."""
    specular_scale: float = 1.0
    """Factor of the specular reflectance."""
    roughness_add: float = 0.0
    """Is added to the roughness."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of red, green and blue."""


def dress(ring: Ring, options: MaterialOptions) -> None:
    """Give a ring the material that the options ask for. Raises InputError if it cannot have it."""
    if options.material:
        other = Ring.load(options.material)
        if not same_domain(ring, other):
            own = "another" if about(ring) == about(other) else about(ring)
            raise InputError(f"{options.material}: --material: was fitted from {about(other)}, the shape from {own}; a "
                             "material is a function on where the fit started: fit both with the same --domain, "
                             "sphere or mesh FILE")  # fmt: skip
        ring.brdf_net, ring.bsdf = other.brdf_net, other.bsdf
        ring.indirect = ring.indirect and other.indirect
    gains, offsets = {}, {}
    parameters = ring.brdf_net.bsdf_parameters
    for option, value, neutral, names, into in (
        ("--specular-scale", options.specular_scale, 1.0, [p.name for p in parameters if p.name in SPECULAR], gains),
        ("--roughness-add", options.roughness_add, 0.0, [p.name for p in parameters if p.name in ROUGHNESS], offsets),
        ("--tint", options.tint, (1.0, 1.0, 1.0), [p.name for p in parameters if p.channels == 3], gains),
    ):
        if not np.isfinite(value).all() or (into is gains and np.min(value) < 0):
            raise InputError(f"{option}: is {value}, must be {'0 or more' if into is gains else 'a number'}")
        if value != neutral:
            if not names:
                raise InputError(f"{option}: this material has no such parameter; it has "
                                 + ", ".join(p.name for p in parameters))  # fmt: skip
            into |= {name: np.multiply(into.get(name, 1.0), value) for name in names}
    if gains or offsets:
        ring.brdf_net = Edited(ring.brdf_net, gains, offsets)


def same_domain(a: Ring, b: Ring) -> bool:
    """Are two rings functions on the same surface?"""
    if isinstance(a.domain, Sphere) or isinstance(b.domain, Sphere):
        return type(a.domain) is type(b.domain)
    return np.array_equal(a.domain.points, b.domain.points) and np.array_equal(a.domain.faces, b.domain.faces)


def about(ring: Ring) -> str:
    """The domain of a ring, for messages."""
    return "a sphere" if isinstance(ring.domain, Sphere) else f"a mesh of {len(ring.domain.points):,} vertices"


class Edited(nn.Module):
    """A BRDF-Net with gains and offsets, by the names of its parameters, kept within the parameters' ranges."""

    def __init__(self, net, gains: dict, offsets: dict):
        super().__init__()
        self.net, self.gains, self.offsets = net, gains, offsets
        self.bsdf_parameters, self.scale = net.bsdf_parameters, net.scale

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        values = self.net(s)
        for p in self.bsdf_parameters:
            gain = values[p.name].new_tensor(self.gains.get(p.name, 1.0))
            value = gain * values[p.name] + self.offsets.get(p.name, 0.0)
            values[p.name] = value.clamp(p.low, p.high)
        return values
