"""Accelerate: a loader of a mixture for its training loop::

    loader = DataLoader(
        train, batch_sampler=train.batches(4), collate_fn=train.collate, num_workers=2
    )
    loader = prepare(accelerator, loader)
    accelerator.register_for_checkpointing(loader)  # for save_state, or save loader.state_dict()
    for epoch in range(first, epochs):
        train.set_epoch(epoch)
        for batch in loader: ...

``accelerator.prepare(loader)`` would count the passes itself, from 0, whatever epoch was set or
resumed, and repeat samples until all batches are full (``even_batches``). Here a pass is through
the epoch that was set or resumed, or else the next one, and all processes together load each of its
samples once. Resume by ``load_state_dict``; ``state_dict`` does not know of the batches that
``skip_first_batches`` leaves out, with which Hugging Face's Trainer resumes.
"""

from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.mixing import MixedBatches, MixedStream

try:
    from accelerate.data_loader import DataLoaderShard, prepare_data_loader
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
        Accelerate's own loader, which puts batches on the accelerator's device, with
        ``state_dict()`` and ``load_state_dict(state)`` as of a ``MixedLoader``; those of the given
        loader are the same from now on.

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
    if isinstance(divided, MixedBatches):
        # Where batches are skipped, Accelerate sets the epoch of a batch sampler's sampler instead
        # of the dataset's; its earlier releases count from 0 there.
        kept = SimpleNamespace(set_epoch=lambda epoch: None)
        vars(divided).update(sampler=kept)
    prepared = prepare_data_loader(
        loader,
        accelerator.device,
        num_processes=1,
        process_index=0,
        put_on_device=accelerator.device_placement,
        dispatch_batches=False,
    )
    shard = _Prepared(prepared, divided)
    vars(loader).update(
        state_dict=shard.state_dict, load_state_dict=shard.load_state_dict
    )
    return shard


class _Prepared(DataLoaderShard):  # type: ignore[misc]
    """Accelerate's loader, which counts the batches that it has yielded: it fetches one ahead."""

    def __init__(self, prepared: Any, divided: MixedBatches | MixedStream) -> None:
        self.__dict__ |= vars(prepared)
        self._divided = divided
        mixed = divided.scans if isinstance(divided, MixedStream) else divided.dataset
        self._current = mixed.current
        self._current.follow(self)
        self._pass = (0, 0)  # epoch of the latest pass, and number of its batches done

    def begin(self) -> None:
        """Begin a pass, of which ``gather_for_metrics`` drops no samples, because none is
        repeated."""
        super().begin()
        self.remainder = 0
        # Batches that were skipped are none of another process, of which the sampler would warn.
        vars(self._divided).update(_fetched=(0, 0))

    def __iter__(self) -> Iterator[Any]:
        epoch = self.iteration
        for done, batch in enumerate(super().__iter__(), 1):
            self._pass = (epoch, done)
            yield batch

    def state_dict(self) -> dict[str, Any]:
        """The progress after the latest batch."""
        epoch, done = self._pass
        return self._divided.state_dict(done if epoch == int(self._current) else 0)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state with the next pass; raises as ``MixedLoader.load_state_dict``."""
        self._divided.load_state_dict(state)
        self._pass = (0, 0)
