"""Names that come from a file never lead out of the output folder, nor two of them to one file."""

import os
import tarfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from banks import some_image, write_bank
from hypothesis import given, strategies as st
from layouts import WRITTEN_AS, some_scan, write_tars

from lidar_synth.errors import DataError, FileError
from lidar_synth.files.disk import join_inside, write_file
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.convert import Report, convert
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry.scan import Scan

HOSTILE = {
    "up": "../../x",
    "up in the middle": "a/../../../x",
    "absolute": "{outside}/x",
    "home": "~/x",
    "hidden": ".x",
    "notes": ".lidar_synth/x",
    "here": "a/./x",
    "empty part": "a//x",
    "empty end": "x/",
    "drive": "C:/x",
    "backslash": "..\\..\\x",
    "zero": "a\x00b",
    "half a character": "a\ud800b",
    "long part": "x" * 250,
    "long path": "/".join(["x" * 90] * 20),
    "many digits": "00/" + "9" * 6000,
    "far frame": "00/4000000000",
    "other digits": "00/٣",
}
"""Ids that a bank, a tar file or a folder could bring; {outside} is a folder outside of OUT."""


class Named(ScanFiles):
    """Scans with these ids, as any file could name them."""

    def __init__(self, *ids: str) -> None:
        super().__init__(Path("named"), ids, "hdl64e_kitti")

    def read(self, index: int) -> Scan:
        return some_scan(index, count=60)


def everything(root: Path, out: Path) -> dict[str, bytes]:
    """All files and folders under ``root`` but those in ``out``."""
    paths = (p for p in root.rglob("*") if out not in (p, *p.parents))
    return {str(p): p.read_bytes() if p.is_file() else b"" for p in paths}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An output folder so deep that what leaves it lands in ``tmp_path``."""
    folder = tmp_path / "one" / "two" / "three" / "out"
    folder.mkdir(parents=True)
    return folder


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("to", WRITERS)
def test_nothing_lands_outside(tmp_path: Path, out: Path, to: str, name: str) -> None:
    """The scan is refused and named, or it is written in the folder and found there again; the
    others go on."""
    source = Named("good/0", HOSTILE[name].format(outside=tmp_path), "good/2")
    before = everything(tmp_path, out)
    report = convert(source, WRITERS[to](out), on_bad="skip", progress=False)
    assert everything(tmp_path, out) == before
    assert report.written + len(report.skipped) == 3 and report.written >= 2
    assert len(open_scans(out, layout=WRITTEN_AS[to])) == report.written
    if report.skipped:
        with pytest.raises(DataError, match="for a file under"):
            WRITERS[to](out).write(source[1], 1, name=source.ids[1])


@pytest.mark.parametrize("to", WRITERS)
def test_a_bank_and_a_tar_with_names_that_lead_out(
    tmp_path: Path, out: Path, to: str
) -> None:
    write_bank(tmp_path / "bank", [some_image()], model="../../x")
    [path, *others] = write_tars(tmp_path / "tar")
    for other in others:
        other.unlink()
    with tarfile.open(path) as tar:
        members = {m.name: tar.extractfile(m).read() for m in tar}  # type: ignore[union-attr]
    with tarfile.open(path, "w") as tar:
        for member, content in members.items():
            info = tarfile.TarInfo(member.replace("000000.", "%2E%2E/%2E%2E/x."))
            info.size = len(content)
            tar.addfile(info, BytesIO(content))
    sources = open_scans(tmp_path / "bank"), open_scans(tmp_path / "tar")
    assert [source.ids for source in sources] == [("../../x/5/0",), ("../../x",)]
    before = everything(tmp_path, out)
    for number, source in enumerate(sources):
        if to == "kitti_object" and number == 0:
            continue  # a bank has no boxes
        report = convert(
            source, WRITERS[to](out / str(number)), on_bad="skip", progress=False
        )
        assert (report.written == 0) == (
            to in ("kitti", "npz", "range", "pcd", "ply", "png", "mcap", "cosmos")
        ), report
    assert everything(tmp_path, out) == before


@pytest.mark.parametrize("to", WRITERS)
def test_a_link_in_the_folder_that_leads_out(
    tmp_path: Path, out: Path, to: str
) -> None:
    """Whichever folder of a layout it is, side files and images included."""
    convert(Named("good/0"), WRITERS[to](tmp_path / "model"), progress=False)
    folders = [
        p.relative_to(tmp_path / "model")
        for p in (tmp_path / "model").rglob("*")
        if p.is_dir()
    ]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for folder in folders or [Path("a")]:
        place = out / folder
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(elsewhere)
        with pytest.raises(
            FileError, match=f"{place.name} is a link to .*elsewhere.*Remove the link"
        ):
            WRITERS[to](out).write(some_scan(count=60), 0, name="a/0")
        assert not list(elsewhere.iterdir())
        place.unlink()
    (out / "a link that stays").symlink_to(out)
    WRITERS[to](out).write(some_scan(count=60), 0, name="a/0")


def test_a_file_is_never_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "target").write_bytes(b"before")
    path = tmp_path / "file"
    for link in (path, path.with_name(f".file.{os.getpid()}.part")):
        link.symlink_to(tmp_path / "target")
    write_file(path, b"after")
    assert (
        path.read_bytes() == b"after"
        and (tmp_path / "target").read_bytes() == b"before"
    )


COLLISIONS = {
    "png": [("a_b", "a/b"), ("x", "x")],
    "semantic_kitti": [
        ("00/000001", "2013_05_28_drive_0000_sync/0000000001"),
        ("other", "00/000000"),
    ],
    "kitti360": [("00/000001", "00/1"), ("other", "00/0")],
    "kitti_object": [("training/1", "training/000001"), ("other", "training/0")],
} | {
    to: [("x", "x")]
    for to in ("kitti", "npz", "range", "pcd", "ply", "webdataset", "mcap", "cosmos")
}


@pytest.mark.parametrize("to", WRITERS)
def test_two_scans_never_share_a_file(out: Path, to: str) -> None:
    for number, ids in enumerate(COLLISIONS[to]):
        folder = out / str(number)
        with pytest.raises(
            DataError, match=r"scan 1 is called .*that no earlier scan has"
        ):
            convert(Named(*ids), WRITERS[to](folder / "a"), progress=False)
        for expected in (Report(written=1), Report(kept=1)):
            report = convert(
                Named(*ids), WRITERS[to](folder / "b"), on_bad="skip", progress=False
            )
            assert (report.written, report.kept) == (expected.written, expected.kept)
            assert list(report.skipped) == [f"{ids[1]} (scan 1)"]
        [scan] = open_scans(folder / "b", layout=WRITTEN_AS[to])
        [alone] = Named(ids[0])
        assert len(scan) == len(alone) or to in (
            "png",
            "range",
        )  # the first, not the second


@given(
    st.lists(
        st.text(st.sampled_from("ab./\\~%: \x00_é"), max_size=8), min_size=2, max_size=2
    )
)
def test_names_stay_inside_and_apart(names: list[str]) -> None:
    root = Path("/somewhere/out")
    found = {}
    for name in names:
        try:
            found[name] = join_inside(root, name)
        except DataError:
            continue
        assert (
            Path(os.path.normpath(found[name])) == found[name]
            and found[name].is_relative_to(root)
            and name
        )
    assert len(set(found.values())) == len(found)


def test_a_table_of_nuscenes_that_leads_out(tmp_path: Path) -> None:
    from layouts import write_nuscenes

    write_nuscenes(tmp_path)
    table = tmp_path / "v1.0-mini" / "lidarseg.json"
    table.write_text(table.read_text().replace("lidarseg/v1.0", "../lidarseg/v1.0"))
    with pytest.raises(DataError, match="for a file under"):
        open_scans(tmp_path)


def test_keys_keep_what_their_names_were(tmp_path: Path) -> None:
    """A tar made with ``tar -C folder .`` has ./ before every name."""
    [path, *others] = write_tars(tmp_path)
    for other in others:
        other.unlink()
    with tarfile.open(path) as tar:
        members = {m.name: tar.extractfile(m).read() for m in tar}  # type: ignore[union-attr]
    with tarfile.open(path, "w") as tar:
        folder = tarfile.TarInfo(".")
        folder.type = tarfile.DIRTYPE
        tar.addfile(folder)
        for member, content in members.items():
            info = tarfile.TarInfo(f"./{member}")
            info.size = len(content)
            tar.addfile(info, BytesIO(content))
    scans = open_scans(tmp_path)
    assert scans.ids == ("000000",) and np.array_equal(
        scans[0].points, some_scan(0).points
    )
