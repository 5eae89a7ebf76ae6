"""Names that libraries have removed and that trainers of 2019 to 2022 still use: what our launchers
set, and why.

A launcher calls ``provide("numpy.float", "imp")`` before it runs the trainer's script. Whatever is
missing is set, and one line of output says what was. ``NAMES`` is the only place for such names.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import find_spec, module_from_spec, spec_from_loader
from types import ModuleType
from typing import Any

import numpy as np
import torch

from lidar_synth.errors import LibraryError


def provide(*names: str) -> list[str]:
    """Set the names that are missing here, and print which.

    Args:
        names: keys of ``NAMES``.

    Returns:
        The names that were set.

    Raises:
        LibraryError: if a library that replaces a removed one is not installed.
    """
    provided = [name for name in names if NAMES[name][1]()]
    if provided:
        print(
            f"lidar_synth: provides {', '.join(f'{name} ({NAMES[name][0]})' for name in provided)}",
            flush=True,
        )
    return provided


def _numpy(name: str, kind: type) -> bool:
    """Numpy's former name of a Python type."""
    missing = not hasattr(np, name)
    if missing:
        setattr(np, name, kind)
    return missing


def _module(name: str, **content: Any) -> ModuleType:
    """Make a module that ``import name`` finds."""
    sys.modules[name] = module = module_from_spec(ModuleSpec(name, None))
    module.__dict__.update(content)
    return module


def _imp() -> bool:
    """``imp.load_source(name, path)``: run a file as a module of that name."""
    if find_spec("imp"):
        return False

    def load_source(name: str, path: str) -> ModuleType:
        spec = spec_from_loader(name, loader := SourceFileLoader(name, path))
        assert spec is not None
        sys.modules[name] = module = module_from_spec(spec)
        loader.exec_module(module)
        return module

    _module("imp", load_source=load_source)
    return True


def _tensorflow() -> bool:
    """TensorFlow 1's summaries, written by TensorBoard: the same messages in the same kind of
    file."""
    installed = "tensorflow" in sys.modules or find_spec("tensorflow")
    if installed and hasattr(import_module("tensorflow").summary, "FileWriter"):
        return False
    try:
        tensorboard = import_module("tensorboard.compat")
        messages = import_module("tensorboard.compat.proto.summary_pb2")
        writer = import_module("torch.utils.tensorboard.writer")
    except ImportError as error:
        raise LibraryError(
            f"tensorboard cannot be imported ({error})",
            "tensorboard, for logs",
            "pip install tensorboard",
        ) from error
    # TensorBoard looks for TensorFlow once, when this is first used: here, before ours is set.
    assert tensorboard.tf.io
    summary = _module("tensorflow.summary", FileWriter=writer.FileWriter)
    _module(
        "tensorflow",
        summary=summary,
        Summary=messages.Summary,
        HistogramProto=messages.HistogramProto,
    )
    return True


def _torchvision() -> bool:
    """An empty torchvision for scripts that import it and use nothing of it."""
    try:
        import_module("torchvision.transforms")
    except (ImportError, RuntimeError):  # RuntimeError: built for another torch
        for name in [n for n in sys.modules if n.split(".")[0] == "torchvision"]:
            del sys.modules[name]
        _module("torchvision", transforms=_module("torchvision.transforms"))
        return True
    return False


def _spconv() -> bool:
    """``import spconv`` of spconv 1, served by spconv 2.

    Submanifold convolutions with one ``indice_key`` and different kernels share their neighbours in
    spconv 1; spconv 2 refuses that, so the kernel becomes part of the key. Features may be assigned
    again.
    """
    if not find_spec("spconv"):
        raise LibraryError(
            "spconv is not installed",
            "spconv 2, for this trainer's network",
            "pip install spconv",
        )
    if not find_spec("spconv.pytorch"):
        return False  # spconv 1
    old = import_module("spconv")
    new = import_module("spconv.pytorch")

    class SubMConv3d(new.SubMConv3d):  # type: ignore[misc, name-defined]
        def __init__(
            self, ins: int, outs: int, kernel_size: Any, *args: Any, **options: Any
        ) -> None:
            if options.get("indice_key"):
                options["indice_key"] = f"{options['indice_key']} {kernel_size}"
            super().__init__(ins, outs, kernel_size, *args, **options)

    tensor = new.SparseConvTensor
    tensor.features = property(
        tensor.features.fget, lambda self, value: setattr(self, "_features", value)
    )
    for name in (
        "SparseConvTensor",
        "SparseConv3d",
        "SparseInverseConv3d",
        "SparseSequential",
        "SparseModule",
    ):
        setattr(old, name, getattr(new, name))
    old.SubMConv3d = SubMConv3d  # type: ignore[attr-defined]
    return True


def _torch_load() -> bool:
    """Numpy's numbers in a checkpoint: ``torch.load`` reads them again, and still runs no code."""
    scalar: Any = np.float64(0).__reduce__()[0]
    kinds = [
        type(np.dtype(kind)) for kind in (np.float32, np.float64, np.int32, np.int64)
    ]
    missing = scalar not in torch.serialization.get_safe_globals()
    torch.serialization.add_safe_globals([scalar, np.dtype, *kinds])
    return missing


NAMES: dict[str, tuple[str, Callable[[], bool]]] = {
    "numpy.float": ("removed in numpy 1.24", lambda: _numpy("float", float)),
    "numpy.int": ("removed in numpy 1.24", lambda: _numpy("int", int)),
    "imp": ("removed in Python 3.12", _imp),
    "tensorflow.summary": ("of TensorFlow 1, written by TensorBoard", _tensorflow),
    "torchvision": ("imported without use; empty here", _torchvision),
    "torch.load": ("of numpy's numbers, refused since torch 2.6", _torch_load),
    "spconv": ("of spconv 1, by spconv 2", _spconv),
}
"""Name: (since when or how, the function that sets it and returns whether it was missing)."""
