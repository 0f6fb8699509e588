"""The renderer of a fit: it predicts the photographs of a batch from the model."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Capture
from mi_ring.fitting.indirect_average import Averages, averaged
from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.refinement import finds_small_lights
from mi_ring.fitting.sampler import Batch
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering import prediction
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.system.machine import autocast


@dataclass(frozen=True)
class Prediction:
    """The prediction for the photographs of one iteration: V vertices, n photographs of H × W pixels.

    Tensors have gradients.
    """

    vertices: Tensor  #: (V, 3) [scene units]
    material: dict[str, Tensor]  #: parameters of the BSDF by name, (V, 3) or (V,)
    rgb: Tensor  #: (n, H, W, 3) radiance as the camera records it, decoded like the photographs
    coverage: Tensor  #: (n, H, W) of the object, in [0, 1]
    photographs: Photographs  #: with their cameras and lights as refined so far
    other_light: GlobalIllumination | None  #: interreflection and room light; None: not rendered
    averages: Averages  #: of interreflection, with these photographs; see `Renderer.remember`
    without_room: Tensor  #: (n, H, W, 3) linear radiance without what `GlobalIllumination.occlusion` adds; detached
    surface: Surface  #: that was rendered

    def detached(self) -> "Prediction":
        """Return a copy without gradients. It does not hold the autograd graph, which uses much memory."""
        result = replace(self, vertices=self.vertices.detach(), rgb=self.rgb.detach(), coverage=self.coverage.detach(),
                         material={name: value.detach() for name, value in self.material.items()})  # fmt: skip
        if "normals" in vars(self):
            vars(result)["normals"] = self.normals  # the surface may be written before they are read again
        return result

    @cached_property
    def normals(self) -> Tensor:
        """The unit normals (n, H, W, 3) in the axes of the world. Pixels without a surface are 0.

        They are rendered when they are first read, which must be before the surface is written again.
        """
        return torch.from_numpy(prediction.maps(self.surface, self.photographs, ())["normal"])


class Renderer:
    """Renders a scene with the fitted object in it."""

    def __init__(self, problem: Problem, ring: FittedObject) -> None:
        self.surface = Surface(problem.scene, problem.capture.shape, ring)
        self.autocast: Callable[[], Any] = autocast(problem.config.precision, problem.device)
        self.averages: Averages = {}  #: of interreflection

    def show(self, model: Model, level: int) -> Surface:
        """Evaluate the networks at mesh level `level`, without gradients. Returns the surface, ready to be rendered.

        If the fit refines lamps, the lamps of the scene get their current values.
        """
        self.surface.show(model.ring, *model.ring.domain.sample(level))
        if model.calibration:
            model.calibration.relight(self.surface)
        return self.surface

    def picture(self, model: Model, capture: Capture, k: int, width: int, level: int, spp: int) -> np.ndarray:
        """Render photograph `k` of the capture from the model. Returns linear radiance (H, W, 3), without gradients.

        `width`: largest width of the picture [px]. `level`: level of the mesh. `spp`: samples per pixel.
        """
        photograph, surface = capture.photograph(k, -(-capture.shots[k].size[0] // width)), self.show(model, level)
        rgb, _ = prediction.draw(surface, photograph, spp, shadows=capture.shadows, indirect=model.ring.indirect)
        return rgb[0].numpy()

    def predict(self, problem: Problem, model: Model, batch: Batch) -> Prediction:
        """Evaluate the networks at the points of a batch, and render the photographs of the batch (paper, section 3).

        The same model and batch give the same prediction, until `remember` is called.
        """
        config, calibration = problem.config, model.calibration
        vertices, material = self.deform(problem, model.ring, batch)
        self.surface.set_faces(batch.faces)
        photographs = problem.capture.photographs.select(batch.photographs, batch.size, batch.scale)
        photographs = replace(photographs, before=batch.share.part.start)
        refined = None
        if calibration:
            refined = calibration(batch.scale).to(problem.device)
            photographs = calibration.refined_photographs(photographs, refined)
        linear, coverage = prediction.render(
            self.surface, photographs, vertices, material, spp=config.spp, seed=batch.seeds["renderer"],
            shadows=config.shadows and problem.capture.shadows, views=refined,
            lamps=calibration.lamp_tensors() if calibration else [],
            lobes=calibration.room.lobe_tensors() if calibration and finds_small_lights(calibration, config) else [],
        )  # fmt: skip
        other, averages = self.other_light(model, batch, photographs, coverage)
        if other and model.ring.indirect:
            bounced = other.interreflection
            linear = linear + (calibration.indirect(bounced) if calibration else bounced)
        without_room = linear.detach()
        if other and photographs.room_rows:
            linear = linear + other.occlusion(torch.from_numpy(photographs.room_strengths).to(linear))
        rgb = calibration.recorded(linear, batch.photographs, batch.scale) if calibration else linear
        return Prediction(vertices, material, rgb, coverage, photographs, other, averages, without_room, self.surface)

    def deform(self, problem: Problem, ring: FittedObject, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Evaluate the networks at the domain points of a batch. Returns (vertices (V, 3), material).

        The material is a dict from names of BSDF parameters to tensors (V, …). If there are several processes, each
        evaluates some of the points; each gets all results.
        """
        points = problem.processes.share(len(batch.points))
        with self.autocast():
            vertices, material = ring(batch.points[points.part])
        vertices, *parameters = points.concatenated([vertices, *material.values()])
        return vertices, problem.lighting.material_at(batch.progress, dict(zip(material, parameters)))

    def other_light(
        self, model: Model, batch: Batch, photographs: Photographs, coverage: Tensor
    ) -> tuple[GlobalIllumination | None, Averages]:
        """Render interreflection and room light. Returns (this light, new averages of interreflection).

        `coverage` (n, H, W): the object's share of each pixel. Returns (None, {}) if there is neither light. If the
        scene has a table, interreflection is averaged over iterations. Otherwise the averages are {}.
        """
        calibration, indirect, rows = model.calibration, model.ring.indirect, photographs.room_rows
        if calibration and calibration.follows_room:
            rows = calibration.room.which
        if not (indirect or rows):
            return None, {}
        other = GlobalIllumination.of(self.surface, photographs, coverage, batch.seeds["indirect"],
                                    rows=rows, indirect=indirect)  # fmt: skip
        return averaged(self.averages, other, batch) if indirect and self.surface.table is not None else (other, {})

    def remember(self, prediction: Prediction) -> Prediction:
        """Store the averages of interreflection that `prediction` contains. The next call of `predict` uses them.

        Returns `prediction` without gradients.
        """
        self.averages |= prediction.averages
        return prediction.detached()

    def state(self) -> Averages:
        """Return the averages of interreflection, for a checkpoint."""
        return self.averages

    def restore(self, state: Averages) -> None:
        """Continue with the averages in `state`, which the method `state` has returned."""
        self.averages = state
