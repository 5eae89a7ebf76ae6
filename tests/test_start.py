"""How a training run starts: from a shipped model, and beside other runs of the process."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState

from lidar_synth.datasets.recordings import seen_by
from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import (
    load_checkpoint,
    network_hash,
    save_checkpoint,
)
from lidar_synth.generate.loading import find_model
from lidar_synth.geometry.sensor import sensor_yaml
from lidar_synth.lab.cli.train import distill
from lidar_synth.lab.evaluate.leakage import overlap, town
from lidar_synth.lab.train import (
    DistillConfig,
    TrainConfig,
    load_config,
    precision,
    run,
)
from lidar_synth.lab.train.runs import open_stage
from lidar_synth.lab.train.stage import Stage
from lidar_synth.lab.train.start import open_networks


def test_a_shipped_model_is_a_start_by_its_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    networks, header = open_networks(
        load_config(TrainConfig, "town_teacher", ["init=town", "codec=null"])
    )
    shipped = load_checkpoint(find_model("town"))
    assert header.provenance["init"] == shipped.hash and set(networks) == set(
        shipped.networks
    )
    with pytest.raises(ConfigError, match="expected a shipped one"):
        open_networks(
            load_config(TrainConfig, "town_teacher", ["init=towns", "codec=null"])
        )


def test_a_flow_is_trained_further_on_another_autoencoder_of_the_same_latents(
    tmp_path: Path,
) -> None:
    town = load_checkpoint(find_model("town"))
    networks = {"codec": town.networks["codec"]}
    with torch.no_grad():
        next(networks["codec"].parameters()).add_(1)
    path = tmp_path / "further.safetensors"
    kept = {"codec": town.header.networks["codec"]}
    made = save_checkpoint(path, replace(town.header, networks=kept), networks)
    given = ["init=town", f"codec={path}"]
    opened, header = open_networks(load_config(TrainConfig, "town_teacher", given))
    weights = opened["codec"].state_dict()
    assert all(
        torch.equal(value, weights[name])
        for name, value in networks["codec"].state_dict().items()
    )
    assert header.provenance["codec"] == made
    other = replace(town.header.sensor, name="mine")
    save_checkpoint(path, replace(town.header, networks=kept, sensor=other), networks)
    with pytest.raises(ConfigError, match="of another sensor than init"):
        open_networks(load_config(TrainConfig, "town_teacher", given))


TEACHER = Path(__file__).parent.parent / "tools" / "stages" / "town_teacher.safetensors"


def student(folder: Path, teacher: Path, *given: str) -> Stage:
    """The distillation of a town's student before its first step."""
    needed = [f"teacher={teacher}", f"output={folder / 'run'}"]
    return open_stage(load_config(DistillConfig, "town_student", [*given, *needed]))


def test_the_examples_of_distill_can_be_run(tmp_path: Path) -> None:
    lines = [line.split() for line in (distill.__doc__ or "").splitlines()]
    calls = [line[3:] for line in lines if line[1:3] == ["distill", "town_student"]]
    assert len(calls) == 3
    for given in calls:
        assert len(student(tmp_path, TEACHER, *given).header.time_grid) == 5


def test_weights_that_the_teacher_lacks_follow_the_seed(tmp_path: Path) -> None:
    zero, again, one = (
        network_hash(student(tmp_path, TEACHER, f"seed={seed}").network)
        for seed in (0, 0, 1)
    )
    assert zero == again != one


def test_a_student_goes_on_with_the_latents_of_its_teacher_alone(
    tmp_path: Path,
) -> None:
    student(tmp_path, TEACHER, "init=town")  # its weights were rounded when stored
    teacher = load_checkpoint(TEACHER)
    codec = teacher.networks["codec"]
    path = tmp_path / "teacher.safetensors"
    for weight, fits in (("head.weight", True), ("to_latent.bias", False)):
        with torch.no_grad():
            codec.get_parameter(weight).add_(0.1)
        save_checkpoint(path, teacher.header, teacher.networks)
        if fits:
            student(tmp_path, path, "init=town")
            continue
        with pytest.raises(ConfigError, match="init town with another autoencoder"):
            student(tmp_path, path, "init=town")


def test_a_student_that_is_trained_further_keeps_its_own_networks(
    tmp_path: Path,
) -> None:
    town = load_checkpoint(find_model("town"))
    held = town.header.networks["velocity"]
    other = held._replace(arguments=held.arguments | {"window": [3, 5]})
    header = replace(town.header, networks=town.header.networks | {"velocity": other})
    path = tmp_path / "start.safetensors"
    save_checkpoint(path, header, town.networks)
    stage = student(tmp_path, TEACHER, f"init={path}")
    assert stage.header.networks == header.networks
    assert stage.network.window == (3, 5)
    save_checkpoint(path, replace(header, other_grids=(), matches={}), town.networks)
    given = [f"init={path}", "also=[]"]
    student(tmp_path, TEACHER, *given, f"grid={list(header.time_grid)}")
    with pytest.raises(
        ConfigError, match=r"grid \(1.0, 0.9.* with init .*its own, \(1"
    ):
        student(tmp_path, TEACHER, *given, "grid=[1, 0.9, 0.8, 0.1, 0]")


def test_times_of_autoguidance_need_a_weaker_teacher(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"within \(0.1, 0.9\) without weaker; expected weaker="
    ):
        student(tmp_path, TEACHER, "within=[0.1, 0.9]")


def test_ranges_that_are_not_learnt_are_told_and_not_those_of_the_model(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    tiny = open_networks(load_config(TrainConfig, "town_tiny"))[1].sensor
    assert not recwarn
    path = tmp_path / "mine.yaml"
    path.write_text(sensor_yaml(replace(tiny, range_min=0.5, range_max=200.0)))
    given = [f"sensor={path}"]
    far = "from 0.5 to 200 m: only returns from 1.45 to 80 m are learnt.*'r2flow'"
    with pytest.warns(UserWarning, match=far):
        networks, header = open_networks(load_config(TrainConfig, "town_tiny", given))
    assert header.sensor == tiny
    start = tmp_path / "start.safetensors"
    save_checkpoint(start, header, networks)
    given.append(f"init={start}")
    assert open_networks(load_config(TrainConfig, "town_tiny", given))[1].sensor == tiny


def config(folder: Path, chosen: str) -> TrainConfig:
    short = ["recipe.iterations=2", "recipe.batch=1", "data.town=2", "samples.every=0"]
    return load_config(
        TrainConfig, "town_tiny", [*short, f"output={folder}", f"precision={chosen}"]
    )


@pytest.mark.slow
def test_rehearsed_scans_are_learnt_from_too_and_named(tmp_path: Path) -> None:
    plain = run(config(tmp_path / "plain", "no"))
    both = config(tmp_path / "both", "no").model_dump(mode="json")
    both |= {
        "rehearsal": {"town": 2, "seed": 5, "licence": "MIT"},
        "output": str(tmp_path / "both"),
    }
    rehearsed = run(TrainConfig.model_validate(both))
    weights = [
        load_checkpoint(path).networks["velocity"].state_dict()
        for path in (plain, rehearsed)
    ]
    assert any(
        not torch.equal(weights[0][name], value) for name, value in weights[1].items()
    )
    facts = load_checkpoint(rehearsed).header.provenance
    assert facts["rehearsal"]["seed"] == 5 and (
        facts["data"]["seed"],
        facts["data"]["town"],
    ) == (
        0,
        2,
    )
    assert overlap(seen_by(facts), town(5)) and overlap(seen_by(facts), town(0))


@pytest.fixture(params=[True, False], ids=["faster in bfloat16", "slower in bfloat16"])
def faster(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the processor is faster in bfloat16."""
    monkeypatch.setattr(precision, "faster_in_bfloat16", lambda: request.param)
    return request.param


@pytest.mark.skipif(
    torch.cuda.is_available() or torch.backends.mps.is_available(),
    reason="a GPU has bfloat16",
)
def test_bfloat16_is_for_processors_that_are_faster_with_it(faster: bool) -> None:
    assert precision.choose_precision("bf16") == ("bf16" if faster else "no")
    assert precision.choose_precision("no") == "no"


@pytest.mark.slow
def test_runs_of_one_process_may_differ_in_precision(
    faster: bool, tmp_path: Path
) -> None:
    made = {
        name: load_checkpoint(run(config(tmp_path / name, name)))
        for name in ("bf16", "no")
    }
    weights = [
        dict(checkpoint.networks["velocity"].named_parameters())
        for checkpoint in made.values()
    ]
    same = all(
        torch.equal(weights[0][name], value) for name, value in weights[1].items()
    )
    assert same is not faster, "the same weights where both were trained in float32"
    AcceleratorState._reset_state()
    mine = Accelerator(mixed_precision="no")  # the caller's own stays as it is
    if faster:
        with pytest.raises(
            ConfigError,
            match="precision=bf16, where this process has set up Accelerate with 'no'",
        ):
            run(config(tmp_path / "refused", "bf16"))
    assert (
        run(config(tmp_path / "same", "no")).exists() and mine.mixed_precision == "no"
    )
    AcceleratorState._reset_state()
