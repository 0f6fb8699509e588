"""Captures of other tools, one file a format, and the scene files that they become.

May import: mitsuba, numpy, scipy, PIL, pycolmap, tyro; images, capture, rendering, geometry, system.
"""
