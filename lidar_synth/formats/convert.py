"""From any source of scans to any format, in parallel, going on where an earlier run stopped.

A scan that is already there whole is not read again; a scan that cannot be read stops the run, or is counted, named
and left out. Each worker process has its own copy of source and writer, and the main one writes what belongs to a
whole folder at the end.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from typing import Any, NamedTuple, TypeVar

from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import OnBad, ScanFiles, Writer
from lidar_synth.formats.domain import mark_synthetic
from lidar_synth.formats.writer import claim
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.projection import unfold as unfold_rings
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Scan, Source
from lidar_synth.geometry.sensor import Sensor

CHUNK = 8
"""Scans that a worker takes at a time."""


SETTINGS = ".convert.json"
"""File in the output folder that says what it was filled with."""


@dataclass
class Report:
    """What a conversion did.

    Args:
        written: scans written now.
        kept: scans that were there already.
        skipped: {id: reason} of the scans that could not be read or written.
        dropped: {id: number} of points that were left out of a scan because they are NaN or infinite.
        left_out: what the format has a place for beside the scans and the source does not tell, in words.
    """

    written: int = 0
    kept: int = 0
    skipped: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list, compare=False)


class Outcome(NamedTuple):
    """What became of one scan.

    Args:
        number: its index in the source.
        skipped: why it was not written; "" where it was.
        dropped: points that were left out of it.
        domain: of the scan; None where it was not read.
    """

    number: int
    skipped: str = ""
    dropped: int = 0
    domain: int | None = None


def convert(
    source: Source,
    writer: Writer,
    *,
    jobs: int = 1,
    on_bad: OnBad = "error",
    as_sensor: Sensor | None = None,
    unfold: bool = False,
    progress: bool = True,
) -> Report:
    """Write every scan of a source; rerun to go on where it stopped.

    Args:
        source: the scans; it is asked for one index at a time. With more than one job it is pickled.
        writer: where they go. The scans of a dataset keep their names there.
        jobs: worker processes.
        on_bad: ``"error"`` stops at the first scan that cannot be read or held by the format; ``"skip"`` leaves it
            out and reports it; ``"drop-points"`` leaves out points that are NaN or infinite, counts them, and stops at
            everything else.
        as_sensor: re-project every scan to this sensor's grid first.
        unfold: put every scan on a grid with one row per laser, ring by ring (``projection.unfold``); of
            ``as_sensor``'s lasers, or of the scan's own sensor.
        progress: show a bar.

    Returns:
        How many scans were written and kept, what was skipped and why, and what was left out.

    Raises:
        ConfigError: on fewer than one job, or an output folder that was filled from something else.
        FileError: where the output cannot be written, whatever ``on_bad`` says.
        DataError: on a bad scan, unless ``on_bad="skip"``.
    """
    if jobs < 1:
        raise ConfigError(f"{jobs} jobs", "at least 1")
    claim(writer.root / SETTINGS, _settings(source, writer, as_sensor, unfold))
    missing, report = _compare(source, writer, on_bad)
    if isinstance(source, ScanFiles):
        report.left_out = writer.carry(source)
    grid = partial(reproject, sensor=as_sensor, unfold=unfold) if unfold or as_sensor is not None else None
    work = partial(convert_one, source, writer, grid, on_bad)
    domains: set[int | None] = set()
    try:
        with in_processes(work, missing, jobs, CHUNK) as results:
            for done in tqdm(results, total=len(missing), unit="scan", disable=not (progress and missing)):
                _count(report, done, name_of(source, done.number) or str(done.number))
                domains.add(done.domain)
    finally:
        if SYNTHETIC in domains and REAL not in domains:
            mark_synthetic(writer.root)
    writer.finish()
    return report


def _count(report: Report, done: Outcome, name: str) -> None:
    if done.skipped:
        report.skipped[name] = done.skipped
    else:
        report.written += 1
    if done.dropped:
        report.dropped[name] = done.dropped


def _compare(source: Source, writer: Writer, on_bad: OnBad) -> tuple[list[int], Report]:
    """Indices of the scans that are not there yet, and what is known before any is read.

    Raises:
        DataError: on a scan whose name is no path under the output folder, or that of a scan before it, with
            ``on_bad="error"``.
    """
    report, missing = Report(), []
    taken: set[str] = set()
    for index in range(len(source)):
        name = name_of(source, index)
        try:
            places = {os.path.normcase(writer.path(index, name))} | ({f"id {name}"} if name is not None else set())
            if places & taken:
                raise DataError(f"scan {index} is called {name!r}", "a name, and a file, that no scan before it has")
            taken |= places
        except DataError as error:
            if on_bad == "error":
                raise
            report.skipped[f"{name} (scan {index})"] = str(error)
            continue
        if writer.complete(index, name):
            report.kept += 1
        else:
            missing.append(index)
    return missing, report


def convert_one(
    source: Source, writer: Writer, grid: Callable[[Scan], Scan] | None, on_bad: OnBad, index: int
) -> Outcome:
    """Write the scan at ``index``, on another grid if there is one.

    Raises:
        DataError, FileError: as ``convert``.
    """
    camera, dropped = None, 0
    try:
        if isinstance(source, ScanFiles):
            # Not source[index]: a source that skips would give the next scan in a bad one's place, under its name.
            scan, camera = source.load(index, on_bad == "drop-points"), source.calibration(index)
            dropped = source.dropped.get(source.ids[index], 0)
        else:
            scan = source[index]
        scan = scan if grid is None else grid(scan)
    except (DataError, FileError) as error:
        if on_bad != "skip":
            raise
        return Outcome(index, str(error))
    try:
        writer.write(scan, index, name=name_of(source, index), calibration=camera)
    except DataError as error:
        if on_bad != "skip":
            raise
        return Outcome(index, str(error))
    return Outcome(index, "", dropped, scan.domain)


def reproject(scan: Scan, sensor: Sensor | None = None, unfold: bool = False) -> Scan:
    """The scan as another sensor's grid would hold it: one return per cell, through the cell's centre.

    What stands in the scan's frame (boxes, pose, image) stays as it is.

    Args:
        scan: N points.
        sensor: whose grid; the scan's own by default.
        unfold: one row per laser, ring by ring, in the place of rows of elevation.

    Raises:
        DataError: on a scan that cannot be unfolded.
    """
    seen = unproject((unfold_rings if unfold else project)(scan, sensor))
    for name in ("boxes", "pose", "image_path", "id", "domain"):
        setattr(seen, name, getattr(scan, name))
    return seen


def name_of(source: Source, index: int) -> str | None:
    """The id of a scan that is not read yet; None where the source does not tell it."""
    return source.ids[index] if isinstance(source, ScanFiles) else None


def _settings(source: Source, writer: Writer, as_sensor: Sensor | None, unfold: bool) -> dict[str, Any]:
    """What decides which scans are written, as far as the source tells it."""
    settings: dict[str, Any] = {"scans": len(source), "writer": type(writer).__name__, "unfold": unfold}
    if isinstance(source, ScanFiles):
        settings |= {"root": str(source.root.resolve()), "sensor": (as_sensor or source.sensor).to_dict()}
    return settings


Item = TypeVar("Item")
Result = TypeVar("Result")

_work: Callable[[Any], Any] | None = None


def _start(work: Callable[[Any], Any]) -> None:
    """Give a worker what it works with once, and not with every item."""
    global _work
    _work = work


def _next(item: Any) -> Any:
    assert _work is not None, "a worker that was not started by in_processes"
    return _work(item)


@contextmanager
def in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int, chunk: int = 1
) -> Iterator[Iterator[Result]]:
    """The results of ``work`` on each item, in order, by as many processes as there are jobs.

    Args:
        work: a function that can be pickled.
        items: what to work on.
        jobs: processes; with one, the work is done here.
        chunk: items that a worker takes at a time.
    """
    if jobs == 1 or len(items) < 2:
        yield map(work, items)
        return
    # Spawned, not forked: the parent may hold threads (numba, torch) that a fork would break. One process per core
    # does the work: threads inside numpy would only fight for the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ProcessPoolExecutor(jobs, get_context("spawn"), _start, (work,)) as pool:
        try:
            yield pool.map(_next, items, chunksize=chunk)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
