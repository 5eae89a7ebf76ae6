"""nuScenes: sweeps of its 32-beam LiDAR, with lidarseg's labels if they exist.

Layout (https://www.nuscenes.org/nuscenes#data-format, https://www.nuscenes.org/nuscenes#lidarseg)::

    samples/LIDAR_TOP/NAME.pcd.bin       float32 x, y, z, intensity 0..255, ring 0..31 (0 = lowest)
    lidarseg/VERSION/TOKEN_lidarseg.bin  uint8 class per point
    VERSION/lidarseg.json                which labels belong to which sweep

nuScenes has x right and y forward; both are converted to the package's x forward, y left. Intensity
is divided by 255 and rings are counted from the top. Points nearer than one metre belong to the
recording car or, in full sweeps, to firings without a return, which are stored at the origin: they
are dropped with their labels, as in nuScenes' own tools. The package reads this layout and does not
write it.
"""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import NUSCENES
from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import (
    SKIP_HINT,
    join_inside,
    list_files,
    read_text,
    read_values,
)
from lidar_synth.files.parsing import parse_json
from lidar_synth.formats.point_labels import mismatch
from lidar_synth.formats.points import read_points
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.geometry import Scan, Sensor

SUFFIX = ".pcd.bin"
INTENSITY_MAX = 255.0
RINGS = 32
NEAREST = 1.0
"""Minimum range, metres: nearer points belong to the recording car, or are firings without a
return."""


class NuScenes(ScanFiles):
    """nuScenes' key frames: <root>/samples/LIDAR_TOP/*.pcd.bin, or one such file, with lidarseg's
    labels.

    There is no ``split``: the lists of scenes are in nuScenes' devkit, not in its files.

    Args:
        root: the dataset's folder, a folder of ``.pcd.bin`` files, or one file.
        sensor: a preset's name, a YAML file or a ``Sensor``; by default what the folder says
            (``scans.json``), or else ``hdl32e_nuscenes``.
        on_bad: see ``ScanFiles``.

    Raises:
        DataError: if the folder has no sweep.

    Example:
        >>> from lidar_synth import NuScenes
        >>> scans = NuScenes("nuScenes")
        >>> scans.ids[0], scans.sensor.name
        ('n015__LIDAR_TOP__0', 'hdl32e_nuscenes')
        >>> list(scans[0].fields())
        ['reflectance', 'label', 'raw_label', 'ring']
    """

    default_sensor = "hdl32e_nuscenes"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        patterns = (f"*{SUFFIX}", f"samples/LIDAR_TOP/*{SUFFIX}")
        return root.name.endswith(SUFFIX) or any(any(root.glob(p)) for p in patterns)

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        folder = root / "samples" / "LIDAR_TOP"
        paths = (
            [root]
            if root.is_file()
            else list_files(folder if folder.is_dir() else root, SUFFIX)
        )
        super().__init__(
            root, [path.name.removesuffix(SUFFIX) for path in paths], sensor, on_bad
        )
        self._folder = paths[0].parent
        self._labels = {} if root.is_file() else lidarseg_files(root)

    def read(self, index: int) -> Scan:
        path = self._folder / f"{self.ids[index]}{SUFFIX}"
        points = read_points(path, fields=5, reflectance_max=INTENSITY_MAX)
        rings = points[:, 4]
        if not ((rings >= 0) & (rings < RINGS) & (rings == np.floor(rings))).all():
            raise DataError(
                f"{path}: the fifth field of its points is not a ring ({rings.min():g} to "
                f"{rings.max():g})",
                f"integers 0..{RINGS - 1}",
                f"It may hold four floats per point (KITTI), or be damaged. {SKIP_HINT}",
            )
        scan = Scan(
            ahead(points[:, :3]),
            points[:, 3],
            self.sensor,
            ring=(RINGS - 1 - rings).astype(np.int16),
            id=self.ids[index],
            **self._read_labels(path, len(points)),
        )
        return drop_nearest(scan, path)

    def _read_labels(self, sweep: Path, count: int) -> dict[str, Any]:
        """The labels of a sweep's points, if there are any."""
        path = self._labels.get(sweep.name)
        if path is None:
            return {}
        raw = read_values(path, "u1")
        if len(raw) != count:
            raise mismatch(path, len(raw), sweep, count)
        label = NUSCENES.decode(raw, f"{path} (labels of {sweep})")
        return {"label": label, "raw_label": raw.astype(np.uint32)}


def drop_nearest(scan: Scan, path: Path) -> Scan:
    """A sweep of nuScenes without points nearer than ``NEAREST``.

    Raises:
        DataError: if no point of the file is left.
    """
    # Keeps NaN, which on_bad handles.
    kept = ~(np.einsum("ij,ij->i", scan.points, scan.points) < NEAREST**2)
    if not kept.any():
        raise DataError(
            f"{path}: all {len(scan)} points are nearer than {NEAREST:g} m",
            "a sweep",
            SKIP_HINT,
        )
    return scan[kept]


def ahead(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert (N, 3) points exactly from nuScenes' x right, y forward to x forward, y left."""
    return np.column_stack([points[:, 1], -points[:, 0], points[:, 2]])


def lidarseg_files(root: Path) -> Mapping[str, Path]:
    """{name of a sweep: its label file} from the tables of all versions under a dataset's root.

    Versions without ``sample_data.json`` are left out, unless none has it: lidarseg's archive also
    has the tables of versions that were not downloaded.

    Raises:
        FileError: if no version has ``sample_data.json``.
        DataError: if a table is not JSON, lacks a field, or names a file outside of the root.
    """
    files = {}
    tables = sorted(root.glob("*/lidarseg.json"))
    complete = [t for t in tables if t.with_name("sample_data.json").is_file()]
    for table in complete or tables:
        with parsing(table, "nuScenes' tables lidarseg.json and sample_data.json"):
            samples, rows = (
                _table(table.with_name(name))
                for name in ("sample_data.json", table.name)
            )
            names = {row["token"]: row["filename"] for row in samples}
            for row in rows:
                files[PurePosixPath(names[row["sample_data_token"]]).name] = (
                    join_inside(root, row["filename"])
                )
    return files


def _table(path: Path) -> Any:
    return parse_json(read_text(path), str(path), "a table of nuScenes")
