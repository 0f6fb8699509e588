"""Mitsuba scenes: their parts, lights and mesh attributes, and rays that are traced against their meshes.

May import: mitsuba, drjit, numpy, torch; geometry.
"""
