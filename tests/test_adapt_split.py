"""The scans that an adaptation trains on and holds out."""

import pytest

from lidar_synth.lab.train.adaptation.scans import split


@pytest.mark.parametrize("count", [12, 16, 24, 200, 1000])
def test_the_split_leaves_scans_out_between_training_and_test(count: int) -> None:
    parts = split([f"00/{i:06d}" for i in range(count)])
    assert (
        max(parts.train)
        < min(parts.between)
        <= max(parts.between)
        < min(parts.held_out)
    )
    assert len(parts.train) + len(parts.between) + len(parts.held_out) == min(
        count, 200
    )
    assert (
        len(parts.held_out) == round(0.2 * min(count, 200))
        and max(parts.held_out) == count - 1
    )


@pytest.mark.parametrize("lengths", [[4] * 7, [30, 30, 20, 9], [100, 100, 40, 30, 20]])
def test_the_split_holds_out_whole_drives(lengths: list[int]) -> None:
    names = [
        f"{drive:02d}/{i:06d}"
        for drive, length in enumerate(lengths)
        for i in range(length)
    ]
    parts = split(names)
    trained, held = (
        {names[i][:2] for i in part} for part in (parts.train, parts.held_out)
    )
    assert not trained & held and not parts.between
    assert 0.1 <= len(parts.held_out) / (len(parts.held_out) + len(parts.train)) <= 0.4


def test_a_last_drive_that_is_too_long_is_split_by_time() -> None:
    parts = split([f"00/{i}" for i in range(5)] + [f"01/{i}" for i in range(95)])
    assert len(parts.held_out) == 20 and len(parts.between) == 5
