"""Safe reading of peers' pickled weights: only tensors and plain values are loaded, and code never runs."""

import re
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from lidar_synth.errors import DataError, FileError


def load_pickle(path: Path, peer: str) -> Any:
    """The content of a ``.pth`` or ``.ckpt`` file.

    Args:
        path: the file.
        peer: name of the project that released it, for errors.

    Raises:
        FileError: if the file cannot be read.
        DataError: on a truncated file, one of another format, or one that contains code.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        kind = path.suffix or "weight"
        raise FileError(f"{path} cannot be read ({error.strerror or error})", f"a {kind} file of {peer}") from error
    with file:
        return unpickle(file, path, peer)


def unpickle(file: BinaryIO, path: Path, peer: str) -> Any:
    """The content of an open file; ``path`` names it in errors. See ``load_pickle``.

    Raises:
        DataError: on a truncated file, one of another format, or one that contains code.
    """
    kind = path.suffix or "weight"
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged pickle can raise anything
        if code := re.search(r"GLOBAL ([\w.]+)", str(error)):
            raise DataError(
                f"{path} would call {code[1]} when loaded, and was not loaded",
                "tensors and plain values only",
                f"A pickle that contains code can do anything: get the file from {peer}'s own release page.",
            ) from error
        raise DataError(
            f"{path} is truncated, damaged or no {kind} file", f"an intact file of {peer}'s release"
        ) from error


def state_of(content: Any, key: str, path: Path) -> dict[str, Tensor]:
    """The state dictionary under a key of a file's content.

    Raises:
        DataError: if the value is not a dictionary of tensors.
    """
    weights = content[key]
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise DataError(f"{path}: its weights are not tensors by name", "the state dictionary of a network")
    return weights
