"""From a folder of photographs to a capture: pictures, structure from motion, the printed sheet, masks, crops.

May import: numpy, scipy, cv2, PIL, pillow_heif, rawpy, pycolmap, tqdm; images, importers, capture, geometry, rendering,
system.
"""
