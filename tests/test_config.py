"""Configuration: every published file loads, overrides apply, what cannot be is refused."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.recipes import read_recipe
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.evaluate.leakage import town
from lidar_synth.lab.town import Town
from lidar_synth.lab.train.config import (
    DistillConfig,
    Run,
    TrainConfig,
    load_config,
    published,
)
from lidar_synth.lab.train.provenance import recordings_known

CONFIGS = Path(__file__).parents[1] / "configs"
RECIPES = {one.name: one for one in published()}
TINY = CONFIGS / "town_tiny.yaml"
KINDS = {"train": TrainConfig, "distill": DistillConfig}


def test_every_file_is_a_recipe_a_base_or_a_sensor() -> None:
    assert {p.stem for p in CONFIGS.glob("*.yaml")} == set(RECIPES) | {"tiny_sensor"}
    named = {
        base
        for p in CONFIGS.rglob("*.yaml")
        for base in np.atleast_1d(yaml.safe_load(p.read_text()).get("base", []))
    }
    assert named == {p.stem for p in (CONFIGS / "base").iterdir()}
    assert not named & set(RECIPES)  # `base: NAME` in a user's file is the recipe


@pytest.mark.parametrize(
    "name", [n for n, one in RECIPES.items() if one.command in KINDS]
)
def test_every_recipe_loads_by_name_from_any_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kind: type[Run] = KINDS[RECIPES[name].command]
    config = load_config(kind, name)
    assert config == load_config(kind, CONFIGS / f"{name}.yaml")
    assert config.output == Path("runs") / name
    again = kind.model_validate(
        yaml.safe_load(yaml.safe_dump(config.model_dump(mode="json")))
    )
    assert again == config  # what a run writes beside its results is the configuration


@pytest.mark.parametrize(
    "name", [n for n, one in RECIPES.items() if one.command == "train"]
)
def test_the_listed_size_is_that_of_the_networks(name: str) -> None:
    """Where a recipe starts from a checkpoint that is not there yet, its size cannot be
    computed."""
    config = load_config(TrainConfig, name)
    if config.init is not None:
        pytest.skip("starts from a checkpoint")
    codec = (
        config if config.codec is None else load_config(TrainConfig, config.codec.stem)
    )
    resolution = load_sensor(codec.sensor).shape
    state = (codec.tensors().size, *resolution)
    with torch.device("meta"):
        if config.codec is not None:
            autoencoder = build_network(*codec.parts(state, resolution)["codec"])
            state = make_codec(autoencoder, codec.tensors(), resolution).shape
        networks = [
            build_network(*part) for part in config.parts(state, resolution).values()
        ]
    size = sum(
        weight.numel() for network in networks for weight in network.parameters()
    )
    assert RECIPES[name].size == f"{size / 1e6:.1f} M"


def test_bases_merge_and_the_recipe_takes_precedence(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "a.yaml").write_text(
        "recipe: {batch: 1, rate: 2.0}\nprecision: bf16"
    )
    (tmp_path / "b.yaml").write_text("base: a\nrecipe: {rate: 3.0}\ndata: {town: 5}")
    path = tmp_path / "c.yaml"
    path.write_text(
        "base: [b.yaml, town]\nabout: {size: none}\ndata: {town: 7}\nsensor: mine.yaml"
    )
    (tmp_path / "mine.yaml").write_text("{}")
    values = read_recipe(path)
    assert values["recipe"]["batch"] == 1
    assert values["recipe"]["schedule"] == "trapezoid"  # of the published base "town"
    assert values["data"] == {"town": 7, "licence": "MIT (procedural, no one's data)"}
    assert values["sensor"] == str(tmp_path / "mine.yaml")
    assert "about" not in values and "base" not in values


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: nowhere", "base 'nowhere'; expected a file beside it"),
        ("base: [3]", "base 3; expected a file beside it"),
        ("base: null", "base: None; expected the name of a recipe"),
        ("base: 3", "base: 3; expected the name of a recipe"),
        ("base: loop", "is its own base"),
        ("base: c.yaml", "base 'c.yaml'; expected a file beside it"),
    ],
)
def test_bases_that_cannot_be_are_refused(
    text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "loop.yaml").write_text("base: c.yaml")
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(TrainConfig, tmp_path / "c.yaml")


@pytest.mark.parametrize("name", ["town_techer", "base/town", "../configs/town_tiny"])
def test_an_unknown_name_is_refused_with_the_known_ones(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ConfigError, match=r"recipe .*expected a YAML file or one of .*town_teacher"
    ):
        load_config(TrainConfig, name)


def test_an_autoencoder_of_surfaces_needs_labels() -> None:
    given = ["channels=[range,reflectance]", "data.town=1"]
    with pytest.raises(ConfigError, match="expected channels range, reflectance, "):
        load_config(TrainConfig, "town_codec", given)


def test_the_published_recipes() -> None:
    teacher = load_config(TrainConfig, CONFIGS / "kitti360_teacher.yaml")
    assert teacher.parts((2, 64, 1024), (64, 1024))["velocity"].arguments[
        "resolution"
    ] == [
        64,
        1024,
    ]
    assert (teacher.recipe.iterations, teacher.recipe.batch, teacher.recipe.warmup) == (
        320_000,
        8,
        10_000,
    )
    student = load_config(DistillConfig, CONFIGS / "kitti360_student.yaml")
    assert (student.grid, student.steps, student.recipe.metric) == (
        (1, 0.86, 0.58, 0.22, 0),
        20,
        "pseudo_huber",
    )


def test_overrides() -> None:
    overrides = [
        "recipe.batch=4",
        "data.flip=false",
        "recipe.rate=1e-3",
        "channels=[range]",
        "samples.every=0",
    ]
    config = load_config(TrainConfig, TINY, overrides)
    assert (config.recipe.batch, config.data.flip, config.recipe.rate) == (
        4,
        False,
        1e-3,
    )
    assert config.tensors().size == 1
    assert config.samples.every == 0
    student = CONFIGS / "town_student.yaml"
    assert [
        load_config(DistillConfig, student, o).precision for o in ([], ["precision=no"])
    ] == [
        "bf16",
        "no",
    ]


def test_the_town_and_paths_become_sources(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = load_config(TrainConfig, TINY, ["data.seed=3"])
    source = config.data.open(load_sensor(config.sensor))
    assert isinstance(source, Town)
    assert (len(source), source.seed, source.sensor.shape) == (40, 3, (16, 128))
    disk = load_config(TrainConfig, CONFIGS / "kitti360_teacher.yaml")
    monkeypatch.delenv("KITTI360_ROOT", raising=False)
    with pytest.raises(
        ConfigError,
        match=r"data.path '\$KITTI360_ROOT'; expected variables that are set",
    ):
        disk.data.open(load_sensor(disk.sensor))
    more = load_config(
        TrainConfig, TINY, ["data.more=[{path: $KITTI360_ROOT, licence: none}]"]
    )
    with pytest.raises(
        ConfigError, match=r"'\$KITTI360_ROOT'.*NAME=FOLDER, or give data.more=\[\]"
    ):
        more.data.open(source.sensor)
    monkeypatch.setenv("KITTI360_ROOT", str(tmp_path / "nowhere"))
    with pytest.raises(DataError, match="nowhere"):
        disk.data.open(load_sensor(disk.sensor))


def test_a_roll_of_one_is_a_degree() -> None:
    for given, roll in (("1", 1.0), ("0", 0.0), ("true", True), ("false", False)):
        found = load_config(TrainConfig, TINY, [f"data.roll={given}"]).data.roll
        assert found == roll and type(found) is type(roll)


@pytest.mark.parametrize("also", ["[4]", "[2, 2]"])
def test_a_student_learns_each_number_of_steps_once(also: str) -> None:
    with pytest.raises(ConfigError, match=r"intervals=4 with also=.*expected each num"):
        load_config(DistillConfig, "town_student", [f"also={also}"])


def test_scans_are_read_with_the_options_of_open_scans(tmp_path: Path) -> None:
    points = np.array(2 * [[5, 0, 0, 255, 3], [0, 9, 0, 51, 4]], np.float32)
    points.tofile(tmp_path / "0.bin")
    given = ["data.town=null", f"data.path={tmp_path}"]
    grid = load_sensor("vlp16")
    plain = load_config(TrainConfig, TINY, given).data
    with pytest.raises(DataError, match="on another scale"):
        plain.open(grid)[0]
    given += ["data.fields=5", "data.reflectance_max=255", "data.sensor=os1_128"]
    data = load_config(TrainConfig, TINY, given).data
    scan = data.open(grid)[0]
    assert scan.reflectance is not None
    assert scan.reflectance.tolist() == pytest.approx(2 * [1.0, 0.2])
    assert scan.sensor == load_sensor("os1_128")
    facts = data.describe()
    own = {"fields": 5, "reflectance_max": 255.0, "sensor": scan.sensor.to_dict()}
    assert facts == plain.describe() | own  # caches without them stay


def test_several_sets_of_scans_follow_each_other() -> None:
    more = "data.more=[{town: 3, seed: 5, licence: MIT}]"
    config = load_config(TrainConfig, TINY, [more])
    sensor = load_sensor(config.sensor)
    source = config.data.open(sensor)
    assert len(source) == 43
    other = Town(5, sensor, 3, interval=config.data.interval)
    assert np.array_equal(source[41].points, other[1].points)
    known = recordings_known(config, {}, sensor)
    assert known == town(config.data.seed) | town(5)
    plain = load_config(TrainConfig, TINY)
    facts = config.data.describe()
    [added] = facts.pop("more")
    assert facts == plain.data.describe()  # their caches stay
    assert (added["town"], added["seed"]) == (3, 5)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "sead=1",
            "unknown key 'sead'; known there: output, licence, data, recipe, seed",
        ),
        (
            "recipe.batches=1",
            "unknown key 'recipe.batches'; known there: iterations, batch, accumulate",
        ),
        ("data.twon=1", "unknown key 'data.twon'; known there: licence, town"),
        ("recipe.batch=many", "recipe.batch = 'many'"),
        ("recipe.batch=0", "batch 0; expected at least 1"),
        ("recipe.clip=0", "clip 0.0; expected above 0"),
        ("recipe.rate=.nan", "rate nan; expected above 0"),
        ("recipe.ema_decay=-3", "ema_decay -3.0; expected at least 0, below 1"),
        ("recipe.ema_decay=1", "ema_decay 1.0; expected at least 0, below 1"),
        ("recipe.betas=[1.5, 2]", r"betas \(1.5, 2.0\); expected at least 0, below 1"),
        ("recipe.weight_decay=-1", "weight_decay -1.0; expected at least 0"),
        ("recipe.warmup=-5", "warmup -5; expected at least 0"),
        ("recipe.ema_after=-1", "ema_after -1; expected at least 0"),
        ("recipe.metric=l7", "one of 'squared_l2', 'pseudo_huber', 'l1'"),
        ("recipe=null", "recipe = None"),
        ("normalisation=cubic", "normalisation 'cubic'; expected one of 'r2flow'"),
        ("channels=[range, colour]", "range and some of"),
        ("sensor=hdl99", "sensor 'hdl99'"),
        (
            "network.arguments.patch=[3, 4]",
            r"resolution \(16, 128\); expected multiples of \(6, 8\)",
        ),
        ("network.arguments.depths=[1, 1, 1, 1, 1]", "expected multiples of"),
        ("network.arguments.width=[1]", "arguments"),
        ("network.arguments.depth=3", "arguments"),
        ("network.arguments.channels=3", r"network.arguments with \['channels'\]"),
        ("network.architecture=resnet", "architecture 'resnet'; expected one of"),
        ("data.path=here", "data with town=40 and path=here; expected one of the two"),
        ("data.town=null", "expected one of the two"),
        ("data.roll=-1", "data.roll"),
        ("rehearsal={licence: MIT}", "expected one of the two"),
        ("data.more=[{licence: MIT}]", "expected one of the two"),
        ("precision=fp8", "precision = 'fp8'"),
        ("batch", "override 'batch'; expected key=value"),
        ("seed.x=1", "seed is a single value"),
        ("channels=[range", "is not YAML"),
    ],
)
def test_what_cannot_be_is_refused(override: str, message: str) -> None:
    start = ["seed=0"] if override.startswith("seed.") else []
    with pytest.raises(ConfigError, match=message):
        load_config(TrainConfig, TINY, [*start, override])


@pytest.mark.parametrize("key", ["warmup", "ema_after"])
def test_a_run_that_ends_before_its_recipe_begins_is_warned_of(
    key: str, recwarn: pytest.WarningsRecorder
) -> None:
    given = ["recipe.iterations=50", f"recipe.{key}=49"]
    load_config(TrainConfig, TINY, given)
    assert not recwarn
    with pytest.warns(UserWarning, match=rf"recipe.{key}=50 with recipe.iterations=50"):
        load_config(TrainConfig, TINY, [*given, f"recipe.{key}=50"])


@pytest.mark.parametrize(
    "grid",
    [
        "[1, .nan, 0.5, 0.2, 0]",
        "[1, 0.5, 0]",
        "[1, 0.5, 0.6, 0.2, 0]",
        "[0.9, 0.6, 0.5, 0.2, 0]",
    ],
)
def test_a_grid_that_is_none_is_refused(grid: str) -> None:
    with pytest.raises(ConfigError, match="descending times from 1 to 0"):
        load_config(DistillConfig, CONFIGS / "kitti360_student.yaml", [f"grid={grid}"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["strategy=uniform_piecewise"], "which is uniform.*in a recipe grid=null"),
        (["strategy=timestep_distillation"], "which is uniform.*in a recipe grid=null"),
        (["strategy=reflow"], "which is uniform.*in a recipe grid=null"),
        (["strategy=piecewise_reflow"], "which is uniform.*in a recipe grid=null"),
        (["intervals=8"], r"9 descending times from 1 to 0.*grid=null"),
        (["grid=null", "also=[101]"], "101 steps of selection.candidates=100 times"),
        (["grid=null", "intervals=101"], "Give selection.candidates=101 or more"),
    ],
)
def test_a_student_that_could_not_be_trained_is_refused_at_once(
    changes: list[str], message: str
) -> None:
    recipe = CONFIGS / "kitti360_student.yaml"
    with pytest.raises(ConfigError, match=message):
        load_config(DistillConfig, recipe, changes)
    others = ["strategy=reflow", "grid=null", "selection.candidates=3"]
    load_config(DistillConfig, recipe, others)


def test_files_that_are_no_configuration_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    with pytest.raises(FileError, match="cannot be read"):
        load_config(TrainConfig, path)
    path.write_text("a: [")
    with pytest.raises(ConfigError, match="is not YAML"):
        load_config(TrainConfig, path)
    path.write_text("- a")
    with pytest.raises(ConfigError, match="holds list; expected keys and values"):
        load_config(TrainConfig, path)
    values: dict[str, Any] = yaml.safe_load(TINY.read_text())
    del values["licence"]
    path.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match="'licence' is missing"):
        load_config(TrainConfig, path)


def test_the_papers_latent_recipes() -> None:
    """Timesteps, 10 Euler steps of the teacher, squared l2; LiDM's sizes."""
    grids = {
        "kitti360_latent": (1, 0.82, 0.57, 0.28, 0),
        "kitti360_camera": (1, 0.74, 0.48, 0.22, 0),
        "semantic_kitti": (1, 0.42, 0.20, 0.08, 0),
    }
    for name, grid in grids.items():
        student = load_config(DistillConfig, CONFIGS / f"{name}_student.yaml")
        assert (student.grid, student.steps, student.recipe.metric) == (
            grid,
            10,
            "squared_l2",
        )
        teacher = load_config(TrainConfig, CONFIGS / f"{name}_teacher.yaml")
        parts = teacher.parts((8, 16, 128), (64, 1024))
        assert parts["velocity"].arguments["position"] is True
        assert teacher.codec is not None
        assert load_config(
            TrainConfig, CONFIGS / f"{teacher.codec.stem}.yaml"
        ).autoencodes
        assert set(parts) == {"velocity"} | (
            {"condition"} if teacher.condition else set()
        )
        assert student.teacher.stem == f"{name}_teacher"


@pytest.mark.parametrize("name", ["kitti360_codec", "semantic_kitti_codec"])
def test_the_codec_recipes_have_the_numbers_of_lidms_public_configuration(
    name: str,
) -> None:
    """autoencoder_c2_p4.yaml: beta 0.25 of the quantiser on the codes, disc_weight 0.6,
    base_learning_rate 4.5e-6."""
    config = load_config(TrainConfig, CONFIGS / f"{name}.yaml")
    losses = config.losses
    recipe = config.recipe
    assert (
        losses.commitment,
        losses.codebook,
        losses.adversarial,
        losses.adaptive,
    ) == (
        1.0,
        0.25,
        0.6,
        True,
    )
    assert recipe.rate == pytest.approx(4.5e-6 * recipe.batch)
    assert (recipe.batch, recipe.accumulate, recipe.betas, recipe.weight_decay) == (
        8,
        2,
        (0.5, 0.9),
        0.0,
    )


@pytest.mark.parametrize("depth", [2**32, 2**64])
def test_a_network_without_end_is_refused_soon(depth: int) -> None:
    start = time.process_time()
    with pytest.raises(ConfigError, match="a network of more than"):
        load_config(TrainConfig, "town_tiny", [f"network.arguments.depths=[1,{depth}]"])
    assert time.process_time() - start < 5
