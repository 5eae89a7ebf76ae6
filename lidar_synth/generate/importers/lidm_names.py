"""The names of LiDM's weights: for every key of our networks, the peer's keys it comes from."""

from collections.abc import Collection

import torch

from lidar_synth.generate.checkpoint import CODEC, ENCODER, VELOCITY, NetworkSpec
from lidar_synth.models import build_network

UNET, UNET_EMA = "model.diffusion_model.", "model_ema."
FIRST_STAGE, COND_STAGE = "first_stage_model.", "cond_stage_model."

Sources = dict[str, tuple[str, ...]]
"""{our name: the peer's, whose tensors are set one after the other}."""

RESIDUAL = {"norm1": "in_layers.0", "conv1": "in_layers.2", "time": "emb_layers.1", "norm2": "out_layers.0",
            "conv2": "out_layers.3", "shortcut": "skip_connection"}  # fmt: skip
ATTENTION: Sources = {"norm": ("norm",), "qkv": ("qkv",), "out": ("proj_out",)}
INNER = "transformer_blocks.0"
CONTEXT: Sources = {
    "norm": ("norm",), "enter": ("proj_in",), "leave": ("proj_out",),
    "norms.0": (f"{INNER}.norm1",), "norms.1": (f"{INNER}.norm2",), "norms.2": (f"{INNER}.norm3",),
    "qkv": tuple(f"{INNER}.attn1.to_{x}" for x in "qkv"), "out": (f"{INNER}.attn1.to_out.0",),
    "query": (f"{INNER}.attn2.to_q",), "key_value": tuple(f"{INNER}.attn2.to_{x}" for x in "kv"),
    "context_out": (f"{INNER}.attn2.to_out.0",),
    "expand": (f"{INNER}.ff.net.0.proj",), "contract": (f"{INNER}.ff.net.2",),
}  # fmt: skip
"""Inside the U-Net's blocks: residual, attention, attention with a context."""

CODEC_RESIDUAL = {"shortcut": "nin_shortcut"}
CODEC_ATTENTION: Sources = {"norm": ("norm",), "qkv": ("q", "k", "v"), "out": ("proj_out",)}
"""Inside the autoencoder's blocks; a name that is not here is the same in both."""
MIDDLE = ("mid.block_1", "mid.attn_1", "mid.block_2")
STATISTICS = ("shift", "scale", "codebook.counts", "codebook.sums")
"""What only our autoencoder holds."""


def peer_names(name: str, part: NetworkSpec, nested: bool) -> Sources:
    """Where every weight of a part comes from.

    Args:
        name: of the part.
        part: the network.
        nested: in the file of a diffusion model, with its prefixes.
    """
    with torch.device("meta"):
        keys = list(build_network(*part).state_dict())
    if name == VELOCITY:
        looking = {key.partition(".attention.")[0] for key in keys if ".attention." in key}
        attention = CONTEXT if part.arguments["context_channels"] else ATTENTION
        found = {key: _unet(key, looking, attention) for key in keys}
    elif name == CODEC:
        levels = len(part.arguments["multipliers"])
        looking = part.arguments.get("attention_levels", ())
        found = {key: _codec(key, levels, looking) for key in keys if key not in STATISTICS}
    else:
        names = {"mix": "channel_mapper", "project": "linear"}
        found = {key: (_renamed(key, names),) for key in keys}
    prefix = {VELOCITY: UNET, CODEC: FIRST_STAGE, ENCODER: COND_STAGE}[name] if nested else ""
    return {ours: tuple(prefix + one for one in theirs) for ours, theirs in found.items()}


def _unet(key: str, looking: set[str], attention: Sources) -> tuple[str, ...]:
    """The U-Net's; ``looking``: the blocks that have attention, ``attention``: the names inside."""
    top = {"time": "time_embed", "stem": "input_blocks.0.0", "norm": "out.0", "head": "out.2"}
    where, number, *rest = key.split(".")
    if where in top:
        return (_renamed(key, top),)
    kind, inside = rest[0], ".".join(rest[1:])
    if where == "middle":  # residual, attention, residual
        place = f"middle_block.{1 if kind == 'attention' else 2 * int(number)}"
    else:
        after = 1 + (f"{where}.{number}" in looking)
        block = f"input_blocks.{int(number) + 1}" if where == "down" else f"output_blocks.{number}"
        place = f"{block}.{ {'residual': 0, 'attention': 1, 'resample': after, 'conv': 0}[kind] }"
    if kind == "conv":
        return (f"{place}.op.{inside}",)
    if kind == "resample":
        return (f"{place}.{inside}",)
    if kind == "residual":
        return (f"{place}.{_renamed(inside, RESIDUAL)}",)
    layer, _, last = inside.rpartition(".")
    return tuple(f"{place}.{name}.{last}" for name in attention[layer])


def _codec(key: str, levels: int, looking: Collection[int]) -> tuple[str, ...]:
    """The autoencoder's of so many levels; ``looking``: those that attend after each block."""
    top = {"to_latent": "quant_conv", "from_latent": "post_quant_conv"}
    if key == "codebook.codes":
        return ("quantize.embedding.weight",)
    where, *rest = key.split(".")
    if where in top:
        return (_renamed(key, top),)
    kind, number, inside = rest[0], rest[1], ".".join(rest[2:])
    if kind in ("stem", "norm", "head"):
        name = {"stem": "conv_in", "norm": "norm_out", "head": "conv_out"}[kind]
        return (f"{where}.{name}.{number}",)
    if kind == "middle":
        place = f"{where}.{MIDDLE[int(number)]}"
        return _attention(place, inside) if int(number) == 1 else (f"{place}.{_renamed(inside, CODEC_RESIDUAL)}",)
    side = "down" if where == "encoder" else "up"
    level = int(number) if side == "down" else levels - 1 - int(number)  # ours counts as the decoder runs
    if kind == "levels":
        first, _, inside = inside.partition(".")
        block, attends = divmod(int(first), 2) if level in looking else (int(first), 0)
        if attends:
            return _attention(f"{where}.{side}.{level}.attn.{block}", inside)
        return (f"{where}.{side}.{level}.block.{block}.{_renamed(inside, CODEC_RESIDUAL)}",)
    return (f"{where}.{side}.{level}.{side}sample.conv.{inside.removeprefix('conv.')}",)


def _attention(place: str, key: str) -> tuple[str, ...]:
    """Of a layer of the autoencoder's attention at a place."""
    layer, _, last = key.rpartition(".")
    return tuple(f"{place}.{name}.{last}" for name in CODEC_ATTENTION[layer])


def _renamed(key: str, names: dict[str, str]) -> str:
    """The key with another first word, where there is one for it."""
    first, dot, rest = key.partition(".")
    return names.get(first, first) + dot + rest
