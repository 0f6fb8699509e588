"""What photographs do not tell where their light was unknown, in words."""

from pathlib import Path

from mi_ring.system.files import read_json


def ambiguity(light: str) -> str:
    """Of a light as a fit's `summary` names it; empty where the scene says what it is."""
    if light == "capture":
        return ""
    text = ("The light was unknown: how bright it is, and of which colour, cannot be told from the object's. "
            "The object is taken to reflect half of it, in each colour")  # fmt: skip
    if "lamp" not in light:
        text += "; slow changes of light and of reflectance can hardly be told apart, either"
    return text + "."


def ambiguity_of(run: Path) -> str:
    """The same of a results folder, or of a ring.pt in one."""
    record = read_json((run if run.is_dir() else run.parent) / "calibration.json")
    light = record.get("light") if isinstance(record, dict) else None
    return ambiguity(light) if isinstance(light, str) else ""
