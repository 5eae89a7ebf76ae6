"""What a figure was measured on, and by which command."""

import os
import platform
import shlex
import sys
from pathlib import Path

import torch


def machine() -> str:
    """The processor, its cores, and the version of torch."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [
        line.partition(":")[2].strip()
        for line in lines
        if line.startswith("model name")
    ]
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, no GPU used, torch {torch.__version__.partition('+')[0]}"


def command_line() -> str:
    """The command of this process, as a user would type it."""
    program = Path(sys.argv[0]).name
    return shlex.join(
        [
            "lidar-synth" if program in ("lidar-synth", "__main__.py") else program,
            *sys.argv[1:],
        ]
    )
