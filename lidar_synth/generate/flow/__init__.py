"""Rectified flow for any velocity ``v(y, t, c)``: path and losses, solvers, timestep selection,
distillation."""
