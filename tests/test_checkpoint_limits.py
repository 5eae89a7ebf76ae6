"""Checkpoints whose header or weights ask for more than they may."""

from pathlib import Path
from typing import Any

import pytest
import torch
from checkpoints import ARGUMENTS, HEADER, network, replace_weights, rewrite
from torch import Tensor

from lidar_synth.errors import DataError
from lidar_synth.generate.checkpoint import (
    VELOCITY,
    NetworkSpec,
    load_checkpoint,
    save_checkpoint,
)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, HEADER, {VELOCITY: network()})
    return path


@pytest.mark.parametrize(
    "change", [lambda t: t.double() * 1e300, lambda t: t.to(torch.complex64)]
)
def test_weights_outside_the_range_of_float32_are_refused(
    saved: Path, change: Any
) -> None:
    def one(tensors: dict[str, Tensor]) -> None:
        name = next(key for key, tensor in tensors.items() if tensor.ndim == 2)
        tensors[name] = change(tensors[name])

    replace_weights(saved, one)
    with pytest.raises(DataError, match="has NaN or infinity in"):
        load_checkpoint(saved)


def test_weights_of_many_dimensions_are_refused(saved: Path) -> None:
    def one(tensors: dict[str, Tensor]) -> None:
        name = min(tensors)
        tensors[name] = tensors[name].reshape(*[1] * 70, *tensors[name].shape)

    try:
        replace_weights(saved, one)
    except RuntimeError:
        pytest.skip("this torch makes no such tensors")
    with pytest.raises(DataError, match="of more than 8 dimensions"):
        load_checkpoint(saved)


def test_arguments_that_ask_for_a_huge_network_are_refused_at_once(saved: Path) -> None:
    spec = NetworkSpec("hdit", ARGUMENTS | {"depths": [1, 2_000_000_000]})
    rewrite(saved, networks={VELOCITY: spec._asdict()})
    with pytest.raises(DataError, match="more than .* modules"):
        load_checkpoint(saved)
