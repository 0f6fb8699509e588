"""Captures: photographs with cameras, lights and masks, from scene files or arrays; and the writer of scene files.

May import: mitsuba, numpy, scipy, skimage, cv2, torch, trimesh; foreign, images, plugins, rendering, objects, scene,
nets, geometry, system.
"""
