"""Point lights and distant lights as tensors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.scene.lights import Light


class LightTensors(NamedTuple):
    """L point lights or distant lights as tensors.

    `places` (L, 3): positions [scene units] of point lights, unit directions toward distant ones. `finite` (L, 1): True
    for a point light. `strengths` (L, 3): intensities of point lights, irradiances of distant ones.
    """

    places: Tensor  #: (L, 3) positions [scene units], of distant lights unit directions toward them
    finite: Tensor  #: (L, 1) bool: a point light? Else it is distant
    strengths: Tensor  #: (L, 3) intensities, of distant lights irradiances

    @classmethod
    def of(cls, lights: Sequence[Light]) -> "LightTensors":
        """Convert L lights to tensors."""
        finite = [light.kind == "point" for light in lights]
        places = [light.vector if point else -light.vector for light, point in zip(lights, finite)]
        numbers = (np.array(part, float).reshape(-1, 3) for part in (places, [light.rgb for light in lights]))
        at, rgb = (torch.from_numpy(part).float() for part in numbers)
        return cls(at, torch.tensor(finite, dtype=torch.bool)[:, None], rgb)

    def moved(self, offset: Tensor, distance: float) -> "LightTensors":
        """Return a copy with moved lights.

        `offset` (L, 3): the motion of each light, in multiples of `distance` [scene units]. A distant light is turned
        instead: `offset` is then added to its unit direction, and its unit is the radian.
        """
        moved = self.places + offset * torch.where(self.finite, distance, 1.0)
        return self._replace(places=torch.where(self.finite, moved, F.normalize(moved, dim=-1)))

    def lights(self) -> list[Light]:
        """Convert the tensors to a list of L lights."""
        places, strengths = (part.detach().double().numpy(force=True) for part in (self.places, self.strengths))
        return [Light("point", place, rgb) if point else Light("directional", -place, rgb)
                for place, point, rgb in zip(places, self.finite[:, 0].tolist(), strengths)]  # fmt: skip
