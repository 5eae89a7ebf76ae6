"""WebDataset: what stands in the tar files, that their bytes repeat, and that runs go on."""

import json
import tarfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from banks import some_image, write_bank
from layouts import some_scan, write_tars

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import WebDataset, open_scans
from lidar_synth.formats.convert import SETTINGS, Report, convert
from lidar_synth.formats.webdataset import WebDatasetWriter, _write_tar
from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.evaluate.extractors.archive import Archive


def samples(path: Path) -> dict[str, dict[str, bytes]]:
    """As WebDataset's readers group a tar file: neighbours with the same key, which ends at the
    first dot."""
    found: dict[str, dict[str, bytes]] = {}
    with tarfile.open(path) as tar:
        for member in tar:
            folder, _, name = member.name.rpartition("/")
            stem, kind = name.split(".", 1)
            key = f"{folder}/{stem}" if folder else stem
            assert key not in found or key == list(found)[-1], (
                "members of a scan stand together"
            )
            assert kind not in found.setdefault(key, {})
            content = tar.extractfile(member)
            assert content is not None
            found[key][kind] = content.read()
    return found


def tars(root: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in root.rglob("*.tar")}


def test_members_are_what_webdataset_decodes(tmp_path: Path) -> None:
    scans = [some_scan(i) for i in range(5)]
    scans[1].label = scans[1].raw_label = scans[1].instance = scans[1].boxes = scans[
        1
    ].pose = None
    convert(scans, WebDatasetWriter(tmp_path, shard_size=2), progress=False)
    assert sorted(tars(tmp_path)) == [
        "scans-000000.tar",
        "scans-000001.tar",
        "scans-000002.tar",
    ]
    found = samples(tmp_path / "scans-000000.tar")
    assert list(found) == ["000000", "000001"]
    first, second = found.values()
    assert list(first) == [
        "json",
        "points.npy",
        "label.npy",
        "raw_label.npy",
        "instance.npy",
        "boxes.npy",
    ]
    points = np.load(BytesIO(first["points.npy"]), allow_pickle=False)
    assert points.dtype == np.float32 and np.array_equal(points[:, :3], scans[0].points)
    assert np.array_equal(points[:, 3], scans[0].reflectance)
    facts = json.loads(first["json"])
    assert facts["sensor"] == scans[0].sensor.to_dict() and facts["domain"] == 0
    assert scans[0].boxes is not None and tuple(facts["names"]) == scans[0].boxes.names
    assert set(second) == {"json", "points.npy", "label.npy"}
    assert (np.load(BytesIO(second["label.npy"])) == IGNORE).all()
    read = open_scans(tmp_path)
    assert type(read) is WebDataset and read.ids == tuple(f"{i:06d}" for i in range(5))
    assert read[0].boxes is not None and np.array_equal(
        read[0].boxes.values, scans[0].boxes.values
    )
    assert np.array_equal(read[4].pose, scans[4].pose) and read[1].pose is None
    assert len(open_scans(tmp_path / "scans-000002.tar")) == 1


def test_boxes_of_earlier_versions_are_read(tmp_path: Path) -> None:
    """They have values and names only."""
    [path, *_] = write_tars(tmp_path)
    [[key, members]] = samples(path).items()
    facts = json.loads(members["json"])
    del facts["boxes"]
    members["json"] = json.dumps(facts).encode()
    named = ((f"{key}.{kind}", content) for kind, content in members.items())
    with path.open("wb") as file:
        _write_tar(file, named)
    read = open_scans(path)[0].boxes
    sent = some_scan(0).boxes
    assert read is not None and sent is not None and read.names == sent.names
    assert np.array_equal(read.values, sent.values) and (read.instance == -1).all()
    facts["boxes"] = {"occlusion": [10**400] * len(read)}
    members["json"] = json.dumps(facts).encode()
    named = ((f"{key}.{kind}", content) for kind, content in members.items())
    with path.open("wb") as file:
        _write_tar(file, named)
    with pytest.raises(DataError, match="the members that this package writes"):
        open_scans(path)[0]


def test_a_bank_goes_out_under_its_names(tmp_path: Path) -> None:
    write_bank(
        tmp_path / "bank",
        [some_image(i) for i in range(5)],
        fields=("reflectance", "label", "confidence"),
    )
    bank = open_scans(tmp_path / "bank")
    convert(bank, WebDatasetWriter(tmp_path / "out", shard_size=3), progress=False)
    assert list(samples(tmp_path / "out" / "scans-000001.tar")) == [
        "small/5/3",
        "small/5/4",
    ]
    read = open_scans(tmp_path / "out")
    assert read.ids == bank.ids and read.sensor == bank.sensor
    for a, b in zip(read, bank, strict=True):
        assert (a.id, a.domain) == (b.id, b.domain)
        assert all(
            np.array_equal(a.fields()[name], values)
            for name, values in b.fields().items()
        )


def test_names_with_dots(tmp_path: Path) -> None:
    writer = WebDatasetWriter(tmp_path)
    names = ["a.b/c.d", "a%2Eb/c", "a.b/c"]
    for index, name in enumerate(names):
        writer.write(some_scan(index), index, name=name)
        assert writer.complete(index, name)
    writer.finish()
    assert (
        list(open_scans(tmp_path).ids) == names
        and len(samples(tmp_path / "scans-000000.tar")) == 3
    )


@pytest.mark.slow
def test_bytes_repeat_in_any_order_and_by_any_number_of_processes(
    tmp_path: Path,
) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(5)])
    bank = open_scans(tmp_path / "bank")
    convert(bank, WebDatasetWriter(tmp_path / "one", shard_size=2), progress=False)
    convert(
        bank, WebDatasetWriter(tmp_path / "two", shard_size=2), jobs=2, progress=False
    )
    backwards = WebDatasetWriter(tmp_path / "three", shard_size=2)
    for index in reversed(range(5)):
        backwards.write(bank[index], index, name=bank.ids[index])
    backwards.finish()
    assert tars(tmp_path / "one") == tars(tmp_path / "two") == tars(tmp_path / "three")
    assert len(tars(tmp_path / "one")) == 3


class Interrupted:
    """Scans of which one cannot be read, for now."""

    def __init__(self, scans: list[Scan], stop: type[BaseException]) -> None:
        self.scans = scans
        self.stop = stop

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> Scan:
        if index == 3:
            raise self.stop("not now")
        return self.scans[index]


def test_a_resumed_run_writes_the_same_bytes(tmp_path: Path) -> None:
    scans = [some_scan(i) for i in range(5)]
    convert(scans, WebDatasetWriter(tmp_path / "once", shard_size=2), progress=False)
    with pytest.raises(KeyboardInterrupt):
        convert(
            Interrupted(scans, KeyboardInterrupt),
            WebDatasetWriter(tmp_path / "two", shard_size=2),
            progress=False,
        )
    assert convert(
        scans, WebDatasetWriter(tmp_path / "two", shard_size=2), progress=False
    ) == Report(2, 3)
    assert tars(tmp_path / "two") == tars(tmp_path / "once")
    assert convert(
        scans, WebDatasetWriter(tmp_path / "two", shard_size=2), progress=False
    ) == Report(0, 5)
    assert {path.name for path in (tmp_path / "two").iterdir()} == {
        *tars(tmp_path / "two"),
        SETTINGS,
    }


def test_killed_while_gathering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tar files are there, but so are the scans that they were made of: none of them comes
    twice."""
    import lidar_synth.formats.webdataset as module

    scans = [some_scan(i) for i in range(3)]
    with monkeypatch.context() as patch:
        patch.setattr(module, "clear_notes", lambda root: None)
        convert(scans, WebDatasetWriter(tmp_path), progress=False)
    before = (tmp_path / "scans-000000.tar").read_bytes()
    assert convert(scans, WebDatasetWriter(tmp_path), progress=False) == Report(0, 3)
    assert tars(tmp_path) == {"scans-000000.tar": before}


def test_skipped_scans_are_added_by_a_later_run(tmp_path: Path) -> None:
    scans = [some_scan(i) for i in range(5)]
    report = convert(
        Interrupted(scans, DataError),
        WebDatasetWriter(tmp_path),
        on_bad="skip",
        progress=False,
    )
    assert report.written == 4 and len(open_scans(tmp_path)) == 4
    assert convert(scans, WebDatasetWriter(tmp_path), progress=False) == Report(1, 4)
    assert open_scans(tmp_path).ids == (
        "000000",
        "000001",
        "000002",
        "000004",
        "000003",
    )
    with pytest.raises(ConfigError, match="shard_size 0; expected a whole number"):
        WebDatasetWriter(tmp_path, shard_size=0)


def test_a_scan_that_is_written_again_replaces_the_old_one(tmp_path: Path) -> None:
    """All of it: the new one may have fewer members."""
    old = [some_scan(i) for i in range(3)]
    new = some_scan(7)
    new.label = new.raw_label = new.instance = new.boxes = None
    names = ["a.b/0", "a.b/00", "c"]
    writer = WebDatasetWriter(tmp_path)
    for index, name in enumerate(names):
        writer.write(old[index], index, name=name)
    writer.finish()
    writer.write(new, 0, name=names[0])
    writer.finish()
    read = {scan.id: scan for scan in open_scans(tmp_path)}
    assert set(read) == set(names) and read[names[0]].boxes is None
    for name, expected in zip(names, [new, *old[1:]], strict=True):
        assert np.array_equal(read[name].points, expected.points)
    samples(tmp_path / "scans-000000.tar")


def damaged(path: Path, **members: bytes | None) -> None:
    """Write the file again with other members; None leaves one out."""
    [(key, there)] = samples(path).items()
    with tarfile.open(path, "w") as tar:
        for kind, content in (
            there
            | {kind.replace("_", "."): content for kind, content in members.items()}
        ).items():
            if content is not None:
                info = tarfile.TarInfo(f"{key}.{kind}")
                info.size = len(content)
                tar.addfile(info, BytesIO(content))


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"json": b"{"}, "Expecting property name"),
        ({"json": b"{}"}, "KeyError.*names"),
        ({"points_npy": None}, "KeyError.*points"),
        ({"points_npy": b"no"}, "points.npy has no header of an .npy file"),
        ({"label_npy": b"\x93NUMPY"}, "label.npy has no header of an .npy file"),
    ],
)
def test_damaged_members_are_named_and_skipped(
    tmp_path: Path, members: dict[str, bytes | None], message: str
) -> None:
    path = write_tars(tmp_path)[1]
    damaged(path, **members)
    with pytest.raises(
        DataError, match=f"scan '000001' of .*scans-000001.tar: .*({message})"
    ):
        open_scans(tmp_path)[1]
    with pytest.warns(UserWarning, match="skipped scan 000001"):
        assert [scan.id for scan in open_scans(tmp_path, on_bad="skip")] == [
            "000000",
            "000002",
        ]


def test_damaged_and_missing_files(tmp_path: Path) -> None:
    path = write_tars(tmp_path)[1]
    content = path.read_bytes()
    for length in (100, 700, len(content) // 2):
        path.write_bytes(content[:length])
        with pytest.raises(
            DataError, match="scans-000001.tar is truncated, damaged or not a tar file"
        ):
            open_scans(tmp_path)
        with pytest.raises(
            DataError, match="scans-000001.tar is truncated, damaged or not a tar file"
        ):
            WebDatasetWriter(tmp_path).complete(0)
    path.write_bytes(content)
    scans = open_scans(tmp_path)
    path.unlink()
    with pytest.raises(FileError, match="scans-000001.tar cannot be read"):
        scans[1]


PAX = {
    "GNU.sparse.map": "x,y",
    "GNU.sparse.size": "x",
    "size": "-5",
    "GNU.sparse.offset": "x",
}


@pytest.mark.parametrize("key", PAX)
def test_numbers_in_pax_headers_are_checked(key: str, tmp_path: Path) -> None:
    member = tarfile.TarInfo("a.json")
    member.pax_headers = {key: PAX[key]}
    path = tmp_path / "shard.tar"
    with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as tar:
        tar.addfile(member)
    with pytest.raises(DataError):
        open_scans(path)[0]
    with pytest.raises((DataError, FileError)):
        Archive(path, "bonnetal").yaml("a.yaml")
