"""Files made to do harm: each is refused with an error of this package, within limits of memory and time."""

import io
import json
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from layouts import some_scan, write_all, write_nuscenes, write_tars
from limits import in_limits, needs_limits

from lidar_synth.errors import ConfigError, DataError, LidarSynthError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.convert import SETTINGS, convert
from lidar_synth.formats.pcd import lzf
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.parsing import parse_json, parse_npy, parse_yaml, read_arrays, read_picture
from lidar_synth.train.config import TrainConfig, load_config

CONFIGS = Path(__file__).parents[1] / "configs"


def first_scan(path: Path) -> None:
    open_scans(path)[0]


# PCD and PLY

PCD = {
    "VERSION": "0.7", "FIELDS": "x y z intensity", "SIZE": "4 4 4 4", "TYPE": "F F F F", "COUNT": "1 1 1 1",
    "WIDTH": "10", "HEIGHT": "2", "VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": "20", "DATA": "binary",
}  # fmt: skip
POINTS = np.random.default_rng(0).uniform(0, 1, (20, 4)).astype("<f4")


def literal_lzf(content: bytes) -> bytes:
    """LZF that holds everything as it is, with the two lengths before it."""
    parts = [content[i : i + 32] for i in range(0, len(content), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    return struct.pack("<II", len(packed), len(content)) + packed


BODIES = {
    "binary": POINTS.tobytes(),
    "binary_compressed": literal_lzf(POINTS.T.tobytes()),
    "ascii": "".join(f"{' '.join(map(str, row))}\n" for row in POINTS).encode(),
}


def pcd(body: bytes | None = None, **changes: str) -> bytes:
    """A PCD file whose header says something else."""
    header = PCD | changes
    lines = "".join(f"{key} {value}\n" for key, value in header.items() if value)
    return lines.encode() + (BODIES[header["DATA"]] if body is None else body)


LYING_PCD = {
    "many values per point": pcd(COUNT="100000 1 1 1"),
    "many values per point, compressed": pcd(COUNT="1 1 1 100000", DATA="binary_compressed"),
    "many values per point, in text": pcd(COUNT="1 100000 1 1", DATA="ascii"),
    "more values than memory": pcd(COUNT="1 1 1 999999999999"),
    "more values than memory, in text": pcd(COUNT="1 1 1 999999999999", DATA="ascii"),
    "no values": pcd(COUNT="1 1 1 0"),
    "a field twice": pcd(FIELDS="x x z y"),
    "a fifth field twice": pcd(
        FIELDS="x y z intensity intensity", SIZE="4 4 4 4 4", TYPE="F F F F F", COUNT="1 1 1 1 1", WIDTH="8",
        POINTS="16",
    ),
    "more points": pcd(POINTS="21"),
    "fewer points": pcd(POINTS="19"),
    "fewer points everywhere": pcd(POINTS="10", WIDTH="5"),
    "fewer points everywhere, in text": pcd(POINTS="10", WIDTH="5", DATA="ascii"),
    "fewer points everywhere, compressed": pcd(POINTS="10", WIDTH="5", DATA="binary_compressed"),
    "more points than memory": pcd(WIDTH="999999999999", HEIGHT="1", POINTS="999999999999"),
    "more points than memory, in text": pcd(WIDTH="999999999999", HEIGHT="1", POINTS="999999999999", DATA="ascii"),
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
        struct.pack("<II", 80, 0xFFFFFFF0) + bytes(80), DATA="binary_compressed", WIDTH="268435455", HEIGHT="1",
        POINTS="268435455",
    ),
    "compressed, with less": pcd(BODIES["binary_compressed"][:-9], DATA="binary_compressed"),
    "compressed, from before the start": pcd(
        struct.pack("<II", 6, 320) + b"\xff\xff\xff" * 2, DATA="binary_compressed"
    ),
    "compressed, a run beyond the end": pcd(
        struct.pack("<II", 32, 320) + b"\0\0" + b"\xe0\xff\0" * 10, DATA="binary_compressed"
    ),
}  # fmt: skip

PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 20\nproperty float x\nproperty float y\n"
    b"property float z\nproperty float intensity\nend_header\n"
)

LYING_PLY = {
    "more points": PLY.replace(b"20", b"21") + BODIES["binary"],
    "fewer points": PLY.replace(b"20", b"19") + BODIES["binary"],
    "more points than memory": PLY.replace(b"20", b"999999999999") + BODIES["binary"],
    "a field twice": PLY.replace(b" y\n", b" x\n") + BODIES["binary"],
    "a type that is none": PLY.replace(b"float y", b"flout y") + BODIES["binary"],
    "a list of points": PLY.replace(b"float y", b"list uchar float y") + BODIES["binary"],
    "two encodings": PLY.replace(b"element", b"format ascii 1.0\nelement") + BODIES["binary"],
    "two vertices": PLY.replace(b"end_header", b"element vertex 3\nend_header") + BODIES["binary"],
    "a property of nothing": PLY.replace(b"element", b"property float x\nelement") + BODIES["binary"],
    "lists before the points": PLY.replace(b"element", b"element face 9\nproperty list uint int i\nelement", 1)
    + BODIES["binary"],
    "text with more lines": PLY.replace(b"binary_little_endian", b"ascii") + BODIES["ascii"] * 2,
}  # fmt: skip


@needs_limits
@pytest.mark.parametrize(
    ("suffix", "name"), [(".pcd", name) for name in LYING_PCD] + [(".ply", name) for name in LYING_PLY]
)
def test_a_header_that_lies(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / f"scan{suffix}"
    path.write_bytes({".pcd": LYING_PCD, ".ply": LYING_PLY}[suffix][name])
    found = in_limits(first_scan, path)
    assert found.startswith("DataError: "), found or "read without a word"


@pytest.mark.parametrize("data", BODIES)
def test_the_same_points_in_every_encoding(tmp_path: Path, data: str) -> None:
    path = tmp_path / "scan.pcd"
    padded = pcd(FIELDS="_ x y z intensity _ ring", SIZE="1 4 4 4 4 2 4", TYPE="U F F F F U I", COUNT="3 1 1 1 1 2 1")
    for content in (pcd(DATA=data), padded.replace(BODIES["binary"], with_padding()) if data == "binary" else pcd()):
        path.write_bytes(content)
        scan = open_scans(path)[0]
        assert np.array_equal(scan.points, POINTS[:, :3]) and np.array_equal(scan.reflectance, POINTS[:, 3])
    if data == "binary":
        assert scan.ring is not None and np.array_equal(scan.ring, np.arange(20))


def with_padding() -> bytes:
    kind = np.dtype([("pad", "u1", 3), ("points", "<f4", 4), ("pad2", "<u2", 2), ("ring", "<i4")])
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
        header.replace(b"end_header", b"element face 1\nproperty list uchar int i\nend_header")
        + records.tobytes() + b"\x01\0\0\0\x05",
        PLY.replace(b"element vertex", b"element note 2\nproperty uchar n\nelement vertex") + b"ab" + BODIES["binary"],
    ):  # fmt: skip
        path.write_bytes(content)
        assert np.array_equal(open_scans(path)[0].points, POINTS[:, :3])


def damaged_streams() -> None:
    """In a process of its own: compiled code that left its arrays would end it."""
    rng = np.random.default_rng(0)
    packed = np.frombuffer(literal_lzf(POINTS.tobytes())[8:] + b"\xe0\x00\x07" * 20, np.uint8)
    for _ in range(3000):
        stream = packed.copy()
        stream[rng.integers(0, len(stream), 5)] = rng.integers(0, 256, 5)
        target = np.zeros(rng.integers(0, 700) + 8, np.uint8)
        target[-8:] = 123
        written = lzf(stream[: rng.integers(0, len(stream))], target[:-8])
        assert -1 <= written <= len(target) - 8 and (target[-8:] == 123).all()


@needs_limits
def test_compressed_points_that_are_damaged_stay_within_their_arrays() -> None:
    assert in_limits(damaged_streams) == ""


# Arrays


def npy(header: str, body: bytes = b"", version: int = 1) -> bytes:
    content = header.encode("latin-1") + b"\n"
    width = {1: 2, 2: 4, 3: 4}[version]
    return b"\x93NUMPY" + bytes([version, 0]) + len(content).to_bytes(width, "little") + content + body


def described(descr: str = "'<f4'", shape: str = "(20, 4)", order: str = "False") -> str:
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"


def saved(array: object, *, pickled: bool = False) -> bytes:
    content = io.BytesIO()
    np.save(content, np.asarray(array), allow_pickle=pickled)
    return content.getvalue()


HOSTILE_NPY = {
    "160 GB": npy(described(shape="(10000000000, 4)"), bytes(64)),
    "more than bits": npy(described(shape="(4611686018427387904, 8)"), b""),
    "nothing of much": npy(described(shape="(0, 99999999999, 99999999999)"), b""),
    "a token that does not end": npy("{'descr': '<f4', 'fortran_order': False, 'shape': (3L"),
    "deep": npy("(" * 5000),
    "minus": npy("-" * 9000 + "1"),
    "blanks": npy("{'descr': '<f4'," + " " * 9900),
    "digits": npy(described(shape=f"({'9' * 5000},)")),
    "a list": npy("[1, 2]"),
    "negative": npy(described(shape="(-20, -4)"), BODIES["binary"]),
    "fewer values": npy(described(shape="(19, 4)"), BODIES["binary"]),
    "more values": npy(described(shape="(21, 4)"), BODIES["binary"]),
    "complex": saved(POINTS.astype("c8")),
    "objects": saved([{"a": 1}], pickled=True),
    "records": saved(np.zeros(20, [("x", "<f4"), ("y", "<f4")])),
    "text": saved(POINTS.astype(str)),
    "dates": saved(np.zeros((20, 4), "M8[s]")),
    "no scan": saved(5.0),
    "empty": saved(np.zeros((0, 4), "f4")),
    "a long header": npy(" " * 60_000 + described(), BODIES["binary"]),
    "a header beyond the end": b"\x93NUMPY\x02\0\xff\xff\xff\xff{",
    "version 9": b"\x93NUMPY\x09" + npy(described(), BODIES["binary"])[7:],
}


@needs_limits
@pytest.mark.parametrize("name", HOSTILE_NPY)
def test_an_array_that_is_no_scan(tmp_path: Path, name: str) -> None:
    path = tmp_path / "scan.npy"
    path.write_bytes(HOSTILE_NPY[name])
    assert in_limits(read_both, path, seconds=20) == ""


def read_both(path: Path) -> None:
    """As points and as a range image."""
    for layout in ("folder", "range"):
        with pytest.raises((DataError, ConfigError)):
            open_scans(path, layout=layout)[0]


@given(
    st.sampled_from(["b1", "i1", "u1", "<i4", ">i4", "<u8", "<f2", "<f4", ">f8", "<U3", ">U3"]),
    st.lists(st.integers(0, 4), max_size=4),
    st.booleans(),
    st.booleans(),
)
def test_arrays_are_what_numpy_reads(kind: str, shape: list[int], fortran: bool, text: bool) -> None:
    array = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(kind)
    content = saved(np.asfortranarray(array) if fortran and array.ndim else array)
    read, expected = parse_npy(content, "here"), np.load(io.BytesIO(content))
    assert read.dtype == expected.dtype and np.array_equal(read, expected) and read.shape == expected.shape
    start = 10 + content[8] + 256 * content[9]
    old = content[:start].replace(b"'", b'"') + content[start:] if text else content  # as others write it
    assert np.array_equal(parse_npy(old, "here"), expected) and read.flags.writeable


@given(st.binary(max_size=60), st.integers(0, 150))
def test_any_bytes_are_an_array_or_refused(noise: bytes, place: int) -> None:
    content = saved(POINTS)
    for damaged in (noise, content[:place] + noise, content[:place] + noise + content[place + len(noise) :]):
        with suppress(DataError):
            parse_npy(damaged, "here")


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method, compresslevel=1) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return content.getvalue()


def patched(content: bytes, *, local: dict[int, bytes], central: dict[int, bytes]) -> bytes:
    """Other bytes in the two headers of a ZIP file's only member."""
    changed, start = bytearray(content), content.index(b"PK\1\2")
    for base, places in ((0, local), (start, central)):
        for offset, value in places.items():
            changed[base + offset : base + offset + len(value)] = value
    return bytes(changed)


def hostile_npz(name: str) -> bytes:
    scan = zipped({"array.npy": saved(POINTS)})
    match name:
        case "a bomb":
            return zipped({"points.npy": npy(described(shape="(10000000, 4)"), bytes(160_000_000))})
        case "a bomb of many":
            return zipped({f"a{i}.npy": npy(described(shape="(1000000, 4)"), bytes(16_000_000)) for i in range(10)})
        case "a bomb that says it is small":
            bomb = zipped({"points.npy": npy(described(shape="(10000000, 4)"), bytes(160_000_000))})
            return patched(bomb, local={22: struct.pack("<I", 4000)}, central={24: struct.pack("<I", 4000)})
        case "stored, and more than the file":
            size = struct.pack("<I", 0xF0000000)
            return patched(zipped({"a.npy": b"x"}, zipfile.ZIP_STORED), local={18: size * 2}, central={20: size * 2})
        case "encrypted":
            return patched(scan, local={6: b"\1"}, central={8: b"\1"})
        case "another method":
            return patched(scan, local={8: b"\x63"}, central={10: b"\x63"})
        case "a later version":
            return patched(scan, local={4: b"\xff"}, central={6: b"\xff"})
        case "lzma":
            return zipped({"array.npy": saved(POINTS)}, zipfile.ZIP_LZMA)
        case "no array":
            return zipped({"points.npy": b"text", "range": b"text"})
        case "cut inside":
            return scan[: len(scan) // 2]
        case "another sum":
            return patched(scan, local={}, central={16: b"\0\0\0\0"})
        case "a name twice":
            one = zipped({"sensor.npy": saved("a"), "sensos.npy": saved("b")})
            return one.replace(b"sensos", b"sensor")
        case "160 GB":
            return zipped({"points.npy": HOSTILE_NPY["160 GB"]})
        case _:
            return zipped({})


NPZ = ["a bomb", "a bomb of many", "a bomb that says it is small", "stored, and more than the file", "encrypted",
       "another method", "a later version", "lzma", "no array", "cut inside", "another sum", "a name twice", "160 GB",
       "nothing"]  # fmt: skip


@needs_limits
@pytest.mark.parametrize("name", NPZ)
def test_an_archive_that_is_no_scan(tmp_path: Path, name: str) -> None:
    path = tmp_path / "scan.npz"
    path.write_bytes(hostile_npz(name))
    assert in_limits(read_archive, path, megabytes=300) == ""


def read_archive(path: Path) -> None:
    read_both(path)
    with pytest.raises(DataError):
        ObjectBank.load(path) if path.stat().st_size < 100_000 else read_arrays(path)


def changed(path: Path, **arrays: object) -> None:
    with np.load(path) as loaded:
        known = {name: loaded[name] for name in loaded.files}
    np.savez(path, **(known | {name: np.asarray(value) for name, value in arrays.items()}))


@pytest.mark.parametrize("to", ["npz", "range"])
@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("domain", np.inf, "domain is float64"),
        ("domain", 7, "domain is 7, not 0"),
        ("domain", [0, 1], "domain is .* of shape"),
        ("id", 5.0, "id is float64"),
        ("pose", np.eye(3), r"pose is float64 of shape \(3, 3\)"),
        ("pose", np.full((4, 4), np.nan), "pose is"),
        ("pose", "north", "pose is"),
        ("sensor", "[1, 2]", "a sensor of type list"),
        ("sensor", "[" * 100_000, "not JSON"),
        ("sensor", '{"name": "x", "columns": 1e999}', "without|columns"),
        ("sensor", '{"name": "x", "columns": 2000000000, "rows": 2000000000, "range_min": 1, "range_max": 80, '
                   '"fov_up": 3, "fov_down": -25}', "at most 4194304 cells"),
        ("box_names", 3.0, "the boxes' names"),
        ("box_values", np.zeros((2, 5)), "box|reshape"),
        ("box_occlusion", "north", "invalid literal|could not|shape"),
        ("reflectance", "bright", "reflectance is"),
    ],
)  # fmt: skip
def test_facts_that_are_none(tmp_path: Path, to: str, name: str, value: object, message: str) -> None:
    [path] = write_all(to, tmp_path, [some_scan()])
    changed(path, **{name: value})
    with pytest.raises(DataError, match=f"{path.name}.*({message})"):
        open_scans(path)[0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_a_range_that_is_none_is_not_dropped(tmp_path: Path, value: float) -> None:
    [path] = write_all("range", tmp_path, [some_scan()])
    with np.load(path) as loaded:
        distance = loaded["range"].copy()
    distance[np.unravel_index(distance.argmax(), distance.shape)] = value
    changed(path, range=distance)
    np.save(tmp_path / "alone.npy", distance)
    for file in (path, tmp_path / "alone.npy"):
        with pytest.raises(DataError, match="1 cells whose range is negative or no number"):
            open_scans(file)[0]


# Sensors and configurations

LINEAR = {"columns": 64, "rows": 8, "fov_up": 3.0, "fov_down": -25.0, "range_min": 1.0, "range_max": 80.0}
TABLE = {"columns": 64, "elevations": [2.0, 1.0, 0.0], "range_min": 1.0, "range_max": 80.0}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (TABLE | {"elevations": "high"}, "elevations = 'high'; expected a list of finite numbers"),
        (TABLE | {"elevations": []}, r"elevations = \[\]; expected a list of finite numbers"),
        (TABLE | {"elevations": ["2", "1"]}, "a list of finite numbers"),
        (TABLE | {"elevations": [[2.0], [1.0]]}, "a list of finite numbers"),
        (TABLE | {"elevations": [2.0, float("nan")]}, "a list of finite numbers"),
        (TABLE | {"elevations": {2.0: 1.0}}, "a list of finite numbers"),
        (TABLE | {"elevations": [2.0]}, "at least 2 rows"),
        (TABLE | {"elevations": 5.0}, "a list of finite numbers"),
        (TABLE | {"beams": "low"}, "beams = 'low'"),
        (TABLE | {"heights": [True, True, True]}, "a list of finite numbers"),
        (LINEAR | {"rows": 64.5}, "rows = 64.5; expected a whole number"),
        (LINEAR | {"rows": True}, "rows = True; expected a whole number"),
        (LINEAR | {"rows": "64"}, "rows = '64'; expected a whole number"),
        (LINEAR | {"columns": 64.0}, "columns = 64.0; expected a whole number"),
        (LINEAR | {"columns": None}, "columns = None; expected a whole number"),
        (LINEAR | {"rows": 2_000_000_000, "columns": 2_000_000_000}, "expected at most 4194304 cells"),
        (LINEAR | {"rows": 10**2000}, "expected at most 4194304 cells"),
        (LINEAR | {"range_max": float("inf")}, "range_max = inf; expected a finite number"),
        (LINEAR | {"range_max": 10**400}, "a finite number"),
        (LINEAR | {"range_min": "near"}, "range_min = 'near'; expected a finite number"),
        (LINEAR | {"fov_up": [3.0]}, r"fov_up = \[3.0\]; expected a finite number"),
        (LINEAR | {"description": [1]}, "expected text"),
        (LINEAR | {7: 7}, r"sensor keys \[7\]"),
        ({"columns": 64}, "without range_min, range_max"),
        ("text", "holds dict; expected a mapping from a sensor's name"),
    ],
)
def test_a_sensor_that_is_none(tmp_path: Path, values: object, message: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"mine": values}))
    with pytest.raises(ConfigError, match=message):
        load_sensor(path)
    if isinstance(values, dict):
        with pytest.raises(ConfigError):
            Sensor.from_dict({"name": "mine", **values})


def laughs(levels: int, times: int = 9) -> str:
    lines = ["a0: &a0 [1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * times)}]" for i in range(1, levels)]
    return "\n".join(lines)


HOSTILE_YAML = {
    "a billion laughs": laughs(30),
    "laughs that are merged": "a0: &a0 {x: 1}\n"
    + "\n".join(f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)),
    "an alias in itself": "a: &a [*a]",
    "an alias of nothing": "a: *b",
    "deep": "[" * 100_000,
    "deep mappings": "{a: " * 50_000,
    "deep blocks": "\n".join(f"{' ' * i}a:" for i in range(600)),
    "long": "a: b\n" * 200_000,
    "many": "[" + "1," * 30_000 + "]",
    "a tag": "a: !!int ''",
    "a tag of time": "a: !!timestamp x",
    "a tag of Python": "a: !!python/object/apply:os.getcwd []",
    "no month": "a: 2001-99-99",
    "no digits": "a: 0b_",
    "a long number": f"a: 0x{'f' * 20_000}",
    "a key that is none": "? {a: b}\n: c",
    "not closed": 'a: "',
    "control": "a: \x01",
    "two documents": "a: 1\n---\nb: 2",
}


def open_yaml(path: Path) -> None:
    for read in (load_sensor, lambda p: load_config(TrainConfig, p)):
        with pytest.raises((ConfigError, DataError)) as caught:
            read(path)
        assert len(str(caught.value)) < 2000


@needs_limits
@pytest.mark.parametrize("name", HOSTILE_YAML)
def test_yaml_that_is_no_configuration(tmp_path: Path, name: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(HOSTILE_YAML[name])
    assert in_limits(open_yaml, path, megabytes=200, seconds=30) == ""


def test_yaml_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"mine: \xff\xfe")
    open_yaml(path)


def test_anchors_in_reason_stay_possible() -> None:
    assert parse_yaml(laughs(3), "here")["a2"][8][8] == [1, 1]
    assert parse_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}", "here")["b"] == {"x": 1, "y": 2}
    for path in [*CONFIGS.glob("*.yaml")]:
        assert parse_yaml(path.read_text(), path.name) == yaml.safe_load(path.read_text())


@given(st.text(max_size=60) | st.text(st.sampled_from("&*ab:- []{}!\n?|>'\"%0x_1."), max_size=60))
def test_any_text_is_yaml_or_refused(text: str) -> None:
    with suppress(ConfigError):
        parse_yaml(text, "here")


# Text and pictures beside the scans

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
    framed = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def deep_tar(root: Path) -> Path:
    tar_with(root / "scans.tar", {"0.json": DEEP.encode(), "0.points.npy": saved(POINTS)})
    return root


def listed_tar(root: Path) -> Path:
    tar_with(root / "scans.tar", {"0.json": b"[1]", "0.points.npy": saved(POINTS)})
    return root


def infinite_tar(root: Path) -> Path:
    facts = {"id": "0", "domain": 0, "sensor": {"name": "x"} | LINEAR}
    text = json.dumps(facts).replace('"domain": 0', '"domain": 1e999')
    tar_with(root / "scans.tar", {"0.json": text.encode(), "0.points.npy": saved(POINTS)})
    return root


def big_array_in_a_tar(root: Path) -> Path:
    tar_with(root / "scans.tar", {"0.json": b"{}", "0.points.npy": HOSTILE_NPY["160 GB"]})
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
    (root / "scans.tar").write_bytes(tar_header(b"\x80" + (1 << 40).to_bytes(11, "big"), b"x") + bytes(4096))
    return root


def sparse_tar(root: Path) -> Path:
    (root / "scans.tar").write_bytes(tar_header(b"00000000000\0", b"S") + bytes(4096))
    return root


def twice_in_a_tar(root: Path) -> Path:
    [path, *others] = write_tars(root)
    path.write_bytes(path.read_bytes()[:-10240].rstrip(b"\0").ljust(1 << 16, b"\0") + others[0].read_bytes())
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
    path.write_bytes(picture(1024, 64, b"zTXtlidar_synth\0\0" + zlib.compress(b"[" * 80_000_000, 1)))
    return root


def deep_table(root: Path) -> Path:
    write_nuscenes(root)
    (root / "v1.0-mini" / "sample_data.json").write_text(DEEP)
    return root


def table_of_numbers(root: Path) -> Path:
    write_nuscenes(root)
    (root / "v1.0-mini" / "lidarseg.json").write_text('[{"sample_data_token": "token0", "filename": 7}]')
    return root


@needs_limits
@pytest.mark.parametrize(
    "make",
    [
        deep_tar, listed_tar, infinite_tar, big_array_in_a_tar, negative_tar, greedy_tar, sparse_tar, twice_in_a_tar,
        big_picture, bigger_picture, deep_picture, text_bomb_in_a_picture, deep_table, table_of_numbers,
    ],
)  # fmt: skip
def test_what_stands_beside_the_points(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    assert in_limits(first_scan, make(tmp_path), seconds=30).startswith("DataError: ")


def test_a_camera_picture_that_is_none(tmp_path: Path) -> None:
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
