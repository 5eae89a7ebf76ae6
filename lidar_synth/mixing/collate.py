"""Batches of plain PyTorch items: concatenated points with offsets, padded points, or range
images."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import default_collate
from torch.utils.data._utils.collate import default_collate_fn_map

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, choose
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.projection import project
from lidar_synth.mixing.items import Item

Form = Literal["offsets", "padded", "range"]
"""The layout of a batch, see ``Collate``."""

_KEYS = {"points", "label", "confidence", "boxes", "names", "domain", "id"}
"""The keys that every item of a batch must have."""

Unlabelled = Literal["error", "allow"]
"""Whether a batch without any valid label raises an error or is returned."""


@dataclass(frozen=True)
class Collate:
    """A ``collate_fn`` that makes a batch of B items.

    Every batch has ``boxes`` (ΣM, 7) float32 with ``box_offsets`` (B + 1,) int64, ``names`` (B
    tuples), ``domain`` (B,) int64, ``loss_weight`` (B,) float32 and ``id`` (B names). The other
    keys depend on the form:

    - ``offsets``: ``points`` (ΣN, 4) float32, ``label`` (ΣN,) int64, ``confidence`` (ΣN,) float32,
      the concatenation of all scans; ``offsets`` (B + 1,) int64: scan b is
      ``points[offsets[b]:offsets[b + 1]]``.
    - ``padded``: ``points`` (B, N, 4), ``label`` (B, N), ``confidence`` (B, N), and ``mask`` (B, N)
      bool, True for points; padding is 0, with label 255.
    - ``range``: ``range`` (B, H, W) float32 metres, 0 = no return; ``reflectance``, ``label``
      int64, ``confidence`` (B, H, W) of the nearest returns; ``mask`` (B, H, W) bool, True for
      cells with a return.

    Args:
        form: one of these.
        sensor: defines the grid of range images.
        unlabelled: ``"error"`` refuses a batch that has neither a valid label nor a box,
            ``"allow"`` returns it. The mean loss over no label is NaN, and one optimiser step with
            it makes all weights NaN.

    Raises:
        ConfigError: on an unknown form, or no sensor for range images.
    """

    form: Form = "offsets"
    sensor: Sensor | None = None
    unlabelled: Unlabelled = "error"

    def __post_init__(self) -> None:
        for name, kind in (("form", Form), ("unlabelled", Unlabelled)):
            known = dict.fromkeys(get_args(kind))
            choose(f"{name} of batches:", getattr(self, name), known)
        if self.form == "range" and self.sensor is None:
            raise ConfigError(
                "range images without a sensor", "a sensor, which defines their grid"
            )

    def __call__(self, items: Sequence[Item]) -> dict[str, Any]:
        """Make a batch of the items.

        Raises:
            ConfigError: on samples of another form.
            DataError: if no item has a valid label or a box.
        """
        for item in items:
            if not isinstance(item, dict) or not item.keys() >= _KEYS:
                form = sorted(item) if isinstance(item, dict) else type(item).__name__
                raise ConfigError(
                    f"a sample of the form {form}",
                    f"a dict with {', '.join(sorted(_KEYS))}, as to_item makes it",
                    "Give MixedScans(..., to_sample=..., collate=function), a function for "
                    "samples of your form.",
                )
        boxes = [item["boxes"] for item in items]
        batch = _FORMS[self.form](items, self.sensor) | {
            "boxes": torch.cat(boxes),
            "box_offsets": _offsets(boxes),
            "names": [item["names"] for item in items],
            "domain": torch.tensor([item["domain"] for item in items], device="cpu"),
            "loss_weight": torch.tensor(
                [item.get("loss_weight", 1.0) for item in items],
                dtype=torch.float32,
                device="cpu",
            ),
            "id": [item["id"] for item in items],
        }
        if (
            self.unlabelled == "error"
            and not len(batch["boxes"])
            and not (batch["label"] != IGNORE).any()
        ):
            raise DataError(
                f"a batch without any valid label or box (scans {batch['id'][:4]})",
                "at least one, because the loss over no label is NaN",
                "Use larger batches with balanced=True, so that each holds labelled scans; "
                "labels='generated' or another policy that gives labels; labels='none' for an "
                "unlabelled pool; or unlabelled='allow' and skip such batches in the training "
                "loop.",
            )
        return batch


def collate_by_default(items: Sequence[Item], **options: Any) -> Any:
    """torch's default collation, for a ``DataLoader`` without a ``collate_fn``.

    Raises:
        ConfigError: on scans of different sizes, which it cannot stack.
    """
    try:
        return default_collate([dict(item) for item in items])
    except RuntimeError as error:
        raise ConfigError(
            "a DataLoader without collate_fn, whose scans differ in size",
            "the collate_fn of the mixture",
            "DataLoader(train, batch_size=4, collate_fn=train.collate)",
        ) from error


# torch's documented way to define the default collation of a type.
default_collate_fn_map[Item] = collate_by_default


def _offset_points(items: Sequence[Item], sensor: Sensor | None) -> dict[str, Tensor]:
    points, label, confidence = _columns(items)
    return {
        "points": torch.cat(points),
        "label": torch.cat(label),
        "confidence": torch.cat(confidence),
        "offsets": _offsets(points),
    }


def _padded_points(items: Sequence[Item], sensor: Sensor | None) -> dict[str, Tensor]:
    points, label, confidence = _columns(items)
    return {
        "points": pad_sequence(points, batch_first=True),
        "label": pad_sequence(label, batch_first=True, padding_value=IGNORE),
        "confidence": pad_sequence(confidence, batch_first=True),
        "mask": pad_sequence(
            [torch.ones_like(part, dtype=torch.bool) for part in label],
            batch_first=True,
        ),
    }


def _range_images(items: Sequence[Item], sensor: Sensor | None) -> dict[str, Tensor]:
    assert sensor is not None
    images = []
    for item in items:
        points = item["points"].numpy()
        scan = Scan(
            points[:, :3],
            np.ascontiguousarray(points[:, 3]),
            sensor,
            label=item["label"].numpy().astype(np.uint8),
            confidence=item["confidence"].numpy(),
            id=item["id"],
        )
        images.append(project(scan))
    distance = torch.from_numpy(np.stack([image.range for image in images]))
    names = ("reflectance", "label", "confidence")
    channels = {
        n: torch.from_numpy(np.stack([image.channels[n] for image in images]))
        for n in names
    }
    return {
        "range": distance,
        **channels,
        "label": channels["label"].long(),
        "mask": distance > 0,
    }


_FORMS: dict[str, Callable[[Sequence[Item], Sensor | None], dict[str, Any]]] = {
    "offsets": _offset_points,
    "padded": _padded_points,
    "range": _range_images,
}


def _columns(items: Sequence[Item]) -> list[list[Tensor]]:
    names = ("points", "label", "confidence")
    return [[item[name] for item in items] for name in names]


def _offsets(parts: Sequence[Tensor]) -> Tensor:
    """(B + 1,) int64, the start of each part, and the end of the last."""
    ends = [0, *(len(part) for part in parts)]
    return torch.tensor(ends, device="cpu").cumsum(0)
