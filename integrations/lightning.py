"""Lightning: a ``LightningDataModule`` around mixtures, with synthesis on the GPU after the transfer if it is wanted::

    data = MixedData(train=MixedScans(real, synth, ratio=0.25), val=val_scans, batch_size=8, num_workers=4)
    trainer.fit(model, data)

Set ``Trainer(use_distributed_sampler=False, reload_dataloaders_every_n_epochs=0)``: the batch sampler shares the plan
among ranks itself.
"""

from dataclasses import dataclass
from typing import Any

from torch.utils.data import DataLoader, Dataset

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.geometry.scan import Source
from lidar_synth.mixing import Collate, Generated, MixedBatches, MixedScans, to_item
from lidar_synth.noise import keyed_rng

try:
    import lightning
except ImportError as error:
    raise LibraryError(
        f"lightning cannot be imported ({error})", "2.4 or later", "pip install lightning==2.5.5"
    ) from error

STOLEN = ("2.6.2", "2.6.3")
"""Releases that steal credentials."""

if lightning.__version__ in STOLEN:
    raise LibraryError(
        f"lightning {lightning.__version__}, a release that steals credentials",
        "another one",
        "pip install lightning==2.5.5, and change your passwords and keys",
    )


@dataclass(frozen=True)
class Pending:
    """A synthetic sample that is made after the transfer: its place in the plan and its number."""

    epoch: int
    position: int
    source: int
    number: int


class OnDevice(Dataset[Any]):
    """A mixture whose synthetic samples are ``Pending``: workers load the real ones only."""

    def __init__(self, mixed: MixedScans) -> None:
        self.mixed = mixed

    def __len__(self) -> int:
        return len(self.mixed)

    def __getitem__(self, index: int) -> Any:
        epoch, made = self.mixed.epoch, self.mixed.plan()
        source = int(made.source[index]) - made.reals
        if source < 0:
            return self.mixed.sample(epoch, index)
        return Pending(epoch, index, source, int(made.index[index]))


class Items(Dataset[Any]):
    """Scans as plain PyTorch items, for validation and test."""

    def __init__(self, scans: Source) -> None:
        self.scans = scans

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> Any:
        return to_item(self.scans[index], keyed_rng(0, index))


class MixedData(lightning.LightningDataModule):  # type: ignore[misc]
    """Loaders for training on a mixture and for validation and test on real scans.

    Args:
        train: the mixture.
        val, test: scans; none = no such loader.
        batch_size: samples of a batch, on each rank.
        num_workers: of each loader. They are kept over the epochs.
        on_device: make synthetic scans in the main process, after a batch was transferred, with generators that are on
            its device; otherwise they come from workers, which have no GPU.

    Raises:
        ConfigError: with ``on_device``, on synthetic sources that are no generators.
    """

    def __init__(
        self,
        train: MixedScans,
        val: Source | None = None,
        test: Source | None = None,
        *,
        batch_size: int = 4,
        num_workers: int = 0,
        on_device: bool = False,
    ) -> None:
        super().__init__()
        if on_device and not all(isinstance(source, Generated) for source in train.synthetic):
            raise ConfigError(
                f"on_device with {[type(s).__name__ for s in train.synthetic]}", "a generator: load_generator(...)"
            )
        self.train, self.val, self.test = train, val, test
        self.batch_size, self.num_workers, self.on_device = batch_size, num_workers, on_device

    def train_dataloader(self) -> Any:
        """Batches along the plan, shared among ranks."""
        batches = _Epochs(self, MixedBatches(self.train, self.batch_size))
        dataset: Any = OnDevice(self.train) if self.on_device else self.train
        collate = list if self.on_device else self.train.collate
        return DataLoader(dataset, batch_sampler=batches, collate_fn=collate, **self._workers())

    def val_dataloader(self) -> Any:
        """Batches of real scans."""
        return self._plain(self.val)

    def test_dataloader(self) -> Any:
        """Batches of real scans."""
        return self._plain(self.test)

    def transfer_batch_to_device(self, batch: Any, device: Any, dataloader_idx: int) -> Any:
        """The batch on the device; a list of samples waits until the synthetic ones are made."""
        return batch if isinstance(batch, list) else super().transfer_batch_to_device(batch, device, dataloader_idx)

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Makes the synthetic samples of a batch, all of one generator at once, and collates."""
        if not isinstance(batch, list):
            return batch
        for number, source in enumerate(self.train.synthetic):
            wanted = [i for i, item in enumerate(batch) if isinstance(item, Pending) and item.source == number]
            scans = source.scans([batch[i].number for i in wanted]) if wanted else []  # type: ignore[attr-defined]
            for i, scan in zip(wanted, scans, strict=True):
                batch[i] = self.train.finish(scan, batch[i].epoch, batch[i].position)
        device = self.trainer.strategy.root_device if self.trainer else "cpu"
        return super().transfer_batch_to_device(self.train.collate(batch), device, dataloader_idx)

    def state_dict(self) -> dict[str, Any]:
        """The seed; Lightning keeps the epoch itself."""
        return {"seed": self.train.seed}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Refuses a checkpoint of another mixture.

        Raises:
            ConfigError: on another seed.
        """
        if state_dict.get("seed") != self.train.seed:
            raise ConfigError(
                f"a checkpoint of seed {state_dict.get('seed')}", f"seed {self.train.seed} of the mixture"
            )

    def _workers(self) -> dict[str, Any]:
        return {"num_workers": self.num_workers, "persistent_workers": self.num_workers > 0}

    def _plain(self, scans: Source | None) -> Any:
        if scans is None:
            return []
        collate = self.train.collate if isinstance(self.train.collate, Collate) else Collate()
        return DataLoader(Items(scans), self.batch_size, collate_fn=collate, **self._workers())


class _Epochs:
    """A batch sampler that takes the epoch from Lightning before it begins."""

    def __init__(self, data: MixedData, batches: MixedBatches) -> None:
        self._data, self._batches = data, batches

    def __len__(self) -> int:
        return len(self._batches)

    def __iter__(self) -> Any:
        if self._data.trainer is not None:
            self._batches.set_epoch(self._data.trainer.current_epoch)
        return iter(self._batches)
