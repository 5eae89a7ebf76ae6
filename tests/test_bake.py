"""Baking: every engine writes the same bytes; invalid settings are refused before any work."""

import hashlib
import itertools
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from bakes import COUNT, SIZE, files, plan_in
from layouts import some_scan, write_all
from pydantic.fields import FieldInfo
from test_generator import SENSOR, write
from typer.testing import CliRunner

import lidar_synth.bake.shard as shard_module
from lidar_synth.bake import (
    ENGINES,
    BakeJob,
    BakePlan,
    Resources,
    Share,
    bake,
    make_plan,
)
from lidar_synth.bake.folder import (
    _with_conditions_at,
    at_work,
    check_settings,
    finish,
    prepare,
    write_bank_files,
)
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import regenerate, verify
from lidar_synth.bank import INDEX, Bank, Encoding, Entry, Index
from lidar_synth.bank.card import CARD, CROISSANT
from lidar_synth.bank.index import SETTINGS
from lidar_synth.cli import app
from lidar_synth.cli.bake import _resources
from lidar_synth.errors import ConfigError, DataError, FileError, LibraryError
from lidar_synth.files import processes
from lidar_synth.files.disk import sha256
from lidar_synth.formats import open_scans
from lidar_synth.generate.checkpoint import (
    ENCODER,
    VELOCITY,
    Header,
    NetworkSpec,
    save_checkpoint,
)
from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.normalize import NORMALISATIONS
from lidar_synth.lab.train.config import read_values, validate

CONFIGS = Path(__file__).parents[1] / "configs"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


@pytest.fixture
def plan(model: Path, tmp_path: Path) -> BakePlan:
    return plan_in(tmp_path / "bank", model)


@pytest.fixture(scope="module")
def expected(model: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of the bank, baked in one go in this process."""
    plan = plan_in(tmp_path_factory.mktemp("expected") / "bank", model)
    bake(plan, progress=False)
    return files(plan.out)


@pytest.mark.slow
def test_a_bank_holds_the_models_scans(
    plan: BakePlan, model: Path, expected: dict[str, bytes]
) -> None:
    index = bake(plan, progress=False)
    assert (
        index is not None
        and index.scans == COUNT
        and [e.scans for e in index.shards] == [3, 3, 3, 1]
    )
    assert files(plan.out) == expected
    bank = Bank(plan.out)
    generator = load_generator(model)
    encoding = Encoding(generator.sensor, bank.fields)
    for i, image in enumerate(generator.range_images(4, range(COUNT))):
        assert np.array_equal(
            bank.image(i).range, encoding.decode(encoding.encode(image)).range
        )
        assert bank[i].id == f"small/4/{i}"
        assert np.array_equal(bank[i].label, image.label[image.mask])
    facts = bank.facts
    assert (facts.checkpoint, facts.label_policy, facts.licence) == (
        generator.hash,
        "generated",
        "MIT",
    )
    assert (
        facts.settings["seed"] == 4
        and facts.software["torch"]
        and facts.software["deflate"]
    )


def write_conditioned(path: Path) -> Path:
    """A checkpoint with random weights that generates ranges from label maps."""
    arguments = {
        "resolution": SENSOR.shape,
        "channels": 1,
        "width": 16,
        "time_width": 16,
        "depths": (1, 1),
        "heads": (2, 2),
        "patch": (2, 2),
        "window": (3, 3),
        "condition_channels": 3,
    }
    of_maps = {"resolution": SENSOR.shape, "target": SENSOR.shape, "channels": 3}
    torch.manual_seed(0)
    networks = {
        VELOCITY: build_network(
            "hdit", arguments | {"angles": torch.from_numpy(SENSOR.ray_angles())}
        ),
        ENCODER: build_network("semantic_map", of_maps),
    }
    for network in networks.values():
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
    header = Header(
        networks={
            VELOCITY: NetworkSpec("hdit", arguments),
            ENCODER: NetworkSpec("semantic_map", of_maps),
        },
        sensor=SENSOR,
        normalisation=NORMALISATIONS["r2flow"],
        channels=("range",),
        time_grid=(1.0, 0.5, 0.0),
        provenance={"data": "none", "data_licence": "none", "licence": "MIT"},
        conditioning={"semantic": {}},
    )
    save_checkpoint(path, header, networks)
    return path


@pytest.mark.slow
def test_conditions_come_from_a_dataset(tmp_path: Path) -> None:
    real = tmp_path / "real"
    write_all("npz", real, [some_scan(i) for i in range(3)])
    model = write_conditioned(tmp_path / "semantic.safetensors")
    plan = plan_in(tmp_path / "bank", model, condition=str(real), seed=2, first=4)
    index = bake(plan, progress=False)
    assert index is not None and plan.facts.label_policy == "condition"
    bank = Bank(plan.out)
    source = open_scans(real)
    names = hashlib.sha256("\n".join(source.ids).encode()).hexdigest()
    known = {
        "kind": "semantic",
        "source": str(real),
        "layout": None,
        "split": None,
        "content": names,
    }
    assert bank.facts.condition == known
    [expected] = load_generator(model).range_images(2, [9], [source[0]])
    assert bank.condition(5) == source.ids[0]  # index 9 of 3 conditions
    assert np.allclose(bank.image(5).range, expected.range, atol=1e-3)
    assert np.array_equal(bank.image(5).label, expected.label)
    assert min(regenerate(plan.out, str(model), progress=False).values()) == 1
    (plan.out / "shard-00001.h5").unlink()
    assert repair(plan.out, str(model), progress=False) == {
        "shard-00001.h5": "regenerated"
    }


def test_conditions_may_move(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_all("npz", Path("real"), [some_scan(i) for i in range(3)])
    model = write_conditioned(tmp_path / "semantic.safetensors")
    options: dict[str, Any] = {"count": 4, "shard_size": 2}
    plan = plan_in(tmp_path / "bank", model, condition="real", **options)
    assert plan.job.condition == str(tmp_path / "real")
    bake(plan, share=Share(0, 2), progress=False)
    # an earlier version kept the path as it was typed
    old = _with_conditions_at(replace(plan, out=tmp_path / "old"), "real")
    bake(old, share=Share(0, 2), progress=False)
    Path("real").rename("moved")
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    for out, known in ((plan.out, str(tmp_path / "real")), (old.out, "real")):
        moved = plan_in(out, model, condition="../moved", **options)
        assert bake(moved, progress=False) is not None
        assert verify(out, progress=False) == []
        facts = Bank(out).facts
        assert (facts.condition or {})["source"] == facts.settings["condition"] == known
        with pytest.raises(
            ConfigError, match="real .*, which have moved .*--condition"
        ):
            regenerate(out, str(model), progress=False)
        again = regenerate(out, str(model), progress=False, condition="../moved")
        assert min(again.values()) == 1
        (out / "shard-00001.h5").unlink()
        done = repair(out, str(model), progress=False, condition="../moved")
        assert done == {"shard-00001.h5": "regenerated"}
        write_all("npz", tmp_path / "other", [some_scan(i) for i in range(2)])
        with pytest.raises(ConfigError, match="'condition_content'"):
            bake(plan_in(out, model, condition="../other", **options), progress=False)


# The same bytes


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 3])
def test_processes_write_the_same_bytes(
    plan: BakePlan, expected: dict[str, bytes], workers: int
) -> None:
    prepare(plan)
    reported: list[int] = []
    ENGINES["processes"](plan, range(4), Resources(workers), reported.append)
    assert sum(reported) == COUNT  # the bar counts every scan once
    finish(plan)
    assert files(plan.out) == expected


@pytest.mark.parametrize("order", list(itertools.permutations(range(4)))[::5])
def test_shares_in_any_order_write_the_same_bytes(
    plan: BakePlan, expected: dict[str, bytes], order: tuple[int, ...]
) -> None:
    indices = [bake(plan, share=Share(k, 4), progress=False) for k in order]
    assert indices[:3] == [None, None, None] and indices[3] is not None
    assert files(plan.out) == expected


def test_a_plan_may_be_used_in_another_folder(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As actors of Ray do, which run in the folder in which their cluster was started."""
    monkeypatch.chdir(tmp_path)
    plan = prepare(plan_in(Path("bank"), model))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    ENGINES["local"](plan, [3], Resources(), lambda scans: None)
    assert (tmp_path / "bank" / "shard-00003.h5").is_file()


@pytest.mark.parametrize("shares", [1, 2])
@pytest.mark.parametrize("ranks", [(0,), (1, 0), (1, 2, 0)])
def test_ranks_of_torchrun_one_after_another_write_the_same_bytes(
    plan: BakePlan,
    expected: dict[str, bytes],
    ranks: tuple[int, ...],
    shares: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The ranks divide the run's share evenly, whatever is missing, and check only their part."""
    with pytest.raises(
        ConfigError, match="engine 'torchrun' without 'RANK'.*torchrun --nproc-per-node"
    ):
        bake(plan, "torchrun", progress=False)
    checked: list[Path] = []
    monkeypatch.setattr(
        "lidar_synth.bake.folder.sha256",
        lambda path: checked.append(path) or sha256(path),
    )
    monkeypatch.setenv("WORLD_SIZE", str(len(ranks)))
    for share in range(shares):
        part = 4 // shares / len(ranks)
        for rank in ranks:
            monkeypatch.setenv("RANK", str(rank))
            monkeypatch.setenv("LOCAL_RANK", str(rank))
            before = len(list(plan.out.glob("*.h5")))
            index = bake(plan, "torchrun", share=Share(share, shares), progress=False)
            made = len(list(plan.out.glob("*.h5"))) - before
            assert math.floor(part) <= made <= math.ceil(part) and checked == []
            bake(plan, "torchrun", share=Share(share, shares), progress=False)
            assert len(checked) == made
            checked.clear()
    assert index is not None and files(plan.out) == expected


@pytest.mark.slow
def test_torchrun_writes_the_same_bytes(
    plan: BakePlan, model: Path, expected: dict[str, bytes]
) -> None:
    """Two concurrent processes, started by torchrun itself."""
    options = [
        "--model",
        model,
        "--count",
        COUNT,
        "--shard-size",
        SIZE,
        "--seed",
        4,
        "--engine",
        "torchrun",
    ]
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        2,
    ]
    subprocess.run(
        [str(a) for a in (*command, "-m", "lidar_synth", "bake", plan.out, *options)],
        check=True,
    )
    assert files(plan.out) == expected


@pytest.mark.parametrize("engine", ["ray", "slurm"])
def test_a_missing_library_of_an_engine_is_reported(
    plan: BakePlan, engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, {"ray": "ray", "slurm": "submitit"}[engine], None)
    with pytest.raises(
        LibraryError,
        match=rf"engine '{engine}', but .* pip install 'lidar_synth\[{engine}\]'",
    ):
        bake(plan, engine, progress=False)
    assert not plan.out.exists()


def test_a_missing_library_of_the_compression_is_reported_before_the_claim(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of a bake into a URL, where a claim stays."""
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(LibraryError, match="a bank with Blosc2, but hdf5plugin"):
        plan_in(tmp_path, model, compression="blosc2")


def test_a_bake_that_fails_before_its_first_shard_leaves_no_claim(
    plan: BakePlan, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="device 'cuda'; expected an available one"):
        bake(plan_in(plan.out, model, device="cuda"), progress=False)
    assert not plan.out.exists()

    def fail(*arguments: object) -> None:
        raise FileError("no more")

    monkeypatch.setitem(ENGINES, "local", fail)
    with pytest.raises(FileError, match="no more"):
        bake(plan_in(plan.out, model, steps=1), progress=False)
    assert list(plan.out.iterdir()) == []
    prepare(plan)
    with at_work(plan), pytest.raises(FileError, match="no more"):
        bake(plan, progress=False)
    assert (plan.out / SETTINGS).is_file()  # another process needs it


@pytest.mark.parametrize(
    ("allowed", "quota", "workers"),
    [
        ({3}, "max 100000", 1),
        ({0, 2, 5}, "400000 100000", 3),
        ({0, 2, 5}, "150000 100000", 2),
    ],
)
def test_there_is_one_worker_for_each_core_that_may_be_used(
    plan: BakePlan,
    allowed: set[int],
    quota: str,
    workers: int,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(processes, "QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: allowed, raising=False)
    assert _resources(plan, "processes", None, None, None).workers == workers


@pytest.mark.parametrize(
    ("options", "engine"),
    [
        ("", "local"),
        ("--workers 2", "processes"),
        ("--workers 2 --address auto", "ray"),
        ("--workers 2 --slurm cluster=local", "slurm"),
        ("--workers 2 --engine ray", "ray"),
    ],
)
def test_resources_choose_their_engine(
    options: str,
    engine: str,
    model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    used: list[str] = []
    monkeypatch.setattr("lidar_synth.bake.run.LIBRARIES", {})
    for name in ENGINES:
        monkeypatch.setitem(ENGINES, name, lambda *_, name=name: used.append(name))
    call = ["bake", str(tmp_path / "bank"), "--model", str(model), *options.split()]
    CliRunner().invoke(app, call, catch_exceptions=False)
    assert used == [engine]


def test_every_engine_is_named_in_the_help() -> None:
    text = CliRunner().invoke(app, ["bake", "--help"]).output
    assert all(engine in text for engine in ENGINES)


@pytest.mark.parametrize(("name", "field"), BakeJob.model_fields.items())
def test_every_setting_is_an_option_with_its_description_and_default(
    name: str, field: FieldInfo
) -> None:
    text = " ".join(CliRunner().invoke(app, ["bake", "--help"]).output.split())
    description = f"{field.description}" + (
        "" if field.default is None else f" [{field.default}]"
    )
    option = re.escape(f"--{name.replace('_', '-')} ")
    assert re.search(option + r"(<\w+>|NAME,\.\.\.) " + re.escape(description), text), (
        text
    )


# Settings


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 5}, r"'seed': 4.*'seed': 5"),
        ({"seed": 5, "count": 16}, r"or choose another folder\.$"),
        (
            {"count": 16},
            r"'count': 10.*'count': 16.*--first 10 --count 6, then .*merge",
        ),
        ({"steps": 2}, r"'steps': None.*'steps': 2"),
        (
            {"fields": ("label",)},
            r"'fields': \['reflectance', 'label', 'confidence'\].*'fields': \['label'\]",
        ),
        ({"batch": 2}, r"'batch': 1.*'batch': 2"),
    ],
)
def test_a_different_setting_is_refused_and_shown(
    plan: BakePlan, model: Path, change: dict[str, Any], message: str
) -> None:
    bake(plan, share=Share(0, 4), progress=False)
    before = {path: path.read_bytes() for path in plan.out.glob("*.h5")}
    other = plan_in(plan.out, model, **change)
    for check in (bake, check_settings):
        with pytest.raises(ConfigError, match=message):
            check(other)
    assert before == {path: path.read_bytes() for path in plan.out.glob("*.h5")}


def test_a_different_checkpoint_is_refused(plan: BakePlan, tmp_path: Path) -> None:
    bake(plan, share=Share(0, 4), progress=False)
    other = write(tmp_path / "other.safetensors", ("range", "reflectance", "label")[:2])
    with pytest.raises(ConfigError, match="'checkpoint'"):
        bake(plan_in(plan.out, other), progress=False)
    shutil.copyfile(other, tmp_path / "small.safetensors")
    changed = plan_in(tmp_path / "changed", tmp_path / "small.safetensors")
    write(tmp_path / "small.safetensors", ("range",))
    shard_module._load.cache_clear()
    with pytest.raises(
        ConfigError, match="expected the checkpoint that made the bank's scans"
    ):
        bake(changed, progress=False)


def test_a_checkpoint_that_was_replaced_is_loaded_again(tmp_path: Path) -> None:
    model = write(tmp_path / "mine.safetensors")
    bake(plan_in(tmp_path / "first", model), progress=False)
    write(model, ("range", "reflectance", "label")[:2])
    bake(plan_in(tmp_path / "second", model), progress=False)
    assert Bank(tmp_path / "second").fields == {"reflectance"}


def test_a_bank_without_bake_settings_is_refused(plan: BakePlan) -> None:
    bake(plan, progress=False)
    (plan.out / SETTINGS).unlink()
    with pytest.raises(
        ConfigError, match="holds another bank; expected an empty folder"
    ):
        bake(plan, progress=False)


@pytest.mark.parametrize("name", [CARD, CROISSANT])
def test_a_file_of_the_user_is_not_replaced(plan: BakePlan, name: str) -> None:
    plan.out.mkdir()
    (plan.out / name).write_text("mine")
    with pytest.raises(
        ConfigError, match=f"holds a {name}, which the bank's own would replace"
    ):
        bake(plan, progress=False)
    assert [path.name for path in plan.out.iterdir()] == [name]
    assert (plan.out / name).read_text() == "mine"


@pytest.mark.parametrize(("count", "size"), [(10, 64), (1000, 125), (20_000, 1024)])
def test_shards_of_small_banks_are_small(
    model: Path, tmp_path: Path, count: int, size: int
) -> None:
    """An interrupted bake keeps whole shards."""
    plan = make_plan(tmp_path, BakeJob(model=str(model), count=count))
    assert plan.job.shard_size == size


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--count", "0"], "count = 0: Input should be greater than or equal to 1"),
        (["--seed", "-1"], "seed = -1"),
        (["--seed", str(2**64)], "seed = 18446744073709551616"),
        (["--first", "-1"], "first = -1"),
        (["--shard-size", "0"], "shard_size = 0"),
        (["--steps", "0"], "steps = 0"),
        (["--batch", "0"], "batch = 0"),
        (["--threads", "0"], "threads = 0"),
        (["--threads", "5000"], "threads = 5000"),
        (["--solver", "rk4"], "solver 'rk4'; expected one of 'euler', 'heun'"),
        (
            ["--dtype", "float16"],
            "dtype 'float16'; expected one of 'float32', 'bfloat16'",
        ),
        (["--device", "tpu"], "device = 'tpu': Input should be 'cpu' or 'cuda'"),
        (["--compression", "lzf"], "compression = 'lzf'"),
        (["--layout", "flat"], "layout = 'flat'"),
        (["--fields", "ring"], r"fields \['ring'\] of model"),
        (
            ["--engine", "dask"],
            "engine 'dask'; expected one of 'local', 'processes', 'ray'",
        ),
        (["--workers", "0"], "workers 0; expected a whole number"),
        (
            ["--shard-index", "3", "--num-shards", "3"],
            "--shard-index 3 of --num-shards 3",
        ),
        (["--shard-index", "auto"], "--shard-index auto outside an array job"),
        (["--shard-index", ""], "--shard-index '' of --num-shards '1'"),
        (["--shard-index", "two"], "--shard-index 'two' of --num-shards '1'"),
        (["--slurm", "partition"], "--slurm 'partition'; expected KEY=VALUE"),
        (["--model", "city"], "model 'city'; expected a shipped one"),
    ],
)
def test_invalid_options_are_refused(
    options: list[str], message: str, model: Path, tmp_path: Path
) -> None:
    call = ["bake", str(tmp_path / "bank"), "--model", str(model), *options]
    for more in ([], ["--dry-run"]):
        with pytest.raises(ConfigError, match=message):
            CliRunner().invoke(app, [*call, *more], catch_exceptions=False)
    assert not (tmp_path / "bank").exists()


@pytest.mark.parametrize(
    ("index", "size"),
    [
        ("JOB_COMPLETION_INDEX", None),
        ("AWS_BATCH_JOB_ARRAY_INDEX", "AWS_BATCH_JOB_ARRAY_SIZE"),
        ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
        ("CLOUD_RUN_TASK_INDEX", "CLOUD_RUN_TASK_COUNT"),
        ("SKYPILOT_NODE_RANK", "SKYPILOT_NUM_NODES"),
    ],
)
def test_an_array_job_bakes_its_share(
    index: str,
    size: str | None,
    model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "bank"
    call = ["bake", str(out), "--model", str(model), "--count", "3"]
    call += ["--shard-size", "1", "--shard-index", "auto"]
    monkeypatch.setenv(index, "1")
    if size is None:
        with pytest.raises(ConfigError, match="--shard-index '1' of --num-shards ''"):
            CliRunner().invoke(app, call, catch_exceptions=False)
        call += ["--num-shards", "3"]
    else:
        monkeypatch.setenv(size, "3")
    CliRunner().invoke(app, call, catch_exceptions=False)
    assert [path.name for path in out.glob("*.h5")] == ["shard-00001.h5"]
    monkeypatch.setenv(index, "3")  # an array numbered from 1
    with pytest.raises(ConfigError, match="--shard-index 3 of --num-shards 3"):
        CliRunner().invoke(app, call, catch_exceptions=False)


def test_some_tasks_of_an_array_are_no_shares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As --array=1,2 starts them; they would bake the shares of an array of two."""
    for name, value in {"ID": "1", "COUNT": "2", "MAX": "2"}.items():
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", value)
    call = ["bake", str(tmp_path / "bank"), "--shard-index", "auto"]
    with pytest.raises(
        ConfigError, match="array of 2 tasks up to 2; .*--num-shards as well"
    ):
        CliRunner().invoke(app, call, catch_exceptions=False)


def test_unsuitable_models_are_refused(tmp_path: Path) -> None:
    plain = write(tmp_path / "plain.safetensors", ("range", "reflectance"))
    with pytest.raises(
        ConfigError,
        match=r"fields \['label'\] of model .*some of \['reflectance'\].*channel",
    ):
        plan_in(tmp_path / "bank", plain, fields=("reflectance", "label"))
    assert plan_in(tmp_path / "bank", plain).facts.label_policy == "none"
    with pytest.raises(
        ConfigError,
        match="condition .*here for model .*takes no condition; expected none",
    ):
        plan_in(tmp_path / "bank", plain, condition="here")
    with pytest.raises(
        ConfigError,
        match="condition None for model .*takes semantic conditions; expected a dataset",
    ):
        plan_in(
            tmp_path / "bank", write_conditioned(tmp_path / "conditioned.safetensors")
        )
    with pytest.raises(FileError, match="nowhere does not exist"):
        plan_in(
            tmp_path / "bank",
            tmp_path / "conditioned.safetensors",
            condition=str(tmp_path / "nowhere"),
        )
    (tmp_path / "broken.safetensors").write_bytes(b"no")
    with pytest.raises(DataError, match="broken"):
        plan_in(tmp_path / "bank", tmp_path / "broken.safetensors")
    assert not (tmp_path / "bank").exists()


def test_options_override_a_configuration_file(
    model: Path, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    config = tmp_path / "bake.yaml"
    config.write_text(
        yaml.safe_dump(
            {"model": str(model), "count": COUNT, "shard_size": SIZE, "seed": 9}
        )
    )
    result = CliRunner().invoke(
        app, ["bake", str(tmp_path / "bank"), "--config", str(config), "--seed", "4"]
    )
    assert result.exit_code == 0 and "10 scans in 4 shards" in result.output
    assert files(tmp_path / "bank") == expected
    config.write_text("model: small\nsize: 3\n")
    with pytest.raises(
        ConfigError,
        match=r"bake.yaml: unknown key 'size'; known there: model, count, seed",
    ):
        CliRunner().invoke(
            app,
            ["bake", str(tmp_path / "b"), "--config", str(config)],
            catch_exceptions=False,
        )
    with pytest.raises(FileError, match="nowhere.yaml cannot be read"):
        CliRunner().invoke(
            app,
            ["bake", str(tmp_path / "b"), "--config", "nowhere.yaml"],
            catch_exceptions=False,
        )


@pytest.mark.parametrize(
    "path", sorted(CONFIGS.glob("bake_*.yaml")), ids=lambda p: p.stem
)
def test_published_configurations_load(path: Path) -> None:
    assert validate(BakeJob, read_values(path, BakeJob), str(path)).count >= 1000


@pytest.mark.slow
def test_a_dry_run_writes_nothing_and_estimates_the_size(
    model: Path, tmp_path: Path
) -> None:
    out = tmp_path / "bank"
    call = [
        "bake",
        str(out),
        "--model",
        str(model),
        "--count",
        "50",
        "--shard-size",
        "20",
        "--dry-run",
    ]
    output = CliRunner().invoke(app, call).output
    assert (
        "50 scans in 3 shards of up to 20" in output
        and "scans/s" in output
        and "label policy" in output
    )
    assert "MB of memory a worker for its shard" in output
    assert not out.exists()
    # The estimate is close to the actual size.
    actual = CliRunner().invoke(app, [*call[:-1]]).output
    estimated, written = (
        float(text.split(" MB")[0].split()[-1]) for text in (output, actual)
    )
    assert estimated == pytest.approx(written, rel=0.4)


def test_the_index_needs_a_record_of_every_shard(plan: BakePlan) -> None:
    bake(plan, share=Share(0, 2), progress=False)
    bake(plan, share=Share(1, 2), progress=False)
    (plan.out / INDEX).unlink()
    # A finished bake has removed the records, so a rerun checks the shards.
    assert finish(plan) is None


SHARD = b"shard".ljust(64)


@pytest.mark.slow
def test_a_rerun_over_many_shards_parses_the_index_once(
    plan: BakePlan, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """10,000 shards, of which 20 are missing. A few bytes stand in for each shard, because its
    content is not read."""
    many = plan_in(plan.out, model, count=10_000, shard_size=1)
    prepare(many)
    for entry in many.shards:
        (plan.out / entry.file).write_bytes(SHARD)
    content = {"bytes": len(SHARD), "sha256": sha256(plan.out / many.shards[0].file)}
    write_bank_files(
        plan.out,
        Index((many.facts,), tuple(replace(e, **content) for e in many.shards)),
        baked=True,
    )
    for entry in many.shards[::500]:
        (plan.out / entry.file).unlink()
    parsed = [0]
    made = [0]
    parse = Index.from_json
    begin = Entry.__post_init__

    def count_parsed(text: bytes, where: str) -> Index:
        parsed[0] += 1
        return parse(text, where)

    def count_made(entry: Entry) -> None:
        made[0] += 1
        begin(entry)

    monkeypatch.setattr(Index, "from_json", count_parsed)
    monkeypatch.setattr(Entry, "__post_init__", count_made)
    assert bake(many, progress=False) is not None
    assert parsed[0] <= 3 and made[0] < 10 * len(many.shards)
