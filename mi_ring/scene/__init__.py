"""Mitsuba scenes: their parts, lights and mesh attributes, and rays against their meshes.

May import: mitsuba, drjit, numpy, torch; geometry.
"""
