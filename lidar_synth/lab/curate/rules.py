"""Rules about scores: ``confidence < 0.5``, ``duplicate > 0.99 and empty <= 0.3``.

A rule joins conditions by "and"; a condition is a score's name, one of < <= > >=, and a number.
Several rules together select every scan that at least one of them matches.
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

_CONDITION = re.compile(
    r"\s*(\w+)\s*([<>]=?)\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*"
)


def matching(rule: str, scores: Mapping[str, NDArray[np.float64]]) -> NDArray[np.bool_]:
    """Select the scans that a rule matches.

    Args:
        rule: a rule as described in the module.
        scores: {name: (N,)}, at least one.

    Returns:
        (N,) whether each scan matches.

    Raises:
        ConfigError: on an invalid rule or an unknown score.
    """
    selected = np.ones(len(next(iter(scores.values()))), bool)
    for condition in re.split(r"\band\b", rule):
        match = _CONDITION.fullmatch(condition)
        if match is None:
            raise ConfigError(
                f"rule {rule!r}",
                "a score, < <= > or >=, and a number: 'confidence < 0.5'",
            )
        name, sign, number = match.groups()
        if name not in scores:
            raise ConfigError(
                f"score {name!r} in rule {rule!r}", f"one of {', '.join(scores)}"
            )
        selected &= OPERATORS[sign](scores[name], float(number))
    return selected
