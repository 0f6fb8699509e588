"""The paper's tables and figures: they fit datasets, and show the results beside published numbers.

May import: mitsuba, drjit, numpy, scipy, torch, matplotlib; foreign, images, collection, fitting, synthesis,
importers, output, metrics, capture, rendering, objects, scene, geometry, system.
"""
