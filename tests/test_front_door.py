"""``start``: from a folder of scans to a mixture; and the configurations of trainers."""

import ast
import importlib
import json
import os
import pickle
import re
import runpy
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from layouts import MAKERS
from logs import LOGS, ouster, write_log
from proofs import TOWN_SENSOR
from typer.testing import CliRunner

import lidar_synth
from lidar_synth.bank import Bank
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.recipes import folder, published, read_recipe
from lidar_synth.lab.proof.page import write_body
from lidar_synth.lab.start.look import look
from lidar_synth.lab.start.trainers import DEFAULTS, TRAINERS, configure, write_files
from lidar_synth.lab.town import export_town
from lidar_synth.mixing.settings import OPTIONS, read_settings

TASKS = {
    "bank": "segmentation",
    "kitti360": "segmentation",
    "semantic_kitti": "segmentation",
    "kitti_object": "detection",
    "folder": "segmentation",
    "range": "segmentation",
    "png": "segmentation",
    "webdataset": "segmentation",
    "mcap": "segmentation",
    "cosmos": "unlabelled",
    "nuscenes": "segmentation",
    "py123d": "segmentation",
    "pandaset": "segmentation",
    "kitti_raw": "detection",
}


@pytest.mark.parametrize("layout", MAKERS)
def test_what_lies_in_a_folder_of_each_layout(layout: str, tmp_path: Path) -> None:
    MAKERS[layout](tmp_path / "scans")
    found = look(tmp_path / "scans", None, tmp_path / "sensor.yaml", {})
    assert (found.layout, found.task, found.fit) == (layout, TASKS[layout], None)
    assert found.lines()[0].startswith(f"scans    3 of layout {layout}")


def test_scans_of_which_some_have_labels_are_those_of_the_training_split(
    tmp_path: Path,
) -> None:
    MAKERS["semantic_kitti"](tmp_path / "scans")
    sequences = tmp_path / "scans" / "sequences"
    [labelled] = sequences.iterdir()
    shutil.copytree(labelled, sequences / "11", ignore=shutil.ignore_patterns("labels"))
    given = {"scans": 1, "minutes": 0, "jobs": 1, "trainer": "lightning"}
    made = lidar_synth.start(tmp_path / "scans", tmp_path / "out", **given)
    assert made is not None
    assert "3 of layout semantic_kitti, split train, in one" in made.found[0]
    assert "in 3 of 3 scans" in made.found[1] and "split='train'" in made.code
    assert "split='train'" in made.files[tmp_path / "out" / "train.py"]
    labelled.rename(sequences / "30")  # of no split
    found = look(tmp_path / "scans", None, tmp_path / "none.yaml", {})
    assert (found.labelled, found.looked, found.task) == (3, 6, "unlabelled")
    with pytest.raises(ConfigError, match="labels, which 3 of 6 scans looked at have"):
        lidar_synth.start(tmp_path / "scans", tmp_path / "new", task="segmentation")


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of an Ouster without labels, whose folder names no sensor."""
    root = tmp_path_factory.mktemp("logs")
    town = lidar_synth.Town(3, "os1_128", scans=4)
    for index in range(4):
        write_log(root / f"{index:06d}.pcd", ouster(town[index]))
    return root


def test_a_scan_that_is_skipped_is_no_other_one(tmp_path: Path) -> None:
    MAKERS["semantic_kitti"](tmp_path)
    first, *others = sorted(tmp_path.rglob("*.bin"))
    first.write_bytes(b"damaged")
    skipped = pytest.warns(UserWarning, match="skipped scan")
    with skipped:
        found = look(tmp_path, None, tmp_path / "none.yaml", {"on_bad": "skip"})
    assert found.looked == found.labelled == len(others)
    for path in others:
        path.write_bytes(b"damaged")
    with skipped, pytest.raises(DataError, match="none of the 3 scans"):
        look(tmp_path, None, tmp_path / "none.yaml", {"on_bad": "skip"})


@pytest.mark.parametrize("vendor", LOGS)
def test_the_sensor_of_a_vendors_logs_is_fitted(vendor: str, tmp_path: Path) -> None:
    sensor, columns = LOGS[vendor]
    town = lidar_synth.Town(3, sensor, scans=4)
    for index in range(4):
        write_log(tmp_path / f"{index:06d}.pcd", columns(town[index]))
    found = look(tmp_path, None, tmp_path / "none.yaml", {})
    assert found.fit is not None and found.task == "unlabelled"
    assert found.source.sensor.shape[0] == lidar_synth.load_sensor(sensor).shape[0]


class _Mean(torch.nn.Module):
    """A network that normalises the heights of a batch."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = torch.nn.BatchNorm1d(1)

    def forward(self, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        heights: torch.Tensor = self.norm(batch["points"][:, 2:3])
        return heights


@pytest.mark.slow
def test_from_logs_without_labels_to_a_mixture(logs: Path, tmp_path: Path) -> None:
    out = tmp_path / "start"
    said: list[str] = []
    made = lidar_synth.start(logs, out, scans=2, jobs=1, say=said.append)
    assert made is not None
    assert "labels   none" in made.found[1] and "fitted to 4 scans" in made.found[3]
    assert said[0].splitlines() == list(made.found) and len(made.found) == 5
    assert len(made.code.splitlines()) == 8
    network = _Mean()
    batches: list[dict[str, np.ndarray]] = []
    short = made.code.replace("range(40)", "range(1)").replace(
        "...", "batches.append(batch)"
    )
    names: dict[str, Any] = {"batches": batches, "network": network}
    exec(short, names)
    synthetic = np.concatenate([batch["domain"] for batch in batches])
    assert set(synthetic.tolist()) == {1}
    assert all((batch["label"] != 255).any() for batch in batches)
    settled = names["network"].norm
    real = [torch.from_numpy(names["real"][i].points[:, 2]).mean() for i in range(4)]
    assert settled.running_mean.item() == pytest.approx(np.mean(real), abs=0.05)
    assert network.norm.running_mean.item() == 0
    times = {path: path.stat().st_mtime_ns for path in (out / "town").iterdir()}
    again = lidar_synth.start(logs, out, scans=2, jobs=1, say=said.append)
    assert again is not None and "as fitted" in again.found[3]
    assert again.code == made.code and again.files == made.files
    assert {p: p.stat().st_mtime_ns for p in (out / "town").iterdir()} == times


def test_a_dry_run_says_minutes_and_disk_and_writes_nothing(
    logs: Path, tmp_path: Path
) -> None:
    given = ["start", str(logs), "--out", str(tmp_path / "start"), "--dry-run"]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert re.search(r"200 synthetic scans: [\d.]+ minutes, \d+ MB", result.output)
    assert not list(tmp_path.iterdir())


def test_scans_that_may_be_skipped_are_said_not_to_be_compared(tmp_path: Path) -> None:
    MAKERS["semantic_kitti"](tmp_path / "scans")
    given = ["start", str(tmp_path / "scans"), "--on-bad", "skip", "--dry-run"]
    result = CliRunner().invoke(app, [*given, "--out", str(tmp_path / "start")])
    assert "not compared with real scans only: scans may be skipped" in result.output


@pytest.mark.slow
def test_labelled_scans_are_compared_and_mixed(tmp_path: Path) -> None:
    root = tmp_path / "scans"
    town = lidar_synth.Town(5, TOWN_SENSOR, 24)
    export_town(town, root, "semantic_kitti", camera=False, progress=False)
    for poses in root.rglob("poses.txt"):
        poses.unlink()  # with them, the streets of the town are two places
    out = tmp_path / "start"
    given = ["start", str(root), "--out", str(out), "--scans", "4", "--minutes", "2"]
    result = CliRunner().invoke(app, [*given, "--trainer", "mmdet3d"])
    assert result.exit_code == 0, result.output
    assert "| real scans only |" in result.output
    assert "| the town first, then half your scans |" not in result.output
    assert "| generated scans for a quarter, then your scans alone |" in result.output
    assert "Trained and tested on one drive" in result.output
    assert len(Bank(out / "bank")) == 4
    assert {"mix.yaml", "lists.py", "mixed.py", "loop.py"} <= {
        path.name for path in out.iterdir()
    }
    settings = read_settings(out / "mix.yaml")
    assert settings["synthetic"] == str(out / "bank")
    sensor = str(out / "sensor.yaml")
    assert settings["as_sensor"] == {"sensor": sensor, "like": str(root)}
    assert settings["ratio"] == {0: 1.0, 10: 0.0}
    assert "ratio={0: 1.0, 10: 0.0}, epoch_size=100" in (out / "loop.py").read_text()
    lidar_synth.mix(root, settings.pop("synthetic"), **settings)


def test_scans_with_boxes_get_the_town_with_boxes(tmp_path: Path) -> None:
    MAKERS["kitti_object"](tmp_path / "scans")
    points = sorted((tmp_path / "scans" / "training" / "velodyne").iterdir())[-1]
    shutil.copy(points, points.with_name("000099.bin"))  # without boxes
    given = {"scans": 1, "minutes": 0, "jobs": 1, "trainer": "lightning"}
    made = lidar_synth.start(tmp_path / "scans", tmp_path / "out", **given)
    assert made is not None and "your objects pasted" in made.found[4]
    script = made.files[tmp_path / "out" / "train.py"].partition("data = ")[0]
    assert ".with_boxes(), settings" in script and 'task="detection"' in script
    with pytest.raises(DataError, match="no box with 5 points"):
        exec(script, {})  # the random boxes hold no objects that could be pasted
    assert 'task="detection"' in made.code and ".with_boxes()" in made.code
    assert made.found[0].startswith("scans    4 ")
    assert "in 0 of 4 scans looked at" in made.found[1]
    assert "in unknown drives" in made.found[0] and "for 30 of 40" in made.found[4]
    town = lidar_synth.open_scans(tmp_path / "out" / "town")
    assert len(town) == 1 and town[0].boxes is not None and town[0].label is not None


@pytest.mark.parametrize(
    "wrong",
    [{"scans": 0}, {"scans": 2.5}, {"jobs": 0}, {"minutes": -1}, {"minutes": np.nan}],
)
def test_numbers_that_start_refuses(wrong: dict[str, Any], tmp_path: Path) -> None:
    [name] = wrong
    with pytest.raises(ConfigError, match=name):
        lidar_synth.start(tmp_path, tmp_path / "out", dry_run=True, **wrong)


def test_what_start_refuses(tmp_path: Path) -> None:
    MAKERS["semantic_kitti"](tmp_path / "scans")
    MAKERS["semantic_kitti"](tmp_path / "others")
    with pytest.raises(ConfigError, match="a folder outside of it"):
        lidar_synth.start(tmp_path / "scans", tmp_path / "scans" / "start")
    quiet = {"scans": 1, "minutes": 0, "jobs": 1, "say": lambda line: None}
    lidar_synth.start(tmp_path / "scans", tmp_path / "start", **quiet)
    with pytest.raises(ConfigError, match=r"was filled with .*scans"):
        lidar_synth.start(tmp_path / "others", tmp_path / "start", **quiet)
    with pytest.raises(ConfigError, match=r"Did you mean 'openpcdet'"):
        lidar_synth.start(tmp_path / "scans", tmp_path / "new", trainer="openpcd")
    with pytest.raises(ConfigError, match="reflectance_max.*convert .*semantic_kitti"):
        lidar_synth.start(
            tmp_path / "scans",
            tmp_path / "new",
            trainer="rangenet",
            reflectance_max=255.0,
        )
    with pytest.raises(ConfigError, match=r"--task detection for .*segmentation"):
        lidar_synth.start(tmp_path / "scans", tmp_path / "new", task="detection")
    assert not (tmp_path / "new").exists()


def test_points_of_no_rotating_sensor_need_its_name(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for index in range(3):
        points = rng.uniform(-40, 40, (4000, 4)).astype("<f4")
        points[:, 3] = 0.5
        points.tofile(tmp_path / f"{index}.bin")
    with pytest.raises(ConfigError, match=r"cannot be fitted.*--sensor NAME"):
        look(tmp_path, None, tmp_path / "none.yaml", {})


PAIRS = [(trainer, task) for trainer in TRAINERS for task in TRAINERS[trainer]]


@pytest.mark.parametrize(("trainer", "task"), PAIRS)
def test_a_trainers_files_name_what_exists(trainer: str, task: str) -> None:
    settings = {"synthetic": "/data/bank", **DEFAULTS[task], "seed": 0}
    files = configure(trainer, task, settings, "/data/MY_ROOT", "/data/HERE_TOO")
    assert set(yaml.safe_load(files["mix.yaml"])) <= set(OPTIONS)
    for name, text in files.items():
        assert not re.search(r"\b(ROOT|MIX|HERE|OPTIONS)\b", text)
        for module in re.findall(r"lidar_synth\.integrations\.(\w+)", text):
            assert (Path("integrations") / f"{module}.py").is_file()
        if not name.endswith(".py"):
            continue
        for node in ast.walk(ast.parse(text)):
            module = getattr(node, "module", None) or ""
            if isinstance(node, ast.ImportFrom) and module.startswith("lidar_synth"):
                home = importlib.import_module(module)
                assert all(hasattr(home, alias.name) for alias in node.names)
    assert any("/data/MY_ROOT" in text for text in files.values())
    assert any("/data/HERE_TOO/mix.yaml" in text for text in files.values())


ODD = 'Bob\'s "R&D" a|b\\new'


@pytest.mark.parametrize(("trainer", "task"), PAIRS)
def test_configurations_are_of_any_folder(
    trainer: str, task: str, tmp_path: Path
) -> None:
    here = tmp_path / ODD
    (here / "config").mkdir(parents=True)
    (here / "config" / "semantickitti.yaml").write_text("data_path: there")
    files = configure(trainer, task, DEFAULTS[task], f"/data/{ODD}", str(here))
    words = set()
    for name, text in files.items():
        if name.endswith(".py"):
            nodes = ast.walk(ast.parse(text))
            words |= {node.value for node in nodes if isinstance(node, ast.Constant)}
    if "train.sh" in files:
        show = """{ printf '%s\\n' "$LIDAR_SYNTH_MIX" "$@"; }"""
        script = f"python() {show}\nln() {show}\n{files['train.sh']}"
        (here / "configs").mkdir()
        for name in ("ARCH.yaml", "configs/WaffleIron-48-256__kitti.yaml"):
            (here / name).touch()  # the trainer's own
        words |= set(
            subprocess.check_output(
                ["bash", "-ec", script], cwd=here, text=True
            ).splitlines()
        )
        assert f"{here}/mix.yaml" in words
    for path in here.glob("cylinder3d.yaml"):
        words.add(yaml.safe_load(path.read_text())["data_path"])
    there = {
        "cylinder3d": f"/data/{ODD}/sequences/",
        "pointcept": f"{here}/kitti",  # the root itself is in a comment
    }
    assert there.get(trainer, f"/data/{ODD}") in words


def test_names_of_folders_may_be_no_text(tmp_path: Path) -> None:
    """Linux permits any bytes."""
    name = os.fsdecode(b"a\xff")
    write_files({"train.sh": f"cd {name}"}, tmp_path)
    assert (tmp_path / "train.sh").read_bytes() == b"cd a\xff"
    write_body(tmp_path / "index.html", name)
    assert "a?" in (tmp_path / "index.html").read_text()


def test_the_lists_of_mmdetection3d_are_written(tmp_path: Path) -> None:
    MAKERS["semantic_kitti"](tmp_path / "scans")
    sequences = tmp_path / "scans" / "sequences"
    shutil.copytree(sequences / "00", sequences / "08")
    MAKERS["bank"](tmp_path / "bank")
    settings = {"synthetic": str(tmp_path / "bank"), **DEFAULTS["segmentation"]}
    files = configure(
        "mmdet3d", "segmentation", settings, f"{tmp_path}/scans", str(tmp_path)
    )
    write_files(files, tmp_path)
    before = sorted((tmp_path / "scans").rglob("*"))
    runpy.run_path(str(tmp_path / "lists.py"))
    infos = json.loads((tmp_path / "mixed" / "infos.json").read_text())
    assert len(infos["data_list"]) > 3
    validation = pickle.loads((tmp_path / "val.pkl").read_bytes())["data_list"]
    assert {entry["sample_id"][:2] for entry in validation} == {"08"}
    assert sorted((tmp_path / "scans").rglob("*")) == before


def test_configurations_change_no_more_than_they_must(tmp_path: Path) -> None:
    """A list with a schedule is not repeated, the final test stays, and CENet's log has a name."""

    stock = SimpleNamespace(
        train_pipeline=[{}, {}, {"db_sampler": {"rate": 1.0}}],
        param_scheduler=[{"type": "CosineAnnealingLR", "begin": 32.0, "end": 80}],
    )

    def configured(trainer: str, task: str) -> dict[str, Any]:
        text = configure(trainer, task, DEFAULTS[task], "/data", "/here")["mixed.py"]
        made: dict[str, Any] = {"_base_": stock}
        exec(re.sub("^_base_ = .*$", "", text, flags=re.MULTILINE), made)
        return made

    made = configured("mmdet3d", "detection")
    dataset = made["train_dataloader"]["dataset"]
    assert dataset["times"] == 1
    assert made["train_cfg"] == {"max_epochs": 40}
    assert made["param_scheduler"][0] == {
        "type": "CosineAnnealingLR",
        "begin": 16,
        "end": 40,
    }
    sampled = dataset["dataset"]["pipeline"][2]["db_sampler"]
    assert sampled == {
        "rate": 1,
        "data_root": "/here",
        "info_path": "/here/dbinfos.pkl",
    }
    assert made["val_evaluator"] == {"ann_file": "/here/val.pkl"}
    pointcept = configured("pointcept", "segmentation")
    assert (pointcept["epoch"], pointcept["eval_epoch"]) == (40, 40)
    assert pointcept["data"]["val"] == {"data_root": "/here/kitti"}
    hooks = pointcept["hooks"]
    assert hooks[-1] == {"type": "PreciseEvaluator", "test_last": False}
    page = Path("docs/how-to/trainers/pointcept.md").read_text(encoding="utf-8")
    for hook in hooks:
        assert f'dict(type="{hook["type"]}"' in page
    files = configure("rangenet", "segmentation", DEFAULTS["segmentation"], "/d", "/h")
    assert " -n " in files["train.sh"]


def test_lightning_trains_on_the_training_split(tmp_path: Path) -> None:
    MAKERS["semantic_kitti"](tmp_path / "scans")
    sequences = tmp_path / "scans" / "sequences"
    for other in ("08", "11"):
        shutil.copytree(sequences / "00", sequences / other)
    MAKERS["bank"](tmp_path / "bank")
    MAKERS["folder"](tmp_path / "plain")
    settings = {"synthetic": str(tmp_path / "bank"), "ratio": 0.5}
    for root in ("scans", "plain"):
        given = ("lightning", "segmentation", settings, str(tmp_path / root))
        write_files(configure(*given, str(tmp_path)), tmp_path)
        made: dict[str, Any] = {}
        exec((tmp_path / "train.py").read_text().partition("data = ")[0], made)
        assert made["train"].plan(0).reals == 1
        assert len(made["train"].real[0]) == 3


def test_every_trainer_finds_the_sequences(tmp_path: Path) -> None:
    """Some of them read FOLDER/sequences, others FOLDER/dataset/sequences."""
    root = tmp_path / "kitti" / "dataset"
    (root / "sequences").mkdir(parents=True)
    for given in (root, root.parent):
        here = tmp_path / given.name
        here.mkdir(exist_ok=True)
        settings = DEFAULTS["segmentation"]
        made = {
            trainer: configure(
                trainer, "segmentation", settings, str(given), str(here / "out")
            )
            for trainer in (
                "mmdet3d",
                "rangenet",
                "cylinder3d",
                "open3d_ml",
                "waffleiron",
            )
        }
        assert f'root = "{root}"\n' in made["mmdet3d"]["lists.py"]
        assert f"-d {root} " in made["rangenet"]["train.sh"]
        assert f'"{root}/sequences/"' in made["cylinder3d"]["train.sh"]
        read = here / "out" / "kitti"
        script = f"python() {{ :; }}\nsed() {{ :; }}\n{made['waffleiron']['train.sh']}"
        subprocess.run(["bash", "-ec", script], check=True)
        assert f"--path_dataset {read} " in script
        assert (read / "dataset" / "sequences").samefile(root / "sequences")
        lines = made["open3d_ml"]["train.py"].splitlines()
        first = next(i for i, line in enumerate(lines) if line.startswith("link = "))
        exec("\n".join(lines[first : first + 4]), {"Path": Path})
        assert (read / "dataset" / "sequences").samefile(root / "sequences")


def test_the_recipes_command_refuses_a_folder_with_the_name_of_a_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("town").mkdir()
    given = "recipes --trainer openpcdet --root town --synthetic"
    assert CliRunner().invoke(app, [*given.split(), "./town"]).exit_code == 0
    refused = CliRunner().invoke(app, [*given.split(), "town"])
    assert "Write ./town for the folder" in str(refused.exception)


def test_the_recipes_command_writes_a_trainers_files(tmp_path: Path) -> None:
    given = f"recipes --trainer openpcdet --root KITTI --synthetic town --out {tmp_path / 'mixed'}"
    result = CliRunner().invoke(app, given.split())
    assert result.exit_code == 0, result.output
    settings = read_settings(tmp_path / "mixed" / "mix.yaml")
    assert (
        settings["ratio"] == {"synthetic_first": 40} and settings["labels"] == "boxes"
    )
    other = CliRunner().invoke(app, "recipes --trainer rangenet".split())
    assert "# For a training of 40 epochs" in other.output
    assert "epochs: 40\n" in other.output
    text = (tmp_path / "mixed" / "train.sh").read_text()
    assert f"LIDAR_SYNTH_MIX={tmp_path}/mixed/mix.yaml" in text
    assert "DATA_CONFIG.DATA_PATH KITTI" in text
    wrong = CliRunner().invoke(
        app, "recipes --trainer openpcdet --task segmentation".split()
    )
    assert "one of mmdet3d, pointcept" in str(wrong.exception)


def test_a_trainers_files_name_folders_by_their_whole_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("KITTI", "town_scans"):
        Path(name).mkdir()
    given = (
        "recipes --trainer openpcdet --root KITTI --synthetic town_scans --out mixed"
    )
    result = CliRunner().invoke(app, given.split())
    assert result.exit_code == 0, result.output
    settings = read_settings(tmp_path / "mixed" / "mix.yaml")
    assert settings["synthetic"] == str(tmp_path / "town_scans")
    script = (tmp_path / "mixed" / "train.sh").read_text()
    assert f"DATA_CONFIG.DATA_PATH {tmp_path}/KITTI" in script
    assert "--epochs 40" in script


def test_the_schema_of_a_recipe_knows_the_keys_of_published_ones() -> None:
    schemas = {}
    for command in ("train", "distill", "bake"):
        said = CliRunner().invoke(app, ["recipes", "--schema", command]).output
        schemas[command] = set(json.loads(said)["properties"])
    for recipe in published():
        keys = set(read_recipe(folder() / f"{recipe.name}.yaml"))
        assert keys <= schemas[recipe.command], recipe.name
