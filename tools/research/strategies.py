"""The paper's Table 4 on what ships: students of the shipped teacher by strategy, over several
seeds.

    python tools/research/strategies.py OUT [KEY=VALUE ...] [--seeds 5] [--count 64]

Each student starts as tools/stages/town_teacher.safetensors and learns by the recipe town_student
in 4 steps; KEY=VALUE changes it (recipe.iterations=300, data.town=500). A student's error is the
squared difference of its states and the teacher's of the same noise in 50 steps, over the variance
of the teacher's, in percent; isolated returns and mIoU with the town's segmenter are those of
model_card.py. The figures stand as mean and standard deviation over the seeds, with the p-value of
a paired t-test over them against adaptive piecewise distillation. The same command resumes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from model_card import SEED, head, row
from numpy.typing import NDArray
from scipy.stats import ttest_rel
from tqdm import tqdm
from typer import Argument, run as run_command

from lidar_synth.generate.flow.distill import STRATEGIES
from lidar_synth.generate.flow.solvers import solve
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.loading import load_generator
from lidar_synth.lab.evaluate.isolated import count_isolated, share_of_isolated
from lidar_synth.lab.evaluate.segmentation import load_judge, mean_iou
from lidar_synth.lab.train import DistillConfig, load_config, run
from lidar_synth.lab.train.state import read_progress
from lidar_synth.noise import gaussian

TEACHER = Path(__file__).parents[1] / "stages" / "town_teacher.safetensors"
STEPS = 4
FINE = 50
"""Steps of the student, and of the teacher that it is compared with."""
OURS = "adaptive_piecewise"
FIGURES = ("error, %", "isolated returns, %", "mIoU with the segmenter, %")


class Row(NamedTuple):
    """A row of the table.

    Args:
        name: of the strategy, or the teacher.
        values: (seeds, figures).
    """

    name: str
    values: NDArray[np.float64]


def train(
    out: Path, teacher: Path, strategy: str, seed: int, overrides: Sequence[str]
) -> Path:
    """The student of a strategy and a seed; trained before, it is kept."""
    values = {
        "teacher": str(teacher),
        "strategy": strategy,
        "seed": seed,
        "also": [],
        "output": str(out / f"{strategy}-{seed}"),
        "data": {"cache": str(out / "cache")},
        "samples": {"every": 0},
    }
    config = load_config(DistillConfig, "town_student", overrides, values)
    if read_progress(config.output).step < config.recipe.iterations:
        run(config, resume=True)
    return config.checkpoint


def states(generator: Generator, count: int, steps: int) -> torch.Tensor:
    """(count, C, H, W) what a flow makes of the same noise."""
    made = []
    with torch.inference_mode():
        for i in tqdm(range(count), desc=generator.name, leave=False):
            noise = gaussian(SEED, [i], generator.codec.shape)
            grid = generator.header.grid(steps)
            made.append(solve(generator.network, noise, grid))
    return torch.cat(made)


def measure(model: Path, truth: torch.Tensor, steps: int) -> list[float]:
    """The figures of a model in a number of steps."""
    generator = load_generator(model)
    count = len(truth)
    error = (states(generator, count, steps) - truth).square().mean() / truth.var()
    scans = [generator.scans(SEED, [i], steps=steps)[0] for i in range(count)]
    counts = np.sum([count_isolated(scan) for scan in scans], 0)
    isolated = share_of_isolated(counts.sum(1))
    agreement = mean_iou(load_judge().agreement(scans))
    return [100 * float(error), 100 * float(isolated), 100 * float(agreement)]


def table(rows: Sequence[Row]) -> str:
    """The figures in Markdown."""
    [ours] = [one.values for one in rows if one.name == OURS]
    lines = head("strategy", FIGURES)
    for name, values in rows:
        cells = []
        for figure in range(len(FIGURES)):
            own = values[:, figure]
            cell = f"{own.mean():.3g}"
            if len(own) > 1:
                cell += f" ± {own.std(ddof=1):.2g}"
            if len(own) > 1 and name != OURS and len(own) == len(ours):
                cell += f" (p {ttest_rel(own, ours[:, figure]).pvalue:.2g})"
            cells.append(cell)
        lines.append(row(name, cells))
    return "\n".join(lines)


def main(
    out: Path,
    overrides: Annotated[list[str] | None, Argument(metavar="[KEY=VALUE]...")] = None,
    teacher: Path = TEACHER,
    seeds: int = 5,
    count: int = 64,
) -> None:
    """Trains the students and prints the table."""
    truth = states(load_generator(teacher), count, FINE)
    rows = [
        Row(f"teacher, {steps} steps", np.array([measure(teacher, truth, steps)]))
        for steps in (FINE, STEPS)
    ]
    for strategy in STRATEGIES:
        values = []
        for seed in range(seeds):
            student = train(out, teacher, strategy, seed, overrides or ())
            values.append(measure(student, truth, STEPS))
        rows.append(Row(strategy, np.array(values)))
    print(f"{seeds} seeds, {count} scans each\n\n{table(rows)}")


if __name__ == "__main__":
    run_command(main)
