"""Writes output files: meshes, textures, scenes, pictures, films, contact sheets and reports.

May import: mitsuba, numpy, scipy, skimage, trimesh, torch, PIL, matplotlib, jinja2, imageio_ffmpeg, pygltflib, xatlas,
tyro; images, metrics, capture, plugins, rendering, objects, scene, geometry, system.
"""
