"""``MixedLoader``: batches of a mixture, epoch after epoch."""

from collections.abc import Iterator, Mapping
from typing import Any

from torch.utils.data import DataLoader

from lidar_synth.mixing.batches import MixedBatches


class MixedLoader(DataLoader[Any]):
    """A ``DataLoader`` of a mixture that sets its own epoch and can resume.

    Each pass is one epoch, from the mixture's own or that of a loaded state on; a pass that is left
    early is begun again by the next one. In a distributed training each rank gets its share.

    Args:
        dataset: a ``MixedScans``.
        batch_size: number of samples in a batch, on each rank.
        num_workers: number of worker processes.
        drop_last: whether to drop the samples that do not fill a batch on every rank.
        options: further arguments of ``DataLoader``.

    Raises:
        ConfigError: on a batch size below 1.
    """

    def __init__(
        self,
        dataset: Any,
        batch_size: int,
        num_workers: int = 0,
        *,
        drop_last: bool = False,
        **options: Any,
    ) -> None:
        self._mixed = dataset
        self._batches: MixedBatches = dataset.batches(batch_size, drop_last=drop_last)
        self._epoch: int = dataset.epoch
        self._done = 0
        options.setdefault("collate_fn", dataset.collate)
        super().__init__(dataset, batch_sampler=self._batches, num_workers=num_workers, **options)

    @property
    def epoch(self) -> int:
        """The epoch of the pass that is running, or else of the next one."""
        return self._epoch

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next pass; raises as ``MixedScans.set_epoch``."""
        self._mixed.set_epoch(epoch)
        self._epoch = epoch
        self._done = 0

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        self.set_epoch(self._epoch)
        for batch in super().__iter__():
            self._done += 1
            yield batch
        self._epoch += 1
        self._done = 0

    def state_dict(self) -> dict[str, Any]:
        """The progress after the latest batch, from which any number of ranks and workers can
        resume."""
        if self._mixed.epoch != self._epoch:  # a pass has ended, and no other has begun
            return self._batches.state_dict(done=len(self._batches))
        return self._batches.state_dict(done=self._done)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state with the next pass.

        Raises:
            ConfigError: on an invalid state, or one of another mixture.
        """
        self._batches.load_state_dict(state)
        self._epoch = self._mixed.epoch
        self._done = 0
