"""The networks as functions of points: encoding, multilayer perceptron, Shape-Net's flow and BRDF-Net's material.

May import: torch.
"""
