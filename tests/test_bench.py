"""Every benchmark of tools/bench runs, with the arguments that make it shortest."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from project import ROOT
from small_models import write

from lidar_synth.generate.models.hdit.hdit import HDiT
from lidar_synth.geometry.sensor import load_sensor

BENCH = ROOT / "tools" / "bench"
SHARED = {"timing", "untrained"}
"""Files that the scripts share."""
SMALLEST = {
    "bake": "--model {pixels} --count 2 --lengths 2 2 --rounds 1",
    "bank": "--model {pixels} --scans 2 --generated 1 --tree 2",
    "extractors": "--only squeezeseg --rounds 1",
    "gpu": "{pixels} --device cpu --dtype float32 --batch 1 --rounds 1",
    "label": "--scans 4 --points 1",
    "latent": "--width 32 --rounds 1",
    "million": "--shards 2",
    "link": "--scans 2 --rates 1000 --delay 1",
    "mixing": "--scans 2 --rounds 1",
    "networks": "--model {full_size} --rounds 1",
    "projection": "--rounds 1",
    "scans": "{maps} --steps 1 --rounds 1",
    "service": "--rounds 1",
    "town": "--stretches 1 --jobs 1",
    "trainers": "",
    "transfer": "--rounds 1",
    "weather": "--rounds 1",
}
"""{script: arguments}, with the names of ``models``."""


def test_a_training_step_is_divided(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(BENCH))
    import networks

    angles = torch.from_numpy(load_sensor("hdl64e_kitti360").ray_angles())
    small = {"width": 16, "depths": [1], "heads": [2], "patch": [8, 16]}
    net = HDiT((64, 1024), angles=angles, **small)
    monkeypatch.setattr(networks, "full_network", lambda model: net)
    networks.on_training("hdit", batch=2, rounds=2)
    found = re.search(r"time (\S+) s, .* network (\S+) s", capsys.readouterr().out)
    assert found is not None
    assert 0 < float(found[2]) < float(found[1])


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Checkpoints with random weights: of pixels, of label maps, and one of 64 x 1024 cells."""
    folder = tmp_path_factory.mktemp("models")
    sys.path.append(str(BENCH))
    from untrained import write_untrained

    sys.path.remove(str(BENCH))
    return {
        "pixels": write(folder / "pixels.safetensors"),
        "maps": write(folder / "maps.safetensors", dropout=0.1),
        "full_size": write_untrained(folder / "full_size.safetensors"),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", sorted({path.stem for path in BENCH.glob("*.py")} - SHARED)
)
def test_a_benchmark_prints_its_tables(name: str, models: dict[str, Path]) -> None:
    arguments = SMALLEST[name].format(**models).split()
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, BENCH / f"{name}.py", *arguments]
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (
        "|---" in done.stdout or "| ---" in done.stdout or "not measured" in done.stdout
    )
