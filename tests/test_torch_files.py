"""Weight files of strangers: every layout that ``torch.save`` writes is read as data, and nothing
in it runs."""

import argparse
import io
import os
import pickle
import struct
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from random import Random
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lidar_synth.errors import DataError
from lidar_synth.files.torch_files import load_pickle, state_of

FORMATS = {"zip": True, "legacy": False}
"""By name: ``_use_new_zipfile_serialization`` of ``torch.save``."""


@pytest.fixture(params=FORMATS)
def zipped(request: pytest.FixtureRequest) -> bool:
    return FORMATS[request.param]


def save(path: Path, content: Any, zipped: bool) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    return path


def some_tensors() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    base = torch.randn(6, 4, generator=generator)
    types = (
        torch.float64,
        torch.float16,
        torch.bfloat16,
        torch.int64,
        torch.int32,
        torch.int16,
        torch.int8,
        torch.uint8,
    )
    return {
        "plain": base,
        "turned": base.T,
        "a part": base[2:, 1],
        "one number": torch.ones(1).expand(5, 7),
        "scalar": torch.tensor(3.5),
        "none": torch.zeros(0, 3),
        "truth": base > 0,
        "parameter": nn.Parameter(base.clone()),
        **{str(dtype): (base * 10).abs().to(dtype) for dtype in types},
    }


def test_tensors_are_those_of_torch(tmp_path: Path, zipped: bool) -> None:
    tensors = some_tensors()
    found = load_pickle(save(tmp_path / "a.pth", tensors, zipped), "a peer")
    assert list(found) == list(tensors)
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype, name
        assert torch.equal(found[name], tensor.detach()), name
    assert (
        found["turned"].untyped_storage().data_ptr()
        == found["plain"].untyped_storage().data_ptr()
    )


@pytest.fixture
def lightning(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Classes under the names that pytorch-lightning 1.4 pickles."""
    module = ModuleType("pytorch_lightning_1_4")

    class ModelCheckpoint:
        pass

    class AttributeDict(dict):  # type: ignore[type-arg]
        pass

    for made in (ModelCheckpoint, AttributeDict):
        made.__module__, made.__qualname__ = module.__name__, made.__name__
        setattr(module, made.__name__, made)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    yield module


def test_a_checkpoint_of_lightning_1_4_is_read(
    tmp_path: Path, zipped: bool, lightning: Any
) -> None:
    state = OrderedDict(some_tensors())
    state._metadata = {"": {"version": 1}}  # type: ignore[attr-defined]  # as nn.Module.state_dict
    content = {
        "epoch": 3,
        "callbacks": {
            lightning.ModelCheckpoint: {
                "best_model_score": torch.tensor(0.5),
                "monitor": None,
            }
        },
        "hyper_parameters": lightning.AttributeDict(lr=1e-4, betas=(0.9, 0.99)),
        "namespace": argparse.Namespace(width=64, nested=argparse.Namespace(depth=2)),
        "loss": np.float64(0.25),
        "count": np.int32(7),
        "state_dict": state,
    }
    path = save(tmp_path / "model.ckpt", content, zipped)
    monkeyed = sys.modules.pop(lightning.__name__)
    try:
        found = load_pickle(path, "LiDM")
    finally:
        sys.modules[lightning.__name__] = monkeyed
    assert found["hyper_parameters"] == {"lr": 1e-4, "betas": (0.9, 0.99)}
    assert found["namespace"] == {"width": 64, "nested": {"depth": 2}}
    assert (found["loss"], found["count"], found["epoch"]) == (0.25, 7, 3)
    assert list(found["callbacks"]) == ["pytorch_lightning_1_4.ModelCheckpoint"]
    weights = state_of(found, "state_dict", path)
    assert all(
        torch.equal(weights[name], tensor.detach()) for name, tensor in state.items()
    )


@pytest.mark.parametrize(
    "wrap",
    ["{}", "module.{}", "_orig_mod.{}", "module._orig_mod.{}", "_orig_mod.module.{}"],
)
def test_names_of_wrapped_networks_are_those_of_the_network(
    tmp_path: Path, wrap: str
) -> None:
    state = {
        wrap.format(name): tensor
        for name, tensor in nn.Linear(2, 2).state_dict().items()
    }
    found = load_pickle(save(tmp_path / "a.pth", state, True), "a peer")
    assert set(state_of(found, "weights", tmp_path)) == {"weight", "bias"}
    assert set(state_of({"weights": found}, "weights", tmp_path)) == {"weight", "bias"}


class Evil:
    """An object that calls a function when Python's own reader loads it."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> Any:
        return self.call


class EvilState:
    def __init__(self, trace: str) -> None:
        self.trace = trace

    def __setstate__(self, state: Any) -> None:
        Path(state["trace"]).mkdir()


PLACES = ["weights", "key", "state", "list"]


@pytest.mark.parametrize("place", PLACES)
def test_a_hostile_file_runs_nothing(tmp_path: Path, zipped: bool, place: str) -> None:
    trace = tmp_path / "ran"
    evil = EvilState(str(trace)) if place == "state" else Evil(os.mkdir, str(trace))
    content = {
        "weights": {"weights": evil},
        "key": {"callbacks": evil, "weights": some_tensors()},
        "state": {"callbacks": evil, "weights": some_tensors()},
        "list": {"weights": [evil]},
    }[place]
    path = save(tmp_path / "evil.pth", content, zipped)
    found = load_pickle(path, "a peer")
    assert not trace.exists()
    if place in ("key", "state"):
        assert state_of(found, "weights", path)
    else:
        with pytest.raises(DataError, match="not tensors by name"):
            state_of(found, "weights", path)
    torch.load(path, weights_only=False)
    assert trace.exists(), "the file does nothing even in Python's own reader"


def rebuilt(
    size: tuple[int, ...], stride: tuple[int, ...], offset: int = 0, count: int = 4
) -> bytes:
    """A ZIP archive with one tensor in a storage of four float32, whatever its pickle says."""
    numbers = b"".join(b"\x8a\x08" + struct.pack("<q", n) for n in size)
    strides = b"".join(b"\x8a\x08" + struct.pack("<q", n) for n in stride)
    storage = b"(X\x07\0\0\0storagectorch\nFloatStorage\nX\1\0\0\0" + b"0X\3\0\0\0cpu"
    body = (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n("
        + storage
        + b"\x8a\x08"
        + struct.pack("<q", count)
        + b"tQ"
    )
    body += (
        b"\x8a\x08"
        + struct.pack("<q", offset)
        + b"("
        + numbers
        + b"t("
        + strides
        + b"t\x89}tR."
    )
    return archive(body)


def archive(
    body: bytes, storage: bytes = bytes(16), method: int = zipfile.ZIP_STORED
) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method) as file:
        file.writestr("a/data.pkl", body)
        file.writestr("a/data/0", storage)
    return content.getvalue()


def shared_lists() -> bytes:
    """2^60 values in 60 lists of the list before, twice."""
    value: list[Any] = [0]
    for _ in range(60):
        value = [value, value]
    return archive(pickle.dumps(value, 2))


def overlong() -> bytes:
    """A pickle of 1 GB by the list of members."""
    content = bytearray(archive(b"\x80\x02N."))
    at = content.index(b"PK\x01\x02")
    content[at + 20 : at + 24] = struct.pack("<I", 1 << 30)
    return bytes(content)


DAMAGED = {
    "beyond the storage": lambda: rebuilt((5,), (1,)),
    "an offset beyond": lambda: rebuilt((1,), (1,), 4),
    "a stride beyond": lambda: rebuilt((2, 2), (3, 1)),
    "a negative offset": lambda: rebuilt((1,), (1,), -1),
    "a negative stride": lambda: rebuilt((2,), (-1,), 3),
    "a size that wraps": lambda: rebuilt((1 << 62, 8), (0, 0)),
    "8 EB of one number": lambda: rebuilt((1 << 40, 1 << 20), (0, 0)),
    "more strides than sizes": lambda: rebuilt((2,), (1, 1)),
    "a storage of another size": lambda: rebuilt((2,), (1,), count=1 << 40),
    "compressed": lambda: archive(
        b"\x80\x02N.", bytes(10_000_000), zipfile.ZIP_DEFLATED
    ),
    "shared lists": shared_lists,
    "2 GB of text": lambda: archive(b"\x80\x04X\xff\xff\xff\x7fx."),
    "opcodes without end": lambda: archive(b"\x80\x02" + b"N0" * 1_600_000 + b"N."),
    "a member that is longer than the file": overlong,
    "no pickle": lambda: archive(b""),
    "text": lambda: b"not a weight file",
    "nothing": lambda: b"",
    "an old tar": lambda: b"pickle\0" + bytes(2000),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_are_refused_within_limits(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.pth"
    path.write_bytes(DAMAGED[name]())
    with pytest.raises(
        DataError, match=r"a\.pth is truncated, damaged or no \.pth file"
    ):
        load_pickle(path, "a peer")


def test_deep_and_circular_values_end(tmp_path: Path, zipped: bool) -> None:
    deep: list[Any] = []
    for _ in range(100):
        deep = [deep]
    circle: dict[str, Any] = {}
    circle["self"] = circle
    found = load_pickle(
        save(tmp_path / "a.pth", {"deep": deep, "circle": circle, "x": 1}, zipped),
        "a peer",
    )
    assert found["x"] == 1
    assert found["circle"] == {"self": None}
    assert len(repr(found["deep"])) < 200


def test_flipped_and_cut_files_give_no_foreign_error(
    tmp_path: Path, zipped: bool
) -> None:
    path = save(
        tmp_path / "a.pth",
        {"weights": {"a": torch.ones(3)}, "b": np.float32(1)},
        zipped,
    )
    content = path.read_bytes()
    rng = Random(0)
    refused = 0
    for _ in range(400):
        changed = bytearray(content)
        for _ in range(rng.choice((1, 1, 3, 20))):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
        path.write_bytes(
            changed[: rng.choice((len(changed), rng.randrange(len(changed))))]
        )
        try:
            load_pickle(path, "a peer")
        except DataError:
            refused += 1
    assert refused > 100
