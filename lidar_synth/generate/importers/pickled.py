"""Reading the pickles in which peers ship their weights: tensors and plain values come out, code never runs."""

import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidar_synth.errors import DataError, FileError


def load_pickle(path: Path, peer: str) -> Any:
    """What a ``.pth`` or ``.ckpt`` holds.

    Args:
        path: the file.
        peer: whose it is, to name in an error.

    Raises:
        FileError: where it cannot be read.
        DataError: on a file that is cut, is no such file, or asks for code.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise FileError(
            f"{path} cannot be read ({error.strerror or error})", f"a {path.suffix} file of {peer}"
        ) from error
    except Exception as error:  # a damaged pickle can raise anything
        if code := re.search(r"GLOBAL ([\w.]+)", str(error)):
            raise DataError(
                f"{path} calls for {code[1]} when it is loaded, and was not loaded",
                "tensors and plain values only",
                f"A pickle with code in it can do anything: get the file from {peer}'s own release page.",
            ) from error
        raise DataError(
            f"{path} is cut, damaged or no {path.suffix} file", f"a whole file of {peer}'s release"
        ) from error


def state_of(content: Any, key: str, path: Path) -> dict[str, Tensor]:
    """The state dictionary under a key.

    Raises:
        DataError: where there is none.
    """
    weights = content[key]
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise DataError(f"{path}: its weights are no tensors by name", "the state dictionary of a network")
    return weights
