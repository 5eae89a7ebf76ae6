"""Evaluation of scans by a network that was trained on real streets: an archive of lidar-bonnetal
(https://github.com/PRBonn/lidar-bonnetal), a folder with ``arch_cfg.yaml``, ``data_cfg.yaml`` and the state
dictionaries ``backbone``, ``segmentation_decoder`` and ``segmentation_head``.

Where such a network recognises the classes of a synthetic scan as well as those of real ones, the scan is realistic to
it. No archive ships with the package: those of lidar-bonnetal have the terms of SemanticKITTI (non-commercial).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES, SEMANTIC_KITTI
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.evaluate.squeezeseg import SqueezeSeg
from lidar_synth.files.parsing import read_yaml
from lidar_synth.generate.importers.pickled import load_pickle
from lidar_synth.geometry.projection import carry, locate
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor

NETWORKS: dict[str, Callable[[int, int], nn.Module]] = {"squeezeseg": SqueezeSeg}
"""Networks by the name of backbone and decoder in ``arch_cfg.yaml``: (channels, classes) -> network."""

PARTS = ("backbone", "segmentation_decoder", "segmentation_head")
INPUTS = ("range", "x", "y", "z", "remission")


@dataclass(frozen=True)
class StreetJudge:
    """A segmentation network of lidar-bonnetal with its grid and its classes.

    Args:
        network: the network in evaluation mode; ``decode`` gives its last feature map.
        sensor: the grid onto which scans are projected.
        mean, deviation: (5,) of range, x, y, z and remission, over its training set.
        train_id: (C,) uint8 train id of each of the network's classes; 255 for its unlabelled class.
    """

    network: nn.Module
    sensor: Sensor
    mean: Tensor
    deviation: Tensor
    train_id: NDArray[np.uint8]

    def confusion(self, scans: Iterable[Scan]) -> NDArray[np.int64]:
        """(19, 19) number of labelled cells by label (row) and prediction (column); "unlabelled" is never predicted.

        Raises:
            DataError: on a scan without labels.
        """
        count = len(NAMES)
        table = np.zeros(count * count, np.int64)
        for scan in scans:
            if scan.label is None:
                raise DataError(f"scan {scan.id!r} without labels", "labelled scans")
            image, label = self.image(scan)
            valid = label != IGNORE
            pairs = label[valid].astype(np.int64) * count + self.predict(image)[valid]
            table += np.bincount(pairs, minlength=len(table))
        return table.reshape(count, count)

    def predict(self, image: Tensor) -> NDArray[np.uint8]:
        """Train ids (H, W) of an ``image`` (5, H, W); "unlabelled" is never predicted."""
        known = np.flatnonzero(self.train_id != IGNORE)
        with torch.inference_mode():
            best: NDArray[np.intp] = self.network(image[None])[0, known].argmax(0).numpy()
        return self.train_id[known[best]]

    def features(self, scans: Sequence[Scan]) -> NDArray[np.floating]:
        """(n, 64) means of the decoder's last feature map over the cells with a return; an ``Extractor``."""
        rows = []
        for scan in scans:
            image, _ = self.image(scan)
            with torch.inference_mode():
                features = self.network.decode(image[None])[0]  # type: ignore[operator]
            rows.append(features[:, image.abs().sum(0) > 0].mean(1).double().numpy())
        return np.stack(rows)

    def image(self, scan: Scan) -> tuple[Tensor, NDArray[np.uint8]]:
        """The network's input (5, H, W), 0 where there is no return, and the train ids (H, W), 255 without labels."""
        cells = locate(scan.points, self.sensor)
        filled = cells.point >= 0
        nearest = cells.point[filled]
        image = np.zeros((len(INPUTS), *self.sensor.shape), np.float32)
        values = np.column_stack([cells.range[nearest], scan.points[nearest, :3], scan.reflectance[nearest]])
        image[:, filled] = ((values - self.mean.numpy()) / self.deviation.numpy()).T
        fields = ["label"] if scan.label is not None else []
        label = carry(scan, cells.point, fields).get("label", np.full(self.sensor.shape, IGNORE, np.uint8))
        return torch.from_numpy(image), label


def load_archive(folder: Path, columns: int | None = None) -> StreetJudge:
    """Load an archive of lidar-bonnetal. Its pickles are read without running code.

    Args:
        folder: with the archive's five files.
        columns: width of the grid; the archive's own by default. A scan with one return per cell of 1024 columns is
            judged at 1024.

    Raises:
        FileError: if a file cannot be read.
        DataError: on a damaged file, one that contains code, or weights of another architecture.
        ConfigError: on a network or a width that is not supported, or settings that are missing.
    """
    folder = Path(folder)
    architecture = read_yaml(folder / "arch_cfg.yaml", "arch_cfg.yaml of an archive of lidar-bonnetal")
    classes = read_yaml(folder / "data_cfg.yaml", "data_cfg.yaml of an archive of lidar-bonnetal")
    try:
        names = architecture["backbone"]["name"], architecture["decoder"]["name"], architecture["head"]["name"]
        inputs = architecture["backbone"]["input_depth"]
        sensor = architecture["dataset"]["sensor"]
        mean, deviation = (torch.tensor(sensor[key], dtype=torch.float32) for key in ("img_means", "img_stds"))
        grid = _grid(sensor, columns)
        ids = [classes["learning_map_inv"][i] for i in range(len(classes["learning_map_inv"]))]
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{folder}: its settings lack or misstate {error}", "arch_cfg.yaml and data_cfg.yaml as "
                          "lidar-bonnetal writes them") from error  # fmt: skip
    if names[0] != names[1] or names[0] not in NETWORKS or names[2] != "segmentation":
        raise ConfigError(f"{folder} with backbone, decoder and head {names}", f"one of {', '.join(NETWORKS)}")
    if inputs != {"range": True, "xyz": True, "remission": True} or mean.shape != (5,) or deviation.shape != (5,):
        raise ConfigError(f"{folder} with input {inputs}", "range, xyz and remission, each with mean and deviation")
    network = NETWORKS[names[0]](len(INPUTS), len(ids))
    for part in PARTS:
        _load_part(network.get_submodule(part), folder / part)
    return StreetJudge(network.eval(), grid, mean, deviation, SEMANTIC_KITTI.decode(np.array(ids), str(folder)))


def _grid(sensor: Mapping[str, Any], columns: int | None) -> Sensor:
    """The grid that the archive's settings describe, with another width on request."""
    size = sensor["img_prop"]
    width = columns or size["width"]
    if width % 16:
        raise ConfigError(f"{width} columns", "a multiple of 16")
    name, up, down = f"{sensor['name']}/{width}", float(sensor["fov_up"]), float(sensor["fov_down"])
    return Sensor(name, width, range_min=0.0, range_max=1000.0, rows=size["height"], fov_up=up, fov_down=down)


def _load_part(module: nn.Module, path: Path) -> None:
    state = load_pickle(path, "lidar-bonnetal")
    try:
        module.load_state_dict(state)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path}: weights of another architecture ({error})", "those that arch_cfg.yaml names"
        ) from error
