"""py123d's logs (https://kesai.eu/py123d): drives of many datasets in one layout. Extra ``py123d``.

Layout, a folder for each log, each file a table of Arrow with its metadata in MessagePack::

    SPLIT/LOG/sync.arrow                dataset, split, name; rows of what was measured together
    SPLIT/LOG/lidar.NAME.arrow          clouds as LAZ, Draco or Arrow, or paths in the raw dataset
    SPLIT/LOG/ego_state_se3.arrow       x, y, z, qw, qx, qy, qz: the vehicle (IMU) to the world
    SPLIT/LOG/box_detections_se3.arrow  the same of each box, then length, width, height

Clouds are in the frame of the vehicle; the reader gives them in that of the sensor, turned by
quarters of a circle so that x is ahead, and those of nuScenes without points nearer than one metre
(``nuscenes.NEAREST``). The package reads this layout and does not write it.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import NUSCENES, PANDASET, WAYMO
from lidar_synth.errors import (
    ConfigError,
    DataError,
    LibraryError,
    LidarSynthError,
    needs,
)
from lidar_synth.files.parsing import parse_json
from lidar_synth.formats.folder import rows_of_rings
from lidar_synth.formats.nuscenes import RINGS, drop_nearest
from lidar_synth.formats.pandaset_cuboids import track_number
from lidar_synth.formats.points import check_points
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.geometry import Boxes, Scan, Sensor
from lidar_synth.geometry.motion import from_world, pose_of

SYNC = "sync.arrow"
EGO = "ego_state_se3"
BOXES = "box_detections_se3"
MERGED = "lidar.lidar_merged"
TOP = 2
"""py123d's number of the sensor on the roof."""

SENSORS = {
    "nuscenes": "hdl32e_nuscenes",
    "pandaset": "pandar64",
    "kitti360": "hdl64e_kitti360",
}
"""Sensors of datasets; those of others have to be named."""

LABELS = {"NuScenes": NUSCENES, "Pandaset": PANDASET, "WODPerception": WAYMO}
"""Classes of points, by the beginning of the name of their table in py123d."""

OBJECTS = {
    "Default": "- Car Tram Misc Pedestrian - - - - - - -",
    "AV2Sensor": "- Misc Misc Cyclist - Truck Misc - - - Misc Misc - Misc Cyclist Pedestrian "
    "Pedestrian Tram Car Misc - - - Misc Truck Truck Misc Misc Misc Cyclist",
    "KITTI360": "Misc - Misc Car Misc - Misc Pedestrian - Cyclist - - - - Misc Tram - Truck -",
    "NuPlan": "Car Cyclist Pedestrian - - - -",
    "Nureasoning": "Car Cyclist Pedestrian - - - - Truck Misc Misc Misc Pedestrian -",
    "NuScenes": "Car Truck Misc Misc Misc Misc Misc Misc Misc Misc Pedestrian Pedestrian "
    "Pedestrian Misc Pedestrian Misc Misc - - - - - -",
    "Pandaset": "- - Misc Misc Car - - Misc Truck Misc Misc Misc Misc Misc Pedestrian Pedestrian "
    "Misc Truck - - - Truck - - Misc Tram Tram",
    "WODPerception": "- Car Pedestrian - Cyclist",
    "PhysicalAIAV": "Car Pedestrian Misc Truck Misc - Cyclist - Misc - Tram Misc",
    "Griffin": "Pedestrian Car Truck Misc Misc Misc",
}
"""KITTI's names of the classes of boxes in the order of py123d's numbers; - = no box. Where py123d
has one class for all vehicles, they are cars."""


class Frame(NamedTuple):
    """What was measured together: a log's folder and dataset, the name of its file of clouds, and
    the rows by the names of files."""

    folder: Path
    dataset: str
    lidar: str
    rows: Mapping[str, int | None]


class Py123D(ScanFiles):
    """py123d's logs: SPLIT/LOG/sync.arrow with lidar.*.arrow.

    A scan has of rings, times, labels, instances, boxes and pose what its log has.

    Args:
        root: the folder of the logs, of a split, or of one log.
        sensor: by default that of nuScenes, PandaSet or KITTI-360.
        split: the full name of a split, such as ``nuscenes_val``, or its end (``val``).
        lidar: py123d's number of the sensor, such as 3 = front; by default the one on the roof, or
            else a log's first.
        on_bad: see ``ScanFiles``.

    Raises:
        DataError: if there is no log with clouds, or a file is damaged.
        ConfigError: on an unknown split, or logs of several datasets.
        LibraryError: without the extra ``py123d``.
    """

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return any(root.rglob(SYNC))

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        split: str | None = None,
        lidar: int | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        self._frames: list[Frame] = []
        ids = []
        splits = set()
        for path in sorted(root.rglob(SYNC)):
            with _opened(path) as table:
                facts = _facts(table)
                name = facts["split"]
                splits.add(name)
                if split in (None, name, name.rpartition("_")[2]):
                    found = _frames(path.parent, facts["dataset"], table, lidar)
                    ids += [f"{name}/{facts['log_name']}/{n:06d}" for n, _ in found]
                    self._frames += [frame for _, frame in found]
        if split is not None and not ids:
            raise ConfigError(
                f"split {split!r} of {root}", f"one of {', '.join(sorted(splits))}"
            )
        if len(datasets := {frame.dataset for frame in self._frames}) > 1:
            raise ConfigError(
                f"{root} has logs of {', '.join(sorted(datasets))}",
                "one dataset",
                "Open the folder of a split, or name it: --split (split=...).",
            )
        named = SENSORS.get(min(datasets, default=""), self.default_sensor)
        self.default_sensor = named  # type: ignore[misc]
        super().__init__(root, ids, sensor, on_bad)
        self.options["lidar"] = lidar

    def read(self, index: int) -> Scan:
        frame = self._frames[index]
        path = frame.folder / f"{frame.lidar}.arrow"
        row, facts = _row(frame, frame.lidar)
        mounts = _mounts(facts)
        number = self.options["lidar"]
        if number is None:
            number = TOP if TOP in mounts else min(mounts)
        if number not in mounts:
            raise DataError(
                f"{path} has no sensor {number}", f"one of {sorted(mounts)}"
            )
        with _errors(path):
            cloud = _cloud(row, frame, facts)
            if frame.lidar == MERGED and "ids" in cloud:
                own = cloud["ids"] == number
                cloud = {name: values[own] for name, values in cloud.items()}
            mount = _ahead(pose_of(mounts[number]["lidar_to_imu_se3"]))
        points = from_world(cloud["xyz"].astype(np.float64), mount).astype(np.float32)
        grey = cloud.get("intensity", np.zeros(len(points))).astype(np.float32)
        check_points(points, grey, str(path), 255)
        scan = Scan(points, grey / np.float32(255), self.sensor, id=self.ids[index])
        if "channel" in cloud:
            scan.ring = cloud["channel"].astype(np.int16)
            if frame.dataset == "nuscenes":
                scan.ring = RINGS - 1 - scan.ring
            elif not self._unknown:
                scan.ring = rows_of_rings(scan)
        if "instance" in cloud:
            scan.instance = cloud["instance"].astype(np.int32)
        if "semantic" in cloud:
            scan.raw_label = cloud["semantic"].astype(np.uint32)
            table = _table(LABELS, mounts[number].get("segmentation_label_class"))
            scan.label = table and table.decode(scan.raw_label, str(path))
        if frame.rows.get(EGO) is not None:
            ego, _ = _row(frame, EGO)
            scan.pose = pose_of(ego["imu_se3"]) @ mount
            if "timestamps" in cloud:
                since = cloud["timestamps"].astype(np.int64) - ego["timestamp_us"]
                scan.time = (since / 1e6).astype(np.float32)
            if frame.rows.get(BOXES) is not None:
                scan.boxes = _boxes(*_row(frame, BOXES), scan.pose)
        return drop_nearest(scan, path) if frame.dataset == "nuscenes" else scan


def _mounts(facts: dict[Any, Any]) -> dict[int, dict[str, Any]]:
    """The sensors of a file of clouds by their numbers: of a merged one, or of one sensor."""
    if "lidar_id" in facts:
        return {facts["lidar_id"]: facts}
    return {int(number): mount for number, mount in facts.items()}


def _frames(
    folder: Path, dataset: str, table: Any, lidar: int | None
) -> list[tuple[int, Frame]]:
    """The frames of a log with clouds of a sensor, with their numbers."""
    columns = table.read_all().to_pydict()
    clouds = sorted(name for name in columns if name.startswith("lidar."))
    clouds.sort(key=lambda name: name not in (MERGED, "lidar.lidar_top"))
    if not clouds:
        return []
    for name in clouds if lidar is not None else ():
        with _opened(folder / f"{name}.arrow") as cloud:
            if lidar in _mounts(_facts(cloud)):
                clouds = [name]
                break
    numbers = enumerate(columns[clouds[0]])
    return [
        (n, Frame(folder, dataset, clouds[0], {k: v[n] for k, v in columns.items()}))
        for n, row in numbers
        if row is not None
    ]


def _row(frame: Frame, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """A frame's row of a file, and the file's metadata."""
    number = frame.rows[name]
    assert number is not None
    with _opened(frame.folder / f"{name}.arrow") as table:
        for part in range(table.num_record_batches):
            batch = table.get_batch(part)
            if 0 <= number < batch.num_rows:
                [row] = batch.slice(number, 1).to_pylist()
                return {k.rpartition(".")[2]: v for k, v in row.items()}, _facts(table)
            number -= batch.num_rows
        raise ValueError(f"no row {frame.rows[name]}")


def _cloud(
    row: dict[str, Any], frame: Frame, facts: dict[str, Any]
) -> dict[str, NDArray[Any]]:
    """The arrays of a cloud: ``xyz`` and py123d's features."""
    data = row["data"]
    if isinstance(data, str):
        return _referenced(row, frame, facts)
    if data[:4] == b"LASF":
        import laspy

        las = laspy.read(BytesIO(data))
        names = las.point_format.extra_dimension_names
        features = {n.removeprefix("extra_"): np.array(las[n]) for n in names}
        return {"xyz": np.array(las.xyz), **features}
    if data[:5] == b"DRACO":
        import DracoPy

        cloud = DracoPy.decode(data)
        arrays = {a["name"]: np.array(a["data"]) for a in cloud.attributes}
        features = {
            n: (v.view("<i8") if v.shape[-1] == 8 else v).reshape(len(v))
            for n, v in arrays.items()
            if n and not n.startswith("__")
        }
        return {"xyz": np.array(cloud.points), **features}
    import pyarrow

    batch = pyarrow.ipc.open_stream(data).read_next_batch()
    columns = dict(zip(batch.schema.names, batch.columns, strict=True))
    features = {n: c.to_numpy(zero_copy_only=False) for n, c in columns.items()}
    return {"xyz": np.stack([features.pop(axis) for axis in "xyz"], -1), **features}


def _referenced(
    row: dict[str, Any], frame: Frame, facts: dict[str, Any]
) -> dict[str, NDArray[Any]]:
    """A cloud of the raw dataset, which py123d itself reads."""
    try:
        from py123d.common.io.lidar.path_lidar_io import load_point_cloud_data_from_path
        from py123d.datatypes.sensors import lidar
    except ImportError as error:
        raise LibraryError(
            f"{frame.folder} refers to {row['data']} of {frame.dataset} ({error})",
            "py123d, which reads it",
            "pip install py123d",
        ) from error
    try:
        merged = frame.lidar == MERGED
        kind = lidar.LidarMergedMetadata if merged else lidar.LidarMetadata
        known = kind.from_dict(facts)
        xyz, features = load_point_cloud_data_from_path(
            row["data"],
            frame.dataset,
            lidar_metadatas=dict(known) if merged else {known.lidar_id: known},
            load_kwargs=parse_json(row["kwargs"] or "{}", "its place in the file"),
        )
    except Exception as error:  # py123d asserts
        raise DataError(
            f"{frame.folder} refers to {row['data']} of {frame.dataset} ({error})",
            "the raw dataset where py123d's variable says, such as NUSCENES_DATA_ROOT",
            "Logs that are converted with lidar_store_option=binary hold their clouds.",
        ) from error
    return {"xyz": xyz, **features}


def _boxes(
    row: dict[str, Any], facts: dict[str, Any], pose: NDArray[np.float64]
) -> Boxes:
    """A frame's boxes in the frame of the sensor; of a class of no table, they are ``Misc``."""
    names = (_table(OBJECTS, facts["box_detection_label_class"]) or "").split()
    found = [
        (name, box, track_number(token))
        for box, label, token in zip(
            row["bounding_box_se3"], row["label"], row["track_token"], strict=True
        )
        if (name := names[label] if names else "Misc") != "-"
    ]
    to_sensor = np.linalg.inv(pose)
    values = []
    for _, box, _ in found:
        place = to_sensor @ pose_of(box[:7])
        values.append([*place[:3, 3], *box[7:], np.arctan2(place[1, 0], place[0, 0])])
    return Boxes(
        np.array(values),
        tuple(name for name, _, _ in found),
        instance=np.array([token for _, _, token in found]),
    )


def _table(tables: Mapping[str, Any], name: str | None) -> Any:
    """The table of a class of py123d, such as ``py123d.parser.registry.NuScenesBoxDetectionLabel``;
    None if it is of no dataset."""
    start = (name or "").rpartition(".")[2]
    for ending in ("BoxDetectionLabel", "LidarSegmentationLabel"):
        start = start.removesuffix(ending)
    return tables.get(start)


def _ahead(mount: NDArray[np.float64]) -> NDArray[np.float64]:
    """A sensor's frame in the vehicle's, turned about its z so that x is ahead."""
    quarters = np.round(np.arctan2(mount[1, 0], mount[0, 0]) / (np.pi / 2))
    half = -quarters * np.pi / 4
    return mount @ pose_of([0, 0, 0, np.cos(half), 0, 0, np.sin(half)])


def _facts(table: Any) -> dict[str, Any]:
    """The metadata of a table."""
    import msgpack

    facts: dict[str, Any] = msgpack.unpackb(
        table.schema.metadata[b"metadata"], strict_map_key=False
    )
    return facts


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A table of Arrow; whatever is wrong with it as ``DataError``."""
    with _errors(path):
        import msgpack  # noqa: F401 - the extra has both
        import pyarrow

        with pyarrow.memory_map(str(path)) as file:
            yield pyarrow.ipc.open_file(file)


@contextmanager
def _errors(path: Path) -> Iterator[None]:
    try:
        with needs("py123d", f"{path} of py123d, but a library"):
            yield
    except LidarSynthError:
        raise
    except Exception as error:  # each library has its own classes
        raise DataError(
            f"{path} is damaged or no table of py123d ({error!r})", "an intact file"
        ) from error
