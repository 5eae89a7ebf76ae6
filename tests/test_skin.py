"""A skin learns the look of a sensor's returns from unlabelled scans, and changes nothing else."""

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError, FileError, LidarSynthError
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor, sensor_yaml
from lidar_synth.lab.town import (
    STRETCH_FRAMES,
    Skin,
    Town,
    fit_skin,
    load_skin,
    returns,
)
from lidar_synth.lab.town.returns import ReturnNoise
from lidar_synth.lab.town.skin.features import find_features
from lidar_synth.lab.town.skin.skin import BOXED, LONGEST, SOFT, shapes
from lidar_synth.lab.town.skin.tables import grouped_quantiles, lookup

SENSOR = Sensor(
    "small",
    columns=900,
    range_min=1.0,
    range_max=80.0,
    rows=32,
    fov_up=3.0,
    fov_down=-25.0,
)
STREETS = 5

pytestmark = pytest.mark.slow


def cast(
    seed: int, skin: Skin | None = None, noise: ReturnNoise | None = None
) -> list[Scan]:
    """One scan of each of some streets."""
    town = Town(seed, SENSOR, STREETS * STRETCH_FRAMES, noise=noise, skin=skin)
    return [town[STRETCH_FRAMES * k + 4] for k in range(STREETS)]


@pytest.fixture(scope="module")
def plain() -> list[Scan]:
    return cast(11, noise=ReturnNoise(gain_std=0))


@pytest.fixture(scope="module")
def undressed() -> list[Scan]:
    """The scans of ``dressed`` without a skin."""
    return cast(13, noise=ReturnNoise(gain_std=0))


@pytest.fixture(scope="module")
def altered() -> list[Scan]:
    """Scans of a sensor that measures a third of the reflectance, with more noise of the range and
    two odd lasers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(returns, "_SPECKLE", returns._SPECKLE * 1.5)
        scans = cast(12, noise=ReturnNoise(range_std=0.03, gain_std=0))
    out = []
    for scan in scans:
        assert scan.ring is not None
        bright = 0.05 + 0.4 * scan.reflectance
        bright[scan.ring == 20] += 0.08
        out.append(
            replace(
                scan,
                reflectance=bright.astype(np.float32),
                label=None,
                raw_label=None,
                boxes=None,
            )
        )
    return out


@pytest.fixture(scope="module")
def skin(altered: list[Scan]) -> Skin:
    return fit_skin(
        altered, SENSOR, licence="none", streets=STREETS, lasers=True, progress=False
    )


@pytest.fixture(scope="module")
def dressed(skin: Skin) -> list[Scan]:
    return cast(13, skin)


def reflectance_quantiles(scans: list[Scan], ring: int | None = None) -> np.ndarray:
    values = [
        s.reflectance if ring is None else s.reflectance[s.ring == ring] for s in scans
    ]
    return np.quantile(np.concatenate(values), np.linspace(0.1, 0.9, 9))


def range_residual(scans: list[Scan]) -> float:
    """Metres, median deviation of the range from its neighbours in the ring."""
    found = [
        find_features(s.points, s.reflectance, s.ring.astype(np.int32), SENSOR).residual
        for s in scans
    ]  # type: ignore[union-attr]
    return float(np.nanmedian(np.abs(np.concatenate(found))))


def test_a_skin_recovers_the_reflectance_and_the_noise_of_another_sensor(
    altered: list[Scan], plain: list[Scan], dressed: list[Scan]
) -> None:
    wanted = reflectance_quantiles(altered)
    assert np.abs(reflectance_quantiles(dressed) - wanted).max() < 0.02
    assert np.abs(reflectance_quantiles(plain) - wanted).max() > 0.06
    noise = range_residual(altered)
    assert range_residual(dressed) == pytest.approx(noise, rel=0.15)
    assert range_residual(plain) < 0.6 * noise


def test_a_skin_has_the_offset_of_each_laser(skin: Skin) -> None:
    offset = skin.arrays["offset"][0]
    assert offset[20] == pytest.approx(0.08, abs=0.015)
    assert np.abs(np.delete(offset, 20)).max() < 0.03


def test_a_skin_of_the_scans_that_it_is_compared_with_changes_nothing(
    undressed: list[Scan],
) -> None:
    town = Town(11, SENSOR, STREETS * STRETCH_FRAMES, noise=ReturnNoise(gain_std=0))
    compared = [
        town[STRETCH_FRAMES * street + frame]
        for street in range(STREETS)
        for frame in (4, 14)
    ]
    own = fit_skin(
        compared, SENSOR, licence="none", seed=11, streets=STREETS, progress=False
    )
    same = cast(13, own)
    shift = reflectance_quantiles(same) - reflectance_quantiles(undressed)
    assert np.abs(shift).max() < 0.004
    assert range_residual(same) == pytest.approx(range_residual(undressed), rel=0.02)
    assert sum(map(len, same)) == pytest.approx(sum(map(len, undressed)), rel=0.001)


def test_labels_rings_and_boxes_stay_and_points_move_along_their_rays(
    skin: Skin, undressed: list[Scan], dressed: list[Scan]
) -> None:
    every = replace(
        skin, arrays={**skin.arrays, "missing": np.zeros_like(skin.arrays["missing"])}
    )
    for k, before in enumerate(undressed[:2]):
        after = Town(13, SENSOR, STREETS * STRETCH_FRAMES, skin=every)[
            STRETCH_FRAMES * k + 4
        ]
        for name in ("raw_label", "ring", "instance", "pose"):
            assert np.array_equal(getattr(before, name), getattr(after, name)), name
        assert np.array_equal(before.boxes.values, after.boxes.values)  # type: ignore[union-attr]
        shift = np.linalg.norm(after.points - before.points, axis=1)
        assert 0.05 < shift.max() < SOFT + 1e-3
        assert shift[before.instance > 0].max() < BOXED + 1e-3
        across = np.linalg.norm(
            np.cross(after.points, before.points), axis=1
        ) / np.linalg.norm(before.points, axis=1)
        assert across.max() < 0.05
        assert len(dressed[k]) <= len(before)


def test_points_stay_in_their_boxes(dressed: list[Scan]) -> None:
    for scan in dressed:
        assert scan.boxes is not None and scan.instance is not None
        # 0.1 m on each side, as without a skin, and what a skin may add
        grown = 2 * (0.1 + BOXED)
        wider = replace(
            scan.boxes,
            values=scan.boxes.values + np.float32([0, 0, 0, grown, grown, grown, 0]),
        )
        inside = wider.contain(scan.points)
        for i, instance in enumerate(scan.boxes.instance):
            assert inside[i, scan.instance == instance].all()


def test_a_town_with_a_skin_is_a_pure_function_of_its_arguments(
    skin: Skin, dressed: list[Scan]
) -> None:
    town = Town(13, SENSOR, STREETS * STRETCH_FRAMES, skin=skin)
    copy = pickle.loads(pickle.dumps(town))
    for k in (3, 1):
        for one in (town[STRETCH_FRAMES * k + 4], copy[STRETCH_FRAMES * k + 4]):
            assert np.array_equal(one.points, dressed[k].points)
            assert np.array_equal(one.reflectance, dressed[k].reflectance)


def test_a_saved_skin_is_the_same(skin: Skin, tmp_path: Path) -> None:
    skin.save(tmp_path / "a.skin")
    back = load_skin(tmp_path / "a.skin")
    back.save(tmp_path / "b.skin")
    assert (tmp_path / "a.skin").read_bytes() == (tmp_path / "b.skin").read_bytes()
    assert back.sensor == SENSOR and back.provenance == skin.provenance
    assert all(
        np.allclose(back.arrays[k], v, atol=1e-3, rtol=1e-3)
        for k, v in skin.arrays.items()
    )


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda b: b"",
    "cut": lambda b: b[: len(b) // 2],
    "a flipped bit of the values": lambda b: (
        b[:-1000] + bytes([b[-1000] ^ 1]) + b[-999:]
    ),
    "another licence": lambda b: b.replace(b"none", b"free"),
    "another format": lambda b: b.replace(b"lidar-synth-skin/1", b"lidar-synth-skin/9"),
    "a header of another size": lambda b: b"\xff" * 8 + b[8:],
    "a pickle": lambda b: pickle.dumps({"a": 1}),
    "too long": lambda b: b + bytes(LONGEST),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_skin_is_refused(skin: Skin, name: str, tmp_path: Path) -> None:
    path = tmp_path / "a.skin"
    skin.save(path)
    path.write_bytes(DAMAGE[name](path.read_bytes()))
    with pytest.raises(DataError, match=r"a\.skin"):
        load_skin(path)


def test_what_no_skin_can_be_learnt_from(plain: list[Scan]) -> None:
    with pytest.raises(DataError, match="at least 5"):
        fit_skin(plain[:4], SENSOR)
    flat = [replace(s, reflectance=np.zeros_like(s.reflectance)) for s in plain]
    with pytest.raises(DataError, match="without|with reflectance"):
        fit_skin(flat, SENSOR, progress=False)
    with pytest.raises(DataError, match="degrees from the lasers"):
        fit_skin(plain, load_sensor("hdl64e_kitti"), progress=False)
    with pytest.raises(DataError, match="rings 0 to 31"):
        fit_skin(plain, replace(SENSOR, rows=16), progress=False)
    with pytest.raises(DataError, match="range image, with 900 columns for the 1800"):
        fit_skin(plain, replace(SENSOR, firings=1800), progress=False)


WRONG: dict[str, tuple[Callable[[Skin], object], type[LidarSynthError], str]] = {
    "another sensor": (lambda s: Town(skin=s), ConfigError, "same beams"),
    "other firings": (
        lambda s: Town(sensor=replace(SENSOR, firings=1800), skin=s),
        ConfigError,
        "1800 firings",
    ),
    "an unknown name": (lambda s: Town(skin="no_such"), ConfigError, "one of"),
    "a missing file": (
        lambda s: load_skin("no/such.skin"),
        FileError,
        "cannot be read",
    ),
    "another suffix": (lambda s: s.save("skin.npz"), ConfigError, "ends in .skin"),
    "other arrays": (lambda s: replace(s, arrays={}), ConfigError, "arrays"),
    "not a number": (
        lambda s: replace(
            s, arrays={**s.arrays, "missing": s.arrays["missing"] * np.nan}
        ),
        ConfigError,
        "not finite",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_use_is_an_error(skin: Skin, name: str) -> None:
    act, error, message = WRONG[name]
    with pytest.raises(error, match=message):
        act(skin)


def test_the_shipped_skin_states_where_it_comes_from() -> None:
    shipped = load_skin("pandar64")
    text = json.dumps(shipped.provenance)
    for needed in (
        "CC BY 4.0",
        "Scale AI",
        "Hesai",
        "Dataset Terms",
        "frames 00 to 30",
    ):
        assert needed in text
    assert {k: v.shape for k, v in shipped.arrays.items()} == shapes(64)


def test_the_command_line_describes_a_skin() -> None:
    result = CliRunner().invoke(app, ["skin", "show", "pandar64"])
    assert result.exit_code == 0 and "CC BY 4.0" in result.output


def test_the_command_line_reads_scans_as_other_commands_do(
    plain: list[Scan], tmp_path: Path
) -> None:
    (tmp_path / "sensor.yaml").write_text(sensor_yaml(SENSOR), encoding="utf-8")
    (tmp_path / "logs").mkdir()
    for number, scan in enumerate(plain):
        order = np.lexsort((np.arctan2(*scan.points.T[1::-1]) % (2 * np.pi), scan.ring))
        levels = np.round(scan.reflectance * 255)
        file = tmp_path / "logs" / f"{number:06}.bin"
        np.c_[scan.points, levels][order].astype("<f4").tofile(file)
    (tmp_path / "logs/bad.bin").write_bytes(b"odd")
    out = tmp_path / "my.skin"
    given = ["--licence", "none", "--streets", "1", "--reflectance-max", "255"]
    given += ["--on-bad", "skip"]
    given += ["--sensor", str(tmp_path / "sensor.yaml"), "--out", str(out)]
    result = CliRunner().invoke(app, ["skin", "fit", str(tmp_path / "logs"), *given])
    assert result.exit_code == 0 and load_skin(out).step == 1 / 255, result.output
    assert f"learnt from {STREETS} scans" in result.output


def test_quantiles_by_group_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    value = rng.normal(size=1000).astype(np.float32)
    group = rng.integers(0, 4, 1000) * 2
    table, number = grouped_quantiles(value, group, 8, 5)
    for g in range(8):
        assert number[g] == (group == g).sum()
        expected = (
            np.quantile(value[group == g], np.linspace(0, 1, 5))
            if number[g]
            else np.zeros(5)
        )
        assert np.allclose(table[g], expected, atol=1e-6)


def test_a_map_is_monotone_and_keeps_the_distance_beyond_its_ends() -> None:
    source = np.float32([[0, 0, 0.2, 0.5]])
    target = np.float32([[0.1, 0.3, 0.4, 0.6]])
    grid = np.float32([-0.1, 0, 0.1, 0.2, 0.5, 0.7])
    assert np.allclose(lookup(source, target, grid), [[0.1, 0.2, 0.3, 0.4, 0.6, 0.8]])
