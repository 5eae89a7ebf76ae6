"""The epoch that is set or resumed is loaded, whatever loads it; its length is the same under every
schedule."""

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from mixtures import Endless, Scans
from torch.utils.data import ConcatDataset, DataLoader, DistributedSampler

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import Linear, MixedScans, MixedStream
from lidar_synth.mixing.state import make_state

pytestmark = pytest.mark.filterwarnings("ignore")

SCHEDULES = {"rising": Linear(0.1, 0.5, 8), "falling": Linear(0.5, 0.1, 8)}
STARTS = {"fresh": (0, 0), "from epoch 5": (5, 0), "resumed": (6, 8)}
WORKERS = [
    pytest.param({"num_workers": 0}, id="0 workers"),
    pytest.param({"num_workers": 2}, id="2 workers", marks=pytest.mark.slow),
    pytest.param(
        {"num_workers": 2, "persistent_workers": True},
        id="2 that persist",
        marks=pytest.mark.slow,
    ),
]
SCHEDULED = pytest.mark.parametrize("schedule", SCHEDULES)
STARTED = pytest.mark.parametrize("start", STARTS)
STARTED_WHOLE = pytest.mark.parametrize("start", ["fresh", "from epoch 5"])
WORKED = pytest.mark.parametrize("workers", WORKERS)
FORMS = pytest.mark.parametrize("form", ["map", "stream"])


def number(scan: Scan, rng: Any) -> torch.Tensor:
    """Of a scan, negative for synthetic ones."""
    own = int(scan.id[1:])
    return torch.tensor(-1 - own if scan.domain else own)


def mixed(schedule: str) -> MixedScans:
    """20 samples an epoch."""
    real = Scans("r", 10)
    return MixedScans(
        real, Endless(), SCHEDULES[schedule], to_sample=number, collate=torch.stack
    )


def planned(train: MixedScans, epoch: int, start: int = 0) -> list[int]:
    made = train.plan(epoch)
    both = zip(made.domain.tolist(), made.index.tolist(), strict=True)
    return [-1 - i if d else i for d, i in both][start:]


def read(batches: Any) -> list[int]:
    return [int(x) for batch in batches for x in batch]


def make_loader(
    train: MixedScans, form: str, kind: Any = DataLoader, **workers: Any
) -> Any:
    if form == "stream":
        stream = MixedStream(train, batch_size=4, endless=False)
        return kind(stream, 4, **workers)
    return kind(
        train, batch_sampler=train.batches(4), collate_fn=train.collate, **workers
    )


def begin(train: MixedScans, loader: DataLoader[Any], start: str) -> None:
    """As a training script does: it sets the first epoch or loads a state."""
    epoch, position = STARTS[start]
    if position:
        order: Any = (
            loader.dataset
            if isinstance(loader.dataset, MixedStream)
            else loader.batch_sampler
        )
        order.load_state_dict(make_state(train.mixture, epoch, position))
    elif epoch:
        train.set_epoch(epoch)


def check_passes(
    train: MixedScans, loader: Any, start: str, ordered: bool = True
) -> None:
    """The rest of the first epoch, and two whole ones."""
    first, position = STARTS[start]
    for epoch in range(first, first + 3):
        if epoch > first:
            train.set_epoch(epoch)
        expected = planned(train, epoch, position if epoch == first else 0)
        found = read(loader)
        assert found == expected if ordered else sorted(found) == sorted(expected)


@SCHEDULED
@STARTED
@FORMS
@WORKED
def test_a_data_loader(
    workers: dict[str, Any], form: str, start: str, schedule: str
) -> None:
    train = mixed(schedule)
    loader = make_loader(train, form, **workers)
    begin(train, loader, start)
    check_passes(train, loader, start)


def make_shards(train: MixedScans, kind: Any, **workers: Any) -> list[Any]:
    """Loaders of two ranks by torch's own sampler."""
    samplers = [DistributedSampler(train, 2, rank) for rank in range(2)]
    return [
        kind(train, 4, sampler=s, collate_fn=train.collate, **workers) for s in samplers
    ]


def make_chained(train: MixedScans, kind: Any, **workers: Any) -> list[Any]:
    """A loader of a mixture and three samples more."""
    both: Any = ConcatDataset([train, [torch.tensor(1000)] * 3])
    return [kind(both, 4, shuffle=True, collate_fn=train.collate, **workers)]


def set_epochs(train: MixedScans, loaders: list[Any], epoch: int) -> None:
    """As a training script does that uses torch's sampler."""
    train.set_epoch(epoch)
    for loader in loaders:
        if isinstance(loader.sampler, DistributedSampler):
            loader.sampler.set_epoch(epoch)


@SCHEDULED
@STARTED
@WORKED
@pytest.mark.parametrize("make", [make_shards, make_chained])
def test_torchs_own_sampler_and_concatenation(
    make: Callable[..., list[Any]], workers: dict[str, Any], start: str, schedule: str
) -> None:
    """Made once; resumed, as ``StatefulDataLoader`` does by the batches that it has yielded."""
    kind: Any = DataLoader
    first, position = STARTS[start]
    seen: list[int] = []
    states = []
    if position:
        kind = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader
        stopped = mixed(schedule)
        before = make(stopped, kind, **workers)
        set_epochs(stopped, before, first)
        for loader in before:
            seen += read(islice(loader, 1))
            states.append(loader.state_dict())
    train = mixed(schedule)
    loaders = make(train, kind, **workers)
    more = [1000] * 3 if make is make_chained else []
    for epoch in range(first, first + 3):
        set_epochs(train, loaders, epoch)
        for loader in loaders:
            if states:
                loader.load_state_dict(states.pop(0))
            seen += read(loader)
        assert sorted(seen) == sorted(planned(train, epoch)) + more
        seen = []


def test_a_stream_is_in_no_sampler_and_no_concatenation() -> None:
    """torch refuses them: a stream is divided among ranks by itself."""
    stream: Any = MixedStream(mixed("rising"), batch_size=4, endless=False)
    with pytest.raises(ValueError, match="expected unspecified sampler"):
        DataLoader(stream, 4, sampler=DistributedSampler(stream, 2, 0))
    with pytest.raises(
        AssertionError, match="ConcatDataset does not support IterableDataset"
    ):
        ConcatDataset([stream, mixed("rising")])
    endless: Any = MixedStream(mixed("rising"), batch_size=4)
    with pytest.raises(TypeError, match="endless=False"):
        DistributedSampler(endless, 2, 0)


@pytest.fixture
def accelerator() -> Iterator[Any]:
    accelerate = pytest.importorskip("accelerate")
    yield accelerate.Accelerator(cpu=True)
    accelerate.state.AcceleratorState._reset_state(True)


@SCHEDULED
@STARTED
@FORMS
@WORKED
def test_accelerate(
    accelerator: Any, workers: dict[str, Any], form: str, start: str, schedule: str
) -> None:
    from lidar_synth.integrations.accelerate import prepare

    train = mixed(schedule)
    loader = make_loader(train, form, **workers)
    begin(train, loader, start)
    check_passes(train, prepare(accelerator, loader), start)


@SCHEDULED
@STARTED
@FORMS
@WORKED
def test_a_stateful_data_loader(
    workers: dict[str, Any], form: str, start: str, schedule: str
) -> None:
    """Of torchdata, whose state within an epoch another loader takes."""
    kind = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader
    train = mixed(schedule)
    loader = make_loader(train, form, kind, **workers)
    epoch, position = STARTS[start]
    train.set_epoch(epoch)
    if position:
        seen = read(islice(loader, position // 4))
        assert seen == planned(train, epoch)[:position]
        state = loader.state_dict()
        train = mixed(schedule)
        loader = make_loader(train, form, kind, **workers)
        train.set_epoch(epoch)
        loader.load_state_dict(state)
    check_passes(train, loader, start)


@pytest.fixture
def fit(tmp_path: Path) -> Any:
    """Trains for three epochs by Lightning, with the options of ``Trainer.fit``; a ``KeyError``
    writes a checkpoint."""
    lightning = pytest.importorskip("lightning")

    def train(model: Any, data: Any, **options: Any) -> None:
        saving = lightning.pytorch.callbacks.OnExceptionCheckpoint(tmp_path, "last")
        lightning.Trainer(
            max_epochs=3,
            accelerator="cpu",
            logger=False,
            default_root_dir=tmp_path,
            callbacks=[saving],
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
        ).fit(model, data, **options)

    return train


def make_model(
    stop: tuple[int, int] = (9, 9), begin: Callable[[int], None] = print
) -> Any:
    """A Lightning module that keeps what it has seen.

    Args:
        stop: epoch and number of the batch at which it raises ``KeyError``.
        begin: called with the number of an epoch when it begins.
    """
    lightning = pytest.importorskip("lightning")

    class Model(lightning.LightningModule):  # type: ignore[name-defined, misc]
        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(1))
            self.seen: list[int] = []

        def on_train_epoch_start(self) -> None:
            begin(self.current_epoch)

        def training_step(self, batch: Any, index: int) -> Any:
            if (self.current_epoch, index) == stop:
                raise KeyError
            self.seen += batch.tolist()
            return self.weight.sum()

        def configure_optimizers(self) -> Any:
            return torch.optim.SGD(self.parameters(), 0.1)

    return Model()


@SCHEDULED
@STARTED
@WORKED
def test_lightning(
    fit: Any, workers: dict[str, Any], start: str, schedule: str, tmp_path: Path
) -> None:
    """A run from epoch 5 on that stops in its second epoch and resumes, or that does not stop."""
    from lidar_synth.integrations.lightning import MixedData

    def make_data() -> Any:
        return MixedData(train, batch_size=4, num_workers=workers["num_workers"])

    train = mixed(schedule)
    first = 0 if start == "fresh" else 5
    train.set_epoch(first)
    seen = []
    options = {}
    if start == "resumed":
        stopped = make_model((1, 2))
        with pytest.raises(KeyError):
            fit(stopped, make_data())
        seen += stopped.seen
        train = mixed(schedule)
        options = {"ckpt_path": tmp_path / "last.ckpt"}
    model = make_model()
    fit(model, make_data(), **options)
    assert seen + model.seen == [
        x for e in range(first, first + 3) for x in planned(train, e)
    ]


@SCHEDULED
@STARTED_WHOLE
@WORKED
def test_lightning_with_a_stream(
    fit: Any, workers: dict[str, Any], start: str, schedule: str
) -> None:
    """A loader of a stream whose epoch the user's module sets; ``MixedData`` asks for its scans."""
    from lidar_synth.integrations.lightning import MixedData

    train = mixed(schedule)
    stream = MixedStream(train, batch_size=4, endless=False)
    with pytest.raises(
        ConfigError, match=r"train=MixedStream.*MixedData\(stream.scans\)"
    ):
        MixedData(stream)  # type: ignore[arg-type]
    first, _ = STARTS[start]
    train.set_epoch(first)
    model = make_model(begin=lambda epoch: stream.set_epoch(first + epoch))
    fit(model, DataLoader(stream, 4, **workers))
    assert model.seen == [x for e in range(first, first + 3) for x in planned(train, e)]
