"""Objects set into scans: what a sensor would have seen if they had been there, and nothing
else."""

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from box_scenes import CAR, HEIGHT, SENSOR, WALL, car, cast, wall
from hypothesis import assume, example, given, settings
from pasting import assert_nothing_shares_a_ray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import DataError
from lidar_synth.geometry.assign import assign_beams
from lidar_synth.geometry.projection import locate, project
from lidar_synth.geometry.scan import SYNTHETIC, Boxes
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.town import Town
from lidar_synth.labels import Object, objects_of, paste
from lidar_synth.labels.merge import merge_scans
from lidar_synth.labels.pasting import LIFT, paste_groups, update_occlusion

places = st.tuples(st.floats(5, 30), st.floats(-180, 180), st.floats(-3.1, 3.1))


def at(place: tuple[float, float, float], ground: float = -HEIGHT) -> np.ndarray:
    """A car at a distance, in a direction (degrees), with a yaw."""
    distance, direction, yaw = place
    return car(
        distance * np.cos(np.radians(direction)),
        distance * np.sin(np.radians(direction)),
        yaw,
        ground,
    )


def seen(box: np.ndarray, ground: float = -HEIGHT) -> Object:
    """A car as the sensor sees it alone in the world."""
    [found] = objects_of(cast([box], ground=ground)).values()
    return found


@settings(max_examples=25)
# the foot of a wall in the cells where the car meets the ground
@example((22.0, 0.0, 1.0), [(20.0, 1.0)])
@given(places, st.lists(st.tuples(st.floats(4, 40), st.floats(-180, 180)), max_size=3))
def test_a_pasted_car_looks_as_the_sensor_would_see_it(
    place: tuple[float, float, float], walls: list[tuple[float, float]]
) -> None:
    box = at(place)
    around = [
        wall(d * np.cos(np.radians(a)), d * np.sin(np.radians(a)), np.radians(a) + 1.2)
        for d, a in walls
    ]
    empty = cast([], around)
    true = cast([box], around)
    pasted = paste(empty, [seen(box)])
    assume(pasted.boxes is not None and len(pasted.boxes) == 1)
    expected = project(true)
    got = project(pasted)
    assert len(pasted) == len(true)
    assert np.allclose(expected.range, got.range, atol=1e-4)
    for name in ("label", "instance"):
        assert np.array_equal(expected.channels[name], got.channels[name])
    assert np.allclose(pasted.boxes.values, box, atol=5e-3)
    assert_nothing_shares_a_ray(pasted, 1)


def test_most_places_are_taken() -> None:
    """The property above must not hold for want of cars."""
    rng = np.random.default_rng(0)
    placed = 0
    for _ in range(20):
        box = at((rng.uniform(5, 30), rng.uniform(-180, 180), rng.uniform(-3, 3)))
        placed += len(paste(cast(), [seen(box)]).boxes or ())
    assert placed == 20


@pytest.mark.parametrize(("apart", "placed"), [(0.1, 1), (0.3, 2)])
def test_pasted_objects_keep_their_distance(apart: float, placed: int) -> None:
    """Cars side by side, 1.8 m wide."""
    cars = [seen(car(15, y)) for y in (0.0, 1.8 + apart)]
    assert len(paste(cast(), cars).boxes or ()) == placed


@pytest.mark.parametrize("x", [-8.0, 8.0])
def test_a_car_across_the_seam_is_whole(x: float) -> None:
    pasted = paste(cast(), [seen(car(x, 0, 1.0))])
    assert len(pasted) == len(cast([car(x, 0, 1.0)]))
    assert_nothing_shares_a_ray(pasted, 1)


@pytest.mark.parametrize("ground", [-2.3, -1.5])
@pytest.mark.parametrize("labelled", [True, False])
def test_a_pasted_object_stands_on_the_ground(ground: float, labelled: bool) -> None:
    host = cast(ground=ground)
    host = host if labelled else replace(host, label=None, instance=None)
    candidate = seen(car(22, 5, 0.4))
    pasted = paste(host, [candidate])
    assert pasted.boxes is not None and pasted.instance is not None
    lowered = candidate.scan.points + np.array(
        [0, 0, pasted.boxes.values[0, 2] - candidate.box[2]], np.float32
    )
    cells = np.unique(locate(lowered, SENSOR).cell)
    # The ground before it hides not even its lowest row.
    assert (pasted.instance == 1).sum() == len(cells)
    assert pasted.boxes.values[0, 2] - pasted.boxes.values[0, 5] / 2 == pytest.approx(
        ground, abs=0.02
    )
    assert_nothing_shares_a_ray(pasted, 1)


def test_a_pasted_object_stands_on_a_slope() -> None:
    host = cast()
    rise = 0.15
    host.points[:, 2] += rise * host.points[:, 0]
    pasted = paste(host, [seen(car(5, 2))])
    assert pasted.boxes is not None
    assert pasted.boxes.values[0, 2] - 0.8 == pytest.approx(rise * 5 - HEIGHT, abs=0.03)


def test_an_object_is_not_placed_without_suitable_ground() -> None:
    candidate = seen(car(12, 0))
    for host in (
        cast([], [wall(12, 0.5)]),  # a wall through it
        cast([], [wall(13.5, 0, np.pi / 2, 1)]),  # a post in its rear
        cast([], [wall(6, 0, np.pi / 2, 40)]),  # behind a long wall
        cast([car(12, 1.5)]),  # beside a car, nearer than anybody parks
        cast(
            ground=-HEIGHT - LIFT - 0.2
        ),  # on ground so low that it would be seen from above
        cast()[cast().points[:, 0] < 5],  # on ground that nobody has seen
        cast()[cast().points[:, 0] < 12],  # with ground on one side only
        replace(
            cast(), boxes=cast([car(12, 1)]).boxes
        ),  # in a box that nobody has seen
        cast()[:0],
    ):
        pasted = paste(host, [candidate])
        assert np.array_equal(pasted.points, host.points)
        assert pasted.boxes is not None and len(pasted.boxes) == len(host.boxes or ())


def test_each_group_of_objects_has_a_number_of_its_own() -> None:
    groups = [[seen(car(10, y)) for y in (y, y + 4)] for y in (-8, 0)]
    pasted = paste_groups(cast(), [(group, 1) for group in groups], 5)
    assert pasted.boxes is not None
    assert sorted(pasted.boxes.values[:, 1].round().tolist()) == [-8, 0]


def test_a_raised_object_has_the_rings_that_see_it() -> None:
    host = cast(ground=-1.4)
    candidate = seen(car(12, 3))
    scans = (replace(s, ring=assign_beams(s).ring) for s in (host, candidate.scan))
    pasted = paste(next(scans), [candidate._replace(scan=next(scans))])
    new = pasted[pasted.instance == 1]
    assert len(new) > 100 and np.array_equal(new.ring, assign_beams(new).ring)


def test_objects_in_front_occlude_a_pasted_object() -> None:
    """A narrow wall covers part of the car, and the car nothing of the wall."""
    alone = seen(car(15, 0, np.pi / 2))
    shares = {}
    for width in (0.2, 1.0, 1.6):
        front = wall(9, 0, np.pi / 2, width)
        pasted = paste(cast([], [front]), [alone])
        true = cast([car(15, 0, np.pi / 2)], [front])
        assert (
            pasted.boxes is not None
            and pasted.label is not None
            and true.label is not None
        )
        assert (pasted.label == WALL).sum() == (true.label == WALL).sum()
        assert (pasted.label == CAR).sum() == (true.label == CAR).sum()
        shares[width] = (pasted.label == CAR).sum() / len(alone.scan)
        expected = -1 if shares[width] >= 0.8 else 1 if shares[width] >= 0.45 else 2
        assert pasted.boxes.occlusion.tolist() == [expected]
    assert shares[0.2] > 0.8 > shares[1.0] > 0.45 > shares[1.6] > 0.1
    wide = paste(cast([], [wall(9, 0, np.pi / 2, 3)]), [alone])
    assert wide.boxes is not None and not len(wide.boxes)  # hidden
    assert np.array_equal(wide.points, cast([], [wall(9, 0, np.pi / 2, 3)]).points)
    none = paste(replace(cast(), boxes=None), [])
    # A detector's sample has boxes, be there any or not.
    assert none.boxes is not None and len(none.boxes) == 0


def test_gaps_between_occluding_returns_show_nothing() -> None:
    host = cast([], [wall(9, 0, np.pi / 2, 1.6)])
    alone = seen(car(15, 0, np.pi / 2))
    label = project(host).label
    assert label is not None
    rows = np.arange(64)[:, None]
    inner = (
        (label == WALL)
        & (np.roll(label, 1, 0) == WALL)
        & (np.roll(label, -1, 0) == WALL)
        & (rows % 2 == 0)
    )
    perforated = host[~inner.reshape(-1)[locate(host.points, SENSOR).cell]]
    assert len(host) - len(perforated) > 200
    whole, pierced = (paste(h, [alone]).label for h in (host, perforated))
    assert whole is not None and pierced is not None
    assert (whole == CAR).sum() == (pierced == CAR).sum() > 100


def test_occluded_objects_are_removed_with_their_boxes() -> None:
    behind = car(22, 0.2)
    beside = car(10, 12, 1.0)
    farther = car(20, 4.0)
    host = cast([behind, beside, farther])
    host.boxes = replace(host.boxes, occlusion=np.array([0, 0, 0]))
    pasted = paste(host, [seen(car(12, 0, np.pi / 2))])
    assert pasted.boxes is not None and pasted.instance is not None
    assert pasted.boxes.instance.tolist() == [2, 3, 4]
    assert not (pasted.instance == 1).any()
    assert pasted.boxes.occlusion.tolist() == [0, 1, -1]
    truth = cast([behind, beside, farther, car(12, 0, np.pi / 2)])
    assert truth.instance is not None and host.instance is not None
    assert 0 < (truth.instance == 3).sum() < (host.instance == 3).sum()
    left = (truth.instance == 3).sum()
    assert (pasted.instance == 3).sum() == left
    equal = paste(host, [seen(car(12, 0, np.pi / 2))], least=left)
    assert np.array_equal(equal.points, pasted.points)
    strict = paste(host, [seen(car(12, 0, np.pi / 2))], least=left + 1)
    assert strict.boxes is not None and np.allclose(strict.boxes.values[:, 0], [10, 12])
    assert (strict.label == CAR).sum() == (pasted.label == CAR).sum() - left
    assert_nothing_shares_a_ray(pasted, 4)


def test_occlusion_only_grows_and_unknown_levels_stay() -> None:
    boxes = Boxes(np.tile(car(9, 0), (9, 1)), ("Car",) * 9)
    boxes = replace(boxes, occlusion=np.array([0, 0, 0, 0, 0, 0, 2, 3, -1]))
    shares = np.array([1, 0.8, 0.79, 0.45, 0.44, 0, 0.6, 0.3, 0.3])
    assert update_occlusion(boxes, shares).occlusion.tolist() == [
        *[0, 0, 1, 1, 2, 2, 2, 3, 2]
    ]


def test_an_object_up_to_its_roof_hides_what_stands_higher_on_a_hill() -> None:
    host = cast()
    host.points[:, 2] += 0.1 * host.points[:, 0]
    cars = (seen(car(x, 0, 0, z), z) for x, z in ((6, -1.13), (15, -0.23)))
    pasted = paste(host, cars)
    assert pasted.boxes is not None and len(pasted.boxes) == 1


def test_ground_without_labels_does_not_hide_the_foot_of_an_object() -> None:
    host = cast(ground=-2.3)
    unknown = np.random.default_rng(0).random(len(host)) < 0.5
    partly = replace(host, label=np.where(unknown, np.uint8(IGNORE), host.label))
    known, found = (paste(h, [seen(car(22, 5, 0.4))]) for h in (host, partly))
    assert np.array_equal(found.points, known.points)


def test_pasted_objects_occlude_one_another_in_any_order() -> None:
    cars = [car(9, 0), car(15, 0.8), car(22, 3, 0.3), car(-9, 4, 2.0)]
    candidates = [seen(c) for c in cars]
    truth = cast(cars)
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        pasted = paste(cast(), [candidates[i] for i in order])
        assert len(pasted) == len(truth)
        assert np.allclose(project(pasted).range, project(truth).range, atol=1e-4)
        assert pasted.boxes is not None
        # From near to far.
        assert np.allclose(pasted.boxes.values[:, 0], [9, -9, 15, 22], atol=0.01)
        assert_nothing_shares_a_ray(pasted, 1)
    twice = paste(
        cast(), [candidates[0], candidates[0].turned(0.05), candidates[3]], count=2
    )
    # the second found no place
    assert twice.boxes is not None and len(twice.boxes) == 2


def test_gaps_in_an_object_show_nothing_behind_it() -> None:
    whole = seen(car(10, 3, 0.7))
    rng = np.random.default_rng(0)
    holes = whole._replace(scan=whole.scan[rng.random(len(whole.scan)) < 0.4])
    background = cast([], [wall(25, 6, 1.0, 30)])
    full = project(paste(background, [whole]))
    pasted = paste(background, [holes])
    assert_nothing_shares_a_ray(pasted, 1)
    assert ((full.label == CAR) & (project(pasted).range == 0)).sum() > 300
    across = np.arctan2(whole.scan.points[:, 1], whole.scan.points[:, 0])
    # what stood before it when it was recorded
    post = np.abs(across - np.median(across)) < 0.03
    stripe = paste(background, [whole._replace(scan=whole.scan[~post])])
    closed = project(stripe).range[(full.label == CAR) & (project(stripe).label != CAR)]
    assert len(closed) > 100 and (closed == 0).mean() > 0.97


def test_fields_of_a_scan_with_pasted_objects() -> None:
    host = cast([], [wall(20, 0)])
    host = replace(
        host,
        ring=np.zeros(len(host), np.int16),
        pose=np.eye(4),
        domain=0,
        confidence=None,
    )
    candidate = seen(car(8, 5))
    camera = {
        "truncation": [0.2],
        "alpha": [1.0],
        "image_box": [[1, 2, 3, 4]],
        "occlusion": [1],
    }
    known = replace(candidate.scan.boxes, **{k: np.array(v) for k, v in camera.items()})
    candidate = candidate._replace(scan=replace(candidate.scan, boxes=known))
    pasted = paste(host, [candidate])
    assert set(pasted.fields()) == {
        "reflectance",
        "label",
        "instance",
        "confidence",
        "ring",
    }
    new = slice(-len(candidate.scan), None)
    assert (
        pasted.boxes is not None
        and pasted.confidence is not None
        and pasted.instance is not None
    )
    assert (pasted.confidence[new] == 1).all() and (pasted.instance[new] == 1).all()
    assert np.array_equal(pasted.reflectance[new], candidate.scan.reflectance)
    assert (pasted.domain, pasted.id, pasted.raw_label) == (SYNTHETIC, host.id, None)
    elevation, height = (values[pasted.ring[new]] for values in SENSOR.optics())
    x, y, z = pasted.points[new].T
    assert (
        np.abs(np.degrees(np.arctan2(z - height, np.hypot(x, y)) - elevation)).max()
        < 0.45
    )
    boxes = pasted.boxes
    assert (boxes.occlusion.tolist(), boxes.image_box.tolist()) == ([1], [[-1] * 4])
    assert (boxes.truncation[0], boxes.alpha[0]) == (np.float32(0.2), 1)
    about = paste(host, [candidate.turned(0.2)]).boxes
    assert about is not None
    # In another direction the camera saw nothing of it.
    assert (about.truncation[0], about.alpha[0]) == (
        -1,
        -10,
    )


@pytest.mark.parametrize("name", ["town", "hdl64e_lasers"])
def test_points_without_rings_get_those_of_their_lasers(name: str) -> None:
    host, other = (Town(seed, name, scans=1, motion=False)[0] for seed in (0, 3))
    both = merge_scans(host, [replace(other, ring=None)])
    assert (both.ring[len(host) :] == other.ring).mean() > 0.999


def test_objects_of_another_sensor_get_rings_of_the_scans_lasers() -> None:
    host = Town(0, scans=1, motion=False)[0]
    finer = Town(3, "os1_128", scans=1, motion=False)[0]
    pasted = paste(host, objects_of(finer, 50).values())
    new = pasted[pasted.instance > host.instance.max()]
    assert len(new) > 100 and np.array_equal(new.ring, assign_beams(new).ring)


def test_objects_with_tracks_are_still_there_where_points_have_no_instance() -> None:
    """As in PandaSet and KITTI raw, whose boxes have the numbers of their tracks."""
    town = replace(Town(0, scans=1)[0], instance=None, raw_label=None)
    before = objects_of(town)
    after = objects_of(merge_scans(town, []))
    assert len(before) >= 8 and before.keys() == after.keys()
    for number, item in before.items():
        assert np.array_equal(after[number].scan.points, item.scan.points)
        assert after[number].scan.boxes.instance == item.scan.boxes.instance


@pytest.mark.slow
def test_nothing_that_is_given_is_changed() -> None:
    host = cast([car(20, 0)])
    candidate = seen(car(8, 5))
    for array in (
        host.points,
        *host.fields().values(),
        host.boxes.values,
        candidate.scan.points,
        candidate.box,
    ):
        array.setflags(write=False)
    assert len(paste(host, [candidate])) != len(host)


def test_a_coarser_sensor_cannot_lend_objects() -> None:
    coarse = presets()["hdl32e_nuscenes"]
    [found] = objects_of(cast([car(8, 3)], sensor=coarse)).values()
    with pytest.raises(
        DataError, match="'hdl32e_nuscenes' for a scan of 'town'.* sensor='town'"
    ):
        paste(cast(), [found])
    wide = replace(SENSOR, name="wide", columns=SENSOR.columns // 2)
    [found] = objects_of(cast([car(8, 3)], sensor=wide)).values()
    with pytest.raises(DataError, match="'wide' for a scan of 'town'"):
        paste(cast(), [found])
    fine = paste(cast(sensor=coarse), [seen(car(8, 3))])
    assert fine.boxes is not None and len(fine.boxes) == 1
    assert_nothing_shares_a_ray(fine, 1)
