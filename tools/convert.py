"""Convert scans from one format to another: ``python tools/convert.py --help``; the same as
``lidar-synth convert``."""

import sys

from lidar_synth.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "convert")
    main()
