"""Hostile arrays and archives (.npy, .npz): each is refused with an error of this package."""

import io
import struct
import tarfile
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fuzzing.worker import causes
from hostile import HOSTILE_NPY, POINTS, described, npy, saved
from hypothesis import given, strategies as st
from layouts import some_scan, write_all
from limits import in_limits, needs_limits

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.parsing import parse_npy, read_arrays
from lidar_synth.formats import open_scans
from lidar_synth.lab.evaluate.extractors.archive import Archive
from lidar_synth.labels.bank import ObjectBank


@pytest.mark.slow
@needs_limits
@pytest.mark.parametrize("name", HOSTILE_NPY)
def test_hostile_arrays_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "scan.npy"
    path.write_bytes(HOSTILE_NPY[name])
    assert in_limits(read_both, path, seconds=20) == ""


def read_both(path: Path) -> None:
    """As points and as a range image."""
    for layout in ("folder", "range"):
        with pytest.raises((DataError, ConfigError)):
            open_scans(path, layout=layout)[0]


@given(
    st.sampled_from(
        ["b1", "i1", "u1", "<i4", ">i4", "<u8", "<f2", "<f4", ">f8", "<U3", ">U3"]
    ),
    st.lists(st.integers(0, 4), max_size=4),
    st.booleans(),
    st.booleans(),
)
def test_arrays_are_what_numpy_reads(
    kind: str, shape: list[int], fortran: bool, text: bool
) -> None:
    array = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(kind)
    content = saved(np.asfortranarray(array) if fortran and array.ndim else array)
    read = parse_npy(content, "here")
    expected = np.load(io.BytesIO(content))
    assert (
        read.dtype == expected.dtype
        and np.array_equal(read, expected)
        and read.shape == expected.shape
    )
    start = 10 + content[8] + 256 * content[9]
    # As others write it.
    old = content[:start].replace(b"'", b'"') + content[start:] if text else content
    assert np.array_equal(parse_npy(old, "here"), expected) and read.flags.writeable


@given(st.binary(max_size=60), st.integers(0, 150))
def test_any_bytes_are_an_array_or_refused(noise: bytes, place: int) -> None:
    content = saved(POINTS)
    for damaged in (
        noise,
        content[:place] + noise,
        content[:place] + noise + content[place + len(noise) :],
    ):
        with suppress(DataError):
            parse_npy(damaged, "here")


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method, compresslevel=1) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return content.getvalue()


def patched(
    content: bytes, *, local: dict[int, bytes], central: dict[int, bytes]
) -> bytes:
    """Other bytes in the two headers of a ZIP file's only member."""
    changed = bytearray(content)
    start = content.index(b"PK\1\2")
    for base, places in ((0, local), (start, central)):
        for offset, value in places.items():
            changed[base + offset : base + offset + len(value)] = value
    return bytes(changed)


def hostile_npz(name: str) -> bytes:
    scan = zipped({"array.npy": saved(POINTS)})
    match name:
        case "a bomb":
            return zipped(
                {
                    "points.npy": npy(
                        described(shape="(10000000, 4)"), bytes(160_000_000)
                    )
                }
            )
        case "a bomb of many":
            return zipped(
                {
                    f"a{i}.npy": npy(described(shape="(1000000, 4)"), bytes(16_000_000))
                    for i in range(10)
                }
            )
        case "a bomb that says it is small":
            bomb = zipped(
                {
                    "points.npy": npy(
                        described(shape="(10000000, 4)"), bytes(160_000_000)
                    )
                }
            )
            return patched(
                bomb,
                local={22: struct.pack("<I", 4000)},
                central={24: struct.pack("<I", 4000)},
            )
        case "stored, and more than the file":
            size = struct.pack("<I", 0xF0000000)
            return patched(
                zipped({"a.npy": b"x"}, zipfile.ZIP_STORED),
                local={18: size * 2},
                central={20: size * 2},
            )
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


NPZ = [
    "a bomb",
    "a bomb of many",
    "a bomb that says it is small",
    "stored, and more than the file",
    "encrypted",
    "another method",
    "a later version",
    "lzma",
    "no array",
    "cut inside",
    "another sum",
    "a name twice",
    "160 GB",
    "nothing",
]


@pytest.mark.slow
@needs_limits
@pytest.mark.parametrize("name", NPZ)
def test_hostile_archives_are_refused(tmp_path: Path, name: str) -> None:
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
    np.savez(
        path, **(known | {name: np.asarray(value) for name, value in arrays.items()})
    )


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
        (
            "sensor",
            '{"name": "x", "columns": 2000000000, "rows": 2000000000, "range_min": 1, '
            '"range_max": 80, "fov_up": 3, "fov_down": -25}',
            "at most 4194304 cells",
        ),
        ("box_names", 3.0, "the boxes' names"),
        ("box_values", np.zeros((2, 5)), "box|reshape"),
        ("box_occlusion", "north", "invalid literal|could not|shape"),
        ("reflectance", "bright", "reflectance is"),
    ],
)
def test_invalid_facts_are_refused(
    tmp_path: Path, to: str, name: str, value: object, message: str
) -> None:
    [path] = write_all(to, tmp_path, [some_scan()])
    changed(path, **{name: value})
    with pytest.raises(DataError, match=f"{path.name}.*({message})"):
        open_scans(path)[0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_invalid_ranges_are_not_dropped_silently(tmp_path: Path, value: float) -> None:
    [path] = write_all("range", tmp_path, [some_scan()])
    with np.load(path) as loaded:
        distance = loaded["range"].copy()
    distance[np.unravel_index(distance.argmax(), distance.shape)] = value
    changed(path, range=distance)
    np.save(tmp_path / "alone.npy", distance)
    for file in (path, tmp_path / "alone.npy"):
        with pytest.raises(
            DataError, match="1 cells whose range is negative or not finite"
        ):
            open_scans(file)[0]


@pytest.mark.slow
@needs_limits
@pytest.mark.parametrize("kind", ["objects", "folder", "packed"])
def test_small_files_take_little_memory(tmp_path: Path, kind: str) -> None:
    """A bank and an archive that unpack into 700 MB; a file that may have 2 GB, but has few."""
    path = tmp_path / kind
    zeros = np.zeros(700_000_000 // 8)
    if kind == "objects":
        np.savez_compressed(path, points=zeros)
        path = path.with_suffix(".npz")
    elif kind == "packed":
        with tarfile.open(path, "w:gz", compresslevel=1) as tar:
            info = tarfile.TarInfo("a/weights")
            info.size = zeros.nbytes
            tar.addfile(info, io.BytesIO(zeros.data))
    else:
        path.mkdir()
        (path / "weights").write_bytes(b"x")
    assert in_limits(READ[kind], path, megabytes=300, seconds=20) == ""


def refuse_objects(path: Path) -> None:
    with pytest.raises(DataError, match="more than it can hold"):
        ObjectBank.load(path)


def refuse_weights(path: Path) -> None:
    with pytest.raises(DataError) as refused:
        Archive(path, "a peer").weights("weights")
    assert not any(isinstance(c, MemoryError) for c in causes(refused.value))


READ = {"objects": refuse_objects, "folder": refuse_weights, "packed": refuse_weights}
