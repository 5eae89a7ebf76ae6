"""Pickled tables of pandas: every spelling is read, and nothing in a hostile one is called."""

import codecs
import gzip
import io
import os
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from limits import in_limits, needs_limits
from pandaset_files import array, dump, table

from lidar_synth.errors import DataError, FileError
from lidar_synth.files.parsing import MOST_BYTES
from lidar_synth.files.pickles import MOST_STEPS, Call, Name, parse_pickle
from lidar_synth.formats.pandas_table import KNOWN, MOST_COLUMNS, read_table

GOLDEN = sorted((Path(__file__).parent / "golden" / "pandas").glob("*.pkl"))

COLUMNS: dict[str, Any] = {
    "x": np.array([1.5, -2.25, np.inf]),
    "d": np.array([0, 1, 1]),
    "f": np.arange(3, dtype="f4"),
    "label": np.array(["Car", "Bus", "Tram / Subway"], object),
    "yaw": np.array([0.5, 1.0, 2.0]),
    "stationary": np.array([True, False, True]),
    "rider": np.array(["-", None, np.nan], object),
}


def read(path: Path, *columns: str) -> dict[str, np.ndarray]:
    return read_table(path, columns or tuple(COLUMNS))


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_tables_of_pandas_itself_are_read(path: Path) -> None:
    """Written by the version of pandas and in the protocol that the file's name says; README.md
    there has the code."""
    found = read(path)
    for name, values in COLUMNS.items():
        expected = values.tolist()
        if name == "rider":  # pandas 3 writes nan for None
            found[name], expected = found[name][:1], expected[:1]
        assert found[name].tolist() == expected, name
        assert found[name].dtype == values.dtype


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("compressed", [False, True])
def test_the_published_form_is_read_in_every_protocol(
    tmp_path: Path, protocol: int, compressed: bool
) -> None:
    content = dump(table(COLUMNS), protocol)
    (tmp_path / "x.pkl").write_bytes(gzip.compress(content) if compressed else content)
    found = read(tmp_path / "x.pkl")
    for name, values in COLUMNS.items():
        assert (
            found[name].dtype == values.dtype
            and found[name].tolist()[:-1] == values.tolist()[:-1]
        )
    assert read(tmp_path / "x.pkl", "yaw").keys() == {"yaw"}
    assert read_table(tmp_path / "x.pkl", ("yaw",), ("d", "missing")).keys() == {
        "yaw",
        "d",
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda content: content[:-200],
            r"is truncated; expected a pickled pandas table",
        ),
        (
            lambda content: content[:10] + b"?" + content[11:],
            r"is damaged \(Error -3|is truncated|damaged pickle",
        ),
        (
            lambda content: gzip.compress(zlib.decompress(content, 31)[:-300]),
            "truncated or damaged pickle",
        ),
        (lambda content: b"", "truncated or damaged pickle"),
        (lambda content: b"hello", "truncated or damaged pickle|would call"),
        (lambda content: gzip.compress(dump({"a": 1})), "a dict instead of"),
        (
            lambda content: gzip.compress(dump(array(np.zeros(3)))),
            "instead of .*DataFrame; expected a pickled pandas table",
        ),
    ],
)
def test_damaged_tables_are_named(
    tmp_path: Path, change: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "x.pkl.gz"
    path.write_bytes(change(gzip.compress(dump(table(COLUMNS)))))
    with pytest.raises(DataError, match=f"x.pkl.gz.*({message})"):
        read(path)


def test_missing_files_and_columns_are_named(tmp_path: Path) -> None:
    path = tmp_path / "x.pkl"
    with pytest.raises(FileError, match=r"x.pkl cannot be read .*pickled pandas table"):
        read(path)
    path.write_bytes(dump(table(COLUMNS)))
    with pytest.raises(
        DataError, match="x.pkl has no column z; expected a table with x, z"
    ):
        read(path, "x", "z")


FLAG = "LIDAR_SYNTH_TEST_FLAG"


class Exploit:
    """Python's own reader calls this."""

    def __init__(self, function: Callable[..., Any], *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> Any:
        return self.call


def call(name: str, *args: Any) -> bytes:
    """A pickle that calls a function of a module, whether or not it is installed."""
    return dump(Call(name, args or ((),)))


def frame(values: Any, *, placement: Any = None, columns: int = 1) -> bytes:
    """A table whose block is something else."""
    tree = table({f"c{i}" if i else "x": np.zeros(3) for i in range(columns)})
    block = tree.state["_data"].state[3]["0.14.1"]["blocks"][0]
    block["values"] = values
    if placement is not None:
        block["mgr_locs"] = placement
    return dump(tree)


def repeated(opcodes: bytes, count: int) -> bytes:
    return b"\x80\x04" + opcodes * count + b"."


def many_blocks() -> bytes:
    """Each block refers to one long text, from which an array of its own would be made."""
    text = "x" * 16_000_000
    tree = table({"x": np.zeros(3)})
    saved = tree.state["_data"].state[3]["0.14.1"]
    state = (*array(np.zeros(3)).state[:4], Call("_codecs.encode", (text, "latin1")))
    values = Call(
        "numpy.core.multiarray._reconstruct", (), (1, (1, 2_000_000), *state[2:])
    )
    saved["blocks"] = [
        {"values": values, "mgr_locs": Call("builtins.slice", (0, 1, 1))}
    ] * 500
    return dump(tree)


CODE: dict[str, Callable[[], bytes]] = {
    "os.system": lambda: pickle.dumps(Exploit(os.system, f"touch ${FLAG}"), 2),
    "builtins.eval": lambda: pickle.dumps(
        Exploit(eval, f"open(__import__('os').environ['{FLAG}'], 'w')")
    ),
    "builtins.exec": lambda: pickle.dumps(
        Exploit(exec, f"import os; open(os.environ['{FLAG}'], 'w')"), 0
    ),
    "in a cell of a table": lambda: pickle.dumps(
        np.array([Exploit(os.system, f"touch ${FLAG}"), "Car"], object), protocol=4
    ),
    "of numpy": lambda: pickle.dumps(Exploit(np.save, os.environ[FLAG], np.zeros(1))),
    "as a codec": lambda: pickle.dumps(Exploit(codecs.open, os.environ[FLAG], "w")),
}
"""{name: pickle that makes a file when Python's own reader loads it}."""


@pytest.mark.parametrize("name", CODE)
def test_no_code_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    made = tmp_path / "made.npy"
    monkeypatch.setenv(FLAG, str(made))
    content = CODE[name]()
    path = tmp_path / "x.pkl.gz"
    path.write_bytes(gzip.compress(content))
    with pytest.raises(
        DataError,
        match=r"x.pkl.gz would call '[\w.]+' when loaded, and was not loaded.*release page",
    ):
        read(path)
    assert not made.exists()
    pickle.loads(content)
    assert made.exists(), "the pickle does nothing even in Python's own reader"


NAMES = """posix.system nt.system subprocess.Popen builtins.__import__ builtins.getattr
    builtins.open runpy.run_path importlib.import_module operator.attrgetter functools.partial
    types.CodeType copyreg.__newobj__ torch.load numpy.load numpy.core.multiarray.scalar
    numpy.core._internal._ctypes numpy.testing.rundocs numpy.f2py.compile
    pandas.read_pickle pandas.io.pickle.read_pickle pandas.eval pandas.core.computation.eval.eval
    pandas.io.common.urlopen pandas.core.internals.managers.BlockManager.__init__""".split()
"""Functions of Python, numpy and pandas that no table names."""

HOSTILE: dict[str, Callable[[], bytes]] = {
    # Names
    **{name: lambda name=name: call(name, "x") for name in NAMES},  # type: ignore[misc]
    "a nested attribute": lambda: b"\x80\x04\x8c\x05numpy\x8c\x0bndarray.ctx\x93.",
    "a name that is no text": lambda: b"\x80\x04K\x01K\x02\x93.",
    "a persistent id": lambda: b"\x80\x04\x8c\x01xQ.",
    "a persistent id in text": lambda: b"Px\n.",
    "an extension": lambda: b"\x80\x02\x82\x01.",
    "INST": lambda: b"(S'echo'\nios\nsystem\n.",
    "OBJ": lambda: b"(cos\nsystem\nS'echo'\no.",
    "keywords for a class": lambda: b"\x80\x04cnumpy\nndarray\n)}\x92.",
    "a frozen set": lambda: b"\x80\x04(K\x01\x91.",
    "a buffer outside": lambda: b"\x80\x05\x97.",
    # Calls and states of what is no call
    "a call of text": lambda: b"\x80\x04\x8c\x01x)R.",
    "a call without a tuple": lambda: b"\x80\x04cnumpy\nndarray\n]R.",
    "a state for a class": lambda: (
        b"\x80\x04cnumpy\nndarray\n}\x8c\x04__doc__\x8c\x01xsb."
    ),
    "a state twice": lambda: b"\x80\x04cnumpy\nndarray\n)R}b}b.",
    "items for a tuple": lambda: b"\x80\x04)\x8c\x01xK\x01s.",
    "a key that is no text": lambda: b"\x80\x04}]K\x01s.",
    "more on the stack": lambda: b"\x80\x04K\x01K\x02.",
    "an open mark": lambda: b"\x80\x04(K\x01.",
    "nothing": lambda: b"\x80\x04.",
    "no end": lambda: b"\x80\x04N",
    "no value there": lambda: b"\x80\x04h\x07.",
    "a number of many digits": lambda: b"L" + b"9" * 1_000_000 + b"L\n.",
    # Sizes
    "a place far away": lambda: b"\x80\x04Nr\xff\xff\xff\xff.",
    "16 EB of bytes": lambda: b"\x80\x04\x8e" + b"\xff" * 7 + b"\x7f.",
    "2 GB of text": lambda: b"\x80\x04X\xff\xff\xff\x7fx.",
    "2 GB of a number": lambda: b"\x80\x04\x8b\xff\xff\xff\x7fx.",
    "a frame of 8 EB": lambda: b"\x80\x04\x95" + b"\xff" * 7 + b"\x7fN.",
    "many opcodes": lambda: repeated(b"N", MOST_STEPS),
    "deep tuples": lambda: b"\x80\x04)" + b"\x85" * (MOST_STEPS - 10) + b".",
    "deep lists": lambda: (
        b"\x80\x04" + b"](" * (MOST_STEPS // 4) + b"e" * (MOST_STEPS // 4) + b"."
    ),
    "a list in itself": lambda: b"\x80\x04]q\x00h\x00a.",
    "twice as many, sixty times": lambda: b"\x80\x04]" + b"2\x86" * 60 + b".",
    "a bomb": lambda: gzip.compress(bytes(MOST_BYTES + 1), 1),
    "arrays of 16 MB, 500 times": many_blocks,
    # Tables
    "an array of 8 TB": lambda: frame(array(np.zeros(3), shape=(10**12, 1))),
    "an array of more than bits": lambda: frame(
        array(np.zeros(3), shape=(2**62, 2**62))
    ),
    "an array of objects by number": lambda: frame(array(np.zeros(3), dtype="O8")),
    "numbers as objects": lambda: frame(array(np.array([1, "a"], object), dtype="i8")),
    "a structure": lambda: frame(array(np.zeros(3), dtype="V8")),
    "text of numpy": lambda: frame(array(np.zeros(3), dtype="U2")),
    "dates": lambda: frame(array(np.zeros(3), dtype="M8")),
    "negative": lambda: frame(array(np.zeros(3), shape=(-1, 3))),
    "true rows": lambda: frame(array(np.zeros(3), shape=(True, 3))),  # type: ignore[arg-type]
    "three axes": lambda: frame(array(np.zeros((1, 3, 1)))),
    "no axis": lambda: frame(array(np.zeros(()))),
    "fewer values": lambda: frame(array(np.zeros(2), shape=(1, 3))),
    "lists in cells": lambda: frame(array(np.array([[1], None, "a"], object))),
    "names in cells": lambda: frame(
        array(np.array([Name("numpy.ndarray"), None, "a"], object))
    ),
    "another class as an array": lambda: frame(Call("pandas.StringDtype", ("python",))),
    "an array without a state": lambda: frame(
        Call("numpy.core.multiarray._reconstruct", ())
    ),
    "a slice of text": lambda: frame(
        array(np.zeros((1, 3))), placement=Call("builtins.slice", ("a",))
    ),
    "no slice": lambda: frame(
        array(np.zeros((1, 3))), placement=Call("builtins.slice", (0, 1, 0))
    ),
    "places outside": lambda: frame(
        array(np.zeros((1, 3))), placement=array(np.array([7]))
    ),
    "half a place": lambda: frame(
        array(np.zeros((1, 3))), placement=array(np.array([0.5]))
    ),
    "a million places": lambda: frame(
        array(np.zeros((1, 3))), placement=array(np.zeros(10**6, "i8"))
    ),
    "many columns": lambda: frame(array(np.zeros((1, 3))), columns=MOST_COLUMNS + 1),
}
"""{name: content of a file that is no table}."""


@pytest.mark.slow
@needs_limits
def test_hostile_pickles_are_refused_within_limits(tmp_path: Path) -> None:
    """In one process, which may take 600 MB."""
    for number, (name, make) in enumerate(HOSTILE.items()):
        (tmp_path / f"{number} {name.replace('.', '_')}.pkl").write_bytes(make())
    assert in_limits(refuse_all, tmp_path, megabytes=600) == ""


def refuse_all(folder: Path) -> None:
    for path in sorted(folder.glob("*.pkl")):
        try:
            read(path, "x")
        except DataError as error:
            assert path.name in str(error), path
        else:
            raise AssertionError(f"{path.name} was read")


def test_a_long_pickle_is_refused_before_its_end() -> None:
    content = b"\x80\x04" + b"N0" * MOST_STEPS + b"\xff"  # the last one is no opcode
    with pytest.raises(DataError, match="x has more than 200000 opcodes; expected y"):
        parse_pickle(content, (), "x", "y")


def test_keys_and_arguments_take_no_more_than_their_opcodes() -> None:
    """Deep tuples are not hashed, and arguments of several calls are not copied."""
    deep = b"\x80\x04})" + b"\x85" * (MOST_STEPS // 2) + b"Ns."
    assert parse_pickle(deep, None, "x", "y") == {"tuple": None}
    twice = b"\x80\x04(NNNNt\x940" + b"(" + 2 * b"ca\nb\nh\0R" + b"l."
    first, second = parse_pickle(twice, {"a.b"}, "x", "y")
    assert first.args is second.args


def test_names_that_are_known_are_not_imported() -> None:
    """A name stays text even where its module could not be imported."""
    tree = parse_pickle(call("nowhere.at.all", 1, "a"), {"nowhere.at.all"}, "x", "y")
    assert (tree.name, tree.args, tree.state) == ("nowhere.at.all", (1, "a"), None)
    assert all(
        name.split(".")[0]
        in (
            "numpy",
            "pandas",
            "builtins",
            "__builtin__",
            "_codecs",
            "copyreg",
            "copy_reg",
        )
        for name in KNOWN
    )
    assert not {"builtins.eval", "builtins.exec", "numpy.load"} & KNOWN


def test_plain_values_are_those_of_pythons_own_reader() -> None:
    values = {
        "a": [1, -2, 2**40, 2**200, 1.5, None, True, "ä", b"b", ()],
        "b": ({"c": []}, (1,), (1, 2), (1, 2, 3, 4)),
    }
    for protocol in range(3, 6):
        assert parse_pickle(pickle.dumps(values, protocol), (), "x", "y") == values
    file = io.BytesIO()
    pickle.Pickler(file, 2).dump({"a": [1, "b", 2.5], "c": None})
    assert parse_pickle(file.getvalue(), (), "x", "y") == {
        "a": [1, "b", 2.5],
        "c": None,
    }
