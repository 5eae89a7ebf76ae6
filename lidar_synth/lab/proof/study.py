"""``prove``: what synthetic scans add to a labelled dataset, measured on places that were left
out."""

import json
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lidar_synth.bake.shard import torch_threads
from lidar_synth.datasets.recordings import PLACES, TOWN, seen_by
from lidar_synth.errors import DataError, parsing
from lidar_synth.files.claims import claim
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.files.parsing import parse_json, read_sealed, seal
from lidar_synth.files.processes import map_in_processes, usable_cores
from lidar_synth.formats import ScanFiles, layout_of, open_scans
from lidar_synth.geometry import Scan, Source
from lidar_synth.lab.evaluate.leakage import refuse_leaks
from lidar_synth.lab.proof.arms import CONSTANTS, Row
from lidar_synth.lab.proof.beams import keep_beams
from lidar_synth.lab.proof.page import body, write_body
from lidar_synth.lab.proof.plan import Pair, ProofPlan
from lidar_synth.lab.proof.planning import locate, make_plan
from lidar_synth.lab.proof.pools import (
    OF_GENERATOR,
    PoolTask,
    has_lasers,
    make_pool,
    match_reflectance,
    read_pool,
    seconds_of,
    town_seed,
)
from lidar_synth.lab.proof.settings import ProofSettings
from lidar_synth.lab.proof.summary import Proof, Results, summarise
from lidar_synth.lab.proof.trial import (
    Job,
    Trainer,
    TrialOutcome,
    reference,
    run_trainer,
)

STUDY = "study.json"
GENERATOR = "generator.json"
RUNS = "runs"
POOLS = "pools"
JOBS = "jobs"
PAGE = "index.html"
RESULTS = "results.json"


Task = tuple[Row, Sequence[Pair]]
"""A training, and the pairs whose places it is tested on."""


@dataclass(frozen=True)
class Trainings:
    """What every process needs for its trainings.

    Args:
        plan: the plan.
        scans: {index: scan on the grid}.
        out: the output folder.
        pools: the folder of the pools.
        trainer: trains and tests.
        deadline: ``time.time()`` after which no training begins; None for no limit.
    """

    plan: ProofPlan
    scans: dict[int, Scan]
    out: Path
    pools: Path
    trainer: Trainer
    deadline: float | None

    def path(self, row: Row, pair: Pair) -> Path:
        """The file of an outcome."""
        place, seed = pair
        return (
            self.out
            / RUNS
            / row.key
            / f"{seed}-{sorted(self.plan.places).index(place):03d}.json"
        )

    def pool_folder(self, kind: str, place: str) -> Path:
        """The folder of a pool: one for all places, but for skins, which must not know the place
        that is tested on."""
        own = kind == "skin" and self.plan.training is None
        number = sorted(self.plan.places).index(place)
        return self.pools / (f"skin-{number:03d}" if own else kind)

    def __call__(self, task: Task) -> bool:
        """Train and write the outcomes, unless the time is over; returns whether it did."""
        row, pairs = task
        expected = self.plan.seconds(row)
        if self.deadline is not None and time.time() + expected > self.deadline:
            return False
        # The trainings share the cores among them.
        with torch_threads(1):
            outcomes = run_trainer(self.trainer, self._job(row, pairs))
        for pair in pairs:
            write_file(self.path(row, pair), seal(to_values(outcomes[pair[0]])))
        return True

    def _job(self, row: Row, pairs: Sequence[Pair]) -> Job:
        plan = self.plan
        place, seed = pairs[0]
        kinds = row.arm.pools()
        folders = {kind: self.pool_folder(kind, place) for kind in kinds}
        used = {stage.pool for stage in row.stages()}
        pools = {kind: _pool(folders[kind]) for kind in kinds if kind in used}
        real = [self.scans[i] for i in plan.labelled[pairs[0]]]
        whole = plan.settings.beams is None
        for kind in OF_GENERATOR & pools.keys():
            if whole and not has_lasers(plan.settings.model, plan.sensor):
                pools[kind] = match_reflectance(pools[kind], real)
                del folders[kind]
        return Job(
            row,
            seed,
            real,
            held_out={
                name: [self.scans[i] for i in plan.tested[name]] for name, _ in pairs
            },
            pools=pools,
            iterations=round(plan.settings.iterations * row.arm.iterations),
            batch=plan.settings.batch,
            widths=plan.settings.widths,
            half=plan.half,
            folder=self.out / JOBS / row.key / self.path(row, pairs[0]).stem,
            pool_folders=folders,
            device=plan.device,
        )


_pool = lru_cache(maxsize=2)(read_pool)


def prove(
    scans: str | Path | Source,
    out: str | Path = "proof",
    settings: ProofSettings | None = None,
    *,
    minutes: float | None = None,
    jobs: int | None = None,
    trainer: Trainer = reference,
    pools: str | Path | None = None,
    tests: str | Path | Source | None = None,
    device: str = "cpu",
    progress: bool = True,
) -> Proof:
    """Measure what synthetic scans add to your labelled scans, on places that no training has seen.

    Every place is left out in turn. The same small network is trained on labelled scans of the
    other places in several ways (``ARMS``), with the same scans, seeds, iterations, augmentation
    and schedule, and tested on the place left out. The result is a page, ``index.html`` in ``out``.
    Run it again to resume, or to add arms and seeds.

    Args:
        scans: labelled scans: what ``open_scans`` opens, or a source.
        out: folder to write to.
        settings: of the comparison.
        minutes: limit of the time; places and seeds are chosen so that it is kept, and if not even
            two fit, the iterations of a training.
        jobs: processes of one thread each; by default one for each core. With more than one, a
            script calls this below ``if __name__ == "__main__":``.
        trainer: your own in the place of the small network: a function that can be pickled, or a
            ``CommandTrainer``.
        pools: folder of the synthetic scans, which several comparisons may share; by default in
            ``out``.
        tests: labelled scans of other places to test on, such as a dataset's validation split; one
            training is tested on all of them. By default each place of ``scans`` is left out in
            turn.
        device: on which the small network computes, such as "cuda"; all jobs share it.
        progress: whether to show progress bars.

    Returns:
        The result; ``print`` shows its table.

    Raises:
        ConfigError: on settings that do not fit the scans, a folder with another comparison, a
            device that is not there, or a generator that was trained on places that are tested.
        DataError: on one place only, on scans without labels, or a class that nothing is labelled
            as.

    Example:
        >>> from lidar_synth import ProofSettings, prove
        >>> short = {"iterations": 10, "batch": 1, "seeds": 1, "columns": 64}  # only to be fast
        >>> settings = ProofSettings(arms=("real", "exchange"), places="stretch:2", **short)
        >>> proof = prove("demo_out/town", "proof", settings, jobs=1, progress=False)
        >>> proof.values["tested_places"], len(proof.values["arms"])
        (['00, stretch 1', '00, stretch 2'], 2)
    """
    start = time.time()
    out = Path(out)
    source = open_scans(scans) if isinstance(scans, str | Path) else scans
    if isinstance(tests, str | Path):
        tests = open_scans(tests)
    jobs = jobs or usable_cores()
    plan, loaded = make_plan(
        source, settings or ProofSettings(), minutes, jobs, _earlier(out), tests, device
    )
    seen = ""
    if any(OF_GENERATOR & row.arm.pools() for row in plan.rows):
        generator = refuse_leaks(
            plan.settings.model, plan.recordings, _nameless(source, tests, plan)
        )
        claim(
            out / GENERATOR,
            {"model": plan.settings.model, "checkpoint": generator.hash},
        )
        recordings = seen_by(generator.header.provenance)
        seen = str(recordings) or "scans that its file does not name"
        if any(dataset == TOWN for dataset, _ in recordings.drives):
            seen += CONSTANTS
    named = getattr(
        trainer, "command", getattr(trainer, "__name__", type(trainer).__name__)
    )
    claim(out / STUDY, plan.identity() | {"trainer": named})
    deadline = None if minutes is None else start + 60 * minutes
    work = Trainings(plan, loaded, out, Path(pools or out / POOLS), trainer, deadline)
    _make_pools(work, source, progress)
    tasks = [
        (row, pairs)
        for pairs in plan.trainings(plan.pairs)
        for row in plan.rows
        if not all(_is_there(work.path(row, pair), read_outcome) for pair in pairs)
    ]
    _run_all(work, tasks, jobs, "trainings", progress)
    return report(work, named, seen)


def report(work: Trainings, trainer: str, seen: str = "") -> Proof:
    """Summarise the trainings that are there, and write the page and ``results.json``.

    Args:
        work: the trainings.
        trainer: the name of the trainer.
        seen: what the generator was trained on.

    Raises:
        DataError: if no pair is complete.
    """
    found: Results = {}
    plan = work.plan
    for pair in plan.pairs:
        paths = {row: work.path(row, pair) for row in plan.rows}
        if all(path.is_file() for path in paths.values()):
            found[pair] = {row: read_outcome(path) for row, path in paths.items()}
    if not found:
        raise DataError(
            "no place with trainings of all arms",
            "at least one",
            "Give more --minutes.",
        )
    costs = {row.key: _preparation(work, row) for row in plan.rows}
    proof = summarise(plan, found, costs, trainer, seen)
    write_file(work.out / RESULTS, (json.dumps(proof.values, indent=1) + "\n").encode())
    write_body(work.out / PAGE, body(proof.values))
    return proof


def to_values(outcome: TrialOutcome) -> dict[str, Any]:
    """An outcome as plain values."""
    curve = [[step, table.tolist()] for step, table in outcome.curve]
    return {
        "table": outcome.table.tolist(),
        "curve": curve,
        "losses": outcome.losses,
        "seconds": outcome.seconds,
    }


def read_outcome(path: Path) -> TrialOutcome:
    """The inverse of ``to_values``, from a sealed file.

    Raises:
        FileError: if it cannot be read.
        DataError: on a damaged file.
    """
    values = read_sealed(path, "the outcome of a training")
    with parsing(path, "the outcome of a training", "Remove it."):
        table = np.array(values["table"], np.int64)
        curve = [
            (int(step), np.array(part, np.int64)) for step, part in values["curve"]
        ]
        return TrialOutcome(
            table, curve, [float(v) for v in values["losses"]], float(values["seconds"])
        )


def _is_there(path: Path, read: Callable[[Path], object]) -> bool:
    """Whether a file is there and intact; a damaged one is set aside with a warning, to be made
    again."""
    if not path.is_file():
        return False
    try:
        read(path)
    except DataError as error:
        warnings.warn(f"{error}; it is made again", stacklevel=2)
        path.replace(path.with_suffix(".damaged"))
        return False
    return True


def _earlier(out: Path) -> dict[str, Any] | None:
    """The identity of the comparison that is resumed; None where there is none."""
    path = out / STUDY
    if not path.is_file():
        return None
    values = parse_json(read_text(path), str(path))
    valid = isinstance(values, dict) and isinstance(values.get("iterations"), int)
    return values if valid else None


def _plan_pools(work: Trainings, source: Source) -> list[PoolTask]:
    """What to make, once for each folder."""
    plan = work.plan
    tasks = {}
    kinds = {kind for row in plan.rows for kind in row.arm.pools()}
    seed = town_seed(plan.recordings)
    for place in dict.fromkeys(place for place, _ in plan.pairs):
        for kind in sorted(kinds):
            folder = work.pool_folder(kind, place)
            indices = plan.skin_scans(place)
            tasks[folder] = PoolTask(
                kind,
                folder,
                plan.sensor,
                plan.grid,
                plan.settings.synthetic,
                seed,
                plan.settings.model,
                partial(_scans, source, indices, plan.settings.beams),
                tuple(plan.names[i] for i in indices),
            )
    return list(tasks.values())


def _make_pools(work: Trainings, source: Source, progress: bool) -> None:
    _run_all(
        make_pool,
        _plan_pools(work, source),
        work.plan.jobs,
        "synthetic scans",
        progress,
        "pool",
    )


def _run_all(
    work: Callable[[Any], object],
    tasks: Sequence[Any],
    jobs: int,
    name: str,
    progress: bool,
    unit: str = "it",
) -> None:
    """Do all tasks in processes, with a bar of this name."""
    with map_in_processes(work, tasks, min(jobs, max(1, len(tasks)))) as done:
        for _ in tqdm(done, name, len(tasks), unit=unit, disable=not progress):
            pass


def _nameless(source: Source, tests: Source | None, plan: ProofPlan) -> Iterator[Scan]:
    """The scans of the tested places, unless their names say which recordings they are of."""
    tested = source if tests is None else tests
    if isinstance(tested, ScanFiles) and layout_of(tested.root) in PLACES:
        return
    for place in dict.fromkeys(place for place, _ in plan.pairs):
        for index in plan.places[place]:
            origin, number = locate(source, tests, index)
            yield origin[number]


def _scans(source: Source, indices: Sequence[int], beams: int | None) -> list[Scan]:
    return [keep_beams(source[i], beams) for i in indices]


def _preparation(work: Trainings, row: Row) -> float:
    """Seconds that the pools of an arm took; the mean over places for skins."""
    total = 0.0
    for kind in row.arm.pools():
        folders = {work.pool_folder(kind, place) for place, _ in work.plan.pairs}
        total += float(np.mean([seconds_of(folder) for folder in folders]))
    return total
