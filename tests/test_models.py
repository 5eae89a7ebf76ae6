"""Models of several stages: the published plans, a tiny model end to end, kill and resumption,
errors."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from latent_runs import call, one_thread, scans, write_config  # noqa: F401 - fixtures

from lidar_synth import load_generator
from lidar_synth.errors import ConfigError, FileError
from lidar_synth.files.hub import shipped_models
from lidar_synth.generate.checkpoint import load_checkpoint, read_header
from lidar_synth.lab.train import (
    DistillConfig,
    TrainConfig,
    models,
    plan_model,
    train_model,
)
from lidar_synth.lab.train.config import (
    find_model_file,
    find_recipe,
    load_config,
    load_model,
    published,
    published_models,
)
from lidar_synth.lab.train.model_plan import LEAST
from lidar_synth.lab.train.schedules import PLATEAU
from lidar_synth.lab.train.staged import DONE, StagedRuns

MODELS = {one.name: one for one in published_models()}
RECIPES = {one.name: one for one in published()}
HDIT = {
    "architecture": "hdit",
    "arguments": {"width": 16, "depths": [1], "heads": [2], "patch": [1, 1]},
}
SURFACES = {
    "architecture": "surfaces",
    "arguments": {
        "encoder_widths": [8, 8],
        "widths": [8, 8],
        "reaches": [1],
        "depth": 1,
    },
}
CODEC = "codec: {recipe: codec.yaml, minutes: 1}\n"


def test_a_folder_with_the_name_of_a_recipe_does_not_hide_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("town_teacher").mkdir()  # such as its run
    assert find_recipe("town_teacher").is_file()


@pytest.mark.parametrize("name", MODELS)
def test_a_published_model_plans_the_recipes_of_its_file(name: str) -> None:
    settings = load_model(find_model_file(name) or Path())
    plan = plan_model(name)
    assert list(plan.stages) == list(settings.stages), (
        "every stage is needed for the last one"
    )
    assert plan.out == Path("runs", name, f"{name}.safetensors")
    made: set[Path] = set()
    for stage, planned in plan.stages.items():
        assert find_recipe(planned.recipe).is_file()
        alone = load_config(type(planned.config), planned.recipe)
        changed = {"output", "recipe", *settings.stages[stage].needs}
        assert planned.config.model_dump(exclude=changed) == alone.model_dump(
            exclude=changed
        )
        assert all(
            start in made or key in planned.of_others
            for key, start in planned.starts.items()
        )
        made.add(plan.runs.checkpoint(stage))
    assert sum(plan.runs.budgets(plan.minutes).values()) == pytest.approx(plan.minutes)
    assert call("train", name, "--dry-run").startswith(f"{name} -> ")


@pytest.mark.parametrize("name", MODELS)
def test_the_listed_size_is_that_of_its_parts(name: str) -> None:
    """Models from another one's teacher have that one's autoencoder."""
    plan = plan_model(name)
    [(model, _, _)] = [
        s.partition("/") for s in plan.stages["teacher"].of_others.values()
    ] or [(name, "", "")]
    recipes = (plan_model(model).stages["codec"].recipe, plan.stages["student"].recipe)
    assert (
        MODELS[name].size
        == f"{sum(float(RECIPES[r].size.split()[0]) for r in recipes):.1f} M"
    )


@pytest.mark.parametrize("name", shipped_models())
def test_a_shipped_model_has_stages_and_says_how_it_was_made(name: str) -> None:
    assert name in MODELS
    assert {"recipe", "data", "licence"} <= set(
        read_header(shipped_models()[name])[0].provenance
    )


def test_models_are_listed_and_printed_as_recipes_are() -> None:
    listed = call("recipes")
    assert all(f"{name} " in listed for name in [*MODELS, *RECIPES])
    assert (
        yaml.safe_load(call("recipes", "town"))["stages"]["codec"]["recipe"]
        == "town_codec"
    )


@pytest.fixture(scope="module")
def tiny(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811 - a fixture
    """The file of a tiny model of five stages, beside their recipes."""
    folder = tmp_path_factory.mktemp("tiny")
    recipe = {"iterations": 5, "warmup": 1, "schedule": "trapezoid"}
    start = {
        "teacher": "none.safetensors",
        "weaker": "none.safetensors",
        "codec": "none.safetensors",
    }
    recipes: dict[str, dict[str, Any]] = {
        "codec": {"network": SURFACES},
        "teacher": {"network": HDIT, "codec": start["codec"]},
        "weaker": {"network": HDIT, "codec": start["codec"]},
        "student": {
            "teacher": start["teacher"],
            "guidance": 2.0,
            "strategy": "uniform_piecewise",
            "steps": 2,
        },
        "decoder": {"decoder": True, "init": "none.safetensors"},
    }
    for name, values in recipes.items():
        path = write_config(scans, folder, name, **values, recipe=recipe)
        if name == "decoder":  # its checkpoint says what these are
            kept = yaml.safe_load(path.read_text())
            path.write_text(
                yaml.safe_dump(
                    {k: v for k, v in kept.items() if k not in ("sensor", "channels")}
                )
            )
    needs = {
        "teacher": {"codec": "codec"},
        "weaker": {"codec": "codec"},
        "student": {"teacher": "teacher", "weaker": "weaker"},
        "decoder": {"init": "student"},
    }
    stages = {
        name: {"recipe": f"{name}.yaml", "minutes": 1, "needs": needs.get(name, {})}
        for name in recipes
    }
    (folder / "tiny.yaml").write_text(
        yaml.safe_dump({"stages": stages}, sort_keys=False)
    )
    return folder / "tiny.yaml"


@pytest.fixture(scope="module")
def made(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the tiny model, trained by the command, five iterations a stage."""
    folder = tmp_path_factory.mktemp("made") / "tiny"
    printed = call("train", tiny, f"output={folder}", "recipe.iterations=5")
    assert printed.strip().endswith(str(folder / "tiny.safetensors"))
    return folder


def test_a_model_is_made_by_all_its_stages_each_with_its_state(made: Path) -> None:
    generator = load_generator(made / "tiny.safetensors")
    assert len(generator.scans(0, [0])[0]) and generator.header.time_grid == (
        1.0,
        0.75,
        0.5,
        0.25,
        0.0,
    )
    names = ("codec", "teacher", "weaker", "student", "decoder")
    assert all(
        (made / name / "state.safetensors").is_file() and (made / name / DONE).is_file()
        for name in names
    )
    facts = generator.header.provenance
    assert facts["model"] == "tiny" and list(facts["stages"]) == sorted(names)
    assert {
        Path(stage["recipe"]).stem: stage["iterations"]
        for stage in facts["stages"].values()
    } == dict.fromkeys(names, 5)
    hashes = {
        name: load_checkpoint(made / name / f"{name}.safetensors") for name in names
    }
    assert facts["init"] == hashes["student"].hash
    assert hashes["student"].header.provenance["weaker"] == hashes["weaker"].hash
    assert hashes["teacher"].header.provenance["codec"] == hashes["codec"].hash


def test_large_weights_are_stored_in_half_precision(
    made: Path, monkeypatch: pytest.MonkeyPatch, tiny: Path
) -> None:
    path = made / "tiny.safetensors"
    full = load_checkpoint(path)
    size = path.stat().st_size
    monkeypatch.setattr(models, "LARGE", 1.0)
    plan = plan_model(tiny, [f"output={made}", "recipe.iterations=5"])
    train_model(plan)
    half = load_checkpoint(path)
    for name, network in full.networks.items():
        for a, b in zip(
            network.parameters(), half.networks[name].parameters(), strict=True
        ):
            assert torch.equal(a.half().float(), b)
    assert path.stat().st_size < size
    monkeypatch.undo()
    train_model(plan)
    assert load_checkpoint(path).hash == full.hash


@pytest.mark.slow
def test_a_killed_model_is_resumed_by_the_same_command(
    tiny: Path, made: Path, tmp_path: Path
) -> None:
    """Killed after its first stage, it keeps that one and goes on as a model that was never
    stopped."""
    words = [
        "train",
        str(tiny),
        f"output={tmp_path / 'tiny'}",
        "recipe.iterations=5",
        "--until",
        "teacher",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "lidar_synth", *words],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    while not (tmp_path / "tiny" / "codec" / DONE).exists():
        assert process.poll() is None, "it ended by itself"
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    codec, teacher = (
        tmp_path / "tiny" / name / f"{name}.safetensors"
        for name in ("codec", "teacher")
    )
    assert not (teacher.parent / DONE).exists(), "it was killed too late"
    before = codec.stat().st_mtime_ns
    assert call(*words).strip().endswith(str(teacher))
    assert codec.stat().st_mtime_ns == before
    assert (
        load_checkpoint(teacher).hash
        == load_checkpoint(made / "teacher" / "teacher.safetensors").hash
    )


def test_a_stage_with_a_limit_of_time_lets_its_rate_fall(
    tiny: Path, tmp_path: Path
) -> None:
    """The iterations follow from the steps at the constant rate; a stage that was stopped as it
    fell keeps them."""
    words = (
        "train",
        tiny,
        f"output={tmp_path / 'tiny'}",
        "--minutes",
        5 * LEAST,
        "--until",
        "codec",
    )
    words = tuple(map(str, words))
    call(*words)
    folder = tmp_path / "tiny" / "codec"
    ended = yaml.safe_load((folder / "config.yaml").read_text())["recipe"]["iterations"]
    header, first = read_header(folder / "codec.safetensors")
    assert (
        header.provenance["iterations"] == ended > 1
        and header.provenance["recipe"]["recipe"]["warmup"] == 1
    )
    steps = int(PLATEAU * ended)
    assert ended in {-(-steps // PLATEAU), -(-(steps + 1) // PLATEAU)}
    (folder / DONE).unlink()  # killed before it was noted
    call(*words)
    assert read_header(folder / "codec.safetensors")[1] == first
    call(*words, "--minutes", "1000")  # a done stage stays as it is
    assert read_header(folder / "codec.safetensors")[1] == first


def test_open_stages_share_what_done_ones_have_left(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "codec", tmp_path / "codec")
    runs = StagedRuns(tmp_path, {"codec": 2.0, "teacher": 3.0, "student": 1.0})
    spent = runs.spent("codec")
    assert spent > 0 and runs.spent("teacher") == 0
    assert runs.budgets(10.0) == pytest.approx(
        {"teacher": (10 - spent) * 0.75, "student": (10 - spent) * 0.25}
    )


def test_a_given_checkpoint_replaces_the_stages_that_made_it(tiny: Path) -> None:
    plan = plan_model(tiny, ["teacher.init=mine.safetensors", "teacher.codec=null"])
    assert list(plan.stages) == ["codec", "teacher", "weaker", "student", "decoder"], (
        "the weaker teacher needs it"
    )
    plan = plan_model(
        tiny,
        ["student.weaker=null", "teacher.init=mine.safetensors", "teacher.codec=null"],
    )
    assert list(plan.stages) == ["teacher", "student", "decoder"]
    assert list(plan_model(tiny, until="teacher").stages) == ["codec", "teacher"]
    with pytest.raises(
        ConfigError,
        match=r"^teacher.init=mine.safetensors, which does not exist; expected a checkp",
    ):
        train_model(plan)


def test_overrides_reach_one_stage_or_all() -> None:
    plan = plan_model(
        "town",
        [
            "seed=7",
            "teacher.recipe.batch=16",
            "teacher.seed=8",
            "student.recipe.iterations=9",
        ],
    )
    assert {name: stage.config.seed for name, stage in plan.stages.items()} == {
        "codec": 7,
        "teacher": 8,
        "student": 7,
        "decoder": 7,
    }
    batches = {name: stage.config.recipe.batch for name, stage in plan.stages.items()}
    assert (
        batches["teacher"] == 16
        and batches["codec"] == load_config(TrainConfig, "town_codec").recipe.batch
    )
    assert list(plan.runs.shares) == ["codec", "teacher", "decoder"]
    assert isinstance(plan.stages["student"].config, DistillConfig)


ERRORS: dict[str, tuple[list[str], str]] = {
    "a model": (
        ["town-sparse", "--dry-run"],
        r"--dry-run for the recipe town-sparse; expected a model of several",
    ),
    "a recipe": (
        ["town_codec", "--until", "codec"],
        r"--until codec for the recipe town_codec; expected a model",
    ),
    "a stage": (
        ["town", "--until", "weaker"],
        r"--until 'weaker'; expected a stage of town: codec, teacher, student, decoder",
    ),
    "a stage of an override": (
        ["town", "techer.recipe.batch=4"],
        r"override 'techer.recipe.batch=4'; expected STAGE.KEY=VALUE for a stage of town "
        r"\(codec, teacher, student, decoder\), output=FOLDER, or a key of all its recipes "
        r"\(licence, data, .*Such as codec.recipe.batch",
    ),
    "a key": (
        ["town", "teacher.recipe.batches=4"],
        r"unknown key 'recipe.batches'; known there: iterations",
    ),
    "no value": (["town", "teacher.recipe"], r"override 'recipe'; expected key=value"),
    "the folder of a stage": (
        ["town", "codec.output=here"],
        r"override 'codec.output=here'; expected STAGE.KEY",
    ),
    "a sensor that the flow cannot have": (
        ["town", "codec.sensor=vlp16"],
        r"sensor 'vlp16' of 16 x 1808 cells, whose latents have 4 x 113: resolution \(4, ",
    ),
    "minutes that are no number": (
        ["town", "--minutes", "nan"],
        "--minutes nan for the stages .* expected at least",
    ),
    "minutes without end": (
        ["town", "--minutes", "inf"],
        "--minutes inf for the stages .* expected at least",
    ),
    "too few minutes": (
        ["town", "--minutes", "0.01"],
        r"--minutes 0.01 for the stages codec, teacher, student, decoder of town; expected at "
        r"least 0.12. lidar-synth train town --dry-run prints",
    ),
    "a schedule": (
        ["town", "codec.recipe.schedule=cosine"],
        r"codec.recipe.schedule=cosine with a limit of time; expected trapezoid. Or give "
        r"codec.recipe.iterations=N",
    ),
    "a start": (
        ["town-layout", "output=elsewhere/town-layout"],
        r"teacher.init=elsewhere/town/teacher/teacher.safetensors, which does not exist; expected "
        r"the checkpoint of the stage teacher of town. Type `lidar-synth train town --until "
        r"teacher output=elsewhere/town` first, or give teacher.init=FILE.safetensors",
    ),
    "a start in runs": (
        ["town-camera"],
        r"Type `lidar-synth train town --until teacher` first, or give teacher",
    ),
}


@pytest.mark.parametrize(("words", "message"), ERRORS.values(), ids=list(ERRORS))
def test_wrong_calls_are_refused_before_anything_is_written(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        call("train", *words)
    assert list(tmp_path.iterdir()) == []


FILES: dict[str, tuple[str, str]] = {
    "no stages": ("stages: {}", r"stages = {}: Dictionary should have at least 1 item"),
    "an unknown key": (
        f"stages:\n  {CODEC}steps: 4",
        r"unknown key 'steps'; known there: stages",
    ),
    "no recipe": ("stages: {codec: {minutes: 3}}", r"'stages.codec.recipe' is missing"),
    "no time": (
        "stages: {codec: {recipe: codec.yaml, minutes: 0}}",
        r"stages.codec.minutes = 0",
    ),
    "a later stage": (
        f"stages:\n  teacher: {{recipe: a, minutes: 1, needs: {{codec: codec}}}}\n  {CODEC}",
        r"teacher.needs with the stage 'codec'; expected an earlier one \(none\)",
    ),
    "another key": (
        f"stages:\n  {CODEC}  teacher: {{recipe: a, minutes: 1, needs: {{data: codec}}}}",
        r"teacher.needs with 'data'; expected keys among teacher, weaker, init, codec",
    ),
    "the name of a key": (
        "stages: {data: {recipe: a, minutes: 1}}",
        r"stage 'data'; expected a name .* no key",
    ),
    "an unknown recipe": (
        "stages: {codec: {recipe: town_codecs, minutes: 1}}",
        r"recipe or model 'town_codecs'; expected",
    ),
}


@pytest.mark.parametrize(("text", "message"), FILES.values(), ids=list(FILES))
def test_wrong_files_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        plan_model(tmp_path / "mine.yaml")


def test_a_missing_file_and_a_recipe_are_no_models(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="nowhere.yaml"):
        call("train", tmp_path / "nowhere.yaml")
    with pytest.raises(
        ConfigError,
        match=r"model 'town_codec'; expected a YAML file .* one of town, town-camera, town-l",
    ):
        plan_model("town_codec")


def _of_the_codec(folder: Path) -> None:
    shutil.copy(
        folder / "student" / "student.safetensors",
        folder / "codec" / "codec.safetensors",
    )


CHANGES: dict[str, tuple[list[str], Callable[[Path], object], str]] = {
    "settings": (
        ["teacher.recipe.rate=2e-3"],
        lambda folder: None,
        r"teacher with recipe.rate=0.002",
    ),
    "the start": (
        [],
        _of_the_codec,
        r"teacher, which was made from another codec than .*codec.safetensors is now; "
        r"expected the same one. Remove .*teacher to run the stage again",
    ),
    "more iterations": (
        ["codec.recipe.iterations=6"],
        lambda folder: None,
        r"teacher, which was made from another",
    ),
}


@pytest.mark.parametrize(
    ("overrides", "change", "message"), CHANGES.values(), ids=list(CHANGES)
)
def test_done_stages_of_another_making_are_refused(
    overrides: list[str],
    change: Callable[[Path], object],
    message: str,
    tiny: Path,
    made: Path,
    tmp_path: Path,
) -> None:
    shutil.copytree(made, tmp_path / "tiny")
    change(tmp_path / "tiny")
    values = [f"output={tmp_path / 'tiny'}", "recipe.iterations=5", *overrides]
    # The recipes name the folder in which the model was made.
    for path in (tmp_path / "tiny").glob("*/config.yaml"):
        path.write_text(path.read_text().replace(str(made), str(tmp_path / "tiny")))
    with pytest.raises(ConfigError, match=message):
        train_model(plan_model(tiny, values))


def test_a_time_without_its_warm_up_is_refused(tiny: Path, tmp_path: Path) -> None:
    overrides = [f"output={tmp_path / 'tiny'}", "codec.recipe.warmup=1000000"]
    with pytest.raises(
        ConfigError,
        match=r"steps before the learning rate falls; expected enough for its 1000000 ste",
    ):
        train_model(plan_model(tiny, overrides, minutes=5 * LEAST))
