"""Fits of many scenes, on one machine or many: what is left to do, each fit to its end whatever is killed, Ray.

May import: ray; output, system.
"""
