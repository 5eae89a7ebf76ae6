"""From scans to the sensor that took them: beams, mounting, motion, firings, limits."""

from lidar_synth.geometry.assign import Assigned, assign_beams
from lidar_synth.geometry.deskew import Trajectory, deskew, reskew
from lidar_synth.lab.fitting.fit import SensorFit, fit_sensor

__all__ = [
    "Assigned",
    "SensorFit",
    "Trajectory",
    "assign_beams",
    "deskew",
    "fit_sensor",
    "reskew",
]
