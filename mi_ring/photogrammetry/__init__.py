"""From a folder of photographs to a capture: pictures, structure from motion, the printed sheet, masks, crops.

May import: numpy, scipy, skimage, cv2, trimesh, PIL, pillow_heif, rawpy, pycolmap, rembg; foreign, images, importers,
capture, geometry, fitting, rendering, scene, system.
"""
