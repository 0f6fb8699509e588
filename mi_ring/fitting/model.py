"""The model of a fit: everything that the fit learns, that is the fitted object and the calibration."""

import math

from torch import nn

from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.rig import Rig
from mi_ring.capture.capture import Capture
from mi_ring.fitting.detail_stage import (
    FEWEST_PHOTOGRAPHS,
    add_detail,
    detail_levels,
    fit_resolution,
    share_weights,
    smooth_between,
)
from mi_ring.fitting.lighting import room_frames
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.refinement import Refinement
from mi_ring.geometry.domain import Sphere
from mi_ring.nets.brdf_net import MaterialNet
from mi_ring.nets.shape_net import Flow
from mi_ring.objects.detail import DetailedFlow, DetailedMaterial
from mi_ring.objects.fitted_object import FittedObject


class Model(nn.Module):
    """The unknowns of a fit: the object `ring` and the `calibration`, which is None if the fit refines none."""

    calibration: Calibration | None

    def __init__(self, problem: Problem, ring: FittedObject) -> None:
        super().__init__()
        self.ring = ring
        center = ring.center.cpu().numpy()
        refinement = Refinement.of(problem, center)
        self.albedo = refinement.albedo  #: of the object, according to the lights' intensities
        self.calibration = None
        capture, lighting = problem.capture, problem.lighting
        if refined := refinement.refined:
            rig = Rig(capture, center, problem.exposure, problem.fitted, refinement.power, bool(lighting.lamps),
                      "light" in problem.config.refine, "lamps" in refined, "power" in refined)  # fmt: skip
            self.calibration = Calibration(capture, refined, rig, room_frames(capture, lighting))
            self.calibration.room.to(problem.device)
        self.starts_near = not isinstance(ring.domain, Sphere)  #: from a hull or a mesh
        self.resolution = fit_resolution(problem, center, float(ring.radius))  #: of the photographs
        several = len(problem.fitted) >= FEWEST_PHOTOGRAPHS
        #: of the meshes for details, from coarse to fine
        self.detail_levels = detail_levels(ring, self.resolution) if several else []
        share_weights(ring)
        self.to_freeze = [p for p in ring.shape_net.parameters() if p.requires_grad]

    def fix_surface(self, fixed: bool) -> None:
        """Freeze the parameters of Shape-Net if `fixed`, otherwise let the optimiser train them.

        Parameters that were frozen before the fit stay frozen.
        """
        for parameter in self.to_freeze:
            parameter.requires_grad_(not fixed)

    @property
    def detailed(self) -> bool:
        """Return True if details have been added to the networks."""
        return isinstance(self.ring.shape_net, DetailedFlow) and isinstance(self.ring.brdf_net, DetailedMaterial)

    def add_detail(self, level: int, trained: int) -> None:
        """Add details to both networks, and freeze the networks. Displacements begin with what smooths the flow.

        `level`: of the finest mesh. `trained`: that with which the networks were trained.
        """
        add_detail(self.ring, level, self.resolution)
        smooth_between(self.ring, level, trained)

    def remove_detail(self) -> tuple[Flow, MaterialNet]:
        """Remove the details, and return the networks that had them: (Shape-Net, BRDF-Net)."""
        shape, material = self.ring.shape_net, self.ring.brdf_net
        if isinstance(shape, DetailedFlow) and isinstance(material, DetailedMaterial):
            self.ring.shape_net, self.ring.brdf_net = shape.base.network, material.base.network
        return shape, material

    def update_albedo(self) -> None:
        """Divide the object's reflectances by the current value of `scale`, the common factor of all lights.

        Without this, the brightness of directly lit surfaces would change with `scale`. Does nothing if `scale` is not
        refined.
        """
        if self.calibration and "scale" in self.calibration.refined:
            net, initial = self.ring.brdf_net, self.albedo / self.calibration.rig.power / math.pi
            net.set_parameters(net.bsdf_parameters, initial * self.calibration.albedo_factor)

    def calibrated(self, capture: Capture) -> Capture:
        """Return `capture` with the current estimates of cameras, lights and camera response."""
        return self.calibration.applied(capture) if self.calibration else capture
