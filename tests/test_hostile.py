"""Files made to do harm: each is refused with an error of this package, within limits of memory and
time."""

import io
import json
import struct
import tarfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hostile import BODIES, HOSTILE_NPY, LINEAR, POINTS, literal_lzf, saved
from layouts import some_scan, write_all, write_nuscenes, write_tars
from limits import in_limits, needs_limits

from lidar_synth.errors import DataError, LidarSynthError
from lidar_synth.files.parsing import parse_json, read_picture
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.convert import SETTINGS, convert
from lidar_synth.formats.pcd import lzf


def first_scan(path: Path) -> None:
    open_scans(path)[0]


PCD = {
    "VERSION": "0.7",
    "FIELDS": "x y z intensity",
    "SIZE": "4 4 4 4",
    "TYPE": "F F F F",
    "COUNT": "1 1 1 1",
    "WIDTH": "10",
    "HEIGHT": "2",
    "VIEWPOINT": "0 0 0 1 0 0 0",
    "POINTS": "20",
    "DATA": "binary",
}


def pcd(body: bytes | None = None, **changes: str) -> bytes:
    """A PCD file whose header says something else."""
    header = PCD | changes
    lines = "".join(f"{key} {value}\n" for key, value in header.items() if value)
    return lines.encode() + (BODIES[header["DATA"]] if body is None else body)


FALSE_PCD = {
    "many values per point": pcd(COUNT="100000 1 1 1"),
    "many values per point, compressed": pcd(
        COUNT="1 1 1 100000", DATA="binary_compressed"
    ),
    "many values per point, in text": pcd(COUNT="1 100000 1 1", DATA="ascii"),
    "more values than memory": pcd(COUNT="1 1 1 999999999999"),
    "more values than memory, in text": pcd(COUNT="1 1 1 999999999999", DATA="ascii"),
    "no values": pcd(COUNT="1 1 1 0"),
    "a field twice": pcd(FIELDS="x x z y"),
    "a fifth field twice": pcd(
        FIELDS="x y z intensity intensity",
        SIZE="4 4 4 4 4",
        TYPE="F F F F F",
        COUNT="1 1 1 1 1",
        WIDTH="8",
        POINTS="16",
    ),
    "more points": pcd(POINTS="21"),
    "fewer points": pcd(POINTS="19"),
    "fewer points everywhere": pcd(POINTS="10", WIDTH="5"),
    "fewer points everywhere, in text": pcd(POINTS="10", WIDTH="5", DATA="ascii"),
    "fewer points everywhere, compressed": pcd(
        POINTS="10", WIDTH="5", DATA="binary_compressed"
    ),
    "more points than memory": pcd(
        WIDTH="999999999999", HEIGHT="1", POINTS="999999999999"
    ),
    "more points than memory, in text": pcd(
        WIDTH="999999999999", HEIGHT="1", POINTS="999999999999", DATA="ascii"
    ),
    "more points than bits": pcd(WIDTH="4294967296", HEIGHT="4294967296", POINTS="0"),
    "no points": pcd(b"", WIDTH="0", POINTS="0"),
    "negative": pcd(WIDTH="-10", HEIGHT="-2"),
    "no size": pcd(SIZE="4 4 4"),
    "size 3": pcd(SIZE="4 4 3 4"),
    "a type that is none": pcd(TYPE="F F X F"),
    "size twice": pcd(VERSION="0.7\nSIZE 8 8 8 8"),
    "no width": pcd(WIDTH=""),
    "no depth": pcd(FIELDS="x y w intensity"),
    "another encoding": pcd(b"", DATA="binary_rot13"),
    "a long header": b"# " + b"x" * 100_000 + b"\n" + pcd(),
    "ragged text": pcd(BODIES["ascii"].replace(b"\n", b" 1\n", 1), DATA="ascii"),
    "words": pcd(BODIES["ascii"].replace(b"0.", b"o.", 1), DATA="ascii"),
    "half an integer": pcd(TYPE="F F F U", DATA="ascii"),
    "compressed to more than memory": pcd(
        struct.pack("<II", 80, 0xFFFFFFF0) + bytes(80),
        DATA="binary_compressed",
        WIDTH="268435455",
        HEIGHT="1",
        POINTS="268435455",
    ),
    "compressed, with less": pcd(
        BODIES["binary_compressed"][:-9], DATA="binary_compressed"
    ),
    "compressed, from before the start": pcd(
        struct.pack("<II", 6, 320) + b"\xff\xff\xff" * 2, DATA="binary_compressed"
    ),
    "compressed, a run beyond the end": pcd(
        struct.pack("<II", 32, 320) + b"\0\0" + b"\xe0\xff\0" * 10,
        DATA="binary_compressed",
    ),
}


PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 20\nproperty float x\nproperty float y\n"
    b"property float z\nproperty float intensity\nend_header\n"
)


FALSE_PLY = {
    "more points": PLY.replace(b"20", b"21") + BODIES["binary"],
    "fewer points": PLY.replace(b"20", b"19") + BODIES["binary"],
    "more points than memory": PLY.replace(b"20", b"999999999999") + BODIES["binary"],
    "a field twice": PLY.replace(b" y\n", b" x\n") + BODIES["binary"],
    "a type that is none": PLY.replace(b"float y", b"flout y") + BODIES["binary"],
    "a list of points": PLY.replace(b"float y", b"list uchar float y")
    + BODIES["binary"],
    "two encodings": PLY.replace(b"element", b"format ascii 1.0\nelement")
    + BODIES["binary"],
    "two vertices": PLY.replace(b"end_header", b"element vertex 3\nend_header")
    + BODIES["binary"],
    "a property of nothing": PLY.replace(b"element", b"property float x\nelement")
    + BODIES["binary"],
    "lists before the points": PLY.replace(
        b"element", b"element face 9\nproperty list uint int i\nelement", 1
    )
    + BODIES["binary"],
    "text with more lines": PLY.replace(b"binary_little_endian", b"ascii")
    + BODIES["ascii"] * 2,
}


@pytest.mark.slow
@needs_limits
@pytest.mark.parametrize(
    ("suffix", "name"),
    [(".pcd", name) for name in FALSE_PCD] + [(".ply", name) for name in FALSE_PLY],
)
def test_false_headers_are_refused(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / f"scan{suffix}"
    path.write_bytes({".pcd": FALSE_PCD, ".ply": FALSE_PLY}[suffix][name])
    found = in_limits(first_scan, path)
    assert found.startswith("DataError: "), found or "read without a word"


@pytest.mark.parametrize("data", BODIES)
def test_the_same_points_in_every_encoding(tmp_path: Path, data: str) -> None:
    path = tmp_path / "scan.pcd"
    padded = pcd(
        FIELDS="_ x y z intensity _ ring",
        SIZE="1 4 4 4 4 2 4",
        TYPE="U F F F F U I",
        COUNT="3 1 1 1 1 2 1",
    )
    for content in (
        pcd(DATA=data),
        padded.replace(BODIES["binary"], with_padding()) if data == "binary" else pcd(),
    ):
        path.write_bytes(content)
        source = open_scans(path)
        source.skip_sensor_check()  # these points are of no sensor
        scan = source[0]
        assert np.array_equal(scan.points, POINTS[:, :3]) and np.array_equal(
            scan.reflectance, POINTS[:, 3]
        )
    if data == "binary":
        assert scan.ring is not None and np.array_equal(scan.ring, np.arange(20))


def with_padding() -> bytes:
    kind = np.dtype(
        [("pad", "u1", 3), ("points", "<f4", 4), ("pad2", "<u2", 2), ("ring", "<i4")]
    )
    records = np.full(20, 7, kind)
    records["points"], records["ring"] = POINTS, np.arange(20)
    return records.tobytes()


def test_big_endian_ply_and_faces_after_the_points(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    header = PLY.replace(b"little", b"big").replace(b"float x", b"double x")
    records = np.empty(20, [("x", ">f8"), ("rest", ">f4", 3)])
    records["x"], records["rest"] = POINTS[:, 0], POINTS[:, 1:]
    for content in (
        header + records.tobytes(),
        header.replace(
            b"end_header", b"element face 1\nproperty list uchar int i\nend_header"
        )
        + records.tobytes()
        + b"\x01\0\0\0\x05",
        PLY.replace(
            b"element vertex", b"element note 2\nproperty uchar n\nelement vertex"
        )
        + b"ab"
        + BODIES["binary"],
    ):
        path.write_bytes(content)
        assert np.array_equal(open_scans(path)[0].points, POINTS[:, :3])


def damaged_streams() -> None:
    """In a process of its own: compiled code that left its arrays would end it."""
    rng = np.random.default_rng(0)
    packed = np.frombuffer(
        literal_lzf(POINTS.tobytes())[8:] + b"\xe0\x00\x07" * 20, np.uint8
    )
    for _ in range(3000):
        stream = packed.copy()
        stream[rng.integers(0, len(stream), 5)] = rng.integers(0, 256, 5)
        target = np.zeros(rng.integers(0, 700) + 8, np.uint8)
        target[-8:] = 123
        written = lzf(stream[: rng.integers(0, len(stream))], target[:-8])
        assert -1 <= written <= len(target) - 8 and (target[-8:] == 123).all()


@pytest.mark.slow
@needs_limits
def test_compressed_points_that_are_damaged_stay_within_their_arrays() -> None:
    assert in_limits(damaged_streams) == ""


DEEP = "[" * 200_000


def tar_with(path: Path, members: dict[str, bytes]) -> None:
    with tarfile.open(path, "w") as tar:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))


def picture(width: int, height: int, *chunks: bytes) -> bytes:
    """A PNG of this size, of which no line is there."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    parts = (header, *chunks, b"IDAT" + zlib.compress(b""), b"IEND")
    framed = (
        struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part))
        for part in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def deep_tar(root: Path) -> Path:
    tar_with(
        root / "scans.tar", {"0.json": DEEP.encode(), "0.points.npy": saved(POINTS)}
    )
    return root


def listed_tar(root: Path) -> Path:
    tar_with(root / "scans.tar", {"0.json": b"[1]", "0.points.npy": saved(POINTS)})
    return root


def infinite_tar(root: Path) -> Path:
    facts = {"id": "0", "domain": 0, "sensor": {"name": "x"} | LINEAR}
    text = json.dumps(facts).replace('"domain": 0', '"domain": 1e999')
    tar_with(
        root / "scans.tar", {"0.json": text.encode(), "0.points.npy": saved(POINTS)}
    )
    return root


def big_array_in_a_tar(root: Path) -> Path:
    tar_with(
        root / "scans.tar", {"0.json": b"{}", "0.points.npy": HOSTILE_NPY["160 GB"]}
    )
    return root


def tar_header(size: bytes, kind: bytes = b"0") -> bytes:
    header = bytearray(tarfile.TarInfo("0.json").tobuf())
    header[124:136], header[156:157], header[148:156] = size, kind, b" " * 8
    header[148:156] = f"{sum(header):06o}\0 ".encode()
    return bytes(header)


def negative_tar(root: Path) -> Path:
    (root / "scans.tar").write_bytes(tar_header(b"\xff" * 10 + b"\xfe\x00") * 4)
    return root


def greedy_tar(root: Path) -> Path:
    (root / "scans.tar").write_bytes(
        tar_header(b"\x80" + (1 << 40).to_bytes(11, "big"), b"x") + bytes(4096)
    )
    return root


def sparse_tar(root: Path) -> Path:
    (root / "scans.tar").write_bytes(tar_header(b"00000000000\0", b"S") + bytes(4096))
    return root


def twice_in_a_tar(root: Path) -> Path:
    [path, *others] = write_tars(root)
    path.write_bytes(
        path.read_bytes()[:-10240].rstrip(b"\0").ljust(1 << 16, b"\0")
        + others[0].read_bytes()
    )
    tar_with(path, {"0.json": b"{}"})
    content = path.read_bytes()[:1024]
    path.write_bytes(content * 2 + bytes(1024))
    return root


def big_picture(root: Path) -> Path:
    [path] = write_all("png", root, [some_scan()])
    path.write_bytes(picture(60_000, 60_000))
    return root


def bigger_picture(root: Path) -> Path:
    [path] = write_all("png", root, [some_scan()])
    path.write_bytes(picture(2**31 - 1, 2**31 - 1))
    return root


def deep_picture(root: Path) -> Path:
    [path] = write_all("png", root, [some_scan()])
    from lidar_synth.formats.png import write_png

    write_png(path, np.ones((64, 1024), "u2"), text=DEEP)
    return root


def text_bomb_in_a_picture(root: Path) -> Path:
    [path] = write_all("png", root, [some_scan()])
    path.write_bytes(
        picture(1024, 64, b"zTXtlidar_synth\0\0" + zlib.compress(b"[" * 80_000_000, 1))
    )
    return root


def deep_table(root: Path) -> Path:
    write_nuscenes(root)
    (root / "v1.0-mini" / "sample_data.json").write_text(DEEP)
    return root


def table_of_numbers(root: Path) -> Path:
    write_nuscenes(root)
    (root / "v1.0-mini" / "lidarseg.json").write_text(
        '[{"sample_data_token": "token0", "filename": 7}]'
    )
    return root


@pytest.mark.slow
@needs_limits
@pytest.mark.parametrize(
    "make",
    [
        deep_tar,
        listed_tar,
        infinite_tar,
        big_array_in_a_tar,
        negative_tar,
        greedy_tar,
        sparse_tar,
        twice_in_a_tar,
        big_picture,
        bigger_picture,
        deep_picture,
        text_bomb_in_a_picture,
        deep_table,
        table_of_numbers,
    ],
)
def test_hostile_side_files_are_refused(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    assert in_limits(first_scan, make(tmp_path), seconds=30).startswith("DataError: ")


def test_invalid_camera_images_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    scan = some_scan(count=60)
    scan.image_path = path
    for content in (b"no picture", picture(60_000, 60_000)):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"image.jpg (cannot be read|has)"):
            WRITERS["semantic_kitti"](tmp_path / "out").write(scan, 0)
        with pytest.raises(DataError, match=r"image.jpg"):
            read_picture(path)


@pytest.mark.parametrize("text", ["{", "[]", "7", DEEP])
def test_settings_of_a_folder_that_are_damaged(tmp_path: Path, text: str) -> None:
    (tmp_path / SETTINGS).write_text(text)
    with pytest.raises(DataError, match="damaged"):
        convert([some_scan(count=60)], WRITERS["npz"](tmp_path), progress=False)


def test_json_of_any_depth() -> None:
    for text in (DEEP, '{"a":' * 200_000, b"\xff", "1" * 5000):
        with pytest.raises(LidarSynthError, match="here is not JSON"):
            parse_json(text, "here")
