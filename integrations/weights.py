"""Weights of samples in the losses of OpenPCDet's and MMDetection3D's anchor heads.

Both compute a loss for each anchor of each sample before they add them up, so that a sample's can
be multiplied by its weight (``loss_weight`` of the mixture). Other heads add up inside of the loss.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from lidar_synth.errors import ConfigError

LOSSES = ("cls_loss_func", "reg_loss_func", "dir_loss_func")
"""Names of the losses of OpenPCDet's anchor heads; each returns (B, anchors, ...)."""
KEY = "loss_weight"


class WeighedLoss(nn.Module):
    """A loss whose samples are multiplied by their weights.

    Args:
        loss: returns (B, ...).

    Attributes:
        weights: (B,) of the next batch; None for 1.
    """

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss
        self.weights: Tensor | None = None

    def forward(self, *args: Any, **options: Any) -> Tensor:
        """The loss (B, ...), multiplied."""
        loss: Tensor = self.loss(*args, **options)
        if self.weights is None:
            return loss
        return loss * self.weights.view(-1, *[1] * (loss.dim() - 1)).to(loss)


def weigh_openpcdet(model: Any) -> None:
    """Make a model of OpenPCDet multiply the losses of a batch by its ``loss_weight``.

    Raises:
        ConfigError: on a model with another head than one of anchors, such as CenterPoint, or with
            a second stage.
    """
    model = getattr(model, "module", model)  # several GPUs
    head = getattr(model, "dense_head", None)
    names = [
        name for name in LOSSES if isinstance(getattr(head, name, None), nn.Module)
    ]
    others = [
        name
        for name in ("point_head", "roi_head")
        if getattr(model, name, None) is not None
    ]
    if "cls_loss_func" not in names or others:
        refuse_weights(" and ".join([type(head).__name__, *others]))
    losses = [WeighedLoss(getattr(head, name)) for name in names]
    for name, loss in zip(names, losses, strict=True):
        setattr(head, name, loss)

    def take_weights(module: Any, args: tuple[Any, ...]) -> None:
        for loss in losses:
            loss.weights = args[0].get(KEY) if module.training else None

    model.register_forward_pre_hook(take_weights)


def weigh_mmdet3d(model: Any, weight_of: Callable[[str], float]) -> None:
    """Make a model of MMDetection3D multiply the weights of the anchors of each sample.

    Args:
        model: its detector.
        weight_of: the weight of a sample by the path of its points (``lidar_path``).

    Raises:
        ConfigError: on a model with another head than one of anchors, or with a second stage.
    """
    model = getattr(model, "module", model)
    head: Any = getattr(model, "bbox_head", None)
    if not hasattr(head, "anchor_target_3d") or getattr(model, "roi_head", None):
        refuse_weights(type(head).__name__)
    make_targets = head.anchor_target_3d

    def weighed(
        anchors: Any, boxes: Any, metas: Any, *args: Any, **options: Any
    ) -> Any:
        targets = list(make_targets(anchors, boxes, metas, *args, **options))
        weights = torch.tensor([weight_of(meta["lidar_path"]) for meta in metas])
        for place in (1, 3, 5):  # the weights of labels, boxes and directions, by level
            targets[place] = [
                part * weights.view(-1, *[1] * (part.dim() - 1)).to(part)
                for part in targets[place]
            ]
        return tuple(targets)

    head.anchor_target_3d = weighed


def refuse_weights(trainer: str) -> None:
    """Refuse ``loss_weight`` for a trainer that cannot weigh.

    Raises:
        ConfigError: always.
    """
    raise ConfigError(
        f"loss_weight for {trainer}, which adds up the losses of all samples of a batch",
        "no loss_weight",
        "Use a smaller ratio, or one that falls: ratio: {synthetic_first: EPOCHS}. Anchor heads "
        "(PointPillars, SECOND) of OpenPCDet and MMDetection3D can weigh, and so can your own "
        "loop: batch['loss_weight'].",
    )
