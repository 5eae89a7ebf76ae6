"""What parses foreign files stands in ``lidar_synth/files``, or in the few modules that are listed
here."""

import ast
from pathlib import Path

import pytest

import lidar_synth
from lidar_synth.errors import DataError
from lidar_synth.files.parsing import read_picture

PACKAGE = Path(lidar_synth.__file__).parent

PARSERS = {
    "PIL.Image.open",
    "Image.open",
    "torch.load",
    "np.load",
    "np.loadtxt",
    "np.genfromtxt",
    "np.fromstring",
    "pickle.load",
    "pickle.loads",
    "pickle.Unpickler",
    "yaml.load",
    "yaml.safe_load",
    "yaml.full_load",
    "yaml.unsafe_load",
    "json.load",
    "json.loads",
    "zipfile.ZipFile",
    "tarfile.open",
    "ElementTree.parse",
    "ElementTree.iterparse",
    "ElementTree.fromstring",
    "h5py.File",
    "eval",
    "exec",
}
"""Calls that read a format."""

OUTSIDE = {
    # Formats with one reader, which checks sizes and turns every exception into an error of the
    # package.
    "bank/layout.py": {"h5py.File"},
    "bank/chunks.py": {"h5py.File"},  # in memory
    "bank/writer.py": {"h5py.File"},  # writes
    "bank/facts.py": {"json.loads"},
    "lab/curate/store.py": {"np.load"},
    "lab/evaluate/extractors/archive.py": {"tarfile.open"},
    "formats/cloud.py": {"np.loadtxt"},
    "formats/kitti360_boxes.py": {"ElementTree.parse", "ElementTree.iterparse"},
    "formats/kitti_raw.py": {"ElementTree.fromstring"},
    "formats/webdataset.py": {"tarfile.open"},
    "generate/checkpoint.py": {"json.loads"},
    "lab/town/skin/skin.py": {"json.loads"},
    # The package's own text.
    "bake/folder.py": {"json.loads"},
    "bank/plans.py": {"json.loads"},
    "lab/evaluate/published.py": {"yaml.safe_load"},
    "lab/evaluate/protocols/__init__.py": {"yaml.safe_load"},
    "lab/evaluate/segmentation.py": {"json.loads"},
    "lab/town/catalogue.py": {"yaml.load"},
    "lab/train/arrays.py": {"json.loads"},
    "lab/train/selection.py": {"json.loads"},
}
"""{module: its calls}; a new format is parsed in ``lidar_synth/files``."""


def parsers_of(path: Path) -> set[str]:
    calls = [
        node.func
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
    ]
    return {
        ast.unparse(call)
        for call in calls
        if isinstance(call, ast.Name | ast.Attribute)
    } & PARSERS


def test_no_parser_stands_outside_the_files_room() -> None:
    found = {
        str(p.relative_to(PACKAGE)): parsers_of(p)
        for p in sorted(PACKAGE.rglob("*.py"))
    }
    assert {
        n: c for n, c in found.items() if c and not n.startswith("files/")
    } == OUTSIDE
    assert "torch.load" not in set().union(*found.values())


def test_pictures_start_no_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow gives PostScript to Ghostscript, whatever the name of the file says."""
    trace = tmp_path / "ran"
    program = tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {trace}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")
    picture = tmp_path / "000000.png"
    picture.write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"
    )
    with pytest.raises(DataError, match=r"000000\.png cannot be read"):
        read_picture(picture)
    assert not trace.exists()
