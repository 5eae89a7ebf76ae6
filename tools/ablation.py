"""Compare distillation strategies at an equal budget of network evaluations (the paper's Table 4).

    python tools/ablation.py TEACHER WORK [--evaluations 20000] [--count 256] [KEY=VALUE ...]

Every strategy trains a student from the same teacher, with the same noise and data and the same number of network
evaluations: each sample costs the teacher's steps and one evaluation of the student. KEY=VALUE changes the recipe
town_student for all of them. Students of an earlier call are reused. The figures are those of tools/model_card.py, and
the table is that of docs/research/strategies.md. The time grid is the selected one for adaptive_piecewise and uniform
for the others.
"""

import argparse
from pathlib import Path

from model_card import REFERENCE, Comparison, generate, table, town

from lidar_synth.evaluate.segmentation import load_judge
from lidar_synth.flow.distill import STRATEGIES
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.train.config import DistillConfig, load_config
from lidar_synth.train.runs import checkpoint_path, run

ROOT = Path(__file__).parents[1]
WHOLE = ("reflow", "timestep_distillation")
"""Strategies whose teacher runs from noise to data for every sample."""


def student(strategy: str, teacher: Path, work: Path, evaluations: int, overrides: list[str]) -> tuple[Path, str]:
    """The checkpoint of one strategy, and a description of its budget."""

    def configured(*more: str) -> DistillConfig:
        path = ROOT / "configs" / "town_student.yaml"
        own = (
            "weaker=null",  # without autoguidance, which would affect the strategies differently
            "guidance=1",
            f"output={work / strategy}",
            f"data.cache={work / 'cache'}",
            f"teacher={teacher}",
            f"strategy={strategy}",
        )
        return load_config(DistillConfig, path, [*overrides, *own, *more])

    plain = configured()
    steps = plain.steps * (plain.intervals if strategy in WHOLE else 1)
    iterations = evaluations // ((steps + 1) * plain.recipe.batch)
    config = configured(f"steps={steps}", f"recipe.iterations={iterations}")
    path = checkpoint_path(config)
    if not path.exists() or read_header(path)[0].provenance.get("iterations") != iterations:
        path = run(config, resume=True)
    return path, f"{steps} teacher steps, {iterations} iterations of {plain.recipe.batch}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("teacher", type=Path)
    parser.add_argument("work", type=Path, help="folder of the students")
    parser.add_argument("--evaluations", type=int, default=20_000, help="network evaluations of each strategy")
    parser.add_argument("--count", type=int, default=256, help="scans in each set")
    parser.add_argument("--intervals", type=int, default=200, help="resamples for 95 %% intervals; 0 = none")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    given = parser.parse_intermixed_args()

    comparison = Comparison(town(REFERENCE, given.count), load_judge(), given.intervals)
    sets = []

    def add(name: str, model: str, steps: int | None) -> None:
        scans = generate(model, steps, given.count)
        sets.append(comparison.measure(name, scans))

    for steps in (50, 4):
        add(f"teacher, {steps} steps", str(given.teacher), steps)
    for strategy in STRATEGIES:
        path, what = student(strategy, given.teacher, given.work, given.evaluations, given.overrides)
        add(f"{strategy}, 4 steps ({what})", str(path), None)
    print(f"{given.evaluations} evaluations for each strategy, {given.count} scans\n\n{table(sets)}")


if __name__ == "__main__":
    main()
