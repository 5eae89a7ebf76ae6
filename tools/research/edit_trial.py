"""Do edited scans keep their boxes true, and can objects be moved and put back?

On scans of the town for three sensors, or on real scans with boxes (--folder): objects are set to
random places, moved away by 5 % of their distance, and removed and put back; scans are turned into
those of other sensors.

    python tools/research/edit_trial.py --inserts 500 --scans 8
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from typer import run

from lidar_synth import Boxes, Scan, Source, Town, load_sensor, open_scans
from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import DataError
from lidar_synth.geometry.transfer import Mount, Transfer
from lidar_synth.labels import edit
from lidar_synth.labels.edit.insertion import cut_out
from lidar_synth.labels.objects import objects_of
from lidar_synth.noise import keyed_rng

SENSORS = "town", "hdl32e_nuscenes", "pandar64"
VEHICLES = [TRAIN_ID[name] for name in ("car", "truck", "other-vehicle")]
LEAST = 30
"""Minimum number of returns of an object."""
AWAY = 1.05
"""Factor of its distance by which an object is moved."""
FAR = 2.0
"""Metres from every box beyond which a vehicle's return is a false one."""


def grown_by(scans: Sequence[Scan], count: int) -> NDArray[np.float64]:
    """(count, 3) metres by which the sides of objects' boxes grow when the objects are set to
    random places."""
    rng = keyed_rng(40)
    items = [
        (item, scan.boxes.values[number])
        for scan in scans
        if scan.boxes is not None
        for number, item in objects_of(scan, LEAST).items()
    ]
    growth: list[NDArray[np.float64]] = []
    tries = 40 * count if items else 0
    while tries and len(growth) < count:
        tries -= 1
        item, box = items[rng.integers(len(items))]
        distance = np.hypot(*box[:2]) * rng.uniform(0.6, 1.8)
        angle = rng.uniform(-np.pi, np.pi)
        pose = distance * np.cos(angle), distance * np.sin(angle)
        try:
            result = edit.insert(scans[rng.integers(len(scans))], item, pose)
        except DataError:
            continue
        assert result.boxes is not None
        growth.append(result.boxes.values[-1, 3:6] - box[3:6])
    return np.array(growth).reshape(-1, 3)


def outside_share(scans: Sequence[Scan], targets: Sequence[str]) -> float:
    """Share of the vehicles' points that lie far from every box after scans were turned into other
    sensors'."""
    total = outside = 0
    for scan in scans:
        for name in targets:
            result = Transfer(load_sensor(name), Mount(z=0.1))(scan)
            assert result.label is not None and result.boxes is not None
            points = result.points[np.isin(result.label, VEHICLES)]
            wide = result.boxes.values + np.array(
                [0, 0, 0, *3 * [2 * FAR], 0], np.float32
            )
            total += len(points)
            outside += int(
                (~Boxes(wide, result.boxes.names).contain(points).any(0)).sum()
            )
    return outside / max(total, 1)


def tried(
    scans: Sequence[Scan], factor: float
) -> tuple[Counter[str], Counter[str], Counter[str]]:
    """Numbers of objects, by class: all, and those that were moved by a factor; and reasons of the
    others.

    With the factor 1 an object is removed and put back.
    """
    all_of: Counter[str] = Counter()
    done: Counter[str] = Counter()
    why: Counter[str] = Counter()
    for scan in scans:
        assert scan.boxes is not None
        for number in objects_of(scan, LEAST):
            name = scan.boxes.names[number]
            all_of[name] += 1
            try:
                if factor == 1:
                    edit.insert(edit.remove(scan, number), cut_out(scan, number))
                else:
                    edit.move(scan, number, factor * scan.boxes.values[number, :2])
                done[name] += 1
            except DataError as error:
                why[str(error).split(";")[0].split(", ")[-1][:60]] += 1
    return all_of, done, why


def print_figures(name: str, scans: Sequence[Scan], inserts: int) -> None:
    """Print the figures of a sensor."""
    growth = grown_by(scans, inserts)
    worst = np.abs(growth).max(1, initial=0)
    shares = ", ".join(f"{(worst > limit).mean():.1%}" for limit in (0.2, 0.5, 2.0))
    print(
        f"{name}: {len(growth)} inserts; a side changed by over 0.2, 0.5, 2 m: {shares}; at "
        f"most {worst.max(initial=0):.2f} m"
    )
    if all(scan.label is not None for scan in scans):
        share = outside_share(scans, SENSORS)
        print(f"  vehicles' points over 2 m from a box after a transfer: {share:.2%}")
    for text, factor in (("moved", AWAY), ("put back", 1.0)):
        all_of, done, why = tried(scans, factor)
        print(
            f"  {text}: {done.total()} of {all_of.total()}; people "
            f"{done['Pedestrian']} of {all_of['Pedestrian']}; else {dict(why.most_common(5))}"
        )


def main(inserts: int = 500, scans: int = 8, folder: list[str] | None = None) -> None:
    """Prints the figures of each sensor, or of each folder of scans with boxes."""
    sources: dict[str, Source] = {root: open_scans(root) for root in folder or ()}
    if not sources:
        towns = (Town(seed=40, scans=scans, sensor=load_sensor(n)) for n in SENSORS)
        sources = dict(zip(SENSORS, towns, strict=True))
    for name, source in sources.items():
        chosen = [source[i] for i in range(min(len(source), scans))]
        print_figures(name, chosen, -(-inserts // len(sources)))


if __name__ == "__main__":
    run(main)
