"""The tool that compares strategies of distillation on the shipped teacher."""

import re
from pathlib import Path

import numpy as np
import pytest
import small_models
from project import ROOT
from scipy.stats import ttest_rel

from lidar_synth.generate.checkpoint import read_header
from lidar_synth.generate.flow.distill import STRATEGIES

OVERRIDES = [
    "data.town=2",
    "data.latents=false",
    "compile=false",
    "steps=1",
    "selection.trajectories=1",
    "selection.candidates=6",
    "recipe.iterations=2",
    "recipe.warmup=1",
    "recipe.optimizer=adamw",
]


def test_strategies_are_compared_seed_by_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    import strategies

    rng = np.random.default_rng(0)
    ours, other = rng.normal(5, 1, (2, 5, 3))
    teacher = np.zeros((1, 3))
    text = strategies.table(
        [
            strategies.Row("teacher", teacher),
            strategies.Row(strategies.OURS, ours),
            strategies.Row("reflow", other),
        ]
    )
    assert "| teacher | 0 | 0 | 0 |" in text
    mean, deviation = ours[:, 0].mean(), ours[:, 0].std(ddof=1)
    assert f"| {strategies.OURS} | {mean:.3g} ± {deviation:.2g} |" in text
    chance = ttest_rel(other[:, 0], ours[:, 0]).pvalue
    assert (
        f"| reflow | {other[:, 0].mean():.3g}" in text and f"(p {chance:.2g})" in text
    )


@pytest.mark.slow
def test_students_of_all_strategies_and_seeds_are_trained_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    import strategies

    teacher = small_models.write(tmp_path / "teacher.safetensors")
    monkeypatch.setattr(strategies, "FINE", 8)
    out = tmp_path / "out"
    strategies.main(out, OVERRIDES, teacher, seeds=2, count=2)
    first = capsys.readouterr().out
    rows = re.findall(r"^\| ([\w, ]+) \| (\d[\d.e+-]*)", first, re.M)
    assert [name for name, _ in rows] == [
        "teacher, 8 steps",
        "teacher, 4 steps",
        *STRATEGIES,
    ]
    assert float(rows[0][1]) == 0 < float(rows[1][1])
    for strategy in STRATEGIES:
        hashes = {
            read_header(out / f"{strategy}-{seed}" / f"{strategy}-{seed}.safetensors")[
                1
            ]
            for seed in (0, 1)
        }
        assert len(hashes) == 2  # seeds differ
    monkeypatch.setattr(strategies, "run", None)
    strategies.main(out, OVERRIDES, teacher, seeds=2, count=2)
    assert capsys.readouterr().out == first[first.index("2 seeds") :]
