"""Weather and failing sensors as augmentations, ``corruption(scan, rng) -> scan``.

Each has a physical parameter, and a value for every one of the ``SEVERITIES``; see
``corruption.Corruption``.
"""

from lidar_synth.weather.corruption import CAUSES, SEVERITIES, Change, Corruption
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

CORRUPTIONS: dict[str, type[Corruption]] = {
    "fog": Fog,
    "rain": Rain,
    "snow": Snow,
    "wet_ground": WetGround,
    "motion_blur": MotionBlur,
    "missing_beams": MissingBeams,
    "crosstalk": Crosstalk,
    "incomplete_echo": IncompleteEcho,
    "cross_sensor": CrossSensor,
    "low_power": LowPower,
}
"""Corruptions by name. To add one, write its class and a line here; the tests take it
from here."""

__all__ = [
    "CAUSES",
    "CORRUPTIONS",
    "SEVERITIES",
    "Change",
    "Corruption",
    "CrossSensor",
    "Crosstalk",
    "Fog",
    "IncompleteEcho",
    "LowPower",
    "MissingBeams",
    "MotionBlur",
    "Rain",
    "Snow",
    "WetGround",
]
