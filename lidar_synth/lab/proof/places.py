"""The places of a labelled dataset: groups of scans that show nothing of each other.

A network that is tested on a street on which it was trained looks better than it is, and
neighbouring frames show one street. Scans of one place are therefore all trained on or all tested
on.
"""

import logging
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry import Source
from lidar_synth.labels.edit.unboxed import join_cubes

log = logging.getLogger(__name__)

APART = 50.0
"""Metres: scans nearer than this are of one place; a sensor sees about as far."""
STRETCHES = 3
LEFT_OUT = 0.25
"""Share of the scans of a drive that are left out between its stretches."""
MOST_POSES = 2000
AFTER_LOG = "__LIDAR_TOP__"
"""Follows the log, which is a drive, in nuScenes' names of sweeps."""

_SHUFFLED = "KITTI's frames are shuffled: put mapping/ of the devkit beside training/."

Places = dict[str, list[int]]
"""{name of the place: indices of its scans in the source}."""


def by_drive(source: Source, names: Sequence[str]) -> Places:
    """A place for each drive (sequence): the source's ``drives``, or what the names of scans have
    before the frame."""
    names = [name.replace(AFTER_LOG, "/") for name in names]
    folders = [name.rpartition("/")[0] or "all scans" for name in names]
    places: Places = {}
    for index, drive in enumerate(getattr(source, "drives", None) or folders):
        places.setdefault(drive, []).append(index)
    return places


def by_pose(source: Source, names: Sequence[str]) -> Places:
    """A place for each cluster of poses; different clusters are at least ``APART`` metres from each
    other.

    Drives are kept apart, because many datasets give the poses of each drive from its own start.

    Raises:
        DataError: on a scan without a pose.
    """
    places: Places = {}
    for drive, indices in by_drive(source, names).items():
        # Neighbouring frames are metres apart: some of them show where the drive went.
        step = max(1, len(names) // MOST_POSES)
        positions = np.array([_position(source, i) for i in indices[::step]])
        cluster = np.repeat(join_cubes(positions * (1, 1, 0), APART), step)
        for index, number in zip(indices, cluster, strict=False):
            places.setdefault(f"{drive}, place {number + 1}", []).append(index)
    return places


def by_stretch(source: Source, names: Sequence[str], count: int = STRETCHES) -> Places:
    """Equal stretches of each drive in the order of its frames; a share of ``LEFT_OUT`` between
    them is left out. Warns of KITTI's object set, whose frames are shuffled."""
    if is_shuffled(source):
        log.warning(
            f"stretches show each other's streets, so that a comparison is too good. {_SHUFFLED}"
        )
    places: Places = {}
    for drive, indices in by_drive(source, names).items():
        gap = LEFT_OUT * len(indices) / (count - 1)
        length = (1 - LEFT_OUT) * len(indices) / count
        for number in range(count):
            first = number * (length + gap)
            if chosen := indices[round(first) : round(first + length)]:
                places[f"{drive}, stretch {number + 1}"] = chosen
    return places


SPLITS: dict[str, Callable[[Source, Sequence[str]], Places]] = {
    "drive": by_drive,
    "pose": by_pose,
    "stretch": by_stretch,
}
"""Ways to find places, by name."""


def find_places(
    source: Source, by: str = "auto", fewest: int = 2, labelled: bool = False
) -> Places:
    """The places of a source.

    Args:
        source: scans; their names are its ``ids`` or those of the scans.
        by: a name of ``SPLITS``; ``"auto"`` takes drives if there are at least two, and otherwise
            clusters of poses. ``"stretch:2"`` is the split with two stretches.
        fewest: places that are needed.
        labelled: leave out the places whose first scan has no labels, with a warning: test
            sequences have none. Where no place has any, all are kept.

    Raises:
        ConfigError: on an unknown split.
        DataError: on fewer places.
    """
    by, mark, count = by.partition(":")
    counted = by == "stretch" and count.isdigit() and int(count) > 1
    if (by != "auto" and by not in SPLITS) or (count and not counted):
        raise ConfigError(
            f"places by {by + mark + count!r}",
            f"one of auto, {', '.join(SPLITS)}, or stretch:2",
        )
    names = names_of(source)
    if by == "auto":
        by = (
            "drive"
            if len(by_drive(source, names)) > 1 or not _has_pose(source)
            else "pose"
        )
    places = (
        by_stretch(source, names, int(count)) if count else SPLITS[by](source, names)
    )
    if labelled:
        places = _with_labels(source, places)
    if len(places) < fewest:
        alone = f"one place ({', '.join(places)})"
        raise DataError(
            f"{len(source)} scans of {alone if places else 'drives too short to cut'}",
            "scans of at least two places, better of five or more: networks are tested on places "
            "that they have not seen",
            _SHUFFLED
            if is_shuffled(source)
            else "Add drives, sequences or scans. If a single drive is all there is, split it: "
            "--places stretch (places='stretch').",
        )
    return dict(sorted(places.items()))


def refuse_skipping(source: Source) -> None:
    """Refuse to compare with ``on_bad="skip"``: in the place of a scan that cannot be read would
    stand the next one, which may be of another place.

    Raises:
        ConfigError: on a source that skips.
    """
    if getattr(source, "on_bad", "") == "skip":
        raise ConfigError(
            "a comparison with on_bad='skip'",
            "scans that can all be read",
            "First type lidar-synth convert IN OUT --to FORMAT --on-bad skip.",
        )


def _with_labels(source: Source, places: Places) -> Places:
    kept = {n: p for n, p in places.items() if source[p[0]].label is not None}
    if 0 < len(kept) < len(places):
        without = sorted(places.keys() - kept)
        log.warning("left out, without labels: %s", ", ".join(without))
    return kept or places


def is_shuffled(source: Source) -> bool:
    """Whether neither the names of scans nor their order tell drives apart."""
    return getattr(source, "drives", ()) is None


def names_of(source: Source) -> list[str]:
    """The names of the scans of a source."""
    names = getattr(source, "ids", None)
    return [source[i].id for i in range(len(source))] if names is None else list(names)


def _has_pose(source: Source) -> bool:
    return source[0].pose is not None


def _position(source: Source, index: int) -> NDArray[np.float64]:
    scan = source[index]
    if scan.pose is None:
        raise DataError(
            f"scan {scan.id!r} without a pose",
            "poses, to find places by",
            "Use --places drive or --places stretch.",
        )
    return scan.pose[:3, 3]


def choose(places: Places, count: int | None, rng: np.random.Generator) -> list[int]:
    """The labelled scans to train on: at random, from as many places as possible.

    Args:
        places: those that are not tested on.
        count: number of scans; None for all.
        rng: source of the random numbers.

    Raises:
        ConfigError: on more scans than there are.
    """
    piles = [rng.permutation(indices).tolist() for indices in places.values()]
    there = sum(map(len, piles))
    if count is None:
        return sorted(i for pile in piles for i in pile)
    if not 1 <= count <= there:
        raise ConfigError(
            f"{count} labelled scans",
            f"1 to {there}, the scans of the places that are not tested",
        )
    order = [piles[i] for i in rng.permutation(len(piles))]
    dealt = [
        pile[n] for n in range(max(map(len, order))) for pile in order if n < len(pile)
    ]
    return sorted(dealt[:count])
