"""A fitted object (two networks and their domain), the file `ring.pt` that stores it, and edits of its material.

May import: mitsuba, numpy, torch, trimesh; rendering, scene, nets, geometry, system.
"""
