"""What a figure was measured on, and by which command."""

import os
import platform
import shlex
import sys
from pathlib import Path

import torch


def machine(device: str = "cpu") -> str:
    """The processor, its cores, the GPU if ``device`` is one, and the version of torch."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [
        line.partition(":")[2].strip()
        for line in lines
        if line.startswith("model name")
    ]
    name = names[0] if names else platform.processor() or platform.machine()
    card = "no GPU used" if device == "cpu" else device
    if torch.device(device).type == "cuda":
        card = torch.cuda.get_device_name(device)
    version = torch.__version__.partition("+")[0]
    return f"{name}, {os.cpu_count()} cores, {card}, torch {version}"


def command_line() -> str:
    """The command of this process, as a user would type it."""
    program = Path(sys.argv[0]).name
    return shlex.join(
        [
            "lidar-synth" if program in ("lidar-synth", "__main__.py") else program,
            *sys.argv[1:],
        ]
    )
