"""Calibration that a fit refines: the unknowns of cameras and lights, their values, and the light of the room.

May import: numpy, torch; images, capture, rendering, scene, geometry, system.
"""
