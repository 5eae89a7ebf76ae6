"""Bake a bank: ``python tools/bake.py --help``; the same as ``lidar-synth bake``."""

import sys

from lidar_synth.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "bake")
    main()
