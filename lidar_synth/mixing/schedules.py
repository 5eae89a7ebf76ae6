"""The share of synthetic samples, epoch by epoch.

A schedule is a function from the epoch to a share in [0, 1]. The schedules of this module have an
attribute ``constant_from``, the epoch from which on the share is constant, so that earlier samples
can be counted without visiting every epoch.
"""

from bisect import bisect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from operator import index
from typing import Any

from lidar_synth.errors import ConfigError, shorten, suggest

Schedule = Callable[[int], float]
"""``epoch -> share``: from an epoch, counted from 0, to the share of synthetic samples in [0,
1]."""

Ratio = float | Sequence[float] | Mapping[int, float] | Schedule
"""The share of synthetic samples in [0, 1], see ``make_schedule``."""

# largest denominator of a share: products with positions stay within 64 bits
_FINEST = 10**6


@dataclass(frozen=True)
class Steps:
    """A share that changes at given epochs.

    Args:
        shares: (epoch, share) pairs, sorted by epoch, the first at epoch 0.
        length: number of epochs in the schedule; None = the last share holds for ever.
    """

    shares: tuple[tuple[int, float], ...]
    length: int | None = None

    def __post_init__(self) -> None:
        if not self.shares or self.shares[0][0] != 0:
            raise ConfigError(
                f"a ratio schedule {self.shares}",
                "a ratio from epoch 0 on",
                "Write {0: 0.5, 10: 0.25}.",
            )
        for epoch, value in self.shares:
            _checked(value, epoch)

    @cached_property
    def changes(self) -> tuple[int, ...]:
        """The epochs from which on each share holds."""
        return tuple(epoch for epoch, _ in self.shares)

    @property
    def constant_from(self) -> int:
        """The epoch from which on the share is constant."""
        return self.changes[-1]

    def __call__(self, epoch: int) -> float:
        if self.length is not None and epoch >= self.length:
            raise ConfigError(
                f"epoch {epoch} of a ratio schedule for {self.length} epochs",
                "a ratio for every epoch",
                "Make the list longer, or give {epoch: ratio}, whose last ratio holds for ever.",
            )
        return self.shares[bisect(self.changes, epoch) - 1][1]


@dataclass(frozen=True)
class Linear:
    """A ratio that changes linearly from epoch to epoch and then stays constant.

    Args:
        first: ratio in epoch 0, in [0, 1].
        last: ratio from epoch ``epochs - 1`` on, in [0, 1].
        epochs: number of epochs from ``first`` to ``last``, at least 2.

    Raises:
        ConfigError: on a ratio outside [0, 1], or fewer than 2 epochs.

    Example:
        >>> from lidar_synth import Linear
        >>> ratio = Linear(0.5, 0.1, epochs=5)
        >>> [round(ratio(epoch), 1) for epoch in range(7)]
        [0.5, 0.4, 0.3, 0.2, 0.1, 0.1, 0.1]
    """

    first: float
    last: float
    epochs: int

    def __post_init__(self) -> None:
        to_integer(self.epochs, "epochs")
        _checked(self.first, 0)
        _checked(self.last, self.epochs - 1)
        if self.epochs < 2:
            raise ConfigError(
                f"a linear schedule over {self.epochs} epochs", "at least 2"
            )

    @property
    def constant_from(self) -> int:
        """The epoch from which on the share is constant."""
        return self.epochs - 1

    def __call__(self, epoch: int) -> float:
        progress = min(epoch / (self.epochs - 1), 1.0)
        return self.first * (1 - progress) + self.last * progress


@dataclass(frozen=True)
class SyntheticFirst:
    """Synthetic scans alone for three quarters of the epochs, then both kinds, and real scans alone
    in the last twentieth.

    After the last epochs, batch normalisation has the statistics of real scans. This schedule
    gained most where labelled scans are few (docs/research/proof.md, docs/research/detectors.md).

    Args:
        epochs: number of epochs of the training, at least 4. With fewer than 20, no epoch has real
            scans alone: ``settle`` the network afterwards.
        share: share of synthetic samples in the epochs with both kinds, in [0, 1].

    Raises:
        ConfigError: on fewer than 4 epochs, or a share outside [0, 1].

    Example:
        >>> from lidar_synth.mixing import SyntheticFirst
        >>> ratio = SyntheticFirst(epochs=40)
        >>> [ratio(epoch) for epoch in (0, 29, 30, 37, 38, 39)]
        [1.0, 1.0, 0.5, 0.5, 0.0, 0.0]
    """

    epochs: int
    share: float = 0.5

    def __post_init__(self) -> None:
        _checked(self.share, 0)
        check_epochs(self.epochs)

    @property
    def constant_from(self) -> int:
        """The epoch from which on the share is constant."""
        return self.epochs - self.epochs // 20

    def __call__(self, epoch: int) -> float:
        if epoch < 3 * self.epochs // 4:
            return 1.0
        return self.share if epoch < self.constant_from else 0.0


BY_NAME = {"synthetic_first": SyntheticFirst}
"""Schedules by their names in settings, ``{name: epochs}``."""


def make_schedule(ratio: Ratio) -> Schedule:
    """Make a schedule from a user's argument.

    Args:
        ratio: one share for all epochs; a list or array with one for each; ``{epoch: share}``, each
            from its epoch on; ``Linear(first, last, epochs)``; ``SyntheticFirst(epochs)``, in YAML
            ``{synthetic_first: epochs}``; or any function of the epoch.

    Raises:
        ConfigError: on a share outside [0, 1], or no share for epoch 0.
    """
    if callable(ratio):
        return ratio
    named: Any = ratio
    if hasattr(named, "tolist"):  # an array of numpy or torch
        return make_schedule(named.tolist())
    if isinstance(named, Mapping) and len(named) == 1:
        [(name, epochs)] = named.items()
        if name in BY_NAME:
            return BY_NAME[name](epochs)
        if hint := suggest(name, BY_NAME):
            raise ConfigError(f"ratio={named}", "{epoch: share}", hint)
    if isinstance(ratio, Mapping):
        return Steps(
            tuple(
                sorted(
                    (to_integer(epoch, "epoch of a ratio"), share)
                    for epoch, share in ratio.items()
                )
            )
        )
    if isinstance(ratio, Sequence) and not isinstance(ratio, str):
        return Steps(tuple(enumerate(ratio)), length=len(ratio))
    return Steps(((0, ratio),))


def share_of(schedule: Schedule, epoch: int) -> Fraction:
    """The share of synthetic samples in an epoch as a fraction; 0.1 is exactly one tenth.

    Raises:
        ConfigError: on a share outside [0, 1], a negative epoch, or one after the schedule's end.
    """
    if to_integer(epoch, "epoch") < 0:
        raise ConfigError(f"epoch {epoch}", "0 or more")
    return _checked(schedule(epoch), epoch)


def to_integer(value: Any, name: str) -> int:
    """Convert an integer of any type, such as numpy's, to a plain one.

    Raises:
        ConfigError: on anything else: a real number, text, a truth value.
    """
    try:
        if not isinstance(value, bool):
            return index(value)
    except TypeError:
        pass
    raise ConfigError(
        f"{name}={shorten(repr(value), 40)}",
        "an integer",
        "Write it without quotes or decimals.",
    )


def check_epochs(epochs: int) -> None:
    """Refuse a training too short for a schedule in quarters.

    Raises:
        ConfigError: on fewer than 4 epochs.
    """
    if to_integer(epochs, "epochs") < 4:
        raise ConfigError(f"{epochs} epochs of a schedule", "at least 4")


def constant_from(schedule: Schedule) -> int | None:
    """The epoch from which on a schedule is constant; None if unknown."""
    return getattr(schedule, "constant_from", None)


def _checked(value: Any, epoch: int) -> Fraction:
    try:
        # The comparison is false for NaN too.
        if 0 <= value <= 1:
            return Fraction(repr(float(value))).limit_denominator(_FINEST)
    except TypeError:
        pass
    raise ConfigError(
        f"ratio {value!r} in epoch {epoch}",
        "the share of synthetic samples, a number from 0 to 1",
    )
