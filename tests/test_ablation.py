"""tools/research/ablation.py: students learn from recorded parts of trajectories what they would learn from
the teacher."""

import pytest
import torch
from project import ROOT

GRIDS = {4: (1.0, 0.84, 0.56, 0.24, 0.0), 2: (1.0, 0.62, 0.0), 1: (1.0, 0.0)}


@pytest.mark.parametrize("number", range(12))
def test_a_student_learns_the_recorded_slope_within_the_recorded_part(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    from ablation import students, supervision

    student = students(GRIDS)[number]
    draws = torch.Generator().manual_seed(0)
    y0, y1, slope = (torch.randn(6, 1, 2, 2, generator=draws) for _ in range(3))
    interval = torch.arange(6) % (len(student.parts) - 1)
    start, end = (
        torch.tensor(student.parts)[interval + k].view(-1, 1, 1, 1) for k in (0, 1)
    )
    begin = torch.lerp(y0, y1, start)
    y, t, v = supervision(
        student, {"y0": y0, "y1": y1, "interval": interval, "slope": slope}, draws
    )
    for state, time, velocity in zip(y, t, v, strict=True):
        part = int((slope - velocity).flatten(1).abs().sum(1).argmin())
        assert torch.allclose(velocity, slope[part], atol=1e-5)
        assert end[part].item() <= time.item() <= start[part].item()
        assert torch.allclose(
            state, begin[part] + (time - start[part]) * slope[part], atol=1e-5
        )


def test_students_that_equal_another_are_not_trained(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    from ablation import students

    found = students(GRIDS)
    assert len(found) == len({(s.strategy, s.grid) for s in found}) == 12
    assert {s.strategy for s in found if len(s.grid) == 2} == {
        "reflow",
        "timestep_distillation",
    }
