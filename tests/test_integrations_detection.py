"""The part of OpenPCDet's datasets that needs no OpenPCDet: which synthetic scans are taken."""

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from layouts import write_all
from lidar_synth.integrations.openpcdet_mixture import MixedDetection
from streets import street, synthetic

from lidar_synth.errors import DataError
from lidar_synth.geometry.scan import Scan

LATE = {0: 0.0, 2: 0.5}


class Config(dict[str, Any]):
    """A data configuration without augmentation."""

    DATA_AUGMENTOR = SimpleNamespace(get=lambda name, default: [], AUG_CONFIG_LIST=[])


class Numbers:
    """A trainer's dataset of four samples."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> int:
        return index


class Detection(MixedDetection, Numbers):
    """A mixture with it."""

    class_names = ("Car",)

    def __init__(self, **settings: Any) -> None:
        self.dataset_cfg = Config(LIDAR_SYNTH=settings)
        self._start(["Van"])

    def _synthetic(self, scan: Scan) -> str:  # type: ignore[override]
        return scan.id


@pytest.mark.parametrize("ratio", [0.5, LATE], ids=["always", "later"])
def test_unsuitable_scans_are_refused_before_the_first_epoch(
    ratio: Any, tmp_path: Path
) -> None:
    """Also those of later epochs, after others of real scans alone."""
    scans = [street(i) for i in range(4)]
    bare = [replace(scan, boxes=None) for scan in scans]
    write_all("npz", tmp_path / "bare", bare)
    with pytest.raises(DataError, match="synthetic scan '.*' has no boxes"):
        Detection(synthetic=tmp_path / "bare", ratio=ratio)
    boxes = [replace(s.boxes, names=("Car", "Tram", "Car")) for s in scans if s.boxes]
    named = [replace(s, boxes=b) for s, b in zip(scans, boxes, strict=True)]
    write_all("npz", tmp_path / "named", named)
    with pytest.raises(DataError, match=r"boxes of \['Tram'\].* some of Car, Van"):
        Detection(synthetic=tmp_path / "named", ratio=ratio)
    empty = synthetic(tmp_path / "empty", 4, boxes=False)
    with pytest.raises(DataError, match=r"no box of \['Car'\], and there is no gt_"):
        Detection(synthetic=empty, ratio=ratio)
    assert len(Detection(synthetic=empty, ratio=0)) == 4


def test_samples_of_both_kinds_and_a_log_of_each_epoch(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    made = Detection(synthetic=synthetic(tmp_path / "s", 4), ratio=LATE)
    for epoch in (1, 3):
        made.set_epoch(epoch)
        assert f"epoch {epoch}: 8 samples" in caplog.text  # also if workers load them
        kinds = [type(made[i]) for i in range(len(made))]
        assert kinds.count(str) == (0 if epoch == 1 else 4)
