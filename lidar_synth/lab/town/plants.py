"""Meshes of trees, bushes and hedges: trunks and branches as tubes, foliage as many small
triangles.

Rays pass between the leaves as in a real crown: some hit outer leaves, some a branch, and some an
object behind the tree. Each prototype is sampled once per process with a fixed key; a scene
rotates, scales and tints it.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.materials import Finish
from lidar_synth.lab.town.meshes import Mesh, leaves, loft, merge, tube

LEAF = 0
BARK = 1
TWIG = 2
CORE = 3
TREE_CLASSES = (70, 71, 70, 70)
"""SemanticKITTI's class id of each slot: leaves and branches are vegetation, the stem is trunk."""
VARIANTS = 4
"""Number of prototypes of each species."""

SPECIES: dict[str, tuple[Finish, ...]] = {
    "round": (
        Finish("leaf", (0.20, 0.36, 0.10)),
        Finish("bark"),
        Finish("bark"),
        Finish("foliage"),
    ),
    "birch": (
        Finish("leaf", (0.34, 0.46, 0.15)),
        Finish("bark", (0.72, 0.70, 0.66)),
        Finish("bark"),
        Finish("foliage"),
    ),
    "spruce": (
        Finish("leaf", (0.10, 0.21, 0.11)),
        Finish("bark"),
        Finish("bark"),
        Finish("foliage"),
    ),
    "poplar": (
        Finish("leaf", (0.24, 0.40, 0.12)),
        Finish("bark"),
        Finish("bark"),
        Finish("foliage"),
    ),
    "fruit": (
        Finish("leaf", (0.25, 0.38, 0.13)),
        Finish("bark"),
        Finish("bark"),
        Finish("foliage"),
    ),
    "bush": (
        Finish("leaf", (0.22, 0.35, 0.11)),
        Finish("bark"),
        Finish("bark"),
        Finish("foliage"),
    ),
    "thuja": (
        Finish("leaf", (0.16, 0.29, 0.12)),
        Finish("bark"),
        Finish("bark"),
        Finish("foliage"),
    ),
}
"""The finishes of each species; the colour of the first one varies per plant."""


def _rng(name: str, variant: int) -> np.random.Generator:
    """The random generator of a prototype; keyed by its species and variant, so that plants never
    change."""
    return np.random.Generator(
        np.random.Philox(key=(sorted(SPECIES).index(name), variant))
    )


def _stem(
    height: float, radius: float, rng: np.random.Generator
) -> tuple[Mesh, NDArray[np.float64]]:
    """A slightly crooked trunk that widens at its foot, and its path (5, 3)."""
    levels = np.array([-0.2, 0.12, 0.45, 0.5 * height, height])
    lean = np.cumsum(rng.normal(0, 0.05, (5, 2)), axis=0) * (levels[:, None] > 0.2)
    path = np.c_[lean, levels]
    return tube(path, radius * np.array([1.7, 1.25, 1.0, 0.9, 0.75]), 8, BARK), path


def _branches(
    foot: NDArray[np.float64], ends: NDArray[np.float64], radius: float
) -> Mesh:
    """Branches from ``foot`` (3,) to each of ``ends`` (K, 3)."""
    return merge(
        tube(
            [foot, 0.5 * (foot + e) + (0, 0, 0.1), e],
            [radius, 0.6 * radius, 0.02],
            4,
            TWIG,
            caps=False,
        )
        for e in ends
    )


def _leaf_clusters(
    centres: NDArray[np.float64],
    spread: NDArray[np.float64] | float,
    count: int,
    size: float,
    rng: np.random.Generator,
) -> Mesh:
    """Clusters of leaves, ``count`` triangles around each centre."""
    middle = (
        np.repeat(centres, count, axis=0)
        + rng.normal(0, 1, (count * len(centres), 3)) * spread
    )
    return leaves(middle, size * rng.uniform(0.6, 1.3, len(middle)), rng, LEAF)


def _blob(centre: NDArray[np.float64], radius: float, rng: np.random.Generator) -> Mesh:
    """A dense part of a crown: an uneven ball."""
    polar = np.linspace(0, np.pi, 5)[:, None]
    angle = 2 * np.pi * np.arange(6) / 6
    unit = np.stack(
        [
            np.sin(polar) * np.cos(angle),
            np.sin(polar) * np.sin(angle),
            np.cos(polar) + 0 * angle,
        ],
        -1,
    )
    return loft(
        centre + radius * unit * rng.normal(1, 0.2, (5, 6, 1)), CORE, closed=True
    )


def _ellipsoid_points(
    count: int,
    radii: tuple[float, float, float],
    middle: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """(count, 3) points near the surface of an ellipsoid whose centre is ``middle`` metres above
    the origin."""
    out = rng.standard_normal((count, 3))
    out *= rng.uniform(0.55, 1.0, (count, 1)) ** 0.6 / np.linalg.norm(
        out, axis=1, keepdims=True
    )
    points: NDArray[np.float64] = out * radii + (0, 0, middle)
    return points


def _broadleaf(
    rng: np.random.Generator,
    height: float,
    clear: float,
    width: float,
    size: float,
    droop: float,
) -> Mesh:
    """A broadleaf tree; sizes in metres, ``clear`` is the height of the trunk below the crown."""
    trunk, path = _stem(clear, rng.uniform(0.13, 0.24), rng)
    middle = (height + clear) / 2
    up = (height - clear) / 2 + 0.3
    crown = _ellipsoid_points(46, (0.44 * width, 0.44 * width, 0.9 * up), middle, rng)
    branches = _branches(path[-1], crown[rng.permutation(len(crown))[:6]], 0.08)
    spread = np.array([0.42, 0.42, 0.34 + droop])
    core = [
        _blob(0.82 * (c - (0, 0, middle)) + (0, 0, middle), 0.17 * width, rng)
        for c in crown[::3]
    ]
    return merge(
        [
            trunk,
            branches,
            *core,
            _leaf_clusters(crown - (0, 0, droop), spread, 10, size, rng),
        ]
    )


def _conifer(
    rng: np.random.Generator, height: float, clear: float, width: float
) -> Mesh:
    """A conifer; sizes in metres, ``clear`` is the height at which its leaves begin."""
    trunk, _ = _stem(0.8 * height, 0.02 + 0.012 * height, rng)
    level = 1 - rng.uniform(0, 1, 420) ** 0.6
    reach = width / 2 * (1 - level) * np.sqrt(rng.uniform(0.25, 1, 420)) + 0.06
    angle = rng.uniform(0, 2 * np.pi, 420)
    centres = np.c_[
        reach * np.cos(angle),
        reach * np.sin(angle),
        clear + (height - clear) * level - 0.25 * reach,
    ]
    return merge(
        [
            trunk,
            leaves(centres, (0.08 + 0.05 * width) * (1.2 - 0.5 * level), rng, LEAF),
            _inner_cone(height, clear, width),
        ]
    )


def _inner_cone(height: float, clear: float, width: float) -> Mesh:
    """The opaque cone inside a conifer."""
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    rings = [
        np.c_[
            0.33 * width * f * np.cos(angle),
            0.33 * width * f * np.sin(angle),
            np.full(8, z),
        ]
        for f, z in ((1.0, clear + 0.05 * height), (0.01, 0.95 * height))
    ]
    return loft(rings, LEAF, closed=True)


def _bush(rng: np.random.Generator, height: float, width: float) -> Mesh:
    """A bush; sizes in metres."""
    crown = _ellipsoid_points(
        14, (0.42 * width, 0.42 * width, 0.42 * height), 0.52 * height, rng
    )
    twigs = _branches(np.zeros(3), crown[:3], 0.025)
    core = [_blob(c, 0.2 * width, rng) for c in 0.72 * crown[::2]]
    return merge([twigs, *core, _leaf_clusters(crown, 0.18, 11, 0.16, rng)])


@cache
def coarse_plant(species: str, variant: int) -> Mesh:
    """``plant`` with fewer triangles, to be seen from afar: a quarter of the leaves, each twice as
    wide."""
    mesh = plant(species, variant)
    leaf = mesh.slot == LEAF
    if species in ("spruce", "thuja"):
        leaf[-16:] = False
    some = np.flatnonzero(leaf)[::4]
    middle = mesh.triangles[some].mean(1, keepdims=True)
    wide = middle + 1.9 * (mesh.triangles[some] - middle)
    rest = np.flatnonzero(~leaf & (mesh.slot != TWIG))
    return Mesh(
        np.concatenate([wide, mesh.triangles[rest]]),
        np.concatenate([mesh.slot[some], mesh.slot[rest]]),
    )


@cache
def plant(species: str, variant: int) -> Mesh:
    """Prototype number ``variant`` (0 to ``VARIANTS`` - 1) of a species; slots LEAF, BARK, TWIG,
    CORE."""
    rng = _rng(species, variant)
    match species:
        case "round":
            return _broadleaf(
                rng,
                rng.uniform(7, 11),
                rng.uniform(2.0, 2.8),
                rng.uniform(5, 7.5),
                0.38,
                0.0,
            )
        case "birch":
            return _broadleaf(
                rng,
                rng.uniform(9, 13),
                rng.uniform(1.8, 2.6),
                rng.uniform(4, 5.5),
                0.28,
                0.35,
            )
        case "poplar":
            return _broadleaf(
                rng,
                rng.uniform(10, 14),
                rng.uniform(1.6, 2.2),
                rng.uniform(3.2, 4.2),
                0.32,
                0.0,
            )
        case "fruit":
            return _broadleaf(
                rng,
                rng.uniform(3.6, 5.0),
                rng.uniform(1.1, 1.6),
                rng.uniform(2.8, 4.0),
                0.22,
                0.0,
            )
        case "spruce":
            return _conifer(rng, rng.uniform(8, 14), 0.5, rng.uniform(3.6, 5.5))
        case "thuja":
            return _conifer(rng, rng.uniform(2.2, 4.5), 0.05, rng.uniform(0.9, 1.5))
    return _bush(rng, rng.uniform(1.2, 2.8), rng.uniform(1.4, 2.8))


_CLIPPED = (
    (-0.5, -0.05),
    (-0.5, 0.4),
    (-0.46, 0.8),
    (-0.3, 1.0),
    (0.3, 1.0),
    (0.46, 0.8),
    (0.5, 0.4),
    (0.5, -0.05),
)
_WILD = (
    (-0.5, -0.05),
    (-0.44, 0.3),
    (-0.3, 0.66),
    (-0.1, 0.95),
    (0.12, 1.0),
    (0.3, 0.75),
    (0.44, 0.35),
    (0.5, -0.05),
)


def hedge(
    length: float, height: float, depth: float, clipped: bool, rng: np.random.Generator
) -> Mesh:
    """A hedge along +x from the origin, centred on the x axis; slot 0 = leaves, slot 1 = opaque
    core.

    Args:
        length, height, depth: metres.
        clipped: whether it is trimmed to an even profile; if not, it is rounded and grows unevenly.
        rng: samples its growth.
    """
    profile = np.array(_CLIPPED if clipped else _WILD)
    growth = 0.05 if clipped else 0.16
    steps = max(3, int(length / 0.6) + 1)
    size = (
        1
        + growth
        * np.convolve(rng.normal(0, 1.6, steps + 2), np.full(3, 1 / 3), "valid")[
            :, None
        ]
    )
    bumps = rng.normal(0, growth, (2, steps, len(profile)))
    x = np.linspace(0, length, steps)[:, None] + rng.normal(
        0, 0.04, (steps, len(profile))
    )
    y = depth * (profile[:, 0] + 0.5 * bumps[0]) * np.sqrt(size)
    z = height * (profile[:, 1] + 0.5 * bumps[1] * (profile[:, 1] > 0)) * size
    core = np.stack([x, y, z], -1)
    ends = [loft([core[i, :4], core[i, :3:-1]], 1) for i in (0, -1)]
    count = int(length * (2 * height + depth) * 8)
    row = rng.integers(0, steps - 1, count)
    column = rng.integers(0, len(profile) - 1, count)
    way = rng.random((2, count, 1))
    near = core[row, column] * (1 - way[0]) + core[row, column + 1] * way[0]
    far = core[row + 1, column] * (1 - way[0]) + core[row + 1, column + 1] * way[0]
    centres = (
        near * (1 - way[1])
        + far * way[1]
        + rng.normal(0, 0.04 if clipped else 0.1, (count, 3))
    )
    return merge(
        [
            loft(core, 1),
            *ends,
            leaves(centres, rng.uniform(0.07, 0.15, count), rng, LEAF),
        ]
    )


def tufts(
    length: float,
    depth: float,
    height: float,
    per_metre: float,
    rng: np.random.Generator,
) -> Mesh:
    """High grass and weeds along +x: thin upright triangles."""
    count = int(length * per_metre)
    foot = np.c_[
        rng.uniform(0, length, count),
        rng.uniform(-depth / 2, depth / 2, count),
        np.zeros(count),
    ]
    angle = rng.uniform(0, 2 * np.pi, count)
    half = 0.06 * np.c_[np.cos(angle), np.sin(angle), np.zeros(count)]
    tip = (
        foot
        + np.c_[rng.normal(0, 0.08, (count, 2)), height * rng.uniform(0.4, 1.2, count)]
    )
    triangles = np.stack([foot - half, foot + half, tip], 1).astype(np.float32)
    return Mesh(triangles, np.full(count, LEAF, np.int32))
