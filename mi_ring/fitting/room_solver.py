"""Solves for the light of the room with the photographs of each iteration."""

import torch

from mi_ring.calibration.calibration import Calibration
from mi_ring.fitting.iteration import Iteration


class RoomSolver:
    """Gives what an iteration has seen to the `RoomLight` of a calibration."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration

    @torch.no_grad()
    def look(self, it: Iteration) -> None:
        """Add the iteration's photographs to the normal equations and solve them, once that is due."""
        calibration, other, seen = self.calibration, it.prediction.other_light, it.observation
        if other is None or not calibration.solves_room(it.progress):
            return
        pixels = it.object_pixels() & ~seen.clipped.any(-1)
        observed = calibration.linear(seen.rgb, it.batch.photographs, it.batch.scale)
        predicted = it.prediction.without_room
        calibration.room.solve(other, predicted, observed, pixels, it.progress, it.batch.total)
