"""Encoders of conditions, each of which becomes maps beside the state or tokens that the state attends to."""
