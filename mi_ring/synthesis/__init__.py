"""Captures of known objects: their stage, lights and cameras, path traced by stock Mitsuba, and what goes wrong.

May import: mitsuba, drjit, numpy, scipy, trimesh, tyro; foreign, images, photogrammetry, capture, plugins,
rendering, scene, geometry, system.
"""
