"""The ring: both networks, the domain and the normalisation, which together are a reconstructed object."""

from pathlib import Path

import torch
from torch import Tensor, nn

from mi_ring.brdfnet import COOK_TORRANCE, BRDFNet
from mi_ring.domain import Domain, Sphere
from mi_ring.errors import InputError
from mi_ring.shapenet import ShapeNet

FORMAT = 3  #: version of the file `ring.pt`


class Ring(nn.Module):
    """A surface x(s) = center + radius · Φ(s) with a reflectance Ψ(s) for every point s of the domain.

    `center` (3,) and `radius` are in scene units; `bsdf` is the BSDF that reads `parameters`, as Mitsuba's XML;
    `indirect`: was interreflection part of the fit, so that it belongs into pictures? `subdivisions`: the level to
    sample the surface at; between the vertices of the fit the networks are less certain.
    """

    def __init__(
        self, center, radius: float, scale: float = 1.0, domain: Domain | None = None, parameters=COOK_TORRANCE,
        bsdf: str = '<bsdf type="cooktorrance"/>', indirect: bool = False, steps: int = 20, subdivisions: int = 6,
    ):  # fmt: skip
        super().__init__()
        self.shape_net, self.brdf_net = ShapeNet(steps), BRDFNet(scale, parameters)
        self.bsdf, self.indirect, self.subdivisions = bsdf, indirect, subdivisions
        self.register_buffer("center", torch.as_tensor(center, dtype=torch.float32))
        self.register_buffer("radius", torch.tensor(float(radius)))
        self.domain = domain or Sphere()

    def surface(self, s: Tensor, time: float = 1.0) -> Tensor:
        """Surface points (V, 3) [scene units] of domain points (V, 3), or where the flow has them at a `time`."""
        return self.center + self.radius * self.shape_net(s, time)

    def state(self, config: dict | None = None) -> dict:
        """What `ring.pt` holds, to be written by `torch.save`."""
        domain = None
        if not isinstance(self.domain, Sphere):  # as tensors: numpy arrays are not among what torch loads safely
            domain = {"points": torch.tensor(self.domain.points), "faces": torch.tensor(self.domain.faces)}
        parameters = [tuple(p) for p in self.brdf_net.bsdf_parameters]
        return {
            "format": FORMAT, "networks": self.state_dict(), "domain": domain, "config": config or {},
            "parameters": parameters, "bsdf": self.bsdf, "indirect": self.indirect, "steps": self.shape_net.steps,
        }  # fmt: skip

    @classmethod
    def from_state(cls, state: dict) -> "Ring":
        """The inverse of `state`."""
        domain = state["domain"] and Domain(state["domain"]["points"], state["domain"]["faces"])
        properties = {name: state[name] for name in ("parameters", "bsdf", "indirect", "steps")}
        if "subdivisions" in state["config"]:
            properties["subdivisions"] = state["config"]["subdivisions"]
        ring = cls(torch.zeros(3), 1.0, domain=domain, **properties)
        ring.load_state_dict(state["networks"])
        return ring

    @classmethod
    def load(cls, path: str | Path) -> "Ring":
        """Read a ring.pt or that of a results folder. Raises InputError if missing, none or of another version."""
        path = Path(path)
        path = path / "ring.pt" if path.is_dir() else path
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            version = state["format"]
            if version == FORMAT:
                return cls.from_state(state)
        except FileNotFoundError:
            raise InputError(f"{path}: no such file; give the results folder of a fit, or its ring.pt") from None
        except Exception as error:
            why = f" ({str(error).splitlines()[0]})" if isinstance(error, OSError) else ""
            advice = "give the results folder of a fit, or its ring.pt"
            raise InputError(f"{path}: not a saved fit{why}; {advice}") from error
        raise InputError(f"{path}: format version {version}, this mi_ring reads version {FORMAT}")
