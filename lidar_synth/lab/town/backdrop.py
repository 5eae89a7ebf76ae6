"""The background: houses where a street ends, along side streets, and in rows behind the lots."""

from functools import cache

import numpy as np

from lidar_synth.lab.town import fences, furniture
from lidar_synth.lab.town.boundaries import put_boundary, sample_kind
from lidar_synth.lab.town.buildings import make_building
from lidar_synth.lab.town.facades import BuildingPlan, finishes
from lidar_synth.lab.town.furniture import StaticObject
from lidar_synth.lab.town.lots import sample_house
from lidar_synth.lab.town.meshes import Mesh
from lidar_synth.lab.town.paving import PLAZA_DEPTH
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import LEFT, REACH, RIGHT, Street
from lidar_synth.lab.town.yards import HOUSE

Rng = np.random.Generator


def close_ends(street: Street, scene: Scene, rng: Rng) -> None:
    """Put houses and hedges where the street ends at another one."""
    for end, direction in zip(street.ends, (-1, 1), strict=True):
        if not np.isfinite(end):
            continue
        t = -40.0
        while t < 40:
            width = rng.uniform(9, 16)
            plan = sample_house(
                str(rng.choice(["house", "house", "block"])), width, 9.0, rng
            )
            house = StaticObject(make_building(plan, rng), finishes(rng), HOUSE)
            # The front faces back along the street; in a building's own frame it faces -y.
            at = t if direction < 0 else t + width
            scene.put(
                house, end + direction * rng.uniform(3, 6), at, -direction * np.pi / 2
            )
            scene.put(fences.clipped_hedge(width, rng), end, t, np.pi / 2)
            t += width + rng.uniform(1, 4)


def line_side_streets(street: Street, scene: Scene, rng: Rng) -> None:
    """Put boundaries, houses and trees along the side streets, in full detail where the ego vehicle
    turns into one."""
    for c in street.crossings:
        for side in c.sides:
            if street.kind == "edge" or street.plaza == side:
                continue
            for direction in (-1, 1):
                edge = c.s + direction * (c.half + c.pavement + 0.35)
                kind = sample_kind(rng)
                corner = street.front(side) + 1.0
                _line(scene, (corner, corner + 18), edge, side, kind, rng)
                t = corner + 20
                while t < REACH:
                    width = rng.uniform(9, 14)
                    _line(scene, (t, t + width + 3), edge, side, kind, rng)
                    near = street.turn == (c, side) and t < 60
                    style = str(rng.choice(["house", "house", "row", "block"]))
                    depth = rng.uniform(8, 10)
                    plan = sample_house(style, width, depth, rng)
                    mesh = (
                        make_building(plan, rng)
                        if near
                        else _plain_house(int(rng.integers(12)))
                    )
                    low = t if side == LEFT else -t - width
                    at = low if direction < 0 else low + width
                    house = StaticObject(mesh, finishes(rng), HOUSE)
                    scene.put(
                        house,
                        edge + direction * rng.uniform(2.5, 6),
                        at,
                        -direction * np.pi / 2,
                    )
                    for _ in range(rng.poisson(3)):
                        species = str(
                            rng.choice(["bush", "bush", "thuja", "fruit", "round"])
                        )
                        place = (2 * side - 1) * rng.uniform(t, t + width + 3)
                        scene.put(
                            furniture.random_plant(species, rng, near=near),
                            edge + direction * rng.uniform(0.8, 3),
                            place,
                        )
                    t += width + rng.uniform(3, 6)


def _line(
    scene: Scene, ends: tuple[float, float], at: float, side: int, kind: str, rng: Rng
) -> None:
    """Put a boundary along t on one side of the street; ``ends`` are |t|, ``at`` is s, metres."""
    put_boundary(
        scene, kind, ends if side == LEFT else (-ends[1], -ends[0]), at, False, rng
    )


@cache
def _plain_house(variant: int) -> Mesh:
    """One of the house meshes without window recesses, for houses that are only seen from afar."""
    rng = np.random.Generator(np.random.Philox(key=variant))
    roof = ("gable", "cross", "hip")[variant % 3]
    return make_building(
        BuildingPlan(
            rng.uniform(9, 16),
            rng.uniform(8, 11),
            1 + variant % 4,
            roof=roof,
            detail=False,
        ),
        rng,
    )


def second_row(street: Street, scene: Scene, rng: Rng) -> None:
    """Put distant houses and trees behind the lots and around the far ends of the street."""
    low = -REACH - 70
    high = street.length + REACH + 70
    for side in (RIGHT, LEFT):
        sign = 2 * side - 1
        open_land = street.kind == "edge" and rng.random() < 0.6
        for depth in (36.0, 62.0, 105.0):
            for s in np.arange(low, high, 9.0 + depth / 8):
                far = not -REACH <= s <= street.length + REACH
                t = (
                    street.front(side)
                    + (12 if far and depth < 40 else depth)
                    + rng.uniform(-4, 4)
                )
                crossed = any(
                    side in c.sides and abs(s + 5 - c.s) < c.half + c.pavement + 20
                    for c in street.crossings
                )
                if crossed or (
                    street.plaza == side and t < street.front(side) + PLAZA_DEPTH + 20
                ):
                    continue
                if not open_land and rng.random() < 0.55:
                    turn = float(rng.choice([0.0, np.pi / 2])) if depth > 40 else 0.0
                    house = StaticObject(
                        _plain_house(int(rng.integers(12))), finishes(rng), HOUSE
                    )
                    scene.put(
                        house, s, sign * t, turn + (np.pi if side == RIGHT else 0)
                    )
                elif rng.random() < (0.5 if open_land else 0.8):
                    scene.put(
                        furniture.random_plant(
                            str(rng.choice(["round", "birch", "spruce", "poplar"])),
                            rng,
                            1.2,
                            near=False,
                        ),
                        s,
                        sign * t,
                    )
