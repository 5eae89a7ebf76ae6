"""The truth that removed objects are compared with: the town without them."""

import sys

import numpy as np
from project import ROOT

sys.path.append(str(ROOT / "tools" / "research"))

from surgery_trial import Emptied, fidelity, places_of

from lidar_synth import Boxes, Scan, Town
from lidar_synth.labels.edit.removal import remove_returns

TOWN = Town(seed=977, scans=2)


def test_the_town_without_cars_is_what_an_edit_should_bring_about() -> None:
    scan = TOWN[1]
    places = places_of(scan, anywhere=False, number=0)
    assert scan.instance is not None and len(places) > 1
    gone = [int(np.bincount(scan.instance[place.mine]).argmax()) for place in places]
    truth = Emptied(TOWN, gone)[1]
    assert truth.instance is not None and not np.isin(gone, truth.instance).any()
    assert set(scan.instance) - set(gone) <= set(
        truth.instance
    )  # all others are still there
    boxes = Boxes(np.array([place.box for place in places]), ("Car",) * len(places))
    assert not boxes.contain(
        truth.points[truth.points[:, 2] > -1.3]
    ).any()  # above the ground

    def agreement(result: Scan) -> list[float]:
        return np.nanmean(fidelity(scan, places, result, truth), 0).tolist()

    before = agreement(scan)
    after = agreement(remove_returns(scan, [(p.mine, p.box) for p in places], None, 0))
    assert agreement(truth) == [1, 1, 1]
    assert after[0] > 0.8 and after[1] > before[1] + 0.2 and after[2] > before[2] + 0.2
