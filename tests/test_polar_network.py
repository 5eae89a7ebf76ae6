"""The second network of few_labels.py is a trainer of ``prove``."""

import sys
from pathlib import Path

import pytest
from project import ROOT

sys.path.append(str(ROOT / "tools" / "research"))

from proofs import job

from lidar_synth.datasets.classes import IGNORE

pytestmark = pytest.mark.usefixtures("one_thread")


def test_it_trains_on_the_stages_of_an_arm(tmp_path: Path) -> None:
    from polar_network import learn

    work = job("pretrain-generator", tmp_path, iterations=20)
    assert [count for _, count in work.stages()] == [15, 4, 1]
    [[scan]] = work.held_out.values()
    [table] = learn(work).values()
    assert table.sum() == (scan.label != IGNORE).sum()
