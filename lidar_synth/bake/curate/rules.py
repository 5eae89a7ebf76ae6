"""Rules about scores: ``confidence < 0.5``, ``duplicate > 0.99 and empty <= 0.3``.

A rule is conditions joined by "and"; a condition is a score's name, one of < <= > >=, and a number. Several rules mean
what any of them means.
"""

import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError

OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}

_CONDITION = re.compile(r"\s*(\w+)\s*([<>]=?)\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*")


def matching(rule: str, scores: Mapping[str, NDArray[np.float64]]) -> NDArray[np.bool_]:
    """(N,) which scans a rule means.

    Args:
        rule: see the module.
        scores: {name: (N,)}, at least one.

    Raises:
        ConfigError: on what is no rule, or a score that there is not.
    """
    means = np.ones(len(next(iter(scores.values()))), bool)
    for condition in re.split(r"\band\b", rule):
        match = _CONDITION.fullmatch(condition)
        if match is None:
            raise ConfigError(f"rule {rule!r}", "a score, < <= > or >=, and a number: 'confidence < 0.5'")
        name, sign, number = match.groups()
        if name not in scores:
            raise ConfigError(f"score {name!r} in rule {rule!r}", f"one of {', '.join(scores)}")
        means &= OPERATORS[sign](scores[name], float(number))
    return means
