"""Synthetic captures of known objects: scene, lights, cameras, path tracing by stock Mitsuba, and simulated errors.

May import: mitsuba, drjit, numpy, scipy, trimesh, tyro; foreign, images, photogrammetry, capture, plugins,
rendering, scene, geometry, system.
"""
