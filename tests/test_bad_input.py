"""Bad input: a clear error that names the file and says what to do, never a wrong scan, nothing
half-written."""

import gzip
import os
import re
import shutil
import sys
import tarfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layouts import (
    MAKERS,
    nuscenes_arrays,
    some_scan,
    write_all,
    write_kitti_raw,
    write_nuscenes,
    write_tars,
)
from limits import in_limits, needs_limits

from lidar_synth.bank import ShardReader
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import write_file
from lidar_synth.files.torch_files import load_pickle
from lidar_synth.formats import READERS, WRITERS, NuScenes, SemanticKITTI, open_scans
from lidar_synth.formats.kitti_raw import KITTIRaw
from lidar_synth.formats.points import read_points
from lidar_synth.formats.source import ScanFiles
from lidar_synth.generate.checkpoint import load_checkpoint
from lidar_synth.lab.evaluate.extractors.archive import Archive

RAW = ["kitti360", "semantic_kitti", "kitti_object", "kitti_raw", "folder"]
"""Layouts that hold KITTI's .bin files."""


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def remove(path: Path) -> None:
    path.unlink()


def spoil(path: Path, value: float, field: int = 1) -> None:
    points = np.fromfile(path, "<f4").reshape(
        -1, 5 if path.name.endswith(".pcd.bin") else 4
    )
    points[3, field] = value
    points.tofile(path)


def five_floats(path: Path) -> None:
    points = np.fromfile(path, "<f4").reshape(-1, 4)[:400]
    np.column_stack([points, np.arange(len(points)) % 32]).astype("<f4").tofile(path)
    assert path.stat().st_size % 16 == 0


def big_endian(path: Path) -> None:
    np.fromfile(path, "<f4").astype(">f4").tofile(path)


POINT_FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "cut": (
        cut,
        r"is \d+ bytes long; expected a multiple of 16: 4 float32.*on_bad='skip'",
    ),
    "empty": (empty, r"is empty; expected 16 bytes for each point.*on_bad='skip'"),
    "missing": (remove, r"cannot be read \(No such file or directory\)"),
    "nan": (
        lambda p: spoil(p, np.nan),
        r"1 of \d+ points are NaN or infinite, the first is point 3",
    ),
    "infinite": (
        lambda p: spoil(p, -np.inf, 3),
        r"1 of \d+ points are NaN or infinite, the first is point 3",
    ),
    "far": (
        lambda p: spoil(p, 1e9),
        r"a coordinate of 1e\+09 m; expected coordinates within 100000 m",
    ),
    "five floats": (
        five_floats,
        r"reflectance .* runs from .*; expected values in \[0, 1\].*fields=5",
    ),
    "percent": (
        lambda p: spoil(p, 37.0, 3),
        r"reflectance .* runs from .* to 37; expected values in \[0, 1\]",
    ),
    "negative": (lambda p: spoil(p, -0.5, 3), r"reflectance .* runs from -0.5 to"),
    "big-endian": (big_endian, r"NaN or infinite|a coordinate of|reflectance"),
}


@pytest.mark.parametrize("fault", POINT_FAULTS)
@pytest.mark.parametrize("layout", RAW)
def test_a_bad_scan_is_named_or_skipped(
    tmp_path: Path, layout: str, fault: str
) -> None:
    paths = MAKERS[layout](tmp_path)
    source = open_scans(tmp_path, layout=layout)
    skipping = open_scans(tmp_path, layout=layout, on_bad="skip")
    damage, message = POINT_FAULTS[fault]
    damage(paths[1])
    with pytest.raises(
        (DataError, FileError), match=re.escape(str(paths[1])) + ".*" + message
    ):
        source[1]
    assert len(source[0]) and len(source[2])
    check_skipping(skipping, message)


def check_skipping(source: object, message: str) -> None:
    """Three scans of which the second is bad."""
    assert isinstance(source, ScanFiles)
    with pytest.warns(UserWarning, match=f"skipped scan {re.escape(source.ids[1])}"):
        found = [scan.id for scan in source]
    assert found == [source.ids[0], source.ids[2]] and len(source) == 3
    assert list(source.skipped) == [source.ids[1]] and re.search(
        message, source.skipped[source.ids[1]]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # each bad scan is told of once
        assert [source[i].id for i in range(3)] == [
            source.ids[0],
            source.ids[2],
            source.ids[2],
        ]


@pytest.mark.parametrize("layout", ["semantic_kitti", "folder", "kitti360"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda raw: raw[:-3],
            r"has {labels} labels, .*{points} has {count} points.*on_bad='skip'",
        ),
        (
            lambda raw: np.where(np.arange(len(raw)) == 5, 777, raw),
            r"{points}.*unknown class ids \[777\]",
        ),
    ],
    ids=["length", "unknown id"],
)
def test_labels_that_do_not_fit_their_scan(
    tmp_path: Path,
    layout: str,
    change: Callable[[np.ndarray], np.ndarray],
    message: str,
) -> None:
    points = MAKERS[layout](tmp_path)[1]
    [labels] = [p for p in tmp_path.rglob("*.label") if p.stem == points.stem]
    raw = np.fromfile(labels, "<u4")
    change(raw).astype("<u4").tofile(labels)
    expected = message.format(
        labels=len(raw) - 3, count=len(raw), points=re.escape(str(points))
    )
    source = open_scans(tmp_path, layout=layout)
    with pytest.raises(DataError, match=re.escape(str(labels)) + ".*" + expected):
        source[1]
    check_skipping(open_scans(tmp_path, layout=layout, on_bad="skip"), "labels")


def test_a_label_file_that_is_missing(tmp_path: Path) -> None:
    path = MAKERS["semantic_kitti"](tmp_path)[1]
    (path.parents[1] / "labels" / "000001.label").unlink()
    with pytest.raises(
        FileError,
        match=r"has labels in .* for other scans, but no 000001.label; .*--on-bad skip",
    ):
        SemanticKITTI(tmp_path)[1]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (cut, "a multiple of 20: 5 float32"),
        (lambda p: spoil(p, np.nan), "NaN or infinite"),
        (
            lambda p: spoil(p, 300.0, 3),
            r"runs from .* to 300; expected values in \[0, 255\]",
        ),
        (lambda p: spoil(p, 3.5, 4), "is not a ring"),
        (
            lambda p: np.zeros((400, 5), "<f4").tofile(p),
            "all 400 points are nearer than 1 m",
        ),
        (
            lambda p: np.random.default_rng(0).random((400, 4), "f4").tofile(p),
            "is not a ring",
        ),
    ],
    ids=["cut", "nan", "intensity", "ring", "zeros", "four floats"],
)
def test_bad_sweeps_of_nuscenes(
    tmp_path: Path, fault: Callable[[Path], None], message: str
) -> None:
    paths = write_nuscenes(tmp_path, labels=False)
    fault(paths[1])
    with pytest.raises(DataError, match=re.escape(str(paths[1])) + ".*" + message):
        NuScenes(tmp_path)[1]
    check_skipping(NuScenes(tmp_path, on_bad="skip"), message)


def test_lidarseg_that_does_not_fit_its_sweep(tmp_path: Path) -> None:
    write_nuscenes(tmp_path)
    _, classes = nuscenes_arrays(seed=1)
    path = tmp_path / "lidarseg" / "v1.0-mini" / "token1_lidarseg.bin"
    classes[:-1].astype("u1").tofile(path)
    with pytest.raises(
        DataError,
        match=rf"{path} has 319 labels, .*LIDAR_TOP__1.pcd.bin has 320 points",
    ):
        NuScenes(tmp_path)[1]
    np.where(classes == 3, 99, classes).astype("u1").tofile(path)
    with pytest.raises(
        DataError, match=rf"{path} .*__1.pcd.bin.*unknown class ids \[99\]"
    ):
        NuScenes(tmp_path)[1]
    (tmp_path / "v1.0-mini" / "lidarseg.json").write_text("[{}]")
    with pytest.raises(DataError, match=r"lidarseg.json: KeyError"):
        NuScenes(tmp_path)


@pytest.mark.parametrize("layout", READERS)
def test_a_directory_without_scans(tmp_path: Path, layout: str) -> None:
    with pytest.raises((DataError, FileError), match=re.escape(str(tmp_path))):
        READERS[layout](tmp_path)  # type: ignore[call-arg, arg-type]
    with pytest.raises((DataError, FileError), match="nowhere"):
        READERS[layout](tmp_path / "nowhere")  # type: ignore[call-arg, arg-type]
    with pytest.raises((DataError, FileError), match=re.escape(str(tmp_path))):
        open_scans(tmp_path, layout=layout)


@pytest.mark.parametrize(
    ("layout", "part"),
    [
        ("semantic_kitti", ".."),
        ("semantic_kitti", "sequences/00/velodyne"),
        ("kitti_object", "training"),
        ("kitti_object", "training/velodyne"),
        ("kitti_raw", "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data"),
        ("kitti360", ".."),
    ],
)
def test_a_dataset_is_read_without_its_labels_on_request_alone(
    layout: str, part: str, tmp_path: Path
) -> None:
    root = tmp_path / "above" / "dataset"
    files = MAKERS[layout](root)
    path = (root / part).resolve()
    with pytest.raises(DataError, match=f"of layout '{layout}'.*Give {root}[. /]"):
        open_scans(path)
    assert len(open_scans(path, layout="folder")) == 3
    shutil.copy(files[0], root)
    for name in ("mine", "velodyne_vlp16"):
        (root / name).mkdir()
        shutil.copy(files[0], root / name)
        assert len(open_scans(root / name)) == 1
    assert len(open_scans(files[0])) == 1


def test_a_path_in_no_known_layout(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(
        DataError,
        match=r"holds no scan in a layout that is known; expected one of kitti360, .*\.ply",
    ):
        open_scans(tmp_path)
    with pytest.raises(DataError, match=r"notes.txt holds no scan"):
        open_scans(tmp_path / "notes.txt")
    with pytest.raises(FileError, match="nowhere does not exist"):
        open_scans(tmp_path / "nowhere")
    with pytest.raises(
        ConfigError,
        match=r"layout 'kitti'; expected one of 'kitti360', 'semantic_kitti'",
    ):
        open_scans(tmp_path, layout="kitti")


def test_wrong_splits(tmp_path: Path) -> None:
    for layout in ("kitti360", "semantic_kitti", "kitti_object", "kitti_raw"):
        MAKERS[layout](tmp_path / layout)
    with pytest.raises(
        ConfigError,
        match=r"KITTI-360 split 'train'; expected one of 'r2flow/train', .*full name of a split",
    ):
        open_scans(tmp_path / "kitti360", split="train")
    with pytest.raises(
        ConfigError,
        match="SemanticKITTI split 'valid'; expected one of 'train', 'val', 'test', 'all'",
    ):
        open_scans(tmp_path / "semantic_kitti", split="valid")
    with pytest.raises(
        ConfigError,
        match="KITTI object split 'training'; expected one of 'train', 'val', 'trainval'",
    ):
        open_scans(tmp_path / "kitti_object", split="training")
    with pytest.raises(
        ConfigError, match="split='train' for .*layout 'kitti_raw' has none$"
    ):
        open_scans(tmp_path / "kitti_raw", split="train")
    with pytest.raises(DataError, match=r"no sequence of split 'val' \(it has 00\)"):
        open_scans(tmp_path / "semantic_kitti", split="val")
    with pytest.raises(ConfigError, match="on_bad='ignore'; expected one of"):
        open_scans(tmp_path / "semantic_kitti", on_bad="ignore")  # type: ignore[arg-type]


def test_after_a_bad_last_scan_comes_the_first(tmp_path: Path) -> None:
    empty(MAKERS["folder"](tmp_path)[2])
    source = open_scans(tmp_path, on_bad="skip")
    with pytest.warns(UserWarning, match="skipped scan 000002"):
        assert source[2].id == source[-1].id == "000000"


def test_a_source_without_one_good_scan(tmp_path: Path) -> None:
    for path in MAKERS["folder"](tmp_path):
        empty(path)
    source = open_scans(tmp_path, on_bad="skip")
    with (
        pytest.warns(UserWarning),
        pytest.raises(DataError, match=r"none of the 3 scans of .*is empty"),
    ):
        source[0]
    assert len(source.skipped) == 3 and list(source) == []


def test_a_folder_of_two_kinds(tmp_path: Path) -> None:
    for to in ("kitti", "npz"):
        write_all(to, tmp_path, [some_scan()])
    with pytest.raises(
        ConfigError, match="holds .bin and .npz files; expected one kind"
    ):
        READERS["folder"](tmp_path)  # type: ignore[call-arg, arg-type]


@pytest.mark.parametrize("to", WRITERS)
def test_a_target_that_cannot_be_written(tmp_path: Path, to: str) -> None:
    """A file stands where the folder should be: refused for root too, whom no permission stops."""
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(
        FileError, match=r"out.* cannot be written \(.*Choose another output folder"
    ):
        WRITERS[to](tmp_path / "out").write(some_scan(), 0)
    assert (tmp_path / "out").read_text() == "in the way"


@pytest.mark.parametrize("to", WRITERS)
def test_a_disk_that_is_full_leaves_no_half_scan(tmp_path: Path, to: str) -> None:
    """The system refuses every byte beyond a limit, as a full disk does."""
    resource = pytest.importorskip("resource", reason="needs POSIX limits")
    scan = some_scan(count=40_000, sensor="os1_128")
    WRITERS[to](tmp_path / "warm").write(scan, 0)
    shutil.rmtree(tmp_path / "warm")
    writer = WRITERS[to](tmp_path / "out")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, hard))
    try:
        with pytest.raises(FileError, match="cannot be written"):
            writer.write(scan, 0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not writer.complete(0)
    assert not [
        p
        for p in tmp_path.rglob("*")
        if p.suffix in (".part", ".bin", ".npz", ".pcd", ".ply")
    ]
    writer.write(scan, 0)
    assert writer.complete(0)


@pytest.mark.parametrize(
    ("to", "blocked"),
    [
        ("kitti", "000000.label/x"),
        ("semantic_kitti", "sequences/00/labels"),
        ("semantic_kitti", "sequences/00/calib.txt/x"),
        ("kitti_object", "training/label_2"),
        ("kitti_object", "training/image_2"),
        ("kitti360", "data_3d_semantics_scan"),
        ("kitti360", "data_poses"),
        ("png", "reflectance"),
        ("png", "label"),
    ],
)
def test_a_scan_is_complete_only_with_all_its_files(
    tmp_path: Path, to: str, blocked: str
) -> None:
    (tmp_path / blocked).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / blocked).write_text("in the way")
    writer = WRITERS[to](tmp_path)
    with pytest.raises(FileError, match="cannot be written"):
        writer.write(some_scan(), 0)
    assert not writer.complete(0)


def test_a_failed_write_keeps_the_existing_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_file(path, b"before")

    def fail(file: object) -> None:
        file.write(b"half")  # type: ignore[attr-defined]
        raise OSError(28, "No space left on device")

    with pytest.raises(
        FileError, match=r"file cannot be written \(No space left on device\)"
    ):
        write_file(path, fail)
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
    # Who has the old file open goes on reading it: it is replaced, never written over.
    (tmp_path / "reader").hardlink_to(path)
    write_file(path, b"after")
    assert (
        path.read_bytes() == b"after"
        and (tmp_path / "reader").read_bytes() == b"before"
    )


def test_partial_files_are_never_read(tmp_path: Path) -> None:
    """What a killed writer leaves is hidden from every reader."""
    for layout in ("folder", "kitti360", "semantic_kitti", "kitti_object"):
        path = MAKERS[layout](tmp_path / layout)[0]
        (path.parent / f".{path.name}.123.part").write_bytes(b"half")
        (path.parent / f".{path.name}").write_bytes(b"half")
        assert len(list(open_scans(tmp_path / layout, layout=layout))) == 3


def test_the_hint_finds_the_number_of_fields(tmp_path: Path) -> None:
    np.zeros((3, 5), "<f4").tofile(tmp_path / "five.bin")
    with pytest.raises(
        DataError, match="60 bytes long.*fits 5 floats per point: pass fields=5"
    ):
        read_points(tmp_path / "five.bin")
    assert read_points(tmp_path / "five.bin", fields=5).shape == (3, 5)


def test_clouds_need_no_open3d(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)  # as if its import failed
    for to in ("pcd", "ply"):
        write_all(to, tmp_path / to, [some_scan()])
        assert len(open_scans(tmp_path / to)[0]) == len(some_scan())


def test_bad_names_for_a_writer(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="drive 'a/b'"):
        WRITERS["kitti360"](tmp_path, drive="a/b")  # type: ignore[call-arg]


def test_a_tar_member_larger_than_any_file(tmp_path: Path) -> None:
    [path] = write_tars(tmp_path)[:1]
    content = bytearray(path.read_bytes())
    content[124:136] = b"\x80" + (2**63 - 1).to_bytes(11, "big")
    content[148:156] = b" " * 8
    content[148:156] = b"%06o\x00 " % sum(content[:512])
    path.write_bytes(content)
    with pytest.raises(
        DataError,
        match=rf"{path.name} is truncated, damaged or not a tar file "
        r"\(a member of 9223372036854775807",
    ):
        open_scans(path)


def test_a_cloud_with_two_widths(tmp_path: Path) -> None:
    [path] = write_all("pcd", tmp_path, [some_scan()])
    path.write_bytes(path.read_bytes().replace(b"HEIGHT 1\n", b"HEIGHT 1 1\n"))
    with pytest.raises(DataError, match=r"one each for WIDTH, HEIGHT and POINTS"):
        open_scans(path)[0]


@pytest.mark.parametrize("kind", [tarfile.GNUTYPE_LONGNAME, tarfile.XHDTYPE])
def test_a_packed_archive_with_an_endless_header(tmp_path: Path, kind: bytes) -> None:
    """1 GB of a name packs into 1 MB; it is refused by its size, before it is unpacked."""
    path = tmp_path / "judge.tgz"
    member = tarfile.TarInfo("a")
    member.type = kind
    member.size = 1 << 30
    with gzip.open(path, "wb") as file:
        file.write(member.tobuf(tarfile.GNU_FORMAT) + bytes(1 << 20))
    with pytest.raises(DataError, match="a header of 1073741824 bytes"):
        Archive(path, "a peer").yaml("config.yaml")


def read_any(path: Path) -> None:
    """Read a file by its suffix, as its readers do."""
    if path.suffix == ".safetensors":
        load_checkpoint(path)
    elif path.suffix == ".pth":
        load_pickle(path, "a peer")
    elif path.suffix == ".h5":
        ShardReader(path, path.name)
    else:
        open_scans(path.parent)[0]


@needs_limits
@pytest.mark.parametrize(
    "name",
    ["a.bin", "a.npz", "a.pcd", "a.ply", "a.tar", "a.h5", "a.pth", "a.safetensors"],
)
def test_a_named_pipe_is_refused(tmp_path: Path, name: str) -> None:
    """Opening it would wait for someone who writes."""
    os.mkfifo(tmp_path / name)
    assert "FileError: " in in_limits(read_any, tmp_path / name)


def test_a_frame_of_kitti_raw_without_a_number_has_no_boxes(tmp_path: Path) -> None:
    paths = write_kitti_raw(tmp_path)
    paths[0].rename(paths[0].with_name("0000000000 (1).bin"))
    found = {Path(scan.id).name: scan.boxes for scan in KITTIRaw(tmp_path)}
    assert found["0000000000 (1)"] is None and found["0000000001"] is not None
