"""Adaptation of a model to the sensor and the scans of a user, end to end on a tiny sensor, kill
and resumption too."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hostile import MARKUP, tags_of
from latent_runs import call
from small_models import write as write_pixel_model

from lidar_synth import Town, adapt, load_generator, load_sensor, open_scans
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.datasets.recordings import Recordings, seen_by
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS, layout_of
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    VELOCITY,
    Checkpoint,
    Header,
    NetworkSpec,
    load_checkpoint,
    read_header,
    save_checkpoint,
)
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.loading import find_model
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.normalize import CHANNELS, NORMALISATIONS
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, sensor_yaml
from lidar_synth.lab.evaluate.leakage import measured, overlap, town
from lidar_synth.lab.train.adaptation import card
from lidar_synth.lab.train.adaptation.regrid import (
    PLACED,
    check_movable,
    fit_grid,
    regrid,
)
from lidar_synth.lab.train.adaptation.run import plan_adaptation
from lidar_synth.lab.train.adaptation.scans import Prepared
from lidar_synth.lab.train.adaptation.stages import TOWN_SEED, Work, stages_for
from lidar_synth.lab.train.config import DistillConfig
from lidar_synth.lab.train.held_out import read_history
from lidar_synth.lab.train.staged import StagedRuns

TINY = load_sensor(Path(__file__).parent.parent / "configs" / "tiny_sensor.yaml")
OWN = Sensor(
    "own",
    120,
    1.0,
    100.0,
    elevations=tuple(np.linspace(2, -24, 16) - np.linspace(-1, 1, 16) ** 2),
)
"""The user's sensor: rows of uneven elevation, another number of columns."""
SHORT = {
    "save_every": 2,
    "held_out": {"samples": 4, "patience": 2},
    "recipe": {"warmup": 1, "batch": 2},
}
STAGES = ("labels", "codec", "flow_town", "flow", "student")
QUICK = dict.fromkeys(STAGES, SHORT)


@pytest.fixture(autouse=True, scope="module")
def short() -> Iterator[None]:
    """One thread, and few scans to look for copies."""
    threads = torch.get_num_threads()
    count = card.GENERATED
    torch.set_num_threads(1)
    card.GENERATED = 3
    yield
    torch.set_num_threads(threads)
    card.GENERATED = count


def tiny_model(path: Path, semantic: bool = False) -> Path:
    """A latent model of the tiny sensor with random weights: the architectures of ``town``,
    ``town-semantic``."""
    torch.manual_seed(0)
    size = sum(CHANNELS.values())
    codec = {
        "resolution": list(TINY.shape),
        "channels": size,
        "encoder_widths": [8, 16],
        "widths": [8, 16],
        "reaches": [1],
        "depth": 1,
    }
    flow = {
        "resolution": [4, 8],
        "channels": 8,
        "width": 16,
        "time_width": 16,
        "depths": [1, 1],
        "heads": [2, 2],
        "patch": [1, 1],
        "window": [3, 3],
    }
    parts = {CODEC: NetworkSpec("surfaces", codec), VELOCITY: NetworkSpec("hdit", flow)}
    if semantic:
        maps = {
            "resolution": list(TINY.shape),
            "target": [4, 8],
            "channels": 6,
            "method": "patches",
        }
        parts |= {ENCODER: NetworkSpec("semantic_map", maps)}
        flow["condition_channels"] = 6
    angles = torch.nn.functional.avg_pool2d(
        torch.from_numpy(TINY.ray_angles())[None], (4, 16)
    )[0]
    needed = {VELOCITY: {"angles": angles}}
    networks = {
        name: build_network(part.architecture, part.arguments | needed.get(name, {}))
        for name, part in parts.items()
    }
    header = Header(
        parts,
        TINY,
        NORMALISATIONS["r2flow"],
        tuple(CHANNELS),
        (1.0, 0.6, 0.0),
        {"data": "none", "data_licence": "none", "licence": "MIT"},
        conditioning={"semantic": {"dropout": 0.1}} if semantic else {},
    )
    save_checkpoint(path, header, networks)
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_model(tmp_path_factory.mktemp("model") / "tiny.safetensors")


def write(folder: Path, scans: list[Scan]) -> Path:
    writer = WRITERS["npz"](folder)
    for i, scan in enumerate(scans):
        writer.write(scan, i)
    return folder


def of_town(sensor: Sensor, count: int) -> list[Scan]:
    """Scans that do not say that they come from the town."""
    town = Town(7, sensor, count)
    return [replace(town[i], provenance=None) for i in range(count)]


@pytest.fixture(scope="module")
def own_scans() -> list[Scan]:
    return of_town(OWN, 14)


@pytest.fixture(scope="module")
def scans(own_scans: list[Scan], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fourteen labelled scans of the user's sensor."""
    return write(tmp_path_factory.mktemp("own") / "scans", own_scans)


@pytest.fixture(scope="module")
def adapted(model: Path, scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("adapted") / "mine.safetensors"
    return adapt(
        model,
        scans,
        out,
        minutes=0.02,
        town=4,
        licence="CC0",
        overrides=QUICK,
        progress=False,
    )


@pytest.mark.slow
def test_an_adapted_model_generates_scans_of_the_users_sensor_with_labels(
    adapted: Path,
) -> None:
    generator = load_generator(adapted)
    assert (generator.sensor.name, generator.sensor.shape) == ("own", (16, 128))
    np.testing.assert_allclose(generator.sensor.row_elevations(), OWN.row_elevations())
    [scan] = generator.scans(0, [0])
    assert len(scan) and {"reflectance", "label"} <= set(scan.fields())
    assert generator.header.time_grid == (1.0, 0.6, 0.0), (
        "as few steps as the model had"
    )


def test_every_stage_keeps_the_weights_with_the_least_loss_on_held_out_scans(
    adapted: Path,
) -> None:
    work = adapted.with_suffix(".adapt")
    for name in STAGES[1:]:
        history = read_history(work / name)
        losses = [m.loss for m in history]
        assert history[0].step == 0 and len(history) > 1
        facts = read_header(work / name / f"{name}.safetensors")[0].provenance
        assert facts["held_out_loss"] == min(losses)
        assert facts["iterations"] == history[losses.index(min(losses))].step
        assert (
            len(losses) - 1 - losses.index(min(losses))
            <= SHORT["held_out"]["patience"] + 1
        )


def test_flows_get_the_adapted_autoencoder(adapted: Path) -> None:
    runs = StagedRuns(adapted.with_suffix(".adapt"), {})
    codec = read_header(runs.checkpoint("codec"))[1]
    for name in ("flow_town", "flow"):
        assert read_header(runs.checkpoint(name))[0].provenance["codec"] == codec


def test_the_autoencoder_rehearses_the_town(adapted: Path) -> None:
    facts = read_header(adapted.with_suffix(".adapt") / "codec" / "codec.safetensors")[
        0
    ].provenance
    assert facts["rehearsal"]["town"] == 4 and facts["data"]["layout"] == "range"
    assert overlap(seen_by(facts), town(TOWN_SEED))


def test_the_provenance_has_the_scans_and_a_test_on_them_is_refused(
    adapted: Path, scans: Path, tmp_path: Path
) -> None:
    header = read_header(adapted)[0]
    facts = header.provenance
    assert (facts["licence"], facts["adapted_from"]) == ("CC0", "tiny")
    assert len(facts["scans"]["train"]) == 10 and len(facts["scans"]["held_out"]) == 3
    seen = seen_by(facts)
    assert overlap(seen, measured(open_scans(scans), layout_of(scans), scans, None))
    source = open_scans(scans)
    for places, known in (
        ((0, 3), True),
        ((11, 13), True),
        ((10,), False),
    ):  # 10 was left out between both
        copy = write(tmp_path / f"copy{places[0]}", [source[i] for i in places])
        reference = measured(open_scans(copy), layout_of(copy), copy, None, seen)
        assert bool(overlap(seen, reference)) == known, places


def test_the_command_line_refuses_generated_scans_beside_the_training_scans(
    adapted: Path, scans: Path, tmp_path: Path
) -> None:
    source = open_scans(scans)
    copy = write(tmp_path / "copy", [source[i] for i in range(2)])
    call(
        "sample",
        tmp_path / "generated",
        "--model",
        adapted,
        "--count",
        "2",
        "--to",
        "npz",
    )
    with pytest.raises(ConfigError, match="whose model was trained on content"):
        call(
            "evaluate", copy, tmp_path / "generated", "--protocol", "r2flow", "--anyway"
        )


def test_the_card_says_what_was_learnt_and_whether_it_repeats(adapted: Path) -> None:
    text = adapted.with_suffix(".md").read_text()
    near = read_header(adapted)[0].provenance["figures"]["nearest"]
    assert min(near["generated"], near["held_out"], near["training"]) > 0
    for part in (
        "CC0",
        "10 scans",
        "those of the scans",
        f"{near['generated']:.3f}",
        "flow_town |",
        "nearest training",
    ):
        assert part in text, part


@pytest.mark.slow
def test_a_model_of_label_maps_is_adapted_with_its_encoder(
    scans: Path, own_scans: list[Scan], tmp_path: Path
) -> None:
    model = tiny_model(tmp_path / "maps.safetensors", semantic=True)
    out = tmp_path / "mine.safetensors"
    adapt(
        model,
        scans,
        out,
        minutes=0.02,
        town=2,
        licence=MARKUP,
        overrides=QUICK,
        progress=False,
    )
    generator = load_generator(out)
    assert not tags_of(out.with_suffix(".md").read_text()) & {"img", "a", "script", "b"}
    assert (generator.condition, generator.sensor.shape) == ("semantic", (16, 128))
    wanted = project(own_scans[0], generator.sensor, ["label"]).channels["label"]
    [image] = generator.range_images(0, [0], own_scans[0])
    known = image.mask & (wanted != IGNORE)
    assert known.any() and np.array_equal(image.channels["label"][known], wanted[known])
    weights = [
        load_checkpoint(path).networks[ENCODER].mix.weight for path in (model, out)
    ]
    assert not torch.equal(*weights), "its encoder was trained"


@pytest.mark.slow
def test_scans_without_labels_get_those_that_the_autoencoder_learnt_on_the_town(
    model: Path, own_scans: list[Scan], tmp_path: Path
) -> None:
    bare = write(
        tmp_path / "bare",
        [replace(scan, label=None, raw_label=None) for scan in own_scans],
    )
    out = adapt(
        model,
        bare,
        tmp_path / "mine.safetensors",
        minutes=0.02,
        town=2,
        overrides=QUICK,
        progress=False,
    )
    card = out.with_suffix(".md").read_text()
    # nobody knows which are
    assert "guesses" in card and "labels that are right" not in card
    work = out.with_suffix(".adapt")
    assert read_history(work / "labels")
    images = [open_scans(work / "labelled" / "train")[i] for i in range(2)]
    assert all(
        scan.label is not None and scan.label.shape == (len(scan),) for scan in images
    )
    assert load_generator(out).scans(0, [0])[0].label is not None


@pytest.mark.slow
def test_a_killed_adaptation_is_resumed(
    model: Path, scans: Path, adapted: Path, tmp_path: Path
) -> None:
    """Killed in its first training, it goes on from the saved step, and ends as one that was never
    stopped."""
    out = tmp_path / "mine.safetensors"
    code = tmp_path / "run.py"
    overrides = {
        name: SHORT | {"held_out": {"samples": 4, "patience": 99}} for name in STAGES
    }
    code.write_text(
        "import torch; torch.set_num_threads(1)\nfrom lidar_synth import adapt\n"
        f"adapt({str(model)!r}, {str(scans)!r}, {str(out)!r}, minutes=5, town=0, licence='CC0',\n"
        "      "
        f"overrides={overrides!r})\n"
    )
    process = subprocess.Popen(
        [sys.executable, str(code)], env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    history = tmp_path / "mine.adapt" / "codec" / "held_out.json"
    limit = time.monotonic() + 300
    while time.monotonic() < limit and not (
        history.is_file() and len(json.loads(history.read_text())) > 2
    ):
        assert process.poll() is None, "it ended by itself"
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = json.loads(history.read_text())
    prepared = (
        (tmp_path / "mine.adapt" / "scans" / "train" / "000000.npz").stat().st_mtime_ns
    )
    longer = {
        name: SHORT | {"held_out": {"samples": 4, "patience": 99}} for name in STAGES
    }
    adapt(
        model,
        scans,
        out,
        minutes=before[-1][2] / 60 + 0.05,
        town=0,
        licence="CC0",
        overrides=longer,
        progress=False,
    )
    after = json.loads(history.read_text())
    shared = len(before) - 1  # the last one may be after the last saved state
    assert after[:shared] == before[:shared] and after[-1][0] > before[-1][0]
    assert (
        tmp_path / "mine.adapt" / "scans" / "train" / "000000.npz"
    ).stat().st_mtime_ns == prepared
    assert load_generator(out).sensor == load_generator(adapted).sensor
    with pytest.raises(ConfigError, match="which exists"):
        adapt(model, scans, out)


def test_a_dry_run_prints_the_plan_and_writes_nothing(
    model: Path, scans: Path, tmp_path: Path
) -> None:
    out = tmp_path / "mine.safetensors"
    text = call(
        "adapt", model, "--scans", scans, "--out", out, "--minutes", "60", "--dry-run"
    )
    for part in (
        "own: 16 x 120, as 16 x 128 cells",
        "10 scans to train on, 1 left out, 3 held out",
        "flow_town",
    ):
        assert part in text, part
    assert sum(
        float(line.split()[1]) for line in text.splitlines() if line.startswith("  ")
    ) == pytest.approx(60, 0.01)
    assert list(tmp_path.iterdir()) == []
    start = load_checkpoint(model)
    known = replace(start.header, other_grids=((1.0, 0.5, 0.2, 0.0), (1.0, 0.0)))
    several = tmp_path / "several.safetensors"
    save_checkpoint(several, known, start.networks)
    assert (
        "a student of 2 steps: the times of 3 and 1 steps, which several knows, are lost"
        in str(plan_adaptation(several, scans, out))
    )


@pytest.mark.parametrize("steps", [3, 50])
def test_a_model_of_many_steps_is_given_the_times_of_a_student(
    model: Path, tmp_path: Path, steps: int
) -> None:
    header = replace(load_checkpoint(model).header, time_grid=uniform_grid(steps))
    prepared = Prepared(tmp_path, True, (), (), Recordings())
    work = Work(tmp_path, header, prepared, "MIT", 0, stages_for(header, True, 0), {})
    made = work.config("student", model)
    assert isinstance(made, DistillConfig)
    if steps == 3:
        assert (made.grid, made.intervals) == (header.time_grid, 3)
    else:
        assert (made.grid, made.intervals) == (None, 4)  # they are selected


@pytest.mark.slow
def test_a_pixel_model_is_adapted_too(own_scans: list[Scan], tmp_path: Path) -> None:
    path = write_pixel_model(tmp_path / "pixel.safetensors")
    own = replace(
        OWN, elevations=OWN.elevations[::2] if OWN.elevations else None, columns=40
    )
    folder = write(tmp_path / "scans", of_town(own, 12))
    out = adapt(
        path,
        folder,
        tmp_path / "mine.safetensors",
        minutes=0.02,
        town=0,
        overrides=QUICK,
        progress=False,
    )
    assert load_generator(out).sensor.shape == (8, 40)
    assert not (tmp_path / "mine.adapt" / "codec").exists()


def broken(own: list[Scan], kind: str) -> list[Scan]:
    """The scans with one fault."""
    if kind == "few":
        return own[:11]
    if kind == "sensors":
        other = of_town(TINY, 1)[0]
        return [*own[:5], other, *own[5:]]
    if kind == "points":  # of another sensor under the same name
        up = own[5].points * np.array([1, 1, -1], np.float32)
        return [*own[:5], replace(own[5], points=up), *own[6:]]
    if kind == "some labels":
        return [*own[:5], replace(own[5], label=None, raw_label=None), *own[6:]]
    return [
        replace(scan, label=np.full(len(scan), IGNORE, np.uint8), raw_label=None)
        for scan in own
    ]


@pytest.mark.parametrize(
    ("kind", "message"),
    {
        "few": "11 scans; expected at least 12",
        "sensors": "expected scans of one sensor",
        "points": "expected scans of one sensor",
        "some labels": "some scans have labels, some have none",
        "no class": "labels for 0% of its points; expected labels of the dataset's own table",
    }.items(),
)
def test_scans_that_cannot_be_learnt_from_are_refused(
    kind: str, message: str, model: Path, own_scans: list[Scan], tmp_path: Path
) -> None:
    folder = write(tmp_path / "scans", broken(own_scans, kind))
    with pytest.raises(DataError, match=message):
        adapt(model, folder, tmp_path / "mine.safetensors", progress=False)
    assert not (tmp_path / "mine.safetensors").exists()


def test_a_folder_without_scans_is_refused(model: Path, tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "notes.txt").write_text("nothing")
    with pytest.raises(DataError, match="no scan in a layout that is known"):
        adapt(model, tmp_path / "scans", tmp_path / "mine.safetensors")


@pytest.mark.parametrize(
    ("name", "message"),
    {
        "town-layout": "the condition layout; expected an unconditional model, or the condition "
        "semantic",
        "nothing": "model 'nothing'; expected a shipped one",
    }.items(),
)
def test_models_that_cannot_be_adapted_are_refused(
    name: str, message: str, scans: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        adapt(name, scans, tmp_path / "mine.safetensors")


def test_values_for_a_stage_that_is_not_there_are_refused(
    model: Path, own_scans: list[Scan], tmp_path: Path
) -> None:
    folder = write(tmp_path / "scans", own_scans)
    with pytest.raises(ConfigError, match=r"stage 'flw'.*Did you mean 'flow'"):
        adapt(model, folder, tmp_path / "mine.safetensors", overrides={"flw": {}})


def test_a_model_of_another_architecture_is_refused() -> None:
    header = read_header(find_model("town"))[0]
    other = header.networks["velocity"]._replace(architecture="unet")
    with pytest.raises(
        ConfigError, match="architecture unet; expected architectures among surf"
    ):
        check_movable(replace(header, networks=header.networks | {"velocity": other}))


def test_a_resumed_adaptation_has_the_same_scans_and_model(
    model: Path, scans: Path, tmp_path: Path
) -> None:
    out = tmp_path / "mine.safetensors"
    (tmp_path / "mine.adapt").mkdir()
    (tmp_path / "mine.adapt" / "adapt.json").write_text(
        json.dumps({"model": "another"})
    )
    with pytest.raises(ConfigError, match="mine.adapt was filled with"):
        adapt(model, scans, out)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"elevations": OWN.elevations[:12] if OWN.elevations else None},
            "12 rows; expected a multiple of 8",
        ),
        ({"range_min": 90.0}, "expected some of 1.45 to 80.0 m"),
    ],
)
def test_sensors_that_the_networks_cannot_have_are_refused(
    changed: Any, message: str, model: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        fit_grid(replace(OWN, **changed), read_header(model)[0])


def test_a_model_that_is_moved_to_its_own_sensor_stays_the_same(model: Path) -> None:
    held = load_checkpoint(model)
    several = replace(held.header, other_grids=((1.0, 0.0),))
    matched = replace(several, matches={"1": [[[1.1]], [[0.0]]]})
    header, networks = regrid(held._replace(header=matched), TINY)
    assert header == several  # moments are those of the model's own rows
    for name, network in networks.items():
        for key, value in network.state_dict().items():
            torch.testing.assert_close(
                value, held.networks[name].state_dict()[key], msg=key
            )


def test_biases_of_rows_follow_the_elevation_and_positions_wrap_around(
    model: Path,
) -> None:
    held = load_checkpoint(model)
    codec = held.networks[CODEC]
    flow = held.networks[VELOCITY]
    rows = torch.from_numpy(TINY.row_elevations().reshape(8, 2).mean(1))
    with torch.no_grad():
        codec.place_stem[:] = rows.view(1, 1, -1, 1)
        flow.position.table[:] = torch.cos(torch.arange(8) / 8 * 2 * torch.pi)[
            None, :, None
        ]
    wider = replace(OWN, columns=256)
    moved = regrid(Checkpoint(held.header, held.networks, ""), wider)[1]
    wanted = (
        OWN.row_elevations()
        .reshape(8, 2)
        .mean(1)
        .clip(float(rows.min()), float(rows.max()))
    )
    np.testing.assert_allclose(
        moved[CODEC].place_stem[0, 0, :, 0].detach(), wanted, atol=1e-5
    )
    table = moved[VELOCITY].position.table[0, :, 0].detach()
    assert table.shape == (16,)
    torch.testing.assert_close(
        table[0],
        0.75 * flow.position.table[0, 0, 0] + 0.25 * flow.position.table[0, -1, 0],
    )


def test_the_shipped_dense_model_can_be_moved() -> None:
    header = read_header(find_model("town"))[0]
    assert all(part.architecture in PLACED for part in header.networks.values())
    assert fit_grid(load_sensor("pandar64"), header).shape == (64, 1792)


def test_a_sensor_file_is_taken(model: Path, scans: Path, tmp_path: Path) -> None:
    path = tmp_path / "named.yaml"
    path.write_text(sensor_yaml(replace(OWN, name="named")))
    assert yaml.safe_load(path.read_text())["named"]["columns"] == 120
    text = call(
        "adapt",
        model,
        "--scans",
        scans,
        "--out",
        tmp_path / "x.safetensors",
        "--sensor",
        path,
        "--dry-run",
    )
    assert "sensor named: 16 x 120" in text
