"""Lightning: a ``LightningDataModule`` for mixtures, optionally with synthesis on the GPU after the
batch transfer::

    data = MixedData(
        train=MixedScans(real, synth, ratio=0.25), val=val_scans, batch_size=8, num_workers=4
    )
    trainer.fit(model, data)

Set ``Trainer(use_distributed_sampler=False)``, because the batch sampler divides the plan among
ranks itself; so does that of ``train.loader``, also with Fabric. Training begins in the epoch that
is set on the mixture. A checkpoint within an epoch resumes after its last batch.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from torch.utils.data import DataLoader, Dataset, DistributedSampler

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.generate.generator import Generated
from lidar_synth.geometry import REAL, Source, require_finite
from lidar_synth.mixing import Collate, MixedBatches, MixedScans
from lidar_synth.mixing.items import copy_scan
from lidar_synth.mixing.service.batches import Places, complete
from lidar_synth.mixing.state import after_epoch, check_state, make_state
from lidar_synth.noise import keyed_rng

try:
    import lightning
except ImportError as error:
    raise LibraryError(
        f"lightning cannot be imported ({error})",
        "2.4 or later",
        "pip install lightning==2.5.5",
    ) from error

STOLEN = ("2.6.2", "2.6.3")
"""Releases that steal credentials."""

if lightning.__version__ in STOLEN:
    raise LibraryError(
        f"lightning {lightning.__version__}, a release that steals credentials",
        "another one",
        "pip install lightning==2.5.5, and change your passwords and keys",
    )


class RealSamples(Dataset[Any]):
    """Scans in the form of a mixture's samples, without augmentation, for validation and test."""

    def __init__(self, scans: Source, train: MixedScans) -> None:
        self.scans = scans
        self._to_sample = train._maker._to_sample

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, index: int) -> Any:
        scan = self.scans[index]
        require_finite(scan)
        # Scans of the town count as real, as in training.
        scan = replace(copy_scan(scan), domain=REAL)
        return self._to_sample(scan, keyed_rng(0, index))


class MixedData(lightning.LightningDataModule):  # type: ignore[misc]
    """Loaders for training on a mixture, and for validation and test on real scans.

    Args:
        train: the mixture.
        val, test: scans, which get the form of the mixture's samples; with ``MixedScans.wrap`` your
            own datasets, whose samples stay as they are; None = no such loader. Several devices
            share them; as usual, a few samples may be repeated so that all have as many.
        batch_size: number of samples in a batch, on each rank.
        num_workers: number of workers of each loader; they persist over the epochs.
        on_device: whether the main process makes synthetic scans after the batch transfer, with
            generators on the training device; otherwise workers, which have no GPU, make them.

    Raises:
        ConfigError: on a ``MixedStream``; on a ``MixedScans`` as ``val`` or ``test``, unless
            ``train`` is of ``wrap``; with ``on_device``, on synthetic sources that are not
            generators.
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
        if not isinstance(train, MixedScans):
            raise ConfigError(
                f"train={type(train).__name__}",
                "a MixedScans, whose batches resume after the last one that was trained on",
                "Of a MixedStream: MixedData(stream.scans).",
            )
        if not train._real_as_is and any(
            isinstance(scans, MixedScans) for scans in (val, test)
        ):
            raise ConfigError(
                "a MixedScans for validation or test",
                "the real scans themselves",
                "Of MixedScans(scans, ratio=0): MixedData(train, val=scans).",
            )
        if on_device and not all(
            isinstance(source, Generated) for source in train.synthetic
        ):
            raise ConfigError(
                f"on_device with {[type(s).__name__ for s in train.synthetic]}",
                "a generator: load_generator(...)",
            )
        self.train = train
        self.val = val
        self.test = test
        self.batch_size = batch_size
        self.num_workers = num_workers
        self.on_device = on_device
        self._resume: dict[str, Any] | None = None
        self._first = 0  # the epoch of the mixture in Lightning's epoch 0
        self._batches: _Epochs | None = None

    def train_dataloader(self) -> Any:
        """Batches in the order of the plan, divided among ranks; resumes if a checkpoint was
        loaded."""
        if self.trainer is not None and self.trainer.current_epoch == 0:
            self._first = self.train.epoch
        self._batches = _Epochs(self, MixedBatches(self.train, self.batch_size))
        if self._resume is not None:
            self._batches.load_state_dict(self._resume)
            self._resume = None
        dataset: Any = Places(self.train) if self.on_device else self.train
        collate = Unfinished if self.on_device else self.train.collate
        loader: Any = DataLoader(
            dataset, batch_sampler=self._batches, collate_fn=collate, **self._workers()
        )
        vars(loader).update(  # Lightning saves it
            state_dict=self._batches.state_dict,
            load_state_dict=self._batches.load_state_dict,
        )
        return loader

    def teardown(self, stage: str) -> None:
        """Set the mixture back to its first epoch, in which another training begins."""
        if stage == "fit":
            self.train.set_epoch(self._first)

    def val_dataloader(self) -> Any:
        """Batches of real scans."""
        return self._plain(self.val)

    def test_dataloader(self) -> Any:
        """Batches of real scans."""
        return self._plain(self.test)

    def transfer_batch_to_device(
        self, batch: Any, device: Any, dataloader_idx: int
    ) -> Any:
        """Transfer a batch; an unfinished one is transferred later, when its synthetic samples are
        made."""
        if isinstance(batch, Unfinished):
            return batch
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Make the synthetic samples of a batch, all of one generator at once, and collate it."""
        if not isinstance(batch, Unfinished):
            return batch
        device = self.trainer.strategy.root_device if self.trainer else "cpu"
        return super().transfer_batch_to_device(
            complete(self.train, batch), device, dataloader_idx
        )

    def state_dict(self) -> dict[str, Any]:
        """The progress of training, after the last batch that Lightning counts as processed."""
        if self._batches is None:
            return make_state(self.train.mixture, 0, 0)
        return self._batches.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Resume from a checkpoint.

        Raises:
            ConfigError: on a checkpoint of another mixture; or from the middle of an epoch with
                another batch size, which Lightning would miscount.
        """
        check_state(state_dict, self.train.mixture)
        self._resume = state_dict
        if self._batches is not None:
            self._batches.load_state_dict(state_dict)

    def _workers(self) -> dict[str, Any]:
        return {
            "num_workers": self.num_workers,
            "persistent_workers": self.num_workers > 0,
        }

    def _plain(self, scans: Source | None) -> Any:
        if scans is None:
            return []
        as_is = self.train._real_as_is
        dataset: Any = scans if as_is else RealSamples(scans, self.train)
        collate = self.train.collate
        if isinstance(collate, Collate):
            collate = replace(collate, unlabelled="allow")
        share = self.trainer and self.trainer.distributed_sampler_kwargs
        sampler: Any = (
            DistributedSampler(dataset, **share, shuffle=False) if share else None
        )
        return DataLoader(
            dataset,
            self.batch_size,
            sampler=sampler,
            collate_fn=collate,
            **self._workers(),
        )


class Unfinished(list[Any]):
    """The samples of a batch whose synthetic ones are not made yet; no collate function returns
    this type."""


class _Epochs:
    """A batch sampler that reads the epoch from Lightning, and whose state follows Lightning's
    count of batches."""

    def __init__(self, data: MixedData, batches: MixedBatches) -> None:
        self._data = data
        self._batches = batches
        self._epoch = batches.dataset.epoch  # the epoch that began last
        # the epoch of the loaded state; Lightning's count is one behind after the end of an epoch
        self._least = 0

    def __len__(self) -> int:
        """Number of batches in the complete epoch; Lightning adds the batches before a checkpoint
        to its count."""
        return len(self._batches.steps_from(0))

    def __iter__(self) -> Iterator[list[int]]:
        self._epoch = self._current()
        self._batches.set_epoch(self._epoch)
        return iter(self._batches)

    def state_dict(self) -> dict[str, Any]:
        """The state after the processed batches, and the number of samples in a step of all
        ranks."""
        steps = self._batches.steps_from(0)
        trainer = self._data.trainer
        done = 0
        last = len(steps)
        if trainer:
            done = trainer.fit_loop.epoch_loop.batch_progress.current.processed
            last = min(last, trainer.num_training_batches)  # limit_train_batches
        mixture = self._batches.dataset.mixture
        place = (
            (self._epoch, steps[done].start)
            if done < last
            else after_epoch(mixture, self._epoch)
        )
        return make_state(mixture, *place) | {
            "step": steps.size,
            "first": self._data._first,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state.

        Raises:
            ConfigError: as ``MixedData.load_state_dict``.
        """
        size = self._batches.steps_from(0).size
        if state["position"] and state.get("step", size) != size:
            raise ConfigError(
                f"a checkpoint from the middle of an epoch, {state['step']} samples a step, for "
                f"{size} a step",
                "the batch size and the number of devices with which it was saved",
                "A checkpoint from the end of an epoch fits any.",
            )
        self._batches.load_state_dict(state)
        self._data._first = state.get("first", 0)
        self._epoch = self._least = self._batches.dataset.epoch

    def _current(self) -> int:
        trainer = self._data.trainer
        if trainer is None:
            return int(self._batches.dataset.epoch)
        # The same batches again, where they are to be overfitted.
        passes: int = 0 if trainer.overfit_batches else trainer.current_epoch
        return max(self._least, self._data._first + passes)
