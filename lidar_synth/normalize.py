"""Range images to tensors in [-1, 1] and back, in the scales that the peers' networks were trained on.

encode and decode are exact inverses up to float32 rounding for every range inside the open interval
(range_min, range_max); everything outside decodes to 0 = no return.
"""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch

from lidar_synth.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, DataError

LABEL_BITS = 5
NO_LABEL = len(NAMES)
"""Code of a cell without a label, after the 19 classes."""


@dataclass(frozen=True)
class Normalisation:
    """How a range in metres becomes a value in [-1, 1].

    Args:
        kind: "log": 2 log2(d + offset) / scale - 1; "linear": 2 d / scale - 1;
            "inverse": 2 range_min / d - 1.
        range_min: metres, exclusive.
        range_max: metres, exclusive.
        scale: the divisor; by default the one that takes range_max to 1.
        offset: added before the logarithm.

    Raises:
        ConfigError: on an unknown kind or limits that are not 0 <= range_min < range_max.
    """

    kind: Literal["log", "linear", "inverse"]
    range_min: float
    range_max: float
    scale: float | None = None
    offset: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in ("log", "linear", "inverse"):
            raise ConfigError(f"normalisation {self.kind!r}", "log, linear or inverse")
        if not 0 <= self.range_min < self.range_max:
            raise ConfigError(f"range limits {self.range_min}, {self.range_max} m", "0 <= range_min < range_max")

    @property
    def divisor(self) -> float:
        """The ``scale`` in force."""
        if self.scale is not None:
            return self.scale
        return float(np.log2(self.range_max + self.offset)) if self.kind == "log" else self.range_max

    def inside(self, distance: torch.Tensor) -> torch.Tensor:
        """Where a range (any shape, metres) counts as a return."""
        return (distance > self.range_min) & (distance < self.range_max)

    def encode(self, distance: torch.Tensor) -> torch.Tensor:
        """Ranges (any shape, metres, 0 = no return) to [-1, 1]; no return lies at -1."""
        inside = self.inside(distance)
        if self.kind == "inverse":
            unit = torch.where(inside, self.range_min / torch.where(inside, distance, 1.0), 0.0)
        else:
            distance = torch.where(inside, distance, 0.0)
            unit = (torch.log2(distance + self.offset) if self.kind == "log" else distance) / self.divisor
        return (2 * unit - 1).clamp(-1, 1)

    def decode(self, x: torch.Tensor) -> torch.Tensor:
        """Values (any shape) to ranges in metres, 0 = no return; values beyond [-1, 1] are clamped."""
        unit = ((x + 1) / 2).clamp(0, 1)
        if self.kind == "log":
            distance = torch.exp2(unit * self.divisor) - self.offset
        else:
            distance = unit * self.divisor if self.kind == "linear" else self.range_min / unit
        return torch.where(self.inside(distance), distance, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as a checkpoint's header holds them; ``Normalisation(**values)`` is the inverse."""
        return asdict(self)


NORMALISATIONS = {
    "r2flow": Normalisation("log", 1.45, 80.0),
    "r2flow_inverse": Normalisation("inverse", 1.45, 80.0),
    "r2flow_metric": Normalisation("linear", 1.45, 80.0),
    "lidm_log": Normalisation("log", 1.0, 56.0, scale=5.84, offset=1.0001),
    "lidm_linear": Normalisation("linear", 1.0, 56.0),
}
"""The peers' scales by name."""


def encode_reflectance(reflectance: torch.Tensor) -> torch.Tensor:
    """Reflectance in [0, 1] (any shape) to [-1, 1]."""
    return 2 * reflectance - 1


def decode_reflectance(x: torch.Tensor) -> torch.Tensor:
    """Values (any shape) to reflectance in [0, 1]; values beyond [-1, 1] are clamped."""
    return ((x + 1) / 2).clamp(0, 1)


def encode_labels(label: torch.Tensor) -> torch.Tensor:
    """Labels as analog bits (Chen et al. 2023, "Analog Bits"): 5 channels of -1 and 1, highest bit first.

    Args:
        label: (B, H, W) uint8 train ids 0..18, 255 = ignore, which becomes code 19.

    Returns:
        (B, 5, H, W) float32.

    Raises:
        DataError: on another id.
    """
    code = torch.where(label == IGNORE, NO_LABEL, label.long())
    if bool((code > NO_LABEL).any()):
        raise DataError(f"train ids {sorted(set(label[code > NO_LABEL].tolist()))[:8]}", "0..18, or 255 = ignore")
    return torch.stack([(code >> b & 1) * 2.0 - 1.0 for b in reversed(range(LABEL_BITS))], 1)


def decode_labels(bits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The label whose code is nearest to the bits, and how near.

    Args:
        bits: (B, 5, H, W) float.

    Returns:
        (B, H, W) uint8 train ids, 255 = ignore, and (B, H, W) float32 confidence: 1 on the code, falling
        with the distance (in the maximum norm) to 0 where a bit is no nearer to its value than to the other.
    """
    codes = torch.arange(NO_LABEL + 1, device=bits.device, dtype=torch.uint8)
    codes = torch.where(codes == NO_LABEL, IGNORE, codes)
    corners = encode_labels(codes[None, None].to(torch.uint8))[0, :, 0].to(bits.dtype)  # (5, 20)
    # |bits - corner|^2 without its constant part: the nearest corner is the one with the largest product.
    nearest = torch.einsum("bchw,ck->bkhw", bits, corners).argmax(1)
    gap = (bits - corners[:, nearest].movedim(0, 1)).abs().amax(1)
    return codes[nearest].to(torch.uint8), (1 - gap).clamp(0, 1).float()
