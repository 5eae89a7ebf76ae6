"""Rules about scores: which scans they select, and which texts are refused."""

import numpy as np
import pytest

from lidar_synth.errors import ConfigError
from lidar_synth.lab.curate import matching

SCORES = {"confidence": np.array([0.1, 0.5, 0.9]), "empty": np.array([0.3, 0.2, 0.1])}


@pytest.mark.parametrize(
    ("rule", "selected"),
    [
        ("confidence < 0.5", [True, False, False]),
        ("confidence<=.5", [True, True, False]),
        (" empty > 1e-1 ", [True, True, False]),
        ("empty >= 0.1", [True, True, True]),
        ("confidence > 0.2 and empty > 0.1", [False, True, False]),
        ("confidence > -1 and empty < +2. and empty < 0.15", [False, False, True]),
    ],
)
def test_rules_select_scans(rule: str, selected: list[bool]) -> None:
    assert matching(rule, SCORES).tolist() == selected


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ("", "rule ''; expected a score"),
        ("confidence", "rule 'confidence'; expected a score"),
        ("confidence = 0.5", "expected a score, < <= > or >=, and a number"),
        ("0.5 < confidence", "expected a score, < <= > or >=, and a number"),
        ("confidence < 0.5 or empty > 0", "expected a score"),
        ("confidence < nan", "expected a score"),
        ("confidence < 0.5 and", "expected a score"),
        ("confidence < 0.5); print(1", "expected a score"),
        ("__import__('os') < 1", "expected a score"),
        (
            "colour < 1",
            "score 'colour' in rule 'colour < 1'; expected one of confidence, empty",
        ),
    ],
)
def test_invalid_rules_are_refused(rule: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        matching(rule, SCORES)
