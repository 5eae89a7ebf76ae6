"""MCAP files of ROS 2 (https://mcap.dev/spec): each message ``sensor_msgs/msg/PointCloud2`` is a
scan. Extra ``mcap``.

The package reads what drivers record, with the fields that ``cloud.py`` names, chunk by chunk: a
scan is found by the file's index. It writes one file for each scan, ``NAME.mcap``, with a message
on the topic ``/points``, all fields of the scan (lossless), its description in the metadata record
``lidar_synth``, and its boxes in ``NAME.boxes.json``. ``mcap merge`` joins such files.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError, LidarSynthError, needs
from lidar_synth.files.disk import open_file
from lidar_synth.formats.cloud import Field, check_fields, to_arrays, to_records
from lidar_synth.formats.description import Description, from_comments, to_comments
from lidar_synth.formats.folder import CloudFiles, PCDWriter, find_scans, has_files
from lidar_synth.formats.points import check_scale
from lidar_synth.formats.source import OnBad
from lidar_synth.geometry import Scan, Sensor

SUFFIX = ".mcap"
TOPIC = "/points"
MESSAGE = "sensor_msgs/msg/PointCloud2"
METADATA = "lidar_synth"
"""Name of the record with the description of a file's scan."""

LARGEST = 1 << 30
"""Most bytes of a record, and of a chunk when it is decompressed."""

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of ``sensor_msgs/msg/PointField``."""

_RULE = f"\n{80 * '='}\nMSG: "
DEFINITION = _RULE.join(
    (
        "std_msgs/Header header\nuint32 height\nuint32 width\n"
        "sensor_msgs/PointField[] fields\nbool is_bigendian\nuint32 point_step\n"
        "uint32 row_step\nuint8[] data\nbool is_dense",
        "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
        "sensor_msgs/PointField\nstring name\nuint32 offset\nuint8 datatype\nuint32 count",
    )
)
"""ROS 2's definition of the message."""

_CHUNK = 6
_MESSAGE = 5
_INDEX = 7
# Operation codes of records, each of which is followed by a length of 8 bytes.


class MCAP(CloudFiles):
    """A folder of .mcap files with PointCloud2 messages of ROS 2, or one such file.

    Args:
        root: the folder or the file.
        sensor: the sensor that recorded the scans; by default the one that the files name
            (written by this package), or ``scans.json`` beside them, or else ``hdl64e_kitti``.
        topic: of the messages; it is needed where there are several.
        reflectance_max: maximum of the reflectance in the files, see ``Folder``.
        on_bad: see ``ScanFiles``.

    Raises:
        FileError: if the path does not exist.
        ConfigError: if there are several topics with point clouds, or not this one; on an invalid
            ``reflectance_max``.
        DataError: if there is no scan, or a file is damaged or has no index.
        LibraryError: without the extra ``mcap``.
    """

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return has_files(root, (SUFFIX,))

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        topic: str | None = None,
        reflectance_max: float | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        self._reflectance_max = check_scale(reflectance_max)
        root = Path(root)
        topics: set[str] = set()
        ids, self._places, self._said, stored = find_scans(
            root, SUFFIX, lambda path: _survey(path, topic, topics), _in_order
        )
        if topic not in topics and len(topics) > (topic is None):
            raise ConfigError(
                f"{root} has point clouds on {', '.join(sorted(topics))}",
                topic or "one topic",
                "--topic NAME (topic=...) reads one of them.",
            )
        super().__init__(root, ids, sensor, on_bad, stored=stored)
        self.options["reflectance_max"] = self._reflectance_max
        if topic is not None:
            self.options["topic"] = topic

    def read(self, index: int) -> Scan:
        path, place = self._places[index]
        arrays = _points(_message(path, *place), f"{path}: {self.ids[index]}")
        scan = self.as_scan(arrays, self._said[path], path)
        scan.id = self.ids[index]
        return scan


def encode_mcap(scan: Scan) -> bytes:
    """The file of a scan."""
    with needs("mcap", "an MCAP file, but a library"):
        from mcap_ros2.writer import Writer
    records = to_records(scan)
    kinds = {np.dtype(f"<{name}"): number for number, name in TYPES.items()}
    assert records.dtype.fields is not None
    fields = [
        {"name": name, "offset": offset, "datatype": kinds[dtype], "count": 1}
        for name, (dtype, offset, *_) in records.dtype.fields.items()
    ]
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "lidar"},
        "height": 1,
        "width": len(records),
        "fields": fields,
        "is_bigendian": False,
        "point_step": records.itemsize,
        "row_step": records.nbytes,
        "data": records.tobytes(),
        "is_dense": True,
    }
    out = BytesIO()
    with Writer(out) as file:
        schema = file.register_msgdef(MESSAGE, DEFINITION)
        file.write_message(TOPIC, schema, message, log_time=0)
        text = "\n".join(to_comments(scan))
        file.add_metadata(METADATA, {"description": text})
    return out.getvalue()


class MCAPWriter(PCDWriter):
    """Writes ``NAME.mcap``, with what ``PCDWriter`` writes."""

    suffix = SUFFIX
    encode = staticmethod(encode_mcap)


def _in_order(path: Path) -> list[str]:
    """A key that sorts the files of a split record by their numbers: bag_2 before bag_10."""
    return [re.sub(r"\d+", lambda n: n[0].zfill(20), part) for part in path.parts]


def _survey(
    path: Path, topic: str | None, topics: set[str]
) -> tuple[list[tuple[int, int]], Description | None]:
    """The point clouds of a file on a topic, or on all, in the order of their times: the byte of
    the chunk of each, and the offset in it. Also what the file says about them; its topics are
    added to ``topics``."""
    with _opened(path) as (file, reader):
        summary = reader.get_summary()
        if summary is None or (summary.channels and not summary.chunk_indexes):
            raise DataError(
                f"{path} has no index of its messages",
                "a file that was closed",
                f"mcap recover {path} makes one.",
            )
        clouds = {
            number: channel.topic
            for number, channel in summary.channels.items()
            if summary.schemas[channel.schema_id].name == MESSAGE
        }
        topics.update(clouds.values())
        found = [
            (time, (chunk.chunk_start_offset, offset))
            for chunk in summary.chunk_indexes
            for number, start in chunk.message_index_offsets.items()
            if number in clouds and topic in (None, clouds[number])
            for time, offset in _index(file, start)
        ]
        said = _description(reader, str(path))
    return [place for _, place in sorted(found)], said


def _index(file: BinaryIO, start: int) -> list[tuple[int, int]]:
    """Time and offset of each message that an index in a file lists."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import MessageIndex

    stream = ReadDataStream(BytesIO(_record(file, start, _INDEX)))
    records: list[tuple[int, int]] = MessageIndex.read(stream).records
    return records


def _message(path: Path, chunk: int, offset: int) -> Any:
    """A decoded message."""
    with _opened(path) as (file, _):
        from mcap.data_stream import ReadDataStream
        from mcap.records import Message, Schema
        from mcap_ros2.decoder import DecoderFactory

        content = _record(_unpack_chunk(file, chunk), offset, _MESSAGE)
        message = Message.read(ReadDataStream(BytesIO(content)), len(content))
        schema = Schema(1, DEFINITION.encode(), "ros2msg", MESSAGE)
        decode = DecoderFactory().decoder_for("cdr", schema)
        assert decode is not None
        return decode(message.data)


def _unpack_chunk(file: BinaryIO, start: int) -> BytesIO:
    """The decompressed records of a chunk."""
    import zstandard
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk
    from mcap.stream_reader import get_chunk_data_stream

    content = _record(file, start, _CHUNK)
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    declared = [chunk.uncompressed_size]
    if chunk.compression == "zstd":
        declared.append(zstandard.frame_content_size(chunk.data))
    if max(declared) > LARGEST:
        raise ValueError(f"a chunk of {max(declared)} bytes")
    stream, _ = get_chunk_data_stream(chunk, validate_crc=True)
    return BytesIO(stream.read(chunk.uncompressed_size))


def _points(message: Any, where: str) -> dict[str, NDArray[Any]]:
    """The arrays of a message, named as in ``Scan``.

    Raises:
        DataError: on fields or sizes that do not fit together, or without any point.
    """
    count = message.width * message.height
    order = ">" if message.is_bigendian else "<"
    given = [  # some publishers leave the count at 0
        (f.offset, Field(f.name, order + TYPES[f.datatype], max(f.count, 1)))
        for f in message.fields
        if f.datatype in TYPES
    ]
    given = [(at, field) for at, field in given if field.wanted]
    fields = [field for _, field in given]
    check_fields(fields, count, where)
    row = message.width * message.point_step
    if (
        max(at + field.width for at, field in given) > message.point_step
        or row > message.row_step
        or message.row_step * message.height > len(message.data)
    ):
        raise DataError(
            f"{where} has {len(message.data)} bytes for {count} points",
            f"{message.height} rows of {message.row_step} bytes, with all fields",
        )
    names = [field.name for field in fields]
    layout: Any = {"names": names, "itemsize": message.point_step}
    layout["formats"] = [field.type for field in fields]
    layout["offsets"] = [at for at, _ in given]
    data = np.frombuffer(message.data, np.uint8, message.row_step * message.height)
    rows = data.reshape(message.height, message.row_step)[:, :row]
    points = np.frombuffer(rows.tobytes(), np.dtype(layout))
    if not message.is_dense:  # drivers mark firings without return so
        points = points[np.isfinite([points[axis] for axis in "xyz"]).all(0)]
        check_fields(fields, len(points), where)
    return to_arrays({name: points[name] for name in names})


def _description(reader: Any, where: str) -> Description | None:
    """What a file of this package says about its scan; None for those of others."""
    for record in reader.iter_metadata():
        if record.name == METADATA:
            lines = record.metadata.get("description", "").splitlines()
            return from_comments(lines, where)
    return None


def _record(file: BinaryIO, start: int, kind: int) -> bytes:
    """The content of a record of a file or a chunk."""
    size = file.seek(0, 2)
    file.seek(start)
    head = file.read(9)
    length = int.from_bytes(head[1:], "little")
    if len(head) < 9 or head[0] != kind or start + 9 + length > size:
        raise ValueError(f"no record of kind {kind} at byte {start}")
    return file.read(length)


class Bounded:
    """A file that never reads beyond its end: a false length of a record, which the library
    believes, would take as much memory."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._size = file.seek(0, 2)
        self.seek = file.seek
        self.tell = file.tell
        self.seek(0)

    def read(self, size: int) -> bytes:
        return self._file.read(min(size, max(self._size - self.tell(), 0)))


@contextmanager
def _opened(path: Path) -> Iterator[tuple[BinaryIO, Any]]:
    """An open file and the library's reader of it; errors of the library as ``DataError``."""
    with needs("mcap", "an MCAP file, but a library"):
        import mcap_ros2.decoder  # noqa: F401 - the extra has both
        from mcap.reader import SeekingReader
    with open_file(path) as file:
        try:
            bounded: Any = Bounded(file)
            yield bounded, SeekingReader(bounded, record_size_limit=LARGEST)
        except LidarSynthError:
            raise
        except Exception as error:  # each library has its own classes
            raise DataError(
                f"{path} is damaged or no MCAP file ({error!r})", "an intact file"
            ) from error
