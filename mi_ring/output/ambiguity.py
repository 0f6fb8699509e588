"""Warnings about what photographs cannot tell."""

from pathlib import Path
from typing import Any

from mi_ring.system.files import read_json

ALIKE = 0.9  #: correlation of unknowns above which photographs hardly tell them apart


def ambiguity(light: str) -> str:
    """Return a warning for the user about what the fit could not determine; empty if the capture gave the light.

    `light`: kind of light that the fit assumed, as calibration.json names it, for example "capture" (given) or "2
    lamps".
    """
    if light == "capture":
        return ""
    text = ("The light was unknown: its brightness and colour cannot be separated from those of the object. "
            "The fit assumes that the object reflects half of the light in each colour")  # fmt: skip
    if "lamp" not in light:
        text += "; smooth variations of light and reflectance can hardly be separated either"
    return text + "."


def hardly_told_apart(correlations: list[dict[str, Any]]) -> str:
    """Return a warning about unknowns that photographs hardly tell apart. `correlations`: those of calibration.json."""
    alike = [pair for pair in correlations if pair["value"] > ALIKE]
    pairs = [f"{' and '.join(pair['options'])} (correlation {pair['value']:.2f})" for pair in alike]
    return f"The photographs hardly tell apart {', '.join(pairs)}." if pairs else ""


def hardly_told(untold: list[str]) -> str:
    """Return a warning about unknowns that stay as uncertain as before. `untold`: those of calibration.json."""
    return f"The photographs hardly tell {' and '.join(untold)}: the prior does." if untold else ""


def ambiguity_of(run: Path) -> str:
    """Return a warning about what a fit under unknown light could not determine; empty if the light was given.

    Reads calibration.json. `run`: results folder of the fit, or its file ring.pt.
    """
    record = read_json((run if run.is_dir() else run.parent) / "calibration.json")
    light = record.get("light") if isinstance(record, dict) else None
    return ambiguity(light) if isinstance(light, str) else ""
