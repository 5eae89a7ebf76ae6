"""What lies in a folder of scans: layout, labels, boxes and sensor, which is fitted if it is not
known."""

import logging
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.datasets.classes import NAMES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import ScanFiles, layout_of, open_scans
from lidar_synth.geometry import Scan, spread
from lidar_synth.geometry.agreement import agreement
from lidar_synth.geometry.overlap import count_overlapping
from lidar_synth.lab.fitting import SensorFit, fit_sensor
from lidar_synth.lab.proof.places import by_drive, is_shuffled, names_of

log = logging.getLogger(__name__)

LOOKED = 8
"""Scans that are looked at, evenly spaced."""


@dataclass(frozen=True)
class Findings:
    """What lies in a folder.

    Args:
        source: the scans.
        layout: name of ``READERS``.
        options: of ``open_scans``, that the source was opened with.
        looked: number of scans that were looked at.
        labelled: how many of them have labels.
        classes: names of the labels, the most frequent first.
        boxes: {class: number of boxes in the scans that were looked at}.
        overlapping: how many of them overlap another of their class.
        known: how the sensor is known.
        fit: the fit, if the sensor was not known.
    """

    source: ScanFiles
    layout: str
    options: dict[str, Any]
    looked: int
    labelled: int
    classes: tuple[str, ...]
    boxes: dict[str, int]
    overlapping: int
    known: str
    fit: SensorFit | None

    @property
    def tasks(self) -> list[str]:
        """What can be trained: segmentation with labels, detection with boxes."""
        able = {"segmentation": self.labelled == self.looked, "detection": self.boxes}
        return [task for task, labels in able.items() if labels]

    @property
    def task(self) -> str:
        """The first of ``tasks``, or "unlabelled"."""
        return next(iter(self.tasks), "unlabelled")

    @property
    def drives(self) -> int:
        """Number of drives; 0 if the frames do not tell."""
        if is_shuffled(self.source):
            return 0
        return len(by_drive(self.source, names_of(self.source)))

    def lines(self) -> list[str]:
        """Scans, labels, boxes and sensor in a line each."""
        source = self.source
        drives = (
            "one drive" if self.drives == 1 else f"{self.drives or 'unknown'} drives"
        )
        few = ", ".join(self.classes[:5])
        more = ", ..." if len(self.classes) > 5 else ""
        labels = f"{len(self.classes)} classes ({few}{more})" if few else "none"
        boxes = ", ".join(f"{name} {count}" for name, count in self.boxes.items())
        if self.overlapping:
            boxes += f"; {self.overlapping} overlap one of their class"
        doubts = " ".join(self.fit.uncertain) if self.fit else ""
        split = f", split {name}," if (name := self.options.get("split")) else ""
        return [
            f"scans    {len(source)} of layout {self.layout}{split} in {drives}: {source.root}",
            f"labels   {labels}, in {self.labelled} of {self.looked} scans looked at",
            f"boxes    {boxes or 'none'}",
            f"sensor   {source.sensor.grid_text()}, {self.known}. {doubts}".rstrip(
                ". "
            ),
        ]


def look(
    root: Path, sensor: str | Path | None, fitted: Path, reading: dict[str, Any]
) -> Findings:
    """Look at the scans of a folder; where some have labels, at its split "train" if all of that
    have.

    Args:
        root: the folder.
        sensor: of the scans; None to take the layout's own, or to fit it where the points
            contradict that.
        fitted: YAML file of an earlier fit, taken if it is there.
        reading: further options of ``open_scans``.

    Raises:
        FileError, DataError: if there are no scans, or none can be read.
        ConfigError: if no sensor fits.
    """
    layout = reading.get("layout") or layout_of(root)
    fit = None
    known = "as given"
    if sensor is None and fitted.is_file():
        sensor = fitted
        known = "as fitted"
    elif sensor is None:
        known = "that of the files or the layout"
        fit = _fit(root, reading)
    if fit is not None:
        known = f"fitted to {len(fit.rings)} scans"
        known += f", like {fit.vendor}" if fit.vendor else ""
    options = dict(reading)
    if sensor is not None:
        options["sensor"] = str(sensor)
    given = fit.sensor if fit else sensor
    source = open_scans(root, sensor=given, **reading)
    scans = _some(source)
    if fit is not None:
        options["sensor"] = str(fitted)
    found = Findings(
        source,
        layout,
        options,
        len(scans),
        sum(_has_labels(scan) for scan in scans),
        _classes(scans),
        _boxes(scans),
        sum(count_overlapping(scan.boxes) for scan in scans if scan.boxes is not None),
        known,
        fit,
    )
    if reading.get("split") or not 0 < found.labelled < found.looked:
        return found
    with suppress(ConfigError, DataError):  # the layout or the folder has no such split
        train = look(root, sensor, fitted, reading | {"split": "train"})
        if train.labelled == train.looked:
            log.warning("%s has scans without labels: its split train is taken", root)
            return train
    return found


def _some(source: ScanFiles) -> list[Scan]:
    """The readable ones of ``LOOKED`` scans, or else the first that is."""
    chosen = spread(range(len(source)), LOOKED)
    return source.load_readable(chosen) or [source[0]]


def _fit(root: Path, reading: dict[str, Any]) -> SensorFit | None:
    """A sensor for scans that contradict their layout's own; None if they do not."""
    source = open_scans(root, **reading)
    source.skip_sensor_check()
    scans = _some(source)
    faults = [agreement(s.points, s.sensor).faults(s.sensor) for s in scans]
    if not all(faults):
        return None
    try:
        return fit_sensor(scans, name="sensor")
    except DataError as error:
        raise ConfigError(
            f"{root}, whose sensor is not {source.sensor.name} ({faults[0][0]}) and "
            f"cannot be fitted: {error}",
            "its name or file",
            "--sensor NAME|FILE.yaml",
        ) from error


def _has_labels(scan: Scan) -> bool:
    return scan.label is not None and bool((scan.label < len(NAMES)).any())


def _classes(scans: list[Scan]) -> tuple[str, ...]:
    total = np.zeros(256, np.int64)
    for scan in scans:
        if scan.label is not None:
            total += np.bincount(scan.label, minlength=256)
    order = np.argsort(-total[: len(NAMES)], kind="stable")
    return tuple(NAMES[i] for i in order if total[i])


def _boxes(scans: list[Scan]) -> dict[str, int]:
    names: Counter[str] = Counter()
    for scan in scans:
        if scan.boxes is not None:
            names.update(scan.boxes.names)
    return dict(names.most_common(5))
