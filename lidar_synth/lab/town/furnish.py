"""Objects on the street: parked vehicles, trees, lamps, signs, traffic lights and small street
furniture."""

import numpy as np

from lidar_synth.lab.town import furniture
from lidar_synth.lab.town.catalogue import Rng, pick, pick_colour, pick_name
from lidar_synth.lab.town.lots import Lot
from lidar_synth.lab.town.objects import make_object
from lidar_synth.lab.town.places import furnish_edge, furnish_square
from lidar_synth.lab.town.plants import random_plant, weeds
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import REACH, RIGHT, SIDES, SideStreet, Street
from lidar_synth.lab.town.vehicles import vehicles


def furnish_street(
    street: Street,
    lots: list[Lot],
    scene: Scene,
    rng: Rng,
) -> None:
    """Put all static objects of the street and its squares into the scene."""
    for side in SIDES:
        _park_along(street, lots, side, scene, rng)
        _put_trees(street, side, scene, rng)
        _put_weeds(street, side, scene, rng)
        _put_lamps(street, side, scene, rng)
        _put_signs(street, side, scene, rng)
        if street.kind == "edge":
            furnish_edge(street, side, scene, rng)
        else:
            _put_street_furniture(street, side, scene, rng)
    for c in street.crossings:
        if c.half >= 2.9 or rng.random() >= 0.5:
            _park_on_side_street(street, c, scene, rng)
        for side in c.sides:
            for direction in (-1, 1):
                _furnish_corner(
                    street,
                    c,
                    side,
                    direction,
                    scene,
                    rng,
                )
    if street.plaza is not None:
        furnish_square(street, street.plaza, scene, rng)


def _park_along(
    street: Street,
    lots: list[Lot],
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Park vehicles along one side of the street."""
    how = street.parking[side]
    if how == "none":
        return
    t = street.edge[side] + {"street": -1.02, "bay": 1.05, "kerb": 0.25}[how]
    density = rng.uniform(0.0, 0.5)
    drives = [lot.driveway for lot in lots if lot.side == side and lot.driveway]
    for low, high in street.gaps(side, 4.0):
        s = low + rng.uniform(0, 5)
        while s < high - 3:
            kind = vehicles()[pick_name("parked", rng)]
            half = kind.length / 2
            s += half
            near = half + 0.3
            blocked = any(a - near < s < b + near for a, b in drives)
            if rng.random() < density and not blocked and s + half < high:
                ahead = 0.0 if side == RIGHT else np.pi
                yaw = ahead if rng.random() < 0.85 else np.pi - ahead
                place = side * (t + rng.normal(0, 0.08))
                colour = pick_colour("paints", rng)
                scene.park(kind, colour, s, place, yaw + rng.normal(0, 0.02))
            s += half + rng.uniform(0.6, 1.6)


def _park_on_side_street(
    street: Street,
    c: SideStreet,
    scene: Scene,
    rng: Rng,
) -> None:
    """Park vehicles along a side street."""
    for side in c.sides:
        if street.turn == (c, side):
            continue
        s = c.s + pick((-1, 1), rng) * (c.half - 0.85)
        t = street.edge[side] + 9.0 + rng.uniform(0, 5)
        while t < 75:
            if rng.random() < 0.55:
                yaw = np.pi / 2 * (1 if rng.random() < 0.5 else -1)
                kind = vehicles()[pick_name("parked", rng)]
                scene.park(kind, pick_colour("paints", rng), s, side * t, yaw)
            t += rng.uniform(6.0, 7.5)


def _put_trees(
    street: Street,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put a row of trees onto the verge of one side."""
    verge = street.band(side, "grass")
    if street.kind == "edge" or not verge or rng.random() >= 0.8:
        return
    step = rng.uniform(7, 16)
    species = pick_name("plants_of_verge", rng)
    for low, high in street.gaps(side, 3.0):
        for s in np.arange(low + 2, high - 2, step):
            if rng.random() < 0.85:
                plant = random_plant(species, rng)
                place = s + rng.normal(0, 0.5)
                t = side * (sum(verge) / 2 + rng.normal(0, 0.15))
                scene.put(plant, place, t, solid=0.4)


def _put_weeds(
    street: Street,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put weeds and bushes onto the verge of one side."""
    verge = street.band(side, "grass")
    if not verge:
        return
    bay = street.band(side, "parking")
    t = side * sum(verge) / 2
    depth = verge[1] - verge[0] - 0.3
    for low, high in street.gaps(side, 2.0):
        for s in np.arange(low, high - 8, 8.0):
            if rng.random() < 0.4:
                scene.put(weeds(8.0, depth, rng.uniform(0.1, 0.3), rng), s, t)
            elif bay and rng.random() < 0.2:
                scene.put(random_plant("bush", rng, 0.6), s, t, solid=0.5)


def _near_kerb(
    street: Street,
    side: int,
    margin: float,
    bay: float,
) -> float:
    """|t| of a place ``margin`` behind the kerb, or behind bays of depth ``bay``, metres."""
    parked = street.parking[side] in ("bay", "kerb")
    return street.edge[side] + margin + (bay if parked else 0.0)


def _put_lamps(
    street: Street,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put street lamps along one side, and masts onto the median."""
    if street.kind == "edge" and rng.random() < 0.6:
        return
    height = rng.uniform(*((4.5, 6) if street.kind == "residential" else (7, 9)))
    step = rng.uniform(24, 40)
    if side != RIGHT and street.kind != "main":
        step *= 2
    wood = street.kind in ("residential", "edge") and rng.random() < 0.3
    front = street.front(side)
    t = front - 0.35 if rng.random() < 0.5 else _near_kerb(street, side, 0.4, 2.2)
    for low, high in street.gaps(side, 0.5):
        for s in np.arange(low + rng.uniform(0, step), high, step):
            lamp = furniture.lamp_post(height, rng.uniform(0.6, 1.6))
            scene.put(lamp, s, side * t, -side * np.pi / 2, solid=0.3)
            if wood:
                mast = make_object("wooden_mast")
                scene.put(mast, s + step / 2, side * (front - 0.3), solid=0.3)
    if street.median > 1 and side == RIGHT:
        for s in np.arange(-REACH, street.length + REACH, 28.0):
            scene.put(make_object("tram_mast"), s, 0.0)


def _put_signs(
    street: Street,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put road signs along one side."""
    t = side * _near_kerb(street, side, 0.45, 2.1)
    facing = np.pi if side == RIGHT else 0.0
    for low, high in street.gaps(side, 0.3):
        for s in np.arange(low + rng.uniform(0, 30), high, rng.uniform(28, 55)):
            sign = furniture.road_sign(pick_name("signs", rng), rng.uniform(1.9, 2.4))
            scene.put(sign, s, t, facing + rng.normal(0, 0.15), solid=0.3)


def _furnish_corner(
    street: Street,
    c: SideStreet,
    side: int,
    direction: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put traffic lights at large junctions, street-name and right-of-way signs at other ones, and
    bollards."""
    s = c.s + direction * (c.half + 0.9)
    t = side * (street.edge[side] + 0.9)
    across = side * np.pi / 2
    if street.kind == "junction" and street.marked:
        if direction == -side or rng.random() < 0.5:
            arm = direction == side and rng.random() < 0.6
            lights = make_object("traffic_lights" if arm else "traffic_light")
            scene.put(lights, s, t, np.pi if direction < 0 else 0.0, solid=0.3)
        light = make_object("traffic_light")
        scene.put(light, s - direction * 0.5, t + side * 1.2, across, solid=0.3)
    elif rng.random() < 0.35:
        sign = furniture.road_sign("street", 2.5)
        scene.put(sign, s, t, pick((0.0, np.pi / 2), rng), solid=0.3)
    elif rng.random() < 0.3:
        sign = furniture.road_sign(pick_name("corner_signs", rng), 2.1)
        scene.put(sign, s, t, across, solid=0.3)
    if rng.random() < 0.25:
        for k in range(3):
            scene.put(make_object("bollard"), s + direction * 1.5 * k, t, solid=0.2)


def _put_street_furniture(
    street: Street,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put bins, cabinets, bicycles, motorcycles, bus stops and advertising columns along the front
    of the lots."""
    front = street.front(side)
    for low, high in street.gaps(side, 1.0):
        for s in np.arange(low + 1, high - 4, 6.0) + rng.uniform(0, 4):
            draw = rng.random()
            if draw < 0.10:
                _put_bins(s, side * (front - 0.4), side, scene, rng)
            elif 0.14 <= draw < 0.25:
                _park_cycles(
                    s,
                    high,
                    front,
                    side,
                    draw < 0.22,
                    scene,
                    rng,
                )
            else:
                _put_small_object(
                    draw,
                    s,
                    front,
                    side,
                    street.kind,
                    scene,
                    rng,
                )


def _put_bins(
    s: float,
    t: float,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put up to three bins side by side."""
    for k in range(int(rng.integers(1, 4))):
        item = furniture.bin_(rng)
        yaw = -side * np.pi / 2 + rng.normal(0, 0.1)
        scene.put(item, s + 0.75 * k, t, yaw, solid=0.4)


def _park_cycles(
    s: float,
    high: float,
    front: float,
    side: int,
    bicycles: bool,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put up to four bicycles side by side or in a row, as far as ``high``, or a motorcycle."""
    away = -side * np.pi / 2
    if not bicycles:
        kind = vehicles()["motorcycle"]
        colour = pick_colour("paints", rng)
        t = side * (front - 0.6)
        scene.park(kind, colour, s, t, away + rng.normal(0, 0.3))
        return
    row = rng.random() < 0.6
    kind = vehicles()["bicycle"]
    apart = 1.9 if row else 0.7
    for place in s + apart * np.arange(rng.integers(1, 5)):
        colour = pick_colour("paints", rng)
        yaw = away + np.pi / 2 + rng.normal(0, 0.1) if row else away
        if place < high:
            scene.park(kind, colour, place, side * (front - 0.45), yaw)


def _put_small_object(
    draw: float,
    s: float,
    front: float,
    side: int,
    street: str,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put a cabinet, a planter or, unless the street is residential, a shelter or an advertising
    column; mostly nothing."""
    away = -side * np.pi / 2
    if draw < 0.14:
        cabinet = make_object("cabinet")
        scene.put(cabinet, s, side * (front - 0.3), away, solid=0.6)
    elif draw < 0.27:
        scene.put(furniture.planter(rng), s, side * (front - 0.6), solid=0.6)
    elif draw < 0.285 and street != "residential":
        shelter = make_object("shelter")
        scene.put(shelter, s, side * (front - 0.75), away, solid=1.2)
    elif draw < 0.295 and street != "residential":
        column = make_object("advertising_column")
        scene.put(column, s, side * (front - 0.8), solid=0.8)
