"""Compare distillation strategies in 4, 2 and 1 steps (the paper's Table 4), each with several
seeds.

    python tools/research/ablation.py TEACHER LATENTS WORK [--seeds 3] [--iterations 1000] [--pairs 3072] [--count 64]

TEACHER is the checkpoint of a latent flow, LATENTS the file ``latents-*.npy`` that its training has
left in its cache. Parts of the teacher's trajectories are computed once, as in R2Flow, in Euler
steps of 1/24. Every student starts from the teacher's weights and learns from as many of them in as
many iterations. One student of reflow serves all numbers of steps. In one step, the piecewise
strategies are timestep distillation, and are not trained again. The time grids of
``adaptive_piecewise`` are selected on 64 trajectories; all others are uniform.

The first table has means and standard deviations over the seeds, the second one all measures of
tools/research/model_card.py for the first seed in 4 steps, with 95 % intervals. WORK keeps students and
trajectories: a second call resumes.
"""

import argparse
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from model_card import BEND, REFERENCE, SEED, Comparison, Measured, table, town
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm import tqdm

from lidar_synth import Scan
from lidar_synth.generate.flow.distill import STRATEGIES
from lidar_synth.generate.flow.solvers import solve, uniform_grid
from lidar_synth.generate.flow.timesteps import best_path, select_timesteps
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.evaluate.segmentation import load_judge
from lidar_synth.lab.train.optimizers import muon
from lidar_synth.lab.train.precision import faster_in_bfloat16

STEPS = (4, 2, 1)
EULER = 24
"""Steps of the teacher from noise to data."""
BATCH = 8
TRAJECTORIES = 64
CANDIDATES = 50
RATE = 6e-4
WARM_UP = 20
DECAY = 0.99
WHOLE = ("reflow", "timestep_distillation")
"""Strategies whose targets are whole trajectories."""
SHOWN = {
    "bird's-eye JSD": "BEV Jensen",
    "Fréchet": "Frechet",
    "squared MMD": "squared",
    "mIoU, %": "mIoU",
}
"""{column: the beginning of the measure's name}."""
ERROR = "error, %"
"""Squared difference of sampled latents and the teacher's of the same noise in 50 steps, over their
variance."""

Grid = tuple[float, ...]


class Student(NamedTuple):
    """A student: its strategy, its time grid, and the grid of the parts of trajectories that it
    learns from."""

    strategy: str
    grid: Grid
    parts: Grid


def students(selected: dict[int, Grid]) -> list[Student]:
    """Every student that differs from the others in training or sampling."""
    found = []
    for strategy in STRATEGIES:
        for steps in STEPS:
            grid = (
                selected[steps]
                if strategy == "adaptive_piecewise"
                else tuple(uniform_grid(steps))
            )
            if strategy in WHOLE or steps > 1:
                found.append(
                    Student(strategy, grid, (1.0, 0.0) if strategy in WHOLE else grid)
                )
    return found


@dataclass(frozen=True)
class Ablation:
    """What all students share.

    Args:
        teacher: the generator whose flow is distilled.
        latents: (2, N, C, h, w) encoded scans, as they are and mirrored.
        work: folder of students and trajectories.
        pairs: parts of trajectories for a grid.
        iterations: of each student.
    """

    teacher: Generator
    latents: NDArray[np.float16]
    work: Path
    pairs: int
    iterations: int

    def selected(self) -> dict[int, Grid]:
        """The selected time grid of each number of steps."""
        path = self.work / "grids.pt"
        if not path.exists():
            shape = self.latents.shape[2:]
            selection = select_timesteps(
                velocity(self.teacher),
                shape,
                max(STEPS),
                CANDIDATES,
                TRAJECTORIES,
                "squared_l2",
                batch=2 * BATCH,
            )
            times = np.asarray(selection.candidates)
            torch.save(
                {n: times[best_path(selection.costs, n)].tolist() for n in STEPS}, path
            )
        return {
            n: tuple(grid) for n, grid in torch.load(path, weights_only=True).items()
        }

    def parts(self, grid: Grid) -> dict[str, Tensor]:
        """Parts of the teacher's trajectories: data ``y0``, noise ``y1``, the index of the
        ``interval`` that the teacher integrates from the point between them, and its mean velocity
        there, the ``slope``."""
        path = self.work / f"parts-{'-'.join(f'{t:g}' for t in grid)}.safetensors"
        if not path.exists():
            rng = np.random.default_rng(7)
            noise = torch.Generator().manual_seed(7)
            flow = velocity(self.teacher)
            found = []
            intervals = list(pairwise(grid))
            for part in tqdm(range(self.pairs // BATCH), desc=path.stem, unit="batch"):
                index = part % len(intervals)
                start, end = intervals[index]
                y0 = torch.from_numpy(
                    self.latents[
                        rng.integers(2), rng.choice(self.latents.shape[1], BATCH)
                    ]
                ).float()
                y1 = torch.randn(y0.shape, generator=noise)
                y = torch.lerp(y0, y1, start)
                after = solve(
                    flow,
                    y,
                    uniform_grid(max(2, round(EULER * (start - end))), start, end),
                    "euler",
                    None,
                )
                slope = (after - y) / (end - start)
                found.append(
                    (y0.half(), y1.half(), torch.full((BATCH,), index), slope.half())
                )
            columns = (torch.cat(column) for column in zip(*found, strict=True))
            save_file(
                dict(zip(("y0", "y1", "interval", "slope"), columns, strict=True)), path
            )
        return load_file(path)

    def train(self, student: Student, seed: int) -> dict[str, Tensor]:
        """The averaged weights of a student."""
        steps = 0 if student.strategy == "reflow" else len(student.grid) - 1
        path = self.work / f"{student.strategy}-{steps}-{seed}.safetensors"
        if not path.exists():
            save_file(self._learn(student, seed, path.stem), path)
        return load_file(path)

    def _learn(self, student: Student, seed: int, name: str) -> dict[str, Tensor]:
        parts = self.parts(student.parts)
        network = deepcopy(self.teacher.network).train().requires_grad_(True)
        average = {k: v.clone() for k, v in network.state_dict().items()}
        optimizers = muon(network, RATE, (0.9, 0.98), 0.01)
        draws = torch.Generator().manual_seed(seed)
        for step in tqdm(range(self.iterations), desc=name, unit="step"):
            y, t, v = supervision(student, parts, draws)
            with torch.autocast("cpu", torch.bfloat16, enabled=faster_in_bfloat16()):
                predicted = network(y, t)
            (predicted.float() - v).square().mean().backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            warm = (step + 1) / WARM_UP
            cool = (self.iterations - step) / (0.4 * self.iterations)
            for optimizer in optimizers:
                for group in optimizer.param_groups:
                    group["lr"] = RATE * min(1.0, warm, max(0.02, cool))
                optimizer.step()
                optimizer.zero_grad()
            for k, value in network.state_dict().items():
                average[k].lerp_(value, 1 - min(DECAY, 1 - 1 / (step / 5 + 1)))
        return average

    def generator(self, student: Student, seed: int) -> Generator:
        """The student in the place of the teacher."""
        network = deepcopy(self.teacher.network)
        network.load_state_dict(self.train(student, seed))
        return replace(self.teacher, network=network.eval())

    def end(self, generator: Generator, grid: Grid) -> Tensor:
        """(n, C, h, w) the latents that a flow makes of the same noise."""
        noise = torch.randn(
            TRAJECTORIES,
            *self.latents.shape[2:],
            generator=torch.Generator().manual_seed(5),
        )
        return torch.cat(
            [
                solve(velocity(generator), y, grid, "euler", None)
                for y in noise.split(BATCH)
            ]
        )


def velocity(generator: Generator) -> Callable[..., Tensor]:
    """The flow, without gradients."""

    def flow(y: Tensor, t: Tensor, cond: Any = None) -> Tensor:
        with (
            torch.no_grad(),
            torch.autocast("cpu", torch.bfloat16, enabled=faster_in_bfloat16()),
        ):
            return generator.network(y, t.expand(len(y))).float()

    return flow


def supervision(
    student: Student, parts: dict[str, Tensor], draws: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """States, times and velocities of a batch by the strategy; its teacher is the recorded
    slope."""
    picks = torch.randint(len(parts["y0"]), (BATCH,), generator=draws)
    y0, y1, slope = (parts[name][picks].float() for name in ("y0", "y1", "slope"))
    u = torch.rand(BATCH, generator=draws)
    if (
        student.strategy == "piecewise_reflow"
    ):  # u is the time: within the recorded interval
        times = torch.tensor(student.grid)
        u = torch.lerp(
            times[parts["interval"][picks] + 1], times[parts["interval"][picks]], u
        )
    elif student.strategy not in WHOLE:  # u selects the interval
        u = (parts["interval"][picks] + u) / (len(student.grid) - 1)
    example = STRATEGIES[student.strategy](
        lambda y, t, c: slope, y0, y1, u, student.grid, 1, None
    )
    return example.y, example.t, example.velocity


def sample(generator: Generator, grid: Grid, count: int) -> list[Scan]:
    """Scans on a time grid; all generators get the same noise."""
    known = replace(
        generator, header=replace(generator.header, time_grid=grid, other_grids=())
    )
    made = [
        known.scans(SEED, [i])[0]
        for i in tqdm(range(count), desc=f"{len(grid) - 1} steps", unit="scan")
    ]
    return [replace(scan, sensor=load_sensor("town")) for scan in made]


def row(
    name: str, steps: int, measured: Sequence[Measured], errors: Sequence[float]
) -> str:
    """Means and standard deviations over the seeds."""
    columns = [
        [
            next(s.value for s in one.scores if s.metric.startswith(start))
            for one in measured
        ]
        for start in SHOWN.values()
    ]
    columns += [[one.classes[BEND] for one in measured], list(errors)]
    cells = []
    for values in columns:
        spread = f" ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else ""
        cells.append(f"{np.mean(values):.3g}{spread}")
    return f"| {name} | {steps} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("teacher", type=Path)
    parser.add_argument("latents", type=Path)
    parser.add_argument("work", type=Path, help="folder of students and trajectories")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=1000, help="of each student")
    parser.add_argument(
        "--pairs",
        type=int,
        default=3072,
        help="parts of trajectories for each time grid",
    )
    parser.add_argument("--count", type=int, default=64, help="scans in each set")
    parser.add_argument(
        "--intervals",
        type=int,
        default=200,
        help="resamples for 95 %% intervals; 0 = none",
    )
    given = parser.parse_args()

    given.work.mkdir(parents=True, exist_ok=True)
    teacher = load_generator(str(given.teacher))
    ablation = Ablation(
        teacher,
        np.load(given.latents, mmap_mode="r"),
        given.work,
        given.pairs,
        given.iterations,
    )
    every = students(ablation.selected())
    for seed in range(given.seeds):
        for student in every:
            ablation.train(student, seed)
    real = town(REFERENCE, given.count)
    judge = load_judge()
    plain = Comparison(real, judge)
    exact = Comparison(real, judge, given.intervals)
    columns = (*SHOWN, BEND, ERROR)
    lines = [
        f"| strategy | steps | {' | '.join(columns)} |",
        f"|---|---:|{'---:|' * len(columns)}",
    ]
    kept = []
    whole = ablation.end(teacher, uniform_grid(50))

    def add(name: str, generators: Sequence[Generator], grid: Grid) -> None:
        steps = len(grid) - 1
        sets = [sample(generator, grid, given.count) for generator in generators]
        errors = [
            100 * float((ablation.end(g, grid) - whole).square().mean() / whole.var())
            for g in generators
        ]
        lines.append(
            row(name, steps, [plain.measure(name, scans) for scans in sets], errors)
        )
        if steps == max(STEPS):
            kept.append(exact.measure(name, sets[0]))

    for steps in (50, *STEPS):
        add("teacher", [teacher], uniform_grid(steps))
    for student in every:
        add(
            student.strategy,
            [ablation.generator(student, seed) for seed in range(given.seeds)],
            student.grid,
        )
    print("\n".join(lines), f"\n\nSeed 0, {max(STEPS)} steps:\n\n{table(kept)}")


if __name__ == "__main__":
    main()
