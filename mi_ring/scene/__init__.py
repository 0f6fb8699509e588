"""Mitsuba scenes: how they are put together and lit, mesh attributes, and rays against meshes.

May import: mitsuba, drjit, numpy, torch; objects, geometry.
"""
