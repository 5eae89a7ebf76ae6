"""Files of arrays: the same by every version of numpy, and without code in them."""

import os
import zipfile
from pathlib import Path
from typing import BinaryIO

import numba
import numpy as np
import pytest
from banks import add_stray, some_image

from lidar_synth.errors import DataError, FileError
from lidar_synth.files.compiled import keep_compiled_code
from lidar_synth.files.disk import files_below, remove_file, write_arrays, write_file
from lidar_synth.formats import open_scans
from lidar_synth.formats.npz import read_arrays, write_range_image, write_scan
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import Boxes


def test_the_first_of_several_writers_wins(tmp_path: Path) -> None:
    path = tmp_path / "settings.json"

    def overtaken(file: BinaryIO) -> None:
        path.write_bytes(b"first")
        # as a bake does with files that it takes for leftovers
        Path(file.name).unlink()

    write_file(path, overtaken, overwrite=False)
    write_file(path, b"third", overwrite=False)
    assert path.read_bytes() == b"first"
    with pytest.raises(FileError, match="cannot be written"):
        write_file(tmp_path / "other", lambda f: Path(f.name).unlink(), overwrite=False)


@pytest.mark.parametrize("compressed", [False, True])
def test_what_is_written_is_what_was_given(tmp_path: Path, compressed: bool) -> None:
    arrays = {"a": np.arange(6).reshape(2, 3), "text": np.array("x"), "few": (1, 2.5)}
    write_arrays(tmp_path / "a.npz", arrays, compressed=compressed)
    with zipfile.ZipFile(tmp_path / "a.npz") as file:
        assert sorted(file.namelist()) == ["a.npy", "few.npy", "text.npy"]
    found = read_arrays(tmp_path / "a.npz")
    assert all(np.array_equal(found[name], values) for name, values in arrays.items())
    with pytest.raises(DataError, match=r"arrays \['b'\] of Python objects"):
        write_arrays(tmp_path / "b.npz", {"b": [{}, 1]})
    assert not (tmp_path / "b.npz").exists()


def test_files_with_a_stray_array_are_read(tmp_path: Path) -> None:
    image = some_image(0)
    scan = unproject(image)
    scan.boxes = Boxes(np.array([[5.0, 0, 0, 4, 2, 2, 0]], np.float32), names=("car",))
    write_range_image(tmp_path / "image" / "a.npz", image, scan)
    write_scan(tmp_path / "scan" / "a.npz", scan)
    for path in tmp_path.rglob("*.npz"):
        add_stray(path)
    assert len(open_scans(tmp_path / "image")[0]) == len(scan)
    assert np.array_equal(open_scans(tmp_path / "scan")[0].points, scan.points)


def test_without_a_writable_folder_numba_compiles_into_a_temporary_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    keep_compiled_code()
    assert "NUMBA_CACHE_DIR" not in os.environ
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.warns(UserWarning, match="every start compiles it again"):
        keep_compiled_code()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    assert folder.is_dir() and folder.parent == tmp_path
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(FileError, match="no folder may be written to"):
        keep_compiled_code()


def test_a_file_that_cannot_be_removed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "old.label"
    remove_file(path)  # nothing is there
    path.write_bytes(b"old")

    def refuse(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        with pytest.raises(FileError, match=r"old\.label cannot be written \(Perm"):
            remove_file(path)
    remove_file(path)
    assert not path.exists()


def test_only_links_are_resolved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many folders are listed in a moment."""
    for number in range(3):
        (tmp_path / str(number) / "lidar").mkdir(parents=True)
        (tmp_path / str(number) / "lidar" / "a.bin").touch()
    monkeypatch.setattr(Path, "resolve", lambda path: pytest.fail(str(path)))
    assert len(list(files_below(tmp_path))) == 3
