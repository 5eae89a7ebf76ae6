"""Learning rates over a run, as factors of the recipe's rate.

To add one: write it, enter it in ``SCHEDULES``.
"""

import math
from collections.abc import Callable

ENDLESS = 10**9
"""Iterations of a run that a limit of time or early stopping ends."""
PLATEAU = 0.75
"""Share of the iterations before ``trapezoid`` falls."""


def cosine(step: int, warmup: int, iterations: int) -> float:
    """Linear from 0 over ``warmup`` steps, then down to 0 along half a cosine."""
    if step < warmup:
        return (step + 1) / warmup
    return (1 + math.cos(math.pi * (step - warmup) / max(1, iterations - warmup))) / 2


def trapezoid(step: int, warmup: int, iterations: int) -> float:
    """Linear from 0 over ``warmup`` steps, constant, then linear to 0 over the last quarter: up to
    there a run does not depend on ``iterations``, which may still be changed."""
    falling = (iterations - step) / ((1 - PLATEAU) * iterations)
    return min(constant(step, warmup, iterations), falling)


def constant(step: int, warmup: int, iterations: int) -> float:
    """Linear from 0 over ``warmup`` steps, then constant."""
    return min(1.0, (step + 1) / max(1, warmup))


SCHEDULES: dict[str, Callable[[int, int, int], float]] = {
    "constant": constant,
    "cosine": cosine,
    "trapezoid": trapezoid,
}
"""Learning rates by name: (step, warm-up, iterations) to a factor in [0, 1]."""
