"""The section of the report about refined calibration: a table, and charts of the values before and after the fit."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.images import linear_to_srgb
from mi_ring.output.ambiguity import ambiguity, hardly_told, hardly_told_apart
from mi_ring.output.svg import new_figure, svg_uri
from mi_ring.rendering.spherical_harmonics import PER_FRAME, room_envmap
from mi_ring.scene.assembly import lamp_lights

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BEFORE, AFTER = "0.6", "tab:orange"  #: colours
VISIBLE = 0.01  #: the least shift of a photograph that is drawn [px]
BRIGHTEST = 3  #: lights of the room that are listed
LISTED = 6  #: unknowns of one kind that are listed one by one


class Panel(NamedTuple):
    """The report's section about calibration: a table, a chart and a warning about what the fit could not determine."""

    rows: list[tuple[str, str, str, str]]  #: quantity, before, after, standard deviation
    chart: str  #: a data URI
    untold: str  #: warnings of `mi_ring.output.ambiguity`


def panel(before: Capture, after: Capture, refined: dict[str, Any]) -> Panel:
    """Make the report's section about calibration. Draws its chart, and renders nothing.

    `before`, `after`: the capture with the calibration before and after the fit. `refined`: content of
    calibration.json.
    """
    rows = [row(entry) for entry in refined["unknowns"].values()]
    light = refined.get("light", "capture")
    if light != "capture":
        rows.insert(0, ("kind of light, by coarse fits", "", light, ""))
    rows += small_lights(after) + [row(entry) for entry in of_photographs(refined["photographs"])]
    texts = ambiguity(light), hardly_told_apart(refined.get("correlations", [])), hardly_told(refined.get("untold", []))
    untold = " ".join(filter(None, texts))
    return Panel(rows, chart(before, after, refined["photographs"]), untold)


def small_lights(capture: Capture) -> list[tuple[str, str, str, str]]:
    """Describe the brightest lobes of the room's light in rows: direction, width, and share of all its light."""
    lobes = capture.lobes
    if lobes is None:
        return []
    smooth = 0 if capture.room is None else np.sqrt(4 * np.pi) * capture.room[0].mean()
    shares = lobes.flux.mean(1) / max(lobes.flux.mean(1).sum() + smooth, 1e-12)
    rows = []
    for place, k in enumerate(np.argsort(-shares)[:BRIGHTEST]):
        axes = "camera" if lobes.in_camera[k] else "world"
        half = np.degrees((2 * np.log(2) / lobes.sharpness[k]) ** 0.5)
        what = f"{'brightest light' if place == 0 else 'another light'}: direction in the axes of the {axes}"
        found = f"{numbers(lobes.toward[k], 3)}; half as bright {half:.2g}° away; {shares[k]:.0%} of the light"
        rows.append((what, "", found, ""))
    return rows


def row(entry: dict[str, Any]) -> tuple[str, str, str, str]:
    """Format an unknown as a row: (quantity, value in the scene file, value that the fit found, standard deviation).

    `entry`: the unknown's entry in calibration.json, with keys `what`, `before`, `after` and `std`. If it has more than
    `LISTED` values, the second cell is empty, the third has the median and the largest change, and the fourth a median.
    """
    if np.size(entry["after"]) > LISTED:
        several = len(entry["after"]), -1
        moved = np.linalg.norm(np.subtract(entry["after"], entry["before"]).reshape(several), axis=1)
        spread = np.linalg.norm(np.reshape(entry["std"], several), axis=1)
        return entry["what"], "", f"by {np.median(moved):.3g}, at most {moved.max():.3g}", f"{np.median(spread):.2g}"
    before, after, std = (numbers(entry[key], digits) for key, digits in (("before", 4), ("after", 4), ("std", 2)))
    return entry["what"], before, after, std


def numbers(value: Any, digits: int) -> str:
    """Format a number or a list of numbers as text, separated by commas, each with `digits` significant digits."""
    values = np.ravel(value)
    least = 1e-6 * np.abs(values).max()  # below it is rounding
    return ", ".join(f"{0.0 if abs(v) < least else v:.{digits}g}" for v in values)


def of_photographs(photographs: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Summarise the refined poses and lights of single photographs by medians over all photographs.

    `photographs`: `photographs` in calibration.json, an entry for each file name. Returns an entry for each quantity: a
    dictionary with keys `what` (a text with the unit), `before` (0), `after` and `std`.
    """
    entries = list(photographs.values())
    result = []
    for key, what in (("turned_degrees", "cameras turned, median [°]"), ("moved", "and moved, median [scene units]")):
        if key in entries[0]:
            middle, spread = (np.median([e[key] for e in side]) for side in (entries, [e["std"] for e in entries]))
            result.append({"what": what, "before": 0, "after": middle, "std": spread})
    for key in ("power", "gain"):
        if told := [entry for entry in entries if key in entry]:
            off = np.median([np.abs(np.log(e[key])).mean() for e in told])
            spread = np.median([np.divide(e["std"][key], e[key]).mean() for e in told])
            result.append({"what": f"{key} of photographs, off the mean, median [%]", "before": 0, "after": 100 * off,
                           "std": 100 * spread})  # fmt: skip
    return result


def held_out_text(held_out: dict[str, Any]) -> str:
    """Return a text for the user: how well the fit predicts the photographs that it did not use.

    `held_out`: `held_out` in calibration.json, with the shares `unexplained` and `before` of the object's light, and
    `put_back`, the kinds of unknowns that were reset. It is empty if the fit ended early.
    """
    if not held_out:
        return "not tested: the fit ended early"
    if "unexplained" not in held_out:
        return "not tested: no pixel in them is surely of the object"
    text = f"{held_out['unexplained']:.1%} of the object's light in them is unexplained"
    if "before" in held_out:
        text += f"; {held_out['before']:.1%} with the calibration before the fit"
    if held_out["put_back"]:
        text += f"; reset, because the refinement did not help: {', '.join(held_out['put_back'])}"
    return text


def chart(before: Capture, after: Capture, photographs: dict[str, dict[str, Any]]) -> str:
    """Draw one or two diagrams about the calibration. Returns them as one SVG data URI.

    The first shows cameras and lights from above, before and after the fit. The second shows the first of these that
    was refined: the unknown environment, the shift of the object in each photograph, the light power of each
    photograph. `photographs`: `photographs` in calibration.json, an entry for each file name.
    """
    moved = [entry["moved_px"] for entry in photographs.values()]
    power = np.array([entry["power"] for entry in photographs.values() if "power" in entry])
    light = None if after.photographs.lit.all() else after.photographs.room
    told = max(moved) > VISIBLE or len(power) or light is not None  # otherwise there is no second chart
    figure = new_figure(9 if told else 4.5, 3.4)
    plan, *others = figure.subplots(1, 2 if told else 1, squeeze=False)[0]
    up = before.up
    right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    plane = np.stack([right / np.linalg.norm(right), np.cross(up, right / np.linalg.norm(right))])
    draw_plan(plan, before, plane, BEFORE, "before")
    draw_plan(plan, after, plane, AFTER, "after")
    plan.legend(fontsize=8)
    plan.set_aspect("equal", "datalim")
    plan.set_title("cameras, lights (•) and lamps (★) from above [scene units]", fontsize=9)
    for bars in others:
        if light is not None:
            frame = "camera" if light[PER_FRAME:].any() else "world"
            radiance = room_envmap(light, np.eye(4), lobes=after.lobes).clip(min=0)
            bars.imshow(linear_to_srgb(radiance / max(float(radiance.max()), 1e-9)))
            bars.axis("off")
            bars.set_title(f"the environment, by longitude and latitude, y of the {frame} up", fontsize=9)
            continue
        if max(moved) > VISIBLE:
            bars.bar(range(len(moved)), moved, color=AFTER)
            bars.set_ylabel("pixels")
            bars.set_title("shift of the object in each photograph", fontsize=9)
        else:
            for channel, colour in zip(power.T, ("tab:red", "tab:green", "tab:blue")):
                bars.plot(channel, ".", color=colour)
            bars.axhline(1, color=BEFORE, linewidth=1)
            bars.set_title("power of the light of each photograph, by colour", fontsize=9)
        bars.set_xlabel("photograph (without held-out ones)")
    with np.errstate(invalid="ignore"):  # cameras that are all in one place have no scale
        return svg_uri(figure)


def draw_plan(axes: "Axes", capture: Capture, plane: np.ndarray, colour: str, label: str) -> None:
    """Draw cameras, viewing directions and lights of a capture into `axes`, projected orthogonally to a plane.

    `plane` (2, 3): two orthogonal unit vectors that span the plane. `colour`: of all marks. `label`: for the legend.
    """
    poses = np.stack([shot.camera.to_world for shot in capture.shots])
    places, ahead = poses[:, :3, 3] @ plane.T, poses[:, :3, 2] @ plane.T
    axes.quiver(*places.T, *ahead.T, color=colour, angles="xy", scale=12, width=0.004, label=label)
    lights = capture.photographs.lights
    x, y = (lights.positions()[lights.is_finite() & lights.rgb().any(1)] @ plane.T).T
    axes.scatter(x, y, s=8, c=colour)
    lamps = [lamp.vector for lamp in lamp_lights(capture.scene) if lamp.kind == "point"]
    x, y = plane @ np.reshape(lamps, (-1, 3)).T
    axes.scatter(x, y, s=60, c=colour, marker="*")
