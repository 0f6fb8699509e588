"""A fitted object: the two networks with their domain, its file `ring.pt`, and edits of its material.

May import: mitsuba, numpy, torch, trimesh; rendering, scene, nets, geometry, system.
"""
