"""Train the shipped weights on scans of the town: autoencoder, teacher, a weaker teacher for autoguidance, timesteps,
student, decoder.

    python tools/make_town_weights.py WORK [--model town] [--codec 60] [--teacher 180] [--weaker 10] [--student 30]
        [--decoder 30] [--set RUN.KEY=VALUE ...]
    python tools/make_town_weights.py WORK --model town-dense --codec 60 --teacher 90 --student 45 --decoder 25
    python tools/make_town_weights.py WORK --model town-semantic --teacher 60      # after town, in the same folder
    python tools/make_town_weights.py WORK --model town-camera --teacher 60

The conditional models start from the teacher of "town". The numbers are minutes: every run has a budget of
time instead of iterations. The learning rate is constant for three quarters of the budget, then falls to zero over a
third of the steps done so far (the schedule "trapezoid"). The same command resumes a run that was stopped or killed,
with a new budget. --set changes the recipes (town_codec, town_teacher, town_semantic_student ...), such as
teacher.recipe.batch=16; the data has to be the same in all of them. On a machine that does other work, set
OMP_WAIT_POLICY=passive.
"""

import argparse
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch

from lidar_synth.files.disk import write_file
from lidar_synth.generate.checkpoint import load_checkpoint, read_header, save_checkpoint
from lidar_synth.town import Town, export_town
from lidar_synth.train.config import DistillConfig, TrainConfig, load_config
from lidar_synth.train.runs import run

ROOT = Path(__file__).parents[1]
PLATEAU = 0.75
"""Share of the steps at a constant rate; what the schedule "trapezoid" leaves."""
LIMIT = 16e6
"""Largest size of shipped weights in bytes."""

CAMERA_SCANS, CAMERA_INTERVAL = 800, 2.0
"""Scans with images, and the seconds between them; an image takes a second and a half."""


class Stage(NamedTuple):
    """A run of the recipe.

    Args:
        config: class of its configuration in configs/.
        minutes: default budget.
        needs: {key of the configuration: the stage whose checkpoint it names}.
    """

    config: type[TrainConfig] | type[DistillConfig]
    minutes: float
    needs: Mapping[str, str] = {}


STAGES = {
    "codec": Stage(TrainConfig, 60),
    "teacher": Stage(TrainConfig, 180, {"codec": "codec"}),
    "weaker": Stage(TrainConfig, 10, {"codec": "codec"}),
    "student": Stage(DistillConfig, 30, {"teacher": "teacher", "weaker": "weaker"}),
    "decoder": Stage(TrainConfig, 30, {"init": "student"}),
}
DENSE = {
    "codec": Stage(TrainConfig, 60),
    "teacher": Stage(TrainConfig, 180, {"codec": "codec"}),
    "student": Stage(DistillConfig, 45, {"teacher": "teacher"}),
    "decoder": Stage(TrainConfig, 25, {"init": "student"}),
}
CONDITIONAL = {
    "teacher": Stage(TrainConfig, 180, {"init": "unconditional"}),
    "student": Stage(DistillConfig, 30, {"teacher": "teacher"}),
}
MODELS = {"town": STAGES, "town-dense": DENSE, "town-semantic": CONDITIONAL, "town-camera": CONDITIONAL}
"""Stages of the shipped models."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="folder of the runs")
    parser.add_argument("--model", choices=MODELS, default="town")
    for name, stage in STAGES.items():
        parser.add_argument(f"--{name}", type=float, default=stage.minutes, metavar="MINUTES")
    parser.add_argument("--set", nargs="*", default=[], metavar="RUN.KEY=VALUE")
    parser.add_argument("--out", type=Path, help="file to write [default: the package's weights]")
    given = parser.parse_args()

    data = [f"data.cache={given.work / ('dense_cache' if given.model == 'town-dense' else 'cache')}"]
    if given.model == "town-camera":
        data = [f"data.cache={given.work / 'camera_cache'}", f"data.path={given.work / 'town_camera'}"]
        town = Town(0, scans=CAMERA_SCANS, interval=CAMERA_INTERVAL)
        export_town(town, given.work / "town_camera", "kitti360", jobs=os.cpu_count() or 1)
    made = {"unconditional": given.work / "town_teacher" / "town_teacher.safetensors"}
    for name, stage in MODELS[given.model].items():
        folder = given.work / f"{given.model.replace('-', '_')}_{name}"
        needs = [f"{key}={made[other]}" for key, other in stage.needs.items()]
        changes = [change.partition(".")[2] for change in given.set if change.startswith(f"{name}.")]
        made[name] = path = train(stage.config, folder, getattr(given, name), [*data, *needs, *changes])
    ship(path, given.out or ROOT / "lidar_synth" / "weights" / f"{given.model}.safetensors")


def train(kind: type[TrainConfig] | type[DistillConfig], folder: Path, minutes: float, overrides: list[str]) -> Path:
    """A run with a budget of time; a second call resumes it."""
    note = folder / "budget.json"
    overrides = [f"output={folder}", "recipe.schedule=trapezoid", *overrides]

    def configured(iterations: int) -> TrainConfig | DistillConfig:
        return load_config(
            kind, ROOT / "configs" / f"{folder.name}.yaml", [*overrides, f"recipe.iterations={iterations}"]
        )

    if not note.exists():
        path = run(configured(10**9), resume=True, minutes=PLATEAU * minutes)
        plateau = read_header(path)[0].provenance["iterations"]
        write_file(note, json.dumps({"iterations": math.ceil(plateau / PLATEAU)}).encode())
    return run(configured(json.loads(note.read_text())["iterations"]), resume=True)


def ship(path: Path, out: Path) -> None:
    """Write the student as the package ships it, in half precision where it would be too large."""
    checkpoint = load_checkpoint(path)
    count = sum(p.numel() for network in checkpoint.networks.values() for p in network.parameters())
    dtype = torch.float32 if 4 * count < 0.9 * LIMIT else torch.float16
    save_checkpoint(out, checkpoint.header, checkpoint.networks, dtype)
    size = out.stat().st_size
    assert size <= LIMIT, f"{out} has {size} bytes: make the network smaller"
    print(f"{out}: {count / 1e6:.2f} M parameters, {size / 1e6:.1f} MB, time grid {checkpoint.header.time_grid}")


if __name__ == "__main__":
    main()
