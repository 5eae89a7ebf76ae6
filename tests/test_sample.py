"""Command line `lidar-synth sample`: formats, resuming, and conditions from a dataset."""

from pathlib import Path

import numpy as np
import pytest
from conftest import random_scan
from layouts import write_all
from small_models import SENSOR, write
from typer.testing import CliRunner

from lidar_synth.datasets.recordings import NOTE
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry.scan import REAL, SYNTHETIC


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("generator") / "small.safetensors")


@pytest.mark.slow
# no model gives boxes
@pytest.mark.parametrize("form", [name for name in WRITERS if name != "kitti_object"])
def test_sample_writes_every_format_and_resumes(
    form: str, path: Path, tmp_path: Path
) -> None:
    from lidar_synth.cli import app

    def sample(*options: str) -> str:
        result = CliRunner().invoke(
            app,
            [
                "sample",
                str(tmp_path / "out"),
                "--model",
                str(path),
                "--to",
                form,
                *options,
            ],
        )
        assert result.exception is None, result.exception
        return result.output

    assert "2 scans written, 0 were there already" in sample(
        "--count", "2", "--seed", "4"
    )
    assert "1 scans written, 2 were there already" in sample(
        "--count", "3", "--seed", "4"
    )
    written = open_scans(tmp_path / "out")
    generator = load_generator(path)
    made = {
        "made_by": "model",
        "model": "small",
        "checkpoint": generator.hash,
        "seed": 4,
    }
    assert (
        written.sensor == SENSOR
        and written[2].provenance == made
        and written[2].domain == SYNTHETIC
    )
    if form in ("npz", "semantic_kitti", "kitti", "webdataset"):
        expected = generator.scans(4, range(3))
        assert len(written) == 3
        for a, b in zip(written, expected, strict=True):
            assert np.allclose(a.points, b.points, atol=1e-4)
            assert np.array_equal(a.label, b.label)


@pytest.mark.parametrize(
    ("option", "values"),
    [("seed", "45"), ("columns", ["1024", "2048"]), ("dtype", ["float32", "bfloat16"])],
)
def test_sample_refuses_a_folder_that_holds_samples_of_other_settings(
    path: Path, tmp_path: Path, option: str, values: str | list[str]
) -> None:
    from lidar_synth.cli import app

    model = "town" if option == "columns" else str(path)  # it has several widths
    call = ["sample", str(tmp_path / "out"), "--model", model, "--count", "1"]
    one, other = ([*call, f"--{option}", value] for value in values)
    assert CliRunner().invoke(app, one).exception is None
    before = (tmp_path / "out" / "000000.npz").read_bytes()
    said = f"filled with {{'{option}': .*{{'{option}': "
    with pytest.raises(ConfigError, match=said):
        CliRunner().invoke(app, other, catch_exceptions=False)
    assert (tmp_path / "out" / "000000.npz").read_bytes() == before


def test_sample_does_not_adopt_recorded_scans(path: Path, tmp_path: Path) -> None:
    from lidar_synth.cli import app

    write_all("kitti", tmp_path, [random_scan(SENSOR, 400, 0)])
    call = ["sample", str(tmp_path), "--model", str(path), "--to", "kitti"]
    with pytest.raises(ConfigError, match="files that this command did not write"):
        CliRunner().invoke(app, call, catch_exceptions=False)
    assert open_scans(tmp_path)[0].domain == REAL


def test_sample_takes_another_format_after_one_that_cannot_hold_the_scans(
    path: Path, tmp_path: Path
) -> None:
    from lidar_synth.cli import app

    call = [
        "sample",
        str(tmp_path / "out"),
        "--model",
        str(path),
        "--count",
        "1",
        "--to",
    ]
    with pytest.raises(DataError, match="Write it as semantic_kitti"):
        CliRunner().invoke(app, [*call, "kitti_object"], catch_exceptions=False)
    result = CliRunner().invoke(app, [*call, "semantic_kitti"])
    assert result.exception is None, result.exception
    assert (tmp_path / "out" / NOTE).is_file()


def test_sample_refuses_a_folder_that_holds_samples_of_another_layout(
    tmp_path: Path,
) -> None:
    from lidar_synth.cli import app

    model = write(tmp_path / "laid.safetensors", dropout=0.1, condition="layout")
    layout = tmp_path / "street.yaml"
    call = ["sample", str(tmp_path / "out"), "--model", str(model), "--count", "1"]
    call += ["--objects", "drawn", "--condition", str(layout)]
    layout.write_text("objects: [{class: Car, at: [8, 2]}]")
    assert CliRunner().invoke(app, call).exception is None
    assert "0 scans written" in CliRunner().invoke(app, call).output
    layout.write_text("objects: [{class: Car, at: [12, 2]}]")
    with pytest.raises(ConfigError, match="was filled with {'conditions'"):
        CliRunner().invoke(app, call, catch_exceptions=False)


@pytest.mark.slow
def test_sample_takes_its_conditions_from_a_dataset(tmp_path: Path) -> None:
    from lidar_synth.cli import app

    guided = write(tmp_path / "guided.safetensors", ("range",), 0.1)
    real = [random_scan(SENSOR, 400, seed) for seed in range(2)]
    write_all("semantic_kitti", tmp_path / "real", real)
    call = [
        "sample",
        str(tmp_path / "out"),
        "--model",
        str(guided),
        "--seed",
        "3",
        "--guidance",
        "2",
    ]
    given = [
        "--condition",
        str(tmp_path / "real"),
        "--condition-split",
        "train",
        "--condition-layout",
        "semantic_kitti",
    ]
    result = CliRunner().invoke(app, [*call, *given, "--count", "1"])
    assert result.exception is None, result.exception
    result = CliRunner().invoke(app, [*call, *given, "--count", "3"])
    assert (
        result.exception is None
        and "2 scans written, 1 were there already" in result.output
    )
    expected = load_generator(guided).scans(
        3, range(3), [real[0], real[1], real[0]], guidance=2.0
    )
    for a, b in zip(open_scans(tmp_path / "out"), expected, strict=True):
        assert a.id == f"{int(b.id.rpartition('/')[2]):06d}"
        assert np.allclose(a.points, b.points, atol=1e-3)
        assert np.array_equal(a.label, b.label) and len(np.unique(a.label)) > 2
    for change, message in (
        (["--guidance", "1"], r"'guidance': 2.0.*'guidance': 1.0"),
        (["--condition", str(tmp_path)], "no scan in a layout|no sequence"),
    ):
        with pytest.raises((ConfigError, DataError), match=message):
            CliRunner().invoke(app, [*call, *given, *change], catch_exceptions=False)


@pytest.mark.parametrize(
    ("conditional", "options", "error", "message"),
    [
        (
            True,
            [],
            ConfigError,
            "condition None for model 'model', which takes semantic conditions; expected a data",
        ),
        (
            False,
            ["--condition", "real"],
            ConfigError,
            "condition real for model 'model', which takes no condition",
        ),
        (True, ["--condition", "nowhere"], FileError, "nowhere does not exist"),
        (
            False,
            ["--condition-split", "train"],
            ConfigError,
            "split train, but no dataset; expected --condition PATH",
        ),
    ],
)
def test_sample_refuses_conditions_that_do_not_fit(
    conditional: bool,
    options: list[str],
    error: type[Exception],
    message: str,
    tmp_path: Path,
) -> None:
    from lidar_synth.cli import app

    model = write(
        tmp_path / "model.safetensors", ("range",), 0.1 if conditional else None
    )
    call = ["sample", str(tmp_path / "out"), "--model", str(model), *options]
    with pytest.raises(error, match=message):
        CliRunner().invoke(app, call, catch_exceptions=False)
    assert not (tmp_path / "out").exists()


def test_a_time_grid_is_given_by_hand(path: Path, tmp_path: Path) -> None:
    from lidar_synth.cli import app

    out = tmp_path / "out"
    given = ["sample", str(out), "--model", str(path), "--count", "1"]
    result = CliRunner().invoke(app, [*given, "--times", "1,0.7,0.2,0"])
    assert result.exception is None, result.exception
    [made] = load_generator(path).scans(0, [0], times=(1, 0.7, 0.2, 0))
    assert np.array_equal(open_scans(out)[0].points, made.points)
    other = CliRunner().invoke(app, [*given, "--times", "1,0.6,0.2,0"])
    assert isinstance(other.exception, ConfigError)


def test_sample_says_what_the_format_cannot_hold_and_resumes_by_another_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lidar_synth.cli import app

    monkeypatch.chdir(tmp_path)
    model = write(tmp_path / "laid.safetensors", dropout=0.1, condition="layout")
    layout = tmp_path / "street.yaml"
    layout.write_text("objects: [{class: Car, at: [8, 2]}, {class: Car, at: [-7, 2]}]")

    def sample(to: str, condition: Path) -> str:
        call = ["sample", to, "--to", to, "--model", str(model), "--count", "1"]
        call += ["--condition", str(condition)]
        result = CliRunner().invoke(app, call, catch_exceptions=False)
        return result.output

    assert "dropped boxes of 1 scans, which kitti cannot hold" in sample(
        "kitti", layout
    )
    assert "0 scans written, 1 were there" in sample("kitti", Path("street.yaml"))
    assert "boxes outside the camera's view of 1" in sample("kitti_object", layout)
