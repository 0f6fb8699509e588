"""Surfaces and cameras as arrays: domains, the masks' visual hull, closed meshes.

May import: numpy, scipy, torch, trimesh, skimage, gpytoolbox; foreign, system.
"""
