"""The paper's tables and figures: lists of fits, and what is made of them, beside what others have published.

May import: mitsuba, drjit, numpy, scipy, torch, matplotlib; foreign, images, collection, fitting, synthesis,
importers, output, metrics, capture, rendering, objects, scene, geometry, system.
"""
