"""Robustness of a segmentation network: its mIoU under weather and failing sensors, in the measures
of the Robo3D benchmark (Kong et al., ICCV 2023).

For a corruption, RR = mean mIoU of its severities / clean mIoU, and CE = mean error (1 - mIoU) of
its severities / that of a baseline. mRR and mCE are their means over the benchmark's corruptions.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lidar_synth.datasets.classes import NAMES, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError, choose, parsing
from lidar_synth.files.claims import claim
from lidar_synth.files.disk import hash_of_names, read_values
from lidar_synth.files.parsing import read_facts
from lidar_synth.formats.point_labels import decode_labels
from lidar_synth.formats.semantic_kitti import SemanticKITTIWriter
from lidar_synth.geometry import Scan, Source, scan_hash
from lidar_synth.lab.evaluate.labels import require_label
from lidar_synth.lab.evaluate.reading import readable
from lidar_synth.lab.evaluate.segmentation import load_judge, mean_iou, tabulate
from lidar_synth.lab.evaluate.street_judge import load_archive
from lidar_synth.noise import keyed_rng
from lidar_synth.weather import BENCHMARK, CORRUPTIONS, SEVERITIES

Table = NDArray[np.int64]
Model = Callable[[Iterable[Scan], str], Table]
"""Counts labelled points by label (row, 19) and prediction (column; a 20th one is no class) over
the scans of a case, "clean" or such as "fog/heavy"."""

NAMES_OF_BENCHMARK = tuple(kind.name for kind in BENCHMARK)
BASELINE = {
    "fog": 0.5587,
    "wet_ground": 0.5399,
    "snow": 0.5328,
    "motion_blur": 0.3292,
    "missing_beams": 0.5632,
    "crosstalk": 0.5834,
    "incomplete_echo": 0.5443,
    "cross_sensor": 0.4605,
}
"""{corruption: mIoU of MinkUNet-18 on SemanticKITTI, mean of the severities}, in [0, 1]: the
benchmark's baseline."""


@dataclass(frozen=True)
class Card:
    """What a network scores on clean and on corrupted scans.

    Args:
        clean: mIoU of the scans as they are, in [0, 1].
        scores: {corruption: mIoU of each severity}, in [0, 1].
        baseline: {corruption: mean mIoU of another network, in [0, 1]}, for CE. There is none
            beside an mIoU of 1.
    """

    clean: float
    scores: Mapping[str, Sequence[float]]
    baseline: Mapping[str, float]

    @property
    def means(self) -> dict[str, float]:
        """mIoU of each corruption, mean of its severities."""
        return {name: float(np.mean(values)) for name, values in self.scores.items()}

    @property
    def resilience(self) -> dict[str, float]:
        """RR of each corruption."""
        return {name: score / self.clean for name, score in self.means.items()}

    @property
    def errors(self) -> dict[str, float]:
        """CE of each corruption that the baseline has."""
        return {
            name: (1 - score) / (1 - self.baseline[name])
            for name, score in self.means.items()
            if self.baseline.get(name, 1) < 1
        }

    def to_dict(self) -> dict[str, Any]:
        """All figures as plain values; the means are those of the benchmark's corruptions."""
        figures = {"RR": self.resilience, "CE": self.errors}
        means = {f"m{key}": _mean_of(values) for key, values in figures.items()}
        scores = {name: list(values) for name, values in self.scores.items()}
        return {"clean": self.clean, "scores": scores, **figures, **means}

    def to_text(self) -> str:
        """The figures as a table in Markdown, per cent."""
        every = self.to_dict()
        rows: dict[str, list[float | None]] = {}
        rows["clean"] = [None, None, None, self.clean, 1.0, None]
        for name, values in self.scores.items():
            rates = [self.means[name], self.resilience[name], self.errors.get(name)]
            rows[name] = [*values, *rates]
        rows["mean"] = [None, None, None, None, every["mRR"], every["mCE"]]
        lines = [
            f"| % | {' | '.join(SEVERITIES)} | mIoU | RR | CE |",
            "|---|" + 6 * "---:|",
        ]
        for name, cells in rows.items():
            shown = ["" if c is None else f"{100 * c:.1f}" for c in cells]
            lines.append(f"| {name} | {' | '.join(shown)} |")
        return "\n".join(lines)


def read_means(path: Path) -> dict[str, float]:
    """The baseline of a file of ``Card.to_dict``.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is something else.
    """
    expected = "a card that lidar-synth stress --json printed"
    facts = read_facts(path, expected)
    with parsing(path, expected):
        return Card(facts["clean"], facts["scores"], {}).means


def stress(
    scans: Source,
    model: Model,
    corruptions: Sequence[str] = NAMES_OF_BENCHMARK,
    baseline: Mapping[str, float] = BASELINE,
    seed: int = 0,
    progress: bool = True,
) -> Card:
    """Score a network on labelled scans, as they are and under every severity of corruptions.

    Args:
        scans: labelled scans; they are read anew for every severity.
        model: see ``open_model``.
        corruptions: names of ``CORRUPTIONS``.
        baseline: as for ``Card``; by default the benchmark's.
        seed: of the corruptions.
        progress: whether to show a progress bar.

    Raises:
        ConfigError: on an unknown corruption.
        DataError: on scans without labels, or a network that recognises no point.
    """
    scores = {}
    for case in tqdm(cases(corruptions), unit="case", disable=not progress):
        scores[case] = mean_iou(model(corrupt(scans, case, seed), case))
        if not scores["clean"]:
            raise DataError(
                "predictions of which none is right on the scans as they are",
                f"train ids, 0 to {len(NAMES) - 1}",
                "Map the network's own class ids to them.",
            )
    by_name = {
        name: [scores[f"{name}/{severity}"] for severity in SEVERITIES]
        for name in corruptions
    }
    return Card(scores["clean"], by_name, baseline)


def write_cases(
    scans: Source, out: Path, corruptions: Sequence[str], seed: int = 0
) -> int:
    """Write the scans of every case, as they are and corrupted, to a folder of its name in
    SemanticKITTI's layout, numbered in sequence 00; a rerun writes what is missing.

    Returns:
        Number of scans written.

    Raises:
        ConfigError, DataError: as ``stress``; a ConfigError also on a folder with other scans, or
            with those of another seed.
        FileError: if a folder cannot be written.
    """
    given = hash_of_names(map(scan_hash, corrupt(scans, "clean")))
    # Without the corruptions: others may be added.
    claim(out / ".stress.json", {"seed": seed, "scans": given})
    written = 0
    for case in tqdm(cases(corruptions), unit="case", disable=None):
        writer = SemanticKITTIWriter(out / case)
        for number, scan in enumerate(corrupt(scans, case, seed)):
            if not writer.complete(number):
                writer.write(scan, number)
                written += 1
        writer.finish()
    return written


def cases(corruptions: Sequence[str]) -> list[str]:
    """ "clean", and every severity of corruptions, such as "fog/heavy"."""
    for name in corruptions:
        choose("corruption", name, CORRUPTIONS)
    return ["clean", *(f"{name}/{s}" for name in corruptions for s in SEVERITIES)]


def corrupt(scans: Source, case: str, seed: int = 0) -> Iterator[Scan]:
    """The scans of a case; the same for the same seed.

    Raises:
        DataError: on a scan without labels.
    """
    name, _, severity = case.partition("/")
    change = CORRUPTIONS[name].at(severity) if severity else None
    for number, scan in enumerate(readable(scans)):
        require_label(scan)
        yield scan if change is None else change(scan, keyed_rng(seed, number))


def show_cases(scan: Scan, corruptions: Sequence[str], seed: int = 0) -> list[Scan]:
    """A labelled scan in every case, named by it."""
    return [
        replace(next(corrupt([scan], case, seed)), id=case)
        for case in cases(corruptions)
    ]


def open_model(given: str) -> Model:
    """The network that a text names.

    Args:
        given: ``"town"``, the small segmenter that ships with the package; the folder of an
            archive of lidar-bonnetal; a folder of predictions, ``CASE/.../*.label`` in the order
            of the scans that ``write_cases`` wrote, with SemanticKITTI's class ids; or
            ``module:function``, which is imported and called with each ``Scan`` of N points and
            returns (N,) train ids, 0 to 18, or 255 for none.

    Raises:
        ConfigError: if it names nothing of these.
        FileError, DataError: if an archive cannot be read.
    """
    if given == "town":
        judge = load_judge()
        return lambda scans, case: judge.agreement(scans)
    folder = Path(given)
    if (folder / "arch_cfg.yaml").is_file():
        street = load_archive(folder)
        return lambda scans, case: street.confusion(scans)
    if folder.is_dir():
        return partial(_compare_files, folder)
    module, _, name = given.partition(":")
    sys.path.insert(0, "")  # a command has the working folder not on its path
    try:
        function = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"model {given!r} ({error})",
            "town, a folder of predictions, an archive of lidar-bonnetal, or module:function",
        ) from error
    finally:
        sys.path.remove("")
    return lambda scans, case: sum_tables(count_points(s, function(s)) for s in scans)


def count_points(scan: Scan, predicted: Any) -> Table:
    """(19, 20) labelled points by label and prediction, the last column = none of the classes.

    Raises:
        DataError: unless there is a whole number for every point.
    """
    values = np.asarray(predicted)
    if values.shape != (len(scan),) or values.dtype.kind not in "iu":
        raise DataError(
            f"predictions of shape {values.shape} and type {values.dtype} for scan {scan.id!r}",
            f"({len(scan)},), a train id for each point",
        )
    count = len(NAMES)
    known = (values >= 0) & (values < count)
    return tabulate(require_label(scan), np.where(known, values, count), count + 1)


def sum_tables(tables: Iterable[Table]) -> Table:
    """The sum of the tables of several scans."""
    return sum(tables, np.zeros((len(NAMES), len(NAMES) + 1), np.int64))


def _compare_files(folder: Path, scans: Iterable[Scan], case: str) -> Table:
    """The table of a case from its files of predictions."""
    # Beside the points lie the labels that ``write_cases`` wrote.
    files = [
        path
        for path in sorted((folder / case).rglob("*.label"))
        if path.parent.name != "labels" or not (path.parents[1] / "velodyne").is_dir()
    ]
    tables = []
    count = 0
    for count, scan in enumerate(scans, 1):
        if count <= len(files):
            path = files[count - 1]
            predicted = decode_labels(
                read_values(path, "<u4"), SEMANTIC_KITTI, str(path)
            )
            tables.append(count_points(scan, predicted["label"]))
    if count != len(files):
        raise DataError(
            f"{folder / case} with {len(files)} predictions for {count} scans",
            "a file NNNNNN.label for each scan that --out wrote",
        )
    return sum_tables(tables)


def _mean_of(values: Mapping[str, float]) -> float | None:
    """The mean over the benchmark's corruptions; None without all of them."""
    if not set(NAMES_OF_BENCHMARK) <= set(values):
        return None
    return float(np.mean([values[name] for name in NAMES_OF_BENCHMARK]))
