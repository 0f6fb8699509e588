"""The fit: where it starts, its stages, the terms of its loss, the loop, and a whole session with its checkpoints.

May import: mitsuba, numpy, scipy, torch, cv2, trimesh, tqdm; images, output, capture, rendering, objects, scene, nets,
geometry, system.
"""
