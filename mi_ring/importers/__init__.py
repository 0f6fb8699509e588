"""Importers of captures from other tools, one file per format, and the writer of the scene files.

May import: mitsuba, numpy, scipy, PIL, pycolmap, pygltflib, tyro; colour_profiles, fields, foreign, image_fields,
image_headers, images, capture, rendering, scene, geometry, system.
"""
