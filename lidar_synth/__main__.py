"""``python -m lidar_synth``: the same as ``lidar-synth``."""

from lidar_synth.cli import main

main()
