"""Construction of a lot: house, boundary, garage, plants and objects in the yard."""

import numpy as np

from lidar_synth.lab.town import fences, furniture
from lidar_synth.lab.town.bodywork import PAINTS
from lidar_synth.lab.town.boundaries import put_boundary
from lidar_synth.lab.town.buildings import garage, make_building
from lidar_synth.lab.town.facades import finishes
from lidar_synth.lab.town.furniture import BUILDING, StaticObject
from lidar_synth.lab.town.lots import Lot
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import LEFT, Street
from lidar_synth.lab.town.vehicles import vehicles

Rng = np.random.Generator
HOUSE = (BUILDING,) * 10
"""SemanticKITTI's class id of each slot of a building."""


def build_lot(lot: Lot, street: Street, scene: Scene, rng: Rng) -> None:
    """Put the house, the boundary, the plants and the objects of a lot into the scene."""
    house = lot.front + lot.setback
    if lot.plan is not None:
        _put_facing_street(
            scene,
            StaticObject(make_building(lot.plan, rng), finishes(rng), HOUSE),
            lot,
            lot.start + lot.house_offset,
            house,
            lot.plan.width,
        )
    if lot.boundary != "none":
        openings = [lot.driveway] if lot.driveway else []
        if lot.plan is not None and not lot.driveway:
            middle = lot.start + lot.house_offset + lot.plan.width / 2
            openings = [(middle - 0.6, middle + 0.6)]
        low = lot.start + 0.1
        for a, b in [*openings, (lot.end - 0.1, 0.0)]:
            put_boundary(
                scene, lot.boundary, (low, a), lot.sign * (lot.front + 0.3), True, rng
            )
            low = b
    if lot.driveway:
        _furnish_driveway(scene, lot, house, rng)
    _plant_garden(scene, lot, street, house, rng)


def _put_facing_street(
    scene: Scene, item: StaticObject, lot: Lot, s: float, front: float, width: float
) -> None:
    """Put a building whose front faces the street; ``s`` is the lower end of its front."""
    if lot.side == LEFT:
        scene.put(item, s, front)
    else:
        scene.put(item, s + width, -front, np.pi)


def _furnish_driveway(scene: Scene, lot: Lot, house: float, rng: Rng) -> None:
    """Put a garage, a parked vehicle and a bin onto the driveway, each at random."""
    assert lot.driveway is not None
    middle = sum(lot.driveway) / 2
    if rng.random() < 0.6:
        shed = StaticObject(garage(2.9, 6.0), finishes(rng), HOUSE)
        _put_facing_street(
            scene, shed, lot, middle - 1.45, house + rng.uniform(0.5, 3), 2.9
        )
    if rng.random() < 0.4 and lot.setback > 2.5:
        kinds = vehicles()
        kind = str(
            rng.choice(
                [
                    "hatchback",
                    "compact",
                    "sedan",
                    "estate",
                    "suv",
                    "mpv",
                    "small",
                    "caravan",
                ]
            )
        )
        yaw = np.pi / 2 * (1 if rng.random() < 0.5 else -1)
        scene.park(
            kinds[kind],
            PAINTS[rng.integers(len(PAINTS))],
            middle,
            lot.sign * (lot.front + 2.6),
            yaw,
        )
    if rng.random() < 0.35:
        scene.put(
            furniture.bin_(rng),
            lot.driveway[0] - 0.5,
            lot.sign * (lot.front + 0.9),
            -lot.sign * np.pi / 2,
        )


def _plant_garden(
    scene: Scene, lot: Lot, street: Street, house: float, rng: Rng
) -> None:
    """Put bushes and trees in front of, beside and behind the house."""
    depth = lot.setback if lot.plan else 16.0
    width = lot.end - lot.start
    # Plants behind a house are hardly visible, so most are put near the street.
    for _ in range(rng.poisson((0.4 + lot.garden) * width * min(depth, 10) / 11)):
        s = rng.uniform(lot.start + 0.8, lot.end - 0.8)
        t = lot.front + rng.uniform(0.9, max(1.0, depth - 0.6))
        if lot.driveway and lot.driveway[0] - 1 < s < lot.driveway[1] + 1:
            continue
        species = str(
            rng.choice(
                ["bush", "thuja", "fruit", "round", "birch", "spruce"],
                p=[0.56, 0.13, 0.16, 0.06, 0.04, 0.05],
            )
        )
        near = t < 15 and -35 < s < street.length + 40
        scene.put(
            furniture.random_plant(species, rng, near=near), s, lot.sign * t, solid=0.5
        )
    behind = house + (lot.plan.depth if lot.plan else 0)
    for _ in range(rng.poisson(width / 6)):
        species = str(rng.choice(["round", "birch", "spruce", "poplar", "fruit"]))
        scene.put(
            furniture.random_plant(species, rng, near=False),
            rng.uniform(lot.start, lot.end),
            lot.sign * (behind + rng.uniform(2, 16)),
        )
    if lot.plan and rng.random() < 0.5:
        gap = (
            lot.start + lot.house_offset / 2
            if lot.house_offset > 2
            else lot.start + 0.3
        )
        item = (
            fences.clipped_hedge(8.0, rng)
            if rng.random() < 0.5
            else fences.wire_fence(8.0, 1.2)
        )
        scene.put(
            item,
            lot.start + 0.2 if lot.driveway else gap,
            lot.sign * house,
            lot.sign * np.pi / 2,
        )
    if lot.plan:
        _close_gap(scene, lot, behind, rng)


def _close_gap(scene: Scene, lot: Lot, behind: float, rng: Rng) -> None:
    """Close the gaps beside a house at its back with a hedge, a fence, a shed or bushes."""
    assert lot.plan is not None
    for low, high in (
        (lot.start, lot.start + lot.house_offset),
        (lot.start + lot.house_offset + lot.plan.width, lot.end),
    ):
        draw = rng.random()
        if high - low < 1.5 or draw < 0.2:
            continue
        t = lot.sign * (behind + rng.uniform(-3, 4))
        if draw < 0.45:
            scene.put(fences.clipped_hedge(high - low, rng), low, t)
        elif draw < 0.6:
            scene.put(
                fences.bar_fence(high - low, 1.6, 0.11, (0.45, 0.35, 0.25), True),
                low,
                t,
            )
        elif draw < 0.8 and high - low > 3.4:
            _put_facing_street(
                scene,
                StaticObject(garage(3.2, 4.0), finishes(rng), HOUSE),
                lot,
                low + 0.1,
                abs(t),
                3.2,
            )
        else:
            for s in np.arange(low + 0.7, high, 1.6):
                scene.put(
                    furniture.random_plant(
                        "bush", rng, rng.uniform(1.0, 1.5), near=False
                    ),
                    s,
                    t,
                )
