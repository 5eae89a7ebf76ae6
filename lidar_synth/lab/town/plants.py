"""Meshes of trees, bushes and hedges: trunks and branches as tubes, foliage as many small
triangles.

Rays pass between the leaves as in a real crown: some hit outer leaves, some a branch, and some an
object behind the tree. Each prototype is sampled once per process with a fixed key; a scene
rotates, scales and tints it.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.catalogue import TABLES, Rng
from lidar_synth.lab.town.materials import Finish
from lidar_synth.lab.town.meshes import Mesh, circle, leaves, loft, merge, sphere, tube
from lidar_synth.lab.town.objects import StaticObject, make_object

LEAF = 0
BARK = 1
TWIG = 2
CORE = 3
VARIANTS = 4
"""Number of prototypes of each species."""
SPECIES = TABLES["plants"]
"""The species by name."""


def _stem(height: float, radius: float, rng: Rng) -> tuple[Mesh, Float64Array]:
    """A slightly crooked trunk that widens at its foot, and its path (5, 3)."""
    levels = np.array([-0.2, 0.12, 0.45, 0.5 * height, height])
    lean = np.cumsum(rng.normal(0, 0.05, (5, 2)), axis=0) * (levels[:, None] > 0.2)
    path = np.c_[lean, levels]
    return tube(path, radius * np.array([1.7, 1.25, 1.0, 0.9, 0.75]), 8, BARK), path


def _branches(foot: Float64Array, ends: Float64Array, radius: float) -> Mesh:
    """Branches from ``foot`` (3,) to each of ``ends`` (K, 3)."""
    radii = [radius, 0.6 * radius, 0.02]
    return merge(
        tube([foot, 0.5 * (foot + e) + (0, 0, 0.1), e], radii, 4, TWIG, caps=False)
        for e in ends
    )


def _leaf_clusters(
    centres: Float64Array,
    spread: Float64Array | float,
    count: int,
    size: float,
    rng: Rng,
) -> Mesh:
    """Clusters of leaves, ``count`` triangles around each centre."""
    middle = np.repeat(centres, count, axis=0)
    middle = middle + rng.normal(0, 1, middle.shape) * spread
    return leaves(middle, size * rng.uniform(0.6, 1.3, len(middle)), rng, LEAF)


def _blob(centre: Float64Array, radius: float, rng: Rng) -> Mesh:
    """A dense part of a crown: an uneven ball."""
    ball = radius * sphere(4, 6) * rng.normal(1, 0.2, (5, 6, 1))
    return loft(centre + ball, CORE, closed=True)


def _ellipsoid_points(
    count: int,
    width: float,
    height: float,
    middle: float,
    rng: Rng,
) -> Float64Array:
    """(count, 3) points near the surface of an ellipsoid with semi-axes ``width`` and ``height``
    whose centre is ``middle`` metres above the origin."""
    out = rng.standard_normal((count, 3))
    deep = rng.uniform(0.55, 1.0, (count, 1)) ** 0.6
    out *= deep / np.linalg.norm(out, axis=1, keepdims=True)
    points: Float64Array = out * (width, width, height) + (0, 0, middle)
    return points


def _grow_broadleaf(
    rng: Rng,
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
    crown = _ellipsoid_points(46, 0.44 * width, 0.9 * up, middle, rng)
    branches = _branches(path[-1], crown[rng.permutation(len(crown))[:6]], 0.08)
    spread = np.array([0.42, 0.42, 0.34 + droop])
    centre = (0, 0, middle)
    core = [_blob(0.82 * (c - centre) + centre, 0.17 * width, rng) for c in crown[::3]]
    foliage = _leaf_clusters(crown - (0, 0, droop), spread, 10, size, rng)
    return merge([trunk, branches, *core, foliage])


def _grow_conifer(
    rng: Rng,
    height: float,
    width: float,
    clear: float,
) -> Mesh:
    """A conifer; sizes in metres, ``clear`` is the height at which its leaves begin."""
    trunk, _ = _stem(0.8 * height, 0.02 + 0.012 * height, rng)
    level = 1 - rng.uniform(0, 1, 420) ** 0.6
    reach = width / 2 * (1 - level) * np.sqrt(rng.uniform(0.25, 1, 420)) + 0.06
    angle = rng.uniform(0, 2 * np.pi, 420)
    up = clear + (height - clear) * level - 0.25 * reach
    centres = np.c_[reach * np.cos(angle), reach * np.sin(angle), up]
    foliage = leaves(centres, (0.08 + 0.05 * width) * (1.2 - 0.5 * level), rng, LEAF)
    return merge([trunk, foliage, _inner_cone(height, clear, width)])


def _inner_cone(height: float, clear: float, width: float) -> Mesh:
    """The opaque cone inside a conifer."""
    rings = [
        np.c_[0.33 * width * share * circle(8), np.full(8, z)]
        for share, z in ((1.0, clear + 0.05 * height), (0.01, 0.95 * height))
    ]
    return loft(rings, LEAF, closed=True)


def _grow_bush(rng: Rng, height: float, width: float) -> Mesh:
    """A bush; sizes in metres."""
    crown = _ellipsoid_points(14, 0.42 * width, 0.42 * height, 0.52 * height, rng)
    twigs = _branches(np.zeros(3), crown[:3], 0.025)
    core = [_blob(c, 0.2 * width, rng) for c in 0.72 * crown[::2]]
    return merge([twigs, *core, _leaf_clusters(crown, 0.18, 11, 0.16, rng)])


_CROWNS: dict[str, Callable[..., Mesh]] = {
    "broadleaf": _grow_broadleaf,
    "conifer": _grow_conifer,
    "bush": _grow_bush,
}


@cache
def plant(species: str, variant: int) -> Mesh:
    """Prototype number ``variant`` (0 to ``VARIANTS`` - 1) of a species; slots LEAF, BARK, TWIG,
    CORE."""
    # Keyed by species and variant, so that plants never change.
    key = (sorted(SPECIES).index(species), variant)
    rng = np.random.Generator(np.random.Philox(key=key))
    row = SPECIES[species]
    sizes = [rng.uniform(*limits) for limits in row["sizes"]]
    return _CROWNS[row["crown"]](rng, *sizes, *row["more"])


@cache
def coarse_plant(species: str, variant: int) -> Mesh:
    """``plant`` with fewer triangles, to be seen from afar: a quarter of the leaves, each twice as
    wide."""
    mesh = plant(species, variant)
    leaf = mesh.slot == LEAF
    if SPECIES[species]["crown"] == "conifer":
        leaf[-16:] = False
    some = np.flatnonzero(leaf)[::4]
    middle = mesh.triangles[some].mean(1, keepdims=True)
    wide = middle + 1.9 * (mesh.triangles[some] - middle)
    rest = np.flatnonzero(~leaf & (mesh.slot != TWIG))
    return Mesh(
        np.concatenate([wide, mesh.triangles[rest]]),
        np.concatenate([mesh.slot[some], mesh.slot[rest]]),
    )


def _sample_tint(species: str, rng: Rng) -> Float64Array:
    """(3,) factors of the colour of leaves; some bushes are red."""
    tint = rng.uniform(0.8, 1.25) * rng.uniform(0.9, 1.1, 3)
    if species == "bush" and rng.random() < 0.2:
        tint = np.array((1.9, 0.6, 1.0))
    return tint


def random_plant(
    species: str,
    rng: Rng,
    size: float = 1.0,
    near: bool = True,
) -> StaticObject:
    """A tree or bush of a species with a random shape, size and tint; with fewer leaves unless it
    is ``near``."""
    mesh = (plant if near else coarse_plant)(species, int(rng.integers(VARIANTS)))
    yaw = rng.uniform(0, 2 * np.pi)
    mesh = mesh.moved(yaw=yaw, scale=size * rng.uniform(0.85, 1.15, 3))
    row = SPECIES[species]
    r, g, b = np.clip(np.array(row["leaf"]) * _sample_tint(species, rng), 0, 1)
    bark = (*row["bark"],) if "bark" in row else None
    return make_object(
        "plant", mesh, finishes={0: Finish("leaf", (r, g, b)), 1: Finish("bark", bark)}
    )


def random_hedge(
    length: float,
    height: float,
    depth: float,
    profile: str,
    rng: Rng,
) -> StaticObject:
    """A hedge or an uneven belt of shrubs along +x from the origin, with a random shade of green.

    Args:
        length, height, depth: metres.
        profile: ``clipped`` to an even profile; or ``wild``, rounded and uneven.
        rng: samples its growth.
    """
    mesh = _grow_hedge(length, height, depth, profile, rng)
    green = rng.uniform(0.8, 1.2)
    leaf = Finish("leaf", (0.18 * green, 0.31 * green, 0.10))
    inside = Finish("foliage", (0.10 * green, 0.18 * green, 0.05))
    return make_object("hedge", mesh, finishes={0: leaf, 1: inside})


def clipped_hedge(length: float, rng: Rng) -> StaticObject:
    """A clipped hedge of random height and depth along +x."""
    height = rng.uniform(0.8, 1.9)
    return random_hedge(length, height, rng.uniform(0.6, 1.1), "clipped", rng)


def _grow_hedge(
    length: float,
    height: float,
    depth: float,
    profile: str,
    rng: Rng,
) -> Mesh:
    """The opaque core of a hedge, its ends, and leaves."""
    growth = 0.05 if profile == "clipped" else 0.16
    core = _hedge_core(
        length,
        height,
        depth,
        profile,
        growth,
        rng,
    )
    ends = [loft([core[i, :4], core[i, :3:-1]], 1) for i in (0, -1)]
    count = int(length * (2 * height + depth) * 8)
    scatter = 0.04 if profile == "clipped" else 0.1
    centres = _sample_points(core, count, rng) + rng.normal(0, scatter, (count, 3))
    foliage = leaves(centres, rng.uniform(0.07, 0.15, count), rng, LEAF)
    return merge([loft(core, 1), *ends, foliage])


def _sample_points(core: Float64Array, count: int, rng: Rng) -> Float64Array:
    """(count, 3) random points on the surface through the cross-sections (S, P, 3) of a hedge."""
    steps, columns, _ = core.shape
    row = rng.integers(0, steps - 1, count)
    column = rng.integers(0, columns - 1, count)
    way = rng.random((2, count, 1))
    near, far = (
        core[i, column] * (1 - way[0]) + core[i, column + 1] * way[0]
        for i in (row, row + 1)
    )
    return np.asarray(near * (1 - way[1]) + far * way[1])


def _hedge_core(
    length: float,
    height: float,
    depth: float,
    profile: str,
    growth: float,
    rng: Rng,
) -> Float64Array:
    """(S, P, 3) the cross-sections of the core of a hedge."""
    across, up = np.array(TABLES["hedges"][profile]).T
    steps = max(3, int(length / 0.6) + 1)
    wave = np.convolve(rng.normal(0, 1.6, steps + 2), np.full(3, 1 / 3), "valid")
    size = (1 + growth * wave)[:, None]
    bumps = rng.normal(0, growth, (2, steps, len(up)))
    shifts = rng.normal(0, 0.04, (steps, len(up)))
    x = np.linspace(0, length, steps)[:, None] + shifts
    y = depth * (across + 0.5 * bumps[0]) * np.sqrt(size)
    z = height * (up + 0.5 * bumps[1] * (up > 0)) * size
    return np.stack([x, y, z], -1)


def weeds(
    length: float,
    depth: float,
    height: float,
    rng: Rng,
) -> StaticObject:
    """A strip of high grass and weeds along +x: thin upright triangles."""
    count = int(length * 26)
    along = rng.uniform(0, length, count)
    across = rng.uniform(-depth / 2, depth / 2, count)
    foot = np.c_[along, across, np.zeros(count)]
    angle = rng.uniform(0, 2 * np.pi, count)
    half = 0.06 * np.c_[np.cos(angle), np.sin(angle), np.zeros(count)]
    lean = rng.normal(0, 0.08, (count, 2))
    tip = foot + np.c_[lean, height * rng.uniform(0.4, 1.2, count)]
    triangles = np.stack([foot - half, foot + half, tip], 1).astype(np.float32)
    return make_object("weeds", Mesh(triangles, np.zeros(count, np.int32)))
