"""A scene file and its photographs: read, decoded, as tensors; and the one writer of scene files.

May import: mitsuba, numpy, scipy, skimage, cv2, torch, trimesh; foreign, images, plugins, rendering, objects, scene,
nets, geometry, system.
"""
