"""Malicious banks: no other file is read, and no memory is allocated for mere declarations."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from banks import SENSOR, some_image, write_bank
from hostile import MARKUP, tags_of

from lidar_synth.bank import INDEX, Bank, Index, ShardReader
from lidar_synth.bank.card import dataset_card
from lidar_synth.errors import DataError, LidarSynthError
from lidar_synth.files.parsing import json_checksum

LIMIT = 50 << 20  # bytes of memory that a refusal may use

CHILD = """
import resource, sys
from pathlib import Path
from lidar_synth.bank import ShardReader
from lidar_synth.errors import DataError

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

def read(path):
    with ShardReader(path, str(path)) as shard:
        shard.read(0), shard.read(1), shard.condition(0)

read(Path(sys.argv[1]))  # the code is loaded and compiled
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30),) * 2)
start = peak()
for path in sys.argv[3:]:
    try:
        read(Path(path))
    except DataError:
        pass
    else:
        sys.exit(f"{path} was read")
    if peak() - start > int(sys.argv[2]):
        sys.exit(f"{path} took {(peak() - start) >> 20} MB")
"""

Change = Callable[[h5py.File, Path], None]


def replaced(name: str, make: Callable[[h5py.File, Path], Any]) -> Change:
    """Replace the dataset ``name`` by another one."""

    def change(file: h5py.File, beside: Path) -> None:
        file.pop(name, None)
        make(file, beside)

    return change


def declared(name: str, dtype: str, **options: Any) -> Change:
    """10^9 declared but unwritten values, in a shard that declares as many scans."""

    def make(file: h5py.File, _: Path) -> None:
        file.create_dataset(name, (10**9,), dtype, **options)
        file.attrs["scans"] = 10**9

    return replaced(name, make)


def outside(file: h5py.File, beside: Path, name: str = "range") -> np.ndarray[Any, Any]:
    """Write a file beside the shard with the correct values."""
    values: np.ndarray[Any, Any] = file[name][:]
    with h5py.File(beside / "other.h5", "w") as other:
        other[name] = values
    values.tofile(beside / "other.raw")
    return values


def linked(file: h5py.File, beside: Path) -> None:
    outside(file, beside)
    del file["range"]
    file["range"] = h5py.ExternalLink(str(beside / "other.h5"), "/range")


def stored_outside(file: h5py.File, beside: Path) -> None:
    values = outside(file, beside, "crc")
    del file["crc"]
    file.create_dataset(
        "crc",
        values.shape,
        "<u4",
        external=[(str(beside / "other.raw"), 0, values.nbytes)],
    )


def virtual(file: h5py.File, beside: Path) -> None:
    values = outside(file, beside)
    del file["range"]
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[:] = h5py.VirtualSource(beside / "other.h5", "range", values.shape)
    file.create_virtual_dataset("range", layout)


def soft_linked(file: h5py.File, _: Path) -> None:
    file.move("crc", "other")
    file["crc"] = h5py.SoftLink("/other")


def repacked(**options: Any) -> Change:
    """The same ranges, stored in another way."""

    def change(file: h5py.File, _: Path) -> None:
        values = file["range"][:]
        del file["range"]
        file.create_dataset("range", data=values, **options)

    return change


def huge_grid(file: h5py.File, _: Path) -> None:
    sensor = json.loads(file.attrs["sensor"]) | {"rows": 1 << 15, "columns": 1 << 15}
    file.attrs["sensor"] = np.bytes_(json.dumps(sensor).encode())
    for name, dtype in (("range", "<u2"), ("reflectance", "u1"), ("label", "u1")):
        del file[name]
        shape = (1, 1 << 15, 1 << 15)
        options = {
            "shuffle": True,
            "compression": "gzip",
            "compression_opts": 1,
            "fletcher32": True,
        }
        dataset = file.create_dataset(
            name, (2, *shape[1:]), dtype, chunks=shape, **options
        )
        for position in range(2):
            dataset.id.write_direct_chunk((position, 0, 0), b"a chunk")


def attribute(name: str, value: Any) -> Change:
    def change(file: h5py.File, _: Path) -> None:
        file.attrs[name] = value

    return change


def many_attributes(file: h5py.File, _: Path) -> None:
    for i in range(200):
        file.attrs[f"a{i}"] = i


HARMFUL: dict[str, Change] = {
    "seed declared": declared("seed", "<u8"),
    "index declared": declared("index", "<u8"),
    "crc declared": declared("crc", "<u4"),
    "crc in chunks": declared("crc", "<u4", chunks=(1 << 20,), compression="gzip"),
    "condition declared": declared("condition", "S4"),
    "condition of huge texts": replaced(
        "condition", lambda f, _: f.create_dataset("condition", (2,), "S2000000000")
    ),
    "condition of any length": replaced(
        "condition",
        lambda f, _: f.create_dataset(
            "condition", data=["a", "b"], dtype=h5py.string_dtype()
        ),
    ),
    "crc as references": replaced(
        "crc", lambda f, _: f.create_dataset("crc", (2,), h5py.ref_dtype)
    ),
    "crc as a compound": replaced(
        "crc", lambda f, _: f.create_dataset("crc", (2,), "u4,u4")
    ),
    "crc as a group": replaced("crc", lambda f, _: f.create_group("crc")),
    "another dataset": lambda f, _: f.create_dataset("other", (2,), "u4") and None,
    "external link": linked,
    "external storage": stored_outside,
    "virtual dataset": virtual,
    "soft link": soft_linked,
    "other chunks": repacked(
        chunks=(2, 8, 32), shuffle=True, compression="gzip", fletcher32=True
    ),
    "no chunks": repacked(),
    "another filter": repacked(
        chunks=(1, 8, 32), compression="lzf", shuffle=True, fletcher32=True
    ),
    "no checksum": repacked(chunks=(1, 8, 32), compression="gzip", shuffle=True),
    "a grid of 10^9 cells": huge_grid,
    "a long attribute": attribute("other", np.zeros(1000)),
    "an empty attribute": attribute("model", h5py.Empty("f")),
    "an attribute of any length": attribute("model", "small"),
    "a number as text": attribute("model", 10**12),
    "scans as a fraction": attribute("scans", 1e30),
    "nested JSON": attribute("settings", np.bytes_(b"[" * 50_000)),
    "many attributes": many_attributes,
}


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="needs Linux to measure the memory"
)
def test_malicious_shards_allocate_no_memory(tmp_path: Path) -> None:
    made = [
        harmful(tmp_path / str(number), what) for number, what in enumerate(HARMFUL)
    ]
    assert all(path.stat().st_size < 100_000 for _, path in made)
    given = [made[0][0], str(LIMIT), *(path for _, path in made)]
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *given],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("what", HARMFUL)
def test_a_malicious_shard_is_refused(tmp_path: Path, what: str) -> None:
    good, path = harmful(tmp_path, what)
    with ShardReader(good, "good") as shard:
        assert shard.read(1)["range"].any()
    with (
        pytest.raises(DataError, match="bad.h5"),
        ShardReader(path, str(path)) as shard,
    ):
        shard.read(0)


def harmful(folder: Path, what: str) -> tuple[Path, Path]:
    """A valid shard and a malicious one."""
    good, path = (
        write_bank(folder / name, [some_image(i) for i in range(2)])[0]
        for name in ("good", "bad")
    )
    path = path.rename(path.with_name("bad.h5"))
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        HARMFUL[what](file, folder)
    return good, path


# The index

WRONG: list[Any] = [
    1e30,
    -1,
    0,
    0.5,
    1e400,
    float("nan"),
    10**30,
    1 << 63,
    True,
    None,
    "",
    "x",
    "\ud800",
    [],
    {},
    [[]],
    [None],
    {"x": 1},
    "\0" * 300,
    json.loads("[" * 40 + "]" * 40),
]


def places(values: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of every value in a JSON document."""
    found = [path] if path else []
    for key, child in values.items() if isinstance(values, dict) else enumerate(values):
        found += (
            places(child, (*path, key))
            if isinstance(child, dict | list)
            else [(*path, key)]
        )
    return found


def with_value(values: Any, path: tuple[Any, ...], value: Any) -> Any:
    copy = json.loads(json.dumps(values))
    place = copy
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return copy


def use(root: Path) -> None:
    """Use a bank in every way: read scans and names, describe it, write its index."""
    bank = Bank(root)
    bank[0], bank.condition(0), bank[len(bank) - 1], list(bank.ids[:3])
    bank.facts_of(0).to_attributes()
    dataset_card("bank", bank.index).encode(), bank.index.to_json()


@pytest.mark.slow
def test_an_edited_index_is_read_or_refused(tmp_path: Path) -> None:
    write_bank(tmp_path, [some_image(i) for i in range(3)])
    text = (tmp_path / INDEX).read_text()
    values = {
        key: value for key, value in json.loads(text).items() if key != "checksum"
    }
    values["curation"] = ["nothing"]
    refused = 0
    for path in places(values):
        for wrong in WRONG:
            edited = with_value(values, path, wrong)
            (tmp_path / INDEX).write_text(
                json.dumps(edited | {"checksum": json_checksum(edited)})
            )
            try:
                use(tmp_path)
            except LidarSynthError:
                refused += 1
            except Exception as error:
                pytest.fail(
                    f"{path} = {str(wrong)[:40]!r}: {type(error).__name__}: {error}"
                )
    assert refused > 0.8 * len(places(values)) * len(WRONG)


@pytest.mark.parametrize(
    "text",
    ["[" * 10**6, '{"a":' * 10**5, "1" * 5000, "null", "[]", "1e400", "\ufeff{}", ""],
)
def test_invalid_index_texts_are_refused(text: str) -> None:
    with pytest.raises(LidarSynthError, match="index"):
        Index.from_json(text.encode("utf-8", "surrogatepass"), "index.json")


def test_a_deeply_nested_index_is_refused(tmp_path: Path) -> None:
    """JSON can parse this depth, but later steps could not process it."""
    write_bank(tmp_path, [some_image(0)])
    values = json.loads((tmp_path / INDEX).read_text())
    del values["checksum"]
    for depth in (10, 40, 300, 800):
        values["sources"][0]["settings"] = json.loads(
            '{"a":' * depth + "1" + "}" * depth
        )
        (tmp_path / INDEX).write_text(
            json.dumps(values | {"checksum": json_checksum(values)})
        )
        with pytest.raises(LidarSynthError):  # the shard says something else
            use(tmp_path)


def test_a_bank_of_this_sensor_is_read(tmp_path: Path) -> None:
    write_bank(tmp_path, [some_image(i, SENSOR) for i in range(3)])
    use(tmp_path)


def test_cards_show_markup_as_text(tmp_path: Path) -> None:
    write_bank(
        tmp_path / "bank",
        [some_image()],
        provenance={"licence": MARKUP, "data": MARKUP},
    )
    card = dataset_card(MARKUP, Bank(tmp_path / "bank").index)
    assert tags_of(card) == {
        "h1",
        "p",
        "table",
        "thead",
        "tbody",
        "tr",
        "th",
        "td",
        "pre",
        "code",
    }
    assert all(
        line.count("|") - line.count("\\|") == 3
        for line in card.splitlines()
        if line.startswith("| ")
    )
    assert card.count("\n# ") == 1
