"""The networks, as functions of points: encoding, perceptron, Shape-Net's flow, BRDF-Net's material.

May import: torch.
"""
