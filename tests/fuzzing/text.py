"""Mutators of text: tables of numbers, JSON, YAML, XML, and the headers that are text."""

import json
import re
import xml.etree.ElementTree as ElementTree
from random import Random
from typing import Any

import yaml

from fuzzing.mutators import mutates

WORDS = (
    "0",
    "-1",
    "1",
    "2",
    "3",
    "64.5",
    "-0.0",
    "100000",
    "65536",
    "2147483647",
    "2147483648",
    "2000000000",
    "4294967296",
    "18446744073709551616",
    "1e9",
    "1e30",
    "1e308",
    "1e400",
    "-1e30",
    "nan",
    "inf",
    "-inf",
    "",
    "x",
    "0x10",
    "1_0",
    "1,5",
    "\u0663",
    "None",
    "null",
    "true",
    "[]",
    "{}",
    "../../x",
    "%s",
    "\x00",
    "\ud800",
    "9" * 5000,
    "a" * 100_000,
)
"""What takes the place of a number or a word."""

LINES = (".txt", ".json", ".yaml", ".xml", ".pcd", ".ply")
"""Suffixes of the files that are, or begin with, lines of text."""

DEEP = "@deep@"
LONG = "@long@"
"""Stand for values that no JSON writer writes: brackets within brackets, and a number of 5,000
digits."""

VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    -1,
    1,
    2,
    3,
    64.5,
    2**31,
    2_000_000_000,
    2**63,
    10**30,
    1e30,
    1e308,
    float("nan"),
    float("inf"),
    "",
    "x",
    "0",
    "64",
    "../../x",
    "a" * 100_000,
    "\x00",
    "\ud800",
    [],
    {},
    [0],
    [[1, 2], [3]],
    {"": 0},
    [1] * 1000,
    {"a": {"b": None}},
    DEEP,
    LONG,
)
"""What takes the place of a value of JSON or YAML."""


MOST_PLACES = 100_000
"""Values that are looked at for an edit."""


def encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


@mutates(*LINES)
def replace_number(content: bytes, rng: Random) -> bytes:
    """A number becomes another one, or none."""
    found = list(re.finditer(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", content[:100_000]))
    chosen = rng.choice(found)
    return (
        content[: chosen.start()] + encoded(rng.choice(WORDS)) + content[chosen.end() :]
    )


@mutates(*LINES)
def replace_word(content: bytes, rng: Random) -> bytes:
    """A word becomes another one of the file, or something foreign."""
    found = list(re.finditer(rb"[^\s\"'<>,:{}\[\]]+", content[:20_000]))
    chosen = rng.choice(found)
    other = rng.choice((rng.choice(found)[0], encoded(rng.choice(WORDS))))
    return content[: chosen.start()] + other + content[chosen.end() :]


@mutates(*LINES)
def change_lines(content: bytes, rng: Random) -> bytes:
    """Lines are dropped, repeated, swapped, joined or ended in another way."""
    lines = content.split(b"\n")
    i = rng.randrange(len(lines))
    j = rng.randrange(len(lines))
    change = rng.randrange(7)
    if change == 0:
        del lines[i]
    elif change == 1:
        lines.insert(j, lines[i])
    elif change == 2:
        lines[i:i] = [lines[i]] * min(5000, 1 + 1_000_000 // (len(lines[i]) + 1))
    elif change == 3:
        lines[i], lines[j] = lines[j], lines[i]
    elif change == 4:
        lines[i] = b" ".join(lines[i : i + 2])
    elif change == 5:
        return b"\r\n".join(lines)
    else:
        lines[i] = b""
    return b"\n".join(lines)


@mutates(*LINES)
def change_words_of_a_line(content: bytes, rng: Random) -> bytes:
    """A word of a line is dropped, or stands there several times."""
    lines = content.split(b"\n")
    i = rng.randrange(len(lines))
    words = lines[i].split(b" ")
    k = rng.randrange(len(words))
    words[k : k + 1] = [words[k]] * rng.choice((0, 2, 2, 3, 10_000))
    lines[i] = b" ".join(words)
    return b"\n".join(lines)


@mutates(".pcd", ".ply")
def edit_header(content: bytes, rng: Random) -> bytes:
    """Numbers, words and lines of a header change; what stands below it does not."""
    end = next(
        m.end() for m in re.finditer(rb"^(DATA|end_header)[^\n]*\n", content, re.M)
    )
    header = content[:end]
    for _ in range(rng.choice((1, 1, 2, 3))):
        change = rng.choice(
            (
                replace_number,
                replace_number,
                replace_word,
                change_lines,
                change_words_of_a_line,
            )
        )
        header = change(header, rng)
    return header + content[end:]


@mutates(".txt", ".json", ".yaml", ".xml")
def change_encoding(content: bytes, rng: Random) -> bytes:
    """Another encoding than UTF-8."""
    text = content.decode()
    return rng.choice(
        (
            text.encode("utf-16"),
            text.encode("utf-32-le"),
            b"\xef\xbb\xbf" + content,
            content + b"\xe9",
        )
    )


def places(root: Any) -> list[tuple[Any, Any]]:
    """(container, key) of every value below a value of JSON."""
    found: list[tuple[Any, Any]] = []
    waiting = [root]
    while waiting:
        node = waiting.pop()
        keys = (
            list(node)
            if isinstance(node, dict)
            else range(len(node))
            if isinstance(node, list)
            else []
        )
        found += [(node, key) for key in keys]
        if len(found) > MOST_PLACES:
            raise ValueError("aliases of aliases, which are not followed here")
        waiting += [node[key] for key in keys]
    return found


def edit(root: Any, rng: Random) -> None:
    """Change one value of JSON in place."""
    node, key = rng.choice(places(root))
    change = rng.randrange(8)
    if change == 0:
        del node[key]
    elif change == 1 and isinstance(node, dict):
        node[rng.choice(("", "x", "name", str(key) + " ", *map(str, node)))] = node.pop(
            key
        )
    elif change == 2 and isinstance(node, dict):
        node[rng.choice(("x", "", "__class__", "elevations", "self"))] = rng.choice(
            VALUES
        )
    elif change == 3:
        other, name = rng.choice(places(root))
        node[key] = json.loads(json.dumps(other[name]))
    elif change == 4 and isinstance(node, list):
        node[key:key] = [node[key]] * rng.choice((1, 2, 1000))
    elif change == 5 and isinstance(node[key], int | float):
        node[key] = rng.choice(
            (
                -node[key],
                node[key] * 2,
                node[key] + 0.5,
                str(node[key]),
                node[key] * 10**9,
            )
        )
    else:
        node[key] = rng.choice(VALUES)


def written(text: str, deep: int = 50_000) -> str:
    """JSON text with what ``DEEP`` and ``LONG`` stand for."""
    return text.replace(f'"{DEEP}"', "[" * deep + "]" * deep).replace(
        f'"{LONG}"', "9" * 5000
    )


def edit_json_text(text: str, rng: Random) -> str:
    """JSON after one to three edits of its values."""
    root = json.loads(text)
    for _ in range(rng.choice((1, 1, 2, 3))):
        edit(root, rng)
    return written(json.dumps(root))


@mutates(".json")
def edit_json(content: bytes, rng: Random) -> bytes:
    """Values of the JSON change."""
    return encoded(edit_json_text(content.decode(), rng))


@mutates(".yaml")
def edit_yaml(content: bytes, rng: Random) -> bytes:
    """Values of the YAML change."""
    root = yaml.safe_load(content)
    edit(root, rng)
    # Every JSON text is YAML too; nesting is kept shallower, because YAML's own parser takes long
    # for it.
    return encoded(
        written(json.dumps(root), 2000) if rng.random() < 0.5 else yaml.safe_dump(root)
    )


@mutates(".yaml")
def abuse_yaml(content: bytes, rng: Random) -> bytes:
    """What YAML offers beyond plain values: aliases of aliases, tags, merges, several documents."""
    bomb = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{b}: &{b} [{','.join([f'*{a}'] * 10)}]\n"
        for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    shared = "elevations: &e [5, 4, 3, 2, 1]\n"
    foreign = (
        bomb,
        "bomb:\n  " + bomb.replace("\n", "\n  ") + "\n  elevations: *i\n",
        shared,
        "a: &a {b: *a}\n",
        "<<: {rows: 3}\n",
        "<<: [1, 2]\n",
        "x: !!python/object/apply:os.system ['true']\n",
        "x: !!binary aGVsbG8=\n",
        "x: !!set {a, b}\n",
        "x: !!float 'x'\n",
        "x: !!int ''\n",
        "x: !!timestamp 2001-99-99\n",
        "x: 2001-02-30\n",
        "? [1, 2]\n: 3\n",
        "? {a: b}\n: 3\n",
        "---\nx: {}\n",
        "%YAML 9.9\n---\nx: {}\n",
        "x: 190:20:30\n",
        "x: 0b" + "1" * 20_000 + "\n",
        "x: " + "9" * 5000 + "\n",
        "x: " + "- " * 2000 + "\n",
    )
    return (
        content + encoded(rng.choice(foreign))
        if rng.random() < 0.7
        else encoded(rng.choice(foreign)) + content
    )


@mutates(".xml")
def edit_xml(content: bytes, rng: Random) -> bytes:
    """Text, names and order of the elements change."""
    root = ElementTree.fromstring(content)
    parents = [node for node in root.iter() if len(node)]
    for _ in range(rng.choice((1, 1, 2, 4))):
        parent = rng.choice(parents)
        i = rng.randrange(len(parent)) if len(parent) else 0
        change = rng.randrange(6)
        if not len(parent) or change == 0:
            leaves = [node for node in root.iter() if not len(node)]
            rng.choice(leaves).text = (
                rng.choice(WORDS[:-1]).replace("\x00", "").replace("\ud800", "")
            )
        elif change == 1:
            parent.remove(parent[i])
        elif change == 2:
            parent.extend([parent[i]] * rng.choice((1, 2, 50)))
        elif change == 3:
            parent[i].tag = rng.choice(("x", *(node.tag for node in root.iter())))
        elif change == 4:
            leaf = rng.choice([node for node in root.iter() if not len(node)])
            words = (leaf.text or "").split()
            leaf.text = " ".join(
                rng.choice(
                    (
                        words[:-1],
                        words * 2,
                        [*words, "1"],
                        words[::-1],
                        ["nan", *words[1:]],
                    )
                )
            )
        else:
            parent[:] = rng.sample(list(parent), len(parent))
    return ElementTree.tostring(root)


@mutates(".xml")
def abuse_xml(content: bytes, rng: Random) -> bytes:
    """Entities of entities, elements within elements, encodings, and what is no element."""
    body = (
        content[content.index(b"<", content.find(b"?>") + 1) :]
        if content.startswith(b"<?xml")
        else content
    )
    entities = b'<!ENTITY a "aaaaaaaaaa">' + b"".join(
        b'<!ENTITY %c "%s">' % (b, b"&%c;" % a * 10)
        for a, b in zip(b"abcdefgh", b"bcdefghi", strict=True)
    )
    depth = rng.choice((100, 100_000))
    return rng.choice(
        (
            b"<!DOCTYPE x ["
            + entities
            + b"]>"
            + re.sub(rb">\d", b">&i;", body, count=1),
            b'<!DOCTYPE x [<!ENTITY f SYSTEM "file:///etc/hostname">]>'
            + re.sub(rb">\d", b">&f;", body, count=1),
            b"<a>" * depth + body + b"</a>" * depth,
            b'<?xml version="1.0" encoding="%s"?>'
            % rng.choice((b"utf-16", b"x", b"cp037", b"utf-7", b"euc-jp"))
            + body,
            body + body,
            b"<x>" + b"<item/>" * 50_000 + body + b"</x>",
            b"<!--" + body + b"-->",
        )
    )
