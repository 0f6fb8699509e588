"""Fits of many scenes, on one machine or on a Ray cluster: jobs, retries, and records of their state.

May import: ray; output, system.
"""
