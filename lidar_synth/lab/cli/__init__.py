"""The commands of the laboratory, one file per command; ``lidar_synth.cli`` loads them by name."""
