"""``lidar-synth evaluate`` on scans on disk."""

import json
import shutil
from pathlib import Path

import pytest
from conftest import random_scan
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.cli.sample import NOTE
from lidar_synth.errors import ConfigError
from lidar_synth.evaluate import PROTOCOLS
from lidar_synth.formats import WRITERS
from lidar_synth.geometry.sensor import presets
from lidar_synth.town.export import SETTINGS


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


def trained_on(folder: Path, data: dict[str, object]) -> None:
    (folder / NOTE).write_text(json.dumps({"seed": 0, "trained_on": data}))


@pytest.mark.parametrize("same", [True, False])
def test_what_the_model_was_trained_on_is_no_reference(folders: tuple[Path, Path], tmp_path: Path, same: bool) -> None:
    real, fake = (shutil.copytree(folder, tmp_path / folder.name) for folder in folders)
    call = ["evaluate", str(real), str(fake), "--protocol", "town", "--json"]
    trained_on(fake, {"path": f"{real.parent}/../{tmp_path.name}/real", "split": None if same else "train"})
    by_path = CliRunner().invoke(app, call)
    trained_on(fake, {"town": 3000, "seed": 5})
    (real / SETTINGS).write_text(json.dumps({"seed": 5 if same else 6}))
    by_town = CliRunner().invoke(app, call)
    for result in (by_path, by_town):
        if same:
            assert isinstance(result.exception, ConfigError), result.output
            assert "not trained on" in str(result.exception)
        else:
            assert result.exception is None, result.output
    assert CliRunner().invoke(app, [*call, "--training-data"]).exit_code == 0
