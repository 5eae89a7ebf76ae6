"""States: they tell their mixture, and another one is refused with the difference named."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from mixtures import Endless, Scans

from lidar_synth.errors import ConfigError
from lidar_synth.mixing import MixedScans, MixedStream, Sources
from lidar_synth.mixing.state import after_epoch, make_state


def mixed(
    real: int = 12, ratio: Any = 0.25, synth: Any = None, **options: Any
) -> MixedScans:
    return MixedScans(
        Scans("r", real), Endless() if synth is None else synth, ratio, **options
    )


def batches(train: MixedScans) -> Any:
    return train.batches(4)


def stream(train: MixedScans) -> Any:
    return MixedStream(train, batch_size=4, endless=False)


WAYS = pytest.mark.parametrize("make", [batches, stream])


@WAYS
@pytest.mark.parametrize(
    ("other", "difference"),
    [
        (lambda: mixed(ratio=0.5), r"ratio 1/4, here 1/2"),
        (lambda: mixed(real=4), r"real\[0\] length 12, here 4"),
        (lambda: mixed(epoch_size="replace"), r"epoch_size add, here replace"),
        (lambda: mixed(reuse=2), r"reuse 1, here 2"),
        (lambda: mixed(balanced=True), r"balanced False, here True"),
        (lambda: mixed(synth=Endless(name="t")), r"synthetic\[0\] identity s, here t"),
        (
            lambda: mixed(synth=Sources(Endless(), Endless(name="t"))),
            r"synthetic .*'s'.*, here .*'t'",
        ),
        (lambda: mixed(ratio=[0.5, 0.25]), r"samples before\[1\] 4, here 12"),
        (lambda: mixed(seed=1), r"seed 0, here 1"),
    ],
)
def test_a_state_of_another_mixture_is_refused(
    make: Callable[[MixedScans], Any], other: Callable[[], MixedScans], difference: str
) -> None:
    state = make_state(mixed().mixture, 1, 8)
    with pytest.raises(ConfigError, match=difference):
        make(other()).load_state_dict(state)


@WAYS
def test_a_state_survives_json_and_fits_its_mixture(
    make: Callable[[MixedScans], Any],
) -> None:
    whole = make(mixed())
    state = json.loads(json.dumps(whole.state_dict(2)))
    assert (state["epoch"], state["position"], state["mixture"]["ratio"]) == (
        0,
        8,
        "1/4",
    )
    again = make(mixed())
    again.load_state_dict(state)
    assert len(list(again)) == (2 if make is batches else 8)


@WAYS
def test_a_state_without_its_plan(make: Callable[[MixedScans], Any]) -> None:
    with pytest.raises(ConfigError, match="the hash of the plan"):
        make(mixed()).load_state_dict({"seed": 0, "epoch": 3, "position": 0})
    for wrong in ({"position": -1}, {"epoch": -1}, {"position": 1.0}):
        with pytest.raises(ConfigError, match="integers of 0 or more"):
            make(mixed()).load_state_dict(make_state(mixed().mixture, 0, 8) | wrong)


@WAYS
def test_a_state_of_another_version_or_seed_is_refused(
    make: Callable[[MixedScans], Any],
) -> None:
    state = make_state(mixed().mixture, 1, 8)
    for key, difference in [
        ("version", "version 7, here 2"),
        ("seed", "seed 7, here 0"),
    ]:
        with pytest.raises(
            ConfigError, match=f"another mixture: {difference}; expected"
        ):
            make(mixed()).load_state_dict(state | {key: 7})
        del state[key]
        make(mixed()).load_state_dict(state)


@WAYS
def test_a_position_beyond_the_epoch_is_refused(
    make: Callable[[MixedScans], Any],
) -> None:
    with pytest.raises(ConfigError, match="position 17 of an epoch of 16 samples"):
        make(mixed()).load_state_dict(make_state(mixed().mixture, 0, 17))


def test_the_last_epoch_of_a_schedule_ends_where_it_ends() -> None:
    train = mixed(ratio=[0.5, 0.25])
    assert after_epoch(train.mixture, 0) == (1, 0)
    assert after_epoch(train.mixture, 1) == (1, 24)
    train.set_epoch(1)
    state = train.batches(4).state_dict(6)
    assert (state["epoch"], state["position"]) == (1, 24)
    train.batches(4).load_state_dict(state)


def test_a_resumed_epoch_that_comes_again_after_another_is_whole() -> None:
    train = mixed()
    resumed = batches(train)
    resumed.load_state_dict(make_state(train.mixture, 1, 8))
    counts = []
    for epoch in (1, 2, 1):
        train.set_epoch(epoch)
        counts.append(sum(map(len, resumed)))
    assert counts == [8, 16, 16]


def test_the_next_epochs_ratio_may_change() -> None:
    """What is still to come is not part of a state."""
    state = make_state(mixed(ratio=[0.25, 0.25], epoch_size=16).mixture, 0, 8)
    batches(mixed(ratio=[0.25, 0.5], epoch_size=16)).load_state_dict(state)


def test_a_schedule_of_unrelated_shares_has_states_for_ever() -> None:
    """The exact sum of its shares has ever more digits."""
    train = mixed(50, lambda epoch: 0.9 * 0.995**epoch, epoch_size="replace")
    plans = [train.plan(epoch) for epoch in (1299, 1499, 1500)]
    assert all(len(plan.hash) == 64 for plan in plans)
    assert plans[2].before == tuple(
        before + count
        for before, count in zip(plans[1].before, plans[1].counts, strict=True)
    )
