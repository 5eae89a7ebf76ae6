"""Encoders of conditions: each produces maps on the grid of the state, or tokens to which the state
attends."""
