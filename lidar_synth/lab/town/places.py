"""Objects of special places: the verges of a road at the edge of town, and the furniture and people
of a square."""

import numpy as np

from lidar_synth.lab.town import furniture
from lidar_synth.lab.town.fences import guard_rail, thicket
from lidar_synth.lab.town.paving import PLAZA_DEPTH
from lidar_synth.lab.town.people import CLOTHES, sitter, walker
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import Street

Rng = np.random.Generator


def edge_of_town(street: Street, side: int, scene: Scene, rng: Rng) -> None:
    """Put high grass, thickets, crash barriers and single trees beside a road at the edge of
    town."""
    sign = 2 * side - 1
    front = street.front(side)
    rail = rng.random() < 0.25
    bushes = rng.uniform(0, 0.8)
    belt = rng.random() < 0.6
    depth = rng.uniform(2, 5)
    away = rng.uniform(2, 7)
    for low, high in street.gaps(side, 2.0):
        for s in np.arange(low, high - 8, 8.0):
            if rail:
                scene.put(guard_rail(8.0), s, sign * (street.edge[side] + 0.9))
            scene.put(
                furniture.weeds(8.0, 1.6, rng.uniform(0.2, 0.6), rng),
                s,
                sign * (street.edge[side] + 2.2),
            )
            for _ in range(rng.poisson(3 * bushes)):
                scene.put(
                    furniture.random_plant("bush", rng, rng.uniform(0.8, 1.7)),
                    s + rng.uniform(0, 8),
                    sign * (front + rng.uniform(1, 7)),
                )
            if belt and rng.random() < 0.85:
                shrubs = thicket(8.4, rng.uniform(0.25, 0.9) * depth, depth, rng)
                scene.put(shrubs, s - 0.2, sign * (front + away + depth / 2))
            if rng.random() < 0.45:
                species = str(rng.choice(["round", "birch", "poplar", "spruce"]))
                scene.put(
                    furniture.random_plant(species, rng),
                    s + rng.uniform(0, 8),
                    sign * (front + rng.uniform(1, 14)),
                )


def square(street: Street, side: int, scene: Scene, rng: Rng) -> None:
    """Put rows of trees, benches with sitting people, stalls, a fountain and standing people onto a
    square."""
    sign = 2 * side - 1
    front = street.front(side)
    low = -8.0
    high = street.length + 8
    middle = sign * (front + 0.5 * PLAZA_DEPTH)
    scene.put(furniture.fountain(), rng.uniform(low + 5, high - 5), middle, solid=3.0)
    for row in (4.0, PLAZA_DEPTH - 5):
        species = str(rng.choice(["round", "poplar"]))
        for s in np.arange(low, high, rng.uniform(8, 12)):
            scene.put(
                furniture.random_plant(species, rng), s, sign * (front + row), solid=0.5
            )
            if rng.random() < 0.6 and scene.is_free(
                s + 2.5, sign * (front + row), (1.2, 1.2)
            ):
                scene.put(
                    furniture.bench(),
                    s + 2.5,
                    sign * (front + row),
                    -sign * np.pi / 2,
                    solid=0.9,
                )
                if rng.random() < 0.6:
                    scene.park(
                        sitter(),
                        CLOTHES[rng.integers(len(CLOTHES))],
                        s + 2.5 + rng.uniform(-0.4, 0.4),
                        sign * (front + row),
                        -sign * np.pi / 2,
                    )
    for s in np.arange(low + 3, high, rng.uniform(6, 14)):
        t = middle + rng.uniform(-7, 7)
        if scene.is_free(s, t, (2, 2)) and rng.random() < 0.6:
            scene.put(furniture.stall(rng), s, t, rng.choice([0, np.pi / 2]), solid=1.8)
    for s in np.arange(low, high, 1.8):
        if rng.random() < 0.7:
            scene.put(furniture.bollard(), s, sign * (front + 0.3), solid=0.2)
    for _ in range(int(rng.integers(4, 14))):
        s = rng.uniform(low, high)
        t = middle + rng.uniform(-14, 14)
        if scene.is_free(s, t, (0.6, 0.6)):
            person = walker(int(rng.integers(8)), standing=True, bag=rng.random() < 0.3)
            scene.park(
                person,
                CLOTHES[rng.integers(len(CLOTHES))],
                s,
                t,
                rng.uniform(0, 6.28),
                rng.uniform(0.9, 1.06),
            )
