"""Hostile YAML and impossible sensors: each is refused with an error of this package."""

from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from hostile import LINEAR
from hypothesis import given, strategies as st
from limits import in_limits, needs_limits

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.parsing import parse_yaml
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.lab.train.config import TrainConfig, load_config

CONFIGS = Path(__file__).parents[1] / "configs"


TABLE = {
    "columns": 64,
    "elevations": [2.0, 1.0, 0.0],
    "range_min": 1.0,
    "range_max": 80.0,
}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            TABLE | {"elevations": "high"},
            "elevations = 'high'; expected a list of finite numbers",
        ),
        (
            TABLE | {"elevations": []},
            r"elevations = \[\]; expected a list of finite numbers",
        ),
        (TABLE | {"elevations": ["2", "1"]}, "a list of finite numbers"),
        (TABLE | {"elevations": [[2.0], [1.0]]}, "a list of finite numbers"),
        (TABLE | {"elevations": [2.0, float("nan")]}, "a list of finite numbers"),
        (TABLE | {"elevations": {2.0: 1.0}}, "a list of finite numbers"),
        (TABLE | {"elevations": [2.0]}, "at least 2 rows"),
        (TABLE | {"elevations": 5.0}, "a list of finite numbers"),
        (TABLE | {"beams": "low"}, "beams = 'low'"),
        (TABLE | {"heights": [True, True, True]}, "a list of finite numbers"),
        (LINEAR | {"rows": 64.5}, "rows = 64.5; expected a whole number"),
        (LINEAR | {"rows": True}, "rows = True; expected a whole number"),
        (LINEAR | {"rows": "64"}, "rows = '64'; expected a whole number"),
        (LINEAR | {"columns": 64.0}, "columns = 64.0; expected a whole number"),
        (LINEAR | {"columns": None}, "columns = None; expected a whole number"),
        (
            LINEAR | {"rows": 2_000_000_000, "columns": 2_000_000_000},
            "expected at most 4194304 cells",
        ),
        (LINEAR | {"rows": 10**2000}, "expected at most 4194304 cells"),
        (
            LINEAR | {"range_max": float("inf")},
            "range_max = inf; expected a finite number",
        ),
        (LINEAR | {"range_max": 10**400}, "a finite number"),
        (
            LINEAR | {"range_min": "near"},
            "range_min = 'near'; expected a finite number",
        ),
        (LINEAR | {"fov_up": [3.0]}, r"fov_up = \[3.0\]; expected a finite number"),
        (LINEAR | {"description": [1]}, "expected text"),
        (LINEAR | {7: 7}, r"sensor keys \[7\]"),
        ({"columns": 64}, "without range_min, range_max"),
        ("text", r"does not hold sensors by name \(dict\); expected NAME: "),
    ],
)
def test_invalid_sensors_are_refused(
    tmp_path: Path, values: object, message: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"mine": values}))
    with pytest.raises(ConfigError, match=message):
        load_sensor(path)
    if isinstance(values, dict):
        with pytest.raises(ConfigError):
            Sensor.from_dict({"name": "mine", **values})


def laughs(levels: int, times: int = 9) -> str:
    lines = ["a0: &a0 [1, 1]"]
    lines += [
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * times)}]" for i in range(1, levels)
    ]
    return "\n".join(lines)


HOSTILE_YAML = {
    "a billion laughs": laughs(30),
    "laughs that are merged": "a0: &a0 {x: 1}\n"
    + "\n".join(
        f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)
    ),
    "an alias in itself": "a: &a [*a]",
    "an alias of nothing": "a: *b",
    "deep": "[" * 100_000,
    "deep mappings": "{a: " * 50_000,
    "deep blocks": "\n".join(f"{' ' * i}a:" for i in range(600)),
    "long": "a: b\n" * 200_000,
    "many": "[" + "1," * 30_000 + "]",
    "a tag": "a: !!int ''",
    "a tag of time": "a: !!timestamp x",
    "a tag of Python": "a: !!python/object/apply:os.getcwd []",
    "no month": "a: 2001-99-99",
    "no digits": "a: 0b_",
    "a long number": f"a: 0x{'f' * 20_000}",
    "a key that is none": "? {a: b}\n: c",
    "not closed": 'a: "',
    "control": "a: \x01",
    "two documents": "a: 1\n---\nb: 2",
}


def open_yaml(path: Path) -> None:
    for read in (load_sensor, lambda p: load_config(TrainConfig, p)):
        with pytest.raises((ConfigError, DataError)) as caught:
            read(path)
        assert len(str(caught.value)) < 2000


@pytest.mark.slow
@needs_limits
@pytest.mark.parametrize("name", HOSTILE_YAML)
def test_hostile_yaml_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(HOSTILE_YAML[name])
    assert in_limits(open_yaml, path, megabytes=200, seconds=30) == ""


def test_yaml_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"mine: \xff\xfe")
    open_yaml(path)


def test_a_key_that_stands_twice_is_refused() -> None:
    for text in ("seed: 1\nsteps: 2\nseed: 3", "a: {seed: 1, 'seed': 3}"):
        line = 1 + text.count("\n")
        with pytest.raises(
            ConfigError, match=f"line {line}: the key 'seed' stands twice"
        ):
            parse_yaml(text, "here")
    merged = "{a: {c: &c {<<: {x: 1}, x: 2}}, b: {<<: *c}}"
    assert parse_yaml(merged, "here")["b"] == {"x": 2}


def test_anchors_in_reason_stay_possible() -> None:
    assert parse_yaml(laughs(3), "here")["a2"][8][8] == [1, 1]
    assert parse_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}", "here")["b"] == {
        "x": 1,
        "y": 2,
    }
    for path in [*CONFIGS.glob("*.yaml")]:
        assert parse_yaml(path.read_text(), path.name) == yaml.safe_load(
            path.read_text()
        )


@pytest.mark.slow
@given(
    st.text(max_size=60)
    | st.text(st.sampled_from("&*ab:- []{}!\n?|>'\"%0x_1."), max_size=60)
)
def test_any_text_is_yaml_or_refused(text: str) -> None:
    with suppress(ConfigError):
        parse_yaml(text, "here")
