"""Claims: a folder is resumed with the settings that it was begun with, and no others."""

import json
from pathlib import Path

import pytest

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.claims import claim, hold_claim

SETTINGS = {"seed": 4, "objects": None}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "settings.json"


def test_the_same_settings_resume(path: Path) -> None:
    claim(path, SETTINGS)
    claim(path, SETTINGS)
    assert json.loads(path.read_text()) == SETTINGS


def test_a_setting_that_is_not_recorded_was_none(path: Path) -> None:
    claim(path, {"seed": 4})
    claim(path, SETTINGS)
    with pytest.raises(ConfigError, match="'objects': None.*'objects': 'cast'"):
        claim(path, {"seed": 4, "objects": "cast"})


def test_a_setting_that_is_no_longer_given_is_refused(path: Path) -> None:
    claim(path, {**SETTINGS, "reflectance_max": 255.0})
    with pytest.raises(ConfigError, match="255.0}; expected {'reflectance_max': None}"):
        claim(path, SETTINGS)


def test_another_value_is_refused(path: Path) -> None:
    claim(path, SETTINGS)
    with pytest.raises(ConfigError, match="was filled with {'seed': 4}"):
        claim(path, {**SETTINGS, "seed": 5})


def test_a_damaged_claim_is_refused(path: Path) -> None:
    path.write_text("[4]")
    with pytest.raises(DataError, match="it holds list"):
        claim(path, SETTINGS)


def test_a_call_that_wrote_nothing_leaves_no_claim(path: Path) -> None:
    with pytest.raises(RuntimeError), hold_claim(path, SETTINGS):
        raise RuntimeError
    assert not path.exists()
