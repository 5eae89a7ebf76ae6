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
from typing import Any, TypeVar

from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import OnBad, ScanFiles, Writer
from lidar_synth.formats.writer import claim
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Scan, Source
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
    """

    written: int = 0
    kept: int = 0
    skipped: dict[str, str] = field(default_factory=dict)


def convert(
    source: Source,
    writer: Writer,
    *,
    jobs: int = 1,
    on_bad: OnBad = "error",
    as_sensor: Sensor | None = None,
    progress: bool = True,
) -> Report:
    """Write every scan of a source; rerun to go on where it stopped.

    Args:
        source: the scans; it is asked for one index at a time. With more than one job it is pickled.
        writer: where they go. The scans of a dataset keep their names there.
        jobs: worker processes.
        on_bad: ``"error"`` stops at the first scan that cannot be read or held by the format; ``"skip"`` leaves it
            out and reports it.
        as_sensor: re-project every scan to this sensor's grid first.
        progress: show a bar.

    Returns:
        How many scans were written and kept, and what was skipped and why.

    Raises:
        ConfigError: on fewer than one job, or an output folder that was filled from something else.
        FileError: where the output cannot be written, whatever ``on_bad`` says.
        DataError: on a bad scan, with ``on_bad="error"``.
    """
    if jobs < 1:
        raise ConfigError(f"{jobs} jobs", "at least 1")
    claim(writer.root / SETTINGS, _settings(source, writer, as_sensor))
    missing, report = _compare(source, writer, on_bad)
    work = partial(convert_one, source, writer, as_sensor, on_bad)
    with in_processes(work, missing, jobs, CHUNK) as results:
        for index, reason in tqdm(results, total=len(missing), unit="scan", disable=not (progress and missing)):
            if reason:
                report.skipped[name_of(source, index) or str(index)] = reason
            else:
                report.written += 1
    writer.finish()
    return report


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


def convert_one(source: Source, writer: Writer, as_sensor: Sensor | None, on_bad: OnBad, index: int) -> tuple[int, str]:
    """Write the scan at ``index``.

    Returns:
        The index, and why the scan was skipped ("" where it was written).

    Raises:
        DataError, FileError: as ``convert``.
    """
    camera = None
    try:
        if isinstance(source, ScanFiles):
            # Not source[index]: a source that skips would give the next scan in a bad one's place, under its name.
            scan, camera = source.read(index), source.calibration(index)
        else:
            scan = source[index]
        scan = scan if as_sensor is None else reproject(scan, as_sensor)
    except (DataError, FileError) as error:
        if on_bad == "error":
            raise
        return index, str(error)
    try:
        writer.write(scan, index, name=name_of(source, index), calibration=camera)
    except DataError as error:
        if on_bad == "error":
            raise
        return index, str(error)
    return index, ""


def reproject(scan: Scan, sensor: Sensor) -> Scan:
    """The scan as another sensor's grid would hold it: one return per cell, through the cell's centre.

    What stands in the scan's frame (boxes, pose, image) stays as it is.
    """
    seen = unproject(project(scan, sensor))
    for name in ("boxes", "pose", "image_path", "id", "domain"):
        setattr(seen, name, getattr(scan, name))
    return seen


def name_of(source: Source, index: int) -> str | None:
    """The id of a scan that is not read yet; None where the source does not tell it."""
    return source.ids[index] if isinstance(source, ScanFiles) else None


def _settings(source: Source, writer: Writer, as_sensor: Sensor | None) -> dict[str, Any]:
    """What decides which scans are written, as far as the source tells it."""
    settings: dict[str, Any] = {"scans": len(source), "writer": type(writer).__name__}
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
