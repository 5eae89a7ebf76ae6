"""Range images to tensors in [-1, 1] and back, in the scales that the peers' networks were trained
on.

encode and decode are exact inverses up to float32 rounding for every range inside the open interval
(range_min, range_max); everything outside decodes to 0 = no return.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.geometry.sensor import Sensor

LABEL_BITS = 5
NO_LABEL = len(NAMES)
"""Code of an unlabelled cell; codes 0..18 are the classes."""


@dataclass(frozen=True)
class Normalisation:
    """A mapping between a range in metres and a value in [-1, 1].

    ``NORMALISATIONS`` holds the mappings that published networks were trained with, by name.

    Args:
        kind: "log": 2 log2(d + offset) / scale - 1; "linear": 2 d / scale - 1;
            "inverse": 2 range_min / d - 1.
        range_min: metres, exclusive.
        range_max: metres, exclusive.
        scale: the divisor; by default the one that maps range_max to 1.
        offset: added before the logarithm.

    Raises:
        ConfigError: on an unknown kind or limits that are not 0 <= range_min < range_max, for
            "inverse" 0 < range_min.

    Example:
        >>> import torch
        >>> from lidar_synth.geometry.normalize import NORMALISATIONS
        >>> scale = NORMALISATIONS["r2flow_metric"]
        >>> x = scale.encode(torch.tensor([0.0, 10.0, 60.0]))  # no return, 10 m, 60 m
        >>> x
        tensor([-1.0000, -0.7500,  0.5000])
        >>> scale.decode(x)
        tensor([ 0., 10., 60.])
    """

    kind: Literal["log", "linear", "inverse"]
    range_min: float
    range_max: float
    scale: float | None = None
    offset: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in ("log", "linear", "inverse"):
            raise ConfigError(f"normalisation {self.kind!r}", "log, linear or inverse")
        numbers = (
            self.range_min,
            self.range_max,
            self.offset,
            1.0 if self.scale is None else self.scale,
        )
        if (
            not all(isinstance(n, int | float) and abs(n) < 1e30 for n in numbers)
            or any(isinstance(n, bool) for n in numbers)
            or min(numbers[2:]) <= 0
        ):
            raise ConfigError(
                f"normalisation {numbers}",
                "finite numbers, with a scale and an offset above 0",
            )
        if not 0 <= self.range_min < self.range_max or (
            self.kind == "inverse" and self.range_min == 0
        ):
            raise ConfigError(
                f"{self.kind!r} with range limits {self.range_min}, {self.range_max} m",
                "0 <= range_min < range_max, for 'inverse' 0 < range_min",
            )

    @property
    def divisor(self) -> float:
        """The divisor: ``scale``, or its default."""
        if self.scale is not None:
            return self.scale
        if self.kind == "log":
            return float(np.log2(self.range_max + self.offset))
        return self.range_max

    def inside(self, distance: torch.Tensor) -> torch.Tensor:
        """Whether each range (any shape, metres) is a return, that is, inside the limits."""
        return (distance > self.range_min) & (distance < self.range_max)

    def encode(self, distance: torch.Tensor) -> torch.Tensor:
        """Map ranges (any shape, metres, 0 = no return) to [-1, 1]; no return becomes -1."""
        inside = self.inside(distance)
        if self.kind == "inverse":
            unit = torch.where(
                inside, self.range_min / torch.where(inside, distance, 1.0), 0.0
            )
        else:
            distance = torch.where(inside, distance, 0.0)
            unit = (
                torch.log2(distance + self.offset) if self.kind == "log" else distance
            ) / self.divisor
        return (2 * unit - 1).clamp(-1, 1)

    def decode(self, x: torch.Tensor) -> torch.Tensor:
        """Map values (any shape) to ranges in metres, 0 = no return; values outside [-1, 1] are
        clamped."""
        unit = ((x + 1) / 2).clamp(0, 1)
        if self.kind == "log":
            distance = torch.exp2(unit * self.divisor) - self.offset
        else:
            distance = (
                unit * self.divisor if self.kind == "linear" else self.range_min / unit
            )
        return torch.where(self.inside(distance), distance, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """The arguments as plain values for a checkpoint's header; ``Normalisation(**values)`` is
        the inverse."""
        return asdict(self)


NORMALISATIONS = {
    "r2flow": Normalisation("log", 1.45, 80.0),
    "r2flow_inverse": Normalisation("inverse", 1.45, 80.0),
    "r2flow_metric": Normalisation("linear", 1.45, 80.0),
    "lidm_log": Normalisation("log", 1.0, 56.0, scale=5.84, offset=1.0001),
    "lidm_linear": Normalisation("linear", 1.0, 56.0),
}
"""The normalisations of R2Flow and LiDM by name."""


def encode_reflectance(reflectance: torch.Tensor) -> torch.Tensor:
    """Reflectance in [0, 1] (any shape) to [-1, 1]."""
    return 2 * reflectance - 1


def decode_reflectance(x: torch.Tensor) -> torch.Tensor:
    """Values (any shape) to reflectance in [0, 1]; values beyond [-1, 1] are clamped."""
    return ((x + 1) / 2).clamp(0, 1)


def encode_labels(label: torch.Tensor) -> torch.Tensor:
    """Labels as analog bits (Chen et al. 2023, "Analog Bits"): 5 channels of -1 and 1, highest bit
    first.

    Args:
        label: (B, H, W) uint8 train ids 0..18, 255 = ignore, which becomes code 19.

    Returns:
        (B, 5, H, W) float32.

    Raises:
        DataError: on another id.
    """
    code = torch.where(label == IGNORE, NO_LABEL, label.long())
    if bool((code > NO_LABEL).any()):
        raise DataError(
            f"train ids {sorted(set(label[code > NO_LABEL].tolist()))[:8]}",
            "0..18, or 255 = ignore",
        )
    return torch.stack(
        [(code >> b & 1) * 2.0 - 1.0 for b in reversed(range(LABEL_BITS))], 1
    )


def decode_labels(bits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The label whose code is nearest to the bits, and how near.

    Args:
        bits: (B, 5, H, W) float.

    Returns:
        (B, H, W) uint8 train ids, 255 = ignore, and (B, H, W) float32 confidence: 1 on the code,
        falling with the distance (in the maximum norm) to 0 where a bit is no nearer to its value
        than to the other.
    """
    nearest = torch.zeros_like(bits[:, 0], dtype=torch.uint8)
    for bit in bits.unbind(1):
        nearest = 2 * nearest + (bit > 0)
    gap = (bits.abs() - 1).abs().amax(1)
    # all codes have the same norm: the nearest has the largest product
    if bool((unused := nearest > NO_LABEL).any()):
        powers = 1 << torch.arange(LABEL_BITS, device=bits.device).flip(0)
        corners = (
            torch.arange(NO_LABEL + 1, device=bits.device)[:, None] & powers
        ).sign() * 2.0 - 1.0
        those = bits.movedim(1, -1)[unused].float()
        code = (those @ corners.T).argmax(1)
        nearest[unused] = code.to(torch.uint8)
        gap[unused] = (those - corners[code]).abs().amax(1).to(gap.dtype)
    label = torch.where(nearest == NO_LABEL, IGNORE, nearest)
    return label, (1 - gap).clamp(0, 1).float()


CHANNELS = {"range": 1, "reflectance": 1, "label": LABEL_BITS}
"""The channels that a network's tensor can contain: {name of a range image's channel: number of
tensor channels}."""


@dataclass(frozen=True)
class TensorFormat:
    """The layout of a network's tensor: the channels of a range image that it contains, and the
    range normalisation.

    Args:
        channels: names of ``CHANNELS``, in the tensor's order; "range" must be one of them.
        normalisation: the normalisation of the range.

    Raises:
        ConfigError: on an unknown or repeated channel, or if "range" is missing.
    """

    channels: tuple[str, ...]
    normalisation: Normalisation

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", tuple(self.channels))
        unknown = [name for name in self.channels if name not in CHANNELS]
        if (
            unknown
            or "range" not in self.channels
            or len(set(self.channels)) < len(self.channels)
        ):
            raise ConfigError(
                f"channels {self.channels}",
                f"range and some of {tuple(CHANNELS)}, each once",
            )

    @property
    def size(self) -> int:
        """C, the number of channels of the tensor."""
        return sum(CHANNELS[name] for name in self.channels)

    def parts(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """The channels of a tensor (B, C, H, W) by name, (B, channels of it, H, W) each."""
        sizes = [CHANNELS[name] for name in self.channels]
        return dict(zip(self.channels, torch.split(x, sizes, 1), strict=True))

    def encode(self, fields: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Encode the fields of range images as a tensor.

        Args:
            fields: (B, H, W) each: "range" float32 metres, 0 = no return; "reflectance" float32 in
                [0, 1]; "label" uint8 train ids, 255 = ignore; further fields are ignored.

        Returns:
            (B, C, H, W) float32 in [-1, 1].

        Raises:
            ConfigError: if a channel is missing.
            DataError: on a label that is not a train id.
        """
        if missing := [name for name in self.channels if name not in fields]:
            raise ConfigError(
                f"range images without {missing}", f"all of {self.channels}"
            )
        encoders = {
            "range": lambda d: self.normalisation.encode(d)[:, None],
            "reflectance": lambda r: encode_reflectance(r)[:, None],
            "label": encode_labels,
        }
        return torch.cat([encoders[name](fields[name]) for name in self.channels], 1)

    def decode(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """Decode a tensor to the fields of range images.

        Args:
            x: (B, C, H, W) floating point.

        Returns:
            (B, H, W) each, as for ``encode``; with "label" also "confidence" float32 in [0, 1]. A
            cell without a return has reflectance 0, label 255 (ignore) and confidence 0.

        Raises:
            DataError: on a wrong number of channels, NaN or infinity.
        """
        if x.ndim != 4 or x.shape[1] != self.size:
            raise DataError(
                f"a tensor of shape {tuple(x.shape)}",
                f"(B, {self.size}, H, W) for {self.channels}",
            )
        if not x.abs().amax().isfinite():
            raise DataError(
                f"a tensor for {self.channels} with NaN or infinity", "finite values"
            )
        part = self.parts(x.float())
        fields = {"range": self.normalisation.decode(part["range"][:, 0])}
        empty = fields["range"] == 0
        if "reflectance" in part:
            fields["reflectance"] = decode_reflectance(
                part["reflectance"][:, 0]
            ).masked_fill_(empty, 0)
        if "label" in part:
            label, confidence = decode_labels(part["label"])
            fields["label"] = label.masked_fill_(empty, IGNORE)
            fields["confidence"] = confidence.masked_fill_(empty, 0)
        return fields

    def from_images(self, images: Sequence[RangeImage]) -> torch.Tensor:
        """Encode B range images of one shape as a tensor (B, C, H, W); see ``encode``."""
        values: list[dict[str, Any]] = [
            {**image.channels, "range": image.range} for image in images
        ]
        if missing := [
            name for name in self.channels if any(name not in v for v in values)
        ]:
            raise ConfigError(
                f"range images without {missing}", f"all of {self.channels}"
            )
        return self.encode(
            {
                n: torch.from_numpy(np.stack([v[n] for v in values]))
                for n in self.channels
            }
        )

    def to_images(self, x: torch.Tensor, sensor: Sensor) -> list[RangeImage]:
        """Decode a tensor (B, C, H, W) to B range images on the sensor's grid; see ``decode``."""
        fields = {name: values.cpu().numpy() for name, values in self.decode(x).items()}
        distance = fields.pop("range")
        return [
            RangeImage(d, sensor, {n: v[i] for n, v in fields.items()})
            for i, d in enumerate(distance)
        ]
