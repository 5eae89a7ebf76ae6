"""From scans to the sensor that took them: beams, mounting, motion, firings, limits."""

from lidar_synth.lab.fitting.fit import SensorFit, fit_sensor

__all__ = ["SensorFit", "fit_sensor"]
