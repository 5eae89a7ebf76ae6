"""The background: houses where a street ends, along side streets, and in rows behind the lots."""

from functools import cache

import numpy as np

from lidar_synth.lab.town.boundaries import put_boundary
from lidar_synth.lab.town.buildings import finish_building, make_building
from lidar_synth.lab.town.catalogue import Rng, pick, pick_name
from lidar_synth.lab.town.facades import BuildingPlan
from lidar_synth.lab.town.lots import sample_house
from lidar_synth.lab.town.meshes import Mesh
from lidar_synth.lab.town.paving import PLAZA_DEPTH
from lidar_synth.lab.town.plants import clipped_hedge, random_plant
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import LEFT, REACH, RIGHT, SIDES, SideStreet, Street


def close_ends(street: Street, scene: Scene, rng: Rng) -> None:
    """Put houses and hedges where the street ends at another one."""
    for end, direction in zip(street.ends, (-1, 1), strict=True):
        t = -40.0
        while t < 40 and np.isfinite(end):
            width = rng.uniform(9, 16)
            plan = sample_house(pick_name("houses_at_end", rng), width, 9.0, rng)
            house = finish_building(make_building(plan, rng), rng)
            # The front faces back along the street; in a building's own frame it faces -y.
            place = t if direction < 0 else t + width
            s = end + direction * rng.uniform(3, 6)
            scene.put(house, s, place, -direction * np.pi / 2)
            scene.put(clipped_hedge(width, rng), end, t, np.pi / 2)
            t += width + rng.uniform(1, 4)


def line_side_streets(street: Street, scene: Scene, rng: Rng) -> None:
    """Put boundaries, houses and trees along the side streets, in full detail where the ego vehicle
    turns into one."""
    if street.kind == "edge":
        return
    for c in street.crossings:
        for side in c.sides:
            if street.plaza != side:
                for direction in (-1, 1):
                    _line(
                        street,
                        c,
                        side,
                        direction,
                        scene,
                        rng,
                    )


def _line(
    street: Street,
    c: SideStreet,
    side: int,
    direction: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Line a side street on one side of the stretch, in one direction along s from its middle."""
    edge = c.s + direction * (c.half + c.pavement + 0.35)
    kind = pick_name("boundaries", rng)
    corner = street.front(side) + 1.0
    _put_boundary(
        scene,
        corner,
        corner + 18,
        edge,
        side,
        kind,
        rng,
    )
    t = corner + 20
    while t < REACH:
        width = rng.uniform(9, 14)
        _put_boundary(
            scene,
            t,
            t + width + 3,
            edge,
            side,
            kind,
            rng,
        )
        near = street.turn == (c, side) and t < 60
        style = pick_name("houses_on_side_street", rng)
        plan = sample_house(style, width, rng.uniform(8, 10), rng)
        mesh = make_building(plan, rng) if near else _pick_plain_house(rng)
        low = t if side == LEFT else -t - width
        place = low if direction < 0 else low + width
        house = finish_building(mesh, rng)
        s = edge + direction * rng.uniform(2.5, 6)
        scene.put(house, s, place, -direction * np.pi / 2)
        for _ in range(rng.poisson(3)):
            species = pick_name("plants_on_side_street", rng)
            place = side * rng.uniform(t, t + width + 3)
            plant = random_plant(species, rng, near=near)
            scene.put(plant, edge + direction * rng.uniform(0.8, 3), place)
        t += width + rng.uniform(3, 6)


def _put_boundary(
    scene: Scene,
    low: float,
    high: float,
    s: float,
    side: int,
    kind: str,
    rng: Rng,
) -> None:
    """Put a boundary along t on one side of the street, from |t| ``low`` to ``high``, metres."""
    ends = (low, high) if side == LEFT else (-high, -low)
    put_boundary(
        scene,
        kind,
        ends,
        s,
        False,
        rng,
    )


def _pick_plain_house(rng: Rng) -> Mesh:
    """One of twelve houses without window recesses, which are only seen from afar."""
    return _plain_house(int(rng.integers(12)))


@cache
def _plain_house(variant: int) -> Mesh:
    rng = np.random.Generator(np.random.Philox(key=variant))
    roof = ("gable", "cross", "hip")[variant % 3]
    width = rng.uniform(9, 16)
    depth = rng.uniform(8, 11)
    floors = 1 + variant % 4
    return make_building(
        BuildingPlan(width, depth, floors, roof=roof, detail=False), rng
    )


def line_horizon(street: Street, scene: Scene, rng: Rng) -> None:
    """Put distant houses and trees behind the lots and around the far ends of the street."""
    for side in SIDES:
        open_land = street.kind == "edge" and rng.random() < 0.6
        for depth in (36.0, 62.0, 105.0):
            low = -REACH - 70
            high = street.length + REACH + 70
            for s in np.arange(low, high, 9.0 + depth / 8):
                beyond = not -REACH <= s <= street.length + REACH
                out = 12 if beyond and depth < 40 else depth
                t = street.front(side) + out + rng.uniform(-4, 4)
                if not _lies_open(street, side, s, t):
                    _put_far_object(
                        s,
                        t,
                        side,
                        depth,
                        open_land,
                        scene,
                        rng,
                    )


def _lies_open(
    street: Street,
    side: int,
    s: float,
    t: float,
) -> bool:
    """Whether a place lies on or beside a side street or a square."""
    crossed = any(
        side in c.sides and abs(s + 5 - c.s) < c.half + c.pavement + 20
        for c in street.crossings
    )
    plaza = street.plaza == side and t < street.front(side) + PLAZA_DEPTH + 20
    return crossed or plaza


def _put_far_object(
    s: float,
    t: float,
    side: int,
    depth: float,
    open_land: bool,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put a house, a tree or nothing, at random."""
    if not open_land and rng.random() < 0.55:
        turn = pick((0.0, np.pi / 2), rng) if depth > 40 else 0.0
        house = finish_building(_pick_plain_house(rng), rng)
        scene.put(house, s, side * t, turn + (np.pi if side == RIGHT else 0))
    elif rng.random() < (0.5 if open_land else 0.8):
        species = pick_name("plants_far_away", rng)
        tree = random_plant(species, rng, 1.2, near=False)
        scene.put(tree, s, side * t)
