"""Compose: augmentations by name, as plain data, with what was drawn on the scan."""

import pickle
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from lidar_synth import Compose, PasteObjects, Town, make_policy, mixing
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Scan
from lidar_synth.labels.augment import rotate_scan, yaw
from lidar_synth.labels.compose import MIXES, MOVES, make_augmentation
from lidar_synth.mixing.settings import mix_for_trainer, read_settings
from lidar_synth.noise import keyed_rng
from lidar_synth.weather import CORRUPTIONS, Fog
from lidar_synth.weather.corruption import SCATTERED, SURFACE


@pytest.fixture(scope="module")
def scan() -> Scan:
    return Town(seed=0, scans=1)[0]


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("name", [*MOVES, *CORRUPTIONS])
def test_each_name_survives_yaml_and_gives_the_same_scan(scan: Scan, name: str) -> None:
    options = {"severity": ["light", "heavy"]} if name in CORRUPTIONS else {}
    augment = Compose([{name: {**options, "p": 0.9}}])
    again = Compose.from_dict(yaml.safe_load(yaml.safe_dump(augment.to_dict())))
    assert again.to_dict() == augment.to_dict()
    first = augment(scan, rng())
    second = again(scan, rng())
    assert first.augmented == second.augmented
    np.testing.assert_array_equal(first.points, second.points)


def test_the_drawn_angle_is_noted(scan: Scan) -> None:
    turned = Compose([partial(yaw, limit=45)])(scan, rng())
    [step] = turned.augmented
    expected = rotate_scan(scan, np.radians(step["yaw"]["degrees"]))
    np.testing.assert_array_equal(turned.points, expected.points)


def test_a_range_is_drawn_from_for_each_scan(scan: Scan) -> None:
    augment = Compose([{"fog": {"visibility": [50, 500]}}])
    source = np.random.default_rng(0)
    drawn = [augment(scan, source).augmented[0]["fog"]["visibility"] for _ in range(5)]
    assert len(set(drawn)) == 5
    assert all(50 <= value <= 500 for value in drawn)


def test_the_probability_of_a_step_holds(scan: Scan) -> None:
    source = np.random.default_rng(0)
    augment = Compose([{"yaw": {"p": 0.3}}])
    applied = [len(augment(scan, source).augmented) for _ in range(300)]
    assert 0.22 < np.mean(applied) < 0.38


def test_a_corruption_is_plain_data() -> None:
    data = Compose([Fog(visibility=60)]).to_dict()
    assert data == {"compose": [{"fog": {"visibility": 60}}]}


class OwnFog(Fog):
    """A user's corruption."""

    name = "own_fog"


@pytest.mark.parametrize(
    "given",
    [{name: {"severity": "heavy"}} for name in CORRUPTIONS] + [Fog(15), OwnFog(15)],
    ids=str,
)
def test_a_box_that_loses_its_returns_is_no_target(scan: Scan, given: Any) -> None:
    changed = make_augmentation(given, None, frozenset())(scan, rng())
    assert scan.boxes is not None and changed.boxes is not None
    surface = changed.points[changed.cause == SURFACE]
    had = scan.boxes.contain(scan.points).any(1)
    lost = had & ~scan.boxes.contain(surface).any(1)
    kept = scan.boxes.values[~lost]
    np.testing.assert_array_equal(changed.boxes.values, kept)
    if isinstance(given, Fog):
        alone = given(scan, rng()).boxes  # as a stress test applies it
        assert lost.any() and alone is not None and len(alone) == len(scan.boxes)


@pytest.mark.parametrize(
    ("step", "message"),
    [
        ("fgo", "fog"),
        ({"fog": {"vis": 3}}, "visibility"),
        ({"fog": {"visibility": 60, "p": 2}}, "from 0 to 1"),
        ({"fog": {"visibility": [50, 60, 70]}}, "low, high"),
        ({"fog": {"visibility": [60, 50]}}, "low, high"),
        ({"fog": {"severity": ["lite", "heavy"]}}, "light"),
        ({"fog": {"severity": ["light", "lite", "heavy"]}}, "light"),
        ({"polarmix": {"widht": 90}}, "width"),
        ({"yaw": {"limit": 270}}, "yaw: limit 270"),
        ({"yaw": {"limit": "45"}}, "yaw: limit '45'"),
        ({"yaw": {"limit": [45, 270]}}, "yaw: limit 270"),
        ({"beam_drop": {"share": 3}}, "beam_drop: share 3"),
        ({"jitter": {"spread": -1}}, "jitter: spread=-1"),
        ({"jitter": {"spread": "1"}}, "jitter: '<' not supported"),
        ({"scale": {"low": 2, "high": 1}}, "scale: low=2"),
        ({"yaw": 45}, "{'yaw': 45}.*{argument: value}"),
        ({"yaw": 0}, "{argument: value}"),
        ({"fog": 60}, "{argument: value}"),
        ({"yaw": "45"}, "{argument: value}"),
        ({"scale": [0.9, 1.1]}, "{argument: value}"),
        (Fog, "name"),
        ({"fog": {}, "snow": {}}, "name"),
        (3, "name"),
    ],
)
def test_bad_steps_are_refused_at_once(step: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Compose([step])


def test_a_single_step_needs_no_list() -> None:
    [step] = Compose({"yaw": {"limit": 1}}).steps
    assert (step.name, step.arguments) == ("yaw", {"limit": 1})
    assert [s.name for s in Compose("yaw").steps] == ["yaw"]
    assert Compose({"yaw": None}).to_dict() == {"compose": [{"yaw": {}}]}


def test_a_mixture_takes_steps_by_name(scan: Scan) -> None:
    steps = [{"fog": {"visibility": [50, 500]}}, "yaw"]
    kept = [scan, scan]
    mixed = mixing.MixedScans(
        kept, kept, 0.5, augment=steps, augment_real=True, to_sample=keep
    )
    for position in range(len(mixed)):
        drawn = mixed[position].augmented
        assert [name for step in drawn for name in step] == ["fog", "yaw"]
        assert drawn == mixed.sample(0, position).augmented
        expected = Compose(steps)(scan, keyed_rng(0, 0, position))
        np.testing.assert_array_equal(mixed[position].points, expected.points)


def test_the_settings_of_a_trainer_name_steps(tmp_path: Path) -> None:
    path = tmp_path / "mix.yaml"
    path.write_text("ratio: 0.5\nAugment: [flip_y, {Fog: {Severity: heavy, P: 1}}]\n")
    settings = {**read_settings(path), "synthetic": Town(seed=0, scans=2)}
    mixed = mix_for_trainer(2, settings, keep)
    made = [mixed[n] for n in range(len(mixed)) if mixed.domain(n)]
    assert made and all("fog" in one.augmented[-1] for one in made)


@pytest.mark.parametrize("name", MIXES)
def test_policies_that_draw_from_real_scans_are_steps(name: str) -> None:
    real = Town(seed=1, scans=2)
    own = Town(seed=0, scans=1)[0]
    fields = frozenset({"label", "boxes"})
    arguments = {"bands": [3, 4]} if name == "lasermix" else {}
    augment = Compose([{name: arguments}, "flip_y"])
    bound = pickle.loads(pickle.dumps(augment.bind(real, fields)))
    assert bound.to_dict() == augment.to_dict()
    mixed = Compose([bound.steps[0]])(own, rng())
    expected = make_policy({name: arguments}, real=real, fields=fields)(own, rng())
    np.testing.assert_array_equal(mixed.points, expected.points)
    assert len(mixed) != len(own) and mixed.augmented == ({name: arguments},)


@pytest.mark.parametrize("name", MIXES)
def test_parts_of_real_scans_in_fog_are_surfaces(name: str) -> None:
    """A corrupted scan has causes, the real ones have none."""
    real = Town(seed=1, scans=2)
    own = Town(seed=0, scans=1)[0]
    steps = Compose([{"fog": {"visibility": 60}}, name])
    mixed = steps.bind(real, frozenset({"label", "boxes"}))(own, rng())
    foggy = Compose([{"fog": {"visibility": 60}}])(own, rng())
    assert mixed.cause is not None and mixed.label is not None
    scattered = mixed.cause == SCATTERED
    assert 0 < scattered.sum() <= (foggy.cause == SCATTERED).sum()
    assert (mixed.label[scattered] == IGNORE).all()


def test_a_policy_as_a_step_takes_the_real_scans_of_the_mixture(scan: Scan) -> None:
    real = [Town(seed=1, scans=1)[0]]
    step = PasteObjects(count=2, clear=False)
    mixed = mixing.MixedScans(
        real,
        [scan],
        0.5,
        labels="boxes",
        augment=[step],
        unboxed="keep",
        to_sample=keep,
    )
    [pasted] = [mixed[n] for n in range(len(mixed)) if mixed.domain(n)]
    assert scan.boxes is not None and pasted.boxes is not None
    assert 0 < len(pasted.boxes) - len(scan.boxes) <= 2


def test_a_step_without_the_real_scans_it_needs_is_refused(scan: Scan) -> None:
    with pytest.raises(ConfigError, match="real scans"):
        mixing.MixedScans(None, [scan], 1, epoch_size=1, augment="polarmix")


def keep(scan: Scan, rng: np.random.Generator) -> Scan:
    """A sample is the scan itself."""
    return scan
