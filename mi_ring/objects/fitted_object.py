"""A fitted object: both networks, the domain and the normalisation."""

from collections.abc import Sequence

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor, nn

from mi_ring.errors import InputError, SceneError
from mi_ring.geometry.camera import Camera, usable_camera
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.nets.brdf_net import COOK_TORRANCE, BRDFNet, MaterialNet, Parameter
from mi_ring.nets.shape_net import Flow, ShapeNet
from mi_ring.rendering import prediction
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.assembly import assembled
from mi_ring.scene.lights import Light, usable_light
from mi_ring.scene.mesh_texture import write_texture
from mi_ring.scene.shot import Shot

FINEST, MOST_SPP = 10, 10**4  #: largest level of the mesh and number of samples per pixel of a picture


class FittedObject(nn.Module):
    """A fitted object: the surface x(s) = center + radius · Φ(s) with the material Ψ(s), for points s of the domain.

    `center` (3,), `radius`: normalising sphere [scene units]. `domain`: the start surface; default: the unit sphere.
    `parameters`: the BSDF parameters that Ψ predicts. `bsdf`: Mitsuba's XML of the BSDF that reads them. `indirect`:
    the fit and its pictures include interreflection. `subdivisions`: level of the mesh in the results; finer levels are
    less certain. `networks`: (Shape-Net Φ, BRDF-Net Ψ). Without them, the networks of the paper are made: `steps` is
    the number of Euler steps of the flow Φ, `scale` the order of magnitude of the reflectances.

    `ground` (2, 3): a point of the table below the object and the table's unit normal. Surface points below the table
    are moved up to the table. `up` (3,), the up direction, and `metres`, the length of a scene unit [m], are for
    exports. These three are None if unknown.
    """

    shape_net: Flow
    brdf_net: MaterialNet
    center: Tensor
    radius: Tensor
    ground: Tensor | None

    def __init__(
        self, center: Sequence[float] | np.ndarray | Tensor, radius: float, scale: float = 1.0,
        domain: Domain | None = None, parameters: Sequence[Parameter] = COOK_TORRANCE,
        bsdf: str = '<bsdf type="cooktorrance"/>', indirect: bool = False, steps: int = 20, subdivisions: int = 6,
        networks: tuple[Flow, MaterialNet] | None = None, ground: np.ndarray | Tensor | None = None,
        up: Sequence[float] | np.ndarray | None = None, metres: float | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        self.shape_net, self.brdf_net = networks or (ShapeNet(steps), BRDFNet(scale, parameters))
        self.bsdf, self.indirect, self.subdivisions = bsdf, indirect, subdivisions
        self.register_buffer("center", torch.as_tensor(center, dtype=torch.float32))
        self.register_buffer("radius", torch.tensor(float(radius)))
        self.register_buffer("ground", None if ground is None else torch.as_tensor(ground, dtype=torch.float32))
        self.domain = domain or Sphere()
        self.up = None if up is None else [float(x) for x in up]
        self.metres = None if metres is None else float(metres)

    def surface(self, s: Tensor, time: float = 1.0) -> Tensor:
        """Compute the surface points (V, 3) [scene units] of the domain points `s` (V, 3).

        `time`: state of the deformation. 0: the domain. 1: the finished object.
        """
        return self.to_scene(self.shape_net(s, time))

    def material(self, s: Tensor) -> dict[str, Tensor]:
        """Compute the BSDF parameters at the domain points `s` (V, 3).

        Returns a dict from names to tensors (V, 3) or (V,).
        """
        return self.brdf_net(s)

    def forward(self, s: Tensor, time: float = 1.0) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute surface and material at the domain points `s` (V, 3).

        Returns (points (V, 3) [scene units], dict from names of BSDF parameters to tensors (V, 3) or (V,)). `time`:
        state of the deformation. 0: the domain. 1: the finished object.
        """
        return self.surface(s, time), self.material(s)

    def render(
        self, camera: Camera, light: Light | None = None, spp: int = 16, level: int | None = None, shadows: bool = True,
        seed: int = 0,
    ) -> Tensor:  # fmt: skip
        """Render a picture (H, W, 3) of linear radiance under direct light. `camera` determines H and W.

        `light`: None: a point light of intensity 1 at the camera. `spp`: samples per pixel. `level`: level of the mesh;
        None: the object's `subdivisions`. `shadows`: the object casts shadows on itself. One backward pass from the
        picture to the parameters of both networks is possible. Its gradients include moving outlines and shadows. A
        texture finer than the mesh is in the picture, but gets no gradient.

        Raises InputError if camera or light is invalid, and for numbers out of range.
        """
        level = self.subdivisions if level is None else level
        for name, value, least, most in (("spp", spp, 1, MOST_SPP), ("level", level, 0, FINEST)):
            if not (isinstance(value, int | np.integer) and least <= value <= most):
                raise InputError(f"{name}: is {value}, must be a whole number from {least} to {most:,}")
        shot = Shot("view", usable_camera(camera, "camera"), usable_light(light, "light"))
        try:
            view = Photographs.of([shot])
        except SceneError as error:
            raise InputError(f"light: {error}") from error
        shape = mi.load_dict({"type": "shapenet", "subdivisions": 0, "flash": False, "bsdf": {"type": "cooktorrance"}})
        surface = Surface(assembled([shape]), shape, self)
        s, faces = self.domain.sample(level)
        surface.set_faces(faces)
        write_texture(surface.shape, self.brdf_net, s, faces)
        vertices, material = self(s.to(self.center.device))
        return prediction.render(surface, view, vertices, material, spp, seed, shadows)[0][0]

    def to_scene(self, points: Tensor) -> Tensor:
        """Convert points (V, 3) from the normalised frame to scene units. Points below the table are moved up to it."""
        points = self.center + self.radius * points
        if self.ground is None:
            return points
        place, up = self.ground
        return points + ((place - points) @ up).clamp(min=0)[:, None] * up
