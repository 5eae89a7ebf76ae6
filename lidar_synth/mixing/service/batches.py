"""Batch mixing: real samples from DataLoader workers, synthetic scans made in the main process on the training device.

A thread makes the scans of the next batch while the trainer works on this one, on a CUDA stream of its own where
there is a GPU. What comes out is what the dataset gives in any other way: label policy, augmentation and
``to_sample`` are its own.
"""

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from typing import Any, NamedTuple

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import Generated, MixedScans


class Place(NamedTuple):
    """One sample of a batch in the making.

    Args:
        epoch, position: where it stands in the plan.
        missing: (number of the synthetic source, index) of the scan that is still to be made, or None.
        sample: where no scan is missing.
    """

    epoch: int
    position: int
    missing: tuple[int, int] | None = None
    sample: Any = None


class BatchMixer:
    """A replacement of ``DataLoader`` for a ``MixedScans`` whose generator is on the GPU.

    Args:
        dataset: whose samples are loaded. The main process makes the scans of generators, workers all other samples.
        batch_size: number of samples in a batch, in the order of the plan.
        batch_sampler: instead of ``batch_size``, such as ``dataset.batches(...)`` of one rank.
        options: other options of ``DataLoader``, such as ``num_workers``; ``collate_fn`` is ``dataset.collate``.

    Raises:
        ConfigError: on both or none of ``batch_size`` and ``batch_sampler``.

    Example:
        >>> from lidar_synth import BatchMixer, MixedScans, load_generator, open_scans
        >>> generator = load_generator("town")  # with a GPU: device="cuda"
        >>> train = MixedScans(open_scans("demo_out/town"), generator, ratio=0.25)
        >>> domains = [batch["domain"] for batch in BatchMixer(train, batch_size=2, num_workers=0)]
        >>> [len(d) for d in domains], int(sum(d.sum() for d in domains))
        ([2, 2], 1)
    """

    def __init__(
        self,
        dataset: MixedScans,
        batch_size: int | None = None,
        *,
        batch_sampler: Sampler[list[int]] | None = None,
        **options: Any,
    ) -> None:
        if (batch_size is None) == (batch_sampler is None):
            raise ConfigError(f"batch_size={batch_size} and batch_sampler={batch_sampler}", "one of them")
        self.dataset = dataset
        self.batch_sampler = batch_sampler or dataset.batches(batch_size or 0)
        self._sources = {n: source for n, source in enumerate(dataset.synthetic) if isinstance(source, Generated)}
        others = _Others(dataset, self._sources)
        self._loader = DataLoader(others, batch_sampler=self.batch_sampler, collate_fn=list, **options)
        self._streams: dict[torch.device, torch.cuda.Stream] = {}

    def __len__(self) -> int:
        return len(self._loader)

    def __iter__(self) -> Iterator[Any]:
        with ThreadPoolExecutor(1, "lidar-synth") as thread:
            before: Future[Any] | None = None
            for places in self._loader:
                making = thread.submit(self._batch, places)
                if before is not None:
                    yield before.result()
                before = making
            if before is not None:
                yield before.result()

    def _batch(self, places: Sequence[Place]) -> Any:
        scans: dict[tuple[int, int], Scan] = {}
        for number, source in self._sources.items():
            indices = list(dict.fromkeys(p.missing[1] for p in places if p.missing and p.missing[0] == number))
            if indices:
                with self._stream(source.generator.device):
                    made = source.scans(indices)
                scans |= {(number, index): scan for index, scan in zip(indices, made, strict=True)}
        return self.dataset.collate(
            [self.dataset.finish(scans[p.missing], p.epoch, p.position) if p.missing else p.sample for p in places]
        )

    def _stream(self, device: torch.device) -> AbstractContextManager[Any]:
        """The stream for scans, so that they do not queue up behind the trainer's work."""
        if device.type != "cuda":
            return nullcontext()
        if device not in self._streams:
            self._streams[device] = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
            torch.cuda.synchronize(device)  # the weights are there
        return torch.cuda.stream(self._streams[device])


class _Others(Dataset[Place]):
    """What the workers load: every sample but those whose scan the main process makes."""

    def __init__(self, dataset: MixedScans, missing: Collection[int]) -> None:
        # Workers get no network: one on a GPU would not even survive the way.
        sources: list[Any] = [None if n in missing else source for n, source in enumerate(dataset.synthetic)]
        self._dataset = copy(dataset)
        self._dataset.synthetic = tuple(sources)

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, position: int) -> Place:
        epoch = self._dataset.epoch_of(position)
        made = self._dataset.plan(epoch)
        source, index = made[position]
        if source >= made.reals and self._dataset.synthetic[source - made.reals] is None:
            return Place(epoch, position, (source - made.reals, index))
        return Place(epoch, position, sample=self._dataset.sample(epoch, position))
