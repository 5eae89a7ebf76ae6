"""Labels of points on disk: one unsigned 32-bit value per point.

The encoding is that of SemanticKITTI (http://www.semantic-kitti.org/dataset.html): the lower 16
bits are the dataset's class id, the upper 16 bits the instance. KITTI-360's labels use the same
packing with that dataset's class ids.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, Taxonomy
from lidar_synth.errors import DataError, FileError
from lidar_synth.files.disk import read_values, write_file
from lidar_synth.geometry import Scan


def read_labels(
    path: Path, points: Path, count: int, taxonomy: Taxonomy
) -> dict[str, Any]:
    """The fields ``label``, ``raw_label`` and ``instance`` of a scan from its label file.

    Args:
        path: the ``.label`` file.
        points: the file of the points, for error messages.
        count: number of points in the scan.
        taxonomy: the taxonomy of the file's class ids.

    Raises:
        FileError: if the file cannot be read.
        DataError: if the numbers of labels and points differ; on a class id that the dataset does
            not define.
    """
    if not path.is_file():
        raise FileError(
            f"{points} has labels in {path.parent} for other scans, but no {path.name}",
            "a label file for every scan of the folder",
            "Copy it, or leave the scan out with --on-bad skip (on_bad='skip').",
        )
    raw = read_values(path, "<u4")
    if len(raw) != count:
        raise mismatch(path, len(raw), points, count)
    return decode_labels(raw, taxonomy, f"{path} (labels of {points})")


def mismatch(path: Path, labels: int, points: Path, count: int) -> DataError:
    """The error for a label file whose length differs from its scan's."""
    return DataError(
        f"{path} has {labels} labels, {points} has {count} points",
        "one label per point",
        "One of the two belongs to another scan or is truncated: copy both again, or skip the "
        "scan with on_bad='skip'.",
    )


def decode_labels(
    raw: NDArray[np.uint32], taxonomy: Taxonomy, where: str
) -> dict[str, Any]:
    """Decode the values of a label file to ``label``, ``raw_label`` and ``instance``; the inverse
    of ``encode_labels``.

    Raises:
        DataError: on a class id that the dataset does not define.
    """
    return {
        "label": taxonomy.decode((raw & 0xFFFF).astype(np.uint16), where),
        "raw_label": raw,
        "instance": (raw >> 16).astype(np.int32),
    }


def encode_labels(scan: Scan, taxonomy: Taxonomy) -> NDArray[np.uint32]:
    """(N,) values to write for a scan's labels.

    The ``raw_label`` of a point is written unchanged, bit for bit, if it decodes to its ``label``
    in this taxonomy. Otherwise (a label that was changed since, no ``raw_label``, or one that is of
    another dataset, by any id), the value is the taxonomy's static class of ``label`` and
    ``instance`` in the upper bits. A scan without labels gets 0 = unlabelled for every point.

    Raises:
        DataError: on a train id or an instance that the file cannot hold.
    """
    label = np.full(len(scan), IGNORE, np.uint8) if scan.label is None else scan.label
    raw = scan.raw_label
    kept = np.zeros(len(scan), bool)
    if raw is not None:
        with suppress(DataError):
            kept = taxonomy.decode((raw & 0xFFFF).astype(np.uint16)) == label
        if kept.all():
            return raw
    values = taxonomy.encode(label)
    if scan.instance is not None:
        if len(scan) and not 0 <= scan.instance.min() <= scan.instance.max() <= 0xFFFF:
            raise DataError(
                f"scan {scan.id!r}: instances from {scan.instance.min()} to {scan.instance.max()}",
                "0..65535, which is what a label file can hold",
                "Number the instances of each scan anew before writing.",
            )
        values |= scan.instance.astype(np.uint32) << np.uint32(16)
    return values if raw is None else np.where(kept, raw, values)


def write_labels(path: Path, values: NDArray[np.uint32]) -> None:
    """Write the values of ``encode_labels`` to a label file.

    Raises:
        FileError: if it cannot be written.
    """
    write_file(path, values.astype("<u4").tobytes())
