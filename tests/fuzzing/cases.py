"""Numbered cases: the files of a valid dataset, of which one is mutated. A number gives the same
bytes every time."""

import shutil
from collections.abc import Mapping
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path
from random import Random

# They enter their mutators.
from fuzzing import arrays, containers, hdf5, pickled, pictures, text, weights  # noqa: F401
from fuzzing.mutators import mutate
from fuzzing.targets import Target

Files = Mapping[str, bytes]
"""{path below the root: content}."""


def seed_files(target: Target, folder: Path) -> Files:
    """The files of the valid dataset; they are made in ``folder``, or read from there if it
    exists."""
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        target.make(part)
        part.rename(folder)
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def mutable(target: Target, files: Files) -> list[str]:
    """The names of the files that may be mutated."""
    return [
        name
        for name in files
        if any(fnmatch(Path(name).name, pattern) for pattern in target.files)
    ]


def mutated(target: Target, files: Files, rng: Random) -> dict[str, bytes | None]:
    """The files that are other in a case than in the valid dataset; None = missing."""
    name = rng.choice(mutable(target, files))
    change = rng.random()
    if change < 0.01:
        return {name: None}
    if change < 0.03:
        return {name: files[rng.choice(list(files))]}
    return {name: mutate(name, files[name], rng)}


class Cases:
    """The cases of a reader, put one at a time into a folder.

    Args:
        name: of the reader; a part of what decides a case.
        target: the reader.
        seed: of all cases.
        folder: for the valid dataset and the case that is in place.
    """

    def __init__(self, name: str, target: Target, seed: int, folder: Path) -> None:
        self.name = name
        self.target = target
        self.seed = seed
        self.files = seed_files(target, folder / "valid")
        self.root = folder / "case"
        shutil.rmtree(self.root, ignore_errors=True)
        self._changed = set(self.files)
        self.restore()

    def place(self, number: int) -> Path:
        """Put a case into the folder, beside the files that it shares with the valid dataset; the
        folder."""
        rng = Random(f"{self.seed}/{self.name}/{number}")
        if self.target.change is not None:
            self.target.change(self.root, rng)
            return self.root
        for name, content in mutated(self.target, self.files, rng).items():
            self._put(name, content)
        if self.target.mend is not None and rng.random() < 0.5:
            self._changed |= set(self.files)
            # what was mutated may have nothing that could be mended
            with suppress(Exception):
                self.target.mend(self.root)
        return self.root

    def restore(self) -> Path:
        """Put the valid dataset into the folder; the folder."""
        if self.target.writes or self.target.change is not None:
            shutil.rmtree(self.root, ignore_errors=True)
            self._changed = set(self.files)
        for name in sorted(self._changed):
            self._put(name, self.files[name])
        self._changed.clear()
        return self.root

    def _put(self, name: str, content: bytes | None) -> None:
        self._changed.add(name)
        path = self.root / name
        if content is None:
            path.unlink(missing_ok=True)
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
