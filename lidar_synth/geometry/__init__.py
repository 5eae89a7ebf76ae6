"""Scans, sensors and range images: everything that knows angles and metres, and nothing of networks."""
