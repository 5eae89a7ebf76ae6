"""76 mistakes of newcomers, on the command line, in Python and in YAML: each is answered in one
line that names the option or what was expected and, for names, the nearest ones."""

import re
import warnings
from collections.abc import Collection, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from layouts import MAKERS
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

import lidar_synth
from lidar_synth.bake.run import ENGINES
from lidar_synth.cli import COMMANDS as COMMAND_NAMES, app
from lidar_synth.errors import suggest
from lidar_synth.formats import READERS, WRITERS
from lidar_synth.formats.description import Description
from lidar_synth.generate.flow.solvers import SOLVERS
from lidar_synth.lab.proof import ARMS
from lidar_synth.lab.proof.detection import ARMS as DETECTION_ARMS
from lidar_synth.lab.proof.places import SPLITS
from lidar_synth.lab.proof.scores import GROUPS
from lidar_synth.lab.start.trainers import TRAINERS
from lidar_synth.lab.town.export import LAYOUTS
from lidar_synth.mixing.settings import mix_for_trainer, read_settings

COMMANDS = {
    "train twon": "Did you mean 'town'",
    "train town_tiny recipe.itterations=3": "Did you mean 'iterations'",
    "train town_tiny recipe.iterations=many": "recipe.iterations = 'many'",
    "train town_tiny recipe.iterations 3": "expected key=value",
    "train town_tiny --epochs 3": "key=value, such as recipe.iterations=3",
    "train town_tiny sensor=vlp61": "Did you mean 'vlp16'",
    "distill town_studnt": "'town_student'",
    "sample OUT --model twon": "Did you mean 'town'",
    "sample OUT --to kiti": "Did you mean 'kitti'",
    "sample OUT --dtype fp16": "'float32', 'bfloat16'",
    "sample OUT --device gpu": "expected an available one: cpu",
    "sample OUT --count 0": "sample: count = 0",
    "sample OUT --cout 5": "Did you mean '--count'",
    "sample OUT --num 5": "Did you mean '--count'",
    "sample OUT --format kitti": "Did you mean '--to'",
    "sample OUT --model town-semantic": "--condition ROOT",
    "bake OUT --engine locl": "Did you mean 'local'",
    "bake OUT --scans 20": "Did you mean '--count'",
    "bake OUT --gpu": "Did you mean '--device'",
    "bake OUT --checkpoint town": "Did you mean '--model'",
    "bake OUT --output bank": "The folder is the argument OUT",
    "bake OUT --batch-size 4": "Did you mean '--batch'",
    "bake OUT --fields intensity": "'reflectance'",
    "bake OUT --slurm partition": "KEY=VALUE, such as slurm_partition=gpu",
    "bake BANK --count 5": "an empty folder",
    "town OUT --layout kiti360": "Did you mean 'kitti360'",
    "town OUT --sensor hdl64e_kiti": "Did you mean 'hdl64e_kitti'",
    "town OUT --skin pandar46": "Did you mean 'pandar64'",
    "town OUT --count 5": "Did you mean '--scans'",
    "convert SCANS OUT": "Missing option '--to'",
    "convert OUT OUT --to npz --layout semantic_kity": "mean 'semantic_kitti'",
    "convert SCANS OUT --to npz --split tain": "Did you mean 'train'",
    "evaluate OUT OUT --protocol r2flo": "Did you mean 'r2flow'",
    "prove SCANS --arm pretain": "Did you mean 'pretrain'",
    "prove SCANS --task detecton": "Did you mean 'detection'",
    "prove SCANS --classes semantickitti": "Did you mean 'semantic_kitti'",
    "prove SCANS --only cars": "Did you mean 'car'",
    "prove SCANS --epochs 4": "Did you mean '--iterations'",
    "adapt twon --scans SCANS --out m.safetensors": "Did you mean 'town'",
    "verify SCANS": "holds no bank",
    "label kiti360 SCANS OUT": "Did you mean 'kitti360'",
    "labels kitti360 SCANS OUT": "Did you mean 'label'",
    "metrics lst": "lidar-synth metrics has",
    "bank --deep": "lidar-synth bank. It has --help.",
    "generate OUT": "Did you mean 'sample'",
    "mix SCANS BANK": "Did you mean 'check-mix'",
    "help": "Did you mean '--help'",
    "start SCANS --trainer mmdet": "Did you mean 'mmdet3d'",
    "sensor fit SCANS --out my.json": "a file that ends in .yaml",
}
"""By command line: what the answer says. ``OUT`` is a new folder, ``SCANS`` and ``BANK`` are
there."""

PYTHON = {
    "lidar_synth.Towm": "Did you mean 'Town'",
    "lidar_synth.open_scans('nowhere')": "nowhere does not exist",
    "lidar_synth.open_scans(SCANS, on_bad='skp')": "Did you mean 'skip'",
    "lidar_synth.Bank(SCANS)": "holds no bank",
    "lidar_synth.load_sensor('os1_12')": "Did you mean 'os1_128'",
    "lidar_synth.mix(SCANS, BANK, ratio=25)": "a number from 0 to 1",
    "lidar_synth.mix(SCANS, BANK, ratoi=0.5)": "Did you mean 'ratio'",
    "lidar_synth.mix(SCANS, BANK, task='detecton')": "Did you mean 'detection'",
    "lidar_synth.mix(SCANS, BANK, labels='paste')": "ObjectBank.from_scans",
    "lidar_synth.mix(SCANS, BANK, labels={'paste': {'bnk': 1}})": "Did you mean 'bank'",
    "lidar_synth.mix(SCANS, BANK, epoch_size='ad')": "'add', 'replace' or a number",
    "lidar_synth.mix(SCANS, BANK, collate='paded')": "Did you mean 'padded'",
    "lidar_synth.mix(SCANS, 'twon')": "Did you mean 'town'",
    "lidar_synth.fit_sensor(SCANS)": "open_scans(path) opens a folder",
    "lidar_synth.fit_skin(SCANS)": "open_scans(path) opens a folder",
    "lidar_synth.evaluate(SCANS, SCANS, 'town')": "open_scans(path) opens a folder",
    "lidar_synth.KeepLabels(threshold=60)": "a number from 0 to 1",
}
"""By expression: what the error says."""

YAML = {
    "{synthetic: BANK, ratoi: 0.5}": "Did you mean 'ratio'",
    "{synthetic: BANK, ratio: half}": "a number from 0 to 1",
    "{synthetic: BANK, ratio: {synthetic_frist: 40}}": "Did you mean 'synthetic_first'",
    "{synthetic: BANK, labels: generatd}": "Did you mean 'generated'",
    "{synthetic: BANK, as_sensor: os1_12}": "Did you mean 'os1_128'",
    "{synthetic: BANK, unboxed: clos}": "Did you mean 'close'",
    "{synthetic: BANK, reuse: 0}": "1 or more",
    "{synthetic: BANK, seed: one}": "expected an integer",
    "{synthetic: twon}": "Did you mean 'town'",
    "{ratio: 0.5}": "synthetic: a bank's folder",
    "{synthetic: BANK": "is not YAML",
    "[synthetic, ratio]": "a dict of synthetic, epochs, ratio",
    "{synthetic: BANK, loss_weight: 0.1}": "Use a smaller ratio",
}
"""By file of a mixture: what the error says."""


def test_they_are_79() -> None:
    assert len(COMMANDS) + len(PYTHON) + len(YAML) == 79


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The folders that are there, by name."""
    root = tmp_path_factory.mktemp("there")
    MAKERS["semantic_kitti"](root / "scans")
    MAKERS["bank"](root / "bank")
    return {"SCANS": str(root / "scans"), "BANK": str(root / "bank")}


@pytest.mark.parametrize("call", COMMANDS)
def test_a_wrong_command_is_answered(
    call: str, there: dict[str, str], tmp_path: Path
) -> None:
    named = there | {"OUT": str(tmp_path / "out")}
    given = [named.get(word, word) for word in call.split()]
    result = CliRunner().invoke(app, given)
    *_, said = result.output.strip().splitlines() or [""]
    if result.exception is not None and result.exit_code == 1:
        said = str(result.exception)
    assert result.exit_code != 0
    assert said.count(COMMANDS[call]) == 1 and "\n" not in said


@pytest.mark.parametrize(
    "call",
    [
        "adapt town --scans SCANS --out m.safetensors",
        "check-mix mix.yaml SCANS",
        "evaluate SCANS SCANS --protocol town",
        "prove SCANS",
        "stress SCANS town",
    ],
)
def test_commands_of_real_scans_say_how_they_are_read(
    call: str, there: dict[str, str]
) -> None:
    """Such as by ``--reflectance-max``, which other errors tell the user to type."""
    given = [there.get(word, word) for word in call.split()]
    given += ["--reflectance-max", "255", "--fields", "4", "--on-bad", "skip"]
    result = CliRunner().invoke(app, [*given, "--layout", "kitti_ra"])
    assert "Did you mean 'kitti_raw'" in str(result.exception)


def test_a_trainer_without_its_file_is_refused_before_a_plan(
    there: dict[str, str],
) -> None:
    given = ["prove", there["SCANS"], "--trainer", "python mine.py", "--dry-run"]
    result = CliRunner().invoke(app, given)
    assert "a command with {job}" in str(result.exception)


@pytest.mark.parametrize("call", PYTHON)
def test_a_wrong_call_is_answered(call: str, there: dict[str, str]) -> None:
    with pytest.raises(Exception) as caught, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        eval(call, {"lidar_synth": lidar_synth, **there})
    said = str(caught.value)
    assert PYTHON[call] in said and "\n" not in said


@pytest.mark.parametrize(
    ("package", "name"),
    [
        ("lidar_synth", "Town"),
        ("lidar_synth.labels", "paste"),
        ("lidar_synth.bake", "bake"),
    ],
)
def test_a_wrong_name_of_a_package_is_answered(package: str, name: str) -> None:
    module = import_module(package)
    assert getattr(module, name) is not None
    said = re.escape(
        f"module {package!r} has no attribute '{name}x'. Did you mean {name!r}"
    )
    with pytest.raises(AttributeError, match=said):
        getattr(module, f"{name}x")


@pytest.mark.parametrize("text", YAML)
def test_a_wrong_file_is_answered(
    text: str, there: dict[str, str], tmp_path: Path
) -> None:
    path = tmp_path / "mix.yaml"
    path.write_text(text.replace("BANK", there["BANK"]))

    def mixed() -> Any:
        return mix_for_trainer(3, read_settings(path), lambda scan, rng: scan)

    with pytest.raises(Exception) as caught:
        mixed()
    said = str(caught.value)
    assert YAML[text] in said and "\n" not in said


CHOICES: dict[tuple[str, str], Collection[str]] = {
    ("prove", "--arm"): {**ARMS, **DETECTION_ARMS},
    ("prove", "--classes"): GROUPS,
    ("prove", "--places"): SPLITS,
    ("start", "--trainer"): TRAINERS,
    ("recipes", "--trainer"): TRAINERS,
    ("convert", "--to"): WRITERS,
    ("sample", "--to"): WRITERS,
    ("sample", "--solver"): SOLVERS,
    ("convert", "--layout"): READERS,
    ("bake", "--engine"): ENGINES,
    ("town", "--layout"): LAYOUTS,
}
"""By command and option: the names that it takes."""


@pytest.mark.parametrize(("command", "option"), CHOICES)
def test_the_help_of_an_option_lists_its_choices(command: str, option: str) -> None:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    params = [p for p in group.commands[command].params if option in p.opts]
    said = getattr(params[0], "help", None)
    assert set(CHOICES[command, option]) <= set(re.findall(r"[\w-]+", said))


def test_the_help_of_all_commands_is_whole() -> None:
    said = CliRunner().invoke(app, ["--help"]).output
    commands = said.split("Commands:")[1]
    assert "..." not in commands
    assert all(re.search(rf"^  {name} ", commands, re.M) for name in COMMAND_NAMES)
    for name in ("bank", "edit", "sensor", "skin", "metrics"):
        said = CliRunner().invoke(app, [name, "--help"]).output
        assert "..." not in said.split("Commands:")[1]


def all_commands(group: Any, parent: str = "") -> Iterator[tuple[str, Any]]:
    """Every command with its name, and those of groups by ``group command``."""
    for name, command in group.commands.items():
        yield f"{parent}{name}", command
        if isinstance(command, TyperGroup):
            yield from all_commands(command, f"{parent}{name} ")


def test_commands_of_groups_are_visited() -> None:
    assert {"bake", "bank", "bank merge"} <= dict(all_commands(get_command(app))).keys()


def test_examples_of_commands_keep_their_lines() -> None:
    for name, command in all_commands(get_command(app)):
        assert not re.search(r"(?<!\x08\n)Examples?:", command.help or ""), name


def test_arguments_of_commands_are_shown_by_a_name_of_their_own() -> None:
    for name, command in all_commands(get_command(app)):
        given = [p for p in command.params if p.param_type_name == "argument"]
        assert all(getattr(param, "metavar", None) for param in given), name


def test_a_name_like_none_has_no_suggestion() -> None:
    assert suggest("velodyne", ["kitti", "pcd"]) == ""


def test_the_sensor_of_a_folder_is_a_preset() -> None:
    with pytest.raises(
        ValueError, match=r"sensor 'os1_12' is no preset.*Did you mean 'os1_128'"
    ):
        Description.from_dict(
            {"format": "lidar-synth-scans/1", "sensor": "os1_12", "origins": []}
        )
