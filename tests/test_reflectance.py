"""What a sensor reads beside the range: zero-inflated reflectance."""

import pytest
import torch
from torch import Tensor

from lidar_synth.generate.models.surface_codec.reflectance import (
    BLANK,
    ZeroInflatedLogistic,
)

CASES = [(0.1, 0.15, 0.2), (-0.9, 0.2, 0.001), (0.8, 0.05, 0.9)]
"""Medians, scales, shares of a 0."""


def readings(
    middle: float, scale: float, blank: float, cells: int = 1
) -> ZeroInflatedLogistic:
    values = torch.tensor([middle, scale, blank], dtype=torch.float64)
    parts = values[0], values[1].log(), values[2].logit()
    return ZeroInflatedLogistic(*(part.expand(cells, 1, 1, 1) for part in parts))


def column(values: Tensor) -> Tensor:
    return values.double().view(-1, 1, 1, 1)


@pytest.mark.parametrize("case", CASES)
def test_chances_add_up_to_one(case: tuple[float, float, float]) -> None:
    predicted = readings(*case)
    x = torch.linspace(BLANK + 1e-9, 9, 100_001, dtype=torch.float64)
    numbers = torch.trapezoid(torch.exp(-predicted.nll(column(x))).flatten(), x)
    nothing = torch.exp(-predicted.nll(column(torch.tensor([BLANK]))))
    assert numbers + nothing == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("case", CASES)
def test_draws_are_as_likely_as_was_said(case: tuple[float, float, float]) -> None:
    count = 100_000
    drawn = (
        readings(*case, cells=count)
        .sample(column((torch.arange(count) + 0.5) / count))
        .flatten()
    )
    predicted = readings(*case)
    nothing = torch.exp(-predicted.nll(column(torch.tensor([BLANK])))).item()
    assert (drawn == BLANK).double().mean().item() == pytest.approx(nothing, abs=1e-4)
    numbers = drawn[drawn > BLANK]
    low, high = numbers.quantile(torch.tensor([0.4, 0.6], dtype=torch.float64)).tolist()
    x = torch.linspace(low, high, 1001, dtype=torch.float64)
    between = torch.trapezoid(torch.exp(-predicted.nll(column(x))).flatten(), x)
    assert between.item() == pytest.approx(0.2 * len(numbers) / count, rel=0.01)


def test_numbers_at_the_ends_of_chance_are_finite() -> None:
    ends = column(torch.tensor([1e-12, 0.5, 1 - 1e-12], dtype=torch.float64))
    for blank in (0.0, 1.0):
        assert readings(0.1, 0.15, blank, cells=3).sample(ends).isfinite().all()


def test_gradients_are_finite_where_a_reading_is_far_off() -> None:
    parts = [
        torch.tensor(v).view(1, 1, 1, 1).requires_grad_() for v in (1.0, -4.6, -30.0)
    ]
    predicted = ZeroInflatedLogistic(*parts)
    for x in (BLANK, -0.99, 1.0):
        predicted.nll(torch.full((1, 1, 1, 1), x)).sum().backward()
    assert all(part.grad is not None and part.grad.isfinite().all() for part in parts)
