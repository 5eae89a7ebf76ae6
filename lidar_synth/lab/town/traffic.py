"""The traffic of a stretch: vehicles, pedestrians and cyclists.

Every mover has a constant s or t and moves along the other coordinate at constant speed. A sampled
mover is discarded if it would collide with an earlier mover or, where ``solid`` is set, with a
static obstacle in any frame.
"""

from collections.abc import Iterator

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.bodies import PHASES, cyclist, motorcyclist, walker
from lidar_synth.lab.town.catalogue import RGB, Rng, pick, pick_colour, pick_name
from lidar_synth.lab.town.movers import Line, Mover, ego_place
from lidar_synth.lab.town.objects import Prototype
from lidar_synth.lab.town.paving import PLAZA_DEPTH
from lidar_synth.lab.town.scene import Scene
from lidar_synth.lab.town.street import SIDES, SideStreet, Street
from lidar_synth.lab.town.vehicles import vehicles


def _track(
    shape: Prototype,
    line: Line,
    times: Float64Array,
    gap: float,
) -> Float64Array:
    """(T, 4) bounds (lowest s, highest s, lowest t, highest t) of a moving shape at each time,
    metres."""
    low, high = shape.mesh.bounds
    half = np.abs([low[:2], high[:2]]).max(0) + gap
    moving = line.start + line.direction * line.speed * times
    track = _bounds(moving, np.full(len(times), line.at), *half)
    return track if line.along else track[:, [2, 3, 0, 1]]


def _bounds(
    s: Float64Array,
    t: Float64Array,
    half_s: Float64Array,
    half_t: Float64Array,
) -> Float64Array:
    return np.stack([s - half_s, s + half_s, t - half_t, t + half_t], 1)


def _ego_track(street: Street, times: Float64Array) -> Float64Array:
    """The track of the ego vehicle, 4.7 m long and 1.8 m wide, with a margin of 1.2 m."""
    s, t, yaw = np.array([ego_place(street, time) for time in times]).T
    along = np.abs(np.cos(yaw))
    across = np.abs(np.sin(yaw))
    half_s = 2.35 * along + 0.9 * across + 1.2
    half_t = 2.35 * across + 0.9 * along + 1.2
    return _bounds(s, t, half_s, half_t)


def _find_strips(street: Street) -> Iterator[tuple[int, float, float, float]]:
    """Where people walk along the street: side, lowest and highest |t|, mean number of people."""
    for side in SIDES:
        if pavement := street.band(side, "sidewalk"):
            low, high = pavement
            yield side, low + 0.3, high - 0.3, street.row["walking"]
        if street.plaza == side:
            front = street.front(side)
            yield side, front + 1, front + PLAZA_DEPTH - 2, 16


class Traffic:
    """All movers of a stretch.

    Args:
        street, scene: the stretch.
        times: (T,) seconds, the times of the frames, at which movers must not collide.
        rng: samples them.
    """

    def __init__(
        self,
        street: Street,
        scene: Scene,
        times: Float64Array,
        rng: Rng,
    ) -> None:
        self._street = street
        self._scene = scene
        self._times = times
        self._rng = rng
        self._tracks = [_ego_track(street, times)]
        self.movers: list[Mover] = []
        for lane in street.lanes:
            self._add_vehicles(*lane)
        if street.median > 2.2 and rng.random() < 0.6:
            self._add_tram()
        for c in street.crossings:
            for side in c.sides:
                self._add_side_traffic(c, side)
        self._add_pedestrians()
        for side in SIDES:
            self._add_cyclists(side)

    def _add(
        self,
        shapes: tuple[Prototype, ...],
        colour: RGB,
        line: Line,
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
        track = _track(shapes[0], line, self._times, gap)
        low, high = self._street.ends
        if track[:, 0].min() < low or track[:, 1].max() > high:
            return
        if any(_overlap(track, other) for other in self._tracks):
            return
        if solid and _overlap(
            track, np.array(self._scene.footprints).reshape(-1, 1, 4)
        ):
            return
        self._tracks.append(track)
        instance, surfaces = self._scene.add_instance(
            shapes[0], colour, moving=line.speed > 0
        )
        self.movers.append(
            Mover(
                shapes,
                stride,
                line,
                instance,
                surfaces,
                scale,
            )
        )

    def _sample_mover(self) -> tuple[tuple[Prototype, ...], RGB]:
        """A sampled vehicle or motorcyclist: its prototypes and its colour."""
        rng = self._rng
        if rng.random() < 0.04:
            return (motorcyclist(),), pick_colour("clothes", rng)
        kind = vehicles()[pick_name("driven", rng)]
        return (kind,), pick_colour("paints", rng)

    def _add_vehicles(self, t: float, direction: int) -> None:
        """Add vehicles on a lane of the stretch."""
        street = self._street
        rng = self._rng
        speed = street.speed * rng.uniform(0.9, 1.15)
        if (t, direction) == street.lanes[0]:
            speed = street.speed
        s = rng.uniform(-70, -40)
        while s < street.length + 150:
            if rng.random() < street.row["traffic"]:
                shapes, colour = self._sample_mover()
                place = t + rng.normal(0, 0.12)
                start = s if direction > 0 else street.length - s
                line = Line(True, place, start, direction, speed)
                self._add(shapes, colour, line, 0.6)
            s += rng.uniform(9, 40)

    def _add_tram(self) -> None:
        """Add a tram on its rails."""
        rng = self._rng
        start = rng.uniform(-50, self._street.length + 60)
        line = Line(True, 0.0, start, pick((-1, 1), rng), 7.0)
        self._add((vehicles()["tram"],), (0.85, 0.75, 0.15), line, 0.1)

    def _add_side_traffic(self, c: SideStreet, side: int) -> None:
        """Add vehicles on a side street, waiting at the stop line or driving away."""
        rng = self._rng
        edge = self._street.edge[side]
        aside = side * c.half / 2
        for k in range(rng.poisson(1.2 if self._street.kind == "junction" else 0.5)):
            shapes, colour = self._sample_mover()
            t = side * (edge + 4.2 + 7.5 * k)
            line = Line(False, c.s - aside, t, -side, 0.0)
            self._add(shapes, colour, line, 0.4, solid=True)
        if rng.random() < 0.7:
            shapes, colour = self._sample_mover()
            start = side * (edge + rng.uniform(5, 40))
            line = Line(False, c.s + aside, start, side, rng.uniform(4, 9))
            self._add(shapes, colour, line, 0.5, solid=True)

    def _add_pedestrians(self) -> None:
        """Add pedestrians on pavements, on squares and crossing the street."""
        street = self._street
        rng = self._rng
        for side, low, high, mean in _find_strips(street):
            for _ in range(rng.poisson(mean)):
                t = side * rng.uniform(low, max(low, high))
                self._add_pedestrian(True, t, rng.uniform(-50, street.length + 60))
        for _ in range(rng.poisson(street.row["crossing"])):
            s = rng.uniform(-10, street.length + 40)
            self._add_pedestrian(False, s, rng.uniform(-10, 10))

    def _add_pedestrian(self, along: bool, at: float, start: float) -> None:
        """Add a pedestrian; some of those along the street stand."""
        rng = self._rng
        bag = rng.random() < 0.3
        standing = along and rng.random() < 0.2
        phases = range(1 if standing else PHASES)
        shapes = tuple(walker(p, standing, bag) for p in phases)
        child = rng.random() < 0.12
        scale = rng.uniform(0.6, 0.8) if child else rng.uniform(0.9, 1.08)
        direction = pick((-1, 1), rng)
        speed = 0.0 if standing else rng.uniform(0.9, 1.7)
        line = Line(along, at, start, direction, speed)
        colour = pick_colour("clothes", rng)
        self._add(
            shapes,
            colour,
            line,
            0.25,
            1.4 * scale,
            scale,
            solid=True,
        )

    def _add_cyclists(self, side: int) -> None:
        """Add cyclists on the cycleway of a side or at the edge of the carriageway."""
        street = self._street
        rng = self._rng
        shapes = tuple(cyclist(p) for p in range(PHASES))
        own = street.band(side, "cycleway")
        t = street.edge[side] - (2.9 if street.parking[side] == "street" else 0.7)
        if own:
            t = sum(own) / 2
        for _ in range(rng.poisson(2.2 if own else 1.1)):
            colour = pick_colour("clothes", rng)
            start = rng.uniform(-40, street.length + 50)
            line = Line(True, side * t, start, -side, rng.uniform(3, 6.5))
            self._add(
                shapes,
                colour,
                line,
                0.4,
                4.0,
                solid=True,
            )


def _overlap(a: Float64Array, b: Float64Array) -> bool:
    """Whether two tracks (..., 4) overlap at any time."""
    s = (a[..., 0] < b[..., 1]) & (a[..., 1] > b[..., 0])
    t = (a[..., 2] < b[..., 3]) & (a[..., 3] > b[..., 2])
    return bool((s & t).any())
