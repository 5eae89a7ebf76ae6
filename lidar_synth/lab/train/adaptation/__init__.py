"""From a shipped model to the sensor and the streets of a user's 20 to 200 scans."""

from lidar_synth.lab.train.adaptation.run import AdaptPlan, adapt, plan_adaptation

__all__ = ["AdaptPlan", "adapt", "plan_adaptation"]
