"""``lidar-synth evaluate`` on scans on disk."""

import json
from pathlib import Path

import pytest
from conftest import random_scan
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.formats import WRITERS
from lidar_synth.metrics import PROTOCOLS
from lidar_synth.sensor import presets


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("sets")
    for first, name in ((0, "real"), (10, "fake")):
        for i in range(3):
            WRITERS["npz"](root / name).write(random_scan(presets()["town"], 4000, seed=first + i), i)
    return root / "real", root / "fake"


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_figure_names_its_protocol_and_its_sets(folders: tuple[Path, Path], protocol: str) -> None:
    real, fake = map(str, folders)
    result = CliRunner().invoke(app, ["evaluate", real, fake, "--protocol", protocol, "--json"])
    assert result.exception is None, result.output
    apart = json.loads(result.output)
    assert apart and all((s["protocol"], s["real"], s["generated"]) == (protocol, 3, 3) for s in apart)
    same = json.loads(CliRunner().invoke(app, ["evaluate", real, real, "--protocol", protocol, "--json"]).output)
    assert [s["metric"] for s in same] == [s["metric"] for s in apart]
    assert sum(s["value"] for s in same) < sum(s["value"] for s in apart)
    text = CliRunner().invoke(app, ["evaluate", real, fake, "--protocol", protocol]).output
    assert f"({protocol} protocol, 3 real, 3 generated)" in text


def test_an_unknown_protocol_is_a_wrong_call(folders: tuple[Path, Path]) -> None:
    result = CliRunner().invoke(app, ["evaluate", *map(str, folders), "--protocol", "frid"])
    assert result.exit_code == 2
