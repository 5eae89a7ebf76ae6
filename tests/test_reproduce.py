"""The tables of the paper by one command, with small networks on scans of the town."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from latent_runs import call, one_thread  # noqa: F401 - a fixture
from releases import peer_weights, write_r2flow

from lidar_synth.errors import ConfigError, FileError
from lidar_synth.formats import open_scans
from lidar_synth.generate import devices
from lidar_synth.generate.checkpoint import (
    load_checkpoint,
    read_header,
    save_checkpoint,
)
from lidar_synth.lab.evaluate import evaluate
from lidar_synth.lab.evaluate.published import read_published
from lidar_synth.lab.reproduce import report, work as work_module
from lidar_synth.lab.reproduce.report import reproduce
from lidar_synth.lab.reproduce.tables import read_tables
from lidar_synth.lab.reproduce.work import VARIABLES, TaskRun, find_data, write_town
from lidar_synth.lab.train.config import DistillConfig

TABLES = read_tables()
OWN = re.compile(r"^\| \*\*(\w+)\*\*, tiny, \d+ scans \| (\d+) \| (.*) \|$", re.M)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("paper")


@pytest.fixture(autouse=True)
def own_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command sets them."""
    for name in VARIABLES.values():
        monkeypatch.setenv(name, "nowhere")


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, t in TABLES.tables.items() if t.rows])
def test_a_table_has_the_papers_rows_and_ones_own(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = call("reproduce", name, "--tiny", "--out", folder)
    table = TABLES.tables[name]
    rows = [(stage, int(steps)) for stage, steps, _ in OWN.findall(text)]
    assert rows == list(table.rows) * len(table.tasks)
    for published in read_published()[0]:
        if published.key.startswith(f"{name}/"):
            assert all(
                f"| {row['method']} | {row['steps']} |" in text
                for row in published.rows
            )
    # FRD to FSVD need published weights
    figures = [
        [c for c in cells.split(" | ") if c.strip()] for *_, cells in OWN.findall(text)
    ]
    assert all(len(cells) in (1, 2) for cells in figures)
    assert all(float(cell) >= 0 for cells in figures for cell in cells)
    monkeypatch.setattr(work_module, "run", None)  # nothing is trained again
    again = call("reproduce", name, "--tiny", "--out", folder)
    assert OWN.findall(again) == OWN.findall(text)


@pytest.mark.slow
def test_the_figures_are_those_of_evaluate(folder: Path) -> None:
    text = call("reproduce", "table2", "--tiny", "--out", folder)
    home = folder / "tiny"
    scores = evaluate(
        open_scans(home / "town" / "kitti360-3"),
        open_scans(home / "samples" / "kitti360_latent_student-4"),
        "lidm",
        anyway=True,
        training_data=True,
        progress=False,
    )
    shown = [f"{score.value * score.times:.4g}" for score in scores]
    [(*_, cells)] = OWN.findall(text)
    assert cells.split(" | ")[-2:] == shown
    # the timesteps are selected for the teacher that was trained
    header, _ = read_header(
        home / "kitti360_latent_student" / "kitti360_latent_student.safetensors"
    )
    assert "selection" in header.provenance and len(header.time_grid) == 5


@pytest.mark.slow
def test_the_table_of_times(folder: Path) -> None:
    text = call("reproduce", "table6", "--tiny", "--out", folder)
    found = re.findall(
        r"(\w+): (\d+) ms a scan in 4 steps on cpu; paper: (\d+) ms$", text, re.M
    )
    assert [(task, int(paper)) for task, _, paper in found] == [
        ("latent", 68),
        ("pixel", 55),
        ("camera", 156),
        ("semantic", 83),
    ]
    assert all(0 < int(here) < 60_000 for _, here, _ in found)


@pytest.mark.slow
def test_released_weights_take_the_place_of_a_training(
    folder: Path, tmp_path: Path
) -> None:
    released = write_r2flow(tmp_path / "released.pth", peer_weights())
    use = f"pixel.teacher={released}"
    out = tmp_path / "paper"
    text = call("reproduce", "table1", "--tiny", "--out", out, "--use", use)
    assert len(OWN.findall(text)) == 3
    home = out / "tiny"
    assert not (home / "kitti360_teacher").exists()
    [imported] = (home / "imported").iterdir()
    _, digest = read_header(imported)
    header, _ = read_header(home / "kitti360_student" / "kitti360_student.safetensors")
    assert header.provenance["teacher"] == digest
    # the student that is there is no other teacher's
    again = ["reproduce", "table1", "--tiny", "--out", out, "--use"]
    copied = shutil.copy(imported, tmp_path / "copied.safetensors")
    with pytest.raises(ConfigError, match="kitti360_student with teacher='.*copied"):
        call(*again, f"pixel.teacher={copied}")
    made = load_checkpoint(imported)
    other = replace(made.header, provenance=made.header.provenance | {"a": 1})
    save_checkpoint(imported, other, made.networks)
    with pytest.raises(ConfigError, match="which was made from another teacher than"):
        call(*again, use)


def test_two_released_files_may_have_one_name(tmp_path: Path) -> None:
    found = set()
    for scale in (1, 2):
        weights = {name: scale * value for name, value in peer_weights().items()}
        given = {"teacher": tmp_path / str(scale) / "r2flow.pth"}
        given["teacher"].parent.mkdir()
        write_r2flow(given["teacher"], weights)
        made = TaskRun("pixel", tmp_path, given=given).checkpoint("teacher")
        found.add(read_header(made)[0].provenance["file_sha256"])
    assert len(found) == 2


@pytest.mark.slow
def test_an_estimate_adds_up(tmp_path: Path) -> None:
    text = call("reproduce", "table2", "--tiny", "--estimate", "--out", tmp_path)
    hours = dict(re.findall(r"(latent .*?|all) +([\d.]+) h$", text, re.M))
    assert list(hours) == [
        "latent    train codec",
        "latent    train teacher",
        "latent    train student",
        "latent    select timesteps",
        "latent    sample student, 4 steps",
        "all",
    ]
    *parts, total = map(float, hours.values())
    assert total == pytest.approx(sum(parts), abs=0.03)
    assert not (tmp_path / "tiny" / "kitti360_codec").exists()


def test_scales_shorten_the_runs(tmp_path: Path) -> None:
    tenth = TaskRun("pixel", tmp_path, "tenth")
    full = TaskRun("pixel", tmp_path)
    assert (tenth.count, full.count) == (1_000, 10_000)
    for work, share in ((tenth, 10), (full, 1)):
        recipe = work.config("teacher").recipe
        assert recipe.iterations == 320_000 // share
        assert recipe.warmup == recipe.ema_after == 10_000 // share
    student = full.config("reflow")
    assert isinstance(student, DistillConfig)
    assert (student.strategy, student.grid, student.steps) == ("reflow", None, 20)
    assert student.teacher == full.checkpoint("teacher")
    assert full.evaluations == 256 * 100
    assert TaskRun("camera", tmp_path).stages("student") == [
        "codec",
        "teacher",
        "student",
    ]
    given = TaskRun("camera", tmp_path, given={"teacher": tmp_path / "x.safetensors"})
    assert given.stages("student") == ["student"]


def test_what_later_tasks_need_is_asked_for_before_the_first_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    works = {
        "pixel": TaskRun("pixel", tmp_path, "tiny"),
        "camera": TaskRun("camera", tmp_path / "camera"),
    }
    write_town({"pixel": works["pixel"]})
    monkeypatch.delenv("LIDAR_SYNTH_CLIP", raising=False)
    with pytest.raises(FileError, match="and set LIDAR_SYNTH_CLIP to it"):
        works["camera"].check(["teacher"])
    monkeypatch.delenv("SEMANTICKITTI_ROOT")
    with pytest.raises(ConfigError, match="data.path '.SEMANTICKITTI_ROOT'"):
        list(reproduce("table4", TABLES.tables["table4"], works))
    assert not works["pixel"].config("teacher").output.exists()


def test_an_estimate_shares_the_projected_scans(tmp_path: Path) -> None:
    for stage in ("codec", "teacher", "student"):
        one, other = (
            TaskRun("latent", tmp_path, minutes=minutes).config(stage)
            for minutes in (None, 1.0)
        )
        assert one.data.cache == other.data.cache is not None
        assert other.output.parent == one.output.parent / "estimate"


def test_scans_are_sampled_on_a_gpu_if_there_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        devices, "available_devices", lambda: ["cpu", "cuda:0", "cuda:1"]
    )
    monkeypatch.setattr(report, "reproduce", lambda *given: [given[2]["pixel"].device])
    command = ("reproduce", "table1", "--out", tmp_path)
    assert call(*command) == "cuda:0\n"
    assert call(*command, "--device", "cpu") == "cpu\n"


def test_the_datasets_are_found_below_one_folder(tmp_path: Path) -> None:
    import os

    with pytest.raises(ConfigError, match="without data_3d_raw or sequences"):
        find_data(tmp_path)
    (tmp_path / "KITTI-360" / "data_3d_raw").mkdir(parents=True)
    (tmp_path / "SemanticKITTI" / "dataset" / "sequences").mkdir(parents=True)
    find_data(tmp_path)
    assert os.environ["KITTI360_ROOT"] == str(tmp_path / "KITTI-360")
    expected = tmp_path / "SemanticKITTI" / "dataset"
    assert os.environ["SEMANTICKITTI_ROOT"] == str(expected)


def test_what_cannot_be_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="table 'table7'; expected one of 'table1'"):
        call("reproduce", "table7", "--tiny")
    with pytest.raises(
        ConfigError, match="expected TASK.STAGE=FILE with a task of pixel"
    ):
        call("reproduce", "table1", "--tiny", "--use", "latent.teacher=x.pth")
    released = tmp_path / "x.pth"
    released.touch()
    for use, expected in {
        f"pixel.techer={released}": "stage 'techer'.* Did you mean 'teacher'",
        f"pixel.codec={released}": "stage 'codec'; expected one of 'teacher'",
        f"pixel.reflow={released}": "stage 'reflow'; expected one of 'teacher', 'stud",
        f"pixel.teacher={released}s": "x.pths'; expected TASK.STAGE=FILE with a file",
        f"pixel={released}": "expected TASK.STAGE=FILE with a task of pixel",
        "pixel.teacher": "expected TASK.STAGE=FILE with a file that exists",
    }.items():
        with pytest.raises(ConfigError, match=expected):
            call("reproduce", "table1", "--tiny", "--use", use, "--out", tmp_path)
    with pytest.raises(ConfigError, match="--weights nowhere; expected a folder"):
        call("reproduce", "table1", "--tiny", "--weights", "nowhere")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(
        ConfigError,
        match="in several processes; .*with torchrun --nproc-per-node N, then",
    ):
        call("reproduce", "table1", "--tiny", "--out", tmp_path / "paper")
    assert not (tmp_path / "paper").exists()
    monkeypatch.delenv("KITTI360_ROOT")
    with pytest.raises(
        ConfigError, match="no KITTI360_ROOT for latent; expected --data"
    ):
        TaskRun("latent", tmp_path).reference  # noqa: B018
