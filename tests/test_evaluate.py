"""``lidar-synth evaluate`` on scans on disk."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from banks import some_image, write_bank
from click.testing import Result
from conftest import random_scan
from layouts import some_scan, write_all
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.datasets.recordings import (
    FILES,
    KITTI360_SPLITS,
    NOTE,
    Recordings,
    all_frames,
    frames_of,
    seen_by,
)
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.semantic_kitti import SPLITS
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.geometry.scan import SYNTHETIC
from lidar_synth.geometry.sensor import Sensor, presets
from lidar_synth.lab.evaluate import PROTOCOLS, Metric, evaluate
from lidar_synth.lab.evaluate.leakage import measured, overlap, recordings_of, town
from lidar_synth.lab.importers import lidm
from lidar_synth.lab.town.export import SETTINGS


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("sets")
    for first, name in ((0, "real"), (10, "fake")):
        for i in range(3):
            WRITERS["npz"](root / name).write(
                random_scan(presets()["town"], 4000, seed=first + i), i
            )
    return root / "real", root / "fake"


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_figure_names_its_protocol_and_its_sets(
    folders: tuple[Path, Path], protocol: str
) -> None:
    real, fake = map(str, folders)
    options = ["--protocol", protocol, "--anyway"]
    result = CliRunner().invoke(app, ["evaluate", real, fake, *options, "--json"])
    assert result.exception is None, result.output
    apart = json.loads(result.stdout)
    assert apart and all(
        (s["protocol"], s["real"], s["generated"]) == (protocol, 3, 3) for s in apart
    )
    same = json.loads(
        CliRunner().invoke(app, ["evaluate", real, real, *options, "--json"]).stdout
    )
    assert [s["metric"] for s in same] == [s["metric"] for s in apart]
    assert sum(s["value"] for s in same) < sum(s["value"] for s in apart)
    text = CliRunner().invoke(app, ["evaluate", real, fake, *options]).output
    assert f"({protocol} protocol, 3 real, 3 generated)" in text


def test_the_intervals_of_few_scans_are_json(folders: tuple[Path, Path]) -> None:
    """A resample may hold copies of one scan only, of which some figures have no value."""
    call = [
        "evaluate",
        *map(str, folders),
        "--protocol",
        "town",
        "--segmenter",
        "--extended",
        "--intervals",
        "50",
    ]
    result = CliRunner().invoke(app, [*call, "--json"])
    assert result.exception is None, result.output
    assert "NaN" not in result.stdout and any(
        s["low"] is not None for s in json.loads(result.stdout)
    )


@pytest.mark.parametrize(
    "protocol", [name for name, p in PROTOCOLS.items() if p.needs.generated]
)
def test_fewer_scans_than_the_papers_are_refused(
    folders: tuple[Path, Path], protocol: str
) -> None:
    result = CliRunner().invoke(
        app, ["evaluate", *map(str, folders), "--protocol", protocol]
    )
    assert isinstance(result.exception, DataError)
    message = rf"3 (real|generated) scans; expected \d+000?, as the {protocol} protocol .*--anyway"
    assert re.search(message, str(result.exception))


def test_the_figures_stand_beside_the_published_ones(
    folders: tuple[Path, Path],
) -> None:
    call = [
        "evaluate",
        *map(str, folders),
        "--protocol",
        "r2flow",
        "--anyway",
        "--beside",
        "--intervals",
        "20",
    ]
    result = CliRunner().invoke(app, call)
    assert result.exception is None, result.output
    rows = [line for line in result.stdout.splitlines() if line.startswith("|")]
    assert (
        "| LiDAR-Flow | 4 | 165.31 | 12.41 | 9.46 | 32.09 | 33.43 | 0.025 | 0.34 |"
        in rows
    )
    own = rows[-1].split("|")
    jsd = re.search(r"in its tables JSD = (\S+)", result.stdout)
    assert (
        jsd
        and own[1].strip() == "**these scans** (3 real, 3 generated)"
        and own[8].split()[0] == jsd[1]
    )
    # an interval; no weights, no FRD
    assert own[8].strip().endswith("]") and not own[3].strip()
    assert "FRD: no weights of rangenet53" in result.stderr
    assert "those of training among them" in result.stderr
    for more in (["--json"], ["--judge", "squeezeseg"]):
        refused = CliRunner().invoke(app, [*call, *more])
        assert refused.exit_code == 2 and "--beside" in refused.stderr


def test_the_options_of_reading_are_of_both_sets_where_these_need_them(
    tmp_path: Path,
) -> None:
    scan = random_scan(presets()["town"], 1500)
    bright = np.column_stack([scan.points, scan.reflectance * 255]).astype(np.float32)
    for name in ("real", "fake"):
        (tmp_path / name).mkdir()
        bright.tofile(tmp_path / name / "0.bin")
    WRITERS["npz"](tmp_path / "plain").write(scan, 0)
    options = ["--protocol", "town", "--anyway", "--sensor", "town", "--json"]
    found = []
    for fake in ("fake", "plain"):
        call = ["evaluate", str(tmp_path / "real"), str(tmp_path / fake), *options]
        result = CliRunner().invoke(app, [*call, "--reflectance-max", "255"])
        assert result.exit_code == 0, result.exception
        found.append(json.loads(result.stdout))
    assert found[0] == found[1]


def test_damage_of_the_second_set_is_not_hidden_by_options_of_the_first(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    scan = random_scan(presets()["town"], 1500)
    np.column_stack([scan.points, scan.reflectance]).astype(np.float32).tofile(
        tmp_path / "0.bin"
    )
    write_bank(tmp_path / "bank", [some_image(1, presets()["town"])])
    (shard,) = (tmp_path / "bank").glob("shard-*.h5")
    shard.write_bytes(b"x" * shard.stat().st_size)
    options = ["--protocol", "town", "--sensor", "town", "--reflectance-max", "1"]
    call = ["evaluate", str(tmp_path / "0.bin"), str(tmp_path / "bank"), *options]
    assert "lidar-synth repair" in str(CliRunner().invoke(app, call).exception)


def test_scans_of_both_sets_are_skipped(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    shutil.copytree(folders[1], tmp_path / "fake")
    (tmp_path / "fake" / "000002.npz").write_bytes(b"PK")
    call = ["evaluate", str(folders[0]), str(tmp_path / "fake"), "--protocol", "town"]
    skipping = CliRunner().invoke(app, [*call, "--on-bad", "skip", "--json"])
    assert skipping.exception is None, skipping.exception
    (tmp_path / "fake" / "000002.npz").unlink()
    without = CliRunner().invoke(app, [*call, "--json"])
    assert json.loads(skipping.stdout) == json.loads(without.stdout)


def test_a_measure_without_a_place_in_a_table_is_left_out_by_its_title(
    folders: tuple[Path, Path],
) -> None:
    result = CliRunner().invoke(
        app, ["evaluate", *map(str, folders), "--protocol", "spiral", "--anyway"]
    )
    assert (
        "Frechet distance of range features and class shares: no weights of rangenet53"
        in result.stderr
    )


@pytest.mark.parametrize("protocol", ["r2flow", "town"])
def test_another_sensor_is_refused(
    folders: tuple[Path, Path], tmp_path: Path, protocol: str
) -> None:
    WRITERS["npz"](tmp_path / "other").write(
        random_scan(presets()["hdl32e_nuscenes"], 4000), 0
    )
    call = [
        "evaluate",
        str(folders[0]),
        str(tmp_path / "other"),
        "--protocol",
        protocol,
    ]
    result = CliRunner().invoke(app, [*call, "--anyway"])
    assert result.exception is None, result.output
    with pytest.raises(
        DataError,
        match=r"scan .* of sensor hdl32e_nuscenes \(32 rows.*expected .*64 rows",
    ):
        metric = Metric(protocol)
        metric.update(open_scans(call[1]), real=True)
        metric.update(open_scans(call[2]), real=False)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("--protocol town --columns 512", "--columns: goes with --judge"),
        ("--objects --weights w", "--weights: goes with --protocol"),
        ("--judge j --intervals 50", "--intervals: goes with --protocol"),
        ("--detector d --cache c", "--cache: goes with --protocol"),
        ("--judge j --anyway", "--anyway: goes with --protocol"),
    ],
)
def test_options_of_another_comparison_are_a_wrong_call(
    folders: tuple[Path, Path], call: str, message: str
) -> None:
    result = CliRunner().invoke(app, ["evaluate", *map(str, folders), *call.split()])
    assert result.exit_code == 2 and message in result.stderr


def test_an_unknown_protocol_is_a_wrong_call(folders: tuple[Path, Path]) -> None:
    result = CliRunner().invoke(
        app, ["evaluate", *map(str, folders), "--protocol", "frid"]
    )
    error = result.exception  # exit status 2
    assert isinstance(error, ConfigError) and "--protocol 'frid'" in str(error)


def trained_on(folder: Path, seen: Recordings) -> None:
    note = {"seed": 0, "trained_on": "?", "seen": seen.to_list()}
    (folder / NOTE).write_text(json.dumps(note))


@pytest.mark.parametrize("same", [True, False])
def test_training_data_is_refused_as_reference(
    folders: tuple[Path, Path], tmp_path: Path, same: bool
) -> None:
    real, fake = (shutil.copytree(folder, tmp_path / folder.name) for folder in folders)
    call = ["evaluate", str(real), str(fake), "--protocol", "town", "--json"]
    path = f"{real.parent}/../{tmp_path.name}/real"
    trained_on(fake, all_frames(FILES, [path if same else f"{path}#train"]))
    by_path = CliRunner().invoke(app, call)
    trained_on(fake, town(5))
    (real / SETTINGS).write_text(json.dumps({"seed": 5 if same else 6}))
    by_town = CliRunner().invoke(app, call)
    for result in (by_path, by_town):
        if same:
            assert isinstance(result.exception, ConfigError), result.output
            assert "not trained on" in str(result.exception)
        else:
            assert result.exception is None, result.output
    assert CliRunner().invoke(app, [*call, "--training-data"]).exit_code == 0


# --- sets of drives and frames, whatever their names
# --------------------------------------------------------------


KITTI_360 = presets()["hdl64e_kitti360"]
DRIVE = "2013_05_28_drive_{:04d}_sync/{:010d}"


@pytest.fixture(scope="module")
def kitti360(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans of each of three drives."""
    root = tmp_path_factory.mktemp("kitti360")
    writer = WRITERS["kitti360"](root)
    for drive in (0, 2, 3):
        for frame in (5, 6):
            writer.write(
                random_scan(KITTI_360, 2000, seed=drive + frame),
                frame,
                name=DRIVE.format(drive, frame),
            )
    writer.finish()
    return root


@pytest.fixture(scope="module")
def odometry(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("semantic_kitti")
    writer = WRITERS["semantic_kitti"](root)
    for sequence in ("00", "08"):
        writer.write(
            random_scan(presets()["hdl64e_semantic_kitti"], 2000),
            0,
            name=f"{sequence}/000003",
        )
    writer.finish()
    return root


@pytest.fixture
def fake(folders: tuple[Path, Path], tmp_path: Path) -> Path:
    return shutil.copytree(folders[1], tmp_path / "fake")


def judge(real: Path, fake: Path, *options: str) -> Result:
    return CliRunner().invoke(
        app,
        ["evaluate", str(real), str(fake), "--protocol", "town", "--json", *options],
    )


def refused(result: Result) -> str | None:
    """The message, or None where the two were compared."""
    if result.exception is None:
        return None
    assert isinstance(result.exception, ConfigError), result.exception
    return str(result.exception)


def of_splits(*splits: str) -> dict[str, Any]:
    """The provenance of a model that was trained on splits of KITTI-360."""
    seen = Recordings()
    for split in splits:
        seen |= frames_of("kitti360", KITTI360_SPLITS[split] or ())
    return {"data": "?", "seen": seen.to_list()}


TRAINED: dict[str, dict[str, Any]] = {
    "own lidm/train": of_splits("lidm/train"),
    "own r2flow/train": of_splits("r2flow/train"),
    "own SemanticKITTI": {
        "seen": frames_of("semantic_kitti", SPLITS["train"]).to_list()
    },
    "imported LiDM": {"seen": lidm.seen("KITTI-360", generates=True).to_list()},
    "imported LiDM of maps": {
        "seen": lidm.seen("SemanticKITTI", generates=True).to_list()
    },
}
"""Provenances of models."""


@pytest.mark.parametrize(
    ("model", "split", "shared"),
    [
        ("own lidm/train", "r2flow/test", ["0000", "0002"]),
        ("own lidm/train", "lidm/val", []),
        ("own r2flow/train", "r2flow/test", []),
        ("own r2flow/train", "lidm/val", ["0003"]),
        ("own r2flow/train", "r2flow/train", ["0003"]),
        ("own r2flow/train", "lidm/train", []),  # it has drives 00 and 02 of it here
        ("imported LiDM", "r2flow/test", ["0000", "0002"]),
        ("imported LiDM", "lidm/val", []),
        ("imported LiDM of maps", "r2flow/test", ["0000", "0002"]),  # its autoencoder's
    ],
)
def test_overlapping_drives_are_refused(
    model: str, split: str, shared: list[str], kitti360: Path, fake: Path
) -> None:
    trained_on(fake, seen_by(TRAINED[model]))
    message = refused(judge(kitti360, fake, "--split", split))
    if not shared:
        assert message is None
        return
    assert message is not None
    assert all(
        f"KITTI-360 2013_05_28_drive_{drive}_sync" in message for drive in shared
    )
    assert "not trained on" in message
    assert refused(judge(kitti360, fake, "--split", split, "--training-data")) is None


@pytest.mark.parametrize("parent", ["teacher", "weaker", "init", "codec"])
@pytest.mark.parametrize("model", TRAINED)
def test_training_data_of_parent_checkpoints_counts(model: str, parent: str) -> None:
    own = {"seen": town(1).to_list()}
    child = own | {
        f"{parent}_provenance": {"data": "?", "init_provenance": TRAINED[model]}
    }
    assert seen_by(TRAINED[model])
    assert seen_by(child) == seen_by(own) | seen_by(TRAINED[model])


def test_sequences_are_parts_of_raw_drives(odometry: Path, fake: Path) -> None:
    def trained(ids: list[str]) -> None:
        trained_on(fake, frames_of("kitti_raw", ids))

    trained(["2011_09_30_drive_0028_sync/0000001103"])
    assert "KITTI 2011_09_30_drive_0028 (frame 1103)" in str(
        refused(judge(odometry, fake, "--split", "val"))
    )
    trained(
        [
            "2011_09_30_drive_0028_sync/0000000003",
            "2011_10_03_drive_0027_sync/0000000003",
        ]
    )
    assert refused(judge(odometry, fake, "--split", "val")) is None
    assert "2011_10_03_drive_0027 (frame 3)" in str(refused(judge(odometry, fake)))
    trained_on(fake, seen_by(TRAINED["imported LiDM"]))
    assert refused(judge(odometry, fake, "--split", "val")) is None
    assert refused(judge(odometry, fake, "--split", "train")) is not None


def test_an_exported_town_is_not_the_dataset_whose_layout_it_has(
    kitti360: Path, fake: Path, tmp_path: Path
) -> None:
    exported = shutil.copytree(kitti360, tmp_path / "town")
    (exported / SETTINGS).write_text(json.dumps({"seed": 4}))
    trained_on(fake, seen_by(TRAINED["own lidm/train"]))
    assert refused(judge(exported, fake)) is None
    trained_on(fake, town(4))
    assert "town seed 4 (all frames)" in str(refused(judge(exported, fake)))


def test_unknown_training_data_is_reported(kitti360: Path, fake: Path) -> None:
    (fake / NOTE).write_text(json.dumps({"trained_on": "KITTI raw"}))
    result = judge(kitti360, fake)
    assert result.exception is None
    assert "does not record its model's training data" in result.stderr
    (fake / NOTE).write_text(
        json.dumps(
            {"seen": [{"dataset": "KITTI object", "drives": {"training": None}}]}
        )
    )
    assert (
        "whether the two sets share frames is not known"
        not in judge(kitti360, fake).stderr
    )


def test_kittis_object_set_may_share_frames_with_raw_drives(
    odometry: Path, fake: Path
) -> None:
    (fake / NOTE).write_text(
        json.dumps(
            {"seen": [{"dataset": "KITTI object", "drives": {"training": None}}]}
        )
    )
    assert (
        "whether the two sets share frames is not known" in judge(odometry, fake).stderr
    )


def test_a_bank_records_the_training_data_of_its_model(
    kitti360: Path, tmp_path: Path
) -> None:
    bank = tmp_path / "bank"
    write_bank(
        bank, [some_image(i) for i in range(2)], provenance=TRAINED["own lidm/train"]
    )
    assert "2013_05_28_drive_0002_sync" in str(
        refused(judge(kitti360, bank, "--split", "r2flow/test"))
    )


@pytest.mark.slow
def test_a_run_records_the_frames_that_it_saw(
    kitti360: Path, fake: Path, tmp_path: Path
) -> None:
    """Its own and its start's; other frames of the same drive are not refused."""
    sensor = Sensor(
        "small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0
    ).to_dict()
    (tmp_path / "sensor.yaml").write_text(yaml.safe_dump({sensor.pop("name"): sensor}))
    network = {
        "width": 16,
        "time_width": 16,
        "depths": [1],
        "heads": [2],
        "patch": [2, 2],
        "window": [3, 3],
    }
    values = {
        "output": str(tmp_path / "first"),
        "licence": "MIT",
        "sensor": str(tmp_path / "sensor.yaml"),
        "data": {"licence": "none", "path": str(kitti360), "split": "r2flow/train"},
        "network": {"arguments": network},
        "recipe": {"iterations": 1, "batch": 2},
        "samples": {"every": 0},
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(values))
    assert (
        CliRunner().invoke(app, ["train", str(tmp_path / "config.yaml")]).exception
        is None
    )
    first = tmp_path / "first" / "first.safetensors"
    drive = "2013_05_28_drive_0003_sync"
    provenance = read_header(first)[0].provenance
    assert provenance["seen"] == [{"dataset": "KITTI-360", "drives": {drive: [[5, 6]]}}]
    town = [
        "data={town: 2, seed: 9, licence: MIT}",
        f"init={first}",
        f"output={tmp_path / 'second'}",
    ]
    assert (
        CliRunner()
        .invoke(app, ["train", str(tmp_path / "config.yaml"), *town])
        .exception
        is None
    )
    second = read_header(tmp_path / "second" / "second.safetensors")[0].provenance
    assert second["seen"] == [
        *provenance["seen"],
        {"dataset": "town", "drives": {"seed 9": None}},
    ]
    scans = tmp_path / "scans"
    made = CliRunner().invoke(
        app,
        [
            "sample",
            str(scans),
            "--model",
            str(tmp_path / "second" / "second.safetensors"),
            "--count",
            "1",
        ],
    )
    assert made.exception is None, made.output
    note = json.loads((scans / NOTE).read_text())
    assert note["seen"] == second["seen"]
    assert f"KITTI-360 {drive} (2 frames from 5 to 6)" in str(
        refused(judge(kitti360, scans, "--split", "lidm/val"))
    )
    later = tmp_path / "later"
    writer = WRITERS["kitti360"](later)
    writer.write(random_scan(KITTI_360, 2000), 0, name=DRIVE.format(3, 7))
    writer.finish()
    (fake / NOTE).write_text((scans / NOTE).read_text())
    assert refused(judge(later, fake, "--split", "lidm/val")) is None


def test_a_town_is_recognised_in_every_format(tmp_path: Path) -> None:
    made = {"made_by": "town", "seed": 9, "interval": 0.4}
    for to in ("kitti", "npz", "range"):
        write_all(
            to, tmp_path / to, [replace(some_scan(), domain=SYNTHETIC, provenance=made)]
        )
        assert recordings_of(
            open_scans(tmp_path / to), "folder", tmp_path / to
        ) == town(9)


# --- every pair of named splits
# -----------------------------------------------------------------------------------

DRIVES = {
    "r2flow/train": {3, 4, 5, 6, 7, 9, 10},
    "r2flow/test": {0, 2},
    "lidm/train": {0, 2, 4, 5, 6, 7, 8, 9, 10},
    "lidm/val": {3},
    "lidm-camera/train": {0, 4, 5, 6, 7, 8, 9, 10},
    "lidm-camera/val": {3},
    "all": {0, 2, 3, 4, 5, 6, 7, 8, 9, 10},
}
"""As R2Flow's and LiDM's public code list them; KITTI-360 has no drive 1."""

MODELS: dict[str, tuple[dict[str, Any], set[int]]] = {
    **{f"own {s}": (of_splits(s), d) for s, d in DRIVES.items() if s != "all"},
    "imported LiDM": (TRAINED["imported LiDM"], DRIVES["lidm/train"]),
    "imported LiDM of maps": (TRAINED["imported LiDM of maps"], DRIVES["lidm/train"]),
    "R2Flow adapted to the town": (
        {"seen": town(1).to_list(), "init_provenance": TRAINED["own r2flow/train"]},
        DRIVES["r2flow/train"],
    ),
    "student of an adapted LiDM": (
        {
            "seen": town(1).to_list(),
            "teacher_provenance": {
                "seen": town(2).to_list(),
                "init_provenance": TRAINED["imported LiDM"],
            },
        },
        DRIVES["lidm/train"],
    ),
}


@pytest.fixture(scope="module")
def all_drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One scan of every drive of KITTI-360."""
    root = tmp_path_factory.mktemp("all_drives")
    writer = WRITERS["kitti360"](root)
    for drive in sorted(DRIVES["all"]):
        writer.write(
            random_scan(KITTI_360, 500, seed=drive), drive, name=DRIVE.format(drive, 5)
        )
    writer.finish()
    return root


@pytest.mark.parametrize("split", DRIVES)
@pytest.mark.parametrize("model", MODELS)
def test_every_overlap_of_named_splits_is_found(
    model: str, split: str, all_drives: Path
) -> None:
    provenance, seen = MODELS[model]
    reference = measured(
        open_scans(all_drives, split=split), "kitti360", all_drives, split
    )
    shared = {
        int(drive.split("_")[4])
        for dataset, drive in overlap(seen_by(provenance), reference).drives
        if dataset == "KITTI-360"
    }
    assert shared == seen & DRIVES[split]


@pytest.mark.parametrize(
    "protocol",
    [name for name, p in PROTOCOLS.items() if p.reference and p.reference.training],
)
def test_each_protocols_reference_is_apart_from_its_training_data(
    protocol: str,
) -> None:
    reference = PROTOCOLS[protocol].reference
    assert reference is not None and reference.training is not None
    if reference.layout == "kitti360":
        shared = DRIVES[reference.training] & DRIVES[reference.split]
        # whose code compares with all drives
        assert bool(shared) == (protocol == "r2flow")
        assert "training" in PROTOCOLS[protocol].unverified or not shared


def test_python_refuses_what_the_command_refuses(kitti360: Path, fake: Path) -> None:
    trained_on(fake, seen_by(TRAINED["own lidm/train"]))
    sets = open_scans(kitti360, split="r2flow/test"), open_scans(fake)
    with pytest.raises(ConfigError, match="was trained on .*training_data=True"):
        evaluate(*sets, "r2flow", anyway=True, progress=False)
    with pytest.raises(DataError, match="as the r2flow protocol compares.*anyway=True"):
        evaluate(*sets, "r2flow", training_data=True, progress=False)
    scores = evaluate(*sets, "r2flow", anyway=True, training_data=True, progress=False)
    assert [score.table for score in scores[:2]] == ["JSD", "MMD"]
    (fake / NOTE).write_text(json.dumps({"trained_on": "KITTI raw"}))
    with pytest.warns(UserWarning, match="does not record its model's training data"):
        evaluate(*sets, "r2flow", anyway=True, progress=False)
