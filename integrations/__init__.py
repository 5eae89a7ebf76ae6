"""Trainer integrations, one file per trainer, imported as ``lidar_synth.integrations.<trainer>``.

The package itself never imports them.
"""
