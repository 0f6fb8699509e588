"""Numbers that say how good a capture, a fit or the renderer is.

May import: mitsuba, drjit, numpy, scipy, skimage, trimesh, gpytoolbox, torch, igl; images, capture, plugins,
rendering, objects, scene, geometry, system.
"""
