"""The parts of the town: meshes, ground, streets, movers, surfaces."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidar_synth.geometry.overlap import overlapping_pairs
from lidar_synth.geometry.scan import Boxes
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.town.bodies import PHASES, cyclist, motorcyclist, sitter, walker
from lidar_synth.lab.town.bodywork import GLASS
from lidar_synth.lab.town.boxes import box_values
from lidar_synth.lab.town.course import Course, Relief
from lidar_synth.lab.town.ego import free_rays
from lidar_synth.lab.town.ground import KINDS, NAMES, TownGround
from lidar_synth.lab.town.materials import MATERIALS, Finish, Finishes
from lidar_synth.lab.town.meshes import (
    Mesh,
    ball,
    boxes,
    cylinder,
    loft,
    merge,
    tube,
)
from lidar_synth.lab.town.movers import ego_place, place_movers
from lidar_synth.lab.town.plants import (
    CORE,
    LEAF,
    SPECIES,
    VARIANTS,
    coarse_plant,
    plant,
)
from lidar_synth.lab.town.returns import ReturnNoise, cell_noise, laser_gains
from lidar_synth.lab.town.solid import Solid
from lidar_synth.lab.town.street import (
    KINDS as STREETS,
    LEFT,
    REACH,
    RIGHT,
    SHARES,
    sample_street,
)
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.town.vehicles import vehicles
from lidar_synth.lab.town.world import STRETCH_FRAMES, WORLD, build_world, rng_for

UP = np.array((0.0, 0.0, 1.0))


def hits(mesh: Mesh, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances to the mesh, inf where rays miss it."""
    return Solid(mesh.triangles).first(
        origins.astype(np.float32), directions.astype(np.float32)
    )[0]


def rays_towards_origin(
    count: int, seed: int = 0, radius: float = 50.0
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of rays from all sides towards the origin."""
    rng = np.random.default_rng(seed)
    start = rng.standard_normal((count, 3))
    start *= radius / np.linalg.norm(start, axis=1, keepdims=True)
    return start, -start / radius


@given(low=st.tuples(*[st.floats(-5, 5)] * 3), size=st.tuples(*[st.floats(0.1, 5)] * 3))
@settings(max_examples=20)
def test_rays_hit_the_faces_of_a_box(
    low: tuple[float, ...], size: tuple[float, ...]
) -> None:
    a = np.array(low)
    b = np.array(low) + np.array(size)
    mesh = boxes([a], [b])
    assert len(mesh) == 12
    middle = (a + b) / 2
    for axis in range(3):
        direction = np.zeros(3)
        direction[axis] = 1.0
        distances = hits(
            mesh, np.array([middle - 20 * direction]), np.array([direction])
        )
        assert np.isclose(distances[0], 20 - size[axis] / 2, atol=1e-3)


@pytest.mark.parametrize(
    "mesh",
    [
        boxes([(-1, -1, -1)], [(1, 1, 1)]),
        ball((0, 0, 0), 1.0, rings=8, sides=12),
        tube([(0, 0, -1), (0, 0, 1)], 1.0, 12),
    ],
)
def test_closed_shapes_let_no_ray_through(mesh: Mesh) -> None:
    assert np.isfinite(hits(mesh, *rays_towards_origin(2000))).all()


def test_a_cylinder_is_open_at_the_bottom_only() -> None:
    mesh = cylinder(1.4, 0.0, 1.0, 4)
    down, up = (np.array([(0.3, 0.2, z)]) for z in (5, -5))
    assert hits(mesh, down, np.array([(0, 0, -1)]))[0] == pytest.approx(4)
    assert hits(mesh, up, np.array([(0, 0, 1)]))[0] == pytest.approx(6)


def test_a_tube_has_the_given_radius() -> None:
    mesh = tube([(0, 0, 0), (2, 0, 0), (4, 0, 0)], 0.5, 24)
    angle = np.linspace(0, 2 * np.pi, 50)
    out = np.stack([0 * angle, np.cos(angle), np.sin(angle)], 1)
    assert np.allclose(5 - hits(mesh, (2, 0, 0) + 5 * out, -out), 0.5, atol=0.006)


@given(yaw=st.floats(-3, 3), scale=st.floats(0.5, 2), x=st.floats(-10, 10))
@settings(max_examples=20)
def test_moved_equals_scaling_and_a_rigid_motion(
    yaw: float, scale: float, x: float
) -> None:
    mesh = vehicles()["sedan"].mesh
    moved = mesh.moved((x, 1, 2), yaw, scale)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, 1, 2
    assert np.allclose(
        moved.triangles, mesh.moved(scale=scale).posed(pose).triangles, atol=1e-4
    )
    assert np.array_equal(moved.slot, mesh.slot)


def test_the_outline_has_the_extent_of_the_mesh() -> None:
    for prototype in (vehicles()["estate"], walker(1), cyclist(0)):
        low, high = prototype.mesh.bounds
        assert np.abs(prototype.mesh.outline.min(0) - low).max() < 0.06
        assert np.abs(prototype.mesh.outline.max(0) - high).max() < 0.06


def test_vehicles_have_plausible_shapes() -> None:
    kinds = vehicles()
    for kind, prototype in kinds.items():
        low, high = prototype.mesh.bounds
        assert low[2] == pytest.approx(0, abs=0.31), kind
        assert prototype.mesh.slot.max() < len(prototype.finishes)
        assert np.isfinite(prototype.mesh.triangles).all()
        assert abs(high[1] + low[1]) < 0.02, f"{kind} leans"
    for kind in ("hatchback", "sedan", "estate", "van", "bus"):
        mesh = kinds[kind].mesh
        glass = mesh.slot == GLASS
        assert glass.any()
        heights = mesh.triangles[glass][..., 2]
        assert heights.min() > 0.3 * mesh.bounds[1][2]
    # Bonnet and boot are lower than the roof, and a low ray across the middle passes between the
    # wheels.
    car = kinds["sedan"].mesh
    front, roof, boot = 5 - hits(
        car,
        np.array([(x, 0.0, 5.0) for x in (1.8, 0.0, -2.1)]),
        np.tile((0, 0, -1), (3, 1)),
    )
    assert front < 1.0 < roof and boot < roof - 0.2
    assert np.isinf(hits(car, np.array([(0.0, -5.0, 0.1)]), np.array([(0, 1, 0)])))[0]


def test_people_touch_the_ground_and_have_plausible_heights() -> None:
    for prototype in [
        *(walker(p) for p in range(PHASES)),
        walker(0, True),
        cyclist(3),
        motorcyclist(),
        sitter(),
    ]:
        low, high = prototype.mesh.bounds
        assert -0.03 < low[2] < 0.09
        assert 1.2 < high[2] < 1.95
    shapes = [walker(p).mesh.triangles for p in range(PHASES)]
    assert all(np.abs(a - b).max() > 0.05 for a, b in pairwise(shapes))


@pytest.mark.parametrize("species", sorted(SPECIES))
def test_rays_enter_the_crown_of_a_plant(species: str) -> None:
    for variant in range(VARIANTS):
        mesh = plant(species, variant)
        assert len(coarse_plant(species, variant)) < 0.7 * len(mesh)
        low, high = mesh.bounds
        middle = np.array((0, 0, 0.6 * high[2]))
        start, directions = rays_towards_origin(3000, variant)
        side = np.abs(directions[:, 2]) < 0.3
        distances = hits(mesh, start[side] + middle, directions[side])
        depth = 50 - distances[np.isfinite(distances)]
        # Some rays end outside, some deep inside; with a smooth surface, all would end at the same
        # depth.
        assert (
            len(depth) > 0.2 * side.sum()
            and depth.std() > 0.015 * (high - low)[:2].mean()
        )
    assert np.isin(plant(species, 0).slot, (LEAF, CORE)).mean() > 0.5


def test_street_coordinates_preserve_lengths_along_the_centre_line() -> None:
    course = Course(-100, 200, 1 / 150, np.random.default_rng(1))
    s = np.linspace(-150, 250, 4001)
    points = course.points(s, 0.0)
    assert np.allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.1, atol=0.012)
    left = course.points(s, 4.0) - points
    assert np.allclose(np.linalg.norm(left, axis=1), 4)
    ahead = np.stack([np.cos(course.heading(s)), np.sin(course.heading(s))], 1)
    assert np.allclose((left * ahead).sum(1), 0, atol=1e-9)


@pytest.mark.parametrize("stretch", [0, 1, 6])
def test_the_mesh_of_the_ground_matches_its_height_and_kind(stretch: int) -> None:
    world = build_world(0, stretch, 0.4)
    ground = world.scene.ground
    rng = np.random.default_rng(0)
    s = rng.uniform(-40, world.street.length + 40, 3000)
    t = rng.uniform(-25, 25, 3000)
    kind = ground.kind(s, t)
    paved = np.isin(
        kind,
        [
            NAMES.index(k)
            for k in ("road", "old_road", "marking", "parking", "sidewalk", "cycleway")
        ],
    )
    corners = np.zeros(len(s), bool)
    for c in ground.corners:
        corners |= (np.abs(s - c.s) < c.radius + 0.3) & (
            np.abs(t - c.t) < c.radius + 0.3
        )
    keep = paved & ~corners
    mesh = ground.mesh(np.random.default_rng(0))
    points = ground.points(s[keep], t[keep])
    # No ground lies above the points, and the first hit below is the expected surface.
    distances = hits(mesh, points + UP * 30, np.tile((0, 0, -1.0), (len(points), 1)))
    assert keep.sum() > 500
    assert np.abs(30 - distances).max() < 0.16
    assert np.percentile(np.abs(30 - distances), 97) < 0.02
    slot = mesh.slot[
        Solid(mesh.triangles).first(
            (points + UP * 30).astype(np.float32),
            np.tile(np.float32([0, 0, -1]), (len(points), 1)),
        )[1]
    ]
    assert (slot == kind[keep]).mean() > 0.97


def test_the_ground_has_no_holes() -> None:
    world = build_world(0, 0, 0.4)
    mesh = world.scene.ground.mesh(np.random.default_rng(0))
    rng = np.random.default_rng(0)
    points = world.scene.ground.points(
        rng.uniform(-80, 110, 20_000), rng.uniform(-80, 80, 20_000)
    )
    distances = hits(mesh, points + UP * 50, np.tile((0, 0, -1.0), (len(points), 1)))
    assert np.isinf(distances).sum() <= 2


def test_a_kerb_closes_the_step_between_road_and_pavement() -> None:
    rng = np.random.default_rng(0)
    road = NAMES.index("road")
    pavement = NAMES.index("sidewalk")
    rects = [(-50.0, 50.0, -20.0, 20.0, pavement), (-50.0, 50.0, -3.0, 3.0, road)]
    ground = TownGround(
        Course(-50, 50, 0, rng),
        Relief(0.0, rng),
        {RIGHT: 3, LEFT: 3},
        (-60, 60, -60, 60),
        (-50, 50),
        rects,
        [],
    )
    step = float(ground.height(0, 3.01) - ground.height(0, 2.99))
    assert step == pytest.approx(KINDS["sidewalk"].lift, abs=1e-3)
    low = ground.points(0.0, 0.0) + UP * (step / 2 - 0.018 * 3)
    heading = float(ground.course.heading(0.0))
    across = np.array([[-np.sin(heading), np.cos(heading), 0.0]])
    assert hits(ground.mesh(rng), low[None], across)[0] == pytest.approx(3.0, abs=1e-3)


@pytest.mark.parametrize("kind", STREETS)
def test_sampled_streets_of_a_kind_vary_and_are_valid(kind: str) -> None:
    streets = [sample_street(kind, 7.6, np.random.default_rng(k)) for k in range(20)]
    assert len({repr((s.edge, s.parking, len(s.crossings))) for s in streets}) > 10
    for street in streets:
        assert street.kind == kind and street.length > 20
        assert (
            -street.edge[RIGHT] < street.lanes[0].t < 0
            and street.lanes[0].direction == 1
        )
        for lane in street.lanes:
            assert -street.edge[RIGHT] < lane.t < street.edge[
                LEFT
            ] and lane.direction == (1 if lane.t < 0 else -1)
        assert street.ends[0] < -20 and street.ends[1] > street.length + 20
        if kind == "junction":
            assert any(
                c.sides == (RIGHT, LEFT) and 0 < c.s < street.length + 20
                for c in street.crossings
            )


@pytest.mark.parametrize("interval", [0.1, 0.4, 2.0, 4.0, 20.0])
def test_no_scan_leaves_its_stretch_of_road(interval: float) -> None:
    town = Town(interval=interval)
    assert (town.apart == 1000) == (interval <= 2)
    times = np.arange(STRETCH_FRAMES) * interval
    for number in range(60):
        kind = STREETS[number % len(STREETS)]
        street = sample_street(kind, times[-1], np.random.default_rng(number))
        beside = [abs(ego_place(street, time)[1]) for time in times]
        assert max(beside) <= REACH
        assert street.length + 2 * town.sensor.range_max < town.apart


def test_all_kinds_of_street_are_sampled() -> None:
    assert {
        str(rng_for(WORLD, 0, k).choice(STREETS, p=SHARES)) for k in range(40)
    } == set(STREETS)
    assert sum(SHARES) == pytest.approx(1)


def test_no_ray_passes_through_the_ego_vehicle() -> None:
    x, y, _ = Town(7, "os0_128", 1, motion=False)[0].points.T
    assert not ((np.abs(x) < 2.3) & (np.abs(y) < 0.9)).any()


@pytest.mark.parametrize("name", ["town", "os1_128", "pandar64"])
def test_lasers_alternate_between_two_sides_on_an_hdl64e_only(name: str) -> None:
    """Its mounts block every other row at the edges of their two shadows."""
    sensor = load_sensor(name)
    # As a fit gives them to any sensor.
    fitted = replace(sensor, heights=sensor.heights or (0.01,) * sensor.shape[0])
    for blocked in (~free_rays(sensor), ~free_rays(fitted)):
        comb = blocked[:-2] & ~blocked[1:-1] & blocked[2:]
        assert comb.any() == (name == "town")


def test_movers_do_not_collide() -> None:
    world = max((build_world(0, k, 0.4) for k in (0, 7)), key=lambda w: len(w.movers))
    assert len(world.movers) > 15
    for time in 0.4 * np.arange(STRETCH_FRAMES):
        extents = []
        for mover in world.movers:
            s, t, yaw = mover.place(time)
            low, high = mover.shape(time).mesh.bounds
            half = mover.scale * (high - low)[:2] / 2
            extents.append((s, t, *(half if abs(np.cos(yaw)) > 0.5 else half[::-1])))
        s, t, half_s, half_t = np.array(extents).T
        overlap = (np.abs(s[:, None] - s) < half_s[:, None] + half_s) & (
            np.abs(t[:, None] - t) < half_t[:, None] + half_t
        )
        assert not (overlap & ~np.eye(len(s), dtype=bool)).any()


@pytest.mark.parametrize("stretch", range(4))
def test_traffic_keeps_to_the_right(stretch: int) -> None:
    """To the left of a driver, the middle of the street is at t = 0, of a side street at its s."""
    world = build_world(0, stretch, 0.4)
    drivers = [
        m for m in world.movers if m.shapes[0].name not in ("Pedestrian", "Tram")
    ]
    assert {m.line.along for m in drivers} == {True, False}
    for _, at, _, direction, _ in (m.line for m in drivers if m.line.along):
        assert at * direction < 0
    for _, at, _, direction, _ in (m.line for m in drivers if not m.line.along):
        middle = min((c.s for c in world.street.crossings), key=lambda s: abs(at - s))
        assert (at - middle) * direction > 0
    if world.street.turn:
        crossing, side = world.street.turn
        at, *_ = ego_place(world.street, 100.0)
        assert (at - crossing.s) * side == pytest.approx(crossing.half / 2)


@pytest.mark.parametrize("stretch", [1, 7])
def test_nothing_moves_or_stands_in_a_parked_vehicle(stretch: int) -> None:
    """In stretch 1 bicycles are parked in rows, in stretch 7 cars on a side street with traffic."""
    world = build_world(7, stretch, 0.4)
    for time in (0.0, 2.0, 4.0):
        movers = place_movers(world.movers, world.scene, time, (0, 0), 200)
        objects = [*world.scene.placed, *movers]
        rows = np.array([box_values(o, o.pose) for o in objects], np.float32)
        names = tuple(o.prototype.name for o in objects)
        assert overlapping_pairs(Boxes(rows, names)) == []


def test_surfaces_are_frozen_into_columns() -> None:
    surfaces = Finishes()
    dark = surfaces.add(Finish("paint", (0.03, 0.03, 0.03)), 10, 7)
    white = surfaces.add(Finish("paint", (0.9, 0.9, 0.9)), 10, 8)
    road = surfaces.add(Finish("asphalt"), 40)
    table = surfaces.freeze()
    assert table.instance.tolist() == [7, 8, 0] and table.raw.tolist() == [10, 10, 40]
    assert table.reflectance[dark] < 0.1 < table.reflectance[white]
    assert table.reflectance[road] == np.float32(MATERIALS["asphalt"].reflectance)


def test_cell_noise_is_uniform_and_constant_within_a_cell() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-50, 50, (50_000, 3)).astype(np.float32)
    value = cell_noise(points, 0.5)
    assert value.min() >= 0 and value.max() < 1
    assert np.abs(np.histogram(value, 10, (0, 1))[0] / 50_000 - 0.1).max() < 0.01
    centre = (np.floor(points / 0.5) + 0.5) * np.float32(0.5)
    assert np.array_equal(value, cell_noise(centre, 0.5))


def test_laser_gains_are_fixed_for_a_sensor() -> None:
    from lidar_synth.geometry.sensor import load_sensor

    sensor = load_sensor("town")
    gains = laser_gains(sensor, ReturnNoise())
    assert np.array_equal(
        gains, laser_gains(sensor, ReturnNoise())
    ) and gains.shape == (64,)
    assert 0.9 < gains.mean() < 1.2 and gains.std() > 0.05


def test_merging_concatenates_triangles_and_slots() -> None:
    parts = [boxes([(0, 0, 0)], [(1, 1, 1)], slot) for slot in (1, 2)]
    merged = merge(parts)
    assert len(merged) == 24 and merged.slot.tolist() == [1] * 12 + [2] * 12
    assert len(merge([])) == 0
    assert len(loft(np.zeros((3, 4, 3)), np.arange(6).reshape(2, 3))) == 12
