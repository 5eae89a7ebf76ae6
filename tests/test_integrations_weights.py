"""Weights of samples reach the losses of anchor heads. Heads of the form of OpenPCDet's and
MMDetection3D's stand here for them: their own loops are run by their own test files, where the
trainers are installed."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lidar_synth.integrations.mixture import mix_for_trainer
from lidar_synth.integrations.weights import weigh_mmdet3d, weigh_openpcdet
from mixtures import Endless, as_is
from torch import Tensor, nn

from lidar_synth.errors import ConfigError


class AnchorLoss(nn.Module):
    """As OpenPCDet's ``WeightedSmoothL1Loss``: a loss for each anchor, (B, anchors)."""

    def forward(self, found: Tensor, target: Tensor, weights: Tensor) -> Tensor:
        return (found - target).abs() * weights


class AnchorHead(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        for name in ("cls_loss_func", "reg_loss_func", "dir_loss_func"):
            self.add_module(name, AnchorLoss())
        self.scale = nn.Parameter(torch.ones(()))

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        x = batch["x"] * self.scale
        losses = (self.cls_loss_func, self.reg_loss_func, self.dir_loss_func)
        zeros = torch.zeros_like(x)
        terms = [loss(x, zeros, weights=zeros + 1).sum() for loss in losses]
        return sum(terms)  # type: ignore[no-any-return]


class Detector(nn.Module):
    def __init__(self, **further: Any) -> None:
        super().__init__()
        self.dense_head = AnchorHead()
        self.__dict__ |= further

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        loss: Tensor = self.dense_head(batch)
        return loss


def test_the_loss_of_a_sample_is_multiplied_by_its_weight() -> None:
    model = Detector()
    batch = {"x": torch.tensor([[1.0, 2], [10, 20]])}
    plain = model(batch).item()
    weigh_openpcdet(model)
    assert model(batch).item() == plain == 3 * 33
    weighed = model(batch | {"loss_weight": torch.tensor([1.0, 0.1])})
    assert weighed.item() == pytest.approx(3 * (3 + 3))
    weighed.backward()
    assert model.dense_head.scale.grad.item() == pytest.approx(3 * (3 + 3))
    model.eval()  # a validation has no weights
    assert model(batch | {"loss_weight": torch.zeros(2)}).item() == plain


def test_a_model_that_cannot_weigh_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"loss_weight.*roi_head"):
        weigh_openpcdet(Detector(roi_head=nn.Identity()))
    centers = nn.Module()
    centers.dense_head = nn.Module()
    centers.dense_head.hm_loss_func = AnchorLoss()
    with pytest.raises(ConfigError, match="synthetic_first"):
        weigh_openpcdet(centers)
    with pytest.raises(ConfigError, match="loss_weight"):
        weigh_mmdet3d(SimpleNamespace(bbox_head=SimpleNamespace()), float)


def test_anchors_of_a_sample_are_weighed_in_mmdetection3d() -> None:
    def targets(anchors: Any, boxes: Any, metas: Any, sampling: bool) -> Any:
        label = torch.zeros(len(metas), 3)
        box = torch.ones(len(metas), 3, 7)
        assert sampling
        return [label], [label + 1], [box], [box], [label], [label + 1], 4, 5

    head = SimpleNamespace(anchor_target_3d=targets)
    weights = {"real.bin": 1.0, "lsynth://a/0.bin": 0.1}
    weigh_mmdet3d(SimpleNamespace(bbox_head=head), weights.__getitem__)
    metas = [{"lidar_path": path} for path in weights]
    found = head.anchor_target_3d(None, None, metas, sampling=True)
    expected = torch.tensor([1.0, 0.1])
    for place in (1, 3, 5):
        [level] = found[place]
        assert torch.allclose(level.flatten(1).mean(1), expected)
    assert torch.equal(found[2][0], torch.ones(2, 3, 7)) and found[6:] == (4, 5)


def test_a_trainer_without_weights_refuses_them() -> None:
    settings = {"synthetic": Endless(), "ratio": 0.5, "loss_weight": 0.1}
    with pytest.raises(ConfigError, match="loss_weight"):
        mix_for_trainer(4, settings, as_is)
    mixed = mix_for_trainer(4, settings, as_is, weighs=True)
    weights = {mixed.domain(i): mixed.loss_weight(i) for i in range(len(mixed))}
    assert weights == {0: 1.0, 1: 0.1}
