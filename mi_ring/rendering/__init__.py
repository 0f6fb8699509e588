"""Predicted photographs of a surface and their gradients: cameras, lights, edges, and the bridge to torch.

May import: mitsuba, drjit, numpy, torch; foreign, images, nets, scene, geometry.
"""
