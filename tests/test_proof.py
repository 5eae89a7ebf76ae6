"""``prove`` end to end: on the town, on real scans where they are, resumed, within its minutes, and
its page."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import browsers
import numpy as np
import pytest
from proofs import SENSOR, drives, write_town
from small_models import write as write_model
from typer.testing import CliRunner

from lidar_synth import ProofSettings, prove
from lidar_synth.cli import app
from lidar_synth.datasets.classes import PANDASET
from lidar_synth.datasets.recordings import frames_of
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.checkpoint import VELOCITY, load_checkpoint, save_checkpoint
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.evaluate.leakage import content_of, contents, refuse_leaks
from lidar_synth.lab.proof import ARMS, Job, Proof, pools
from lidar_synth.lab.proof.pools import PoolTask, make_pool
from lidar_synth.lab.town import Town

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

SMALL = ProofSettings(
    arms=("real", "exchange"),
    iterations=10,
    batch=2,
    seeds=1,
    columns=64,
    widths=(4, 8),
    tested=2,
    synthetic=3,
)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two streets of the town, five scans each, in one sequence."""
    return write_town(tmp_path_factory.mktemp("town"), 2, (2, 6, 10, 14, 18))


@pytest.fixture(scope="module")
def proof(town: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Proof]:
    """The output folder of a comparison on the town with every arm that needs no generator, and its
    result."""
    out = tmp_path_factory.mktemp("proof")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pools, "SKIN_STREETS", 1)
        arms = tuple(n for n in ARMS if not ARMS[n].pools() & pools.OF_GENERATOR)
        settings = replace(SMALL, arms=arms, columns=128)
        return out, prove(town, out, settings, jobs=1, progress=False)


def test_the_town_is_proved_with_every_arm(proof: tuple[Path, Proof]) -> None:
    out, result = proof
    values = result.values
    assert (
        values["tested_places"] == ["00, place 1", "00, place 2"]
        and values["pairs"] == 2
    )
    keys = [row["key"] for row in values["arms"]]
    assert keys == [
        "real",
        "longer",
        "exchange",
        "town-50",
        "skin-50",
        "pretrain",
        "pretrain-skin",
        "quarter-town",
    ]
    for row in values["arms"]:
        assert (
            0 < row["miou"] < 100
            and row["minutes"] > 0
            and "5 labelled scans" in row["budget"]
        )
        assert row["interval"] is None  # two places
        gain = row["miou"] - values["arms"][0]["miou"]
        assert row["difference"] == (
            None if row["key"] == "real" else pytest.approx(gain)
        )
    [skin] = [row for row in values["arms"] if row["key"] == "skin-50"]
    assert "5 scans of the training places without labels" in skin["budget"]
    assert (
        "an interval needs 6 tested places, and there are" in result.headline
        and result.headline in str(result)
    )
    assert json.loads((out / "results.json").read_text()) == json.loads(
        json.dumps(values)
    )


def test_the_page_is_one_file_that_says_it_all(proof: tuple[Path, Proof]) -> None:
    out, result = proof
    text = (out / "index.html").read_text()
    assert not re.search(r"https?://|src=|@\w+@", text)
    for words in (
        "What was not tested",
        "IoU by class",
        "Label budget",
        "Machine:",
        "Command:",
        "motorcyclist",
    ):
        assert words in text
    for row in result.values["arms"]:
        assert row["title"] in text


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    yield from browsers.running()


@pytest.mark.parametrize("width", [1280, 420])
def test_the_page_shows_in_a_browser(
    width: int, proof: tuple[Path, Proof], browser: Any
) -> None:
    browser.set_window_size(width, 900)
    browser.get((proof[0] / "index.html").as_uri())
    assert browser.get_log("browser") == []
    assert browser.execute_script(
        "return document.documentElement.scrollWidth <= window.innerWidth"
    )
    circles = browser.find_elements("css selector", "svg circle")
    assert len(circles) >= 7 and all(c.size["width"] > 0 for c in circles)


def test_a_comparison_resumes_and_grows(tmp_path: Path) -> None:
    source = drives(3, 4)
    prove(source, tmp_path, SMALL, jobs=1, progress=False)
    before = {
        path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*.json")
    }
    assert len(before) == 6
    (lost := next(iter(before))).unlink()
    more = replace(SMALL, arms=("real", "exchange", "longer"), seeds=2)
    again = prove(source, tmp_path, more, jobs=1, progress=False)
    after = {
        path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*.json")
    }
    assert len(after) == 18 and [
        path for path in before if after[path] != before[path]
    ] == [lost]
    assert again.values["pairs"] == 6
    with pytest.raises(ConfigError, match="'iterations': 10"):
        prove(source, tmp_path, replace(SMALL, iterations=12), jobs=1, progress=False)


def test_processes_give_the_results_of_one_process(tmp_path: Path) -> None:
    source = drives(2, 3)
    one = prove(source, tmp_path / "one", SMALL, jobs=1, progress=False)
    two = prove(source, tmp_path / "two", SMALL, jobs=2, progress=False)
    assert [row["miou"] for row in one.values["arms"]] == [
        row["miou"] for row in two.values["arms"]
    ]


def test_a_time_that_is_over_starts_no_training(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match="minutes, in which 2 places cannot be tested"
    ):
        prove(drives(), tmp_path, SMALL, minutes=1e-6, jobs=1, progress=False)


def test_a_short_time_has_fewer_iterations_which_a_resumed_comparison_keeps(
    tmp_path: Path,
) -> None:
    """Iteration times are measured again by each call, so that the same minutes could give another
    number."""
    source = drives(2, 3)
    asked = replace(SMALL, iterations=10**5)
    first = prove(source, tmp_path, asked, minutes=0.1, jobs=1, progress=False)
    assert 10 <= first.values["iterations"] < 10**5
    again = prove(source, tmp_path, asked, minutes=0.05, jobs=1, progress=False)
    assert again.values["iterations"] == first.values["iterations"]


def perfect(job: Job) -> np.ndarray:
    """A trainer that knows the labels where its arm exchanges parts, and takes everything for road
    otherwise."""
    [scans] = job.held_out.values()
    label = np.concatenate([scan.label for scan in scans if scan.label is not None])
    label = label[label != 255].astype(int)
    given = label if job.row.name == "exchange" else np.full_like(label, 8)
    return np.bincount(label * 19 + given, minlength=361).reshape(19, 19)


def test_a_trainer_of_ones_own_is_measured(tmp_path: Path) -> None:
    result = prove(
        drives(6, 2), tmp_path, SMALL, jobs=1, trainer=perfect, progress=False
    )
    base, exchange = result.values["arms"]
    assert (
        exchange["miou"] == 100
        and base["miou"] < 50
        and result.values["trainer"] == "perfect"
    )
    assert "turned and mirrored" not in (tmp_path / "index.html").read_text()
    low, high = exchange["interval"]
    assert low <= exchange["difference"] <= high and low > 0


def test_one_training_is_tested_on_all_scans_of_other_places(tmp_path: Path) -> None:
    tests = drives(2, 2, first=20)
    asked = replace(SMALL, arms=("exchange",), seeds=2)
    result = prove(drives(1, 4), tmp_path, asked, jobs=1, tests=tests, progress=False)
    assert result.values["pairs"] == 4 and not result.values["left_out"]
    assert "were recorded apart" in (tmp_path / "index.html").read_text()
    single = prove(
        drives(1, 4), tmp_path / "one", asked, jobs=1, tests=tests[2:], progress=False
    )
    [place] = single.values["tested_places"]
    assert place == "01"
    for key in ("real", "exchange"):
        both, alone = (
            next(row for row in r.values["arms"] if row["key"] == key)["miou_by_place"]
            for r in (result, single)
        )
        assert both["01"] == alone["01"], "other places change nothing"


def test_the_scans_that_a_generator_learnt_from_are_those_of_its_town(
    tmp_path: Path,
) -> None:
    generator = load_generator("town")
    sensor = generator.sensor
    task = PoolTask("learnt", tmp_path / "pool", sensor, None, 2)
    first, last = pools.read_pool(make_pool(task))
    data = generator.header.provenance["data"]
    town = Town(data["seed"], sensor, data["town"], data["interval"], motion=False)
    for scan, own in ((first, town[0]), (last, town[len(town) - 1])):
        assert np.array_equal(scan.points, own.points)
        assert np.array_equal(scan.label, own.label)
    other = write_model(tmp_path / "mine.safetensors")
    with pytest.raises(ConfigError, match="did not learn from the town"):
        make_pool(replace(task, folder=tmp_path / "other", model=str(other)))


def test_generated_scans_of_other_lasers_get_the_reflectance_of_the_labelled_ones(
    tmp_path: Path,
) -> None:
    assert pools.has_lasers("town", load_sensor("hdl64e_semantic_kitti"))
    model = str(write_model(tmp_path / "mine.safetensors"))
    assert not pools.has_lasers(model, SENSOR)
    trained: list[Job] = []

    def keep(job: Job) -> np.ndarray:
        trained.append(job)
        return perfect(job)

    asked = replace(SMALL, arms=("generator",), model=model)
    for beams in (None, 16):
        settings = replace(asked, beams=beams)
        out = tmp_path / f"{beams}"
        prove(drives(2, 2), out, settings, jobs=1, trainer=keep, progress=False)
        job = trained[-1]
        given = job.pools["generator"]
        made = pools.read_pool(out / "pools" / "generator")
        assert ("generator" in job.pool_folders) == (beams == 16)
        same = [
            np.array_equal(one.reflectance, other.reflectance)
            for one, other in zip(given, made, strict=True)
        ]
        assert same == [beams == 16] * 3
    matched = pools.match_reflectance(made, job.real)
    middle = np.median(np.concatenate([scan.reflectance for scan in matched]))
    assert middle == pytest.approx(
        np.median(np.concatenate([scan.reflectance for scan in job.real])), abs=0.03
    )


def test_a_generator_that_saw_the_tested_places_is_refused_by_drive_and_frame(
    tmp_path: Path,
) -> None:
    saved = load_checkpoint(write_model(tmp_path / "plain.safetensors"))
    seen = frames_of("semantic_kitti", ["00/000000", "00/000001", "00/000002"])
    header = replace(
        saved.header, provenance={**saved.header.provenance, "seen": seen.to_list()}
    )
    path = tmp_path / "leaks.safetensors"
    save_checkpoint(path, header, saved.networks)
    with pytest.raises(ConfigError, match=r"2011_10_03_drive_0027 \(frame 2\)"):
        refuse_leaks(str(path), frames_of("semantic_kitti", ["00/000002", "01/000000"]))
    refuse_leaks(str(path), frames_of("semantic_kitti", ["00/000003", "01/000000"]))


@pytest.mark.parametrize("condition", ["semantic", "layout"])
def test_a_generator_with_a_condition_gets_those_of_the_towns_streets(
    condition: str, tmp_path: Path
) -> None:
    model = write_model(
        tmp_path / "model.safetensors", dropout=0.1, condition=condition
    )

    def scans_of(seed: int) -> list[Scan]:
        task = PoolTask(
            "generator",
            tmp_path / str(seed),
            SENSOR,
            None,
            2,
            town_seed=seed,
            model=str(model),
        )
        return pools.read_pool(make_pool(task))

    one = scans_of(1)
    other = scans_of(2)
    assert len(one) == 2 and all(len(scan) for scan in one + other)
    assert not np.array_equal(one[0].points, other[0].points), (
        "another street gives another scan"
    )
    with pytest.raises(ConfigError, match="needs camera images"):
        refuse_leaks("town-camera", frames_of("semantic_kitti", ["01/000000"]))


def test_a_generator_that_saw_the_tested_scans_in_another_folder_is_refused(
    tmp_path: Path,
) -> None:
    scans = drives(3, 2)
    saved = load_checkpoint(write_model(tmp_path / "mine.safetensors"))
    provenance = {
        **saved.header.provenance,
        "seen": contents([content_of(scans[0])]).to_list(),
    }
    save_checkpoint(
        tmp_path / "mine.safetensors",
        replace(saved.header, provenance=provenance),
        saved.networks,
    )
    settings = replace(
        SMALL, arms=("generator",), model=str(tmp_path / "mine.safetensors")
    )
    with pytest.raises(ConfigError, match="trained on places that are tested: content"):
        prove(scans, tmp_path / "out", settings, jobs=1, progress=False)


def test_a_pool_of_other_weights_is_not_reused(tmp_path: Path) -> None:
    model = write_model(tmp_path / "mine.safetensors")
    task = PoolTask(
        "generator", tmp_path / "pool", SENSOR, None, 1, 0, str(model), None, ()
    )
    make_pool(task)
    saved = load_checkpoint(model)
    for weight in saved.networks[VELOCITY].parameters():
        weight.data.mul_(0.5)
    save_checkpoint(model, saved.header, saved.networks)
    with pytest.raises(ConfigError, match="was filled with .*checkpoint"):
        make_pool(task)


def test_the_shipped_generator_is_not_measured_on_its_own_town(
    town: Path, tmp_path: Path
) -> None:
    with pytest.raises(
        ConfigError, match="trained on places that are tested: town seed 0"
    ):
        prove(
            town, tmp_path, replace(SMALL, arms=("generator",)), jobs=1, progress=False
        )


def test_the_command_plans_and_proves(town: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    arms = [
        "--arm",
        "exchange",
        "--iterations",
        "10",
        "--batch",
        "2",
        "--seeds",
        "1",
        "--jobs",
        "1",
    ]
    planned = runner.invoke(
        app, ["prove", str(town), *arms, "--dry-run", "--out", str(tmp_path / "none")]
    )
    assert (
        planned.exit_code == 0
        and "4 trainings; about" in planned.output
        and not (tmp_path / "none").exists()
    )
    done = runner.invoke(app, ["prove", str(town), *arms, "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "| real scans only |" in done.output and (tmp_path / "index.html").is_file()


def test_real_scans_are_proved(labelled_scans: Path, tmp_path: Path) -> None:
    root = labelled_scans / "semantic_kitti"
    settings = replace(SMALL, labelled=4, batch=4)
    values = prove(root, tmp_path, settings, jobs=1, progress=False).values
    assert values["tested_places"] == ["00", "01", "03", "04", "06", "07", "09"]
    low, high = values["arms"][1]["interval"]
    assert low < values["arms"][1]["difference"] < high
    for pair, names in values["labelled_scans"].items():
        place = pair.split(",")[0]
        assert len({name[:2] for name in names} - {place}) == 4


def pandaset_frame(path: Path) -> Scan:
    """A frame of PandaSet in the frame of its sensor, with PandaSet's own class ids as labels."""
    with np.load(path) as file:
        reflectance = file["reflectance"].astype(np.float32) / 255
        return Scan(
            file["points"],
            reflectance,
            load_sensor("pandar64"),
            label=file["label"],
            id=f"002/{path.stem}",
        )


def test_labels_of_pandaset_need_its_table(
    labelled_scans: Path, tmp_path: Path
) -> None:
    paths = sorted((labelled_scans / "pandaset" / "sensor_frame").glob("*.npz"))[::5]
    source = [pandaset_frame(path) for path in paths]
    settings = replace(SMALL, places="stretch:2", arms=("real",), classes="pandaset")
    with pytest.raises(DataError, match=r"with labels \[.*of another table"):
        prove(source, tmp_path, settings, jobs=1, progress=False)
    mapped = [
        replace(scan, label=PANDASET.decode(scan.label))
        for scan in source
        if scan.label is not None
    ]
    values = prove(mapped, tmp_path, settings, jobs=1, progress=False).values
    assert len(values["tested_places"]) == 2 and "vehicle" in values["classes"]
