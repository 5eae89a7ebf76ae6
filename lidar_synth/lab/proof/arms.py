"""The trainings that are compared. Each is an *arm*: a mixture whose share of synthetic scans
follows a schedule, as of ``mix``.

All arms have the same network, batch size, augmentation and optimiser, and the same number of
iterations, except where an arm's ``iterations`` says so. The learning rate has one cycle over the
whole training, as in a trainer that knows nothing of the schedule. To add an arm, enter it in
``ARMS``.
"""

from dataclasses import dataclass
from itertools import groupby
from typing import Any

from lidar_synth.errors import ConfigError, choose
from lidar_synth.lab.town.returns import CALIBRATED_ON
from lidar_synth.labels.policies import LabelPolicy, Labels, make_policy
from lidar_synth.mixing.defaults import TOWN_OBJECTS, quarter_of
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


CONSTANTS = f" ({CALIBRATED_ON})"
"""Behind the labels of the town: the real scans that it owes something to."""
_TOWN = f"labels of the town, which cost nothing{CONSTANTS}"
GENERATOR_BUDGET = "what the generator was trained on"
_BUDGETS = {
    "town": _TOWN,
    "skin": f"{_TOWN}; scans of the training places without labels, to learn the skin",
    "generator": GENERATOR_BUDGET,
    "learnt": GENERATOR_BUDGET,
}
"""What the scans of a pool use besides the labelled scans."""

EPOCHS = 40
"""Epochs of the training whose schedule gives the stages."""
FIRST = SyntheticFirst(EPOCHS)
QUARTER = quarter_of(EPOCHS)


@dataclass(frozen=True)
class Arm:
    """One of the compared trainings.

    Args:
        title: its row in tables.
        pool: of the synthetic scans: a name of ``POOLS``, ``REAL``, or "" without any.
        ratio: share of synthetic samples, as ``mix`` takes it for ``EPOCHS`` epochs; None where it
            matters, so that the arm is trained once for each of the given shares.
        labels: label policy of the synthetic scans.
        iterations: factor of the number of iterations.
        extra: what it uses besides the labelled scans and its pool.
    """

    title: str
    pool: str = ""
    ratio: Any = 0.0
    labels: Labels = "generated"
    iterations: float = 1.0
    extra: str = ""

    @property
    def budget(self) -> str:
        """What it uses besides the labelled scans."""
        return "; ".join(filter(None, (_BUDGETS.get(self.pool), self.extra)))

    def pools(self) -> set[str]:
        """Names of the pools whose scans it needs."""
        return {self.pool} - {"", REAL}


ARMS: dict[str, Arm] = {
    "real": Arm("real scans only"),
    "longer": Arm("real scans only, twice as long", iterations=2),
    "exchange": Arm(
        "real scans, PolarMix and LaserMix", REAL, 0.5, "polarmix_or_lasermix"
    ),
    "town": Arm("with scans of the town", "town", None),
    "skin": Arm("with scans of the town in your skin", "skin", None),
    "generator": Arm("with generated scans", "generator", None),
    "pretrain": Arm("the town first, then half your scans", "town", FIRST),
    "pretrain-skin": Arm(
        "the town in your skin first, then half your scans", "skin", FIRST
    ),
    "pretrain-generator": Arm(
        "generated scans first, then half your scans", "generator", FIRST
    ),
    "alone": Arm("generated scans alone, your scans without labels", "generator", 1.0),
    "quarter": Arm(
        "generated scans for a quarter, then your scans alone", "generator", QUARTER
    ),
    "quarter-town": Arm(
        "the town for a quarter, then your scans alone", "town", QUARTER
    ),
    "pretrain-learnt": Arm(
        "the scans that the generator learnt from first, then half your scans",
        "learnt",
        FIRST,
    ),
    "recipe": Arm(
        "generated scans with persons and cycles of the town first, then half your scans",
        "generator",
        FIRST,
        TOWN_OBJECTS,
        extra=_TOWN,
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
        if self.ratio is None:
            return self.arm.title
        return f"{self.arm.title}, {100 * self.ratio:g} %"

    def stages(self) -> tuple[ArmStage, ...]:
        """The parts of the training, each with one mixture."""
        arm = self.arm
        schedule = make_schedule(arm.ratio if self.ratio is None else self.ratio)
        stages = []
        for ratio, epochs in groupby(range(EPOCHS), schedule):
            share = len(list(epochs)) / EPOCHS
            pool = arm.pool if ratio else ""
            stages.append(ArmStage(share, ratio, pool, arm.labels))
        return tuple(stages)


def rows(names: tuple[str, ...], ratios: tuple[float, ...]) -> list[Row]:
    """The rows of a comparison; ``BASE`` is always the first.

    Raises:
        ConfigError: on an unknown arm, no shares, or one that is not between 0 and 1.
    """
    for name in names:
        choose("arm", name, ARMS)
    if not (ratios and all(0 < ratio < 1 for ratio in ratios)):
        raise ConfigError(
            f"ratios {ratios}",
            "shares of synthetic scans between 0 and 1, such as 0.5",
        )
    return [
        Row(name, r)
        for name in ARMS
        if name in {BASE, *names}
        for r in (sorted(set(ratios)) if ARMS[name].ratio is None else (None,))
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
