"""Resuming MMDetection3D from its own checkpoints with torch 2.6 or later.

mmengine 0.10 reads a checkpoint by ``torch.load``, which since torch 2.6 refuses everything but
tensors and plain values, unless it is declared safe. A checkpoint of mmengine also holds numbers of
numpy, the history of the loss and parts of the configuration. They are declared here, so that no
pickle has to be read that may run code.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from mmengine.config import ConfigDict
from mmengine.logging import HistoryBuffer


def method_of_history(owner: Any, name: str) -> Callable[..., Any]:
    """A method of ``HistoryBuffer``, in the place of ``getattr``, by which a pickle names it.

    Raises:
        ValueError: on any other attribute.
    """
    if owner is not HistoryBuffer or name not in ("current", "max", "mean", "min"):
        raise ValueError(
            f"the checkpoint reads {owner!r}.{name}; expected a method of mmengine's HistoryBuffer"
        )
    method: Callable[..., Any] = getattr(owner, name)
    return method


def allow_checkpoints() -> None:
    """Declare what a checkpoint of mmengine holds as safe to read."""
    # before torch 2.6 nothing is refused
    if not hasattr(torch.serialization, "get_unsafe_globals_in_checkpoint"):
        return
    dtypes = {type(np.dtype(kind)) for kind in ("?", "i4", "i8", "f4", "f8")}
    names: tuple[Any, ...] = (
        np.float64(0).__reduce__()[0],
        np.zeros(0).__reduce__()[0],
        np.ndarray,
        np.dtype,
        ConfigDict,
        HistoryBuffer,
        *dtypes,
    )
    torch.serialization.add_safe_globals(
        [*names, (method_of_history, "builtins.getattr")]
    )
