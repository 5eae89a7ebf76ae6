"""Conversion of any source of scans to any format, in parallel and resumable.

Scans that were written completely by an earlier run are not read again. A scan that cannot be read
stops the run, or is skipped and reported. Each worker process has its own copy of source and
writer; the main process writes the files of the whole folder at the end.
"""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from tqdm import tqdm

from lidar_synth.bank import is_url
from lidar_synth.errors import ConfigError, DataError, FileError, check_count
from lidar_synth.files.disk import hash_of_names
from lidar_synth.files.processes import map_in_processes
from lidar_synth.formats import OnBad, ScanFiles, Writer
from lidar_synth.formats.as_sensor import AsSensor
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.description import NAME, Origin, add_origin
from lidar_synth.formats.models import models_of, write_models
from lidar_synth.geometry import Scan, Sensor, Source
from lidar_synth.geometry.projection import unfold, unproject
from lidar_synth.geometry.transfer import Transfer

CHUNK = 8
"""Number of scans that a worker takes at a time."""


SETTINGS = ".convert.json"
"""File in the output folder with the settings of the conversion."""


@dataclass
class Report:
    """The result of a conversion.

    Args:
        written: number of scans written by this run.
        kept: number of scans that existed already.
        skipped: {id: reason} of the scans that could not be read or written.
        dropped: {id: number} of points that were dropped because they are NaN or infinite.
        left_out: descriptions of files that the format supports but the source does not have.
        seen: for each scan that another sensor saw, the share of its rays within the first sensor's
            field of view.
        lost: {field: number of written scans that had it, though the format cannot hold it}.
        unlabelled: number of written scans without labels, where the format has labels of every
            scan.
    """

    written: int = 0
    kept: int = 0
    skipped: dict[str, str] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list, compare=False)
    seen: list[float] = field(default_factory=list, compare=False)
    lost: Counter[str] = field(default_factory=Counter, compare=False)
    unlabelled: int = field(default=0, compare=False)

    def add(
        self, writer: Writer, scan: Scan, camera: Calibration | None = None
    ) -> None:
        """Count a scan that was written, and what it lost."""
        self.written += 1
        self.lost.update(writer.loses(scan, camera))
        self.unlabelled += writer.always_labels and scan.label is None


class Outcome(NamedTuple):
    """The result for one scan.

    Args:
        number: its index in the source.
        skipped: the reason why it was not written; "" if it was.
        dropped: number of points that were dropped.
        origin: where the scan comes from; None if it was not written.
        seen: as in ``Report``; None without another sensor.
        lost: names of what the scan had, though the format cannot hold it.
        unlabelled: whether it got labels of 0 because its labels are unknown.
    """

    number: int
    skipped: str = ""
    dropped: int = 0
    origin: Origin | None = None
    seen: float | None = None
    lost: tuple[str, ...] = ()
    unlabelled: bool = False


def convert(
    source: Source,
    writer: Writer,
    *,
    jobs: int = 1,
    on_bad: OnBad = "error",
    as_sensor: AsSensor | Transfer | Sensor | None = None,
    unfold: bool = False,
    strict: bool = False,
    progress: bool = True,
) -> Report:
    """Write every scan of a source; a rerun resumes an interrupted conversion.

    Args:
        source: the scans, read one at a time. With more than one job it is pickled.
        writer: the output. The scans of a dataset keep their names.
        jobs: number of worker processes.
        on_bad: ``"error"`` stops at the first scan that cannot be read, or that the format cannot
            represent; ``"skip"`` skips and reports it; ``"drop-points"`` drops points that are NaN
            or infinite, counts them, and stops at any other fault.
        as_sensor: turn every scan into one of this sensor first (``geometry.transfer``).
        unfold: unfold every scan to a grid with one row per laser (``projection.unfold``).
        strict: refuse a scan with something that the format cannot hold, such as boxes, instead of
            counting it.
        progress: whether to show a progress bar.

    Returns:
        Number of scans written and kept, skipped scans with reasons, and what was left out.

    Raises:
        ConfigError: on fewer than one job, an output folder that is the source's or has the scans
            of another conversion or sensor, or a source whose points are not those of its sensor;
            with ``strict``, on a scan that would lose something.
        FileError: if the output cannot be written, for any ``on_bad``.
        DataError: on a bad scan, unless ``on_bad="skip"``; if what lies beside the scans is
            damaged.
    """
    check_count("jobs", jobs, 1)
    change = _change(as_sensor)
    models = []
    if isinstance(source, ScanFiles):
        source.check_sensor()  # first, so that a wrong sensor leaves no settings behind
        models = models_of(source.root)
    settings = _settings(source, writer, change, unfold)
    with writer.hold(SETTINGS, settings, source):
        work = partial(convert_one, source, writer, change, unfold, on_bad, strict)
        report = _write_missing(source, writer, change, work, on_bad, jobs, progress)
        write_models(writer.root, models if report.written or report.kept else [])
    return report


def _write_missing(
    source: Source,
    writer: Writer,
    change: AsSensor | None,
    work: Callable[[int], Outcome],
    on_bad: OnBad,
    jobs: int,
    progress: bool,
) -> Report:
    """The part of ``convert`` that writes."""
    missing, report = _compare(source, writer, on_bad)
    if change is not None and change.moves:
        if type(writer).carry is not Writer.carry:
            report.left_out += [
                "files such as times.txt, which are copied only where the sensor stays in its place"
            ]
    elif isinstance(source, ScanFiles):
        report.left_out += writer.carry(source)
    with map_in_processes(work, missing, jobs, CHUNK) as results:
        for done in tqdm(
            results, total=len(missing), unit="scan", disable=not (progress and missing)
        ):
            _count(report, done, name_of(source, done.number) or str(done.number))
            if done.origin is not None and jobs > 1 and (writer.root / NAME).is_file():
                # Again: two workers may have added theirs at the same moment.
                add_origin(writer.root, done.origin)
    writer.finish()
    return report


def _count(report: Report, done: Outcome, name: str) -> None:
    if done.skipped:
        report.skipped[name] = done.skipped
    else:
        report.written += 1
    if done.dropped:
        report.dropped[name] = done.dropped
    if done.seen is not None:
        report.seen.append(done.seen)
    report.lost.update(done.lost)
    report.unlabelled += done.unlabelled


def _change(as_sensor: AsSensor | Transfer | Sensor | None) -> AsSensor | None:
    if isinstance(as_sensor, AsSensor | None):
        return as_sensor
    return AsSensor(
        as_sensor if isinstance(as_sensor, Transfer) else Transfer(as_sensor)
    )


def _compare(source: Source, writer: Writer, on_bad: OnBad) -> tuple[list[int], Report]:
    """Indices of the scans that are still to be written, and a report of the existing ones.

    Raises:
        DataError: with ``on_bad="error"``, on a scan whose name cannot be a path under the output
            folder, or is that of an earlier scan.
    """
    report = Report()
    missing = []
    taken: set[str] = set()
    drives = set()
    for index in range(len(source)):
        name = name_of(source, index)
        try:
            path = writer.path(index, name)
            places = {os.path.normcase(path)} | (
                {f"id {name}"} if name is not None else set()
            )
            if places & taken:
                raise DataError(
                    f"scan {index} is called {name!r}",
                    "a name, and a file, that no earlier scan has",
                )
            taken |= places
            drives.add((path.parent, (name or "").rpartition("/")[0]))
        except DataError as error:
            if on_bad == "error":
                raise
            report.skipped[f"{name} (scan {index})"] = str(error)
            continue
        if writer.complete(index, name):
            report.kept += 1
        else:
            missing.append(index)
    if len(dict(drives)) < len(drives) and "pose" in writer.keeps:
        report.left_out.append("the limits of drives: several become one")
    return missing, report


def convert_one(
    source: Source,
    writer: Writer,
    change: AsSensor | None,
    unfold: bool,
    on_bad: OnBad,
    strict: bool,
    index: int,
) -> Outcome:
    """Write the scan at ``index``, as another sensor would have recorded it if one is given.

    Raises:
        ConfigError, DataError, FileError: as ``convert``.
    """
    camera = None
    dropped = 0
    seen = None
    try:
        if isinstance(source, ScanFiles):
            # Not source[index]: with on_bad="skip" that would be the next scan, under the name of
            # the bad one.
            scan = source.load(index, on_bad == "drop-points")
            camera = source.calibration(index)
            dropped = source.dropped.get(source.ids[index], 0)
        else:
            scan = source[index]
        if change is not None:
            scan, seen = change.cast(scan, source, index)
            camera = change.calibration(camera)
        scan = unfolded(scan) if unfold else scan
        lost = writer.loses(scan, camera)
    except (DataError, FileError) as error:
        if on_bad != "skip":
            raise
        return Outcome(index, str(error))
    if strict and lost:
        raise ConfigError(
            f"scan {scan.id!r} has {', '.join(lost)}, which {type(writer).__name__} cannot hold",
            "a format that holds all that a scan has",
            "Choose another, such as npz or webdataset, or convert without --strict (strict=True).",
        )
    try:
        writer.write(scan, index, name=name_of(source, index), calibration=camera)
    except DataError as error:
        if on_bad != "skip":
            raise
        return Outcome(index, str(error))
    unlabelled = writer.always_labels and scan.label is None
    return Outcome(index, "", dropped, Origin.of(scan), seen, tuple(lost), unlabelled)


def unfolded(scan: Scan) -> Scan:
    """The scan on a grid with one row per laser: one return per cell, on the ray through the cell's
    centre. Boxes, pose and image stay unchanged.

    Raises:
        DataError: on a scan that cannot be unfolded.
    """
    seen = unproject(unfold(scan))
    for name in ("boxes", "pose", "image_path", "id", "domain", "provenance"):
        setattr(seen, name, getattr(scan, name))
    return seen


def name_of(source: Source, index: int) -> str | None:
    """The id of a scan that has not been read; None if the source has no ids."""
    return source.ids[index] if isinstance(source, ScanFiles) else None


def _settings(
    source: Source, writer: Writer, change: AsSensor | None, unfold: bool
) -> dict[str, Any]:
    """The settings that determine which scans are written, as far as the source has them."""
    settings: dict[str, Any] = {
        "scans": len(source),
        "writer": type(writer).__name__,
        "unfold": unfold,
    }
    if isinstance(source, ScanFiles):
        settings |= {
            "root": str(source.root if is_url(source.root) else source.root.resolve()),
            "sensor": source.sensor.to_dict(),
        }
        settings["names"] = hash_of_names(source.ids)
        settings["options"] = source.options
    return settings | {"as_sensor": None if change is None else change.identity}
