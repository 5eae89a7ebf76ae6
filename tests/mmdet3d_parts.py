"""What the tests of MMDetection3D's adapter need: its configurations as plain values."""

from pathlib import Path
from typing import Any

CONFIGS = Path(__file__).parent.parent / "configs" / "mmdet3d"
DATA_KEYS = (
    "type",
    "data_root",
    "ann_file",
    "data_prefix",
    "pts",
    "sweeps",
    "img",
    "filter_empty_gt",
)
"""Keys of a stock configuration that ours may change."""


def flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """{dotted key: value} of a configuration."""
    if not isinstance(config, dict):
        return {prefix: config}
    return {
        key: value
        for name in config
        for key, value in flat(config[name], f"{prefix}.{name}").items()
    }


def bare(value: Any) -> Any:
    """A value without mmengine's notes of whose configuration it comes from."""
    if isinstance(value, dict):
        return {key: bare(item) for key, item in value.items() if key != "_scope_"}
    return [bare(item) for item in value] if isinstance(value, list | tuple) else value
