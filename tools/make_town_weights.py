"""The recipe of the weights that ship: teacher, timesteps, student, on scans of the town only.

    python tools/make_town_weights.py WORK [--minutes 60] [--teacher-share 0.7]
        [--teacher KEY=VALUE ...] [--student KEY=VALUE ...]

Both runs have a budget of time in place of iterations: at a constant rate until three quarters of it are over, then
the rate falls to zero over a third of the steps done so far (the schedule "trapezoid"). A run that was stopped or
killed goes on when the same is typed again, with the budget anew. KEY=VALUE changes the configurations
(configs/town_teacher.yaml and town_student.yaml), such as recipe.batch=16; data has to stay the same in both. On a
machine that does other things too, set OMP_WAIT_POLICY=passive.
"""

import argparse
import json
import math
from pathlib import Path

import torch

from lidar_synth.checkpoint import load_checkpoint, read_header, save_checkpoint
from lidar_synth.cli.run import run
from lidar_synth.config import DistillConfig, TrainConfig, load_config
from lidar_synth.files import write_file

ROOT = Path(__file__).parents[1]
PLATEAU = 0.75
"""Share of the steps at a constant rate; what the schedule "trapezoid" leaves."""
LIMIT = 16e6
"""Bytes that weights in the package may have."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, help="folder of the runs")
    parser.add_argument("--minutes", type=float, default=60, help="for teacher and student together")
    parser.add_argument("--teacher-share", type=float, default=0.7, help="of the minutes")
    parser.add_argument("--teacher", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--student", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=ROOT / "lidar_synth" / "weights" / "town.safetensors")
    given = parser.parse_args()

    cache = f"data.cache={given.work / 'cache'}"
    minutes = given.minutes * given.teacher_share
    teacher = train(TrainConfig, given.work / "town_teacher", minutes, [cache, *given.teacher])
    overrides = [cache, f"teacher={teacher}", *given.student]
    student = train(DistillConfig, given.work / "town_student", given.minutes - minutes, overrides)
    ship(student, given.out)


def train(kind: type[TrainConfig] | type[DistillConfig], folder: Path, minutes: float, overrides: list[str]) -> Path:
    """A run with a budget of time; a second call goes on with it."""
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
    """The student as the package holds it, in half precision if it has to be."""
    checkpoint = load_checkpoint(path)
    count = sum(p.numel() for network in checkpoint.networks.values() for p in network.parameters())
    dtype = torch.float32 if 4 * count < 0.9 * LIMIT else torch.float16
    save_checkpoint(out, checkpoint.header, checkpoint.networks, dtype)
    size = out.stat().st_size
    assert size <= LIMIT, f"{out} has {size} bytes: make the network smaller"
    print(f"{out}: {count / 1e6:.2f} M parameters, {size / 1e6:.1f} MB, time grid {checkpoint.header.time_grid}")


if __name__ == "__main__":
    main()
