"""How a training run starts: from a shipped model, and beside other runs of the process."""

from pathlib import Path

import pytest
from accelerate import Accelerator
from accelerate.state import AcceleratorState

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import load_checkpoint
from lidar_synth.generate.generator import find_model
from lidar_synth.train import TrainConfig, load_config, run
from lidar_synth.train.start import start_networks


def test_a_shipped_model_is_a_start_by_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    networks, header = start_networks(load_config(TrainConfig, "town_teacher", ["init=town", "codec=null"]))
    shipped = load_checkpoint(find_model("town"))
    assert header.provenance["init"] == shipped.hash and set(networks) == set(shipped.networks)
    with pytest.raises(ConfigError, match="expected a shipped one"):
        start_networks(load_config(TrainConfig, "town_teacher", ["init=towns", "codec=null"]))


@pytest.mark.slow
def test_runs_of_one_process_may_differ_in_precision(tmp_path: Path) -> None:
    short = ["recipe.iterations=1", "recipe.batch=1", "data.town=2", "samples.every=0"]

    def config(name: str, precision: str) -> TrainConfig:
        return load_config(TrainConfig, "town_tiny", [*short, f"output={tmp_path / name}", f"precision={precision}"])

    for precision in ("bf16", "no"):
        assert run(config(precision, precision)).exists()
    AcceleratorState._reset_state()
    mine = Accelerator(mixed_precision="no")  # the caller's own stays as it is
    with pytest.raises(ConfigError, match="precision=bf16, where this process has set up Accelerate with 'no'"):
        run(config("refused", "bf16"))
    assert run(config("same", "no")).exists() and mine.mixed_precision == "no"
    AcceleratorState._reset_state()
