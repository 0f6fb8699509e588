"""The networks, as functions of points: encoding, perceptron, Shape-Net's flow, BRDF-Net's reflectance.

May import: torch.
"""
