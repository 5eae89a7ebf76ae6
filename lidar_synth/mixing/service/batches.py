"""Batch mixing: real samples from DataLoader workers, synthetic scans made in the main process on
the training device.

A thread makes the scans of the next batch while the trainer works on the current one; on a GPU it
uses a CUDA stream of its own. Label policy, augmentation and ``to_sample`` are those of the
dataset, so that the samples are the same as with any other way of loading.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from typing import Any, NamedTuple

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from lidar_synth.errors import ConfigError
from lidar_synth.generate.generator import Generated
from lidar_synth.geometry import Scan
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.batches import check_mixture


class Place(NamedTuple):
    """One sample of an unfinished batch.

    Args:
        epoch, position: its place in the plan.
        missing: (number of the synthetic source, index) of the scan that is still to be made, or
            None.
        sample: the finished sample if no scan is missing.
    """

    epoch: int
    position: int
    missing: tuple[int, int] | None = None
    sample: Any = None


class BatchMixer:
    """A replacement of ``DataLoader`` for a ``MixedScans`` whose generator is on the GPU.

    Args:
        dataset: the dataset. The main process makes the scans of generators; workers load all other
            samples.
        batch_size: number of samples in a batch, in the order of the plan.
        batch_sampler: instead of ``batch_size``, such as ``dataset.batches(...)`` of one rank.
        options: other options of ``DataLoader``, such as ``num_workers``; ``collate_fn`` is
            ``dataset.collate``.

    Raises:
        ConfigError: if both or neither of ``batch_size`` and ``batch_sampler`` are given, or on a
            batch size below 1, or another dataset.

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
        check_mixture(dataset)
        if (batch_size is None) == (batch_sampler is None):
            raise ConfigError(
                f"batch_size={batch_size} and batch_sampler={batch_sampler}",
                "one of them",
            )
        if batch_sampler is None:
            batch_sampler = dataset.batches(batch_size or 0)
        self.dataset = dataset
        self.batch_sampler = batch_sampler
        self._loader = DataLoader(
            Places(dataset),
            batch_sampler=batch_sampler,
            collate_fn=list,
            **options,
        )
        self._streams: dict[torch.device, torch.cuda.Stream] = {}

    def __len__(self) -> int:
        return len(self._loader)

    def __iter__(self) -> Iterator[Any]:
        with ThreadPoolExecutor(1, "lidar-synth") as thread:
            ready: list[Future[Any]] = []
            for places in self._loader:
                ready.append(
                    thread.submit(complete, self.dataset, places, self._stream)
                )
                if len(ready) == 2:
                    yield ready.pop(0).result()
            for last in ready:
                yield last.result()

    def _stream(self, source: Any) -> AbstractContextManager[Any]:
        """The CUDA stream on which scans are made, so that they do not queue behind the trainer's
        work."""
        device = source.generator.device
        if device.type != "cuda":
            return nullcontext()
        if device not in self._streams:
            self._streams[device] = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
            torch.cuda.synchronize(device)  # until the weights are loaded
        return torch.cuda.stream(self._streams[device])


def complete(
    dataset: MixedScans,
    places: Sequence[Place],
    stream: Callable[[Any], AbstractContextManager[Any]] = nullcontext,
) -> Any:
    """The batch of some places, whose missing scans are made, all of one generator at once.

    Args:
        dataset: the mixture.
        places: of ``Places(dataset)``.
        stream: the context in which a source makes its scans.
    """
    scans: dict[tuple[int, int], Scan] = {}
    missing = dict.fromkeys(p.missing for p in places if p.missing)
    for number in sorted({number for number, _ in missing}):
        wanted = [pair for pair in missing if pair[0] == number]
        source: Any = dataset.synthetic[number]
        with stream(source):
            made = source.scans([index for _, index in wanted])
        scans |= zip(wanted, made, strict=True)
    return dataset.collate(
        [
            dataset.finish(scans[p.missing], p.epoch, p.position)
            if p.missing
            else p.sample
            for p in places
        ]
    )


class Places(Dataset[Place]):
    """The dataset of the workers: all samples except those whose scan the main process makes."""

    def __init__(self, dataset: MixedScans) -> None:
        # Workers get no network: one on a GPU could not be sent to them.
        sources: list[Any] = [
            None if isinstance(source, Generated) else source
            for source in dataset.synthetic
        ]
        self._dataset = copy(dataset)
        self._dataset.synthetic = tuple(sources)

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, position: int) -> Place:
        epoch = self._dataset.epoch_of(position)
        plan = self._dataset.plan(epoch)
        source, index = plan[position]
        number = source - plan.reals
        if number >= 0 and self._dataset.synthetic[number] is None:
            return Place(epoch, position, (number, index))
        return Place(epoch, position, sample=self._dataset.sample(epoch, position))
