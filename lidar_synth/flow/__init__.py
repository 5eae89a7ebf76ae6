"""Rectified flow: path and losses, solvers, timestep selection, distillation. Takes any callable ``v(y, t, c)``."""
