"""A student of several numbers of steps: from distillation to scans, and as the start of another
run."""

from pathlib import Path

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from flows import select_timesteps
from test_run import call, distilling, one_thread, scans, teacher, write_config

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import load_checkpoint, read_header
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.generate.loading import load_generator
from lidar_synth.lab.train import DistillConfig, load_config
from lidar_synth.lab.train.loop import weigh_metric
from lidar_synth.lab.train.runs import open_stage
from lidar_synth.lab.train.student import StudentStage

__all__ = ["one_thread", "scans", "teacher"]  # fixtures


def test_other_numbers_of_steps_have_no_times_beside_a_given_grid(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    config = write_config(
        scans, tmp_path, teacher=str(teacher), grid=[1, 0.5, 0], also=[1], intervals=2
    )
    with pytest.raises(
        ConfigError, match=r"also=\[1\] with grid=\[1.0, 0.5, 0.0\]; expected grid=null"
    ):
        call("distill", config)


def test_a_student_of_several_numbers_of_steps_is_distilled(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    config = distilling(scans, tmp_path, teacher)
    call("distill", config, "also=[2, 1]")
    header, _ = read_header(tmp_path / "run" / "run.safetensors")
    assert [len(grid) - 1 for grid in (header.time_grid, *header.other_grids)] == [
        4,
        2,
        1,
    ]
    student = load_generator(tmp_path / "run" / "run.safetensors")
    with torch.inference_mode():
        moments = [
            torch.std_mean(torch.cat([*student.samples(0, range(64), steps=n)]), (0, 3))
            for n in (4, 2, 1)
        ]
    assert set(header.matches) == {"2", "1"}
    std, mean = moments[0]
    for steps, (own_std, own_mean) in zip((2, 1), moments[1:], strict=True):
        excess = torch.tensor(header.matches[str(steps)][0]) ** (1 / 3)
        assert torch.allclose(own_mean, mean, atol=1e-4)
        assert torch.allclose(own_std, std * excess, atol=1e-4)
    # it was trained
    assert student.network.ends and student.network.step.out.weight.any()
    images = [
        student.range_images(0, [1], steps=steps)[0].range for steps in (1, 2, 4, None)
    ]
    assert np.array_equal(images[2], images[3]) and not np.array_equal(
        images[0], images[1]
    )
    with pytest.raises(ConfigError, match="it predicts mean velocities"):
        student.range_images(0, [1], solver="heun")
    call("distill", config, "also=[2, 1]", "--resume", "recipe.iterations=6")
    made = tmp_path / "run" / "run.safetensors"
    with pytest.raises(ConfigError, match="a student of several numbers of steps"):
        call("distill", config, f"teacher={made}", f"output={tmp_path / 'other'}")
    with pytest.raises(
        ConfigError,
        match=r"also=\[2\] for a hdit by reflow; expected an hdit, adaptive_piecewise. "
        r"Give also=\[\]",
    ):
        call(
            "distill",
            config,
            "also=[2]",
            "strategy=reflow",
            f"output={tmp_path / 'other'}",
        )
    call(
        "train",
        write_config(scans, tmp_path, recipe={"iterations": 1}),
        f"init={made}",
        f"output={tmp_path / 'flow'}",
    )
    # It is not told where a step ends.
    flow = load_generator(tmp_path / "flow" / "flow.safetensors")
    assert not flow.network.ends
    assert flow.header.other_grids == () and flow.header.matches == {}


def test_a_student_is_not_distilled_on_the_town_in_place_of_the_teachers_scans(
    teacher: Path, tmp_path: Path
) -> None:
    given = [
        f"teacher={teacher}",
        f"output={tmp_path / 'run'}",
        "weaker=null",
        "guidance=1",
    ]
    with pytest.raises(
        ConfigError,
        match=r"data.town=3000 for teacher .*, which learnt from .*data.town=null",
    ):
        call("distill", "town_pixel_student", *given)
    assert not (tmp_path / "run" / "cache").exists()


def test_timesteps_are_selected_by_the_metric_of_the_training(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    recipe = {"weights": {"label": 0.01}, "iterations": 1, "metric": "pseudo_huber"}
    selection = {"candidates": 6, "trajectories": 2}
    config = load_config(
        DistillConfig,
        write_config(
            scans, tmp_path, teacher=str(teacher), selection=selection, recipe=recipe
        ),
    )
    stage = open_stage(config)
    assert isinstance(stage, StudentStage)
    data = stage.open_data()
    stage.prepare(data, Accelerator(cpu=True))
    plain = METRICS["pseudo_huber"]
    by_each, by_none = (
        select_timesteps(stage.flow, stage.codec.shape, 4, 6, 2, metric)
        for metric in (weigh_metric(plain, recipe["weights"], data.tensors), plain)
    )
    cost = stage.header.provenance["selection"]["cost"]
    assert cost == pytest.approx(by_each.cost) != pytest.approx(by_none.cost)
    unweighted = config.recipe.__class__(**vars(config.recipe) | {"weights": {}})
    with pytest.raises(ConfigError, match=r"made with weights.label=0.01"):
        open_stage(config.model_copy(update={"recipe": unweighted}))


def test_a_damaged_selection_is_made_again(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    config = distilling(scans, tmp_path, teacher)
    path = tmp_path / "run" / "selection.npz"
    path.parent.mkdir()
    for content in (b"", b"PK\x03\x04", b"no archive"):
        path.write_bytes(content)
        with pytest.warns(UserWarning, match="the timesteps are selected again"):
            call("distill", config, f"output={path.parent}")
        assert load_checkpoint(path.parent / "run.safetensors").header.time_grid[0] == 1
        for other in path.parent.iterdir():
            if other.is_file():
                other.unlink()


def test_a_student_is_trained_further_from_its_checkpoint(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    config = distilling(scans, tmp_path, teacher)
    call("distill", config, "also=[2, 1]")
    made = tmp_path / "run" / "run.safetensors"
    start = load_checkpoint(made)
    out = tmp_path / "more"
    further = [f"init={made}", f"output={out}", "also=[2, 1]"]
    call("distill", config, *further, "recipe.iterations=1", "recipe.rate=1.0e-9")
    found = load_checkpoint(out / "more.safetensors")
    assert found.header.other_grids == start.header.other_grids
    assert found.header.time_grid == start.header.time_grid
    assert found.header.provenance["init"] == start.hash
    assert not (out / "selection.npz").exists()  # the times are those of the start
    before = start.networks["velocity"].state_dict()
    for name, value in found.networks["velocity"].state_dict().items():
        assert np.allclose(value, before[name], atol=1e-5), name
    with pytest.raises(ConfigError, match=r"with \[4, 2, 1\] steps; .*in \[4, 1\]"):
        call("distill", config, f"init={made}", f"output={tmp_path / 'x'}", "also=[1]")
