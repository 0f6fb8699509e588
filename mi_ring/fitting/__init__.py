"""The fit: its problem, model, schedule, sampler, renderer, loss and optimisation, and a session with checkpoints.

May import: mitsuba, numpy, scipy, torch, cv2, trimesh, tqdm; images, output, calibration, capture, rendering, objects,
scene, nets, geometry, system.
"""
