"""Mitsuba scenes: their composition, lights and mesh attributes, and rays that are traced against their meshes.

May import: mitsuba, drjit, numpy, torch; geometry.
"""
