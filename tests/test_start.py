"""A training run starts from a shipped model by its name."""

from pathlib import Path

import pytest

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import load_checkpoint
from lidar_synth.generate.generator import find_model
from lidar_synth.train import TrainConfig, load_config
from lidar_synth.train.start import start_networks


def test_a_shipped_model_is_a_start_by_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    networks, header = start_networks(load_config(TrainConfig, "town_teacher", ["init=town", "codec=null"]))
    shipped = load_checkpoint(find_model("town"))
    assert header.provenance["init"] == shipped.hash and set(networks) == set(shipped.networks)
    with pytest.raises(ConfigError, match="expected a shipped one"):
        start_networks(load_config(TrainConfig, "town_teacher", ["init=towns", "codec=null"]))
