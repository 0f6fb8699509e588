"""A fitted object: the two networks with their domain, its file `ring.pt`, and edits of its material.

May import: numpy, torch, trimesh; nets, geometry, system.
"""
