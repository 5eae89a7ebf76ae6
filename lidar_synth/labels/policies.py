"""The label policies by name. A policy is ``(scan, rng) -> scan``, a function of its two
arguments alone.

A policy that needs to know its sources has the method ``bind(real, fields)``, which checks
them and returns the policy to call. ``real`` are the real scans or None; ``fields`` are
those of ``POINT_FIELDS`` that the synthetic scans have, and "boxes" if they have boxes.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import signature
from typing import Any

import numpy as np

from lidar_synth.errors import ConfigError, shorten, suggest
from lidar_synth.geometry import Scan, Source

LabelPolicy = Callable[[Scan, np.random.Generator], Scan]
"""Sets the labels of a synthetic scan; it returns a new scan and never changes its input."""

Labels = str | Mapping[str, Any] | LabelPolicy
"""A policy, its name in ``POLICIES``, or ``{name: {argument: value}}``, as in YAML."""

POLICIES = {
    "none": "own.RemoveLabels",
    "ignore": "own.IgnoreLabels",
    "generated": "own.KeepLabels",
    "condition": "own.KeepCondition",
    "boxes": "own.KeepBoxes",
    "pseudo": "pseudo.PredictLabels",
    "paste": "mix.PasteObjects",
    "polarmix": "mix.PolarMix",
    "lasermix": "mix.LaserMix",
    "polarmix_or_lasermix": "mix.PolarMixOrLaserMix",
}
"""Where to find the class of each policy, in ``lidar_synth.labels``; it is imported when it
is used."""


def make_policy(
    labels: Labels,
    *,
    real: Source | None = None,
    fields: frozenset[str] = frozenset(),
    **options: Any,
) -> LabelPolicy:
    """Make a label policy for given sources.

    Args:
        labels: a name of ``POLICIES``, ``{name: {argument: value}}``, or a policy.
        real: the real labelled scans, for policies that draw from them.
        fields: the fields of ``POINT_FIELDS`` that the synthetic scans have, and "boxes"
            if they have boxes.
        options: arguments of the policy that ``labels`` names.

    Raises:
        ConfigError: on an unknown name or argument, or a policy that the sources cannot
            support.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, make_policy
        >>> bank = Bank("demo_out/bank")
        >>> policy = make_policy("generated", fields=bank.fields, threshold=0.6)
        >>> policy
        KeepLabels(threshold=0.6)
        >>> scan = policy(bank[0], np.random.default_rng(0))
        >>> np.unique(scan.label[scan.confidence < 0.6])  # unsure labels are ignored
        array([255], dtype=uint8)
    """
    if options and not isinstance(labels, str):
        given = f"arguments {sorted(options)} for a policy that is an object"
        raise ConfigError(given, "a policy's name")
    policy = read_policy({labels: options} if isinstance(labels, str) else labels)
    if not hasattr(policy, "bind"):
        return policy
    bound: LabelPolicy = policy.bind(real, fields)
    return bound


def read_policy(labels: Labels) -> LabelPolicy:
    """The policy that a configuration describes, not yet bound to sources; see
    ``make_policy``.

    Raises:
        ConfigError: on an unknown name or argument.
    """
    if callable(labels) and not isinstance(labels, type):
        return labels
    name: Any = labels
    arguments: Any = {}
    if isinstance(labels, Mapping) and len(labels) == 1:
        [(name, arguments)] = labels.items()
    # Trainers' configurations may write capitals.
    key = name.lower() if isinstance(name, str) else ""
    if key not in POLICIES:
        raise ConfigError(
            f"labels={shorten(repr(name), 60)}",
            f"one of {', '.join(map(repr, POLICIES))}, {{name: {{argument: value}}}}, "
            "or a policy such as KeepLabels(threshold=0.6)",
            suggest(key, POLICIES),
        )
    module, kind = POLICIES[key].split(".")
    found = getattr(import_module(f"lidar_synth.labels.{module}"), kind)
    policy: LabelPolicy = found(**_check_arguments(key, found, arguments or {}))
    return policy


def _check_arguments(name: str, kind: type, arguments: Any) -> dict[str, Any]:
    known = list(signature(kind).parameters)
    if not isinstance(arguments, Mapping):
        given = f"labels={name!r}: {shorten(repr(arguments), 40)}"
        example = f"{{{known[-1]}: ...}}" if known else "none"
        raise ConfigError(given, f"arguments by name, such as {example}")
    lowered = {str(key).lower(): value for key, value in arguments.items()}
    try:
        signature(kind).bind(**lowered)
    except TypeError as error:
        raise ConfigError(
            f"labels={name!r}: {error}",
            f"arguments {', '.join(known)}" if known else "no arguments",
            next((suggest(word, known) for word in lowered if word not in known), ""),
        ) from error
    return lowered
