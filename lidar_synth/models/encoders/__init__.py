"""Encoders of conditions: label maps and camera images."""
