"""A fitted object (networks, domain, details), the file `ring.pt` that stores it, and edits of its material.

May import: mitsuba, numpy, scipy, torch, trimesh; rendering, scene, nets, geometry, system.
"""
