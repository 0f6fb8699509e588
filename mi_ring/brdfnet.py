"""BRDF-Net: the reflectance at every point of the domain (paper, section 3)."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.encoding import PosEnc


class BRDFNet(nn.Module):
    """Ψ(s) = (ρʳ, ρᵍ, ρᵇ, ρᵞ, r): an MLP of 1,285 neurons on the domain point s, never on the deformed point.

    `scale` is the order of magnitude of ρ in the scene's units of light: the networks see numbers near 1 whatever the
    photographer's units are. Diffuse and specular are positive (softplus), roughness lies in (0, 1) (sigmoid).
    """

    def __init__(self, scale: float = 1.0, width: int = 256, frequencies: int = 16):
        super().__init__()
        self.encoding = PosEnc(frequencies)
        sizes = [self.encoding.width] + [width] * 5
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(sizes, sizes[1:]))
        self.output = nn.Linear(width, 5)
        self.register_buffer("scale", torch.tensor(float(scale)))

    def forward(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(diffuse (..., 3), specular (...), roughness (...)) at domain points (..., 3)."""
        h = self.encoding(s)
        for layer in self.hidden:
            h = F.leaky_relu(layer(h))
        raw = self.output(h).float()
        diffuse = self.scale * F.softplus(raw[..., :3])
        specular = self.scale * F.softplus(raw[..., 3] - 2)
        return diffuse, specular, torch.sigmoid(raw[..., 4] - 0.5)
