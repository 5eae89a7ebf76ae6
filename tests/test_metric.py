"""Metrics in a training loop, over processes and from a cache; protocols and published figures as
data."""

import multiprocessing
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch.distributed
from conftest import random_scan
from random_archives import write

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import Scan, scan_hash
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.evaluate import PROTOCOLS, Metric, Score, evaluate, lidm
from lidar_synth.lab.evaluate.cache import Cached, extract_all, weights_hash
from lidar_synth.lab.evaluate.extractors import EXTRACTORS
from lidar_synth.lab.evaluate.measures import KINDS
from lidar_synth.lab.evaluate.protocols import FEATURES, alike, parse_protocol
from lidar_synth.lab.evaluate.published import compare_published, read_published

SENSOR = presets()["town"]
REAL = [random_scan(SENSOR, 1500, seed) for seed in range(6)]
FAKE = [random_scan(SENSOR, 1500, seed) for seed in range(10, 14)]


def moments(scans: Sequence[Scan]) -> np.ndarray:
    return np.stack([np.r_[s.points.mean(0), s.points.std(0)] for s in scans])


# --- update, compute, reset
# ---------------------------------------------------------------------------------------


def test_scans_in_parts_are_scans_at_once() -> None:
    metric = Metric("general", {"moments": moments}, batch=2)
    for part in (FAKE[:1], FAKE[1:]):
        metric.update(part, real=False)
    for part in (REAL[:4], REAL[4:], []):
        metric.update(part, real=True)
    whole = evaluate(REAL, FAKE, "general", {"moments": moments}, progress=False)
    assert metric.compute() == {s.metric: s.value for s in whole} and len(whole) == 7
    assert metric.compute() == metric.compute()


def test_one_scan_is_no_list_of_scans() -> None:
    with pytest.raises(DataError, match="scan .*; expected a list of scans"):
        Metric("town").update(REAL[0], real=True)  # type: ignore[arg-type]


def test_reset_forgets_the_generated_scans_and_real_ones_on_request() -> None:
    metric = Metric("town")
    metric.update(REAL, real=True)
    metric.update(FAKE[:2], real=False)
    first = metric.compute()
    metric.reset(real=False)
    with pytest.raises(DataError, match="no generated scans"):
        metric.compute()
    metric.update(FAKE[2:], real=False)
    assert metric.compute() != first
    metric.reset()
    with pytest.raises(DataError, match="no real scans"):
        metric.compute()


def test_merged_metrics_are_one() -> None:
    parts = [Metric("town"), Metric("town")]
    for metric, real, fake in zip(
        parts, (REAL[:2], REAL[2:]), (FAKE[:3], FAKE[3:]), strict=True
    ):
        metric.update(real, real=True)
        metric.update(fake, real=False)
    parts[0].merge(parts[1])
    assert parts[0].compute() == {
        s.metric: s.value for s in evaluate(REAL, FAKE, "town", progress=False)
    }


def of_a_rank(rank: int, store: str, out: str) -> None:
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{store}", rank=rank, world_size=2
    )
    metric = Metric("town", {"moments": moments})
    metric.update(REAL[rank::2], real=True)
    metric.update(FAKE[rank::2], real=False)
    values = metric.compute()
    # what was gathered is not collected a second time
    assert metric.compute() == values
    Path(out, str(rank)).write_text(repr(sorted(values.items())))
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_processes_compute_one_value_together(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    ranks = [
        context.Process(
            target=of_a_rank, args=(r, str(tmp_path / "store"), str(tmp_path))
        )
        for r in range(2)
    ]
    for process in ranks:
        process.start()
    for process in ranks:
        process.join()
    assert [p.exitcode for p in ranks] == [0, 0]
    one, other = ((tmp_path / str(r)).read_text() for r in range(2))
    assert one == other
    alone = evaluate(
        REAL[0::2] + REAL[1::2],
        FAKE[0::2] + FAKE[1::2],
        "town",
        {"moments": moments},
        progress=False,
    )
    for (name, value), score in zip(
        eval(one), sorted(alone, key=lambda s: s.metric), strict=True
    ):
        assert name == score.metric and value == pytest.approx(score.value, rel=1e-9)


def test_intervals_hold_the_values_and_features_get_them_with_enough_scans() -> None:
    many = [
        [random_scan(SENSOR, 300, first + i) for i in range(30)] for first in (0, 50)
    ]
    scores = evaluate(
        *many,
        "town",
        {"moments": moments},
        progress=False,
        replicates=40,
        extended=True,
    )
    by_name = {s.metric: s for s in scores}
    assert all(
        s.low is not None and s.low <= s.high
        for s in scores
        if "infinitely" not in s.metric
    )
    assert 0 <= by_name["precision of moments"].value <= 1
    same = evaluate(
        many[0],
        many[0][1:],
        "town",
        {"moments": moments},
        progress=False,
        replicates=40,
        extended=True,
    )
    shares = [
        s for s in same if s.metric.startswith(("precision", "recall", "coverage"))
    ]
    assert len(shares) == 3 and all(s.high is not None and s.high <= 1 for s in shares)
    assert {
        "recall of moments",
        "density of moments",
        "coverage of moments",
    } <= by_name.keys()
    frechet, unbiased = (
        by_name[f"Frechet distance of moments{end}"]
        for end in ("", ", infinitely many samples")
    )
    assert unbiased.value < frechet.value
    assert sum("squared maximum mean discrepancy" in name for name in by_name) == 1
    few = evaluate(
        REAL,
        FAKE,
        "town",
        {"moments": moments},
        progress=False,
        replicates=40,
        extended=True,
    )
    # 4 scans, 6 features.
    assert next(s for s in few if s.metric == "Frechet distance of moments").low is None
    assert "[" in str(by_name["BEV Jensen-Shannon distance"])


# --- bad input
# --------------------------------------------------------------------------------------------------


def test_features_that_are_not_finite_name_their_scan() -> None:
    def broken(scans: Sequence[Scan]) -> np.ndarray:
        return np.where([[s.id == REAL[1].id] for s in scans], np.nan, 1.0)

    with pytest.raises(
        DataError, match=f"scan {REAL[1].id!r}: features that are not finite"
    ):
        evaluate(REAL, FAKE, "town", {"broken": broken}, progress=False)
    with pytest.raises(
        DataError, match=r"features of shape \(6,\) of 6 scans; expected \(6, D\)"
    ):
        evaluate(
            REAL,
            FAKE,
            "town",
            {"flat": lambda scans: np.ones(len(scans))},
            progress=False,
        )


def test_one_scan_has_no_frechet_distance() -> None:
    # histograms can be compared
    assert evaluate(REAL[:1], FAKE[:1], "town", progress=False)
    with pytest.raises(
        DataError, match="features of 1 and 4 scans; expected at least two of each"
    ):
        evaluate(REAL[:1], FAKE, "town", {"moments": moments}, progress=False)
    with pytest.raises(
        DataError, match="1 real and 4 generated scans; expected at least two of each"
    ):
        evaluate(REAL[:1], FAKE, "town", progress=False, replicates=20)


@pytest.mark.parametrize("replicates", [19, -5])
def test_too_few_resamples_are_refused_before_any_scan(replicates: int) -> None:
    with pytest.raises(ConfigError, match=f"{replicates} resamples; .* 0 for no"):
        Metric("town", replicates=replicates)


def test_scans_of_another_sensor_are_refused() -> None:
    other = random_scan(presets()["hdl32e_nuscenes"], 1500)
    with pytest.raises(
        DataError,
        match=r"generated scan .*hdl32e_nuscenes \(32 rows.*expected that of scan 'random-0', town",
    ):
        evaluate(REAL, [other], "town", progress=False)
    with pytest.raises(DataError, match="real scan .* of sensor hdl32e_nuscenes .*"):
        evaluate([REAL[0], other], FAKE, "town", progress=False)
    with pytest.raises(DataError, match="the sensor of the lidm protocol"):
        Metric("lidm").update([other], real=True)
    metric = Metric("town")
    metric.update([other], real=False)
    with pytest.raises(DataError, match="real scan .* expected that of scan .*hdl32e"):
        metric.update(REAL, real=True)
    metric.reset()
    with pytest.raises(DataError, match="'empty'"):
        metric.update([replace(other[:0], id="empty")], real=True)
    metric.update(REAL, real=True)  # a failed update leaves nothing
    assert evaluate(REAL, [other], "town", progress=False, anyway=True)
    assert alike(presets()["hdl64e_kitti"], presets()["hdl64e_semantic_kitti"])


def test_a_figure_that_is_not_finite_is_left_out() -> None:
    near = [s[np.linalg.norm(s.points, axis=1) < 7.9] for s in REAL[:2]]
    left_out: dict[str, str] = {}
    scores = evaluate(near, FAKE, "general", progress=False, left_out=left_out)
    assert left_out == {"isolated": "no finite value for these scans"}
    assert all(np.isfinite(s.value) for s in scores) and len(scores) == 4


def test_measures_of_classes_are_left_out_without_labels() -> None:
    bare = [replace(s, label=None) for s in REAL]
    left_out: dict[str, str] = {}
    scores = evaluate(bare, FAKE, "general", progress=False, left_out=left_out)
    assert (
        left_out == {"s_jsd": "scans without labels", "s_mmd": "scans without labels"}
        and len(scores) == 3
    )
    with pytest.raises(DataError, match="no figure of spiral: .*scans without labels"):
        evaluate(bare, FAKE, "spiral", progress=False)
    with pytest.raises(DataError, match="only some scans have labels"):
        evaluate([*bare, REAL[0]], FAKE, "general", progress=False)


# --- the cache
# --------------------------------------------------------------------------------------------------


class Counting:
    def __init__(self) -> None:
        self.seen: list[str] = []

    def __call__(self, scans: Sequence[Scan], generated: bool = False) -> np.ndarray:
        self.seen += [s.id for s in scans]
        return moments(scans) + generated


def test_features_are_made_once_per_scan_and_weights(tmp_path: Path) -> None:
    count = Counting()
    cached = Cached(count, tmp_path, "weights 1")
    first = cached(REAL[:3])
    again = cached([REAL[2], REAL[3], REAL[0]])
    assert count.seen == [s.id for s in REAL[:4]]
    assert np.array_equal(first, moments(REAL[:3])) and np.array_equal(
        again, moments([REAL[2], REAL[3], REAL[0]])
    )
    # Prepared as a generated scan.
    assert np.array_equal(cached(REAL[:1], True), moments(REAL[:1]) + 1)
    Cached(count, tmp_path, "weights 2")(REAL[:1])
    assert count.seen[4:] == [REAL[0].id] * 2


@pytest.mark.parametrize("change", ["points", "reflectance", "label", "sensor"])
def test_a_scan_that_changes_has_another_hash(change: str) -> None:
    scan = REAL[0]
    other = (
        replace(scan, sensor=presets()["hdl64e_kitti"])
        if change == "sensor"
        else replace(scan, **{change: np.roll(getattr(scan, change), 1, 0)})
    )
    assert scan_hash(other) != scan_hash(scan) == scan_hash(replace(scan, id="renamed"))


def test_a_damaged_file_is_made_again(tmp_path: Path) -> None:
    count = Counting()
    cached = Cached(count, tmp_path, "weights")
    cached(REAL[:2])
    for file, content in zip(
        sorted(tmp_path.rglob("*.npz")), (b"", b"PK broken"), strict=True
    ):
        file.write_bytes(content)
    assert np.array_equal(cached(REAL[:2]), moments(REAL[:2])) and len(count.seen) == 4
    cached(REAL[:2])
    assert len(count.seen) == 4


def test_weights_are_told_apart_by_content(tmp_path: Path) -> None:
    for name, content in (("a", "1"), ("b", "1"), ("c", "2")):
        (tmp_path / name / "deep").mkdir(parents=True)
        (tmp_path / name / "deep" / "weights").write_text(content)
    a, b, c = (weights_hash(tmp_path / name) for name in "abc")
    assert a == b != c and weights_hash(tmp_path / "c" / "deep" / "weights") not in (
        a,
        c,
    )


def make_cached(folder: Path) -> Cached:
    return Cached(moments, folder, "weights")


@pytest.mark.slow
def test_processes_extract_the_features_of_one(tmp_path: Path) -> None:
    both = extract_all(partial(make_cached, tmp_path), REAL, processes=2, batch=2)
    assert np.array_equal(both, moments(REAL)) and len(
        list(tmp_path.rglob("*.npz"))
    ) == len(REAL)
    unused = Cached(
        lambda scans: pytest.fail("not from the cache"), tmp_path, "weights"
    )
    assert np.array_equal(extract_all(lambda: unused, REAL), both)
    with pytest.raises(
        ConfigError, match="2 processes without a cache; expected a folder"
    ):
        evaluate(REAL, FAKE, "town", progress=False, processes=2)


def test_published_weights_are_measured_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("sparenet_pointnet", tmp_path / "weights")
    options = {
        "weights": tmp_path / "weights",
        "cache": tmp_path / "cache",
        "progress": False,
        "anyway": True,
    }
    left_out: dict[str, str] = {}
    first = evaluate(REAL[:2], FAKE[:2], "r2flow", left_out=left_out, **options)
    assert [s.table for s in first] == ["JSD", "MMD", "FPD"] and set(left_out) == {
        "frd",
        "frid",
        "fsvd",
        "fpvd",
    }
    files = {p: p.stat().st_mtime_ns for p in (tmp_path / "cache").rglob("*.npz")}
    assert len(files) == 4
    assert evaluate(REAL[:2], FAKE[:2], "r2flow", **options) == first
    assert files == {
        p: p.stat().st_mtime_ns for p in (tmp_path / "cache").rglob("*.npz")
    }
    assert first[-1].value > 0


# --- protocols and published figures as data
# ----------------------------------------------------------------------


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_says_where_it_was_read(name: str) -> None:
    protocol = PROTOCOLS[name]
    assert protocol.name == name
    paper = protocol.reference is not None
    assert bool(protocol.source) == paper
    for measure in protocol.measures.values():
        assert not measure.table or paper
    if any(m.kind == FEATURES and m.table == "" for m in protocol.measures.values()):
        assert protocol.unverified
    for measure in protocol.measures.values():
        assert measure.kind == FEATURES or measure.kind in KINDS


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_extractor_of_a_protocol_exists(name: str) -> None:
    for measure in PROTOCOLS[name].measures.values():
        if measure.extractor is not None:
            spec = EXTRACTORS[measure.extractor]
            assert spec.measure == measure.table or not measure.table


def test_the_grid_of_lidm_is_that_of_its_protocol() -> None:
    grid = PROTOCOLS["lidm"].prepare.grid
    assert grid is not None and replace(grid, name="lidm") == lidm.SENSOR == replace(
        lidm.SENSOR, name="lidm"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: x\nmeasures: {a: {kind: bev_jsd, title: A, colour: red}}", "colour"),
        ("name: x\nmeasures: {a: {kind: jsd, title: A}}", "kind 'jsd' is none of"),
        ("name: x\nmeasures: {a: {kind: frechet, title: A}}", "has an extractor"),
        ("[1, 2]", "x.yaml"),
        ("name: x\nneeds: {fake: 3}\nmeasures: {}", "needs"),
    ],
)
def test_a_protocol_that_cannot_be_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_protocol(text, "x.yaml")


def test_published_figures_name_their_protocol_and_source() -> None:
    tables, sources = read_published()
    for table in tables:
        names = {m.table for m in PROTOCOLS[table.protocol].measures.values()}
        assert table.source in sources and table.rows
        for row in table.rows:
            figures = row.keys() - {"method", "steps"}
            assert (
                figures
                and figures <= names
                and all(isinstance(row[f], int | float) for f in figures)
            )


def test_own_figures_stand_in_the_scale_of_the_table() -> None:
    scores = [
        Score(
            "BEV minimum matching distance",
            8.72e-5,
            "r3dpa",
            1000,
            2000,
            "MMD",
            1e5,
            8e-5,
            9e-5,
        )
    ]
    shown = compare_published(scores)
    assert (
        shown.splitlines()[-1]
        == "| **these scans** (1000 real, 2000 generated) | |  |  |  |  |  | 8.72 [8, 9] |"
    )
    outside = Score("x", 0.319, "lidm", 64, 64, "", 1.0, 0.247, 0.273, 0.26)
    assert outside.shown() == "0.319 (corrected 0.26) [0.247, 0.273]"
    assert replace(outside, value=0.25).shown() == "0.25 [0.247, 0.273]"
    assert (
        "| R3DPA |  | 8.46 | 6.34 | 9.83 | 11.0 | 5.67 | 8.72 |" in shown
        and "LiDAR-Flow" not in shown
    )
    assert "No published figures" in compare_published([Score("x", 1.0, "town", 2, 2)])
