"""From a folder of photographs to a capture: cameras by structure from motion or the printed sheet, masks, crops.

May import: numpy, scipy, torch, skimage, cv2, trimesh, PIL, rawpy, pycolmap, rembg; colour_profiles, foreign,
image_headers, images, importers, capture, geometry, nets, fitting, rendering, scene, system.
"""
