"""Photographs of a surface, and their gradients: cameras, lights, shading, edges, and the seam to torch.

May import: mitsuba, drjit, numpy, torch; foreign, images, nets, ring, geometry.
"""
