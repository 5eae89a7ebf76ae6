"""The Lightning data module in Lightning's own trainer; skipped where it is not installed."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("lightning", reason="lightning is not installed")

import lidar_synth.integrations.lightning as module
import lightning
import torch
from mixtures import Endless, Scans
from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.generator import Generated
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.state import make_state

REAL = 9


class Model(lightning.LightningModule):  # type: ignore[misc, name-defined]
    """Notes what it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[tuple[int, int, str]] = []
        self.validated = 0

    def training_step(self, batch: Any, index: int) -> Any:
        pairs = zip(batch["domain"].tolist(), batch["id"], strict=True)
        self.seen += [(self.current_epoch, domain, name) for domain, name in pairs]
        return self.weight.sum()

    def validation_step(self, batch: Any, index: int) -> None:
        self.validated += len(batch["id"])

    def configure_optimizers(self) -> Any:
        return torch.optim.SGD(self.parameters(), 0.1)


def fit(data: Any, epochs: int = 2, checkpoint: Any = None, **options: Any) -> Model:
    model = Model()
    trainer = lightning.Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        num_sanity_val_steps=0,
        **options,
    )
    trainer.fit(model, data, ckpt_path=checkpoint)
    return model


def test_two_epochs_see_exactly_the_planned_scans() -> None:
    mixed = MixedScans(Scans("r", REAL), Endless(), ratio=0.25, seed=1)
    data = module.MixedData(mixed, val=Scans("v", 4), batch_size=4)
    model = fit(data)
    for epoch in (0, 1):
        made = mixed.plan(epoch)
        seen = [(domain, name) for e, domain, name in model.seen if e == epoch]
        assert Counter(d for d, _ in seen) == {0: REAL, 1: 3}
        wanted = [
            f"{'s' if d else 'r'}{i}"
            for d, i in zip(made.domain, made.index, strict=True)
        ]
        assert [name for _, name in seen] == wanted
    assert model.validated == 8


def test_scans_of_validation_need_no_labels() -> None:
    blank = [replace(scan, label=None) for scan in Scans("v", 4)]
    mixed = MixedScans(Scans("r", REAL), Endless(), ratio=0.25, collate="padded")
    model = fit(module.MixedData(mixed, val=blank, batch_size=2), epochs=1)
    assert model.validated == 4


def as_pair(scan: Any, rng: Any) -> Any:
    scan.points += 1  # its own copy
    return torch.full((8, 8), scan.points.max()), torch.full((8, 8), len(scan))


def in_pairs(items: Any) -> Any:
    first, second = zip(*items, strict=True)
    return {"first": torch.stack(first), "second": torch.stack(second)}


class Wrapped:
    """A trainer's own dataset of pairs."""

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: int) -> Any:
        return torch.full((8, 8), float(index)), torch.ones(8, 8, dtype=torch.int64)


def test_batches_of_validation_have_the_form_of_the_training() -> None:
    held_out = Scans("v", 3)
    options: dict[str, Any] = {"to_sample": as_pair, "collate": in_pairs}
    data = module.MixedData(
        MixedScans(Scans("r", REAL), Endless(), **options), val=held_out, batch_size=3
    )
    for _ in range(2):
        [batch] = data.val_dataloader()
        assert batch["second"][:, 0, 0].tolist() == [len(scan) for scan in held_out]
        tops = [float(scan.points.max()) + 1 for scan in held_out]
        assert batch["first"][:, 0, 0].tolist() == pytest.approx(tops)
    wrapped = MixedScans.wrap(Wrapped(), Endless(), **options)
    [batch] = module.MixedData(wrapped, test=Wrapped(), batch_size=3).test_dataloader()
    assert batch["first"][:, 0, 0].tolist() == [0, 1, 2]


def test_scans_of_validation_are_real_and_finite_as_in_training() -> None:
    train = MixedScans(Scans("r", 3), Endless())
    town = Scans("v", 3, domain=1)
    data = module.MixedData(train, val=town, test=town, batch_size=3)
    [batch] = data.val_dataloader()
    assert batch["domain"].tolist() == [0, 0, 0] and town[0].domain == 1
    town[1].points[0] = float("nan")
    with pytest.raises(DataError, match="'v1' with points that are NaN"):
        list(data.test_dataloader())


def test_mixtures_are_for_training_alone() -> None:
    train = MixedScans(Scans("r", 3), Endless())
    held = MixedScans(Scans("v", 3), ratio=0)
    for name in ("val", "test"):
        with pytest.raises(ConfigError, match="expected the real scans themselves"):
            module.MixedData(train, **{name: held})


def test_batches_that_are_overfitted_stay_the_same() -> None:
    mixed = MixedScans(Scans("r", REAL), Endless(), ratio=0.25, seed=1)
    model = fit(module.MixedData(mixed, batch_size=4), overfit_batches=2)
    first, second = (
        [name for e, _, name in model.seen if e == epoch] for epoch in (0, 1)
    )
    assert first == second and len(first) == 8


class OfNumbers(Generated):
    """A generator of the tests' scans that counts how it is asked."""

    def __init__(self) -> None:
        self.source = Endless()
        self.asked = list[list[int]]()

    sensor = Endless.sensor
    fields = frozenset(("reflectance", "label", "confidence"))
    identity = "of numbers"

    def __getitem__(self, number: int) -> Any:
        raise AssertionError("asked one by one")

    def scans(self, numbers: Any) -> Any:
        self.asked.append(list(numbers))
        return [self.source[n] for n in numbers]


@pytest.mark.parametrize("workers", [0, 2])
def test_synthesis_after_the_transfer_gives_the_same_batches(workers: int) -> None:
    made = OfNumbers()
    mixed = MixedScans(Scans("r", REAL), made, ratio=0.5, seed=1)
    model = fit(
        module.MixedData(mixed, batch_size=4, num_workers=workers, on_device=True)
    )
    again = fit(
        module.MixedData(
            MixedScans(Scans("r", REAL), Endless(), ratio=0.5, seed=1), batch_size=4
        )
    )
    assert model.seen == again.seen
    assert max(map(len, made.asked)) > 1  # several at once


class Pairs(Model):
    """Is given (input, target) as PyTorch's own collate function makes them, a list."""

    def training_step(self, batch: Any, index: int) -> Any:
        x, y = batch
        assert (
            x.dtype == torch.float32
            and y.dtype == torch.int64
            and x.shape == y.shape == (4, 8, 8)
        )
        self.validated += 1
        return self.weight.sum()


def test_batches_of_pairs_are_passed_on(tmp_path: Path) -> None:
    def pair(scan: Any, rng: Any) -> Any:
        return torch.zeros(8, 8), torch.ones(8, 8, dtype=torch.int64)

    mixed = MixedScans.wrap(
        [pair(None, None)] * REAL, Endless(), ratio=0.25, to_sample=pair
    )
    model = Pairs()
    trainer(tmp_path, 1).fit(model, module.MixedData(mixed, batch_size=4))
    assert model.validated == 3


@pytest.mark.parametrize(
    "options",
    [{"fast_dev_run": True}, {"limit_train_batches": 1}, {"overfit_batches": 1}],
)
def test_one_batch_is_no_epoch_that_grows(
    options: dict[str, Any], tmp_path: Path
) -> None:
    model = Model()
    data = module.MixedData(
        MixedScans(Scans("r", REAL), Endless(), ratio=0.25, seed=1), batch_size=4
    )
    trainer(tmp_path, 1, **options).fit(model, data)
    assert len(model.seen) == 4


def test_on_device_refuses_sources_that_are_not_generators() -> None:
    mixed = MixedScans(Scans("r", REAL), Endless())
    with pytest.raises(ConfigError, match="on_device with .'Endless'."):
        module.MixedData(mixed, on_device=True)


def test_a_checkpoint_of_another_mixture_is_refused() -> None:
    data = module.MixedData(MixedScans(Scans("r", REAL), Endless(), seed=1))
    data.load_state_dict(data.state_dict())
    with pytest.raises(ConfigError, match="seed 2, here 1"):
        data.load_state_dict(make_state(replace(data.train.mixture, seed=2), 0, 0))
    with pytest.raises(ConfigError, match="the hash of the plan"):
        data.load_state_dict({"seed": 1})
    with pytest.raises(ConfigError, match="ratio 1/4, here 1/2"):
        module.MixedData(
            MixedScans(Scans("r", REAL), Endless(), 0.5, seed=1)
        ).load_state_dict(data.state_dict())


class Stop(Exception):
    """A run that is interrupted."""


class Stopping(Model):
    """Is interrupted in the training step of a batch."""

    def __init__(self, epoch: int, batch: int) -> None:
        super().__init__()
        self.stop = (epoch, batch)

    def training_step(self, batch: Any, index: int) -> Any:
        if (self.current_epoch, index) == self.stop:
            raise Stop
        return super().training_step(batch, index)


def trainer(root: Path, epochs: int = 3, **options: Any) -> Any:
    return lightning.Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        default_root_dir=root,
        enable_model_summary=False,
        use_distributed_sampler=False,
        num_sanity_val_steps=0,
        **options,
    )


@pytest.mark.parametrize("how", ["step", "exception", "epoch"])
@pytest.mark.parametrize(("workers", "limit"), [(0, 1.0), (2, 1.0), (0, 3)])
def test_a_checkpoint_resumes_after_its_last_batch(
    workers: int, limit: float, how: str, tmp_path: Path
) -> None:
    """Taken after a training step, on an exception in the next one, or at an epoch's end, also if
    Lightning limits the batches of an epoch."""
    callbacks = lightning.pytorch.callbacks
    callback = {
        "step": callbacks.ModelCheckpoint(
            tmp_path, "step", every_n_train_steps=1, save_top_k=1, monitor=None
        ),
        "exception": callbacks.OnExceptionCheckpoint(tmp_path, "exception"),
        "epoch": callbacks.ModelCheckpoint(tmp_path, "epoch"),
    }[how]

    def data() -> Any:
        mixed = MixedScans(Scans("r", 10), Endless(), ratio=0.25, seed=1)  # 14 samples
        return module.MixedData(mixed, batch_size=3, num_workers=workers)

    silent = {"enable_checkpointing": False, "limit_train_batches": limit}
    whole = Model()
    trainer(tmp_path, **silent).fit(whole, data())
    first = Stopping(1, 2)
    with pytest.raises(Stop):
        trainer(tmp_path, callbacks=[callback], limit_train_batches=limit).fit(
            first, data()
        )
    rest = Model()
    trainer(tmp_path, **silent).fit(rest, data(), ckpt_path=tmp_path / f"{how}.ckpt")
    kept = [sample for sample in first.seen if how != "epoch" or sample[0] == 0]
    assert kept + rest.seen == whole.seen


def test_a_loader_resumes_within_an_epoch_and_later_epochs_are_whole(
    tmp_path: Path,
) -> None:
    def loader() -> Any:
        return MixedScans(Scans("r", 10), Endless(), ratio=0.25).loader(3)

    whole = Model()
    trainer(tmp_path, enable_checkpointing=False).fit(whole, loader())
    saving = lightning.pytorch.callbacks.ModelCheckpoint(
        tmp_path, "step", every_n_train_steps=1
    )
    first = Stopping(1, 3)
    with pytest.raises(Stop):
        trainer(tmp_path, callbacks=[saving]).fit(first, loader())
    rest = Model()
    trainer(tmp_path, enable_checkpointing=False).fit(
        rest, loader(), ckpt_path=tmp_path / "step.ckpt"
    )
    assert first.seen + rest.seen == whole.seen


def test_a_checkpoint_within_an_epoch_needs_steps_of_its_size() -> None:
    data = module.MixedData(MixedScans(Scans("r", REAL), Endless()), batch_size=2)
    state = make_state(data.train.mixture, 0, 4) | {"step": 4}
    data.load_state_dict(state)
    with pytest.raises(
        ConfigError,
        match="4 samples a step, for 2 a step.*from the end of an epoch fits any",
    ):
        data.train_dataloader()
    data.load_state_dict(make_state(data.train.mixture, 1, 0) | {"step": 4})
    data.train_dataloader()


class Shared(Model):
    """Two processes that gather what they were given."""

    def __init__(self, out: Path) -> None:
        super().__init__()
        self.out = out

    def on_train_epoch_end(self) -> None:
        path = self.out / f"{self.current_epoch}-{self.global_rank}.txt"
        path.write_text(
            "\n".join(
                name for epoch, _, name in self.seen if epoch == self.current_epoch
            )
        )

    def validation_step(self, batch: Any, index: int) -> None:
        with (self.out / f"val-{self.global_rank}.txt").open("a") as file:
            print(*batch["id"], file=file)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("own", [True, False])
def test_two_processes_see_every_sample(own: bool, tmp_path: Path) -> None:
    """With the module's own sharing, and with Lightning's ``DistributedSampler`` over a plain
    loader."""
    mixed = MixedScans(Scans("r", 10), Endless(), ratio=0.25, seed=1)
    data: Any = (
        module.MixedData(mixed, val=Scans("v", 3), batch_size=3)
        if own
        else DataLoader(mixed, 3, collate_fn=mixed.collate)
    )
    lightning.Trainer(
        max_epochs=2,
        accelerator="cpu",
        devices=2,
        strategy="ddp_fork",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        check_val_every_n_epoch=2,
        use_distributed_sampler=not own,
    ).fit(Shared(tmp_path), data)
    for epoch in (0, 1):
        seen = [
            name
            for rank in (0, 1)
            for name in (tmp_path / f"{epoch}-{rank}.txt").read_text().split()
        ]
        made = mixed.plan(epoch if own else 0)  # nobody tells a plain dataset the epoch
        wanted = [
            f"{'s' if d else 'r'}{i}"
            for d, i in zip(made.domain, made.index, strict=True)
        ]
        assert sorted(seen) == sorted(wanted)
    if own:  # the share of each is as long as that of the other
        shares = [(tmp_path / f"val-{rank}.txt").read_text().split() for rank in (0, 1)]
        assert shares == [["v0", "v2"], ["v1", "v0"]]


@pytest.mark.filterwarnings("ignore")
def test_lightning_does_not_share_once_more(tmp_path: Path) -> None:
    data = module.MixedData(MixedScans(Scans("r", 10), Endless()), batch_size=3)
    both = lightning.Trainer(
        max_epochs=1,
        accelerator="cpu",
        devices=2,
        strategy="ddp_fork",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    with pytest.raises(Exception, match="use_distributed_sampler=False"):
        both.fit(Model(), data)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("own", [True, False])
def test_loaders_that_are_shared_once_more_are_refused(own: bool) -> None:
    train = MixedScans(Scans("r", 10), Endless())
    loader: Any = (
        train.loader(2) if own else DataLoader(train, batch_sampler=train.batches(2))
    )
    fabric = lightning.Fabric(accelerator="cpu", devices=2, strategy="ddp_fork")
    with pytest.raises(Exception, match="expected .*use_distributed_sampler=False"):
        fabric.launch(lambda fabric: fabric.setup_dataloaders(loader))


@pytest.mark.parametrize("version", module.STOLEN)
def test_releases_that_steal_are_refused(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import importlib
    import sys

    from lidar_synth.errors import LibraryError

    monkeypatch.setitem(sys.modules, "lightning", SimpleNamespace(__version__=version))
    monkeypatch.delitem(sys.modules, "lidar_synth.integrations.lightning")
    with pytest.raises(LibraryError, match="change your passwords"):
        importlib.import_module("lidar_synth.integrations.lightning")
