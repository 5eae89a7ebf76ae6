"""Stands in for mmcv's compiled operators, which datasets and transforms never call: they only have
to import."""

import sys
from types import ModuleType
from typing import Any


class _Operators(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def missing(*args: Any, **options: Any) -> None:
            raise RuntimeError(f"mmcv's operator {name} is not compiled")

        return missing


def install() -> None:
    """Put the stand-in where mmcv looks, unless the real operators are there."""
    from importlib.util import find_spec

    if find_spec("mmcv") is not None and find_spec("mmcv._ext") is None:
        sys.modules["mmcv._ext"] = _Operators("mmcv._ext")
