"""Pickles read as data: the opcodes build plain values and named calls, and nothing is imported or
called.

A pickle is a program. Python's own reader looks up functions by name and calls them, so a foreign
file can do anything. Here a name stays text, and a call stays a ``Call`` that holds the name and
the arguments. Whoever reads a format takes the calls that it knows apart, such as those of numpy's
arrays. All protocols (0 to 5) are read. A reader either lists the names that may occur, so that any
other refuses the file, or takes every name as an inert placeholder.
"""

import pickletools
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

from lidar_synth.errors import DataError, shorten
from lidar_synth.files.disk import SKIP_HINT

MOST_STEPS = 200_000
"""Maximum number of opcodes; PandaSet's tables have up to a few thousand."""

PERSISTENT = "persistent_load"
"""Name of the ``Call`` that stands for what a pickle keeps outside itself, such as a tensor's
values."""


DTYPE = "numpy.dtype"
ENCODE = "_codecs.encode"
"""Names of the calls with which numpy writes types, and protocol 2 bytes."""

TYPES = frozenset(
    ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
)
"""Types of arrays of numbers; arrays of objects (``O8``) may hold text, numbers, truth values and
None."""


@dataclass(frozen=True)
class Name:
    """A function or class that the pickle names, such as ``numpy.ndarray``."""

    text: str


@dataclass(eq=False)
class Call:
    """A call that the pickle asks for and that nobody makes.

    Args:
        name: of the function or class.
        args: its arguments: plain values, names and calls.
        state: the state that the object would get afterwards.
        items, values: what it would hold as a dictionary and as a list; only where all names are
            placeholders.
    """

    name: str
    args: tuple[Any, ...]
    state: Any = None
    items: dict[Any, Any] = field(default_factory=dict)
    values: list[Any] = field(default_factory=list)


def parse_pickle(
    content: bytes | BinaryIO,
    known: Collection[str] | None,
    where: str,
    expected: str,
    most: int = MOST_STEPS,
) -> Any:
    """Read a pickle as data.

    Args:
        content: the bytes of the pickle, or an open file that is read up to the pickle's end.
        known: names of functions and classes that may occur; None to take all of them as inert
            placeholders.
        where: name of the pickle in errors, usually its path.
        expected: description of what it should hold, for errors.
        most: maximum number of opcodes.

    Returns:
        None, truth values, numbers, text, bytes, tuples, lists, dictionaries, ``Name`` and
        ``Call``. Values that occur several times in the pickle are one object.

    Raises:
        DataError: on a truncated or damaged pickle, a name that is not ``known``, or too many
            opcodes.
    """
    machine = _OpenMachine() if known is None else _Machine(known)
    try:
        for step, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if step >= most:
                raise DataError(
                    f"{where} has more than {most} opcodes", expected, SKIP_HINT
                )
            machine.run(opcode.name, argument)
        [value] = machine.stack if not machine.below else []
    except _Unknown as error:
        raise DataError(
            f"{where} would {error} when loaded, and was not loaded",
            expected,
            "A pickle that contains code can do anything: get the file from the dataset's own "
            "release page.",
        ) from None
    # What a damaged pickle causes: an empty stack, an unknown reference, a value of another kind,
    # invalid text.
    except (ValueError, IndexError, KeyError, TypeError, OverflowError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"{where} is a truncated or damaged pickle", expected, SKIP_HINT
        ) from error
    return value


def dtype_of(value: Any) -> "np.dtype[Any]":
    """The type of an array or a number of numpy, from the call that makes it.

    Raises:
        TypeError, ValueError: if it is no such call, or a type of structures, text or dates.
    """
    if not isinstance(value, Call) or value.name != DTYPE:
        raise TypeError(f"a {type(value).__name__} instead of {DTYPE}")
    [text, *_] = value.args
    _, order, *structure = value.state
    if order not in ("<", ">", "|", "=") or any(
        part is not None for part in structure[:3]
    ):
        raise ValueError("an array of structures")
    if text in ("O8", "O4", "O"):
        return np.dtype(object)
    if text not in TYPES:
        raise ValueError(f"an array of {text!r}")
    dtype: np.dtype[Any] = np.dtype(f"{order}{text}")
    return dtype


def bytes_of(value: Any) -> bytes | bytearray:
    """The bytes of an array; protocol 2 writes them as text with one character for each byte.

    Raises:
        TypeError, ValueError: if it is something else.
    """
    if isinstance(value, Call) and value.name == ENCODE:
        [value, _] = value.args
    if isinstance(value, str):
        return value.encode("latin-1")
    if not isinstance(value, bytes | bytearray):
        raise TypeError(f"a {type(value).__name__} instead of an array's bytes")
    return value


class _Unknown(Exception):
    """A name or an opcode that a table does not have."""


class _Machine:
    """The stack and the memory of a pickle; ``run`` executes one opcode."""

    def __init__(self, known: Collection[str]) -> None:
        self.known = known
        self.stack: list[Any] = []
        self.below: list[list[Any]] = []  # what lies under each mark
        self.memory: dict[int, Any] = {}

    def run(self, opcode: str, argument: Any) -> None:
        if opcode in _VALUES:
            self.stack.append(argument)
        elif opcode in _MAKERS:
            self.stack.append(_MAKERS[opcode]())
        elif opcode in _STEPS:
            _STEPS[opcode](self, argument)
        elif opcode in _OPEN_STEPS and isinstance(self, _OpenMachine):
            _OPEN_STEPS[opcode](self, argument)
        elif opcode not in ("PROTO", "FRAME", "STOP"):
            raise _Unknown(f"run the opcode {opcode}")

    def since_mark(self) -> list[Any]:
        """The values above the last mark, which are taken off the stack."""
        values = self.stack
        self.stack = self.below.pop()
        return values

    def push_since_mark(self, kind: Callable[[list[Any]], Any]) -> None:
        values = self.since_mark()
        self.stack.append(kind(values))

    def push_items(self) -> None:
        values = self.since_mark()
        self.stack.append({})
        self.set_items(values)

    def mark(self, _: Any) -> None:
        self.below.append(self.stack)
        self.stack = []

    def name(self, text: str) -> None:
        if text not in self.known:
            raise _Unknown(f"call {shorten(repr(text), 200)}")
        self.stack.append(Name(text))

    def stack_name(self, _: Any) -> None:
        attribute = self.stack.pop()
        module = self.stack.pop()
        if not isinstance(module, str) or not isinstance(attribute, str):
            raise TypeError("a name that is not text")
        self.name(f"{module}.{attribute}")

    def call(self, _: Any) -> None:
        args = self.stack.pop()
        name = self.stack.pop()
        if not isinstance(name, Name) or not isinstance(args, tuple):
            raise TypeError("a call of something else than a name")
        self.stack.append(Call(name.text, args))

    def build(self, _: Any) -> None:
        state = self.stack.pop()
        call = self.stack[-1]
        if not isinstance(call, Call) or call.state is not None:
            raise TypeError("a state for something else than a new object")
        call.state = state

    def remember(self, place: Any) -> None:
        self.memory[len(self.memory) if place is None else place] = self.stack[-1]

    def tuple_of(self, count: int) -> None:
        values = [self.stack.pop() for _ in range(count)]
        self.stack.append(tuple(reversed(values)))

    def extend(self, values: list[Any]) -> None:
        if not isinstance(self.stack[-1], list):
            raise TypeError("values for something else than a list")
        self.stack[-1].extend(values)

    def set_items(self, values: list[Any]) -> None:
        if not isinstance(self.stack[-1], dict) or not all(
            isinstance(key, str) for key in values[::2]
        ):
            raise TypeError(
                "items for something else than a dictionary, or with a key that is not text"
            )
        self.stack[-1].update(zip(values[::2], values[1::2], strict=True))


class _OpenMachine(_Machine):
    """A machine for pickles of any objects: all names are placeholders, and what cannot be kept
    becomes text."""

    def __init__(self) -> None:
        super().__init__(())

    def name(self, text: str) -> None:
        self.stack.append(Name(text))

    def call(self, _: Any) -> None:
        args = self.stack.pop()
        name = self.stack.pop()
        self.call_of(name, args if isinstance(args, tuple) else ())

    def call_of(self, name: Any, args: Any) -> None:
        self.stack.append(Call(_text(name), tuple(args)))

    def call_since_mark(self, _: Any) -> None:
        name, *args = self.since_mark()
        self.call_of(name, args)

    def build(self, _: Any) -> None:
        state = self.stack.pop()
        if isinstance(self.stack[-1], Call):
            self.stack[-1].state = state

    def extend(self, values: list[Any]) -> None:
        target = self.stack[-1]
        (target.values if isinstance(target, Call) else target).extend(values)

    def set_items(self, values: list[Any]) -> None:
        target = self.stack[-1]
        items = target.items if isinstance(target, Call) else target
        items.update(zip(map(_key, values[::2]), values[1::2], strict=True))


def _key(value: Any) -> Any:
    """A key for a dictionary: a plain value as it is, and text for a class or an object."""
    if value is None or isinstance(value, str | int | float | bytes):
        return value
    return _text(value)


def _text(value: Any) -> str:
    """A placeholder: the name of a class, a function or a call, or the type of another value."""
    if isinstance(value, Name):
        return value.text
    return value.name if isinstance(value, Call) else type(value).__name__


_VALUES = frozenset(
    """INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING
    UNICODE SHORT_BINUNICODE BINUNICODE BINUNICODE8 SHORT_BINBYTES BINBYTES BINBYTES8
    BYTEARRAY8""".split()
)
"""Opcodes whose argument is a value."""

_MAKERS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_TUPLE": tuple,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
}
"""Opcodes of a value that they do not tell."""

_STEPS: dict[str, Callable[[_Machine, Any], object]] = {
    "MARK": _Machine.mark,
    "POP": lambda m, _: m.stack.pop(),
    "POP_MARK": lambda m, _: m.since_mark(),
    "DUP": lambda m, _: m.stack.append(m.stack[-1]),
    "TUPLE": lambda m, _: m.push_since_mark(tuple),
    "TUPLE1": lambda m, _: m.tuple_of(1),
    "TUPLE2": lambda m, _: m.tuple_of(2),
    "TUPLE3": lambda m, _: m.tuple_of(3),
    "LIST": lambda m, _: m.push_since_mark(list),
    "DICT": lambda m, _: m.push_items(),
    "APPEND": lambda m, _: m.extend([m.stack.pop()]),
    "APPENDS": lambda m, _: m.extend(m.since_mark()),
    "SETITEM": lambda m, _: m.set_items([m.stack.pop(-2), m.stack.pop()]),
    "SETITEMS": lambda m, _: m.set_items(m.since_mark()),
    "PUT": _Machine.remember,
    "BINPUT": _Machine.remember,
    "LONG_BINPUT": _Machine.remember,
    "MEMOIZE": _Machine.remember,
    "GET": lambda m, place: m.stack.append(m.memory[place]),
    "BINGET": lambda m, place: m.stack.append(m.memory[place]),
    "LONG_BINGET": lambda m, place: m.stack.append(m.memory[place]),
    "GLOBAL": lambda m, argument: m.name(argument.replace(" ", ".")),
    "STACK_GLOBAL": _Machine.stack_name,
    "REDUCE": _Machine.call,
    "NEWOBJ": _Machine.call,
    "BUILD": _Machine.build,
}

_OPEN_STEPS: dict[str, Callable[[_OpenMachine, Any], object]] = {
    "PERSID": lambda m, argument: m.call_of(Name(PERSISTENT), (argument,)),
    "BINPERSID": lambda m, _: m.call_of(Name(PERSISTENT), (m.stack.pop(),)),
    "NEWOBJ_EX": lambda m, _: m.call(m.stack.pop()),  # without the arguments by name
    "INST": lambda m, text: m.call_of(Name(text.replace(" ", ".")), m.since_mark()),
    "OBJ": _OpenMachine.call_since_mark,
    "EMPTY_SET": lambda m, _: m.stack.append([]),
    "ADDITEMS": lambda m, _: m.extend(m.since_mark()),
    "FROZENSET": lambda m, _: m.push_since_mark(list),
}
"""Opcodes that only occur in pickles of any objects; a set becomes a list."""
