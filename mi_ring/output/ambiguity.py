"""The warning that a fit under unknown light cannot determine everything."""

from pathlib import Path

from mi_ring.system.files import read_json


def ambiguity(light: str) -> str:
    """Return the warning for this kind of light, a text for the user; empty if the capture gives the light.

    `light`: `light` in calibration.json, for example "capture" or "2 lamps".
    """
    if light == "capture":
        return ""
    text = ("The light was unknown: its brightness and colour cannot be separated from those of the object. "
            "The fit assumes that the object reflects half of the light in each colour")  # fmt: skip
    if "lamp" not in light:
        text += "; smooth variations of light and reflectance can hardly be separated either"
    return text + "."


def ambiguity_of(run: Path) -> str:
    """Return the warning of `ambiguity` for a fit. Reads its calibration.json. `run`: results folder, or ring.pt."""
    record = read_json((run if run.is_dir() else run.parent) / "calibration.json")
    light = record.get("light") if isinstance(record, dict) else None
    return ambiguity(light) if isinstance(light, str) else ""
