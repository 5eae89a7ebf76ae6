"""``MixedLoader``: batches of a mixture, epoch after epoch."""

from collections.abc import Iterator, Mapping
from typing import Any

from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError
from lidar_synth.mixing.batches import DIVIDED, MixedBatches
from lidar_synth.mixing.epochs import REPEATED


class MixedLoader(DataLoader[Any]):
    """A ``DataLoader`` of a mixture that sets its own epoch and can resume.

    Each pass is one epoch. The first pass is in the mixture's epoch or that of a loaded state;
    ``set_epoch`` of the loader or of the mixture chooses another. A pass that is left early is
    repeated by the next one from its beginning. Since passes of a few batches each would train on
    the same batches forever, a warning says so, unless the pass was left after one batch or the
    mixture has real scans alone. In distributed training each rank gets its share.

    Args:
        dataset: a ``MixedScans``.
        batch_size: number of samples in a batch, on each rank.
        num_workers: number of worker processes.
        drop_last: whether to drop the samples that do not fill a batch on every rank.
        options: further arguments of ``DataLoader``. With ``persistent_workers=True`` the workers
            stay, so that an epoch starts sooner; of the dataset's changes they see the epoch alone.

    Raises:
        ConfigError: on a batch size below 1, or another order of samples (``shuffle``, a sampler,
            ``in_order=False``).
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
        for name in ("shuffle", "sampler", "batch_sampler", "in_order"):
            kept = name == "in_order"
            if bool(options.get(name, kept)) != kept:
                raise ConfigError(
                    f"{name}={options[name]} for a loader of a mixture",
                    "batches in the plan's order, which is shuffled, as state_dict counts them",
                    DIVIDED if "sampler" in name else "",
                )
        self._mixed = dataset
        self._batches = MixedBatches(dataset, batch_size, drop_last=drop_last)
        # Epoch of the latest pass, and number of its batches done.
        self._pass = (dataset.epoch, 0)
        options.setdefault("collate_fn", dataset.collate)
        super().__init__(
            dataset, batch_sampler=self._batches, num_workers=num_workers, **options
        )

    @property
    def epoch(self) -> int:
        """The epoch of the pass that is running or, after its last batch, of the next one."""
        epoch = int(self._mixed.epoch)
        return epoch + 1 if self._pass == (epoch, len(self._batches)) else epoch

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next pass; raises as ``MixedScans.set_epoch``."""
        if self._pass[1] and self.epoch > self._mixed.epoch:
            self._batches._start = (0, 0)  # the pass that was resumed is over
        self._mixed.set_epoch(epoch)
        self._pass = (epoch, 0)

    def __len__(self) -> int:
        """Number of batches in a complete epoch, also while one is resumed: trainers ask for it
        once, and Lightning adds the batches before a checkpoint to its count."""
        return len(self._batches.steps_from(0))

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        epoch = self.epoch
        begun, done = self._pass
        # Users look at one batch before training; a mixture of real scans alone may be for tests.
        if begun == epoch and done > 1 and self._mixed.synthetic:
            self._mixed.current.warn(REPEATED.format(epoch))
        self.set_epoch(epoch)
        # Counted before each batch is yielded, because a loop over exactly len(self) batches never
        # asks for the end of the pass.
        for done, batch in enumerate(super().__iter__(), 1):
            self._pass = (epoch, done)
            yield batch
        self._pass = (epoch, len(self._batches))

    def state_dict(self) -> dict[str, Any]:
        """The progress after the latest batch, from which any number of ranks and workers can
        resume."""
        epoch, done = self._pass
        return self._batches.state_dict(done if epoch == self._mixed.epoch else 0)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state with the next pass.

        Raises:
            ConfigError: on an invalid state, or one of another mixture.
        """
        self._batches.load_state_dict(state)
        self._pass = (self._mixed.epoch, 0)
