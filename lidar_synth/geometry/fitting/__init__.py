"""From scans to the sensor that took them: beams, mounting, motion, firings, limits."""

from lidar_synth.geometry.fitting.assign import Assigned, assign_beams
from lidar_synth.geometry.fitting.fit import SensorFit, fit_sensor
from lidar_synth.geometry.fitting.motion import Trajectory, deskew, reskew

__all__ = ["Assigned", "SensorFit", "Trajectory", "assign_beams", "deskew", "fit_sensor", "reskew"]
