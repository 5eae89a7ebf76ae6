"""The label policies by name. A policy is ``(scan, rng) -> scan``, a function of its two arguments
alone."""

from collections.abc import Callable
from importlib import import_module
from inspect import signature
from typing import Any

import numpy as np

from lidar_synth.errors import ConfigError, suggest
from lidar_synth.geometry.scan import Scan, Source

LabelPolicy = Callable[[Scan, np.random.Generator], Scan]
"""Sets the labels of a synthetic scan; it returns a new scan and never changes its input."""

KINDS = {
    "objects": "mix.objects",
    "polar": "mix.polar",
    "laser": "mix.laser",
    "exchange": "mix.exchange",
}
"""Where to find the builders of the kinds of ``mix``, in ``lidar_synth.labels``."""


def mix(
    real: Source | None, fields: frozenset[str], kind: str = "objects", **options: Any
) -> LabelPolicy:
    """Make the policy ``mix``: labelled parts of real scans are inserted into the synthetic scan.

    Raises:
        ConfigError: on an unknown kind or option, or a kind that the sources cannot support.
    """
    if kind not in KINDS:
        raise ConfigError(
            f"labels='mix', kind={kind!r}", f"one of {', '.join(map(repr, KINDS))}"
        )
    return _build(KINDS[kind], f"labels='mix', kind={kind!r}", real, fields, options)


POLICIES = {
    "none": "own.unlabelled",
    "ignore": "own.ignored",
    "generated": "own.generated",
    "condition": "own.condition",
    "pseudo": "pseudo.pseudo",
    "mix": "policies.mix",
    "boxes": "own.boxes",
}
"""Where to find the builder of each policy, in ``lidar_synth.labels``; builders are
``(real, fields, **options) -> LabelPolicy`` and are imported when they are used."""


def make_policy(
    labels: str | LabelPolicy,
    *,
    real: Source | None = None,
    fields: frozenset[str] = frozenset(),
    **options: Any,
) -> LabelPolicy:
    """Make a label policy by name.

    Args:
        labels: a name of ``POLICIES``, or a policy, which is returned as it is.
        real: the real labelled scans, for policies that draw from them.
        fields: the fields of ``POINT_FIELDS`` that the synthetic scans have, and "boxes" if they
            have boxes.
        options: of the policy.

    Raises:
        ConfigError: on an unknown name or option, or a policy that the sources cannot support.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Bank, make_policy
        >>> bank = Bank("demo_out/bank")
        >>> policy = make_policy("generated", fields=bank.fields, threshold=0.6)
        >>> scan = policy(bank[0], np.random.default_rng(0))
        >>> np.unique(scan.label[scan.confidence < 0.6])  # labels of low confidence are ignored
        array([255], dtype=uint8)
    """
    if not isinstance(labels, str):
        if options:
            raise ConfigError(
                f"options {sorted(options)} for a policy that is a function",
                "a policy's name",
            )
        return labels
    if labels not in POLICIES:
        expected = f"one of {', '.join(map(repr, POLICIES))}, or a function (scan, rng)"
        raise ConfigError(f"labels={labels!r}", expected, suggest(labels, POLICIES))
    return _build(POLICIES[labels], f"labels={labels!r}", real, fields, options)


def _build(
    home: str,
    where: str,
    real: Source | None,
    fields: frozenset[str],
    options: dict[str, Any],
) -> LabelPolicy:
    module, name = home.split(".")
    build: Callable[..., LabelPolicy] = getattr(
        import_module(f"lidar_synth.labels.{module}"), name
    )
    try:
        signature(build).bind(real, fields, **options)
    except TypeError as error:
        known = list(signature(build).parameters)[2:]
        raise ConfigError(
            f"{where}: {error}", f"options {known}" if known else "no options"
        ) from error
    return build(real, fields, **options)
