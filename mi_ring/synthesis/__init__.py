"""Makes synthetic captures of known objects: scene, lights and cameras, path tracing by Mitsuba, simulated errors.

May import: mitsuba, drjit, numpy, scipy, trimesh, tyro; colour_profiles, foreign, images, photogrammetry, capture,
plugins, rendering, scene, geometry, system.
"""
