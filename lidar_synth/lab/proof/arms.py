"""The trainings that are compared. Each is an *arm*: one or more stages, each with a mixture of its
own.

All arms have the same network, batch size, augmentation and optimiser, and the same number of
iterations, except where an arm's ``iterations`` says so. The learning rate has one cycle over all
stages, as in a trainer that knows nothing of them. To add an arm, enter it in ``ARMS``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from lidar_synth.errors import ConfigError, suggest
from lidar_synth.lab.town.returns import CALIBRATED_ON
from lidar_synth.labels.policies import LabelPolicy, Labels, make_policy
from lidar_synth.mixing.defaults import PERSONS, quarter_of
from lidar_synth.mixing.schedules import SyntheticFirst, make_schedule

REAL = "real"
"""The name of the labelled scans themselves, where a stage takes them in the place of synthetic
ones."""


@dataclass(frozen=True)
class ArmStage:
    """A part of a training with one mixture.

    Args:
        share: of the iterations.
        ratio: share of synthetic samples in each batch, 0 to 1.
        pool: of the synthetic scans: a name of ``POOLS``, or ``REAL``.
        labels: their label policy.
    """

    share: float = 1.0
    ratio: float = 0.0
    pool: str = ""
    labels: Labels = "generated"


@dataclass(frozen=True)
class Arm:
    """One of the compared trainings.

    Args:
        title: its row in tables.
        stages: from the share of synthetic samples to the stages.
        swept: whether the share matters, so that the arm is trained once for each of the given
            shares.
        iterations: factor of the number of iterations.
        synthetic: whether it uses scans that were not recorded.
        budget: what it uses besides the labelled scans.
    """

    title: str
    stages: Callable[[float], tuple[ArmStage, ...]]
    swept: bool = False
    iterations: float = 1.0
    synthetic: bool = True
    budget: str = ""

    def pools(self) -> set[str]:
        """Names of the pools whose scans it needs."""
        return {stage.pool for stage in self.stages(0.5)} - {"", REAL}


_TOWN = f"labels of the town, which cost nothing ({CALIBRATED_ON})"
GENERATOR_BUDGET = "what the generator was trained on"
_SKIN = f"{_TOWN}; scans of the training places without labels, to learn the skin"

EPOCHS = 40
"""Epochs of the training whose schedule gives the stages."""


def _stages(
    pool: str, given: Any, labels: Labels = "generated"
) -> tuple[ArmStage, ...]:
    """The stages of a training of ``EPOCHS`` epochs with a ratio as of ``mix``."""
    stages = []
    for ratio, epochs in groupby(range(EPOCHS), make_schedule(given)):
        share = len(list(epochs)) / EPOCHS
        stages.append(ArmStage(share, ratio, pool if ratio else "", labels))
    return tuple(stages)


def synthetic_first(pool: str, labels: Labels = "generated") -> tuple[ArmStage, ...]:
    """Synthetic scans first, then half, real ones at the end."""
    return _stages(pool, SyntheticFirst(EPOCHS), labels)


def _quarter(pool: str) -> tuple[ArmStage, ...]:
    """Synthetic scans for a quarter, then real ones alone."""
    return _stages(pool, quarter_of(EPOCHS))


ARMS: dict[str, Arm] = {
    "real": Arm("real scans only", lambda ratio: (ArmStage(),), synthetic=False),
    "longer": Arm(
        "real scans only, twice as long",
        lambda ratio: (ArmStage(),),
        iterations=2,
        synthetic=False,
    ),
    "exchange": Arm(
        "real scans, PolarMix and LaserMix",
        lambda ratio: (ArmStage(1, 0.5, REAL, "polarmix_or_lasermix"),),
        synthetic=False,
    ),
    "town": Arm(
        "with scans of the town",
        lambda ratio: (ArmStage(1, ratio, "town"),),
        swept=True,
        budget=_TOWN,
    ),
    "skin": Arm(
        "with scans of the town in your skin",
        lambda ratio: (ArmStage(1, ratio, "skin"),),
        swept=True,
        budget=_SKIN,
    ),
    "generator": Arm(
        "with generated scans",
        lambda ratio: (ArmStage(1, ratio, "generator"),),
        swept=True,
        budget=GENERATOR_BUDGET,
    ),
    "pretrain": Arm(
        "the town first, then half your scans",
        lambda ratio: synthetic_first("town"),
        budget=_TOWN,
    ),
    "pretrain-skin": Arm(
        "the town in your skin first, then half your scans",
        lambda ratio: synthetic_first("skin"),
        budget=_SKIN,
    ),
    "pretrain-generator": Arm(
        "generated scans first, then half your scans",
        lambda ratio: synthetic_first("generator"),
        budget=GENERATOR_BUDGET,
    ),
    "alone": Arm(
        "generated scans alone, your scans without labels",
        lambda ratio: (ArmStage(1, 1, "generator"),),
        budget=GENERATOR_BUDGET,
    ),
    "quarter": Arm(
        "generated scans for a quarter, then your scans alone",
        lambda ratio: _quarter("generator"),
        budget=GENERATOR_BUDGET,
    ),
    "quarter-town": Arm(
        "the town for a quarter, then your scans alone",
        lambda ratio: _quarter("town"),
        budget=_TOWN,
    ),
    "pretrain-learnt": Arm(
        "the scans that the generator learnt from first, then half your scans",
        lambda ratio: synthetic_first("learnt"),
        budget=GENERATOR_BUDGET,
    ),
    "persons": Arm(
        "generated scans with pedestrians of the town first, then half your scans",
        lambda ratio: synthetic_first("generator", PERSONS),
        budget=f"{GENERATOR_BUDGET}; {_TOWN}",
    ),
}
"""Arms by name."""

BASE = "real"
"""The arm with which the others are compared."""


@dataclass(frozen=True)
class Row:
    """An arm with its share of synthetic samples.

    Args:
        name: of the arm.
        ratio: the share; None where it does not matter.
    """

    name: str
    ratio: float | None = None

    @property
    def arm(self) -> Arm:
        """The arm."""
        return ARMS[self.name]

    @property
    def key(self) -> str:
        """A text that names the row, also in the names of files."""
        return self.name if self.ratio is None else f"{self.name}-{100 * self.ratio:g}"

    @property
    def title(self) -> str:
        """The row in tables."""
        return (
            self.arm.title
            if self.ratio is None
            else f"{self.arm.title}, {100 * self.ratio:g} %"
        )

    def stages(self) -> tuple[ArmStage, ...]:
        """The stages of the training."""
        return self.arm.stages(0.5 if self.ratio is None else self.ratio)


def rows(names: tuple[str, ...], ratios: tuple[float, ...]) -> list[Row]:
    """The rows of a comparison; ``BASE`` is always the first.

    Raises:
        ConfigError: on an unknown arm, or a share that is not between 0 and 1.
    """
    if unknown := [name for name in names if name not in ARMS]:
        given = f"arm {', '.join(map(repr, unknown))}"
        raise ConfigError(
            given, f"some of {', '.join(ARMS)}", suggest(unknown[0], ARMS)
        )
    if wrong := [ratio for ratio in ratios if not 0 < ratio < 1]:
        raise ConfigError(
            f"ratio {wrong[0]}",
            "shares of synthetic scans between 0 and 1, such as 0.5",
        )
    ordered = [name for name in ARMS if name in {BASE, *names}]
    return [
        Row(name, r)
        for name in ordered
        for r in (sorted(set(ratios)) if ARMS[name].swept else (None,))
    ]


def policy_of(stage: ArmStage, real: Any, fields: frozenset[str]) -> LabelPolicy:
    """The label policy of a stage.

    Args:
        stage: the stage.
        real: the labelled scans.
        fields: the fields of the synthetic scans.
    """
    return make_policy(
        stage.labels, real=real, fields=fields, **options_of(stage, real)
    )


def options_of(stage: ArmStage, real: Any) -> dict[str, Any]:
    """The options of the label policy of a stage; arguments as for ``policy_of``."""
    if stage.labels == "polarmix_or_lasermix" and real[0].instance is None:
        return {"objects": 0}  # PolarMix turns whole objects, which needs instances
    return {}
