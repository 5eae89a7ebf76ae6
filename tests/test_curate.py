"""Curation: planted outliers get the highest scores, and the command lists, plots and drops
scans."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from banks import SENSOR, some_image, write_bank
from hypothesis import given, settings
from layouts import write_all
from test_verify import call, names_and_points

import lidar_synth.lab.curate.duplicates as duplicates
from lidar_synth.bank import Bank
from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.lab.cli.curate import curate
from lidar_synth.lab.curate import FILE, MEANINGS, read_scores, score, write_scores
from lidar_synth.lab.curate.features import MEASURES, features
from lidar_synth.lab.curate.scores import FARTHEST
from lidar_synth.viz import histograms

ALL = ("reflectance", "label", "confidence")
ROAD = TRAIN_ID["road"]
BUILDING = TRAIN_ID["building"]


def plain_image(seed: int) -> RangeImage:
    """Four walls on a road at random distances; each seed gives another scan."""
    metres = np.tile(
        np.repeat(np.random.default_rng(seed).uniform(6, 38, 4), 8), (8, 1)
    ).astype(np.float32)
    metres[:, seed % 32] = 0
    seen = metres > 0
    label = np.where(np.arange(8)[:, None] < 3, BUILDING, ROAD) * np.ones((1, 32))
    channels = {
        "reflectance": np.where(seen, 0.5, 0).astype(np.float32),
        "label": np.where(seen, label, IGNORE).astype(np.uint8),
        "confidence": np.where(seen, 0.9, 0).astype(np.float32),
    }
    return RangeImage(metres, SENSOR, channels)


def relabelled(image: RangeImage, label: object) -> None:
    image.channels["label"] = np.where(image.mask, label, IGNORE).astype(np.uint8)


def empty(image: RangeImage) -> None:
    image.range[:, 9:] = 0
    for name, nothing in (("reflectance", 0), ("label", IGNORE), ("confidence", 0)):
        image.channels[name][:, 9:] = nothing


def narrow(image: RangeImage) -> None:
    image.range[image.mask] = np.linspace(70, 79, image.mask.sum())


def sprayed(image: RangeImage) -> None:
    shown = image.range[image.mask]
    behind = np.random.default_rng(0).uniform(45, 75, len(shown))
    image.range[image.mask] = np.where(np.arange(len(shown)) % 3, shown, behind)


PLANTED: dict[str, Callable[[RangeImage], object]] = {
    "range": narrow,
    "labels": lambda image: relabelled(image, TRAIN_ID["car"]),
    "empty": empty,
    "isolated": sprayed,
    "unlabelled": lambda image: relabelled(
        image, np.where(np.arange(32) < 20, IGNORE, ROAD)
    ),
    "floating": lambda image: relabelled(image, ROAD),
    "speckle": lambda image: relabelled(
        image, np.where(np.arange(32) % 2, ROAD, BUILDING)
    ),
    "confidence": lambda image: image.channels["confidence"].fill(0.2),
}


def images_with(name: str) -> list[RangeImage]:
    """Twenty scans; number 13 is the outlier."""
    images = [plain_image(seed) for seed in range(20)]
    if name == "duplicate":
        images[13] = replace(
            plain_image(4), range=plain_image(4).range * np.float32(1.002)
        )
    else:
        PLANTED[name](images[13])
        images[13].channels["confidence"][~images[13].mask] = 0
    return images


# Scores


@pytest.mark.parametrize("name", MEANINGS)
def test_a_planted_outlier_has_the_highest_score(name: str, tmp_path: Path) -> None:
    write_bank(tmp_path, images_with(name), shard_size=8, fields=ALL)
    scores = score(Bank(tmp_path), progress=False)
    assert list(scores.values) == list(MEANINGS)
    values = -scores.values[name] if name == "confidence" else scores.values[name]
    others = np.delete(values, 13)
    assert (
        values[13] > others.max() + 0.5 * (others.max() - others.min())
        and values.argmax() == 13
    )
    if name == "duplicate":
        assert scores.twin[13] == 4 and values[13] > 0.99 and scores.twin[0] == -1


def test_the_measures_match_their_definitions() -> None:
    image = plain_image(0)
    scan = unproject(image)
    assert MEASURES["empty"].of(image, scan) == pytest.approx(1 / 32)
    assert MEASURES["confidence"].of(image, scan) == pytest.approx(0.9)
    assert [
        MEASURES[name].of(image, scan) for name in ("unlabelled", "floating", "speckle")
    ] == [
        0,
        0,
        0,
    ]
    # The first row looks up, the others down.
    image.channels["label"][0, 1:5] = (
        ROAD,
        ROAD,
        IGNORE,
        BUILDING,
    )
    scan = unproject(image)
    assert MEASURES["unlabelled"].of(image, scan) == pytest.approx(1 / (8 * 31))
    assert MEASURES["floating"].of(image, scan) == pytest.approx(2 / (5 * 31 + 2))
    assert MEASURES["speckle"].of(image, scan) == 0
    image.channels["label"][0, 10] = ROAD
    # Four walls of 7 in every row, less what is beside the gap and beside the unknown label.
    pairs = 8 * 27 - 2
    assert MEASURES["speckle"].of(image, unproject(image)) == pytest.approx(2 / pairs)


def test_a_scan_without_returns_has_the_largest_distance(tmp_path: Path) -> None:
    images = [plain_image(seed) for seed in range(3)]
    images[1] = RangeImage(
        np.zeros_like(images[1].range),
        SENSOR,
        {"label": np.full_like(images[1].label, IGNORE)},
    )
    write_bank(tmp_path, images, fields=("label",))
    values = score(Bank(tmp_path), progress=False).values
    assert set(values) == set(MEANINGS) - {"confidence"}
    assert (
        values["range"][1] == values["labels"][1] == FARTHEST
        and values["empty"][1] == 1
    )
    assert [
        values[name][1] for name in ("unlabelled", "floating", "speckle", "duplicate")
    ] == [
        0,
        0,
        0,
        0,
    ]


def test_signatures_are_unit_vectors_of_the_near_returns() -> None:
    points = features(plain_image(3)).signature.astype(np.float64)
    assert points.shape == (1024,) and np.linalg.norm(points) == pytest.approx(
        1, abs=1e-3
    )
    far = plain_image(3)
    far.range[far.mask] = 79
    assert not features(far).signature[512 - 16 : 512 + 16].any()


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1), count=st.integers(1, 12), block=st.integers(1, 5)
)
def test_the_most_similar_earlier_scan_is_found(
    seed: int, count: int, block: int
) -> None:
    rng = np.random.default_rng(seed)
    signatures = rng.random((count, 6)) * (rng.random((count, 6)) < 0.5)
    signatures = (
        signatures / np.linalg.norm(signatures, axis=1).clip(1e-9)[:, None]
    ).astype(np.float16)
    products = signatures.astype(np.float32) @ signatures.astype(np.float32).T
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(duplicates, "BLOCK", block)
        similarity, twin = duplicates.most_similar(signatures, progress=False)
    assert (similarity[0], twin[0]) == (0, -1)
    for i in range(1, count):
        assert 0 <= twin[i] < i and similarity[i] == pytest.approx(
            min(products[i, :i].max(), 1), abs=1e-6
        )
        assert products[i, twin[i]] == pytest.approx(products[i, :i].max(), abs=1e-6)


def test_a_reference_replaces_the_mean_histograms(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", images_with("range"), fields=ALL)
    write_bank(tmp_path / "odd", [images_with("range")[13]], fields=ALL)
    bank = Bank(tmp_path / "bank")
    odd = Bank(tmp_path / "odd")
    values = score(bank, odd, name="odd", progress=False).values
    assert values["range"].argmin() == 13 and values["range"][13] < 1e-6
    assert np.array_equal(values["empty"], score(bank, progress=False).values["empty"])
    write_bank(tmp_path / "blind", [images_with("range")[13]], fields=())
    assert "labels" not in score(bank, Bank(tmp_path / "blind"), progress=False).values
    with pytest.raises(ConfigError, match="jobs 0; expected a whole number"):
        score(bank, jobs=0)
    with pytest.raises(ConfigError, match="scans of the reference 'odd' 0"):
        score(bank, [], name="odd")


def test_every_scan_counts_alike_in_the_mean(tmp_path: Path) -> None:
    """Of one scan and a copy with half of its returns at other ranges, both are as far away."""
    images = [plain_image(0), plain_image(0)]
    images[0].range[:] = 10
    images[1].range[:] = 60
    images[1].range[::2] = 0
    write_bank(tmp_path, images, fields=())
    near, far = score(Bank(tmp_path), progress=False).values["range"]
    assert near == pytest.approx(far)


def test_scores_do_not_depend_on_processes_and_are_saved(tmp_path: Path) -> None:
    write_bank(tmp_path, images_with("empty"), shard_size=8, fields=ALL)
    one, two = (score(Bank(tmp_path), jobs=jobs, progress=False) for jobs in (1, 2))
    for name, values in one.values.items():
        assert np.array_equal(values, two.values[name])
    write_scores(tmp_path / FILE, one)
    back = read_scores(tmp_path / FILE)
    assert (back.bank, back.reference) == (Bank(tmp_path).identity, "") and list(
        back.values
    ) == list(one.values)
    assert all(
        np.array_equal(back.values[name], values) for name, values in one.values.items()
    )
    (tmp_path / FILE).write_bytes((tmp_path / FILE).read_bytes()[:-100])
    with pytest.raises(DataError, match=r"scores.npz: "):
        read_scores(tmp_path / FILE)
    np.savez(
        tmp_path / FILE,
        bank=np.array(""),
        reference=np.array(""),
        twin=np.zeros(3),
        range=np.zeros(2),
    )
    with pytest.raises(DataError, match=r"expected the scores of a bank. Remove it"):
        read_scores(tmp_path / FILE)


# The command


@pytest.fixture
def bank(tmp_path: Path) -> Path:
    write_bank(tmp_path / "bank", images_with("duplicate"), shard_size=8, fields=ALL)
    return tmp_path / "bank"


@pytest.mark.slow
def test_the_command_lists_plots_and_drops(bank: Path, tmp_path: Path) -> None:
    out = tmp_path / "good"
    picture = tmp_path / "scores.png"
    status, output = call(
        "curate", bank, "--sort", "duplicate", "--limit", 1, "--plot", picture
    )
    assert status == 0 and "0 of 20 scans match the rules" in output
    [row] = [line for line in output.splitlines() if "small/5/13" in line]
    assert row.split()[0] == "13" and row.split()[-1] == "4"
    assert picture.read_bytes()[:4] == b"\x89PNG"
    made = (bank / FILE).stat().st_mtime_ns
    rules = ("--drop", "duplicate > 0.99", "--drop", "confidence < 0.5 and empty > 0.9")
    status, output = call("curate", bank, *rules, "--limit", 20)
    assert "1 of 20 scans match the rules" in output and output.count("dropped") == 1
    status, output = call("curate", bank, *rules, "--out", out)
    assert (
        status == 0
        and f"{out}: 19 scans in 3 shards; 1 of 20 scans left out by 'duplicate > 0.99' or "
        in output
    )
    assert (bank / FILE).stat().st_mtime_ns == made  # scored once
    assert (
        names_and_points(out)
        == names_and_points(bank)[:13] + names_and_points(bank)[14:]
    )
    assert (
        "left out by 'duplicate > 0.99'"
        in json.loads(call("info", out, "--json")[1])["curation"]
    )
    call("curate", out)
    assert len(read_scores(out / FILE).twin) == 19


@pytest.mark.slow
def test_the_help_names_every_score() -> None:
    assert curate.__doc__ is not None
    listed = curate.__doc__.partition("Scores:")[2].partition("Examples:")[0]
    assert {line.split()[0] for line in listed.splitlines() if line.strip(" \b")} == {
        *MEANINGS
    }


def test_the_plot_counts_every_scan_and_marks_some() -> None:
    rng = np.random.default_rng(0)
    values = {name: rng.random(50) for name in MEANINGS}
    marked = rng.random(50) < 0.2
    figure = histograms(values, MEANINGS, marked, "title")
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(MEANINGS)
    for axes in figure.axes:
        plain, orange = (
            sum(patch.get_height() for patch in bars) for bars in axes.containers
        )
        assert (plain, orange) == ((~marked).sum(), marked.sum())


def test_the_command_prints_json_and_takes_a_reference(
    bank: Path, tmp_path: Path
) -> None:
    found = json.loads(
        call(
            "curate",
            bank,
            "--json",
            "--sort",
            "-empty",
            "--limit",
            3,
            "--drop",
            "empty >= 0",
        )[1]
    )
    assert (found["scans"], found["dropped"], len(found["listed"])) == (20, 20, 3)
    assert {"number", "id", "twin", "dropped", *MEANINGS} == set(found["listed"][0])
    before = read_scores(bank / FILE).values["range"]
    write_all("npz", tmp_path / "real", [unproject(images_with("range")[13])])
    call("curate", bank, "--reference", tmp_path / "real", "--json")
    scores = read_scores(bank / FILE)
    assert scores.reference.startswith(f"1 scans of {tmp_path / 'real'} (")
    assert not np.allclose(scores.values["range"], before)


def test_a_reference_is_read_with_the_options_that_it_needs(
    bank: Path, tmp_path: Path
) -> None:
    (tmp_path / "real").mkdir()
    scans = [unproject(images_with("range")[number]) for number in (12, 13)]
    for number, scan in enumerate(scans):
        bright = np.column_stack([scan.points, np.full(len(scan), 255.0)])
        bright.astype(np.float32).tofile(tmp_path / "real" / f"{number}.bin")
    (tmp_path / "real" / "0.bin").write_bytes(b"damaged")
    reading = ["--reflectance-max", "255", "--on-bad", "skip"]
    call("curate", bank, "--reference", tmp_path / "real", *reading, "--json")
    skipped = read_scores(bank / FILE).values["range"]
    (tmp_path / "real" / "0.bin").unlink()
    call("curate", bank, "--reference", tmp_path / "real", *reading, "--json")
    assert np.array_equal(read_scores(bank / FILE).values["range"], skipped)


def test_scores_of_a_reference_with_other_scans_of_the_same_names_are_not_reused(
    bank: Path, tmp_path: Path
) -> None:
    found = []
    for seed in (1, 2):
        write_all("npz", tmp_path / "real", [unproject(some_image(seed))])
        call("curate", bank, "--reference", tmp_path / "real", "--json")
        found.append(read_scores(bank / FILE).values["range"])
    assert not np.allclose(*found)


def test_scores_of_another_bank_are_not_reused(bank: Path) -> None:
    call("curate", bank, "--json")
    write_bank(bank, [some_image(i) for i in range(3)], fields=ALL)
    call("curate", bank, "--json")
    assert (
        len(read_scores(bank / FILE).twin) == 3
        and read_scores(bank / FILE).bank == Bank(bank).identity
    )


def test_scores_of_a_read_only_bank_are_saved_here(
    bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sorted(bank.iterdir())
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != bank)
    told = [call("curate", bank, "--json") for _ in range(2)]
    assert told[0] == told[1] and sorted(bank.iterdir()) == before
    [saved] = Path().iterdir()
    assert read_scores(saved).bank == Bank(bank).identity


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "x"], "--out x without a rule; expected --drop as well"),
        (["--plot", "x.jpg"], "--plot x.jpg; expected a file that ends in .png"),
        (
            ["--split", "train", "--fields", "5"],
            "--split, --fields without a reference; expected --reference as well",
        ),
        (["--sort", "beauty"], "score 'beauty'; expected one of 'range', 'labels'"),
        (["--drop", "beauty > 1", "--out", "x"], "score 'beauty' in rule"),
        (["--drop", "empty >= 0", "--out", "bank/good"], "inside of .*bank"),
        (["--drop", "empty >= 0", "--out", "x"], "all 20 scans of .* left out"),
    ],
)
def test_wrong_calls_write_nothing(
    bank: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        call("curate", bank, *options)
    assert not Path("x").exists()
    # All but the last are refused before a scan is scored.
    assert (bank / FILE).exists() == message.startswith("all")
