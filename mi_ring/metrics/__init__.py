"""Measures the quality of captures, fits and the renderer.

May import: mitsuba, drjit, numpy, scipy, skimage, trimesh, gpytoolbox, torch, igl; image_headers, images, capture,
plugins, rendering, objects, scene, geometry, system.
"""
