"""The label policies by name. A policy is ``(scan, rng) -> scan``, a function of its two arguments
alone; one that needs to know the sources has ``bind(real, fields)``, which gives such a policy."""

from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import signature
from typing import Any

import numpy as np

from lidar_synth.errors import ConfigError, suggest
from lidar_synth.geometry.scan import Scan, Source

LabelPolicy = Callable[[Scan, np.random.Generator], Scan]
"""Sets the labels of a synthetic scan; it returns a new scan and never changes its input."""

POLICIES = {
    "none": "own.RemoveLabels",
    "ignore": "own.IgnoreLabels",
    "generated": "own.KeepLabels",
    "condition": "own.KeepCondition",
    "pseudo": "pseudo.PredictLabels",
    "boxes": "own.KeepBoxes",
    "paste": "mix.PasteObjects",
    "polarmix": "mix.PolarMix",
    "lasermix": "mix.LaserMix",
    "polarmix_or_lasermix": "mix.PolarMixOrLaserMix",
}
"""Where to find the class of each policy, in ``lidar_synth.labels``; it is imported when it is
used."""


def make_policy(
    labels: Any,
    *,
    real: Source | None = None,
    fields: frozenset[str] = frozenset(),
    **options: Any,
) -> LabelPolicy:
    """Make a label policy for given sources.

    Args:
        labels: a name of ``POLICIES``, ``{name: {argument: value}}``, or a policy.
        real: the real labelled scans, for policies that draw from them.
        fields: the fields of ``POINT_FIELDS`` that the synthetic scans have, and "boxes" if they
            have boxes.
        options: arguments of the policy that ``labels`` names.

    Raises:
        ConfigError: on an unknown name or argument, or a policy that the sources cannot support.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, make_policy
        >>> bank = Bank("demo_out/bank")
        >>> policy = make_policy("generated", fields=bank.fields, threshold=0.6)
        >>> scan = policy(bank[0], np.random.default_rng(0))
        >>> np.unique(scan.label[scan.confidence < 0.6])  # labels of low confidence are ignored
        array([255], dtype=uint8)
    """
    name, given = read_labels(labels)
    if name is not None:
        labels = _build(name, {**given, **options})
    elif options:
        raise ConfigError(
            f"arguments {sorted(options)} for a policy that is an object",
            "a policy's name",
        )
    bind = getattr(labels, "bind", None)
    policy: LabelPolicy = labels if bind is None else bind(real, fields)
    return policy


def read_labels(labels: Any) -> tuple[str | None, dict[str, Any]]:
    """The name and the arguments of a policy; None and no arguments for one that is an object.

    Raises:
        ConfigError: on what is neither a policy, nor a name, nor ``{name: {argument: value}}``.
    """
    if isinstance(labels, str):
        return labels, {}
    if callable(labels) or hasattr(labels, "bind"):
        return None, {}
    if isinstance(labels, Mapping) and len(labels) == 1:
        [(name, given)] = labels.items()
        if isinstance(name, str) and isinstance(given, Mapping):
            return name.lower(), {str(key).lower(): v for key, v in given.items()}
    raise ConfigError(
        f"labels={labels!r}",
        "a policy, its name, or {name: {argument: value}} such as {paste: {count: 8}}",
    )


def _build(name: str, options: dict[str, Any]) -> Any:
    """The policy of a name with arguments, before it is bound."""
    if name not in POLICIES:
        expected = f"one of {', '.join(map(repr, POLICIES))}, or a function (scan, rng)"
        raise ConfigError(f"labels={name!r}", expected, suggest(name, POLICIES))
    module, cls = POLICIES[name].split(".")
    make = getattr(import_module(f"lidar_synth.labels.{module}"), cls)
    try:
        signature(make).bind(**options)
    except TypeError as error:
        known = list(signature(make).parameters)
        expected = f"arguments {known}" if known else "no arguments"
        raise ConfigError(f"labels={name!r}: {error}", expected) from error
    return make(**options)
