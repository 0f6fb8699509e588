"""The Mitsuba plugins, one file each, named like it.

May import: mitsuba, drjit, numpy, torch; rendering, objects, scene, geometry.
"""

import importlib
import sys

#: In the order in which they need each other.
PLUGINS = ("photograph", "flash", "room", "cooktorrance", "merl", "shapenet", "table", "photometric")


def register() -> None:
    """Define the plugins for the current variant of Mitsuba: classes belong to one variant."""
    for name in PLUGINS:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)
