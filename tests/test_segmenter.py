"""The small range-view segmenter."""

import pytest
import torch

from lidar_synth.lab.evaluate.segmenter import (
    ROW_BANDS,
    RangeSegmenter,
    segmenter_input,
)


def test_shapes_and_that_columns_wrap() -> None:
    torch.manual_seed(0)
    network = RangeSegmenter(widths=(8, 8, 12, 12)).eval()
    x = torch.randn(2, 4, 16, 64)
    logits = network(x)
    assert logits.shape == (2, 19, 16, 64)
    assert network.features(x).shape == (2, ROW_BANDS * 8)
    # A turn of the sensor by a multiple of the total stride turns the answer.
    assert torch.allclose(network(x.roll(16, -1)), logits.roll(16, -1), atol=1e-5)
    assert torch.allclose(
        network.features(x.roll(16, -1)), network.features(x), atol=1e-5
    )


@pytest.mark.slow
def test_it_learns_what_depends_on_height() -> None:
    torch.manual_seed(0)
    network = RangeSegmenter(classes=2, widths=(8, 8, 8))
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    height = torch.linspace(0.05, -0.4, 16)[:, None].expand(16, 32)
    for _ in range(40):
        distance = torch.rand(4, 16, 32) * 40
        target = (distance * height < -1.5).long()
        loss = torch.nn.functional.cross_entropy(
            network(segmenter_input(distance, torch.rand(4, 16, 32), height)), target
        )
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss < 0.25


def test_the_input_is_zero_where_there_is_no_return() -> None:
    x = segmenter_input(torch.zeros(1, 4, 8), torch.ones(1, 4, 8), torch.ones(4, 8))
    assert x.shape == (1, 4, 4, 8) and not x.any()
