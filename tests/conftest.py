"""Where tests find what is not in the repository, and the small scans they share."""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings

from lidar_synth.geometry.projection.rings import ring_bounds
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, presets

# A shell leaves SIGINT ignored in what it starts in the background, and so in every process that
# tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# a busy machine is no fault of the code
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests of every format take MCAP and py123d where their extras are installed."""
    values = getattr(item, "callspec", None)
    for name, library in (("mcap", "mcap_ros2"), ("py123d", "pyarrow")):
        if values is not None and name in map(str, values.params.values()):
            pytest.importorskip(library)


def _folder(variable: str) -> Path:
    value = os.environ.get(variable)
    if not value:
        pytest.skip(f"{variable} is not set")
    path = Path(value)
    if not path.is_dir() or not any(path.iterdir()):
        pytest.fail(f"{variable}={value} leads to no folder with files")
    return path


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """torch on one thread: sums in one order, and no waiting for each other on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True, scope="module")
def accelerate_unset() -> Iterator[None]:
    """Accelerate keeps the precision of its first use in a process; it is cleared after every file
    of tests."""
    yield
    if "accelerate.state" in sys.modules:
        sys.modules["accelerate.state"].AcceleratorState._reset_state(True)


@pytest.fixture(scope="session")
def real_scans() -> Path:
    """Folder with real scans of KITTI-360, SemanticKITTI, KITTI and nuScenes; skips where there is
    none."""
    return _folder("LIDAR_SYNTH_REAL_SCANS")


@pytest.fixture(scope="session")
def labelled_scans() -> Path:
    """Folder with labelled real scans of SemanticKITTI and PandaSet; skips where there is none."""
    return _folder("LIDAR_SYNTH_LABELLED_SCANS")


class Golden:
    """Numbers from running the peers' code: small files in tests/golden, larger ones where
    LIDAR_SYNTH_GOLDEN says."""

    def __truediv__(self, name: str) -> Path:
        here = Path(__file__).parent / "golden" / name
        return here if here.is_file() else _folder("LIDAR_SYNTH_GOLDEN") / name


@pytest.fixture(scope="session")
def golden() -> Golden:
    """``golden / name`` is the path of a file; the test is skipped if it is not available."""
    return Golden()


@pytest.fixture(params=sorted(presets()))
def sensor(request: pytest.FixtureRequest) -> Sensor:
    """Every preset in turn."""
    return presets()[request.param]


def ring_numbers(points: np.ndarray) -> np.ndarray:
    """(N,) ring of each point, 0 = the first in the file."""
    bounds = ring_bounds(points)
    return np.repeat(np.arange(len(bounds) - 1, dtype=np.int16), np.diff(bounds))


def random_scan(sensor: Sensor, count: int = 3000, seed: int = 0) -> Scan:
    """Points all around the sensor with reflectance, labels and instances; a few out of its view or
    range."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(-np.pi, np.pi, count)
    elevation = np.radians(rng.uniform(sensor.down - 1, sensor.up + 1, count))
    distance = np.exp(
        rng.uniform(
            np.log(max(sensor.range_min, 0.5) * 0.9),
            np.log(sensor.range_max * 1.1),
            count,
        )
    )
    points = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            -np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        -1,
    )
    raw = rng.choice([0, 10, 40, 50, 70, 80, 252], count).astype(np.uint32) | (
        rng.integers(0, 50, count).astype(np.uint32) << 16
    )
    from lidar_synth.datasets.classes import SEMANTIC_KITTI

    return Scan(
        points=(points * distance[:, None]).astype(np.float32),
        reflectance=(rng.integers(0, 100, count) / 100).astype(np.float32),
        sensor=sensor,
        label=SEMANTIC_KITTI.decode(raw & 0xFFFF),
        raw_label=raw,
        instance=(raw >> 16).astype(np.int32),
        id=f"random-{seed}",
    )
