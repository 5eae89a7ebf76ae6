"""Checks of this machine: libraries, devices and data, and the command that fixes each problem."""

import ctypes
import importlib
import os
import platform
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import (
    PackageNotFoundError,
    requires,
    version as installed_version,
)
from pathlib import Path
from typing import Literal

from lidar_synth import __version__
from lidar_synth.files.processes import usable_cores

State = Literal["ok", "absent", "check", "broken"]
"""``absent``: an optional part is missing; ``check``: an optional part does not work; ``broken``:
the package does not work without this part."""


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Args:
        group: ``libraries``, ``devices`` or ``data``.
        name: name of the checked part.
        state: result of the check.
        found: version, description or problem.
        buys: what a missing optional part would add.
        fix: the command to type.
    """

    group: str
    name: str
    state: State
    found: str
    buys: str = ""
    fix: str = ""


DEVELOPMENT = ("dev", "docs", "test")
"""Extras for work on the package itself, of which its users need nothing."""

OPTIONAL = {
    "embreex": "ray casting, for instance in the town",
    "open3d": "the 3-D window of lidar-synth view",
}
"""Purposes of the optional dependencies; every other dependency is required."""

MODULES = {
    "pyyaml": "yaml",
    "pillow": "PIL",
    "mcap-ros2-support": "mcap_ros2",
    "rerun-sdk": "rerun",
}
"""Import names of the distributions whose import name differs."""

SHARED_OBJECTS = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libudev.so.1": "libudev1",
}
"""The system libraries that open3d loads, and the Debian and Ubuntu packages that hold them."""

DATA_ROOTS = {
    "KITTI360_ROOT": (
        "data_3d_raw/*/velodyne_points/data/*.bin",
        ("data_poses", "calibration", "data_2d_raw"),
    ),
    "SEMANTICKITTI_ROOT": ("sequences/*/velodyne/*.bin", ()),
    "KITTI_ROOT": ("training/velodyne/*.bin", ("training/label_2", "training/calib")),
    "NUSCENES_ROOT": ("samples/LIDAR_TOP/*.pcd.bin", ()),
    "PANDASET_ROOT": ("*/lidar/*.pkl.gz", ()),
    "LIDAR_SYNTH_REAL_SCANS": ("manifest.csv", ()),
    "LIDAR_SYNTH_GOLDEN": ("*.npz", ()),
    "LIDAR_SYNTH_METRICS": ("*", ()),
}
"""Environment variables that name data: a pattern of required files, and optional folders."""


def examine() -> list[Finding]:
    """All findings about this machine, in the order of the report."""
    return [*_libraries(), *_devices(), *_data()]


def works(findings: list[Finding]) -> bool:
    """Whether all parts that the package needs work."""
    return all(finding.state != "broken" for finding in findings)


def missing_packages() -> list[str]:
    """The Debian packages with libraries that open3d needs and this Linux lacks."""
    if not sys.platform.startswith("linux"):
        return []
    return [
        package for library, package in SHARED_OBJECTS.items() if not _loads(library)
    ]


def report(findings: list[Finding]) -> str:
    """The findings as a text table."""
    width = max(len(finding.name) for finding in findings)
    lines = [
        f"lidar_synth {__version__} on Python {platform.python_version()}, {platform.system()} "
        f"{platform.machine()}"
    ]
    group = ""
    for finding in findings:
        if finding.group != group:
            group = finding.group
            lines += ["", group]
        buys = f" (for {finding.buys})" if finding.buys else ""
        lines.append(
            f"  {finding.state:<7} {finding.name:<{width}}  {finding.found}{buys}"
        )
        if finding.fix:
            lines.append(f"  {'':<7} {'':<{width}}  -> {finding.fix}")
    lines += [
        "",
        "The package works."
        if works(findings)
        else "The package does not work: see the lines marked broken.",
    ]
    return "\n".join(lines)


def as_dict(findings: list[Finding]) -> dict[str, object]:
    """The findings as plain values for ``--json``."""
    return {
        "version": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "works": works(findings),
        "findings": [asdict(finding) for finding in findings],
    }


def _libraries() -> Iterator[Finding]:
    enough = sys.version_info >= (3, 10)
    yield Finding(
        "libraries",
        "python",
        "ok" if enough else "broken",
        platform.python_version(),
        fix="" if enough else "install Python 3.10 or later",
    )
    try:
        wanted = requires("lidar_synth") or []
    except PackageNotFoundError:
        yield Finding(
            "libraries",
            "lidar_synth",
            "broken",
            "not installed",
            fix="pip install -e .",
        )
        return
    for line in wanted:
        requirement, _, marker = line.partition(";")
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", marker)
        parts = re.match(r"([\w.-]+)[^>]*(?:>=\s*([\d.]+))?", requirement)
        if parts and not (extra and extra[1] in DEVELOPMENT):
            yield _library(parts[1], parts[2] or "0", extra[1] if extra else None)
    yield _geometry()


def _library(name: str, minimum: str, extra: str | None) -> Finding:
    """Check one dependency; those of an extra are optional."""
    buys = OPTIONAL.get(name) or (f"the extra {extra!r}" if extra else "")
    worst: State = "check" if buys else "broken"
    wheel = (
        f"pip install 'lidar_synth[{extra}]'"
        if extra
        else f"pip install '{name}>={minimum}'"
    )
    try:
        module = importlib.import_module(MODULES.get(name, name.replace("-", "_")))
    except ModuleNotFoundError:
        return Finding(
            "libraries",
            name,
            "absent" if buys else "broken",
            "not installed",
            buys,
            wheel,
        )
    # A broken installation may raise anything; it is reported.
    except Exception as error:
        if name == "open3d" and (packages := missing_packages()):
            line = "apt-get install -y --no-install-recommends " + " ".join(packages)
            return Finding(
                "libraries",
                name,
                "absent",
                "lacks system libraries",
                buys,
                _as_root(line),
            )
        return Finding(
            "libraries",
            name,
            worst,
            f"{type(error).__name__}: {error}",
            buys,
            f"{wheel} --force-reinstall",
        )
    version = str(getattr(module, "__version__", None) or installed_version(name))
    if _numbers(version) < _numbers(minimum):
        return Finding(
            "libraries", name, worst, f"{version}, older than {minimum}", buys, wheel
        )
    return Finding("libraries", name, "ok", version)


def _geometry() -> Finding:
    """Check that a range image survives the round trip to points, which needs compatible numpy and
    numba."""
    try:
        import numpy as np

        from lidar_synth.geometry import RangeImage, load_sensor
        from lidar_synth.geometry.projection import project, unproject

        sensor = load_sensor("hdl64e_kitti360")
        image = RangeImage(np.full(sensor.shape, 10, np.float32), sensor)
        back = project(unproject(image))
        same = np.allclose(back.range, image.range, rtol=3e-7)
    except Exception as error:  # any error belongs in the report
        return Finding(
            "libraries", "projection", "broken", f"{type(error).__name__}: {error}"
        )
    if not same:
        return Finding(
            "libraries",
            "projection",
            "broken",
            "a range image comes back changed",
            fix="pip install --force-reinstall numba numpy",
        )
    return Finding(
        "libraries",
        "projection",
        "ok",
        "range image -> points -> range image returns every cell",
    )


def _devices() -> Iterator[Finding]:
    yield Finding(
        "devices",
        "CPU",
        "ok",
        f"{_cpu_name()}, {usable_cores()} cores{_instructions()}",
    )
    if hasattr(os, "sysconf"):
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
        yield Finding("devices", "memory", "ok", f"{total:.1f} GiB")
    yield from _cuda()


def _cuda() -> Iterator[Finding]:
    try:
        import torch

        from lidar_synth.generate.devices import available_devices

        cards = [
            torch.cuda.get_device_properties(i)
            for i in range(torch.cuda.device_count())
        ]
    except Exception as error:  # an incompatible driver raises various errors
        yield Finding("devices", "CUDA", "check", f"{type(error).__name__}: {error}")
        return
    for number, card in enumerate(cards):
        found = (
            f"{card.name}, {card.total_memory / 2**30:.0f} GiB, compute {card.major}.{card.minor}, "
            f"CUDA {torch.version.cuda}"
        )
        yield Finding("devices", f"cuda:{number}", "ok", found)
    if cards:
        return
    if shutil.which("nvidia-smi") is None:
        found = f"no NVIDIA driver: torch computes on {', '.join(available_devices())}"
        yield Finding("devices", "CUDA", "absent", found)
    elif torch.version.cuda is None:
        yield Finding(
            "devices",
            "CUDA",
            "check",
            "driver found, but torch is built for the CPU",
            fix="the line for this machine's CUDA on https://pytorch.org/get-started/locally",
        )
    else:
        yield Finding(
            "devices",
            "CUDA",
            "check",
            f"driver found, but torch (CUDA {torch.version.cuda}) finds no GPU",
            fix="nvidia-smi",
        )


def _data() -> Iterator[Finding]:
    for variable, (pattern, companions) in DATA_ROOTS.items():
        value = os.environ.get(variable)
        if not value:
            yield Finding("data", variable, "absent", "not set")
            continue
        root = Path(value)
        first = next(iter(root.glob(pattern)), None)
        if first is None:
            wrong = f"holds no {pattern}" if root.is_dir() else "is not a folder"
            yield Finding(
                "data",
                variable,
                "check",
                f"{root} {wrong}",
                fix=f"export {variable}=/the/folder",
            )
        else:
            lacking = [name for name in companions if not (root / name).is_dir()]
            yield Finding(
                "data",
                variable,
                "ok",
                f"{root}" + (f", without {', '.join(lacking)}" if lacking else ""),
            )


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _as_root(line: str) -> str:
    return line if hasattr(os, "geteuid") and os.geteuid() == 0 else f"sudo {line}"


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(
        int(part) for part in re.findall(r"\d+", version.partition("+")[0])[:3]
    )


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _instructions() -> str:
    """The vector instructions that torch uses."""
    try:
        import torch

        return f", {torch.backends.cpu.get_cpu_capability()}"
    except Exception:  # the report lists a missing torch separately
        return ""
