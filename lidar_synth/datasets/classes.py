"""Semantic classes: SemanticKITTI's 19 training classes, and the mappings of other datasets to
them.

Inside the package a label is a train id 0..18 as uint8, or ``IGNORE`` (255) for unlabelled points.
The sources are http://www.semantic-kitti.org/dataset.html (``semantic-kitti.yaml``),
https://www.cvlibs.net/datasets/kitti-360/documentation.php,
https://www.nuscenes.org/nuscenes#lidarseg, PandaSet's ``classes.json``, Waymo's
``segmentation.proto`` and http://www.poss.pku.edu.cn/semanticposs.html.
"""

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError

IGNORE = 255

NAMES = (
    "car",
    "bicycle",
    "motorcycle",
    "truck",
    "other-vehicle",
    "person",
    "bicyclist",
    "motorcyclist",
    "road",
    "parking",
    "sidewalk",
    "other-ground",
    "building",
    "fence",
    "vegetation",
    "trunk",
    "terrain",
    "pole",
    "traffic-sign",
)
"""Class names; the position is the train id."""

TRAIN_ID = {name: i for i, name in enumerate(NAMES)}
"""Train id by class name."""

GROUND = np.isin(
    np.arange(256),
    [TRAIN_ID[n] for n in ("road", "parking", "sidewalk", "other-ground", "terrain")],
)
"""(256,) whether a label, uint8, is of the ground."""


def check_labels(labels: NDArray[Any], where: str, hint: str = "") -> None:
    """Refuse labels that are not train ids, with ``where`` before the message.

    Raises:
        DataError: on one.
    """
    known = (labels >= 0) & (labels < len(NAMES)) | (labels == IGNORE)
    if not known.all():
        raise DataError(
            f"{where}: labels {np.unique(labels[~known])[:8].tolist()}",
            "train ids 0..18, or 255 = ignore",
            hint,
        )


def has_ground(label: NDArray[np.uint8] | None) -> TypeGuard[NDArray[np.uint8]]:
    """Whether any of the labels (N,) is of the ground; those of objects that were pasted into an
    unlabelled scan do not tell where its ground is."""
    return label is not None and bool(GROUND[label].any())


BOXED = tuple(
    TRAIN_ID[name]
    for name in ("car", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist")
)
"""Train ids of the classes whose objects always have boxes; parked cycles may have none."""

LABELS = {
    "Car": TRAIN_ID["car"],
    "Van": TRAIN_ID["car"],
    "Truck": TRAIN_ID["truck"],
    "Tram": TRAIN_ID["other-vehicle"],
    "Pedestrian": TRAIN_ID["person"],
    "Person_sitting": TRAIN_ID["person"],
    "Cyclist": TRAIN_ID["bicyclist"],
    "Motorcyclist": TRAIN_ID["motorcyclist"],
    "Bicycle": TRAIN_ID["bicycle"],
    "Motorcycle": TRAIN_ID["motorcycle"],
}
"""Train id of the points in a box, by the class of the box; those of KITTI's ``Misc`` are
unknown."""


@dataclass(frozen=True)
class Taxonomy:
    """The mapping between one dataset's class ids and the train ids.

    Args:
        name: of the dataset.
        to_train: {class id: train id or ``IGNORE``}, for every class id that the dataset defines.
        from_train: the class id to write for each train id; ``None`` if the package does not write
            this dataset's format.

    Raises:
        ConfigError: on ids that are no whole numbers from 0 to 65535, other train ids, or not 19 of
            ``from_train``.

    Example:
        >>> import numpy as np
        >>> from lidar_synth.datasets.classes import SEMANTIC_KITTI
        >>> train = SEMANTIC_KITTI.decode(np.array([10, 252, 40, 0]))  # car, moving car, road, none
        >>> train
        array([  0,   0,   8, 255], dtype=uint8)
        >>> SEMANTIC_KITTI.encode(train)
        array([10, 10, 40,  0], dtype=uint32)
    """

    name: str
    to_train: Mapping[int, int]
    from_train: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        written = self.from_train or (0,) * len(NAMES)
        train = (*range(len(NAMES)), IGNORE)
        wrong = _others((*self.to_train, *written), range(1 << 16))
        wrong += _others(self.to_train.values(), train)
        if wrong or len(written) != len(NAMES):
            raise ConfigError(
                f"classes {self.name!r} with {wrong[:8] or f'{len(written)} ids to write'}",
                f"ids 0 to 65535, train ids 0 to {len(NAMES) - 1} or {IGNORE}, and none or "
                f"{len(NAMES)} ids to write",
            )

    @cached_property
    def _table(self) -> NDArray[np.int16]:
        table = np.full(1 << 16, -1, np.int16)
        table[list(self.to_train)] = list(self.to_train.values())
        return table

    def decode(
        self, ids: NDArray[np.integer], where: str = "the labels"
    ) -> NDArray[np.uint8]:
        """Map the dataset's class ids to train ids.

        Args:
            ids: any shape, class ids of the dataset (for SemanticKITTI, the lower 16 bits of the
                file's values).
            where: the name of the labels in an error message, usually their path.

        Returns:
            The same shape as uint8: 0..18 or ``IGNORE``.

        Raises:
            DataError: on an id that the dataset does not define.
        """
        ids = np.asarray(ids)
        if ids.dtype != np.uint16:
            inside = (ids >= 0) & (ids < len(self._table))
            train = np.where(
                inside, self._table[np.where(inside, ids, 0)], np.int16(-1)
            )
        else:
            train = self._table[ids]
        unknown = train < 0
        if unknown.any():
            raise DataError(
                f"{where}: unknown class ids {np.unique(ids[unknown])[:8].tolist()}",
                f"class ids of {self.name}",
                "Check that the labels belong to this dataset, or map them before reading.",
            )
        return train.astype(np.uint8)

    def encode(self, train: NDArray[np.uint8]) -> NDArray[np.uint32]:
        """Map train ids to the dataset's (static) class ids, and ``IGNORE`` to 0.

        This is the inverse of ``decode``, except that classes with the same train id become one.

        Raises:
            DataError: on a train id that is neither 0..18 nor ``IGNORE``, or if ``from_train`` is
                None.
        """
        if self.from_train is None:
            raise DataError(
                f"no table from train ids to {self.name}",
                f"one of {', '.join(FILE_CLASSES)}",
            )
        table = np.zeros(256, np.uint32)
        table[: len(NAMES)] = self.from_train
        bad = (train < 0) | (train >= len(NAMES)) & (train != IGNORE)
        if bad.any():
            raise DataError(
                f"train ids {np.unique(train[bad])[:8].tolist()}",
                "0..18, or 255 = ignore",
            )
        return table[train]


def _others(values: Iterable[Any], allowed: Container[int]) -> list[Any]:
    """The values that are none of some whole numbers."""
    return [
        value
        for value in values
        if isinstance(value, bool)
        or not isinstance(value, Integral)
        or int(value) not in allowed
    ]


def _by_name(
    table: Mapping[str, tuple[int, ...]], known: Iterable[int]
) -> dict[int, int]:
    """{id: train id} from {class name: ids}; ids of ``known`` that no class contains are
    ignored."""
    ids = dict.fromkeys(known, IGNORE)
    return ids | {i: TRAIN_ID[name] for name, group in table.items() for i in group}


SEMANTIC_KITTI = Taxonomy(
    "SemanticKITTI",
    dict.fromkeys((0, 1, 52, 99), IGNORE)
    | _by_name(
        {
            "car": (10, 252),
            "bicycle": (11,),
            "motorcycle": (15,),
            "truck": (18, 258),
            "other-vehicle": (13, 16, 20, 256, 257, 259),
            "person": (30, 254),
            "bicyclist": (31, 253),
            "motorcyclist": (32, 255),
            "road": (40, 60),
            "parking": (44,),
            "sidewalk": (48,),
            "other-ground": (49,),
            "building": (50,),
            "fence": (51,),
            "vegetation": (70,),
            "trunk": (71,),
            "terrain": (72,),
            "pole": (80,),
            "traffic-sign": (81,),
        },
        range(0),
    ),
    (10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81),
)
"""SemanticKITTI's ids: ``learning_map`` of semantic-kitti.yaml and its inverse to the static
classes."""

MOVING = 252
"""First of SemanticKITTI's ids of moving objects."""

MAX_INSTANCES = 1000
"""An instance of KITTI-360 is id * 1000 + n, as in the dataset's label images and tools."""

KITTI360 = Taxonomy(
    "KITTI-360",
    _by_name(
        {
            "car": (26,),
            "bicycle": (33,),
            "motorcycle": (32,),
            "truck": (27,),
            "other-vehicle": (28, 29, 30, 31, 43),
            "person": (24,),
            "bicyclist": (25,),
            "road": (7,),
            "parking": (9,),
            "sidewalk": (8,),
            "other-ground": (6, 10),
            "building": (11, 34),
            "fence": (12, 13, 14, 35),
            "vegetation": (21,),
            "terrain": (22,),
            "pole": (17, 18, 37, 38),
            "traffic-sign": (20,),
        },
        range(45),
    ),
    (26, 33, 32, 27, 43, 24, 25, 25, 7, 9, 8, 6, 11, 13, 21, 21, 22, 17, 20),
)
"""KITTI-360's semantic ids. Lossy: its riders have no vehicle (all become bicyclists), walls and
guard rails become fence as in SemanticKITTI, and vegetation holds the trunks."""

NUSCENES = Taxonomy(
    "nuScenes-lidarseg",
    _by_name(
        {
            "car": (17, 20),
            "bicycle": (14,),
            "motorcycle": (21,),
            "truck": (23,),
            "other-vehicle": (15, 16, 18, 19, 22),
            "person": (2, 3, 4, 5, 6),
            "road": (24,),
            "sidewalk": (26,),
            "other-ground": (25,),
            "building": (28,),
            "fence": (9,),
            "vegetation": (30,),
            "terrain": (27,),
        },
        range(32),
    ),
)
"""nuScenes-lidarseg's 32 ids. Lossy: ``static.manmade`` is building, poles and signs alike; a
motorcycle or bicycle holds its rider; barriers become fence."""

PANDASET = Taxonomy(
    "PandaSet",
    _by_name(
        {
            "car": (13,),
            "bicycle": (26,),
            "motorcycle": (18, 25),
            "truck": (14, 15, 16),
            "other-vehicle": (17, 19, 20, 21, 22, 23, 27, 28, 29),
            "person": (30, 31),
            "road": (7, 8, 9, 10),
            "sidewalk": (11, 12),
            "building": (41,),
            "fence": (35, 39),
            "vegetation": (5,),
            "terrain": (6,),
            "traffic-sign": (36, 38),
        },
        range(43),
    ),
)
"""PandaSet's 42 classes, 0 = none. Lossy: a bicycle or motorcycle holds its rider, and vegetation
the trunks; markings are road, driveways are sidewalk and pickups are trucks as in SemanticKITTI;
barriers become fence. Ignored: smoke, exhaust, spray and reflections (1 to 4), personal mobility
devices (24), animals (32, 33), pylons and cones (34, 37), rolling containers (40) and *other static
object* (42), which holds poles, walls and fences alike."""

NUSCENES_16 = Taxonomy(
    "nuScenes-lidarseg's 16 classes",
    _by_name(
        {
            "car": (4,),
            "bicycle": (2,),
            "motorcycle": (6,),
            "truck": (10,),
            "other-vehicle": (3, 5, 9),
            "person": (7,),
            "road": (11,),
            "sidewalk": (13,),
            "other-ground": (12,),
            "building": (15,),
            "fence": (1,),
            "vegetation": (16,),
            "terrain": (14,),
        },
        range(17),
    ),
    (4, 2, 6, 10, 0, 7, 2, 6, 11, 11, 13, 12, 15, 15, 16, 16, 14, 15, 15),
)
"""The challenge's 16 classes, 0 = ignored. Lossy, as ``NUSCENES``; other vehicles (buses, trailers
and construction vehicles there) are not written, and fences, poles and signs are written as
manmade."""

WAYMO = Taxonomy(
    "Waymo Open's 22 classes",
    _by_name(
        {
            "car": (1,),
            "bicycle": (12,),
            "motorcycle": (13,),
            "truck": (2,),
            "other-vehicle": (3, 4),
            "person": (7,),
            "bicyclist": (6,),
            "motorcyclist": (5,),
            "road": (18, 19),
            "sidewalk": (17, 22),
            "other-ground": (20,),
            "building": (14,),
            "vegetation": (15,),
            "trunk": (16,),
            "terrain": (21,),
            "pole": (10,),
            "traffic-sign": (8,),
        },
        range(23),
    ),
    (1, 12, 13, 2, 4, 7, 6, 5, 18, 18, 22, 0, 14, 0, 15, 16, 21, 10, 8),
)
"""Waymo's 3D segmentation, 0 = undefined. Lossy: curbs are sidewalk, lane markers are road, and
*walkable* is terrain; fences and other ground are not written."""

SEMANTIC_POSS = Taxonomy(
    "SemanticPOSS",
    _by_name(
        {
            "car": (7,),
            "bicycle": (21,),
            "person": (4, 5),
            "bicyclist": (6,),
            "road": (22,),
            "building": (15,),
            "fence": (17,),
            "vegetation": (9,),
            "trunk": (8,),
            "pole": (13,),
            "traffic-sign": (10, 11, 12),
        },
        (0, 1, *range(4, 23)),
    ),
    (7, 21, 21, 0, 0, 4, 6, 6, 22, 22, 22, 22, 15, 17, 9, 8, 22, 13, 10),
)
"""SemanticPOSS' file ids. Lossy: all ground is one class (read as road), as are riders and as are
bikes; trucks and other vehicles are not written."""

FILE_CLASSES = {
    "semantic_kitti": SEMANTIC_KITTI,
    "kitti360": KITTI360,
    "nuscenes": NUSCENES_16,
    "waymo": WAYMO,
    "semantic_poss": SEMANTIC_POSS,
}
"""Tables by the name of the key ``classes`` in a mixture's settings."""
