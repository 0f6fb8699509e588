"""Calibration as something to be refined: the unknowns of cameras and lights, their values, and the room's light.

May import: numpy, torch; images, capture, rendering, scene, geometry, system.
"""
