"""A reconstructed object: both networks with their domain and normalisation, and its material, edited or exchanged.

May import: numpy, torch, trimesh; nets, geometry, system.
"""
