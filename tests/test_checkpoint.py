"""Checkpoints: saving and loading, and refusal of everything else."""

import os
import struct
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest
import torch
from checkpoints import ARGUMENTS, HEADER, SENSOR, network, replace_weights, rewrite
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError, FileError, LidarSynthError
from lidar_synth.generate.checkpoint import (
    FORMAT,
    VELOCITY,
    Checkpoint,
    Header,
    load_checkpoint,
    read_header,
    save_checkpoint,
)
from lidar_synth.generate.models import build_network

MATCH = [[[1.1] * 8] * 7, [[0.0] * 8] * 7]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, HEADER, {VELOCITY: network()})
    return path


def test_loading_restores_everything_that_was_saved(saved: Path) -> None:
    header, networks, digest = load_checkpoint(saved)
    assert header == HEADER
    original = network()
    assert all(
        torch.equal(v, original.state_dict()[k])
        for k, v in networks[VELOCITY].state_dict().items()
    )
    y = torch.randn(1, 7, 8, 32)
    with torch.no_grad():
        assert torch.equal(networks[VELOCITY](y, 0.5), original.eval()(y, 0.5))
    assert not networks[VELOCITY].training
    assert read_header(saved) == (HEADER, digest)
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]


def test_the_same_content_gives_the_same_bytes_and_hash(
    saved: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again.safetensors"
    digest = save_checkpoint(again, HEADER, {VELOCITY: network()})
    assert again.read_bytes() == saved.read_bytes()
    assert digest == load_checkpoint(saved).hash
    other_weights = save_checkpoint(again, HEADER, {VELOCITY: network(1)})
    other_grid = save_checkpoint(
        again, replace(HEADER, time_grid=(1.0, 0.0)), {VELOCITY: network()}
    )
    assert len({digest, other_weights, other_grid}) == 3


def test_a_loaded_checkpoint_saves_to_the_same_bytes(
    saved: Path, tmp_path: Path
) -> None:
    header, networks, digest = load_checkpoint(saved)
    assert save_checkpoint(tmp_path / "copy.safetensors", header, networks) == digest
    assert (tmp_path / "copy.safetensors").read_bytes() == saved.read_bytes()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_used_only_for_parameters(
    saved: Path, tmp_path: Path, dtype: torch.dtype
) -> None:
    path = tmp_path / "half.safetensors"
    save_checkpoint(path, HEADER, {VELOCITY: network()}, dtype)
    assert path.stat().st_size < 0.7 * saved.stat().st_size
    half = load_checkpoint(path).networks[VELOCITY]
    whole = load_checkpoint(saved).networks[VELOCITY]
    assert {t.dtype for t in half.state_dict().values()} == {torch.float32}
    for (name, a), b in zip(half.named_parameters(), whole.parameters(), strict=True):
        assert torch.equal(a, b.to(dtype).float()), name
    assert all(
        torch.equal(a, b) for a, b in zip(half.buffers(), whole.buffers(), strict=True)
    )


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.999])
def test_a_truncated_file_is_refused(saved: Path, share: float) -> None:
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])
    for read in (load_checkpoint, read_header):
        with pytest.raises(
            DataError,
            match=r"model.safetensors is truncated, damaged or no .safetensors file",
        ):
            read(saved)


def test_a_flipped_bit_in_a_weight_is_refused(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[-1000] ^= 1
    saved.write_bytes(content)
    with pytest.raises(DataError, match="do not match their checksum in the header"):
        load_checkpoint(saved)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"format": "lidar-synth-checkpoint/3"},
            f"format 'lidar-synth-checkpoint/3'; expected '{FORMAT}'",
        ),
        ({"format": None}, "format None"),
        (
            {"format": "lidar-synth-checkpoint/1"},
            "format 'lidar-synth-checkpoint/1'; expected",
        ),
        ({"convention": "t=0 noise"}, "convention 't=0 noise'"),
        ({"label_encoding": "one-hot"}, "label_encoding 'one-hot'"),
        ({"colour": "red"}, r"header keys \['colour'\]"),
        ({"sensor": None}, "a header without 'sensor'"),
        ({"sensor": {"name": "x"}}, "sensor"),
        (
            {"sensor": SENSOR.to_dict() | {"columns": 64}},
            "a network for .7, 8, 32. channels, rows and columns",
        ),
        (
            {"normalisation": {"kind": "cubic"}},
            "normalisation|header with invalid values",
        ),
        ({"channels": ["range"]}, "a network for"),
        ({"channels": ["range", "colour"]}, "colour"),
        ({"time_grid": [1.0, 0.5]}, "time grid"),
        ({"time_grid": [1.0, 0.2, 0.6, 0.0]}, "time grid"),
        ({"time_grid": [10**400, 0.0]}, "header with invalid values"),
        ({"provenance": {"data": "town"}}, "without data_licence, licence"),
        ({"networks": {}}, "networks"),
        (
            {"networks": {VELOCITY: {"architecture": "vgg", "arguments": {}}}},
            "architecture 'vgg'",
        ),
        (
            {
                "networks": {
                    VELOCITY: {
                        "architecture": "hdit",
                        "arguments": ARGUMENTS | {"a": 1},
                    }
                }
            },
            "'a'",
        ),
        (
            {
                "networks": {
                    VELOCITY: {
                        "architecture": "hdit",
                        "arguments": ARGUMENTS | {"width": 32},
                    }
                }
            },
            "other shapes",
        ),
        (
            {
                "networks": {
                    VELOCITY: {
                        "architecture": "hdit",
                        "arguments": ARGUMENTS | {"depths": [1, 2]},
                    }
                }
            },
            "missing",
        ),
        ({"networks": [1]}, "header with invalid values"),
        ({"matches": {"2": MATCH}}, "matches for '2' steps"),
        ({"other_grids": [[1, 0]], "matches": {"1": MATCH[:1]}}, "another shape"),
        ({"other_grids": [[1, 0]], "matches": {"1": [[[1]], [["1"]]]}}, "finite"),
        ({"other_grids": [[1, 0]], "matches": {"1": [[[1]], [[1e39]]]}}, "finite"),
        ({"other_grids": [[1, 0]], "matches": {"1": [[[1]], [[10**400]]]}}, "finite"),
        ({"weights": None}, "do not match their checksum"),
    ],
    ids=str,
)
def test_an_invalid_header_is_refused(
    saved: Path, changes: dict[str, Any], message: str
) -> None:
    rewrite(saved, **changes)
    with pytest.raises(DataError, match=message) as caught:
        load_checkpoint(saved)
    assert str(saved) in str(caught.value)


def same(a: Checkpoint, b: Checkpoint) -> bool:
    """Whether two checkpoints have equal headers and weights."""
    states = [{p: n.state_dict() for p, n in c.networks.items()} for c in (a, b)]
    return (a.header, a.hash) == (b.header, b.hash) and all(
        torch.equal(value, states[1][part][key])
        for part, state in states[0].items()
        for key, value in state.items()
    )


@pytest.mark.slow
def test_one_changed_byte_is_refused_or_changes_nothing(saved: Path) -> None:
    """Changes every byte of the header in turn, and some bytes of the weights."""
    content = saved.read_bytes()
    whole = load_checkpoint(saved)
    header = 8 + struct.unpack("<Q", content[:8])[0]
    random = Random(0)
    refused = 0
    for place in [
        *range(header),
        *(random.randrange(header, len(content)) for _ in range(50)),
    ]:
        changed = bytearray(content)
        changed[place] = random.choice(
            [changed[place] ^ (1 << random.randrange(8)), random.randrange(256)]
        )
        saved.write_bytes(changed)
        try:
            assert same(load_checkpoint(saved), whole), place
        except DataError:
            refused += 1
    assert refused > 0.9 * header


@pytest.mark.parametrize(
    ("old", "new"), [(b"0.86", b"0.76"), (b'range_max\\": 80.0', b'range_max\\": 90.0')]
)
def test_a_changed_time_or_range_limit_is_refused(
    saved: Path, tmp_path: Path, old: bytes, new: bytes
) -> None:
    content = saved.read_bytes()
    assert old in content
    saved.write_bytes(content.replace(old, new))
    for read in (load_checkpoint, read_header):
        with pytest.raises(
            DataError, match="a header that does not match its checksum"
        ):
            read(saved)


def test_a_deeply_nested_header_is_refused(saved: Path) -> None:
    tensors = load_file(saved)
    save_file(
        tensors,
        saved,
        {"lidar_synth": '{"format": ' + "[" * 100_000 + "]" * 100_000 + "}"},
    )
    with pytest.raises(DataError):
        read_header(saved)


@pytest.mark.parametrize("device", ["gpu", "cuda:99", "meta", "cpu:1"])
def test_an_unavailable_device_is_refused(saved: Path, device: str) -> None:
    with pytest.raises(
        ConfigError, match=rf"device '{device}'; expected an available one: cpu"
    ):
        load_checkpoint(saved, device)


def test_weights_without_a_header_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(DataError, match="no header of lidar_synth"):
        load_checkpoint(path)


def test_a_pickle_is_never_loaded(tmp_path: Path) -> None:
    path = tmp_path / "model.pth"
    trace = tmp_path / "ran"
    for new_format in (True, False):
        torch.save(Evil(trace), path, _use_new_zipfile_serialization=new_format)
        for read in (load_checkpoint, read_header):
            with pytest.raises(
                DataError,
                match=r"is a PyTorch pickle.*lidar-synth import .*model\.pth OUT",
            ):
                read(path)
    assert not trace.exists()


class Evil:
    """An object that creates a folder when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.trace),)


def test_missing_or_unexpected_keys_and_other_shapes_are_refused(saved: Path) -> None:
    def rename(tensors: dict[str, Tensor]) -> None:
        tensors[f"{VELOCITY}.spare"] = tensors.pop(f"{VELOCITY}.norm.weight")

    def cut(tensors: dict[str, Tensor]) -> None:
        tensors[f"{VELOCITY}.norm.weight"] = tensors[f"{VELOCITY}.norm.weight"][:-1]

    def add(tensors: dict[str, Tensor]) -> None:
        tensors["codec.weight"] = torch.zeros(1)

    def add_inside(tensors: dict[str, Tensor]) -> None:
        tensors[f"{VELOCITY}.spare"] = torch.zeros(1)

    def spoil(tensors: dict[str, Tensor]) -> None:
        tensors[f"{VELOCITY}.norm.weight"][3] = torch.nan

    content = saved.read_bytes()
    for change, message in (
        (rename, r"missing keys \['norm.weight'\] and unexpected keys \['spare'\]"),
        (cut, r"other shapes: norm.weight \(15,\) for \(16,\)"),
        (add_inside, r"missing keys \[\] and unexpected keys \['spare'\]"),
        (add, r"tensors \['codec.weight'\]"),
        (spoil, r"NaN or infinity in \['velocity.norm.weight'\]"),
    ):
        saved.write_bytes(content)
        replace_weights(saved, change)
        with pytest.raises(DataError, match=message):
            load_checkpoint(saved)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(FileError, match="cannot be read"):
            load_checkpoint(path)


@pytest.mark.parametrize(
    ("header", "networks", "message"),
    [
        (HEADER, {}, "networks"),
        (HEADER, {VELOCITY: network(), "codec": network()}, "networks"),
        (HEADER, {VELOCITY: nn.Linear(2, 2)}, "missing keys"),
        (
            replace(HEADER, provenance=HEADER.provenance | {"jsd": float("nan")}),
            {VELOCITY: network()},
            "JSON",
        ),
        (
            replace(HEADER, provenance=HEADER.provenance | {"path": Path("x")}),
            {VELOCITY: network()},
            "JSON",
        ),
    ],
    ids=["none", "too many", "another", "nan", "path"],
)
def test_networks_that_do_not_match_the_header_are_not_written(
    tmp_path: Path, header: Header, networks: dict[str, nn.Module], message: str
) -> None:
    with pytest.raises(LidarSynthError, match=message):
        save_checkpoint(tmp_path / "model.safetensors", header, networks)
    assert list(tmp_path.iterdir()) == []


def test_weights_that_are_not_finite_do_not_overwrite_a_checkpoint(saved: Path) -> None:
    before = saved.read_bytes()
    broken = network()
    next(broken.parameters()).data[0] = torch.inf
    with pytest.raises(DataError, match="NaN or infinity"):
        save_checkpoint(saved, HEADER, {VELOCITY: broken})
    assert saved.read_bytes() == before


def test_missing_ray_angles_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"NaN or infinity in \['velocity.angles.cells'\]"
    ):
        save_checkpoint(
            tmp_path / "model.safetensors",
            HEADER,
            {VELOCITY: build_network("hdit", ARGUMENTS)},
        )


def test_a_path_that_cannot_be_written_is_reported(tmp_path: Path, saved: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "taken.safetensors").mkdir()
    for path in (
        tmp_path / "file" / "model.safetensors",
        tmp_path / "taken.safetensors",
    ):
        with pytest.raises(FileError, match="cannot be written"):
            save_checkpoint(path, HEADER, {VELOCITY: network()})
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "file",
        saved.name,
        "taken.safetensors",
    ]


def test_a_full_disk_keeps_the_old_checkpoint(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    before = saved.read_bytes()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FileError, match="No space left on device"):
        save_checkpoint(saved, HEADER, {VELOCITY: network(1)})
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]


def test_other_file_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"ends in \.safetensors"):
        save_checkpoint(tmp_path / "model.pth", HEADER, {VELOCITY: network()})
