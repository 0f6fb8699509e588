"""Collects the content of `calibration.json`: the calibration that a fit has found, as plain numbers."""

import math
from typing import Any

import numpy as np
import torch

from mi_ring.calibration.unknown import Found
from mi_ring.calibration.unknowns import Exposure
from mi_ring.capture.capture import Capture
from mi_ring.fitting.joint_equations import JointEquations
from mi_ring.fitting.joint_solver import doubt
from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem


@torch.no_grad()
def summary(problem: Problem, model: Model, refined: Capture, joint: JointEquations) -> dict[str, Any]:
    """Collect the content of calibration.json. Writes no file.

    `refined`: the calibrated capture. `joint`: the equations of its unknowns. Returns a dict with these keys.
    `refined`: list of the refined options. `light`: kind of the light. `unknowns`: a dict with, for each unknown that
    photographs share, its meaning (`what`), its value `before` and `after` the fit, and its standard deviation `std`.
    `correlations`: a list of pairs of options, with how much their unknowns look alike in the photographs, 0 to 1.
    `untold`: the options of which photographs tell hardly more than the priors.
    `photographs`: a dict with, for each fitted photograph, how far the object has moved in it (`moved_px`) and the
    values of its own unknowns.
    """
    calibration, ring = model.calibration, model.ring
    assert calibration is not None
    rig, capture, deviations = calibration.rig, problem.capture, joint.deviations(problem.exposure)
    several = bool(problem.lighting.lamps)
    found = Found(rig, capture, refined, calibration.power_factor, calibration.lamps(), several)
    values = {name: calibration.value(name).double().numpy(force=True) for name in calibration.widths}
    unknowns: dict[str, dict[str, Any]] = {}
    for name, unknown in calibration.unknowns.items():
        if described := unknown.describe(values[name], deviations[name], found):
            what, *numbers = described
            values_of = zip(("before", "after", "std"), (np.asarray(n, float).tolist() for n in numbers))
            unknowns[name] = {"what": what, **dict(values_of)}
    if "ambient" in calibration.refined:
        room = calibration.room
        by = "first lamp" if several else "flash"
        what = f"light of the room on the object, as shares of the {by}'s: red, green, blue"
        if capture.photographs.dark:
            what = "mean radiance of the environment: red, green, blue"
        mean = torch.zeros_like(room.harmonics)
        mean[0] = torch.from_numpy(deviations["ambient"])
        given = None if capture.lobes is None else capture.lobes.scaled(rig.power)
        lights = (room.given, given), (room.harmonics, room.lobes()), (mean, None)
        before, after, spread = (calibration.room_share(*light).tolist() for light in lights)
        spread = [math.hypot(part, doubt(calibration)) for part in spread]
        unknowns["ambient"] = {"what": what, "before": before, "after": after, "std": spread,
                               "harmonics": room.harmonics.tolist(),
                               "lobes": [] if refined.lobes is None else refined.lobes.values().tolist()}  # fmt: skip

    corners = ring.center.cpu().numpy() + float(ring.radius) * np.concatenate([np.eye(3), -np.eye(3)])
    single = {name: unknown for name, unknown in calibration.unknowns.items() if unknown.single}
    for name, unknown in single.items():
        if isinstance(unknown, Exposure):
            values[name] = unknown.centred(calibration.value(name), rig).double().numpy(force=True)
    photographs: dict[str, dict[str, Any]] = {}
    for k in problem.fitted:
        before, after = (side.shots[k].whole.camera.project(corners)[0] for side in (capture, refined))
        own: dict[str, Any] = {"moved_px": float(np.linalg.norm(after - before, axis=1).mean())}
        std: dict[str, Any] = {}
        for name, unknown in single.items():
            if not unknown.concerns(rig, bool(rig.lit[k])):
                continue
            row = unknown.rows(rig, np.array([k]))[0][0]
            if entry := unknown.describe_photograph(values[name][row], deviations[name][row], rig):
                key, own[key], std[key] = entry
        photographs[capture.names[k]] = own | {"std": std}
    return {"refined": list(calibration.refined), "light": str(problem.lighting), "unknowns": unknowns,
            "correlations": [{"options": [one, other], "value": value} for one, other, value in joint.correlations()],
            "untold": joint.untold(), "photographs": photographs}  # fmt: skip
