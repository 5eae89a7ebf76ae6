"""Scans, sensors, range images and the projections between them; no neural networks."""
