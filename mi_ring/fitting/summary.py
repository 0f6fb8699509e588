"""What a fit has refined besides surface and material, as plain numbers: `calibration.json`."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mi_ring.capture.capture import Capture

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit


def summary(fit: "Fit", refined: Capture, deviations: dict[str, np.ndarray]) -> dict[str, Any]:
    """What was refined: of each unknown `before`, `after` and, but for the room's light, `std`, given the surface.

    `light`: what it was taken to be. `photographs`: of each that was not kept out how far its picture of the object
    moved [px]; if cameras were refined how far it was turned and moved, if powers or gains were, the factor of each
    colour. `refined`: the capture with all of it; `deviations`: as `mi_ring.fitting.covariance` has them.
    """
    calibration = fit.calibration
    assert calibration is not None
    with torch.no_grad():
        now = {name: calibration.value(name).double().numpy(force=True) for name in calibration.widths}
        strengthened = calibration.strengthened
        room = calibration.room
        given, share = (calibration.room_share(light).tolist() for light in (room.given, room.harmonics))
        factors = {name: calibration.centred(name).double().exp().numpy() for name in ("power", "gain") if name in now}
    unknowns: dict[str, dict[str, Any]] = {}

    def add(name: str, what: str, before: Any, after: Any, std: Any) -> None:
        before, after, std = (np.asarray(value, float).tolist() for value in (before, after, std))
        unknowns[name] = {"what": what, "before": before, "after": after, "std": std}

    old, new = fit.capture.shots, refined.shots
    lenses = np.unique(calibration.lens.numpy(), return_index=True)[1]
    focal = np.stack([new[k].camera.focal for k in lenses])
    if "light" in now and calibration.flash is not None:
        flash, units = calibration.level.numpy(), calibration.distance * calibration.free.numpy()
        add("light", "place of the flash in the cameras' axes: to the left, up, ahead [scene units]", flash,
            flash + units * now["light"][0], units * deviations["light"][0])  # fmt: skip
    elif "light" in now:
        first = np.unique(calibration.place.numpy(), return_index=True)[1]
        before, after = (c.photographs.lights.positions()[first] for c in (fit.capture, refined))
        units = np.where(calibration.finite.numpy()[first], calibration.distance, 1.0)
        which = "place of the first lamp" if fit.lighting.lamps else "places of the lights"
        add("light", f"{which} [scene units], directions to distant ones", before, after,
            units * deviations["light"])  # fmt: skip
    if "lamp" in now:
        with torch.no_grad():
            lamps, found = calibration.lamps, calibration.lamps_now()
        which, by = "the scene's lamps", ""
        if fit.lighting.lamps:
            first = refined.photographs.lights[0].rgb[0]
            which, by = "the other lamps", f" (of the first, by which all are, {first:.4g})"
        add("lamp", f"places of {which} [scene units], directions to distant ones", lamps.places, found.places,
            np.where(lamps.finite, calibration.distance, 1.0) * deviations["lamp"])  # fmt: skip
        add("strength", f"strengths of {which}: red, green, blue{by}", lamps.strengths, found.strengths,
            found.strengths.numpy() * deviations["strength"])  # fmt: skip
    if "focal" in now:
        add("focal", "focal length [px]", [old[k].camera.focal.mean() for k in lenses], focal.mean(1),
            focal.mean(1) * deviations["focal"])  # fmt: skip
    if "principal" in now:
        add("principal", "principal point [px]", [old[k].camera.centre for k in lenses],
            [new[k].camera.centre for k in lenses], focal * deviations["principal"])  # fmt: skip
    if "distortion" in now:
        add("distortion", "first radial distortion of the lens", [old[k].camera.distortion for k in lenses],
            [new[k].camera.distortion for k in lenses], deviations["distortion"])  # fmt: skip
    if "falloff" in now:
        add("falloff", "exponent of the flash's cone", np.mean([shot.falloff for shot in old]),
            np.mean([shot.falloff for shot in new]), deviations["falloff"])  # fmt: skip
    if "vignetting" in now:
        add("vignetting", "exponent of the lens' vignetting", np.mean([shot.response.vignetting for shot in old]),
            np.mean([shot.response.vignetting for shot in new]), deviations["vignetting"])  # fmt: skip
    if "curve" in now:
        gamma = np.mean([shot.response.gamma for shot in new])
        add("curve", "exponent of the camera's curve", np.mean([shot.response.gamma for shot in old]), gamma,
            gamma * deviations["curve"])  # fmt: skip
    if "contrast" in now:
        contrast = np.mean([shot.response.contrast for shot in new])
        add("contrast", "contrast of the camera's curve", np.mean([shot.response.contrast for shot in old]), contrast,
            contrast * deviations["contrast"])  # fmt: skip
    if "scale" in now:
        add("scale", "power of all lights together", 1, strengthened, strengthened * deviations["scale"])
    if "ambient" in calibration.refined:
        own = "first lamp" if fit.lighting.lamps else "flash"
        what = f"light of the room on the object, as shares of the {own}'s: red, green, blue"
        if fit.capture.photographs.dark:
            what = "mean radiance of the environment: red, green, blue"
        unknowns["ambient"] = {"what": what, "before": given, "after": share, "harmonics": room.harmonics.tolist()}

    center, radius = fit.ring.center.cpu().numpy(), float(fit.ring.radius)
    corners = center + radius * np.concatenate([np.eye(3), -np.eye(3)])
    photographs: dict[str, dict[str, Any]] = {}
    for k in fit.fitted:  # of those that are kept out nobody knows
        before, after = old[k], new[k]
        shift = after.camera.project(corners)[0] - before.camera.project(corners)[0]
        entry: dict[str, Any] = {"moved_px": float(np.linalg.norm(shift, axis=1).mean())}
        std: dict[str, Any] = {}
        for name, key, unit in (
            ("turn", "turned_degrees", np.degrees(1.0)),
            ("move", "moved", calibration.distance),
        ):
            if name in now:
                entry[key] = float(unit * np.linalg.norm(now[name][k]))
                std[key] = float(unit * np.linalg.norm(deviations[name][k]))
        for name, factor in factors.items():
            entry[name], std[name] = factor[k].tolist(), (factor[k] * deviations[name][k]).tolist()
        photographs[fit.capture.names[k]] = entry | {"std": std}
    return {"refined": list(calibration.refined), "light": str(fit.lighting), "unknowns": unknowns,
            "photographs": photographs}  # fmt: skip
