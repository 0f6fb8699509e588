"""Surfaces and cameras as arrays: domains, visual hulls of masks, closed meshes.

May import: numpy, scipy, torch, trimesh, skimage, gpytoolbox; foreign, system.
"""
