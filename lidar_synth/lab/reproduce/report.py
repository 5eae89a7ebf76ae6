"""The tables that come out, and how long it takes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lidar_synth.errors import ConfigError, choose
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.lab.evaluate import PROTOCOLS
from lidar_synth.lab.evaluate.features import describe_missing, load_extractors
from lidar_synth.lab.evaluate.published import read_published, show_table
from lidar_synth.lab.reproduce.tables import PaperTable
from lidar_synth.lab.reproduce.work import TaskRun
from lidar_synth.lab.train.config import DistillConfig, load_config
from lidar_synth.lab.train.state import read_progress

HOUR = 3600.0


def reproduce(
    name: str, table: PaperTable, works: Mapping[str, TaskRun]
) -> Iterator[str]:
    """Do what a table needs; what is done already is kept.

    Args:
        name: of the table.
        table: what it needs.
        works: its tasks by name.

    Yields:
        Of each task, what has no weights of extractors; after the trainings, the paper's rows with
        those measured here below, in Markdown.

    Raises:
        ConfigError, FileError, DataError: as the trainings, the importers and ``evaluate``.
    """
    for work in works.values():
        work.check(_all_stages(table, work))
        if table.rows:
            work.open_reference()
            protocol = PROTOCOLS[work.task.protocol]
            if missing := load_extractors(protocol, work.weights).missing:
                yield describe_missing(missing, protocol)
    for task, work in works.items():
        for stage in _all_stages(table, work):
            work.train(stage)
        if not table.rows:
            here = 1000 * work.seconds("student", 4)
            paper = work.task.milliseconds
            yield f"{task}: {here:.0f} ms a scan in 4 steps on {work.device}; paper: {paper} ms"
            continue
        own = {}
        left_out: dict[str, str] = {}
        for stage, steps in table.rows:
            scores = work.compare(stage, steps, left_out)
            label = f"**{stage}**, {work.scale}, {work.count} scans"
            own[f"{label} | {steps}"] = scores
        [published] = [t for t in read_published()[0] if t.key == f"{name}/{task}"]
        yield f"{show_table(published, own)}\n\n{_times(work)}"
        yield describe_missing(left_out, PROTOCOLS[work.task.protocol])


def _all_stages(table: PaperTable, work: TaskRun) -> list[str]:
    """The stages of all rows, in order, each once."""
    wanted = [stage for stage, _ in table.rows] or ["student"]
    return list(dict.fromkeys(s for last in wanted for s in work.stages(last)))


def _times(work: TaskRun) -> str:
    """The timesteps of the student beside the paper's."""
    own = read_header(work.checkpoint("student"))[0].time_grid
    paper = load_config(DistillConfig, work.task.stages["student"]).grid or ()
    here, there = (", ".join(f"{t:.2f}" for t in grid[1:-1]) for grid in (own, paper))
    return f"Timesteps selected for this teacher: {here}; the paper's: {there}."


def estimate(table: PaperTable, works: Mapping[str, TaskRun]) -> Iterator[str]:
    """Lines of hours by stage, from a minute of each training and some generated scans.

    Args:
        table: what is to be done.
        works: its tasks by name, in a folder of their own and with a limit of time.

    Raises:
        ConfigError, FileError, DataError: as ``reproduce``.
    """
    total = 0.0
    for work in works.values():
        work.check(_all_stages(table, work))
    for task, work in works.items():
        for what, hours in _hours(table, work):
            total += hours
            yield f"{task:<10}{what:<30}{hours:10.2f} h"
    yield f"{'all':<40}{total:10.2f} h"


def _hours(table: PaperTable, work: TaskRun) -> Iterator[tuple[str, float]]:
    """(stage, hours) of a task."""
    for stage in _all_stages(table, work):
        work.train(stage)
        config = work.config(stage)
        done = read_progress(config.output)
        seconds = done.seconds / done.step * config.recipe.iterations
        yield f"train {stage}", seconds / HOUR
        if stage == "student":
            step = work.seconds("teacher", 4) / 4
            yield (
                "select timesteps",
                step * replace(work, minutes=None).evaluations / HOUR,
            )
    for stage, steps in table.rows:
        seconds = work.seconds(stage, steps) * work.count
        yield f"sample {stage}, {steps} steps", seconds / HOUR


def given_weights(
    given: Sequence[str], table: PaperTable
) -> dict[str, dict[str, Path]]:
    """{task: {stage: file}} of texts TASK.STAGE=FILE.

    Raises:
        ConfigError: on another text, a stage that the table does not need, or a missing file.
    """
    found: dict[str, dict[str, Path]] = {task: {} for task in table.tasks}
    for text in given:
        place, _, path = text.partition("=")
        task, _, stage = place.partition(".")
        if task not in found or not stage:
            raise ConfigError(
                f"--use {text!r}", f"TASK.STAGE=FILE with a task of {', '.join(found)}"
            )
        needed = _all_stages(table, TaskRun(task, Path()))
        choose("stage", stage, dict.fromkeys(needed))
        found[task][stage] = file = Path(path)
        if not file.is_file():
            raise ConfigError(
                f"--use {text!r}", "TASK.STAGE=FILE with a file that exists"
            )
    return found
