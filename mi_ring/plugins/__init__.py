"""The Mitsuba plugins, one file per plugin with the plugin's name.

May import: mitsuba, drjit, numpy, torch; rendering, objects, scene, geometry.
"""

import importlib
import sys

#: Ordered so that each comes after those that it imports.
PLUGINS = ("photograph", "flash", "room", "fine_attribute", "cooktorrance", "merl", "shapenet", "table", "photometric")


def register() -> None:
    """Define and register the plugins for the current variant of Mitsuba. Call it after each change of the variant."""
    for name in PLUGINS:
        module = f"{__name__}.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)
