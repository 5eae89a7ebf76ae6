"""Objects of special places: the verges of a road at the edge of town, and the furniture and people
of a square."""

import numpy as np

from lidar_synth.lab.town.bodies import sitter, walker
from lidar_synth.lab.town.catalogue import Rng, pick, pick_colour, pick_name
from lidar_synth.lab.town.furniture import stall
from lidar_synth.lab.town.objects import make_object
from lidar_synth.lab.town.paving import PLAZA_DEPTH
from lidar_synth.lab.town.plants import random_hedge, random_plant, weeds
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import Street


def furnish_edge(
    street: Street,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put high grass, thickets, crash barriers and single trees beside a road at the edge of
    town."""
    edge = street.edge[side]
    front = street.front(side)
    rail = rng.random() < 0.25
    bushes = rng.uniform(0, 0.8)
    belt = rng.random() < 0.6
    depth = rng.uniform(2, 5)
    middle = side * (front + rng.uniform(2, 7) + depth / 2)
    for low, high in street.gaps(side, 2.0):
        for s in np.arange(low, high - 8, 8.0):
            if rail:
                scene.put(make_object("guard_rail"), s, side * (edge + 0.9))
            grass = weeds(8.0, 1.6, rng.uniform(0.2, 0.6), rng)
            scene.put(grass, s, side * (edge + 2.2))
            for _ in range(rng.poisson(3 * bushes)):
                bush = random_plant("bush", rng, rng.uniform(0.8, 1.7))
                place = s + rng.uniform(0, 8)
                scene.put(bush, place, side * (front + rng.uniform(1, 7)))
            if belt and rng.random() < 0.85:
                height = rng.uniform(0.25, 0.9) * depth
                shrubs = random_hedge(8.4, height, depth, "wild", rng)
                scene.put(shrubs, s - 0.2, middle)
            if rng.random() < 0.45:
                tree = random_plant(pick_name("plants_of_edge", rng), rng)
                place = s + rng.uniform(0, 8)
                scene.put(tree, place, side * (front + rng.uniform(1, 14)))


def furnish_square(
    street: Street,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put rows of trees, benches with sitting people, stalls, a fountain and standing people onto a
    square."""
    front = street.front(side)
    low = -8.0
    high = street.length + 8
    middle = side * (front + 0.5 * PLAZA_DEPTH)
    fountain = make_object("fountain")
    scene.put(fountain, rng.uniform(low + 5, high - 5), middle, solid=3.0)
    for row in (4.0, PLAZA_DEPTH - 5):
        species = pick_name("plants_of_square", rng)
        t = side * (front + row)
        for s in np.arange(low, high, rng.uniform(8, 12)):
            scene.put(random_plant(species, rng), s, t, solid=0.5)
            if rng.random() < 0.6 and scene.is_free(s + 2.5, t, 1.2):
                _put_bench(s + 2.5, t, side, scene, rng)
    for s in np.arange(low + 3, high, rng.uniform(6, 14)):
        t = middle + rng.uniform(-7, 7)
        if scene.is_free(s, t, 2) and rng.random() < 0.6:
            scene.put(stall(rng), s, t, pick((0, np.pi / 2), rng), solid=1.8)
    for s in np.arange(low, high, 1.8):
        if rng.random() < 0.7:
            scene.put(make_object("bollard"), s, side * (front + 0.3), solid=0.2)
    _put_standing_people(low, high, middle, scene, rng)


def _put_bench(
    s: float,
    t: float,
    side: int,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put a bench and, at random, a person on it."""
    yaw = -side * np.pi / 2
    scene.put(make_object("bench"), s, t, yaw, solid=0.9)
    if rng.random() < 0.6:
        colour = pick_colour("clothes", rng)
        scene.park(sitter(), colour, s + rng.uniform(-0.4, 0.4), t, yaw)


def _put_standing_people(
    low: float,
    high: float,
    middle: float,
    scene: Scene,
    rng: Rng,
) -> None:
    """Put people onto a square where it is free."""
    for _ in range(int(rng.integers(4, 14))):
        s = rng.uniform(low, high)
        t = middle + rng.uniform(-14, 14)
        if scene.is_free(s, t, 0.6):
            phase = int(rng.integers(8))
            person = walker(phase, standing=True, bag=rng.random() < 0.3)
            colour = pick_colour("clothes", rng)
            yaw = rng.uniform(0, 6.28)
            scene.park(
                person,
                colour,
                s,
                t,
                yaw,
                rng.uniform(0.9, 1.06),
            )
