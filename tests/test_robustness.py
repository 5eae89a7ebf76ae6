"""The robustness card: its measures, the cases, and each kind of model, computed independently."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from project import ROOT
from typer.testing import CliRunner

from lidar_synth import Scan, Town, open_scans
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.lab.evaluate.robustness import (
    BASELINE,
    NAMES_OF_BENCHMARK,
    Card,
    cases,
    corrupt,
    count_points,
    open_model,
    read_means,
    stress,
    write_cases,
)
from lidar_synth.lab.evaluate.segmentation import load_judge, mean_iou
from lidar_synth.weather import SEVERITIES

LOSSES = ("missing_beams", "incomplete_echo")


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    return [Town(seed=0, scans=2)[n] for n in range(2)]


def by_height(scan: Scan) -> NDArray[np.int64]:
    """A network: road below, buildings above, and no class far above."""
    height = scan.points[:, 2]
    return np.select([height < -1.3, height < 2], [8, 12], 255)


def iou_of(scans: list[Scan]) -> float:
    """mIoU of ``by_height``, class by class."""
    label = np.concatenate([scan.label for scan in scans if scan.label is not None])
    predicted = np.concatenate([by_height(scan) for scan in scans])[label != 255]
    label = label[label != 255]
    ious = []
    for one in np.unique(label):
        hits = ((label == one) & (predicted == one)).sum()
        ious.append(hits / ((label == one) | (predicted == one)).sum())
    return float(np.mean(ious))


def test_the_published_rows_give_the_published_means() -> None:
    """Those of the benchmark's paper: SqueezeSeg's mCE is 164.87 % and its mRR 66.81 %."""
    tool = runpy.run_path(str(ROOT / "tools/research/weather_calibration.py"))
    clean, *row = np.divide(tool["PUBLISHED"], 100).tolist()
    scores = {n: [score] for n, score in zip(NAMES_OF_BENCHMARK, row, strict=True)}
    figures = Card(clean, scores, BASELINE).to_dict()
    assert 100 * figures["mCE"] == pytest.approx(164.87, abs=0.01)
    assert 100 * figures["mRR"] == pytest.approx(66.81, abs=0.01)
    own = Card(0.6276, {n: [s] for n, s in BASELINE.items()}, BASELINE).to_dict()
    assert own["mCE"] == pytest.approx(1)
    assert 100 * own["mRR"] == pytest.approx(81.90, abs=0.01)


def test_the_measures_by_hand() -> None:
    card = Card(0.5, {"fog": [0.4, 0.3, 0.2], "rain": [0.5] * 3}, {"fog": 0.6})
    assert card.resilience == pytest.approx({"fog": 0.6, "rain": 1.0})
    assert card.errors == pytest.approx({"fog": 0.7 / 0.4})
    assert card.to_dict()["mCE"] is None  # only with all eight
    lines = card.to_text().splitlines()
    assert lines[3] == "| fog | 40.0 | 30.0 | 20.0 | 30.0 | 60.0 | 175.0 |"
    assert lines[4] == "| rain | 50.0 | 50.0 | 50.0 | 50.0 | 100.0 |  |"
    assert Card(0.5, card.scores, {"fog": 1.0, "rain": 0.5}).errors == {"rain": 1.0}


def test_a_function_is_scored_as_counted_by_hand(
    scans: list[Scan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_network.py").write_text(
        "import numpy as np\n\n\ndef predict(scan):\n    z = scan.points[:, 2]\n"
        "    return np.select([z < -1.3, z < 2], [8, 12], 255)\n"
    )
    card = stress(scans, open_model("my_network:predict"), LOSSES, progress=False)
    assert card.clean == pytest.approx(iou_of(scans))
    for name in LOSSES:
        for severity, score in zip(SEVERITIES, card.scores[name], strict=True):
            changed = list(corrupt(scans, f"{name}/{severity}"))
            assert score == pytest.approx(iou_of(changed))


def test_predictions_in_files_score_as_the_function_that_made_them(
    scans: list[Scan], tmp_path: Path
) -> None:
    assert write_cases(scans, tmp_path / "out", LOSSES) == 2 * 7
    assert write_cases(scans, tmp_path / "out", LOSSES) == 0
    for others, seed in ((scans, 1), (scans[::-1], 0), (scans[:1], 0)):
        with pytest.raises(ConfigError, match="out was filled with"):
            write_cases(others, tmp_path / "out", LOSSES, seed)
    assert write_cases(scans, tmp_path / "out", ["motion_blur"]) == 2 * 3
    ids = np.full(256, 0, "<u4")
    ids[[8, 12]] = 40, 50  # SemanticKITTI's road and building
    for case in cases(LOSSES):
        folder = tmp_path / "predictions" / case / "sequences/00/predictions"
        folder.mkdir(parents=True)
        given = open_scans(tmp_path / "out" / case, sensor=scans[0].sensor)
        for n in range(2):
            ids[by_height(given[n])].tofile(folder / f"{n:06d}.label")
    network = open_model(str(tmp_path / "predictions"))
    card = stress(scans, network, LOSSES, progress=False)
    own = stress(
        scans, lambda s, _: sum(count_points(x, by_height(x)) for x in s), LOSSES
    )
    assert card.to_dict() == own.to_dict()
    (folder / "000001.label").unlink()
    with pytest.raises(DataError, match="1 predictions for 2 scans"):
        stress(scans, network, LOSSES, progress=False)


def test_labels_that_were_written_are_no_predictions(
    scans: list[Scan], tmp_path: Path
) -> None:
    write_cases(scans, tmp_path, LOSSES[:1])
    network = open_model(str(tmp_path))
    with pytest.raises(DataError, match="0 predictions for 2 scans"):
        stress(scans, network, LOSSES[:1], progress=False)
    for case in cases(LOSSES[:1]):
        for points in (tmp_path / case).rglob("*.bin"):
            beside = points.parents[1] / "predictions" / f"{points.stem}.label"
            beside.parent.mkdir(exist_ok=True)
            np.full(points.stat().st_size // 16, 40, "<u4").tofile(beside)
    roads = stress(
        scans,
        lambda s, _: sum(count_points(x, np.full(len(x), 8)) for x in s),
        LOSSES[:1],
    )
    assert stress(scans, network, LOSSES[:1]).to_dict() == roads.to_dict()


def test_the_shipped_segmenter_is_a_model(scans: list[Scan]) -> None:
    card = stress(scans, open_model("town"), LOSSES[:1], progress=False)
    assert card.clean == mean_iou(load_judge().agreement(scans))
    assert card.scores["missing_beams"][2] < card.clean


def test_a_class_that_is_not_predicted_counts_as_missed(scans: list[Scan]) -> None:
    scan = scans[0]
    assert scan.label is not None
    table = count_points(scan, np.full(len(scan), 255))
    assert table.shape == (19, 20) and table[:, 19].sum() == (scan.label != 255).sum()
    assert mean_iou(table) == 0


def test_bad_input_is_refused(scans: list[Scan]) -> None:
    for given in ("no/such/folder", "no_module:predict", "json:no_function"):
        with pytest.raises(ConfigError, match="module:function"):
            open_model(given)
    with pytest.raises(DataError, match="shape"):
        count_points(scans[0], np.zeros(3, int))
    with pytest.raises(DataError, match="type float64"):
        count_points(scans[0], np.zeros(len(scans[0])))
    with pytest.raises(DataError, match="none is right.*expected train ids, 0 to 18"):
        stress(
            scans,
            lambda s, _: sum(count_points(x, np.full(len(x), 40)) for x in s),
            LOSSES,
            progress=False,
        )
    with pytest.raises(ConfigError, match="fog"):
        cases(["fogg"])
    with pytest.raises(DataError, match="without labels"):
        list(corrupt([Scan(s.points, s.reflectance, s.sensor) for s in scans], "clean"))


def test_the_command_writes_corruptions_once_and_beside_the_scans(
    tmp_path: Path,
) -> None:
    root = tmp_path / "scans"
    run("town", root, "--scans", 1, "--layout", "semantic_kitti", "--no-camera")
    for points in root.rglob("*.bin"):
        values = np.fromfile(points, np.float32).reshape(-1, 4)
        (values * [1, 1, 1, 255]).astype(np.float32).tofile(points)
    before = sorted(root.rglob("*"))
    given = ["stress", root, "--reflectance-max", 255, "--corruptions", "fog, snow,fog"]
    for out in (root, root / "stressed"):
        with pytest.raises(ConfigError, match="inside of .*a folder outside of it"):
            run(*given, "--out", out)
    assert sorted(root.rglob("*")) == before
    run(*given, "--out", tmp_path / "out")
    made = {p.name for p in (tmp_path / "out").iterdir() if p.is_dir()}
    assert made == {"clean", "fog", "snow"}
    [clean] = (tmp_path / "out" / "clean").rglob("*.bin")
    assert np.fromfile(clean, np.float32)[3::4].max() <= 1


def run(*words: object) -> str:
    """What a command prints."""
    return CliRunner().invoke(app, list(map(str, words)), catch_exceptions=False).stdout


@pytest.mark.slow
def test_the_command_prints_a_card(tmp_path: Path) -> None:
    """With another card as its baseline; all eight give the means."""
    folder = tmp_path / "town"
    run("town", folder, "--scans", 2, "--layout", "semantic_kitti", "--no-camera")
    figures = json.loads(run("stress", folder, "town", "--json"))
    assert set(figures["scores"]) == set(NAMES_OF_BENCHMARK)
    assert figures["mRR"] == pytest.approx(np.mean(list(figures["RR"].values())))
    path = tmp_path / "card.json"
    path.write_text(json.dumps(figures))
    assert read_means(path)["fog"] == pytest.approx(np.mean(figures["scores"]["fog"]))
    page = tmp_path / "card.html"
    few = ("--corruptions", "fog,rain", "--baseline", path, "--view", page)
    lines = run("stress", folder, "town", *few).splitlines()
    text = page.read_text()
    assert all(case in text for case in cases(["fog", "rain"])) and lines[3] in text
    assert lines[3].startswith("| fog |") and lines[3].endswith("| 100.0 |")
    assert lines[4].startswith("| rain |") and lines[4].endswith("|  |")
