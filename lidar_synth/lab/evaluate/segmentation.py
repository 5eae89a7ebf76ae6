"""Agreement of labels (IoU), and evaluation of scans by a segmentation network trained on scans of
the town.

Distances between two sets of scans can be computed on the features of this small range-view
network, which ships with the package. If its predictions agree with the labels of a scan, the
labels lie on the right objects.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import read_file, write_file
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.arrays import Int64Array
from lidar_synth.geometry.projection import project
from lidar_synth.lab.evaluate.labels import require_label
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter, segmenter_input

FORMAT = "lidar-synth-segmenter/1"

Images = Mapping[str, Tensor]
"""A batch of labelled range images, (B, H, W) each: "range" float32 metres, 0 = no return;
"reflectance" float32 in [0, 1]; "label" uint8 train ids, 255 = ignore."""


def confusion(
    network: nn.Module, batches: Iterable[Images], height: Tensor
) -> Int64Array:
    """(19, 19) number of cells by label (row) and prediction (column), without ignored cells."""
    table = np.zeros((len(NAMES), len(NAMES)), np.int64)
    with torch.inference_mode():
        for batch in batches:
            seen = segmenter_input(batch["range"], batch["reflectance"], height)
            predicted = network(seen).argmax(1).cpu().numpy()
            table += tabulate(batch["label"].numpy(), predicted)
    return table


def tabulate(
    label: NDArray[np.uint8],
    predicted: NDArray[np.integer],
    columns: int = len(NAMES),
) -> Int64Array:
    """(19, columns) number of elements by label (row) and prediction (column), without ignored
    ones; the arrays have one shape."""
    valid = label != IGNORE
    pairs = label[valid].astype(np.int64) * columns + predicted[valid]
    counts = np.bincount(pairs, minlength=len(NAMES) * columns)
    return counts.reshape(len(NAMES), columns)


def class_ious(table: Int64Array) -> NDArray[np.float64]:
    """(19,) intersection over union of every class; NaN for a class that is neither labelled nor
    predicted.

    Args:
        table: (19, 19) the result of ``confusion``; a 20th column counts predictions of no class.
    """
    hit = np.diagonal(table)
    union = table.sum(0)[: len(hit)] + table.sum(1) - hit
    return np.where(union > 0, hit / np.maximum(union, 1), np.nan)


def mean_iou(table: Int64Array) -> float:
    """Mean of ``class_ious`` over the classes that occur in the labels, in [0, 1].

    Raises:
        DataError: on a table without any labelled cell.
    """
    labelled = table.sum(1) > 0
    if not labelled.any():
        raise DataError(
            "no labelled cell", "at least one label that is not 255 = ignore"
        )
    return float(class_ious(table)[labelled].mean())


@dataclass(frozen=True)
class Judge:
    """A trained segmentation network and its grid.

    Args:
        network: the network in evaluation mode.
        sensor: defines the grid onto which scans are projected.
        provenance: its training data and its accuracy on them.
    """

    network: RangeSegmenter
    sensor: Sensor
    provenance: Mapping[str, Any]

    @property
    def height(self) -> Tensor:
        """(H, W) sine of each cell's elevation."""
        return torch.from_numpy(np.sin(self.sensor.ray_angles()[0]))

    def features(self, scans: Sequence[Scan]) -> NDArray[np.floating]:
        """(n, D) features of n scans; an ``Extractor`` for ``evaluate``."""
        batch = self._images(scans)
        with torch.inference_mode():
            inputs = segmenter_input(batch["range"], batch["reflectance"], self.height)
            return self.network.features(inputs).double().numpy()

    def agreement(self, scans: Iterable[Scan]) -> Int64Array:
        """(19, 19) number of cells by the scans' labels (row) and the network's prediction
        (column).

        Raises:
            DataError: on a scan without labels.
        """

        def labelled() -> Iterator[Images]:
            for scan in scans:
                require_label(scan)
                yield self._images([scan])

        return confusion(self.network, labelled(), self.height)

    def _images(self, scans: Sequence[Scan]) -> Images:
        names = (
            ("reflectance", "label")
            if all(scan.label is not None for scan in scans)
            else ("reflectance",)
        )
        images = [project(scan, self.sensor, names) for scan in scans]
        stacked = {
            name: np.stack([image.channels[name] for image in images]) for name in names
        }
        return {
            k: torch.from_numpy(v)
            for k, v in {
                "range": np.stack([i.range for i in images]),
                **stacked,
            }.items()
        }

    def save(self, path: Path) -> None:
        """Save the network atomically.

        Raises:
            FileError: if it cannot be written.
        """
        header = {
            "format": FORMAT,
            "sensor": self.sensor.to_dict(),
            "provenance": dict(self.provenance),
        }
        state = {
            k: v.detach().cpu().contiguous()
            for k, v in self.network.state_dict().items()
        }
        write_file(
            path,
            save(state, {"lidar_synth": json.dumps(header, sort_keys=True)}),
            durable=True,
        )


def load_judge(path: Path | None = None) -> Judge:
    """Load a saved segmenter, by default the one that ships with the package.

    Raises:
        FileError: if it cannot be read.
        DataError: if the file is not a segmenter, or of another version.

    Example:
        >>> from lidar_synth import Town
        >>> from lidar_synth.lab.evaluate.segmentation import load_judge
        >>> load_judge().features([Town(seed=1, scans=1)[0]]).shape
        (1, 64)
    """
    path = (
        path or Path(str(files("lidar_synth.lab.evaluate"))) / "segmenter.safetensors"
    )
    content = read_file(path)
    try:
        start = int.from_bytes(content[:8], "little") + 8
        header = json.loads(json.loads(content[8:start])["__metadata__"]["lidar_synth"])
        if header["format"] != FORMAT:
            raise ConfigError(f"format {header['format']!r}", repr(FORMAT))
        network = RangeSegmenter()
        network.load_state_dict(load(content))
        return Judge(
            network.eval(), Sensor.from_dict(header["sensor"]), header["provenance"]
        )
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise DataError(
            f"{path} is not a segmenter of this version ({error})",
            f"a file of {FORMAT}",
        ) from error
