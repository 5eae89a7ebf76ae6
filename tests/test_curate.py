"""Curation: planted oddities are found, a rule means what it says, and a curated bank is whole without them."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from banks import SENSOR, some_facts, some_image, write_bank
from hypothesis import given, settings
from layouts import write_all
from test_generator import write
from test_verify import baked, call, flip, names_and_points, shards

import lidar_synth.bake.curate.duplicates as duplicates
from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.bake.curate import FILE, MEANINGS, matching, read_scores, score, write_scores
from lidar_synth.bake.curate.features import MEASURES, features
from lidar_synth.bake.curate.scores import FARTHEST
from lidar_synth.bake.edit import drop, head, merge, split
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import verify
from lidar_synth.bank import INDEX, Bank, Entry, Index
from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.viz import histograms

ALL = ("reflectance", "label", "confidence")
ROAD, BUILDING = TRAIN_ID["road"], TRAIN_ID["building"]
KEPT = [0, 2, 3, 6, 7]


def plain_image(seed: int) -> RangeImage:
    """Four walls on a road, at distances of their own; every scan another place."""
    metres = np.tile(np.repeat(np.random.default_rng(seed).uniform(6, 38, 4), 8), (8, 1)).astype(np.float32)
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


PLANTED: dict[str, Callable[[RangeImage], object]] = {
    "range": narrow,
    "labels": lambda image: relabelled(image, TRAIN_ID["car"]),
    "empty": empty,
    "unlabelled": lambda image: relabelled(image, np.where(np.arange(32) < 20, IGNORE, ROAD)),
    "floating": lambda image: relabelled(image, ROAD),
    "speckle": lambda image: relabelled(image, np.where(np.arange(32) % 2, ROAD, BUILDING)),
    "confidence": lambda image: image.channels["confidence"].fill(0.2),
}


def images_with(name: str) -> list[RangeImage]:
    """Twenty scans, of which number 13 is odd."""
    images = [plain_image(seed) for seed in range(20)]
    if name == "duplicate":
        images[13] = replace(plain_image(4), range=plain_image(4).range * np.float32(1.002))
    else:
        PLANTED[name](images[13])
        images[13].channels["confidence"][~images[13].mask] = 0
    return images


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


@pytest.fixture(scope="module")
def original(model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scans in shards of three."""
    return baked(tmp_path_factory.mktemp("original") / "bank", model)


@pytest.fixture
def good(original: Path, tmp_path: Path) -> Path:
    """Without scans 1, 4 and 5: the first shard has lost one in the middle, the second one its last two."""
    drop(Bank(original), [1, 4, 5], "by hand", tmp_path / "good", progress=False)
    return tmp_path / "good"


# Scores


@pytest.mark.parametrize("name", MEANINGS)
def test_a_planted_oddity_has_the_highest_score(name: str, tmp_path: Path) -> None:
    write_bank(tmp_path, images_with(name), shard_size=8, fields=ALL)
    scores = score(Bank(tmp_path), progress=False)
    assert list(scores.values) == list(MEANINGS)
    values = -scores.values[name] if name == "confidence" else scores.values[name]
    others = np.delete(values, 13)
    assert values[13] > others.max() + 0.5 * (others.max() - others.min()) and values.argmax() == 13
    if name == "duplicate":
        assert scores.twin[13] == 4 and values[13] > 0.99 and scores.twin[0] == -1


def test_the_measures_are_what_they_say() -> None:
    image = plain_image(0)
    scan = unproject(image)
    assert MEASURES["empty"].of(image, scan) == pytest.approx(1 / 32)
    assert MEASURES["confidence"].of(image, scan) == pytest.approx(0.9)
    assert [MEASURES[name].of(image, scan) for name in ("unlabelled", "floating", "speckle")] == [0, 0, 0]
    image.channels["label"][0, 1:5] = ROAD, ROAD, IGNORE, BUILDING  # the first row looks up, the others down
    scan = unproject(image)
    assert MEASURES["unlabelled"].of(image, scan) == pytest.approx(1 / (8 * 31))
    assert MEASURES["floating"].of(image, scan) == pytest.approx(2 / (5 * 31 + 2))
    assert MEASURES["speckle"].of(image, scan) == 0
    image.channels["label"][0, 10] = ROAD
    pairs = 8 * 27 - 2  # four walls of 7 in every row, less what is beside the gap and beside the unknown label
    assert MEASURES["speckle"].of(image, unproject(image)) == pytest.approx(2 / pairs)


def test_a_scan_without_a_return_is_far_from_everything(tmp_path: Path) -> None:
    images = [plain_image(seed) for seed in range(3)]
    images[1] = RangeImage(np.zeros_like(images[1].range), SENSOR, {"label": np.full_like(images[1].label, IGNORE)})
    write_bank(tmp_path, images, fields=("label",))
    values = score(Bank(tmp_path), progress=False).values
    assert set(values) == set(MEANINGS) - {"confidence"}
    assert values["range"][1] == values["labels"][1] == FARTHEST and values["empty"][1] == 1
    assert [values[name][1] for name in ("unlabelled", "floating", "speckle", "duplicate")] == [0, 0, 0, 0]


def test_signatures_are_unit_vectors_of_what_is_near() -> None:
    points = features(plain_image(3)).signature.astype(np.float64)
    assert points.shape == (1024,) and np.linalg.norm(points) == pytest.approx(1, abs=1e-3)
    far = plain_image(3)
    far.range[far.mask] = 79
    assert not features(far).signature[512 - 16 : 512 + 16].any()


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 12), block=st.integers(1, 5))
def test_the_most_alike_of_the_earlier_ones(seed: int, count: int, block: int) -> None:
    rng = np.random.default_rng(seed)
    signatures = rng.random((count, 6)) * (rng.random((count, 6)) < 0.5)
    signatures = (signatures / np.linalg.norm(signatures, axis=1).clip(1e-9)[:, None]).astype(np.float16)
    products = signatures.astype(np.float32) @ signatures.astype(np.float32).T
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(duplicates, "BLOCK", block)
        likeness, twin = duplicates.most_alike(signatures, progress=False)
    assert (likeness[0], twin[0]) == (0, -1)
    for i in range(1, count):
        assert 0 <= twin[i] < i and likeness[i] == pytest.approx(min(products[i, :i].max(), 1), abs=1e-6)
        assert products[i, twin[i]] == pytest.approx(products[i, :i].max(), abs=1e-6)


def test_a_reference_takes_the_place_of_the_mean(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", images_with("range"), fields=ALL)
    write_bank(tmp_path / "odd", [images_with("range")[13]], fields=ALL)
    bank, odd = Bank(tmp_path / "bank"), Bank(tmp_path / "odd")
    values = score(bank, odd, name="odd", progress=False).values
    assert values["range"].argmin() == 13 and values["range"][13] < 1e-6
    assert np.array_equal(values["empty"], score(bank, progress=False).values["empty"])
    write_bank(tmp_path / "blind", [images_with("range")[13]], fields=())
    assert "labels" not in score(bank, Bank(tmp_path / "blind"), progress=False).values
    for wrong in ({"jobs": 0}, {"reference": []}):
        with pytest.raises(ConfigError, match="at least one job, and one scan"):
            score(bank, **wrong)  # type: ignore[arg-type]


def test_processes_score_alike_and_the_file_keeps_it(tmp_path: Path) -> None:
    write_bank(tmp_path, images_with("empty"), shard_size=8, fields=ALL)
    one, two = (score(Bank(tmp_path), jobs=jobs, progress=False) for jobs in (1, 2))
    for name, values in one.values.items():
        assert np.array_equal(values, two.values[name])
    write_scores(tmp_path / FILE, one)
    back = read_scores(tmp_path / FILE)
    assert (back.bank, back.reference) == (Bank(tmp_path).identity, "") and list(back.values) == list(one.values)
    assert all(np.array_equal(back.values[name], values) for name, values in one.values.items())
    (tmp_path / FILE).write_bytes((tmp_path / FILE).read_bytes()[:-100])
    with pytest.raises(DataError, match=r"scores.npz: "):
        read_scores(tmp_path / FILE)
    np.savez(tmp_path / FILE, bank=np.array(""), reference=np.array(""), twin=np.zeros(3), range=np.zeros(2))
    with pytest.raises(DataError, match=r"expected the scores of a bank. Remove it"):
        read_scores(tmp_path / FILE)


# Rules


SCORES = {"confidence": np.array([0.1, 0.5, 0.9]), "empty": np.array([0.3, 0.2, 0.1])}


@pytest.mark.parametrize(
    ("rule", "means"),
    [
        ("confidence < 0.5", [True, False, False]),
        ("confidence<=.5", [True, True, False]),
        (" empty > 1e-1 ", [True, True, False]),
        ("empty >= 0.1", [True, True, True]),
        ("confidence > 0.2 and empty > 0.1", [False, True, False]),
        ("confidence > -1 and empty < +2. and empty < 0.15", [False, False, True]),
    ],
)
def test_rules(rule: str, means: list[bool]) -> None:
    assert matching(rule, SCORES).tolist() == means


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ("", "rule ''; expected a score"),
        ("confidence", "rule 'confidence'; expected a score"),
        ("confidence = 0.5", "expected a score, < <= > or >=, and a number"),
        ("0.5 < confidence", "expected a score, < <= > or >=, and a number"),
        ("confidence < 0.5 or empty > 0", "expected a score"),
        ("confidence < nan", "expected a score"),
        ("confidence < 0.5 and", "expected a score"),
        ("confidence < 0.5); print(1", "expected a score"),
        ("__import__('os') < 1", "expected a score"),
        ("colour < 1", "score 'colour' in rule 'colour < 1'; expected one of confidence, empty"),
    ],
)
def test_what_is_no_rule(rule: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        matching(rule, SCORES)


# Curated banks


@settings(max_examples=50)
@given(scans=st.integers(1, 40), data=st.data())
def test_positions_of_what_is_kept(scans: int, data: st.DataObject) -> None:
    dropped = sorted(data.draw(st.sets(st.integers(0, scans - 1), max_size=scans - 1)))
    entry = Entry("a.h5", 0, 0, scans, dropped=tuple(dropped))
    kept = np.setdiff1d(np.arange(scans), dropped).tolist()
    assert (entry.kept, [entry.position(rank) for rank in range(entry.kept)]) == (len(kept), kept)


def test_a_curated_bank_is_the_bank_without_some_scans(original: Path, good: Path) -> None:
    expected = [names_and_points(original)[i] for i in KEPT]
    bank = Bank(good)
    assert len(bank) == 5 and names_and_points(good) == expected
    assert list(bank.ids) == [f"small/0/{i}" for i in KEPT]
    assert np.array_equal(bank.image(4).range, Bank(original).image(7).range)
    assert (bank.index.curation, bank.index.sources) == (("by hand",), Bank(original).index.sources)
    assert verify(good, progress=False) == [] and bank.identity != Bank(original).identity
    for path in good.glob("*.h5"):  # the same files, not copies
        assert path.stat().st_ino == (original / path.name.replace(".curated", "")).stat().st_ino
    assert Index.from_json((good / INDEX).read_bytes(), "") == bank.index
    assert "| curation | by hand |" in (good / "README.md").read_text()


def test_an_index_without_curation_says_nothing_of_it(original: Path) -> None:
    """Older versions read it, and an index that leaves scans out none of them reads as if it did not."""
    text = (original / INDEX).read_text()
    assert "dropped" not in text and "curation" not in text


def test_a_shard_of_which_nothing_is_kept_is_not_there(original: Path, tmp_path: Path) -> None:
    index = drop(Bank(original), [0, 3, 4, 5], "by hand", tmp_path / "few", progress=False)
    assert [entry.dropped for entry in index.shards] == [(0,), ()]
    assert len(list((tmp_path / "few").glob("*.h5"))) == 2 and verify(tmp_path / "few", progress=False) == []
    assert names_and_points(tmp_path / "few") == [names_and_points(original)[i] for i in (1, 2, 6, 7)]
    with pytest.raises(ConfigError, match=r"all 4 scans of .*few left out \(all\); expected a rule that leaves some"):
        drop(Bank(tmp_path / "few"), range(4), "all", tmp_path / "none", progress=False)
    with pytest.raises(ConfigError, match=r"scans \[-1, 4\] to leave out; expected 0 to 3"):
        drop(Bank(tmp_path / "few"), [1, 4, -1], "some", tmp_path / "none", progress=False)
    assert not (tmp_path / "none").exists()


def test_curating_again(good: Path, original: Path, tmp_path: Path) -> None:
    index = drop(Bank(good), [0, 2], "once more", tmp_path / "better", progress=False)
    assert (index.curation, index.scans) == (("by hand", "once more"), 3)
    assert names_and_points(tmp_path / "better") == [names_and_points(original)[i] for i in (2, 6, 7)]
    with pytest.raises(ConfigError, match="good holds a bank; expected a folder of its own"):
        drop(Bank(original), [0], "elsewhere", good, progress=False)


@pytest.mark.parametrize("shares", [(0.2, 0.2, 0.6), (0.4, 0.6), (0.8, 0.2)])
def test_parts_of_a_curated_bank_are_curated(good: Path, tmp_path: Path, shares: tuple[float, ...]) -> None:
    parts = split(Bank(good), {tmp_path / str(i): share for i, share in enumerate(shares)}, progress=False)
    assert names_and_points(*parts) == names_and_points(good)
    assert all(verify(part, progress=False) == [] for part in parts)
    assert all(index.curation == ("by hand",) for index in parts.values())
    merge([Bank(part) for part in parts], tmp_path / "merged", progress=False)
    assert names_and_points(tmp_path / "merged") == names_and_points(good)
    assert Bank(tmp_path / "merged").index.curation == ("by hand",)
    assert all(path.name.endswith(".curated.h5") for path in (tmp_path / "merged").glob("*.h5"))
    assert head(Bank(good), 3, tmp_path / "head", progress=False).scans == 3
    assert names_and_points(tmp_path / "head") == names_and_points(good)[:3]


def test_a_part_of_a_shard_keeps_what_is_dropped_in_it(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(9)], shard_size=9)
    drop(Bank(tmp_path / "bank"), [2, 4, 5], "by hand", tmp_path / "good", progress=False)
    parts = split(Bank(tmp_path / "good"), {tmp_path / "a": 2 / 6, tmp_path / "b": 4 / 6}, progress=False)
    [a], [b] = (index.shards for index in parts.values())
    assert (a.first, a.scans, a.dropped, b.first, b.scans, b.dropped) == (0, 2, (), 3, 6, (1, 2))
    assert [list(Bank(part).ids) for part in parts] == [
        ["small/5/0", "small/5/1"],
        list(Bank(tmp_path / "good").ids)[2:],
    ]
    assert names_and_points(*parts) == names_and_points(tmp_path / "good")
    assert all(verify(part, progress=False) == [] for part in parts)


def test_repair_keeps_the_curation(good: Path, original: Path, model: Path) -> None:
    before, index = shards(good), (good / INDEX).read_bytes()
    (good / "shard-00000.curated.h5").unlink()  # not the original: a second name for it
    flip_copy(good / "shard-00001.curated.h5")
    assert [problem.file for problem in verify(good, progress=False)][:2] == [
        "shard-00000.curated.h5",
        "shard-00001.curated.h5",
    ]
    assert set(repair(good, str(model), progress=False)) == {"shard-00000.curated.h5", "shard-00001.curated.h5"}
    assert (shards(good), (good / INDEX).read_bytes()) == (before, index)
    assert verify(original, progress=False) == []


def flip_copy(path: Path) -> None:
    """Damage a file, but not the others that share its content."""
    copy = path.with_suffix(".copy")
    shutil.copyfile(path, copy)
    copy.replace(path)
    flip(path, 8 * 5000)


def test_a_lost_index_never_brings_back_what_was_dropped(good: Path, original: Path, model: Path) -> None:
    (good / INDEX).unlink()
    with pytest.raises(FileError, match="holds no bank"):
        Bank(good)
    with pytest.raises(DataError, match=r"are not one bake's; expected a copy of the index"):
        repair(good, str(model), progress=False)
    shutil.copyfile(original / INDEX, good / INDEX)
    with pytest.raises(FileError, match="shard-00000.h5 is missing"):
        Bank(good)


def test_a_curated_bank_is_not_baked_into(good: Path, model: Path) -> None:
    with pytest.raises(ConfigError, match="holds a bank that no bake made"):
        bake(make_plan(good, BakeJob(model=str(model), count=8, shard_size=3)), progress=False)


@pytest.mark.parametrize("dropped", [(0, 0), (2, 1), (0, 1, 2), (3,), (-1,)])
def test_an_index_that_leaves_out_what_is_not_there(dropped: tuple[int, ...]) -> None:
    with pytest.raises(DataError, match="ascending positions that leave a scan"):
        Index((some_facts(),), (Entry("a.h5", 0, 0, 3, dropped=dropped),), curation=("by hand",))
    with pytest.raises(DataError, match="and what dropped them"):
        Index((some_facts(),), (Entry("a.h5", 0, 0, 3, dropped=(1,)),))


# The command


@pytest.fixture
def bank(tmp_path: Path) -> Path:
    write_bank(tmp_path / "bank", images_with("duplicate"), shard_size=8, fields=ALL)
    return tmp_path / "bank"


def test_the_command_lists_plots_and_drops(bank: Path, tmp_path: Path) -> None:
    out, picture = tmp_path / "good", tmp_path / "scores.png"
    status, output = call("curate", bank, "--sort", "duplicate", "--limit", 1, "--plot", picture)
    assert status == 0 and "0 of 20 scans match the rules" in output
    [row] = [line for line in output.splitlines() if "small/5/13" in line]
    assert row.split()[0] == "13" and row.split()[-1] == "4"
    assert picture.read_bytes()[:4] == b"\x89PNG"
    made = (bank / FILE).stat().st_mtime_ns
    rules = ("--drop", "duplicate > 0.99", "--drop", "confidence < 0.5 and empty > 0.9")
    status, output = call("curate", bank, *rules, "--limit", 20)
    assert "1 of 20 scans match the rules" in output and output.count("dropped") == 1
    status, output = call("curate", bank, *rules, "--out", out)
    assert status == 0 and f"{out}: 19 scans in 3 shards; 1 of 20 scans left out by 'duplicate > 0.99' or " in output
    assert (bank / FILE).stat().st_mtime_ns == made  # scored once
    assert names_and_points(out) == names_and_points(bank)[:13] + names_and_points(bank)[14:]
    assert "left out by 'duplicate > 0.99'" in json.loads(call("info", out, "--json")[1])["curation"]
    call("curate", out)
    assert len(read_scores(out / FILE).twin) == 19


def test_the_plot_counts_every_scan_and_marks_some() -> None:
    rng = np.random.default_rng(0)
    values, marked = {name: rng.random(50) for name in MEANINGS}, rng.random(50) < 0.2
    figure = histograms(values, MEANINGS, marked, "title")
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(MEANINGS)
    for axes in figure.axes:
        plain, orange = (sum(patch.get_height() for patch in bars) for bars in axes.containers)
        assert (plain, orange) == ((~marked).sum(), marked.sum())


def test_the_command_as_json_and_with_a_reference(bank: Path, tmp_path: Path) -> None:
    found = json.loads(call("curate", bank, "--json", "--sort", "-empty", "--limit", 3, "--drop", "empty >= 0")[1])
    assert (found["scans"], found["dropped"], len(found["listed"])) == (20, 20, 3)
    assert {"number", "id", "twin", "dropped", *MEANINGS} == set(found["listed"][0])
    before = read_scores(bank / FILE).values["range"]
    write_all("npz", tmp_path / "real", [unproject(images_with("range")[13])])
    call("curate", bank, "--reference", tmp_path / "real", "--json")
    scores = read_scores(bank / FILE)
    assert scores.reference == f"1 scans of {tmp_path / 'real'}" and not np.allclose(scores.values["range"], before)


def test_scores_of_another_bank_are_of_no_use(bank: Path) -> None:
    call("curate", bank, "--json")
    write_bank(bank, [some_image(i) for i in range(3)], fields=ALL)
    call("curate", bank, "--json")
    assert len(read_scores(bank / FILE).twin) == 3 and read_scores(bank / FILE).bank == Bank(bank).identity


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "x"], "--out x without a rule; expected --drop, too"),
        (["--plot", "x.jpg"], "--plot x.jpg; expected a file that ends in .png"),
        (["--split", "train"], "--split train of nothing; expected --reference, too"),
        (["--sort", "beauty"], "score 'beauty'; expected one of 'range', 'labels'"),
        (["--drop", "beauty > 1", "--out", "x"], "score 'beauty' in rule"),
        (["--drop", "empty >= 0", "--out", "x"], "all 20 scans of .* left out"),
    ],
)
def test_wrong_calls_write_nothing(
    bank: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], message: str
) -> None:
    monkeypatch.chdir(bank)
    with pytest.raises(ConfigError, match=message):
        call("curate", bank, *options)
    assert not (bank / "x").exists()
