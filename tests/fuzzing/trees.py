"""Changes of files and folders as such: missing, moved, linked, empty, or of another kind."""

import os
import shutil
from pathlib import Path
from random import Random

NAMES = (
    "x",
    "velodyne",
    "training",
    "sequences",
    "00",
    "scans.json",
    "index.json",
    "0000000000.bin",
    "a b",
    "é",
    "-",
)
"""What a file or folder may be called instead."""


def rearrange(root: Path, rng: Random) -> None:
    """Keep one dataset of a folder, and change its tree in one to three places."""
    datasets = sorted(root.iterdir())
    kept = rng.choice(datasets)
    others = [
        path
        for folder in datasets
        if folder != kept
        for path in sorted(folder.rglob("*"))
    ]
    foreign = rng.choice(others)
    for _ in range(rng.choice((1, 1, 2, 3))):
        change_tree(kept, foreign, rng)
    for folder in datasets:
        if folder != kept:
            shutil.rmtree(folder)


def change_tree(root: Path, foreign: Path, rng: Random) -> None:
    """One change; ``foreign`` is a file or folder of another dataset."""
    paths = sorted(root.rglob("*"))
    if not paths:
        return
    path = rng.choice(paths)
    other = rng.choice(paths)
    change = rng.randrange(9)
    if change == 0:
        remove(path)
    elif change == 1:
        move(
            path,
            path.with_name(
                rng.choice((*NAMES, other.name, path.stem, path.name.upper()))
            ),
        )
    elif change == 2:
        move(path, other.parent / path.name)
    elif change == 3:
        remove(path)
        path.write_bytes(rng.choice((b"", b"\0", b"{}")))
    elif change == 4:
        remove(path)
        path.mkdir()
    elif change == 5:
        remove(path)
        path.symlink_to(rng.choice((path, root, root.parent, root / "missing", other)))
    elif change == 6:
        copy(foreign, rng.choice((path.parent / foreign.name, path)))
    elif change == 7:
        copy(
            path, path.with_name(rng.choice((*NAMES, f"{path.stem} (1){path.suffix}")))
        )
    else:
        moved = root.with_name("nested")
        root.rename(moved)
        root.mkdir()
        move(moved, root / rng.choice(NAMES))


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def move(path: Path, to: Path) -> None:
    if to != path and path not in to.parents and to not in path.parents:
        remove(to)
        path.rename(to)


def copy(path: Path, to: Path) -> None:
    # links may lead into the folder that is copied
    inside = Path(os.path.realpath(to.parent))
    given = Path(os.path.realpath(path))
    if to == path or given in (inside, *inside.parents) or to in path.parents:
        return
    remove(to)
    if path.is_dir():
        shutil.copytree(path, to, symlinks=True)
    else:
        shutil.copy(path, to, follow_symlinks=False)
