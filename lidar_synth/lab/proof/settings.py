"""What a comparison is asked to do."""

from dataclasses import dataclass

from lidar_synth.errors import check_count
from lidar_synth.lab.proof.arms import rows

MOST_LABELLED = 200
"""Labelled scans that are trained on if no number is given."""


@dataclass(frozen=True)
class ProofSettings:
    """The settings of ``prove``.

    Args:
        labelled: number of labelled scans that each training gets; by default all of the training
            places, at most ``MOST_LABELLED``.
        arms: names of ``ARMS``; "real" is always among them.
        ratios: shares of synthetic scans, for the arms in which they matter.
        iterations: of each training.
        batch: samples of an iteration.
        seeds: repetitions of each training, with other weights, order and labelled scans.
        places: how places are found: "auto" or a name of ``SPLITS``.
        tested: largest number of scans of a place that are tested on, evenly spread.
        synthetic: scans of a pool.
        model: of the arms with a generator: a name or a path.
        columns: of the grid that the reference network sees; None keeps scans as they are, for your
            own trainer.
        widths: channels of the reference network by level, two or more.
        classes: how classes are pooled: a name of ``GROUPS``; "auto" takes that of the dataset's
            layout.
        beams: number of the sensor's beams, evenly spaced, that all scans keep, to compare on a
            coarser sensor; all by default.
        only: names of the classes that the mean IoU is over; all that occur by default.
        seed: of the choice of labelled scans and of the order of places.

    Raises:
        ConfigError: on values with which nothing can be trained, such as an unknown arm.

    Example:
        >>> from lidar_synth import ProofSettings
        >>> arms = ("exchange", "skin", "pretrain")
        >>> settings = ProofSettings(labelled=24, arms=arms, ratios=(0.25, 0.5))
        >>> settings.iterations, settings.seeds
        (1000, 2)
    """

    labelled: int | None = None
    arms: tuple[str, ...] = ("exchange", "recipe", "quarter")
    ratios: tuple[float, ...] = (0.5,)
    iterations: int = 1000
    batch: int = 4
    seeds: int = 2
    places: str = "auto"
    tested: int = 20
    synthetic: int = 150
    model: str = "town"
    columns: int | None = 512
    widths: tuple[int, ...] = (16, 32, 64, 96)
    classes: str = "auto"
    only: tuple[str, ...] = ()
    seed: int = 0
    beams: int | None = None

    def __post_init__(self) -> None:
        for name in ("batch", "seeds", "tested", "synthetic"):
            check_count(name, getattr(self, name), 1)
        check_count("iterations", self.iterations, 10)
        check_count("number of widths", len(self.widths), 2)
        for width in self.widths:
            check_count("width", width, 1)
        check_count("seed", self.seed, 0)
        rows(self.arms, self.ratios)
        if self.labelled is not None:
            check_count("labelled", self.labelled, 1)
