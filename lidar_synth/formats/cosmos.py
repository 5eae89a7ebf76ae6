"""LiDAR tensors of NVIDIA's Cosmos models in ``.safetensors`` files: what
Cosmos3-Nano-Transfer-Auto takes as ``lidar.control_path`` and ``lidar.condition_path``, and
returns.

One tensor ``frames`` of shape (3, T, 128, 1800), float32, holds T sweeps: range in metres,
intensity and validity, both from 0 to 1
(https://github.com/vllm-project/vllm-omni/blob/main/recipes/cosmos3/Cosmos3-Nano-Transfer-Auto.md).
Columns run clockwise from behind the sensor, and rows are the elevations of a Hesai Pandar128
(https://github.com/nv-tlabs/Cosmos-Drive-Dreams, ``cosmos-transfer-lidargen``): the preset
``pandar128``. Its code casts the rays of a cell through the cell's left edge, this package through
the centre, 0.1 degrees further.

A scan is written on its own sensor's grid, with its description in the file's metadata; Cosmos
takes those of ``convert --as-sensor pandar128``. Labels, boxes and poses are lost.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from lidar_synth.errors import ConfigError, DataError, parsing
from lidar_synth.files.disk import open_file, read_start, write_file
from lidar_synth.files.parsing import parse_json
from lidar_synth.formats.description import (
    Description,
    Origin,
)
from lidar_synth.formats.folder import find_scans
from lidar_synth.formats.npz import range_image
from lidar_synth.formats.points import check_scan
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.writer import FileWriter, project_scan
from lidar_synth.geometry import RangeImage, Scan, Sensor
from lidar_synth.geometry.projection import unproject

SUFFIX = ".safetensors"
TENSOR = "frames"
METADATA = "lidar_synth"
CHANNELS = 3

_HEADER = 1 << 16
# Bytes at the beginning of a file in which the names of its tensors are looked for.


class Cosmos(ScanFiles):
    """A folder of .safetensors files with LiDAR tensors of Cosmos, or one such file.

    Args:
        root: the folder or the file.
        sensor: the sensor of the grid; by default the one that the files name (written by this
            package), or else ``pandar128``.
        on_bad: see ``ScanFiles``.

    Raises:
        FileError: if the path does not exist.
        DataError: if there is no scan, or a file is damaged.
    """

    default_sensor = "pandar128"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Whether the first .safetensors file has the tensor, as checkpoints have not."""
        paths = [root] if root.is_file() else sorted(root.rglob(f"*{SUFFIX}"))
        return (
            bool(paths)
            and paths[0].suffix.lower() == SUFFIX
            and f'"{TENSOR}":{{' in read_start(paths[0], _HEADER)
        )

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        ids, self._places, self._said, stored = find_scans(root, SUFFIX, _survey)
        super().__init__(root, ids, sensor, on_bad, stored=stored)
        self.skip_sensor_check()  # the grid is the sensor's

    def image(self, index: int) -> RangeImage:
        """The range image at ``index``.

        Raises:
            DataError, FileError: if it cannot be read.
        """
        path, sweep = self._places[index]
        said = self._said[path]
        with _opened(path) as file:
            distance, intensity, valid = file.get_slice(TENSOR)[:, sweep]
        stored = said.sensor if said else None
        sensor = self._given or stored or self.sensor
        if stored is not None and stored.shape != sensor.shape:
            raise DataError(
                f"{path} was made for sensor {stored.name!r}, not for {sensor.name!r}",
                f"{sensor.shape[0]} x {sensor.shape[1]} cells",
            )
        mask = valid >= 0.5  # those that a model draws lie between 0 and 1
        return range_image(
            np.where(mask, distance, np.float32(0)),
            sensor,
            {"reflectance": intensity},
            f"{path}: {self.ids[index]}",
        )

    def read(self, index: int) -> Scan:
        path, _ = self._places[index]
        said = self._said[path]
        scan = unproject(self.image(index))
        scan.id = self.ids[index]
        check_scan(scan, f"{path}: {scan.id}")
        return scan if said is None else said.origin.apply(scan)


class CosmosWriter(FileWriter):
    """Writes ``NAME.safetensors`` with a tensor of one sweep: the scan on its sensor's grid, range
    and reflectance alone."""

    suffix = SUFFIX
    keeps: frozenset[str] = frozenset()

    def _write_file(self, path: Path, scan: Scan) -> None:
        write_sweeps(path, [scan])


def write_sweeps(path: str | Path, scans: Sequence[Scan]) -> None:
    """Write consecutive scans as one tensor, as Cosmos takes them.

    Args:
        path: the output file.
        scans: T scans of one sensor, at least one; their ids are lost.

    Raises:
        ConfigError: on scans of several grids, or none.
        DataError: if no point of a scan lies on the grid.
        FileError: if the file cannot be written.

    Example:
        >>> from lidar_synth import Town, open_scans
        >>> from lidar_synth.formats.cosmos import write_sweeps
        >>> town = Town(0, "pandar128", 2)
        >>> write_sweeps("sweeps.safetensors", [town[0], town[1]])
        >>> open_scans("sweeps.safetensors").ids
        ('sweeps/000000', 'sweeps/000001')
    """
    grids = {scan.sensor.name for scan in scans}
    if not scans or not all(s.sensor.same_grid(scans[0].sensor) for s in scans):
        raise ConfigError(
            f"{len(scans)} scans of {', '.join(sorted(grids)) or 'no sensor'}",
            "scans of one sensor",
            "lidar-synth convert IN OUT --as-sensor pandar128 brings them onto its grid.",
        )
    images = [project_scan(scan) for scan in scans]
    sweeps = [(i.range, i.channels["reflectance"], i.mask) for i in images]
    frames = np.stack([np.stack(sweep) for sweep in sweeps], axis=1)
    said = Description(scans[0].sensor, (Origin.of(scans[0]),)).to_dict()
    content = save({TENSOR: frames.astype("<f4")}, {METADATA: json.dumps(said)})
    write_file(Path(path), content)


def _survey(path: Path) -> tuple[range, Description | None]:
    """The sweeps of a file, and what it says about them."""
    with _opened(path) as file:
        names = sorted(file.keys())
        found = file.get_slice(TENSOR) if TENSOR in names else None
        shape = () if found is None else tuple(found.get_shape())
        kind = names if found is None else found.get_dtype()
        text = (file.metadata() or {}).get(METADATA)
    if kind != "F32" or len(shape) != 4 or shape[0] != CHANNELS or 0 in shape:
        raise DataError(
            f"{path} holds {kind} of shape {shape}",
            f"a tensor {TENSOR} of float32, (3, T, 128, 1800)",
        )
    if text is None:
        return range(shape[1]), None
    where = f"{path}: its description"
    with parsing(where, "an intact file"):
        return range(shape[1]), Description.from_dict(parse_json(text, where))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An open file; errors of the library as ``DataError``."""
    with open_file(path):
        pass  # a file that cannot be read raises the package's error
    try:
        with safe_open(path, framework="numpy") as file:
            yield file
    except SafetensorError as error:
        raise DataError(
            f"{path} is truncated, damaged or no .safetensors file ({error})",
            "an intact file",
        ) from error
