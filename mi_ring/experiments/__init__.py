"""The paper's tables and figures: lists of fits, and what is made of them, beside what was published.

May import: mitsuba, drjit, numpy, scipy, trimesh, torch, matplotlib; collection, fitting, synthesis, importers, output,
metrics, capture, nets, rendering, ring, geometry, foreign, images, system.
"""
