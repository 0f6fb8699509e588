"""Captures of other tools, one file a format, and the scene files that they become.

May import: mitsuba, numpy, scipy, PIL, pycolmap, tyro; foreign, images, capture, rendering, scene, geometry, system.
"""
