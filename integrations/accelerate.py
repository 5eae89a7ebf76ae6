"""Accelerate: a loader of a mixture for its training loop::

    loader = DataLoader(
        train, batch_sampler=train.batches(4), collate_fn=train.collate, num_workers=2
    )
    loader = prepare(accelerator, loader)
    for epoch in range(first, epochs):
        train.set_epoch(epoch)
        for batch in loader: ...

``accelerator.prepare(loader)`` would count the passes itself, from 0, whatever epoch was set or
resumed, and repeat samples until all batches are full (``even_batches``). Here a pass is through
the epoch that was set or resumed, or else the next one, and all processes together load each of its
samples once.
"""

from typing import Any

from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.mixing import MixedBatches, MixedStream

try:
    from accelerate.data_loader import prepare_data_loader
except ImportError as error:
    raise LibraryError(
        f"accelerate cannot be imported ({error})",
        "1.0 or later",
        "pip install accelerate",
    ) from error


def prepare(accelerator: Any, loader: DataLoader[Any]) -> Any:
    """Prepare a loader of a mixture, in place of ``accelerator.prepare(loader)``.

    Args:
        accelerator: the ``Accelerator``; its processes have batches of the given size each.
        loader: of a ``MixedScans`` with ``batch_sampler=train.batches(batch_size)``, or of a
            ``MixedStream``.

    Returns:
        Accelerate's own loader, which puts batches on the accelerator's device.

    Raises:
        ConfigError: on a loader that is prepared already, or one without ``train.batches``.

    Example:
        >>> from accelerate import Accelerator
        >>> from torch.utils.data import DataLoader
        >>> from lidar_synth import Bank, MixedScans, open_scans
        >>> from lidar_synth.integrations.accelerate import prepare
        >>> train = MixedScans(open_scans("demo_out/town"), Bank("demo_out/bank"), ratio=0.25)
        >>> train.set_epoch(5)
        >>> loader = DataLoader(train, batch_sampler=train.batches(2), collate_fn=train.collate)
        >>> sum(len(batch["domain"]) for batch in prepare(Accelerator(cpu=True), loader))
        4
    """
    divided = (
        loader.dataset
        if isinstance(loader.dataset, MixedStream)
        else loader.batch_sampler
    )
    if not isinstance(divided, MixedBatches | MixedStream):
        raise ConfigError(
            f"a loader whose batches come from {type(divided).__name__}",
            "a DataLoader with batch_sampler=train.batches(batch_size), or one of a MixedStream",
            "Give the loader as it was before accelerator.prepare.",
        )
    divided.divide(accelerator.process_index, accelerator.num_processes)
    shard = prepare_data_loader(
        loader,
        accelerator.device,
        num_processes=1,
        process_index=0,
        put_on_device=accelerator.device_placement,
        dispatch_batches=False,
    )
    mixed: Any = divided.scans if isinstance(divided, MixedStream) else divided.dataset
    mixed.current.follow(shard)
    return shard
