"""Captures: photographs with cameras, lights and masks, read from scene files or arrays, and written to scene files.

May import: mitsuba, numpy, scipy, skimage, cv2, torch, trimesh; colour_profiles, foreign, image_headers, images,
plugins, rendering, objects, scene, nets, geometry, system.
"""
