"""Mixtures from plain settings, as trainers' configurations and YAML files hold them."""

import inspect
import logging
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.bank import Bank, is_bank
from lidar_synth.bank.storage import is_url
from lidar_synth.errors import ConfigError, DataError, choose
from lidar_synth.files.hub import refuse_ambiguous
from lidar_synth.files.parsing import read_yaml
from lidar_synth.formats import open_scans
from lidar_synth.formats.as_sensor import make_transfer, read_transfer
from lidar_synth.geometry import Scan, Sensor
from lidar_synth.geometry.transfer import Transfer
from lidar_synth.labels.policies import Labels
from lidar_synth.mixing.defaults import detection_options, segmentation_options
from lidar_synth.mixing.scans import MixedScans
from lidar_synth.mixing.schedules import Ratio
from lidar_synth.mixing.sources import agree, each, sensor_of

log = logging.getLogger(__name__)

VARIABLE = "LIDAR_SYNTH_MIX"
"""Environment variable with the YAML file of settings, for trainers whose configuration allows no
further keys."""

TASKS = ("segmentation", "detection")
OPTIONS = (
    "synthetic",
    "epochs",
    "ratio",
    "loss_weight",
    "labels",
    "augment",
    "seed",
    "reuse",
    "epoch_size",
    "balanced",
    "locality",
    "unboxed",
    "as_sensor",
    "classes",
)
"""Keys of the settings: the source of synthetic scans, and arguments of ``MixedScans``."""


def open_synthetic(where: Any) -> Any:
    """Open the source of synthetic scans that a configuration names.

    Args:
        where: a bank's folder or URL, a checkpoint (``.safetensors``), the name of a shipped model,
            or a folder of scans in any layout that ``open_scans`` reads; ``{"root": URL, "cache":
            FOLDER, "limit": "200GB"}`` opens a ``Bank``. Any other object is returned unchanged.

    Raises:
        ConfigError, FileError, DataError: if there is no such source, or both a model and a
            folder of this name.
    """
    if isinstance(where, Mapping) and "root" in where:
        for key in where:
            choose("key of a bank", key, inspect.signature(Bank).parameters)
        return Bank(**where)
    if not isinstance(where, str | Path):
        return where
    if is_url(where):
        return Bank(where)
    refuse_ambiguous(where)
    if not os.path.isdir(where):  # noqa: PTH112 - Path.is_dir raises on a name that is too long
        # imported only if a model is named, because it loads networks
        from lidar_synth.generate.loading import load_generator

        return load_generator(where)
    if is_bank(where):
        return Bank(where)
    scans = open_scans(where)
    stored = scans[0].sensor  # files may store their own sensor
    if scans.sensor.shape == stored.shape:
        return scans
    return open_scans(where, sensor=stored)


def read_settings(settings: Any = None) -> dict[str, Any]:
    """Read the settings of a mixture, with keys in lower case.

    Args:
        settings: the settings or a YAML file; by default the file in the environment variable
            ``LIDAR_SYNTH_MIX``.

    Raises:
        ConfigError: if there are no settings.
        FileError, DataError: if the file cannot be read.
    """
    source = settings if settings is not None else os.environ.get(VARIABLE)
    if isinstance(source, str | Path):
        settings = read_yaml(Path(source), "the settings of a mixture")
    if not isinstance(settings, Mapping):
        raise ConfigError(
            f"{source!r} as the settings of a mixture",
            f"a dict of {', '.join(OPTIONS)}, or a YAML file of them",
            f"Set the file in the trainer's configuration or by {VARIABLE}=mix.yaml.",
        )
    return {str(key).lower(): value for key, value in settings.items()}


def mix(
    real: Any,
    synth: Any,
    ratio: Ratio | None = None,
    labels: Labels | None = None,
    *,
    task: str = "segmentation",
    epochs: int | None = None,
    as_sensor: Any = "auto",
    **options: Any,
) -> MixedScans:
    """Mix real and synthetic scans; ``mix(...).loader(...)`` makes batches of them.

    Args:
        real: a folder or URL of scans or of a bank, or any source of scans; None with ratio 1.
        synth: a folder or URL of scans or of a bank, a checkpoint, the name of a shipped model, or
            any source of synthetic scans.
        ratio, labels: as for ``MixedScans``; by default 0.25 and "generated", or those of the
            task.
        task: "segmentation", or "detection", which needs ``epochs``, takes boxes as labels, and
            pastes objects of the real scans into all scans, which it turns, mirrors and scales.
        epochs: number of epochs of the training; makes the recipe that gained most on real scans
            the default. With up to 40 real scans whose sensor has the lasers of the synthetic
            scans': synthetic scans alone for three quarters of the epochs, then half of the
            samples, and real scans alone in the last twentieth; persons and cycles of the town
            replace those of the synthetic scans, unless ``labels`` are given. Otherwise: synthetic
            scans alone for a quarter of the epochs, then real scans alone.
        as_sensor: ``"auto"`` turns synthetic scans into scans of the real scans' sensor if they
            are of another one; if its lasers differ too, they get the distribution of reflectance
            of ten real scans. None leaves them as they are; otherwise as for ``MixedScans``, or
            ``{"sensor": NAME, "mount": [Z, PITCH], "like": FOLDER}``.
        options: further arguments of ``MixedScans``.

    Raises:
        ConfigError, FileError, DataError: if a source cannot be opened; as ``MixedScans``; with
            ``epochs`` and no ``ratio`` also for a segmenter's real scans without labels.

    Example:
        >>> import lidar_synth
        >>> train = lidar_synth.mix("demo_out/town", "demo_out/bank", ratio=0.25)
        >>> for batch in train.loader(batch_size=4):
        ...     print(sorted(batch["domain"].tolist()))
        [0, 0, 0, 1]
        >>> train = lidar_synth.mix("demo_out/town", "demo_out/bank", epochs=40)
        >>> len(train), [train.mixture.ratio(epoch) for epoch in (0, 30, 39)]
        (100, [1.0, 0.5, 0.0])
    """
    reals = _open_real(real)
    synthetics = open_synthetic(synth)
    alike = agree(Sensor.same_lasers, reals, synthetics)
    if as_sensor == "auto":
        as_sensor = _transfer(reals, synthetics, alike)
    as_sensor = read_transfer(as_sensor, synthetics)
    choose("task", task, dict.fromkeys(TASKS))
    recipe = {}
    if task == "detection":
        recipe = detection_options(reals, epochs)
    elif epochs is not None:
        recipe = segmentation_options(reals, epochs, ratio, alike)
        for source, _ in each(reals):
            if recipe and source[0].label is None:
                raise ConfigError(
                    f"epochs={epochs} with a source of real scans without labels",
                    "labelled scans, or synthetic ones alone: ratio=1.0, epoch_size=400",
                    "Then settle the network on the real scans (docs/how-to/mix.md).",
                )
    given = {"ratio": ratio, "labels": _open_policy(labels), "as_sensor": as_sensor}
    recipe |= {name: value for name, value in given.items() if value is not None}
    known = dict(inspect.signature(MixedScans).parameters, epochs=0, task=0)
    del known["real_as_is"]
    for name in options:
        choose("argument of mix", name, known)
    train = MixedScans(reals, synthetics, **(recipe | options))
    train._maker.notices.segments = task == "segmentation"
    return train


def _transfer(reals: Any, synthetics: Any, alike: bool) -> Transfer | None:
    """The transfer of synthetic scans to the sensor of the real ones; None if it is the same.
    Unless the lasers are ``alike``, the transfer also adapts the reflectance to real scans."""
    if agree(Sensor.same_grid, reals, synthetics):
        return None
    [real, _], *_ = each(reals)
    [synthetic, _], *_ = each(synthetics)
    like = None if alike else real
    return make_transfer(sensor_of(real), (0.0, 0.0), like, synthetic)


def _open_real(where: Any) -> Any:
    """Open real scans by their path or URL; any other object is returned unchanged. Logs a warning
    if scans of a validation or test split are among them."""
    if not isinstance(where, str | Path):
        return where
    if is_url(where) or is_bank(where):
        return Bank(where)
    scans = open_scans(where)
    with suppress(ConfigError, DataError):  # the layout or the folder has no such split
        count = len(open_scans(where, split="train"))
        if count < len(scans):
            log.warning(
                f"{where} has splits, of which all {len(scans)} scans are taken. For the {count} "
                f"of training alone: mix(open_scans({str(where)!r}, split='train'), ...)"
            )
    return scans


def mix_for_trainer(
    real: int,
    settings: Mapping[str, Any],
    to_sample: Callable[[Scan, np.random.Generator], Any] = lambda scan, rng: scan,
    weighs: bool = False,
) -> MixedScans:
    """Make a mixture from settings, for a trainer that loads real samples itself.

    Args:
        real: number of the trainer's real samples.
        settings: keys of ``OPTIONS``; ``synthetic`` is required. ``epochs`` are those of the
            trainer, and take the place of ``ratio``, see ``MixedScans.wrap``.
        to_sample: ``(scan, rng) -> sample`` for synthetic scans; by default they stay as they are.
        weighs: whether the trainer multiplies losses by ``loss_weight``.

    Returns:
        A dataset whose real samples are only their numbers, 0 <= n < real, by which the trainer
        loads them.

    Raises:
        ConfigError: on an unknown key, no real sample, or settings that ``MixedScans`` refuses.
    """
    for key in settings:
        choose("setting of a mixture", key, dict.fromkeys(OPTIONS))
    if not real:
        raise ConfigError(
            "a trainer that found no real scan",
            "a path that leads to them",
            "WaffleIron, Pointcept and Open3D-ML read PATH/dataset/sequences of SemanticKITTI.",
        )
    if "classes" in settings:
        raise ConfigError(
            f"classes: {settings['classes']} for this trainer",
            "no key classes: SemanticKITTI's",
            "The adapters of lidar-bonnetal's family, Cylinder3D and Pointcept take others.",
        )
    if "loss_weight" in settings and not weighs:
        raise ConfigError(
            f"loss_weight: {settings['loss_weight']} for a trainer that adds up a batch's losses",
            "no key loss_weight",
            "Use a smaller ratio, or one that falls: ratio: {synthetic_first: EPOCHS}.",
        )
    if settings.get("as_sensor") == "auto":
        raise ConfigError(
            "as_sensor: auto for a trainer, which reads real scans itself",
            "the sensor of your scans",
            "Name it: as_sensor: hdl64e_kitti, for instance, or a YAML file.",
        )
    if settings.get("synthetic") is None:
        raise ConfigError(
            "a mixture without synthetic scans",
            "synthetic: a bank's folder, a checkpoint or a folder",
        )
    options = dict(settings)
    synthetic = open_synthetic(options.pop("synthetic"))
    options["as_sensor"] = read_transfer(options.get("as_sensor"), synthetic)
    if "labels" in options:
        options["labels"] = _open_policy(options["labels"])
    # compare=False: the real samples are only numbers.
    return MixedScans.wrap(
        range(real), synthetic, to_sample=to_sample, compare=False, **options
    )


def _open_policy(labels: Any) -> Any:
    """A label policy with its real scans, which YAML names by their folder."""
    if not isinstance(labels, Mapping):
        return labels
    policies = dict(labels)
    for name, arguments in labels.items():
        if isinstance(arguments, Mapping) and "real" in arguments:
            policies[name] = {**arguments, "real": _open_real(arguments["real"])}
    return policies
