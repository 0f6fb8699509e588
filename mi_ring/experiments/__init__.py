"""The paper's tables and figures: fits of datasets, and their results beside published numbers.

May import: mitsuba, drjit, numpy, scipy, torch, matplotlib; foreign, images, collection, fitting, synthesis,
importers, output, metrics, capture, rendering, objects, scene, geometry, system.
"""
