"""A trainer of your own as a command: it reads the mixture from a YAML file and writes
predictions."""

import shlex
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES, SEMANTIC_KITTI, TRAIN_ID
from lidar_synth.errors import ConfigError, DataError, ProcessError
from lidar_synth.files.disk import read_values, write_file
from lidar_synth.formats.semantic_kitti import SemanticKITTIWriter
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.labels import require_label
from lidar_synth.lab.evaluate.segmentation import tabulate
from lidar_synth.lab.proof.arms import REAL, ArmStage, options_of
from lidar_synth.lab.proof.trial import Job

FIELD = "{job}"
POOLS = "pools"
_TAIL = 2000


@dataclass(frozen=True)
class CommandTrainer:
    """Trains by a command.

    ``{job}`` in it stands for a YAML file with ``seed``, ``batch``, ``iterations``; ``real``, the
    folder of the labelled scans; ``stages``, one after the other, each with ``iterations``,
    ``ratio``, ``epoch_size``, ``synthetic`` (a folder, or null) and ``labels``, as for
    ``MixedScans``;
    ``held_out``, a folder of scans without labels; and ``predictions``, the folder to write one
    ``NNNNNN.label`` to for each of them. All folders of scans have SemanticKITTI's layout, and
    predictions its values: (N,) uint32, one for each point.

    Args:
        command: the words of the command, as a shell would split them.

    Raises:
        ConfigError: on a command without ``{job}``.
    """

    command: str

    def __post_init__(self) -> None:
        if FIELD not in self.command:
            raise ConfigError(
                f"trainer {self.command!r}",
                f"a command with {FIELD}, such as 'python my.py {FIELD}'",
            )

    def __call__(self, job: Job) -> dict[str, NDArray[np.int64]]:
        """{place: (19, 19) confusion table of the predictions}.

        Raises:
            ProcessError: if the command fails.
            FileError, DataError: on missing or wrong predictions.
        """
        write_scans(job.real, job.folder / "real")
        for name in job.pools.keys() - job.pool_folders.keys():
            write_scans(job.pools[name], job.folder / POOLS / name)
        tested = [scan for part in job.held_out.values() for scan in part]
        bare = [replace(s, label=None, raw_label=None, instance=None) for s in tested]
        write_scans(bare, job.folder / "held_out")
        path = job.folder / "job.yaml"
        write_file(path, yaml.safe_dump(describe(job), sort_keys=False).encode())
        _run([word.replace(FIELD, str(path)) for word in shlex.split(self.command)])
        tables = {}
        first = 0
        for place, scans in job.held_out.items():
            tables[place] = _table(scans, job.folder / "predictions", first)
            first += len(scans)
        return tables


def _run(words: list[str]) -> None:
    """Run a trainer to its end."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, errors="replace")
    except OSError as error:
        raise ProcessError(
            f"trainer {words[0]!r} does not start ({error.strerror})", "a command"
        ) from error
    if done.returncode:
        raise ProcessError(
            f"trainer {shlex.join(words)} ended with status {done.returncode}: "
            f"{(done.stderr or done.stdout)[-_TAIL:].strip()}",
            "status 0",
        )


def describe(job: Job) -> dict[str, Any]:
    """The plain values of a job, for its YAML file."""
    stages = [_describe_stage(job, *stage) for stage in job.stages()]
    home = job.folder.resolve()
    folders = {name: str(home / name) for name in ("real", "held_out", "predictions")}
    plain = {
        "arm": job.row.key,
        "places": list(job.held_out),
        "seed": job.seed,
        "batch": job.batch,
    }
    return {**plain, "iterations": job.iterations, **folders, "stages": stages}


def _describe_stage(job: Job, stage: ArmStage, iterations: int) -> dict[str, Any]:
    folder = job.pool_folders.get(stage.pool, job.folder / POOLS / stage.pool)
    if stage.pool == REAL:
        folder = job.folder / "real"
    options = options_of(stage, list(job.real))
    return {
        "iterations": iterations,
        "ratio": float(stage.ratio),
        "epoch_size": "replace",
        "synthetic": str(folder.resolve()) if stage.ratio else None,
        "labels": {stage.labels: options} if options else stage.labels,
    }


def write_scans(scans: Sequence[Scan], folder: Path) -> None:
    """Write scans in SemanticKITTI's layout, as sequence 00 from frame 0 on."""
    writer = SemanticKITTIWriter(folder)
    for index, scan in enumerate(scans):
        writer.write(replace(scan, image_path=None), index, name=f"00/{index:06d}")
    writer.finish()


def _read(path: Path, count: int) -> NDArray[np.uint8]:
    """The train ids of the predictions of a scan with this number of points."""
    raw = read_values(path, "<u4")
    if len(raw) != count:
        raise DataError(
            f"{path} with {len(raw)} predictions", f"{count}, one for each point"
        )
    return SEMANTIC_KITTI.decode((raw & 0xFFFF).astype(np.uint16), str(path))


def _table(scans: Sequence[Scan], folder: Path, first: int) -> NDArray[np.int64]:
    """The table of the predictions from this number on."""
    table = np.zeros((len(NAMES), len(NAMES)), np.int64)
    for index, scan in enumerate(scans, first):
        label = require_label(scan)
        predicted = _read(folder / f"{index:06d}.label", len(scan))
        # A return without a prediction is an error: it counts as a class with which its own is
        # never pooled.
        wrong = np.where(label == TRAIN_ID["road"], TRAIN_ID["car"], TRAIN_ID["road"])
        table += tabulate(label, np.where(predicted == IGNORE, wrong, predicted))
    return table
