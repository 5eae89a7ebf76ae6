"""Objects of the town as GT samples: they are cast where they are pasted, by the rays of that
scan."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from lidar_synth import Boxes, ObjectBank, PasteObjects, Scan, Town, load_sensor
from lidar_synth.bank.boxes import decode_boxes, encode_boxes
from lidar_synth.datasets.classes import LABELS
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.projection import locate
from lidar_synth.lab.town.pasted import TownObjects
from lidar_synth.labels import paste
from lidar_synth.labels.ground import FLOOR
from lidar_synth.noise import keyed_rng

SENSOR = "hdl64e_lasers"


@pytest.fixture(scope="module")
def bank() -> TownObjects:
    return ObjectBank.from_town(SENSOR, scans=3, seed=5)


@pytest.fixture(scope="module")
def street() -> Scan:
    return Town(9, SENSOR, 20)[4]


def largest(bank: TownObjects, name: str = "Car") -> int:
    mine = np.array(bank.boxes.names) == name
    return int(np.argmax(bank.counts * mine))


def test_a_cast_object_has_the_returns_of_its_scan(bank: TownObjects) -> None:
    """Where the town's own scan sees an object whole, the object cast alone looks the same."""
    scan = Town(5, SENSOR, 20, 2.0, motion=False)[3]
    assert scan.boxes is not None and scan.instance is not None
    compared = 0
    for index, box in enumerate(bank.boxes.values):
        match = np.flatnonzero(np.abs(scan.boxes.values - box).max(1) < 1e-3)
        if not len(match):
            continue
        [number] = match
        seen = scan.points[scan.instance == scan.boxes.instance[number]]
        cast = bank[index].scan.points
        if len(seen) < 0.9 * len(cast) or len(cast) < 100:
            continue  # something stands before it
        assert len(seen) == pytest.approx(len(cast), rel=0.1)
        assert seen.mean(0) == pytest.approx(cast.mean(0), abs=0.2)
        assert seen.std(0) == pytest.approx(cast.std(0), abs=0.25)
        compared += 1
    assert compared >= 3


def test_twice_as_far_away_an_object_has_a_quarter_of_the_returns(
    bank: TownObjects,
) -> None:
    found = bank[largest(bank)]
    assert found.cast is not None and found.scan.boxes is not None
    values = found.scan.boxes.values.copy()
    values[:, :2] *= 15 / np.hypot(*values[0, :2])
    near = found.cast(Boxes(values, ("Car",)), found.scan.sensor)
    values[:, :2] *= 2
    far = found.cast(Boxes(values, ("Car",)), found.scan.sensor)
    assert len(far) / len(near) == pytest.approx(0.25, rel=0.35)
    assert Boxes(values, ("Car",)).contain(far.points)[0].mean() > 0.9


def test_returns_lie_on_the_rays_of_the_scan_they_are_pasted_into(
    bank: TownObjects,
) -> None:
    """A sensor with 16 lasers gets returns on its lasers, where moved points would have none."""
    sensor = load_sensor("vlp16")
    found = bank[largest(bank)]
    assert found.cast is not None and found.scan.boxes is not None
    cast = found.cast(found.scan.boxes, sensor)
    elevation = np.degrees(
        np.arctan2(cast.points[:, 2], np.hypot(*cast.points[:, :2].T))
    )
    lasers = np.degrees(sensor.optics()[0])
    assert len(cast) > 10
    assert np.abs(elevation[:, None] - lasers).min(1).max() < 0.1


def test_pasted_objects_stand_free_on_the_ground(
    bank: TownObjects, street: Scan
) -> None:
    """Nothing else is in their boxes above the floor, and no two returns share a cell."""
    assert street.boxes is not None
    policy = PasteObjects(bank, 10, turn=180.0, clear=False)
    scan = policy(street, keyed_rng(1))
    assert scan.boxes is not None and scan.instance is not None
    pasted = np.flatnonzero(scan.boxes.instance > street.instance.max())  # type: ignore[union-attr]
    assert len(pasted) >= 2
    new = scan.instance > street.instance.max()  # type: ignore[union-attr]
    inside = scan.boxes.contain(scan.points, above_floor=2 * FLOOR)[pasted]
    assert new[inside.any(0)].all()
    cells = locate(scan.points[new], scan.sensor).cell
    assert len(np.unique(cells)) == len(cells)
    others = locate(scan.points[~new], scan.sensor).cell
    assert not set(cells) & set(others)
    again = policy(street, keyed_rng(1))
    assert np.array_equal(scan.points, again.points)


def test_an_object_hides_and_is_hidden(bank: TownObjects, street: Scan) -> None:
    """Of two cars in line, the nearer one has all of its returns and the farther one few."""
    found = bank[largest(bank)]
    assert found.scan.boxes is not None
    floor = float(np.median(street.points[street.label == 8, 2]))  # type: ignore[index]
    size = found.box[3:6]
    flat = Scan(
        *_ground(floor), street.sensor, boxes=Boxes(np.zeros((0, 7), np.float32), ())
    )
    objects = []
    for x in (12, 20):
        box = np.array([[x, 0, floor + size[2] / 2, *size, np.pi / 2]], np.float32)
        scan = found.cast(Boxes(box, ("Car",)), street.sensor)  # type: ignore[misc]
        objects.append(found._replace(scan=scan, ground=floor))
    pasted = paste(flat, objects[1:])
    alone = len(pasted.boxes.contain(objects[1].scan.points)[0])  # type: ignore[union-attr]
    both = paste(flat, objects, least=1)
    assert both.boxes is not None
    returns = both.boxes.contain(both.points, above_floor=0.1).sum(1)
    assert both.boxes.values[0, 0] == 12 and returns[0] > 0.9 * len(objects[0].scan)
    assert len(returns) == 1 or returns[1] < 0.5 * alone
    behind = both.points[
        np.abs(np.arctan2(both.points[:, 1], both.points[:, 0])) < 0.03
    ]
    shadow = (behind[:, 0] > 13.5) & (behind[:, 0] < 16)
    assert not shadow.any()


def _ground(height: float) -> tuple[np.ndarray, np.ndarray]:
    sensor = load_sensor(SENSOR)
    elevations, _ = sensor.optics()
    azimuths = np.linspace(-np.pi, np.pi, 2048, endpoint=False)
    down = elevations[elevations < np.radians(-2)]
    tilt, turn = (v.ravel() for v in np.meshgrid(down, azimuths, indexing="ij"))
    away = height / np.tan(tilt)
    points = np.stack([away * np.cos(turn), away * np.sin(turn), 0 * away + height], 1)
    return points.astype(np.float32), np.full(len(points), 0.3, np.float32)


def test_sizes_fit_those_of_a_dataset(bank: TownObjects) -> None:
    boxes = Boxes(np.array([[9, 0, 0, 5.0, 2.2, 1.7, 0]], np.float32), ("Car",))
    fitted = bank.fit_sizes(boxes)
    cars = np.array(fitted.boxes.names) == "Car"
    assert fitted.boxes.values[cars, 3:6].mean(0) == pytest.approx(
        [5.0, 2.2, 1.7], rel=0.02
    )
    found = fitted[largest(fitted)]
    local = found.scan.boxes.contain(found.scan.points)[0]  # type: ignore[union-attr]
    assert local.mean() > 0.9
    own = bank.boxes.values[np.array(bank.boxes.names) == "Car"]
    assert np.ptp(fitted.boxes.values[cars, 3:6] / own[:, 3:6], 0).max() < 1e-5
    floors = (v[:, 2] - v[:, 5] / 2 for v in (own, fitted.boxes.values[cars]))
    assert next(floors) == pytest.approx(next(floors), abs=1e-5)
    vans = np.array(bank.boxes.names) == "Van"
    kept = np.array(fitted.boxes.names) == "Van"
    assert fitted.boxes.values[kept].tolist() == bank.boxes.values[vans].tolist()


def test_classes_are_chosen_by_name(bank: TownObjects) -> None:
    assert {"Car", "Pedestrian"} <= set(bank.boxes.names)
    cars = ObjectBank.from_town(SENSOR, ["Car"], scans=1, seed=5)
    assert set(cars.boxes.names) == {"Car"}
    with pytest.raises(ConfigError, match=r"Zeppelin.*Car"):
        ObjectBank.from_town(SENSOR, ["Zeppelin"], scans=1)


def test_cycles_are_taken_by_name_and_pasted_with_their_labels(
    bank: TownObjects,
) -> None:
    wanted = {"Bicycle": 1, "Motorcycle": 1, "Motorcyclist": 1}
    assert not {*wanted} & {*bank.boxes.names}  # KITTI has no such boxes
    cycles = ObjectBank.from_town(SENSOR, wanted, scans=3, seed=5)
    assert {*cycles.boxes.names} == {*wanted}
    scan = Town(3, SENSOR, 1)[0]
    policy = PasteObjects(cycles, wanted, turn=180, clear="same")
    seen = set()
    for number in range(8):
        pasted = policy(scan, keyed_rng(number))
        assert pasted.boxes is not None
        assert decode_boxes(encode_boxes(pasted.boxes)).names == pasted.boxes.names
        for name, instance in zip(
            pasted.boxes.names, pasted.boxes.instance, strict=True
        ):
            if name in wanted:
                label = pasted.fields()["label"][pasted.instance == instance]
                assert {*label.tolist()} == {LABELS[name]}
                seen.add(name)
    assert seen == {*wanted}


def test_a_room_too_small_gets_no_object(bank: TownObjects) -> None:
    bare = Scan(np.ones((9, 3), np.float32), np.zeros(9, np.float32), bank.sensor)
    pasted = PasteObjects(bank, 3, clear=False)(bare, keyed_rng(0))
    assert pasted.boxes is not None and not len(pasted.boxes)


def test_a_saved_bank_is_one_of_returns(bank: TownObjects, tmp_path: Path) -> None:
    bank.save(tmp_path / "objects.npz")
    loaded = ObjectBank.load(tmp_path / "objects.npz")
    assert type(loaded) is ObjectBank and loaded[3].cast is None
    assert np.array_equal(loaded.points, bank.points)


def test_workers_get_the_same_objects(bank: TownObjects) -> None:
    other = pickle.loads(pickle.dumps(bank))
    boxes = bank[0].scan.boxes
    assert boxes is not None
    ours = bank[0].cast(boxes, bank.sensor)  # type: ignore[misc]
    theirs = other[0].cast(boxes, bank.sensor)
    assert np.array_equal(ours.points, theirs.points)


def test_a_skin_of_another_sensor_is_refused() -> None:
    with pytest.raises((ConfigError, DataError)):
        ObjectBank.from_town(SENSOR, scans=1, skin="pandar64")
