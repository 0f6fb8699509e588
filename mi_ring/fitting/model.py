"""The model of a fit: the fitted object and the calibration, all that is learned."""

import math

from torch import nn

from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.rig import Rig
from mi_ring.capture.capture import Capture
from mi_ring.fitting.lighting import room_frames
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.refinement import Refinement
from mi_ring.geometry.domain import Sphere
from mi_ring.objects.fitted_object import FittedObject


class Model(nn.Module):
    """The unknowns of a fit: the object `ring`, and the `calibration` of the photographs (None: not refined)."""

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
                      "light" in problem.config.refine, lamps="lamps" in refined)  # fmt: skip
            self.calibration = Calibration(capture, refined, rig, room_frames(capture, lighting))
            self.calibration.room.to(problem.device)
        self.starts_near = not isinstance(ring.domain, Sphere)  #: from a hull or a mesh
        self.to_freeze = [p for p in ring.shape_net.parameters() if p.requires_grad]

    def fix_surface(self, fixed: bool) -> None:
        """Freeze Shape-Net if `fixed`, otherwise train it. Parameters that were frozen at the start stay frozen."""
        for parameter in self.to_freeze:
            parameter.requires_grad_(not fixed)

    def update_albedo(self) -> None:
        """Scale the albedo's initial value inversely to the common factor `scale` of all lights.

        Without this, directly lit surfaces would change their brightness with `scale`.
        """
        if self.calibration and "scale" in self.calibration.refined:
            net, initial = self.ring.brdf_net, self.albedo / self.calibration.rig.power / math.pi
            net.set_parameters(net.bsdf_parameters, initial * self.calibration.albedo_factor)

    def calibrated(self, capture: Capture) -> Capture:
        """Return the capture with the current estimates of cameras, lights and camera response."""
        return self.calibration.applied(capture) if self.calibration else capture
