"""What exported files say, and what they should say."""

import json
import struct

import numpy as np
import torch
from scipy.ndimage import map_coordinates


def chunks(file):
    """The JSON and the binary part of a GLB file (glTF 2.0, section 4.4)."""
    content = file.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size = struct.unpack_from("<I4s", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[20 + size + 8 :]


def bilinear(image, uv):
    """An image (H, W, C) at (N, 2), as renderers read it; the first texel's centre at half a texel."""
    y, x = uv[:, 1] * image.shape[0] - 0.5, uv[:, 0] * image.shape[1] - 0.5
    return np.stack([map_coordinates(image[..., c].astype(float), [y, x], order=1, mode="nearest")
                     for c in range(image.shape[2])], 1)  # fmt: skip


def normals_at(ring, s, time=1.0):
    """The analytic normal (N, 3) of the surface at points of the sphere, by the derivative of the flow."""
    s = torch.from_numpy(s.astype(np.float32)).requires_grad_()
    jacobian = torch.stack([torch.autograd.grad(ring.shape_net(s, time)[:, k].sum(), s)[0] for k in range(3)], 1)
    s = s.detach()
    aside = torch.linalg.cross(s, torch.tensor([0.3, 0.5, 0.8]).expand_as(s))
    a, b = (torch.einsum("nij,nj->ni", jacobian, t) for t in (aside, torch.linalg.cross(s, aside)))
    n = torch.linalg.cross(a, b)
    return (n / n.norm(dim=1, keepdim=True)).numpy()
