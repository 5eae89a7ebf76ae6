"""The traffic of a stretch: vehicles, pedestrians and cyclists.

Every mover has a constant s or t and moves along the other coordinate at constant speed. A sampled
mover is discarded if it would collide with an earlier mover or, where ``solid`` is set, with a
static obstacle in any frame.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.bodywork import PAINTS
from lidar_synth.lab.town.furnish import sample_vehicle
from lidar_synth.lab.town.materials import RGB
from lidar_synth.lab.town.movers import Mover, ego_place
from lidar_synth.lab.town.paving import PLAZA_DEPTH
from lidar_synth.lab.town.people import CLOTHES, PHASES, cyclist, motorcyclist, walker
from lidar_synth.lab.town.prototype import Prototype
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import LEFT, RIGHT, Street
from lidar_synth.lab.town.vehicles import vehicles

Rng = np.random.Generator
_DRIVEN = {
    "hatchback": 0.16,
    "compact": 0.16,
    "small": 0.08,
    "sedan": 0.11,
    "old_sedan": 0.02,
    "estate": 0.14,
    "suv": 0.09,
    "mpv": 0.08,
    "minivan": 0.04,
    "van": 0.04,
    "panel_van": 0.03,
    "box_lorry": 0.025,
    "small_lorry": 0.02,
    "bus": 0.02,
    "flatbed": 0.01,
}


Array = NDArray[np.float64]


def _track(
    shape: Prototype,
    along: bool,
    at: float,
    start: float,
    velocity: float,
    times: Array,
    gap: float,
) -> Array:
    """(T, 4) bounds (lowest s, highest s, lowest t, highest t) of a moving shape at each time,
    metres."""
    low, high = shape.mesh.bounds
    half = (np.abs([low[:2], high[:2]]).max(0) + gap)[:: 1 if along else -1]
    moving = start + velocity * times
    constant = np.full(len(times), at)
    s, t = (moving, constant) if along else (constant, moving)
    return np.stack([s - half[0], s + half[0], t - half[1], t + half[1]], 1)


def _ego_track(street: Street, times: Array) -> Array:
    """The track of the ego vehicle, 4.7 m long and 1.8 m wide, with a margin of 1.2 m."""
    s, t, yaw = np.array([ego_place(street, time) for time in times]).T
    along = np.abs(np.cos(yaw))
    across = np.abs(np.sin(yaw))
    half_s = 2.35 * along + 0.9 * across + 1.2
    half_t = 2.35 * across + 0.9 * along + 1.2
    return np.stack([s - half_s, s + half_s, t - half_t, t + half_t], 1)


class Traffic:
    """All movers of a stretch.

    Args:
        street, scene: the stretch.
        times: (T,) seconds, the times of the frames, at which movers must not collide.
        rng: samples them.
    """

    def __init__(self, street: Street, scene: Scene, times: Array, rng: Rng) -> None:
        self._street = street
        self._scene = scene
        self._times = times
        self._rng = rng
        self._tracks = [_ego_track(street, times)]
        self.movers: list[Mover] = []
        self._add_vehicles()
        self._add_side_traffic()
        self._add_pedestrians()
        self._add_cyclists()

    def _add(
        self,
        shapes: tuple[Prototype, ...],
        colour: RGB,
        along: bool,
        at: float,
        start: float,
        direction: int,
        speed: float,
        gap: float,
        stride: float = 1.0,
        scale: float = 1.0,
        solid: bool = False,
    ) -> None:
        """Add a mover unless it would collide with another one or, if ``solid``, with a static
        obstacle.

        ``colour`` is that of its paint or clothes, and ``gap`` the margin around it in metres; the
        other arguments are those of ``Mover``.
        """
        track = _track(shapes[0], along, at, start, direction * speed, self._times, gap)
        low, high = self._street.ends
        if (
            track[:, 0].min() < low
            or track[:, 1].max() > high
            or any(_overlap(track, other) for other in self._tracks)
        ):
            return
        if solid:
            footprints = np.array(self._scene.footprints).reshape(-1, 1, 4)
            if len(footprints) and _overlap(track[None], footprints):
                return
        self._tracks.append(track)
        instance, surfaces = self._scene.add_instance(
            shapes[0], colour, moving=speed > 0
        )
        self.movers.append(
            Mover(
                shapes,
                stride,
                along,
                at,
                start,
                direction,
                speed,
                instance,
                surfaces,
                scale,
            )
        )

    def _sample_mover(self) -> tuple[tuple[Prototype, ...], RGB]:
        """A sampled vehicle or motorcyclist: its prototypes and its colour."""
        rng = self._rng
        if rng.random() < 0.04:
            return (motorcyclist(),), CLOTHES[rng.integers(len(CLOTHES))]
        return (vehicles()[sample_vehicle(rng, _DRIVEN)],), PAINTS[
            rng.integers(len(PAINTS))
        ]

    def _add_vehicles(self) -> None:
        """Add vehicles on the lanes of the stretch, and a tram on its rails."""
        street = self._street
        rng = self._rng
        density = {
            "residential": 0.25,
            "main": 0.6,
            "junction": 0.55,
            "square": 0.4,
            "edge": 0.4,
        }[street.kind]
        for lane in street.lanes:
            mean = street.speed * rng.uniform(0.9, 1.15)
            s = rng.uniform(-70, -40)
            while s < street.length + 150:
                if rng.random() < density:
                    shapes, colour = self._sample_mover()
                    speed = street.speed if lane == street.lanes[0] else mean
                    self._add(
                        shapes,
                        colour,
                        True,
                        lane.t + rng.normal(0, 0.12),
                        s if lane.direction > 0 else street.length - s,
                        lane.direction,
                        speed,
                        0.6,
                    )
                s += rng.uniform(9, 40)
        if street.median > 2.2 and rng.random() < 0.6:
            self._add(
                (vehicles()["tram"],),
                (0.85, 0.75, 0.15),
                True,
                0.0,
                rng.uniform(-50, street.length + 60),
                int(rng.choice([-1, 1])),
                7.0,
                0.1,
            )

    def _add_side_traffic(self) -> None:
        """Add vehicles on side streets, waiting at the stop line or driving away."""
        street = self._street
        rng = self._rng
        for c in street.crossings:
            for side in c.sides:
                sign = 2 * side - 1
                stop = street.edge[side] + 4.2
                for k in range(rng.poisson(1.2 if street.kind == "junction" else 0.5)):
                    shapes, colour = self._sample_mover()
                    self._add(
                        shapes,
                        colour,
                        False,
                        c.s - sign * c.half / 2,
                        sign * (stop + 7.5 * k),
                        -sign,
                        0.0,
                        0.4,
                    )
                if rng.random() < 0.7:
                    shapes, colour = self._sample_mover()
                    start = sign * (street.edge[side] + rng.uniform(5, 40))
                    self._add(
                        shapes,
                        colour,
                        False,
                        c.s + sign * c.half / 2,
                        start,
                        sign,
                        rng.uniform(4, 9),
                        0.5,
                    )

    def _add_pedestrians(self) -> None:
        """Add pedestrians on pavements, on squares and crossing the street."""
        street = self._street
        rng = self._rng
        strips = []
        for side in (RIGHT, LEFT):
            pavement = street.band(side, "sidewalk")
            if pavement:
                strips.append(
                    (
                        side,
                        pavement[0] + 0.3,
                        pavement[1] - 0.3,
                        {"residential": 4, "edge": 1}.get(street.kind, 9),
                    )
                )
            if street.plaza == side:
                strips.append(
                    (
                        side,
                        street.front(side) + 1,
                        street.front(side) + PLAZA_DEPTH - 2,
                        16,
                    )
                )
        for side, low, high, mean in strips:
            for _ in range(rng.poisson(mean)):
                sign = 2 * side - 1
                self._add_pedestrian(
                    True,
                    sign * rng.uniform(low, max(low, high)),
                    rng.uniform(-50, street.length + 60),
                )
        for _ in range(
            rng.poisson({"residential": 1, "edge": 0.2}.get(street.kind, 3))
        ):
            self._add_pedestrian(
                False, rng.uniform(-10, street.length + 40), rng.uniform(-10, 10)
            )

    def _add_pedestrian(self, along: bool, at: float, start: float) -> None:
        """Add a pedestrian; some of those along the street stand."""
        rng = self._rng
        bag = bool(rng.random() < 0.3)
        standing = along and bool(rng.random() < 0.2)
        shapes = tuple(
            walker(p, standing, bag) for p in range(1 if standing else PHASES)
        )
        scale = rng.uniform(0.6, 0.8) if rng.random() < 0.12 else rng.uniform(0.9, 1.08)
        direction = int(rng.choice([-1, 1]))
        speed = 0.0 if standing else rng.uniform(0.9, 1.7)
        colour = CLOTHES[rng.integers(len(CLOTHES))]
        self._add(
            shapes,
            colour,
            along,
            at,
            start,
            direction,
            speed,
            0.25,
            1.4 * scale,
            scale,
            solid=True,
        )

    def _add_cyclists(self) -> None:
        """Add cyclists on cycleways or at the right edge of the carriageway."""
        street = self._street
        rng = self._rng
        shapes = tuple(cyclist(p) for p in range(PHASES))
        for side, direction in ((RIGHT, 1), (LEFT, -1)):
            own = street.band(side, "cycleway")
            sign = 2 * side - 1
            kerb = street.edge[side] - (
                2.9 if street.parking[side] == "street" else 0.7
            )
            for _ in range(rng.poisson(2.2 if own else 1.1)):
                at = sign * ((own[0] + own[1]) / 2 if own else kerb)
                self._add(
                    shapes,
                    CLOTHES[rng.integers(len(CLOTHES))],
                    True,
                    at,
                    rng.uniform(-40, street.length + 50),
                    direction,
                    rng.uniform(3, 6.5),
                    0.4,
                    4.0,
                    solid=True,
                )


def _overlap(a: Array, b: Array) -> bool:
    """Whether two tracks (..., 4) overlap at any time."""
    return bool(
        (
            (a[..., 0] < b[..., 1])
            & (a[..., 1] > b[..., 0])
            & (a[..., 2] < b[..., 3])
            & (a[..., 3] > b[..., 2])
        ).any()
    )
