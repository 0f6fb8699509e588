"""Attributes that were renamed. An old name raises an error that contains the new name.

The next version will not have this module.
"""

from typing import Any, ClassVar

FIT = {
    "given": "problem.given", "config": "problem.config", "processes": "problem.processes",
    "held_out": "problem.held_out", "fitted": "problem.fitted", "exposure": "problem.exposure",
    "lighting": "problem.lighting", "environment": "problem.environment", "device": "problem.device",
    "calibration": "model.calibration", "albedo": "model.albedo", "surface": "renderer.surface",
    "averages": "renderer.averages", "stages": "schedule.stages", "terms": "loss.terms", "log": "course.log",
    "seconds": "course.seconds", "outlines": "course.masks", "confirmed": "course.validation",
    "restraint": "regulariser", "caution": "optimisation.guard", "optimizers": "optimisation.optimizers",
    "rounds": "sampler", "random": "sampler.random", "summary": "result().calibration",
    "progress": "schedule.progress", "shaping": "schedule.shaping", "near": "model.starts_near",
}  # fmt: skip
ITERATION = {
    "fit": "context", "s": "batch.points", "faces": "batch.faces", "index": "batch.photographs",
    "everything": "batch.all_photographs", "scale": "batch.scale", "share": "batch.share",
    "photographs": "prediction.photographs",
    "vertices": "prediction.vertices", "material": "prediction.material", "predicted": "prediction.rgb",
    "coverage": "prediction.coverage", "observed": "observation.rgb", "clipped": "observation.clipped",
    "mask": "observation.mask", "masked": "observation.masked", "valid": "observation.valid",
    "surely": "object_pixels",
}  # fmt: skip


class Renamed:
    """Base class of classes with renamed attributes. An old name raises AttributeError, which contains the new name."""

    RENAMED: ClassVar[dict[str, str]]

    def __getattr__(self, name: str) -> Any:
        kind = type(self)
        if name in kind.RENAMED:
            raise AttributeError(f"{kind.__name__}.{name} is now {kind.__name__}.{kind.RENAMED[name]}")
        raise AttributeError(f"{kind.__name__} has no attribute {name}")
