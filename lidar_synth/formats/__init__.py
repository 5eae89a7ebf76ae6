"""Readers and writers of datasets and file formats.

A reader is an indexable source of ``Scan`` (source.py); a writer writes scans into one output
folder (writer.py). Each dataset or format has one module with both. To add a format, write such a
module and add its classes to ``READERS`` and ``WRITERS``; ``open_scans``, the command line and the
parametrised tests then include it.
"""

import inspect
import re
from pathlib import Path
from typing import Any

from lidar_synth.bank import is_url
from lidar_synth.errors import ConfigError, DataError, FileError, choose
from lidar_synth.formats.bank import BankScans
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.cosmos import Cosmos, CosmosWriter
from lidar_synth.formats.folder import (
    SUFFIXES,
    Folder,
    KITTIWriter,
    NPZWriter,
    PCDWriter,
    PLYWriter,
)
from lidar_synth.formats.kitti360 import KITTI360, KITTI360Writer
from lidar_synth.formats.kitti_object import KITTIObject, KITTIObjectWriter
from lidar_synth.formats.kitti_raw import KITTIRaw
from lidar_synth.formats.mcap import MCAP, MCAPWriter
from lidar_synth.formats.nuscenes import NuScenes
from lidar_synth.formats.pandaset import PandaSet
from lidar_synth.formats.png import PNGWriter, RangePNG
from lidar_synth.formats.py123d import Py123D
from lidar_synth.formats.range_images import RangeImages, RangeWriter
from lidar_synth.formats.semantic_kitti import SemanticKITTI, SemanticKITTIWriter
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.webdataset import WebDataset, WebDatasetWriter
from lidar_synth.formats.writer import Writer
from lidar_synth.geometry import Sensor

__all__ = [
    "KITTI360",
    "MCAP",
    "READERS",
    "WRITERS",
    "BankScans",
    "Calibration",
    "Cosmos",
    "Folder",
    "KITTIObject",
    "KITTIRaw",
    "NuScenes",
    "OnBad",
    "PandaSet",
    "Py123D",
    "RangeImages",
    "RangePNG",
    "ScanFiles",
    "SemanticKITTI",
    "WebDataset",
    "Writer",
    "layout_of",
    "open_scans",
]

READERS: dict[str, type[ScanFiles]] = {
    "kitti360": KITTI360,
    "semantic_kitti": SemanticKITTI,
    "kitti_object": KITTIObject,
    "nuscenes": NuScenes,
    "pandaset": PandaSet,
    "kitti_raw": KITTIRaw,
    "bank": BankScans,
    "mcap": MCAP,
    "py123d": Py123D,
    "cosmos": Cosmos,
    "png": RangePNG,
    "range": RangeImages,
    "folder": Folder,
    "webdataset": WebDataset,
}
"""{layout: reader}, in the order in which readers are asked whether they recognise a path."""

WRITERS: dict[str, type[Writer]] = {
    "kitti": KITTIWriter,
    "semantic_kitti": SemanticKITTIWriter,
    "kitti_object": KITTIObjectWriter,
    "kitti360": KITTI360Writer,
    "range": RangeWriter,
    "pcd": PCDWriter,
    "ply": PLYWriter,
    "npz": NPZWriter,
    "png": PNGWriter,
    "webdataset": WebDatasetWriter,
    "mcap": MCAPWriter,
    "cosmos": CosmosWriter,
}
"""{format: writer}."""


def open_scans(
    path: str | Path,
    *,
    sensor: str | Path | Sensor | None = None,
    layout: str | None = None,
    split: str | None = None,
    fields: int | None = None,
    topic: str | None = None,
    reflectance_max: float | None = None,
    on_bad: OnBad = "error",
) -> ScanFiles:
    """Open the scans at a path: a dataset's root, a bank, a folder of scans, or one file.

    Args:
        path: path of the scans; a bank may also be at a URL.
        sensor: the sensor that recorded the scans, if it is not the layout's own.
        layout: one of ``READERS``; by default it is recognised from the files.
        split: name of a split, if the layout has splits.
        fields: floats per point of plain ``.bin`` files.
        topic: of the point clouds of MCAP files with several.
        reflectance_max: maximum of the reflectance in plain files, MCAP and KITTI's layouts with
            labels, such as 255; values are divided by it.
        on_bad: ``"error"`` raises on a scan that cannot be read; ``"skip"`` skips it, with a
            warning; ``"drop-points"`` drops points that are NaN or infinite, and counts them.

    Returns:
        An indexable source of ``Scan``.

    Raises:
        FileError: if the path does not exist.
        DataError: if no layout is recognised, or there is no scan.
        ConfigError: on an unknown layout or split, or an option that the layout does not have.

    Example:
        >>> from lidar_synth import open_scans
        >>> scans = open_scans("demo_out/town")
        >>> type(scans).__name__, scans.ids[0]
        ('SemanticKITTI', '00/000000')
        >>> scan = scans[0]
        >>> scan.points.shape == (len(scan), 3), scan.label.dtype
        (True, dtype('uint8'))
    """
    path = path if is_url(path) else Path(path)
    name = layout_of(path) if layout is None else layout
    reader = choose("layout", name, READERS)
    taken = inspect.signature(reader).parameters
    given: dict[str, Any] = {
        "sensor": sensor,
        "split": split,
        "fields": fields,
        "topic": topic,
        "reflectance_max": reflectance_max,
    }
    options = {key: value for key, value in given.items() if value is not None}
    for key, value in options.items():
        if key not in taken:
            plain = key in inspect.signature(Folder).parameters
            raise ConfigError(
                f"{key}={value!r} for {path}",
                f"no {key}: layout {name!r} has none",
                _AS_FOLDER if plain and Folder.recognises(Path(path)) else "",
            )
    scans = reader(path, on_bad=on_bad, **options)  # type: ignore[arg-type]
    if layout is None and name == "folder":
        _refuse_part(scans)
    return scans


def _refuse_part(scans: ScanFiles) -> None:
    """Refuse a part of KITTI's datasets, or a folder above one, which as plain files would have
    neither labels nor boxes.

    Raises:
        DataError: with the folder to give instead.
    """
    inner = next((name for name in scans.ids if "velodyne" in name), scans.ids[0])
    scan = (scans.root / inner).absolute()
    if scans.root.is_dir():
        for root in reversed(scan.parents[:5]):
            folder = scan.parent.relative_to(root).as_posix()
            for layout, place in _PLACES.items():
                if re.fullmatch(place, folder) and READERS[layout].recognises(root):
                    raise DataError(
                        f"{scans.root} has scans of {root}, of layout {layout!r}",
                        "the root of a dataset",
                        f"Give {root}. {_AS_FOLDER}",
                    )


_PLACES = {
    "kitti360": "data_3d_raw/[^/]+/velodyne_points/data",
    "semantic_kitti": "sequences/[^/]+/velodyne",
    "kitti_object": "(training|testing)/velodyne[^/]*",
    "kitti_raw": "(.+/)?velodyne_points/data",
}
"""Where scans lie under the root of a dataset."""
_AS_FOLDER = "--layout folder (layout='folder') reads its files as plain ones."


def layout_of(path: str | Path) -> str:
    """Recognise the layout of the scans at a path; at a URL there are only banks.

    Raises:
        FileError: if the path does not exist.
        DataError: if no reader recognises it.
    """
    if is_url(path):
        return "bank"
    path = Path(path)
    if not path.exists():
        raise FileError(
            f"{path} does not exist", "a dataset's root, a folder of scans, or one file"
        )
    layout = next(
        (name for name, reader in READERS.items() if reader.recognises(path)), None
    )
    if layout is None:
        raise DataError(
            f"{path} holds no scan in a layout that is known",
            f"one of {', '.join(READERS)}, or {', '.join(SUFFIXES)} files",
            "Give the dataset's root, for instance the folder with data_3d_raw, sequences, "
            "training or samples.",
        )
    return layout
