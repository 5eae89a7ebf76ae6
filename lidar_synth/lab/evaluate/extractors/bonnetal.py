"""Segmentation networks of lidar-bonnetal (https://github.com/PRBonn/lidar-bonnetal): an archive
with ``arch_cfg.yaml``, ``data_cfg.yaml`` and the state dictionaries ``backbone``,
``segmentation_decoder`` and ``segmentation_head``. R2Flow publishes its RangeNet-21 in the same
form.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.errors import MISFITS, ConfigError
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.lab.evaluate.extractors.archive import Archive, load_weights
from lidar_synth.lab.evaluate.extractors.darknet import BLOCKS, RangeNet
from lidar_synth.lab.evaluate.extractors.inputs import (
    CHANNELS,
    nearest_points,
    preparation,
)
from lidar_synth.lab.evaluate.extractors.per_scan import PerScan, some
from lidar_synth.lab.evaluate.extractors.pooling import mean_over_bands, subsample
from lidar_synth.lab.evaluate.extractors.squeezeseg import SqueezeSeg

PARTS = ("backbone", "segmentation_decoder", "segmentation_head")
OWN_GRID = "bonnetal"
"""The preparation in which scans are projected to the grid that the archive's settings describe, as
in training."""


def _darknet(channels: int, classes: int, backbone: Mapping[str, Any]) -> RangeNet:
    layers = backbone["extra"]["layers"]
    stride = backbone["OS"]
    if layers not in BLOCKS or stride != 32:
        raise ConfigError(
            f"darknet with {layers} layers and output stride {stride}",
            f"{' or '.join(map(str, BLOCKS))} layers, output stride 32",
        )
    return RangeNet(channels, classes, layers)


NETWORKS: dict[str, Callable[[int, int, Mapping[str, Any]], nn.Module]] = {
    "squeezeseg": lambda channels, classes, backbone: SqueezeSeg(channels, classes),
    "darknet": _darknet,
}
"""Networks by the name of backbone and decoder in ``arch_cfg.yaml``: (channels, classes, settings)
-> network."""

HALVINGS = {"squeezeseg": 16, "darknet": 32}
"""By what each network divides the number of columns."""


@dataclass(frozen=True)
class Segmenter:
    """A segmentation network with its grid and the normalisation of its input.

    Args:
        network: in evaluation mode; ``decode`` gives its last feature map.
        sensor: the grid of its training images.
        channels: (C,) positions of its inputs in ``CHANNELS``.
        mean, deviation: (C,) of its inputs, over its training set.
    """

    network: nn.Module
    sensor: Sensor
    channels: tuple[int, ...]
    mean: Tensor
    deviation: Tensor

    def normalise(self, image: NDArray[np.float32]) -> Tensor:
        """(5, H, W) of ``CHANNELS`` to the network's input (C, H, W), 0 where there is no
        return."""
        values = torch.from_numpy(image)
        scaled = (
            values[list(self.channels)] - self.mean[:, None, None]
        ) / self.deviation[:, None, None]
        return scaled * (values[0] > 0)

    def decode(self, image: Tensor) -> Tensor:
        """The last feature map (width, H, W) of an input (C, H, W)."""
        features: Tensor = self.network.decode(image[None])[0]  # type: ignore[operator]
        return features


def read_segmenter(archive: Archive, columns: int | None = None) -> Segmenter:
    """Read a network of lidar-bonnetal.

    Args:
        archive: with ``arch_cfg.yaml`` and the network's three parts.
        columns: width of the grid; the archive's own by default.

    Raises:
        FileError: if a file cannot be read.
        DataError: on a damaged file, one that contains code, or weights of another architecture.
        ConfigError: on a network or a width that is not supported, or settings that are missing.
    """
    settings = archive.yaml("arch_cfg.yaml")
    states = {part: archive.weights(part) for part in PARTS}
    try:
        backbone = settings["backbone"]
        sensor = settings["dataset"]["sensor"]
        names = backbone["name"], settings["decoder"]["name"], settings["head"]["name"]
        channels = _channels(backbone["input_depth"])
        mean, deviation = (
            torch.tensor(sensor[key], dtype=torch.float32)[: len(channels)]
            for key in ("img_means", "img_stds")
        )
        if (
            names[0] != names[1]
            or names[0] not in NETWORKS
            or names[2] != "segmentation"
        ):
            raise ConfigError(
                f"backbone, decoder and head {names}", f"one of {', '.join(NETWORKS)}"
            )
        grid = _grid(sensor, columns, HALVINGS[names[0]])
        network = NETWORKS[names[0]](
            len(channels), _classes(states["segmentation_head"]), backbone
        )
    except MISFITS as error:
        if isinstance(error, ConfigError):
            raise ConfigError(f"{archive.path}: {error}") from error
        raise ConfigError(
            f"{archive.path}: its settings lack or misstate {error}",
            "arch_cfg.yaml and data_cfg.yaml as lidar-bonnetal writes them",
        ) from error
    if (
        mean.shape != (len(channels),)
        or deviation.shape != mean.shape
        or not (deviation > 0).all()
    ):
        raise ConfigError(
            f"{archive.path} with {len(channels)} inputs, {mean.tolist()} and {deviation.tolist()}",
            "a mean and a positive deviation for each input",
        )
    for part, state in states.items():
        load_weights(network.get_submodule(part), state, str(archive.path / part))
    return Segmenter(network.eval(), grid, channels, mean, deviation)


def _channels(inputs: Mapping[str, bool]) -> tuple[int, ...]:
    if inputs.get("range") is not True or inputs.get("xyz") is not True:
        raise ConfigError(
            f"a network with input {dict(inputs)}",
            "range and xyz, with or without remission",
        )
    return tuple(range(len(CHANNELS) if inputs.get("remission") else len(CHANNELS) - 1))


def _classes(head: Any) -> int:
    """The number of classes that a head's state dictionary has; 20 where it does not tell, so that
    loading fails."""
    bias = head.get("1.bias") if isinstance(head, Mapping) else None
    return len(bias) if isinstance(bias, Tensor) and bias.ndim == 1 else 20


def _grid(sensor: Mapping[str, Any], columns: int | None, factor: int) -> Sensor:
    """The grid that the archive's settings describe, with another width on request."""
    size = sensor["img_prop"]
    width = columns or size["width"]
    if width % factor:
        raise ConfigError(f"{width} columns", f"a multiple of {factor}")
    name = f"{sensor['name']}/{width}"
    up = float(sensor["fov_up"])
    down = float(sensor["fov_down"])
    return Sensor(
        name,
        width,
        range_min=0.0,
        range_max=1000.0,
        rows=size["height"],
        fov_up=up,
        fov_down=down,
    )


def mean_over_returns(features: Tensor, image: Tensor) -> Tensor:
    """(C,) means of a feature map (C, H, W) over the cells of the input (C, H, W) with a return."""
    return features[:, image.abs().sum(0) > 0].mean(1)


POOLS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "subsample": lambda features, image: subsample(features),
    "bands": lambda features, image: mean_over_bands(features),
    "returns": mean_over_returns,
}
"""``(features (C, H, W), input (C, H, W)) -> (D,)``."""


def load_bonnetal(
    path: Path, prepared: str, pool: str, project: str = "lidar-bonnetal"
) -> PerScan:
    """An extractor from an archive; see ``load_extractor``.

    Args:
        path: the archive.
        prepared: a name of ``PREPARATIONS``, or "bonnetal": the grid of the archive.
        pool: a name of ``POOLS``.
        project: that publishes the archive.
    """
    segmenter = read_segmenter(Archive(path, project))
    inputs = None if prepared == OWN_GRID else preparation(prepared)

    def describe(scan: Scan, generated: bool) -> Tensor:
        image = (
            inputs.image(scan, generated)
            if inputs
            else nearest_points(scan, segmenter.sensor)[0]
        )
        some(image[0][image[0] > 0])
        normalised = segmenter.normalise(image)
        return POOLS[pool](segmenter.decode(normalised), normalised)

    return PerScan(describe)


def load_lidm(path: Path, prepared: str) -> PerScan:
    """LiDM's RangeNet-21: range, x, y and z in metres without normalisation; see
    ``load_extractor``."""
    archive = Archive(path, "LiDM")
    settings = archive.yaml("config.yaml")
    try:
        network = _darknet(
            len(_channels(settings["backbone"]["input_depth"])), 0, settings["backbone"]
        )
    except MISFITS as error:
        raise ConfigError(
            f"{path}: config.yaml lacks or misstates {error}",
            "the settings of LiDM's RangeNet",
        ) from error
    for part in PARTS[:2]:
        load_weights(
            network.get_submodule(part), archive.weights(part), str(path / part)
        )
    network.eval()
    inputs = preparation(prepared)
    channels = network.backbone.conv1.in_channels

    def describe(scan: Scan, generated: bool) -> Tensor:
        image = torch.from_numpy(inputs.image(scan, generated))
        some(image[0][image[0] > 0])
        return mean_over_bands(network.decode(image[None, :channels])[0])

    return PerScan(describe)
