"""Construction of a lot: house, boundary, garage, plants and objects in the yard."""

import numpy as np

from lidar_synth.lab.town import furniture
from lidar_synth.lab.town.boundaries import put_boundary
from lidar_synth.lab.town.buildings import finish_building, garage, make_building
from lidar_synth.lab.town.catalogue import Rng, pick_colour, pick_name
from lidar_synth.lab.town.lots import Lot
from lidar_synth.lab.town.objects import StaticObject
from lidar_synth.lab.town.plants import clipped_hedge, random_plant
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import LEFT, Street
from lidar_synth.lab.town.vehicles import vehicles


def build_lot(
    lot: Lot,
    street: Street,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put the house, the boundary, the plants and the objects of a lot into the scene."""
    front = lot.front + lot.setback
    if lot.plan:
        house = finish_building(make_building(lot.plan, rng), rng)
        _put_facing_street(scene, house, lot, lot.house, front)
    if lot.boundary != "none":
        _put_boundaries(scene, lot, rng)
    if lot.driveway:
        _furnish_driveway(scene, lot, lot.driveway, rng)
    _plant_garden(scene, lot, street, rng)
    behind = front + (lot.plan.depth if lot.plan else 0)
    _plant_behind(scene, lot, behind, rng)
    if lot.plan:
        _divide_garden(scene, lot, rng)
        low, high = lot.house
        for gap in ((lot.start, low), (high, lot.end)):
            _close_gap(scene, lot, gap, behind, rng)


def _plant_behind(scene: Scene, lot: Lot, behind: float, rng: Rng) -> None:
    """Put plants beyond |t| ``behind``, that of the back of the house."""
    for _ in range(rng.poisson((lot.end - lot.start) / 6)):
        plant = random_plant(pick_name("plants_behind_house", rng), rng, near=False)
        s = rng.uniform(lot.start, lot.end)
        scene.put(plant, s, lot.side * (behind + rng.uniform(2, 16)))


def _put_boundaries(scene: Scene, lot: Lot, rng: Rng) -> None:
    """Put a boundary along the front of a lot, with an opening for the driveway or the door."""
    openings = [lot.driveway] if lot.driveway else []
    if lot.plan and not lot.driveway:
        middle = lot.start + lot.house_offset + lot.plan.width / 2
        openings = [(middle - 0.6, middle + 0.6)]
    low = lot.start + 0.1
    t = lot.side * (lot.front + 0.3)
    for a, b in [*openings, (lot.end - 0.1, 0.0)]:
        put_boundary(
            scene,
            lot.boundary,
            (low, a),
            t,
            True,
            rng,
        )
        low = b


def _put_facing_street(
    scene: Scene,
    item: StaticObject,
    lot: Lot,
    ends: tuple[float, float],
    front: float,
) -> None:
    """Put a building whose front faces the street; ``ends`` are the s of the ends of its front."""
    low, high = ends
    if lot.side == LEFT:
        scene.put(item, low, front)
    else:
        scene.put(item, high, -front, np.pi)


def _furnish_driveway(
    scene: Scene,
    lot: Lot,
    driveway: tuple[float, float],
    rng: Rng,
) -> None:
    """Put a garage, a parked vehicle and a bin onto the driveway, each at random."""
    middle = sum(driveway) / 2
    if rng.random() < 0.6:
        shed = finish_building(garage(2.9, 6.0), rng)
        low = middle - 1.45
        front = lot.front + lot.setback + rng.uniform(0.5, 3)
        _put_facing_street(scene, shed, lot, (low, low + 2.9), front)
    if rng.random() < 0.4 and lot.setback > 2.5:
        _park(scene, middle, lot.side * (lot.front + 2.6), rng)
    if rng.random() < 0.35:
        t = lot.side * (lot.front + 0.9)
        scene.put(furniture.bin_(rng), driveway[0] - 0.5, t, -lot.side * np.pi / 2)


def _park(scene: Scene, s: float, t: float, rng: Rng) -> None:
    """Park a vehicle that faces the street or the house."""
    kind = vehicles()[pick_name("driveway", rng)]
    yaw = np.pi / 2 * (1 if rng.random() < 0.5 else -1)
    scene.park(kind, pick_colour("paints", rng), s, t, yaw)


def _plant_garden(
    scene: Scene,
    lot: Lot,
    street: Street,
    rng: Rng,
) -> None:
    """Put bushes and trees in front of and beside the house."""
    depth = lot.setback if lot.plan else 16.0
    width = lot.end - lot.start
    drive = lot.driveway or (np.inf, np.inf)
    # Plants behind a house are hardly visible, so most are put near the street.
    for _ in range(rng.poisson((0.4 + lot.garden) * width * min(depth, 10) / 11)):
        s = rng.uniform(lot.start + 0.8, lot.end - 0.8)
        t = lot.front + rng.uniform(0.9, max(1.0, depth - 0.6))
        if drive[0] - 1 < s < drive[1] + 1:
            continue
        species = pick_name("plants_of_garden", rng)
        near = t < 15 and -35 < s < street.length + 40
        plant = random_plant(species, rng, near=near)
        scene.put(plant, s, lot.side * t, solid=0.5)


def _divide_garden(scene: Scene, lot: Lot, rng: Rng) -> None:
    """Put a hedge or a fence beside the house, across the street, at random."""
    if rng.random() >= 0.5:
        return
    item = furniture.wire_fence(8.0, 1.2)
    if rng.random() < 0.5:
        item = clipped_hedge(8.0, rng)
    aside = 0.3
    if lot.driveway:
        aside = 0.2
    elif lot.house_offset > 2:
        aside = lot.house_offset / 2
    t = lot.side * (lot.front + lot.setback)
    scene.put(item, lot.start + aside, t, lot.side * np.pi / 2)


def _close_gap(
    scene: Scene,
    lot: Lot,
    gap: tuple[float, float],
    behind: float,
    rng: Rng,
) -> None:
    """Close a gap beside a house at its back with a hedge, a fence, a shed or bushes."""
    low, high = gap
    width = high - low
    draw = rng.random()
    if width < 1.5 or draw < 0.2:
        return
    t = lot.side * (behind + rng.uniform(-3, 4))
    if draw < 0.45:
        scene.put(clipped_hedge(width, rng), low, t)
    elif draw < 0.6:
        fence = furniture.bar_fence(width, 1.6, 0.11, (0.45, 0.35, 0.25), True)
        scene.put(fence, low, t)
    elif draw < 0.8 and width > 3.4:
        shed = finish_building(garage(3.2, 4.0), rng)
        _put_facing_street(scene, shed, lot, (low + 0.1, low + 0.1 + 3.2), abs(t))
    else:
        for s in np.arange(low + 0.7, high, 1.6):
            scene.put(
                random_plant("bush", rng, rng.uniform(1.0, 1.5), near=False), s, t
            )
