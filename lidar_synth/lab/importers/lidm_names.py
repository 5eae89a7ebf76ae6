"""The names of LiDM's weights: the LiDM keys of every key of our networks."""

from collections.abc import Collection

import torch

from lidar_synth.generate.checkpoint import CODEC, ENCODER, VELOCITY, NetworkSpec
from lidar_synth.generate.models import build_network, limit_modules

UNET = "model.diffusion_model."
UNET_EMA = "model_ema."
FIRST_STAGE = "first_stage_model."
COND_STAGE = "cond_stage_model."

Sources = dict[str, tuple[str, ...]]
"""{our name: LiDM's names, whose tensors are concatenated}."""

RESIDUAL = {
    "norm1": "in_layers.0",
    "conv1": "in_layers.2",
    "time": "emb_layers.1",
    "norm2": "out_layers.0",
    "conv2": "out_layers.3",
    "shortcut": "skip_connection",
}
ATTENTION: Sources = {"norm": ("norm",), "qkv": ("qkv",), "out": ("proj_out",)}
INNER = "transformer_blocks.0"
CONTEXT: Sources = {
    "norm": ("norm",),
    "enter": ("proj_in",),
    "leave": ("proj_out",),
    "norms.0": (f"{INNER}.norm1",),
    "norms.1": (f"{INNER}.norm2",),
    "norms.2": (f"{INNER}.norm3",),
    "qkv": tuple(f"{INNER}.attn1.to_{x}" for x in "qkv"),
    "out": (f"{INNER}.attn1.to_out.0",),
    "query": (f"{INNER}.attn2.to_q",),
    "key_value": tuple(f"{INNER}.attn2.to_{x}" for x in "kv"),
    "context_out": (f"{INNER}.attn2.to_out.0",),
    "expand": (f"{INNER}.ff.net.0.proj",),
    "contract": (f"{INNER}.ff.net.2",),
}
"""Names inside the U-Net's blocks: residual, self-attention, cross-attention to a context."""

CODEC_RESIDUAL = {"shortcut": "nin_shortcut"}
CODEC_ATTENTION: Sources = {
    "norm": ("norm",),
    "qkv": ("q", "k", "v"),
    "out": ("proj_out",),
}
"""Names inside the autoencoder's blocks; all other names are the same in both."""
MIDDLE = ("mid.block_1", "mid.attn_1", "mid.block_2")
MOST_MODULES = 4_000
"""Maximum number of modules of a network; a configuration may ask for 10^9 blocks. LiDM's have
about 1,000."""
STATISTICS = ("shift", "scale")
"""Buffers that only our autoencoder has."""


def _list_names(name: str, part: NetworkSpec) -> Sources:
    """The names without the prefix of a part."""
    with torch.device("meta"), limit_modules(MOST_MODULES):
        keys = list(build_network(*part).state_dict())
    if name == VELOCITY:
        attending = {
            key.partition(".attention.")[0] for key in keys if ".attention." in key
        }
        attention = CONTEXT if part.arguments["context_channels"] else ATTENTION
        return {key: _unet(key, attending, attention) for key in keys}
    if name == CODEC:
        levels = len(part.arguments["multipliers"])
        attending = part.arguments.get("attention_levels", ())
        return {
            key: _codec(key, levels, attending) for key in keys if key not in STATISTICS
        }
    renamed = {"mix": "channel_mapper", "project": "linear"}
    return {key: (_renamed(key, renamed),) for key in keys}


def peer_names(name: str, part: NetworkSpec, nested: bool) -> Sources:
    """The LiDM names of every weight of a part.

    Args:
        name: name of the part.
        part: the network.
        nested: whether the file is that of a diffusion model, whose names have prefixes.
    """
    prefix = (
        {VELOCITY: UNET, CODEC: FIRST_STAGE, ENCODER: COND_STAGE}[name]
        if nested
        else ""
    )
    return {
        ours: tuple(prefix + one for one in theirs)
        for ours, theirs in _list_names(name, part).items()
    }


def _unet(key: str, attending: set[str], attention: Sources) -> tuple[str, ...]:
    """LiDM's names of a U-Net key, given the blocks that have attention and the names inside
    attention."""
    top = {
        "time": "time_embed",
        "stem": "input_blocks.0.0",
        "norm": "out.0",
        "head": "out.2",
    }
    where, number, *rest = key.split(".")
    if where in top:
        return (_renamed(key, top),)
    kind = rest[0]
    inside = ".".join(rest[1:])
    if where == "middle":  # residual, attention, residual
        place = f"middle_block.{1 if kind == 'attention' else 2 * int(number)}"
    else:
        after = 1 + (f"{where}.{number}" in attending)
        block = (
            f"input_blocks.{int(number) + 1}"
            if where == "down"
            else f"output_blocks.{number}"
        )
        place = f"{block}.{ {'residual': 0, 'attention': 1, 'resample': after, 'conv': 0}[kind] }"
    if kind == "conv":
        return (f"{place}.op.{inside}",)
    if kind == "resample":
        return (f"{place}.{inside}",)
    if kind == "residual":
        return (f"{place}.{_renamed(inside, RESIDUAL)}",)
    layer, _, last = inside.rpartition(".")
    return tuple(f"{place}.{name}.{last}" for name in attention[layer])


def _codec(key: str, levels: int, attending: Collection[int]) -> tuple[str, ...]:
    """LiDM's names of an autoencoder key, given the number of levels and the levels with
    attention."""
    top = {"to_latent": "quant_conv", "from_latent": "post_quant_conv"}
    if key == "codebook.codes":
        return ("quantize.embedding.weight",)
    where, *rest = key.split(".")
    if where in top:
        return (_renamed(key, top),)
    kind = rest[0]
    number = rest[1]
    inside = ".".join(rest[2:])
    if kind in ("stem", "norm", "head"):
        name = {"stem": "conv_in", "norm": "norm_out", "head": "conv_out"}[kind]
        return (f"{where}.{name}.{number}",)
    if kind == "middle":
        place = f"{where}.{MIDDLE[int(number)]}"
        if int(number) == 1:
            return _attention(place, inside)
        return (f"{place}.{_renamed(inside, CODEC_RESIDUAL)}",)
    side = "down" if where == "encoder" else "up"
    # Our decoder numbers its levels in the order of computation.
    level = int(number) if side == "down" else levels - 1 - int(number)
    if kind == "levels":
        first, _, inside = inside.partition(".")
        block, is_attention = (
            divmod(int(first), 2) if level in attending else (int(first), 0)
        )
        if is_attention:
            return _attention(f"{where}.{side}.{level}.attn.{block}", inside)
        return (
            f"{where}.{side}.{level}.block.{block}.{_renamed(inside, CODEC_RESIDUAL)}",
        )
    return (f"{where}.{side}.{level}.{side}sample.conv.{inside.removeprefix('conv.')}",)


def _attention(place: str, key: str) -> tuple[str, ...]:
    """LiDM's names of a key inside the autoencoder's attention at ``place``."""
    layer, _, last = key.rpartition(".")
    return tuple(f"{place}.{name}.{last}" for name in CODEC_ATTENTION[layer])


def _renamed(key: str, names: dict[str, str]) -> str:
    """The key with its first component replaced, if ``names`` has it."""
    first, dot, rest = key.partition(".")
    return names.get(first, first) + dot + rest
