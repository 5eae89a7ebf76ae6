"""Mutators of ``.safetensors`` files, of which a skin is one."""

import json
from random import Random

import safetensors.torch
import torch

from fuzzing.mutators import mutates
from fuzzing.text import edit, edit_json_text, encoded, written


def parts(content: bytes) -> tuple[dict, bytes]:
    """The JSON before the tensors, and the tensors' bytes."""
    size = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + size]), content[8 + size :]


def join(text: str, body: bytes) -> bytes:
    """The inverse of ``parts``."""
    header = encoded(text)
    return len(header).to_bytes(8, "little") + header + body


def in_order(content: bytes) -> bytes:
    """The same file with the keys of its header sorted, which safetensors writes in any order."""
    outer, body = parts(content)
    return join(json.dumps(outer, sort_keys=True), body)


@mutates(".safetensors", ".skin")
def edit_header(content: bytes, rng: Random) -> bytes:
    """The package's own header says something else."""
    outer, body = parts(content)
    metadata = outer["__metadata__"]
    if "lidar_synth" in metadata:
        metadata["lidar_synth"] = edit_json_text(metadata["lidar_synth"], rng)
    else:
        edit(metadata, rng)
    return join(json.dumps(outer), body)


@mutates(".safetensors", ".skin")
def edit_layout(content: bytes, rng: Random) -> bytes:
    """Types, shapes, places or names of the tensors are others than those of the bytes."""
    outer, body = parts(content)
    edit(outer, rng)
    return join(written(json.dumps(outer)), body)


@mutates(".safetensors", ".skin")
def edit_tensors(content: bytes, rng: Random) -> bytes:
    """Tensors hold other values, types or shapes, in a file that is whole."""
    metadata = parts(content)[0]["__metadata__"]
    tensors = safetensors.torch.load(content)
    name = rng.choice(sorted(tensors))
    tensor = tensors.pop(name)
    values = (float("nan"), float("inf"), 0.0, 1e38)
    changed = (
        lambda: None,
        lambda: {name: tensor.double()},
        lambda: {name: tensor.half()},
        lambda: {name: tensor.to(torch.int64)},
        lambda: {name: tensor.to(torch.bool)},
        lambda: {name: tensor.to(torch.complex64)},
        lambda: {name: tensor[None]},
        lambda: {name: tensor.reshape(-1)},
        lambda: {name: tensor.reshape(-1)[:0]},
        lambda: {name: torch.full_like(tensor, rng.choice(values))},
        lambda: {
            rng.choice(
                ("x", f"x.{name}", name + "x", "velocity", "codec.x", "")
            ): tensor
        },
    )
    tensors |= {
        key: value.contiguous() for key, value in (rng.choice(changed)() or {}).items()
    }
    return in_order(safetensors.torch.save(tensors, metadata))
