"""Weather and failing sensors as augmentations, ``corruption(scan, rng) -> scan``.

Each has a physical parameter, and a value for every one of the ``SEVERITIES``; see
``corruption.Corruption``.
"""

from lidar_synth.weather.corruption import SEVERITIES, Change, Corruption
from lidar_synth.weather.cover import Dirt, Spray
from lidar_synth.weather.fog import Fog
from lidar_synth.weather.precipitation import Rain, Snow
from lidar_synth.weather.sensor import (
    CrossSensor,
    Crosstalk,
    IncompleteEcho,
    LowPower,
    MissingBeams,
    MotionBlur,
)
from lidar_synth.weather.wet_ground import WetGround

BENCHMARK = (
    Fog,
    WetGround,
    Snow,
    MotionBlur,
    MissingBeams,
    Crosstalk,
    IncompleteEcho,
    CrossSensor,
)
"""Those of the Robo3D benchmark (Kong et al., ICCV 2023), in its order."""

CORRUPTIONS: dict[str, type[Corruption]] = {
    kind.name: kind for kind in (*BENCHMARK, Rain, Spray, Dirt, LowPower)
}
"""Corruptions by name. To add one, write its class and name it here; the tests take it
from here."""

__all__ = [
    "BENCHMARK",
    "CORRUPTIONS",
    "SEVERITIES",
    "Change",
    "Corruption",
    "CrossSensor",
    "Crosstalk",
    "Dirt",
    "Fog",
    "IncompleteEcho",
    "LowPower",
    "MissingBeams",
    "MotionBlur",
    "Rain",
    "Snow",
    "Spray",
    "WetGround",
]
