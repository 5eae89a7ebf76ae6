"""A mixture's epochs as a file, for trainers whose environment cannot hold the package;
``reader.py`` reads it::

    python -m lidar_synth.integrations.plan mix.yaml plan.npz --real 19130 --epochs 50

``plan.npz`` holds the order of each epoch, computed by the package: ``epoch-<n>`` (N, 2) int64 (0 =
real or 1 = synthetic, number of the sample), and ``settings``, the bytes of a JSON text: format,
order, number of real samples, the bank's identity, label policy and threshold, length and hash of
each epoch's plan.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.mixture import mix_for_trainer, read_settings
from lidar_synth.integrations.reader import PLAN_FORMAT

from lidar_synth.bank import Bank
from lidar_synth.errors import ConfigError, LidarSynthError
from lidar_synth.files.disk import write_arrays
from lidar_synth.labels.own import KeepBoxes, KeepCondition, KeepLabels, RemoveLabels
from lidar_synth.labels.policies import read_policy
from lidar_synth.mixing.plan import VERSION
from lidar_synth.mixing.settings import open_synthetic

POLICIES = {
    KeepLabels: "generated",
    KeepCondition: "condition",
    KeepBoxes: "boxes",
    RemoveLabels: "none",
}
"""Label policies that need no other scan than the bank's own."""


def write_plan(
    settings: Mapping[str, Any], out: str | Path, *, real: int, epochs: int
) -> list[str]:
    """Write the order of a mixture's first epochs.

    Args:
        settings: of the mixture, see ``lidar_synth.mixing.settings``; its synthetic source is a
            bank.
        out: the file to write, ``.npz``.
        real: number of the trainer's real samples.
        epochs: number of epochs.

    Returns:
        The hash of each epoch's plan, as ``MixedScans.plan(epoch).hash``.

    Raises:
        ConfigError: on synthetic scans that are not in a bank, a label policy that needs more than
            the bank's own labels, a recipe by ``epochs``, another sensor, an augmentation, no
            epochs or real samples, or settings that ``MixedScans`` refuses.
        FileError: if the file cannot be written.
    """
    policy = read_policy(settings.get("labels", "generated"))
    labels = POLICIES.get(type(policy))
    if labels is None:
        raise ConfigError(
            f"labels={settings['labels']!r} for a plan file",
            f"one of {', '.join(POLICIES.values())}",
            "The reader takes a bank's own labels; other policies need the package in the "
            "trainer's environment.",
        )
    for key in ("epochs", "as_sensor", "augment"):
        if settings.get(key) is not None:
            raise ConfigError(
                f"{key}: {settings[key]} for a plan file",
                "none",
                "The reader takes a bank's scans as they are; recipes, other sensors and "
                "augmentations need the package in the trainer's environment.",
            )
    if epochs < 1 or real < 1 or Path(out).suffix != ".npz":
        raise ConfigError(
            f"{real} real samples and {epochs} epochs in {out}",
            "at least one of each, in a .npz file",
        )
    bank = open_synthetic(settings.get("synthetic"))
    if not isinstance(bank, Bank):
        raise ConfigError(
            f"synthetic: {settings.get('synthetic')}",
            "a bank",
            "lidar-synth bake OUT writes one.",
        )
    mixed = mix_for_trainer(real, {**settings, "synthetic": bank})
    if (
        "boxes" in mixed.synthetic[0].fields
        and labels != "none"
        and settings.get("unboxed") != "keep"
    ):
        raise ConfigError(
            f"labels={labels!r} of a bank with boxes for a plan file",
            "unboxed: keep, too",
            "The reader cannot remove objects without a box; MixedScans does, where the package "
            "is installed.",
        )
    plans = [mixed.plan(epoch) for epoch in range(epochs)]
    arrays = {
        f"epoch-{plan.epoch}": np.stack(plan.at(np.arange(len(plan))), 1)
        for plan in plans
    }
    hashes = [plan.hash for plan in plans]
    values = {
        "format": PLAN_FORMAT,
        "order": VERSION,
        "real": real,
        "bank": mixed.synthetic[0].identity,
        "labels": labels,
        "threshold": float(getattr(policy, "threshold", 0)),
        "lengths": [len(plan) for plan in plans],
        "hashes": hashes,
    }
    text = np.frombuffer(json.dumps(values).encode(), np.uint8)
    write_arrays(Path(out), {"settings": text, **arrays}, compressed=True)
    return hashes


def main() -> None:
    """Entry point of ``python -m lidar_synth.integrations.plan``."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mix", help="YAML file of the mixture's settings")
    parser.add_argument("out", help="the file to write, .npz")
    parser.add_argument(
        "--real", type=int, required=True, help="number of the trainer's real samples"
    )
    parser.add_argument("--epochs", type=int, required=True, help="number of epochs")
    options = parser.parse_args()
    try:
        hashes = write_plan(
            read_settings(options.mix),
            options.out,
            real=options.real,
            epochs=options.epochs,
        )
    except LidarSynthError as error:
        print(f"lidar-synth: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ConfigError) else 1)
    print(f"{options.out}: {len(hashes)} epochs, the first with plan {hashes[0][:16]}")


if __name__ == "__main__":
    main()
