"""Evaluation of scans by a network that was trained on real streets: an archive of lidar-bonnetal
(https://github.com/PRBonn/lidar-bonnetal), a folder with ``arch_cfg.yaml``, ``data_cfg.yaml`` and
the state dictionaries ``backbone``, ``segmentation_decoder`` and ``segmentation_head``.

Where such a network recognises the classes of a synthetic scan as well as those of real ones, the
scan is realistic to it. No archive ships with the package: those of lidar-bonnetal have the terms
of SemanticKITTI (non-commercial).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.datasets.classes import IGNORE, NAMES, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Scan
from lidar_synth.geometry.projection import carry
from lidar_synth.lab.evaluate.extractors.archive import Archive
from lidar_synth.lab.evaluate.extractors.bonnetal import (
    Segmenter,
    mean_over_returns,
    read_segmenter,
)
from lidar_synth.lab.evaluate.extractors.inputs import CHANNELS, nearest_points
from lidar_synth.lab.evaluate.labels import require_label
from lidar_synth.lab.evaluate.segmentation import tabulate


@dataclass(frozen=True)
class StreetJudge:
    """A segmentation network of lidar-bonnetal with its classes.

    Args:
        segmenter: the network with its grid and the normalisation of its input.
        train_id: (C,) uint8 train id of each of the network's classes; 255 for its unlabelled
            class.
    """

    segmenter: Segmenter
    train_id: NDArray[np.uint8]

    def confusion(self, scans: Iterable[Scan]) -> NDArray[np.int64]:
        """(19, 19) number of labelled cells by label (row) and prediction (column); "unlabelled" is
        never predicted.

        Raises:
            DataError: on a scan without labels.
        """
        table = np.zeros((len(NAMES), len(NAMES)), np.int64)
        for scan in scans:
            require_label(scan)
            image, label = self.image(scan)
            table += tabulate(label, self.predict(image))
        return table

    def predict(self, image: Tensor) -> NDArray[np.uint8]:
        """Train ids (H, W) of an ``image`` (5, H, W); "unlabelled" is never predicted."""
        known = np.flatnonzero(self.train_id != IGNORE)
        with torch.inference_mode():
            best: NDArray[np.intp] = (
                self.segmenter.network(image[None])[0, known].argmax(0).numpy()
            )
        return self.train_id[known[best]]

    def features(self, scans: Sequence[Scan]) -> NDArray[np.floating]:
        """(n, 64) means of the decoder's last feature map over the cells with a return; an
        ``Extractor``."""
        inputs = [self.image(scan)[0] for scan in scans]
        with torch.inference_mode():
            rows = [
                mean_over_returns(self.segmenter.decode(image), image)
                for image in inputs
            ]
        return torch.stack(rows).double().numpy()

    def image(self, scan: Scan) -> tuple[Tensor, NDArray[np.uint8]]:
        """The network's input (5, H, W), 0 where there is no return, and the train ids (H, W), 255
        without labels."""
        image, shown = nearest_points(scan, self.segmenter.sensor)
        fields = ["label"] if scan.label is not None else []
        label = carry(scan, shown, fields).get(
            "label", np.full(shown.shape, IGNORE, np.uint8)
        )
        return self.segmenter.normalise(image), label


def load_archive(folder: Path, columns: int | None = None) -> StreetJudge:
    """Load an archive of lidar-bonnetal. Its pickles are read without running code.

    Args:
        folder: with the archive's five files.
        columns: width of the grid; the archive's own by default. A scan with one return per cell of
            1024 columns is judged at 1024.

    Raises:
        FileError: if a file cannot be read.
        DataError: on a damaged file, one that contains code, or weights of another architecture.
        ConfigError: on a network or a width that is not supported, or settings that are missing.
    """
    archive = Archive(Path(folder), "lidar-bonnetal")
    classes = archive.yaml("data_cfg.yaml")
    segmenter = read_segmenter(archive, columns)
    try:
        ids = [
            classes["learning_map_inv"][i]
            for i in range(len(classes["learning_map_inv"]))
        ]
        if not all(type(i) is int and 0 <= i < 1 << 32 for i in ids):
            raise ValueError(f"ids {ids}")
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{folder}: data_cfg.yaml lacks or misstates {error}",
            "learning_map_inv as lidar-bonnetal writes it",
        ) from error
    if len(segmenter.channels) != len(CHANNELS):
        raise ConfigError(
            f"{folder} without remission as an input",
            "a network of range, xyz and remission",
        )
    if len(ids) != segmenter.network.get_submodule("segmentation_head.1").out_channels:
        raise ConfigError(
            f"{folder} with {len(ids)} names of classes",
            "one for each output of its head",
        )
    return StreetJudge(segmenter, SEMANTIC_KITTI.decode(np.array(ids), str(folder)))
