"""One augmentation made of several, which plain data such as YAML can name.

A step is an augmentation, its name, or ``{name: {argument: value}}``. For every scan, a number is
drawn from ``[low, high]`` and a name from a list of names. ``severity`` sets the strength of a
corruption, and ``p`` is the probability of the step::

    - fog: {visibility: [50, 500], p: 0.3}
    - snow: {severity: [light, moderate], p: 0.3}
    - yaw: {limit: 45}
    - flip_y
    - polarmix
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from inspect import signature
from typing import Any, cast

import numpy as np
from typing_extensions import Self

from lidar_synth.errors import ConfigError, choose
from lidar_synth.geometry import Scan, Source, load_sensor
from lidar_synth.labels import augment
from lidar_synth.labels.augment import Augmentation
from lidar_synth.labels.own import check_share
from lidar_synth.labels.policies import read_policy
from lidar_synth.weather import CORRUPTIONS, Corruption
from lidar_synth.weather.corruption import lost_boxes

MOVES: dict[str, Callable[..., Scan]] = {
    "yaw": augment.yaw,
    "flip_x": augment.flip_x,
    "flip_y": augment.flip_y,
    "scale": augment.scale,
    "jitter": augment.jitter,
    "beam_drop": augment.beam_drop,
    "range_drop": augment.range_drop,
    "drop_reflectance": augment.drop_reflectance,
}
MIXES = "polarmix", "lasermix", "polarmix_or_lasermix", "paste"
"""Label policies that are augmentations too: they draw from the real scans."""


@dataclass(frozen=True)
class Step:
    """One step of a ``Compose``.

    Args:
        name: a name in ``MOVES``, ``CORRUPTIONS`` or ``MIXES``; "" for another function.
        arguments: its arguments, as in plain data.
        p: probability in [0, 1].
        call: the function to call; None makes it from name and arguments for every scan.

    Raises:
        ConfigError: on an unknown name or argument, or an invalid value.
    """

    name: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    p: float = 1.0
    call: Augmentation | None = None

    def __post_init__(self) -> None:
        check_share("p", self.p)
        if self.call is None:  # every value that may be drawn has to be valid
            lists = [v for v in self.arguments.values() if isinstance(v, list | tuple)]
            for n in range(max(map(len, lists), default=1)):
                self._make(partial(_nth, n), check=True)

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        if self.p < 1 and rng.random() >= self.p:
            return scan
        call = self.call or self._make(partial(_draw, rng))
        changed = call(scan, rng)
        if self.name in MIXES:
            return changed.noted(self.name, **self.arguments)
        boxes = changed.boxes
        if isinstance(call, Corruption) and boxes is not None:
            return replace(changed, boxes=boxes[~lost_boxes(boxes, scan, changed)])
        return changed

    def bind(self, real: Source | None, fields: frozenset[str]) -> "Step":
        """The step with real scans to draw from, if it needs them."""
        call: Any = self._make(list) if self.name in MIXES else self.call
        if not hasattr(call, "bind"):
            return self
        return replace(self, call=call.bind(real, fields))

    def to_data(self) -> Any:
        """The step as plain data.

        Raises:
            ConfigError: for a function without a name.
        """
        if not self.name:
            raise ConfigError(f"{self.call} as plain data", "an augmentation by name")
        chance = {} if self.p == 1 else {"p": self.p}
        return {self.name: {**self.arguments, **chance}}

    def _make(self, pick: Callable[[Sequence[Any]], Any], check: bool = False) -> Any:
        """The augmentation; ``pick`` takes one value out of a list.

        ``check`` calls one of ``MOVES`` with one point, because these check their arguments only
        when they are called.
        """
        choose("augmentation", self.name, dict.fromkeys((*MOVES, *CORRUPTIONS, *MIXES)))
        if self.name in MIXES:
            return read_policy({self.name: self.arguments})
        arguments = {
            k: pick(_check_choice(k, v)) if isinstance(v, list | tuple) else v
            for k, v in self.arguments.items()
        }
        kind = CORRUPTIONS.get(self.name)
        make: Any = MOVES.get(self.name, kind)
        if kind is not None and "severity" in arguments:
            make = kind.at
        try:
            if kind:
                return make(**arguments)
            if check:
                point = np.ones((1, 3), np.float32)
                scan = Scan(
                    point,
                    point[:, 0],
                    load_sensor("vlp16"),
                    ring=np.zeros(1, np.uint16),
                )
                make(scan, np.random.default_rng(0), **arguments)
            return partial(make, **arguments)
        except ConfigError as error:
            raise ConfigError(f"{self.name}: {error}") from error
        except TypeError as error:
            known = [k for k in signature(make).parameters if k not in ("scan", "rng")]
            raise ConfigError(f"{self.name}: {error}", f"arguments {known}") from error


class Compose:
    """One augmentation that applies several in order, with one random generator.

    ``scan.augmented`` holds the values that were drawn. A box that loses all its returns to a
    corruption is dropped: nothing is left of its object to detect.

    Args:
        steps: augmentations, their names, or ``{name: {argument: value, "p": chance}}``; a list
            of them, or a single one.

    Raises:
        ConfigError: on an unknown name or argument, or an invalid value.

    Example:
        >>> from functools import partial
        >>> from lidar_synth import Compose, Town
        >>> from lidar_synth.labels.augment import yaw
        >>> from lidar_synth.noise import keyed_rng
        >>> augment = Compose([{"fog": {"visibility": [50, 500]}}, partial(yaw, limit=45), "scale"])
        >>> scan = augment(Town(seed=0, scans=1)[0], keyed_rng(0, 3, 17))  # seed, epoch, position
        >>> [name for step in scan.augmented for name in step]
        ['fog', 'yaw', 'scale']
        >>> Compose.from_dict(augment.to_dict()).to_dict() == augment.to_dict()
        True
    """

    def __init__(self, steps: Any) -> None:
        steps = steps if isinstance(steps, list | tuple) else [steps]
        self.steps = tuple(map(read_step, steps))

    def __call__(self, scan: Scan, rng: np.random.Generator) -> Scan:
        for step in self.steps:
            scan = step(scan, rng)
        return scan

    def bind(self, real: Source | None, fields: frozenset[str]) -> Self:
        """The augmentation with real scans to draw from."""
        return type(self)([step.bind(real, fields) for step in self.steps])

    def to_dict(self) -> dict[str, Any]:
        """The augmentation as plain data, from which ``from_dict`` makes it again.

        Raises:
            ConfigError: on a step that is a function without a name.
        """
        return {"compose": [step.to_data() for step in self.steps]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Make it from ``to_dict``.

        Raises:
            ConfigError: on anything else.
        """
        if not isinstance(values, Mapping) or list(values) != ["compose"]:
            raise ConfigError(f"{values!r}", "{compose: [steps]}")
        return cls(values["compose"])


def make_augmentation(
    given: Any, real: Source | None, fields: frozenset[str]
) -> Augmentation:
    """The augmentation that the argument ``augment`` of ``MixedScans`` describes.

    Args:
        given: an augmentation, a step, a list of steps, or ``Compose.to_dict``.
        real: labelled scans to draw from.
        fields: the fields of the synthetic scans.

    Raises:
        ConfigError: as ``Compose``.
    """
    augmentation: Any = given
    if isinstance(given, Mapping) and "compose" in given:
        augmentation = Compose.from_dict(given)
    elif not callable(given) or isinstance(given, type | Corruption):
        augmentation = Compose(given)
    if hasattr(augmentation, "bind"):
        augmentation = augmentation.bind(real, fields)
    return cast(Augmentation, augmentation)


def read_step(given: Any) -> Step:
    """The step that an augmentation or plain data describe.

    Raises:
        ConfigError: on anything else.
    """
    if isinstance(given, Step):
        return given
    if isinstance(given, str):
        return Step(given.lower())
    if type(given) in CORRUPTIONS.values():
        values = {f: getattr(given, f.name) for f in fields(given)}
        changed = {f.name: v for f, v in values.items() if v != f.default}
        return Step(given.name, changed)
    if isinstance(given, Mapping) and len(given) == 1:
        [(name, options)] = given.items()
        if isinstance(options, Mapping | None):
            arguments = {str(k).lower(): v for k, v in (options or {}).items()}
            return Step(str(name).lower(), arguments, p=arguments.pop("p", 1.0))
    if callable(given) and not isinstance(given, type):
        function = getattr(given, "func", given)
        for name, move in MOVES.items():
            if move is function:
                return Step(name, getattr(given, "keywords", {}))
        return Step("", call=given)
    raise ConfigError(
        f"{given!r} as an augmentation",
        "a function, a name, or {name: {argument: value}} such as "
        "{fog: {visibility: 60, p: 0.5}}",
    )


def _check_choice(key: str, values: Sequence[Any]) -> Sequence[Any]:
    """The values of a list, after checking that they are names or [low, high]."""
    kinds = set(map(type, values))
    numbers = kinds <= {int, float} and len(values) == 2 and values[0] <= values[1]
    if not numbers and kinds != {str}:
        raise ConfigError(
            f"{key}: {values!r}", "a number, [low, high], or a list of names"
        )
    return values


def _nth(n: int, values: Sequence[Any]) -> Any:
    return values[min(n, len(values) - 1)]


def _draw(rng: np.random.Generator, values: Sequence[Any]) -> Any:
    """A random one of several names, or a random number between two."""
    if isinstance(values[0], str):
        return values[int(rng.integers(len(values)))]
    return float(rng.uniform(*values))
