"""Surfaces and cameras as arrays: domains, visual hulls of masks, closed meshes.

May import: numpy, scipy, skimage, cv2, torch, trimesh, gpytoolbox; foreign, system.
"""
