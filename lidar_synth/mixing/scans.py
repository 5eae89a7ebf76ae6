"""``MixedScans``: real and synthetic scans in one map-style dataset."""

import logging
from collections.abc import Callable, Iterable
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakValueDictionary

import numpy as np
from torch.utils.data import Dataset, default_collate, get_worker_info

from lidar_synth.errors import ConfigError
from lidar_synth.geometry import (
    REAL,
    SYNTHETIC,
    Scan,
    Sensor,
    check_source,
    identity_of,
    index_of,
)
from lidar_synth.labels.policies import Labels
from lidar_synth.mixing.batches import AHEAD, MixedBatches
from lidar_synth.mixing.collate import Collate, Form, Unlabelled
from lidar_synth.mixing.compare import check_alike, weightless
from lidar_synth.mixing.domains import make_weight
from lidar_synth.mixing.epochs import CurrentEpoch, Position
from lidar_synth.mixing.items import to_item
from lidar_synth.mixing.loader import MixedLoader
from lidar_synth.mixing.making import SampleMaker, ToSample, make_transfer
from lidar_synth.mixing.notices import report_repeats
from lidar_synth.mixing.plan import MixingPlan
from lidar_synth.mixing.quotas import EpochSize, Mixture, PlannedSource
from lidar_synth.mixing.schedules import (
    Ratio,
    make_schedule,
    share_of,
    to_integer,
)
from lidar_synth.mixing.sources import agree, check_together, each, loss_weights_of
from lidar_synth.mixing.synthetic import make_synthetic
from lidar_synth.noise import keyed_rng

if TYPE_CHECKING:
    from lidar_synth.geometry.transfer import Transfer

log = logging.getLogger(__name__)

_LATEST: WeakValueDictionary[str, Any] = WeakValueDictionary()
"""{hash of the plan of epoch 0: the latest mixture with that plan}. It shows that a mixture is made
anew before each epoch, which repeats epoch 0."""


class MixedScans(Dataset[Any]):
    """A dataset of real scans mixed with synthetic ones at an exact ratio; real scans stay
    unchanged.

    The order of an epoch is a pure function of the arguments and the epoch (plan.py) and is already
    shuffled: iterate in order (a ``DataLoader`` without ``shuffle``), or use ``batches``, which
    also serves several ranks. Samplers that treat all positions alike work too (``RandomSampler``,
    ``DistributedSampler``); to hold scans out or weight them, split or weight the sources, as a
    position is another scan in every epoch. Call ``set_epoch`` before each epoch; otherwise the
    same scans are repeated, with a warning. ``set_epoch`` after ``iter(loader)`` raises an error;
    with ``batches`` it takes effect with the next pass.

    Args:
        real: indexable source of ``Scan``, or ``Sources`` of several; None with ratio 1.
        synth: a generator, a bank, a rolling bank, scans by index, or ``Sources`` of several.
        ratio: share of synthetic samples in [0, 1]: a number, a list or array with one for each
            epoch, ``{epoch: share}``, ``Linear(first, last, epochs)``, ``SyntheticFirst(epochs)``
            or a function of the epoch.
        labels: label policy of the synthetic scans: a policy of ``lidar_synth.labels`` such as
            ``PasteObjects(bank, count=8)``, a name of ``lidar_synth.labels.POLICIES``, ``{name:
            {argument: value}}``, or your own ``(scan, rng) -> scan``.
        loss_weight: weight of the synthetic samples in the loss, from 0 to 1: a number, or one by
            epoch as for ``ratio``. Items and batches have it as ``loss_weight``; ``Sources`` may
            have one for each source. Your training loop multiplies the losses by it.
        seed: of the order, of all random numbers of a sample, and of a generator's scans.
        epoch_size: the length of every epoch. ``"add"`` uses every real scan once and adds
            synthetic ones, as many as the largest ratio of a schedule needs; where the ratio is
            smaller, real scans are used more often, all equally over all epochs, so that a later
            epoch may use some twice and others never. ``"replace"`` has as many samples as there
            are real scans; a number is the length.
        reuse: number of epochs in which each synthetic scan is used, with different random
            augmentations.
        balanced: whether to spread synthetic samples evenly, so that every batch in the order of
            the plan holds its exact share (up to one sample if that is not a whole number).
        locality: ``"shard"`` uses the scans of a bank a few shards at a time, so that a bank in an
            object store can be streamed through a small cache; it is ``balanced`` then.
        augment: changes synthetic scans, after the label policy: ``(scan, rng) -> scan``, a name
            as in a ``Compose``, ``{name: {argument: value}}``, or a list of them.
        augment_real: whether to apply ``augment`` to real scans too; otherwise they stay unchanged,
            bit for bit.
        to_sample: ``(scan, rng) -> sample``; by default it makes the plain PyTorch item (items.py).
            The scan is a copy, which it and the trainer may change in place. If the sample is a
            dict with the key ``loss_weight``, the weight is written there; other samples are
            refused if a weight is not 1.
        collate: how ``collate`` makes a batch of items: ``"offsets"``, ``"padded"`` or ``"range"``
            (collate.py), or your own function.
        unlabelled: ``"error"`` refuses a batch without any valid label; ``"allow"`` returns it,
            which is always the case with ``labels="none"``.
        unboxed: what is done to objects without a box in synthetic scans with boxes: ``"close"``
            removes them and fills the holes, ``"keep"`` keeps them, from which a detector would
            learn that such objects are background, ``"error"`` refuses the scan; or your own
            ``(scan) -> scan``. A scan without boxes is not changed.
        as_sensor: turns every synthetic scan into one of this sensor, before the label policy and
            in the process that loads the sample: a ``Transfer``, a preset's name, a YAML file or a
            ``Sensor``. A bank of one sensor can thus be mixed with scans of another. Lost returns
            and noise are drawn anew at every position of an epoch. Real scans stay unchanged;
            ``SeenAs(real, transfer)`` turns those into scans of another sensor.
        real_as_is: whether real samples are returned unchanged, because they are not ``Scan`` but
            already have the trainer's form; see ``wrap``.
        compare: whether to refuse weights that samples have no key for, and with ``real_as_is`` to
            compare the first real sample with a synthetic one at construction; see
            ``check_alike``.

    Attributes:
        collate: the ``collate_fn``.
        mixture: the settings that determine the plan.
        real, synthetic: the sources, in the plan's order.
        synthetic_weight: the weight of synthetic samples in the loss by epoch.
        current: the current epoch, shared by all processes of this dataset.

    Raises:
        ConfigError: on a ratio outside [0, 1], sources of different sensors or classes, a policy
            that a source cannot support, or sizes that are impossible.
        DataError: without real scans, unless ratio is 1.

    Example:
        >>> from lidar_synth import Bank, MixedScans, open_scans
        >>> train = MixedScans(open_scans("demo_out/town"), Bank("demo_out/bank"), ratio=0.25)
        >>> len(train), sum(train.domain(i) for i in range(len(train)))  # three real, one synthetic
        (4, 1)
        >>> list(train[0])
        ['points', 'label', 'confidence', 'boxes', 'names', 'domain', 'loss_weight', 'id']
    """

    def __init__(
        self,
        real: Any,
        synth: Any = None,
        ratio: Ratio = 0.25,
        labels: Labels = "generated",
        seed: int = 0,
        *,
        loss_weight: Ratio = 1.0,
        epoch_size: EpochSize = "add",
        reuse: int = 1,
        balanced: bool = False,
        locality: Literal["shard"] | None = None,
        augment: Any = None,
        augment_real: bool = False,
        to_sample: ToSample = to_item,
        collate: Form | Callable[[Any], Any] = "offsets",
        unlabelled: Unlabelled = "error",
        unboxed: str | Callable[[Scan], Scan] = "close",
        as_sensor: "Transfer | Sensor | str | Path | None" = None,
        real_as_is: bool = False,
        compare: bool = True,
    ) -> None:
        reals = each(real)
        seed = to_integer(seed, "seed")
        if augment_real and real_as_is:
            raise ConfigError(
                "augment_real=True with wrap, which passes real samples on unchanged",
                "augment_real=False",
                "Augment real samples in your dataset.",
            )
        if isinstance(epoch_size, np.integer):
            epoch_size = to_integer(epoch_size, "epoch_size")
        if locality not in (None, "shard"):
            raise ConfigError(f"locality={locality!r}", '"shard", or None')
        for source, _ in reals:
            check_source(source, " Real scans come first, then synthetic ones.")
        synthetics = [
            (make_synthetic(source, seed), weight) for source, weight in each(synth)
        ]
        self.real = tuple(source for source, _ in reals)
        self.synthetic = tuple(source for source, _ in synthetics)
        self.synthetic_weight = make_weight(loss_weight)
        self._loss_weights = (*loss_weights_of(real), *loss_weights_of(synth))
        self._real_as_is = real_as_is
        transfer = make_transfer(as_sensor)
        self.mixture = Mixture(
            tuple(
                PlannedSource(len(source), weight, identity_of(source))
                for source, weight in reals
            ),
            tuple(
                _plan_synthetic(source, weight, transfer, bool(locality))
                for source, weight in synthetics
            ),
            make_schedule(ratio),
            seed,
            epoch_size,
            to_integer(reuse, "reuse"),
            balanced or locality is not None,
        )
        kept = () if real_as_is else self.real
        target = getattr(transfer, "target", None)
        sensors = check_together(
            (*kept, *self.synthetic),
            [None] * len(kept) + [target] * len(self.synthetic),
        )
        self._maker = SampleMaker(
            self.synthetic,
            None if real_as_is else real,
            transfer,
            labels,
            unboxed,
            augment,
            augment_real,
            to_sample,
            images=collate == "range",
        )
        if isinstance(collate, str):
            if self._maker.removes_labels:
                unlabelled = "allow"
            sensor = sensors[0] if sensors else None
            collate = Collate(collate, sensor, unlabelled)
        self.collate: Callable[[Any], Any] = collate
        self.current = CurrentEpoch(len(self))
        self._planned: MixingPlan | None = None
        # Whether this mixture continues an earlier one with the same plan; until set_epoch.
        self._continues = False
        self.set_epoch(0)
        self._continues = self._take_earlier()
        self._weighs = compare and (
            self.synthetic_weight != make_weight(1) or set(self._loss_weights) != {1}
        )
        if real_as_is and compare:
            check_alike(self.real, self.synthetic, self._maker.synthetic, self._weighs)

    def _take_earlier(self) -> bool:
        """Adopt the pass of the latest mixture with the same plan; whether there is one."""
        first = MixingPlan(self.mixture, 0)
        report_repeats(first)
        earlier = _LATEST.get(first.hash)
        if earlier is not None:
            self.current.take_pass(earlier.current)
        _LATEST[first.hash] = self
        return earlier is not None

    @classmethod
    def wrap(
        cls,
        dataset: Any,
        synth: Any,
        ratio: Ratio | None = None,
        *,
        to_sample: ToSample,
        epochs: int | None = None,
        collate: Callable[[Any], Any] = default_collate,
        **options: Any,
    ) -> "MixedScans":
        """Mix synthetic samples into a trainer's own map-style dataset.

        Its samples are passed on unchanged, with nothing added; ``domain(i)`` tells which samples
        are synthetic. Other attributes that the trainer reads from its dataset (class names, a
        collate function) come from the wrapped one.

        Args:
            dataset: has ``__len__`` and ``__getitem__``; or ``Sources`` of several.
            synth, ratio: as for ``MixedScans``.
            epochs: number of epochs of a segmenter's training, instead of ``ratio``; chooses the
                recipe of ``mix``.
            to_sample: ``(scan, rng) -> sample`` gives a synthetic scan the form of ``dataset``'s
                samples.
            collate: the trainer's own collate function.
            options: other arguments of ``MixedScans``. A label policy that draws from real scans
                needs them itself: ``labels=PolarMix(real=scans)``.

        Raises:
            ConfigError, DataError: as above; also where a synthetic sample does not have the form
                of a real one (keys, types, dtypes, ranks, the value of ignored labels), unless
                ``compare=False``.

        Example:
            >>> import torch
            >>> from lidar_synth import Bank, MixedScans, open_scans
            >>> mine = [torch.from_numpy(s.points) for s in open_scans("demo_out/town")]  # any data
            >>> def to_sample(scan, rng):
            ...     return torch.from_numpy(scan.points)
            >>> synth = Bank("demo_out/bank")
            >>> train = MixedScans.wrap(mine, synth, ratio=0.25, to_sample=to_sample)
            >>> [train[i].shape[1] for i in range(len(train))]
            [3, 3, 3, 3]
        """
        defaults: dict[str, Any] = {"ratio": 0.25 if ratio is None else ratio}
        if epochs is not None:
            # imported here, because it loads the modules that paste objects
            from lidar_synth.mixing.defaults import segmentation_options

            transfer = make_transfer(options.get("as_sensor"))
            alike = transfer is None or agree(
                Sensor.same_lasers, transfer.target, synth
            )
            defaults |= segmentation_options(dataset, epochs, ratio, alike)
        return cls(
            dataset,
            synth,
            to_sample=to_sample,
            collate=collate,
            real_as_is=True,
            **(defaults | options),
        )

    def __getattr__(self, name: str) -> Any:
        # Called only for missing attributes. Names with double underscores are protocols (copy,
        # __getitems__).
        state = self.__dict__
        if (
            name.startswith("__")
            or not state.get("_real_as_is")
            or len(state["real"]) != 1
        ):
            raise AttributeError(
                f"{type(self).__name__!r} object has no attribute {name!r}"
            )
        return getattr(state["real"][0], name)

    @property
    def seed(self) -> int:
        """The seed of the mixture."""
        return self.mixture.seed

    @property
    def epoch(self) -> int:
        """The epoch that indexing refers to."""
        return int(self.current)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, before a ``DataLoader`` begins to iterate; all its workers see it,
        persistent ones too.

        If a loader is already iterating, its next sample raises an error; a loader with ``batches``
        finishes the epoch in which it began.

        Raises:
            ConfigError: on an epoch for which there is no ratio or no weight.
        """
        MixingPlan(self.mixture, epoch)
        make_weight(self.synthetic_weight, epoch)  # raises without one
        if self._continues:
            self._continues = False
            self.current.forget_pass()
        self.current.set(epoch)
        if get_worker_info() is None:
            self.tell_sources(epoch)
            self.expect(epoch, range(len(self)))

    def tell_sources(self, epoch: int) -> None:
        """Set the epoch of the sources that have one, such as a ``RollingBank`` with ``refresh``
        or a trainer's own dataset; ``plan`` tells a worker's copies of real sources."""
        _tell(
            self.synthetic if get_worker_info() else self.real + self.synthetic, epoch
        )

    def plan(self, epoch: int | None = None) -> MixingPlan:
        """The plan of an epoch, by default the current one; the main process logs its hash once, a
        worker sets the epoch of its real sources."""
        epoch = self.epoch if epoch is None else epoch
        plan = self._planned  # read once: another thread may plan another epoch
        if plan is None or plan.epoch != epoch:
            self._planned = plan = MixingPlan(self.mixture, epoch)
            if get_worker_info() is None:
                log.info(
                    "epoch %d: %d samples, %d of them synthetic, plan %s",
                    epoch,
                    len(plan),
                    plan.synthetics,
                    plan.hash[:16],
                )
            else:
                _tell([s for s in self.real if not isinstance(s, MixedScans)], epoch)
        return plan

    def expect(self, epoch: int, positions: Iterable[int]) -> None:
        """Announce the next positions to synthetic sources that work ahead.

        Args:
            epoch: the epoch of the positions.
            positions: the positions in the order of their use; only the first ``AHEAD`` are
                announced.
        """
        if any(hasattr(source, "expect") for source in self.synthetic):
            plan = self.plan(epoch)
            upcoming = np.fromiter(islice(positions, AHEAD), np.int64)
            sources, indices = plan.at(upcoming)
            for number, source in enumerate(self.synthetic, plan.reals):
                if hasattr(source, "expect"):
                    source.expect(indices[sources == number].tolist())

    def __repr__(self) -> str:
        plan = MixingPlan(self.mixture, self.epoch)
        size = (
            f"{len(plan)} samples in epoch {self.epoch}, {plan.synthetics} of them synthetic; "
            f"seed {self.seed}"
        )
        kinds = [
            ", ".join(type(source).__name__ for source in kind)
            for kind in (self.real, self.synthetic)
        ]
        return (
            f"{type(self).__name__}: {size}\n  real: {kinds[0] or 'none'}; synthetic: "
            f"{kinds[1] or 'none'}"
        )

    def __len__(self) -> int:
        return self.mixture.length

    def __getitem__(self, index: int) -> Any:
        return self.sample(self.epoch_of(index), index_of(index, len(self)))

    def domain(self, index: int) -> int:
        """The domain of the sample at ``index`` in the current epoch: 0 = real, 1 = synthetic.

        Example:
            >>> from lidar_synth import Bank, MixedScans, open_scans
            >>> train = MixedScans(open_scans("demo_out/town"), Bank("demo_out/bank"), ratio=0.5)
            >>> domains = [train.domain(i) for i in range(len(train))]
            >>> domains.count(0), domains.count(1)
            (3, 3)
        """
        plan, position = self._planned_at(index)
        return SYNTHETIC if plan[position][0] >= plan.reals else REAL

    def loss_weight(self, index: int) -> float:
        """The weight in the loss of the sample at ``index`` in the current epoch.

        Example:
            >>> from lidar_synth import Bank, MixedScans, open_scans
            >>> train = MixedScans(
            ...     open_scans("demo_out/town"), Bank("demo_out/bank"), ratio=0.5, loss_weight=0.1
            ... )
            >>> sorted(train.loss_weight(i) for i in range(len(train)))
            [0.1, 0.1, 0.1, 1.0, 1.0, 1.0]
        """
        return self._weight_of(*self._planned_at(index))

    def _planned_at(self, index: int) -> tuple[MixingPlan, int]:
        """The plan and the position in it of an index, which may count from the end."""
        plan = self.plan(index.epoch if isinstance(index, Position) else None)
        return plan, index_of(index, len(plan))

    def _weight_of(self, plan: MixingPlan, position: int) -> float:
        source = plan[position][0]
        weight = float(self._loss_weights[source])
        if source < plan.reals:
            return weight
        return weight * float(share_of(self.synthetic_weight, plan.epoch))

    def _with_weight(self, sample: Any, plan: MixingPlan, position: int) -> Any:
        """The sample, with its loss weight if it is a dict with that key.

        Raises:
            ConfigError: if the mixture has loss weights and the sample has no such key.
        """
        if isinstance(sample, dict) and "loss_weight" in sample:
            sample["loss_weight"] = self._weight_of(plan, position)
        elif self._weighs:
            raise weightless()
        return sample

    def epoch_of(self, index: int) -> int:
        """The epoch of an index that is being fetched: the one in which iteration began.

        This is for callers that make scans elsewhere, such as in the main process on a GPU.

        Raises:
            ConfigError: if another epoch was set since.
        """
        return self.current.of(index)

    def sample(self, epoch: int, position: int) -> Any:
        """The sample at a position of an epoch, 0 <= position < length; ``self[i]`` is
        ``sample(epoch, i)``."""
        plan = self.plan(epoch)
        source, index = plan[position]
        if source >= plan.reals:
            return self.finish(
                self.synthetic[source - plan.reals][index], epoch, position
            )
        scans = self.real[source]
        if isinstance(scans, MixedScans):  # all workers share its epoch
            index = Position(index, epoch)
        real = scans[index]
        if self._real_as_is:
            return real
        rng = keyed_rng(self.seed, epoch, position)
        return self._with_weight(self._maker.real(real, rng), plan, position)

    def finish(self, scan: Scan, epoch: int, position: int) -> Any:
        """Make the sample of a synthetic scan at its position: sensor, label policy, augmentation,
        ``to_sample``.

        This is for callers that make the scan elsewhere, such as in the main process on a GPU.
        """
        plan = self.plan(epoch)
        rng = keyed_rng(self.seed, epoch, position)
        source = plan[position][0] - plan.reals
        return self._with_weight(
            self._maker.synthetic(source, scan, rng), plan, position
        )

    def batches(
        self,
        batch_size: int,
        *,
        rank: int | None = None,
        world_size: int | None = None,
        drop_last: bool = False,
    ) -> MixedBatches:
        """Make a ``batch_sampler`` in the order of the plan, for one rank or several; see
        ``MixedBatches``.

        Example:
            >>> from torch.utils.data import DataLoader
            >>> from lidar_synth import Bank, MixedScans, open_scans
            >>> real, synth = open_scans("demo_out/town"), Bank("demo_out/bank")
            >>> train = MixedScans(real, synth, ratio=0.5, balanced=True)
            >>> loader = DataLoader(train, batch_sampler=train.batches(2), collate_fn=train.collate)
            >>> [sorted(batch["domain"].tolist()) for batch in loader]
            [[0, 1], [0, 1], [0, 1]]
        """
        return MixedBatches(
            self, batch_size, rank=rank, world_size=world_size, drop_last=drop_last
        )

    def loader(
        self, batch_size: int, num_workers: int = 0, **options: Any
    ) -> MixedLoader:
        """Make a ``DataLoader`` that sets its own epoch and can resume; see ``MixedLoader``.

        Args:
            batch_size: number of samples in a batch, on each rank.
            num_workers: number of worker processes; where they are spawned (macOS, Windows,
                Python 3.14), a script does this below ``if __name__ == "__main__":``.
            options: further arguments of ``DataLoader``.

        Example:
            >>> from lidar_synth import Bank, MixedScans, open_scans
            >>> train = MixedScans(open_scans("demo_out/town"), Bank("demo_out/bank"), ratio=0.25)
            >>> loader = train.loader(batch_size=2)
            >>> for epoch in range(2):
            ...     for batch in loader:
            ...         state = loader.state_dict()
            >>> state["epoch"], state["position"]  # after the last batch of epoch 1
            (2, 0)
        """
        return MixedLoader(self, batch_size, num_workers, **options)


def _tell(sources: Iterable[Any], epoch: int) -> None:
    for source in sources:
        if hasattr(source, "set_epoch"):
            source.set_epoch(epoch)


def _plan_synthetic(
    source: Any, weight: float | None, transfer: "Transfer | None", by_shard: bool
) -> PlannedSource:
    """The properties of a synthetic source that determine the plan."""
    suffix = "" if transfer is None else f" as {transfer.identity}"
    return PlannedSource(
        source.length,
        weight,
        source.identity + suffix,
        getattr(source, "shard_size", 1) if by_shard else 1,
    )
