"""Objects on the street: parked vehicles, trees, lamps, signs, traffic lights and small street
furniture."""

import numpy as np

from lidar_synth.lab.town import furniture
from lidar_synth.lab.town.bodywork import PAINTS
from lidar_synth.lab.town.lots import Lot
from lidar_synth.lab.town.places import edge_of_town, square
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.signs import BOARDS, road_sign, traffic_light
from lidar_synth.lab.town.street import LEFT, REACH, RIGHT, SideStreet, Street
from lidar_synth.lab.town.vehicles import vehicles

Rng = np.random.Generator
_PARKED = {
    "hatchback": 0.17,
    "compact": 0.16,
    "small": 0.08,
    "sedan": 0.11,
    "old_sedan": 0.05,
    "estate": 0.14,
    "suv": 0.08,
    "mpv": 0.09,
    "minivan": 0.035,
    "van": 0.03,
    "panel_van": 0.025,
    "small_lorry": 0.008,
    "flatbed": 0.007,
    "trailer": 0.008,
    "caravan": 0.007,
}


def sample_vehicle(rng: Rng, shares: dict[str, float] = _PARKED) -> str:
    """A kind of vehicle, sampled by the given shares (they need not sum to 1)."""
    weight = np.array(list(shares.values()))
    return str(rng.choice(list(shares), p=weight / weight.sum()))


def furnish(street: Street, lots: list[Lot], scene: Scene, rng: Rng) -> None:
    """Put all static objects of the street and its squares into the scene."""
    for side in (RIGHT, LEFT):
        _park_along(street, lots, side, scene, rng)
        _put_trees(street, side, scene, rng)
        _put_lamps(street, side, scene, rng)
        _put_signs(street, side, scene, rng)
        _put_street_furniture(street, side, scene, rng)
        if street.kind == "edge":
            edge_of_town(street, side, scene, rng)
    for c in street.crossings:
        _park_on_side_street(street, c, scene, rng)
        _put_corner_posts(street, c, scene, rng)
    if street.plaza is not None:
        square(street, street.plaza, scene, rng)


def _park_along(
    street: Street, lots: list[Lot], side: int, scene: Scene, rng: Rng
) -> None:
    """Park vehicles along one side of the street."""
    how = street.parking[side]
    if how == "none":
        return
    sign = 2 * side - 1
    edge = street.edge[side]
    at = {"street": edge - 1.02, "bay": edge + 1.05, "kerb": edge + 0.25}[how]
    density = rng.uniform(0.0, 0.5)
    drives = [lot.driveway for lot in lots if lot.side == side and lot.driveway]
    kinds = vehicles()
    for low, high in street.gaps(side, 4.0):
        s = low + rng.uniform(0, 5)
        while s < high - 3:
            kind = sample_vehicle(rng)
            ends = kinds[kind].mesh.bounds
            length = float(ends[1][0] - ends[0][0])
            s += length / 2
            blocked = any(
                a - length / 2 - 0.3 < s < b + length / 2 + 0.3 for a, b in drives
            )
            if rng.random() < density and not blocked and s + length / 2 < high:
                yaw = (
                    (0.0 if side == RIGHT else np.pi)
                    if rng.random() < 0.85
                    else (np.pi if side == RIGHT else 0.0)
                )
                place = sign * (at + rng.normal(0, 0.08))
                scene.park(
                    kinds[kind],
                    PAINTS[rng.integers(len(PAINTS))],
                    s,
                    place,
                    yaw + rng.normal(0, 0.02),
                )
            s += length / 2 + rng.uniform(0.6, 1.6)


def _park_on_side_street(street: Street, c: SideStreet, scene: Scene, rng: Rng) -> None:
    """Park vehicles along a side street."""
    kinds = vehicles()
    if c.half < 2.9 and rng.random() < 0.5:
        return
    for side in c.sides:
        if street.turn == (c, side):
            continue
        sign = 2 * side - 1
        direction = int(rng.choice([-1, 1]))
        t = street.edge[side] + 9.0 + rng.uniform(0, 5)
        while t < 75:
            if rng.random() < 0.55:
                yaw = np.pi / 2 * (1 if rng.random() < 0.5 else -1)
                scene.park(
                    kinds[sample_vehicle(rng)],
                    PAINTS[rng.integers(len(PAINTS))],
                    c.s + direction * (c.half - 0.85),
                    sign * t,
                    yaw,
                )
            t += rng.uniform(6.0, 7.5)


def _put_trees(street: Street, side: int, scene: Scene, rng: Rng) -> None:
    """Put trees, weeds and bushes onto the verge of one side."""
    sign = 2 * side - 1
    verge = street.band(side, "grass")
    bay = street.band(side, "parking")
    if street.kind != "edge" and verge is not None and rng.random() < 0.8:
        step = rng.uniform(7, 16)
        at = (verge[0] + verge[1]) / 2
        species = str(rng.choice(["round", "birch", "poplar"]))
        for low, high in street.gaps(side, 3.0):
            for s in np.arange(low + 2, high - 2, step):
                if rng.random() < 0.85:
                    scene.put(
                        furniture.random_plant(species, rng),
                        s + rng.normal(0, 0.5),
                        sign * (at + rng.normal(0, 0.15)),
                        solid=0.4,
                    )
    if verge is not None:
        for low, high in street.gaps(side, 2.0):
            for s in np.arange(low, high - 8, 8.0):
                if rng.random() < 0.4:
                    scene.put(
                        furniture.weeds(
                            8.0, verge[1] - verge[0] - 0.3, rng.uniform(0.1, 0.3), rng
                        ),
                        s,
                        sign * (verge[0] + verge[1]) / 2,
                    )
                elif bay is not None and rng.random() < 0.2:
                    scene.put(
                        furniture.random_plant("bush", rng, 0.6),
                        s,
                        sign * (verge[0] + verge[1]) / 2,
                        solid=0.5,
                    )


def _put_lamps(street: Street, side: int, scene: Scene, rng: Rng) -> None:
    """Put street lamps along one side, and masts onto the median."""
    if street.kind == "edge" and rng.random() < 0.6:
        return
    sign = 2 * side - 1
    height = rng.uniform(4.5, 6) if street.kind == "residential" else rng.uniform(7, 9)
    step = rng.uniform(24, 40) * (1 if side == RIGHT or street.kind == "main" else 2)
    wood = street.kind in ("residential", "edge") and rng.random() < 0.3
    at = (
        street.front(side) - 0.35
        if rng.random() < 0.5
        else street.edge[side]
        + 0.4
        + (2.2 if street.parking[side] in ("bay", "kerb") else 0.0)
    )
    for low, high in street.gaps(side, 0.5):
        for s in np.arange(low + rng.uniform(0, step), high, step):
            scene.put(
                furniture.lamp_post(height, rng.uniform(0.6, 1.6)),
                s,
                sign * at,
                -sign * np.pi / 2,
                solid=0.3,
            )
            if wood:
                scene.put(
                    furniture.mast(8.5, 0.13, True),
                    s + step / 2,
                    sign * (street.front(side) - 0.3),
                    solid=0.3,
                )
    if street.median > 1 and side == RIGHT:
        for s in np.arange(-REACH, street.length + REACH, 28.0):
            scene.put(furniture.mast(7.5, 0.11, False), s, 0.0)


def _put_signs(street: Street, side: int, scene: Scene, rng: Rng) -> None:
    """Put road signs along one side."""
    sign = 2 * side - 1
    at = (
        street.edge[side]
        + 0.45
        + (2.1 if street.parking[side] in ("bay", "kerb") else 0.0)
    )
    facing = np.pi if side == RIGHT else 0.0
    for low, high in street.gaps(side, 0.3):
        for s in np.arange(low + rng.uniform(0, 30), high, rng.uniform(28, 55)):
            kind = str(
                rng.choice(list(BOARDS)[:6], p=[0.2, 0.3, 0.12, 0.23, 0.12, 0.03])
            )
            scene.put(
                road_sign(kind, rng.uniform(1.9, 2.4)),
                s,
                sign * at,
                facing + rng.normal(0, 0.15),
                solid=0.3,
            )


def _put_corner_posts(street: Street, c: SideStreet, scene: Scene, rng: Rng) -> None:
    """Put traffic lights at large junctions, and street-name and right-of-way signs at other
    ones."""
    for side in c.sides:
        sign = 2 * side - 1
        for direction in (-1, 1):
            s = c.s + direction * (c.half + 0.9)
            t = sign * (street.edge[side] + 0.9)
            if street.kind == "junction" and street.marked:
                if direction == -sign or rng.random() < 0.5:
                    towards = np.pi if direction < 0 else 0.0
                    reach = 3.5 if direction == sign and rng.random() < 0.6 else 0.0
                    scene.put(
                        traffic_light(5.2 if reach else 3.2, reach),
                        s,
                        t,
                        towards,
                        solid=0.3,
                    )
                scene.put(
                    traffic_light(3.2, 0.0),
                    s - direction * 0.5,
                    t + sign * 1.2,
                    sign * np.pi / 2,
                    solid=0.3,
                )
            elif rng.random() < 0.35:
                scene.put(
                    road_sign("street", 2.5),
                    s,
                    t,
                    rng.choice([0.0, np.pi / 2]),
                    solid=0.3,
                )
            elif rng.random() < 0.3:
                scene.put(
                    road_sign(str(rng.choice(["warning", "priority"])), 2.1),
                    s,
                    t,
                    sign * np.pi / 2,
                    solid=0.3,
                )
            if rng.random() < 0.25:
                for k in range(3):
                    scene.put(
                        furniture.bollard(), s + direction * 1.5 * k, t, solid=0.2
                    )


def _put_street_furniture(street: Street, side: int, scene: Scene, rng: Rng) -> None:
    """Put bins, cabinets, bicycles, motorcycles, bus stops and advertising columns along the front
    of the lots."""
    sign = 2 * side - 1
    front = street.front(side)
    if street.kind == "edge":
        return
    kinds = vehicles()
    away = -sign * np.pi / 2
    for low, high in street.gaps(side, 1.0):
        for s in np.arange(low + 1, high - 4, 6.0) + rng.uniform(0, 4):
            draw = rng.random()
            if draw < 0.10:
                for k in range(int(rng.integers(1, 4))):
                    scene.put(
                        furniture.bin_(rng),
                        s + 0.75 * k,
                        sign * (front - 0.4),
                        away + rng.normal(0, 0.1),
                        solid=0.4,
                    )
            elif draw < 0.14:
                scene.put(furniture.cabinet(), s, sign * (front - 0.3), away, solid=0.6)
            elif draw < 0.22:
                lean = away + np.pi / 2 if rng.random() < 0.6 else away
                for k in range(int(rng.integers(1, 5))):
                    scene.park(
                        kinds["bicycle"],
                        PAINTS[rng.integers(len(PAINTS))],
                        s + 0.7 * k,
                        sign * (front - 0.45),
                        lean + (0 if lean == away else rng.normal(0, 0.1)),
                    )
            elif draw < 0.25:
                scene.park(
                    kinds["motorcycle"],
                    PAINTS[rng.integers(len(PAINTS))],
                    s,
                    sign * (front - 0.6),
                    away + rng.normal(0, 0.3),
                )
            elif draw < 0.27:
                scene.put(furniture.planter(rng), s, sign * (front - 0.6), solid=0.6)
            elif draw < 0.285 and street.kind != "residential":
                scene.put(
                    furniture.shelter(), s, sign * (front - 0.75), away, solid=1.2
                )
            elif draw < 0.295 and street.kind != "residential":
                scene.put(
                    furniture.advertising_column(), s, sign * (front - 0.8), solid=0.8
                )
