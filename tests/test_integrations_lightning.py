"""The Lightning data module in Lightning's own trainer; skipped where it is not installed."""

from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("lightning", reason="lightning is not installed")

import lidar_synth.integrations.lightning as module
import lightning
import torch
from mixtures import Endless, Scans

from lidar_synth.errors import ConfigError
from lidar_synth.mixing import Generated, MixedScans

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


def fit(data: Any, epochs: int = 2, checkpoint: Any = None) -> Model:
    model = Model()
    trainer = lightning.Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, use_distributed_sampler=False, num_sanity_val_steps=0,
    )  # fmt: skip
    trainer.fit(model, data, ckpt_path=checkpoint)
    return model


@pytest.mark.parametrize("workers", [0, 2])
def test_two_epochs_see_exactly_the_planned_scans(workers: int) -> None:
    mixed = MixedScans(Scans("r", REAL), Endless(), ratio=0.25, seed=1)
    data = module.MixedData(mixed, val=Scans("v", 4), batch_size=4, num_workers=workers)
    model = fit(data)
    for epoch in (0, 1):
        made = mixed.plan(epoch)
        seen = [(domain, name) for e, domain, name in model.seen if e == epoch]
        assert Counter(d for d, _ in seen) == {0: REAL, 1: 3}
        wanted = [f"{'s' if d else 'r'}{i}" for d, i in zip(made.domain, made.index, strict=True)]
        assert [name for _, name in seen] == wanted
    assert model.validated == 8


class OfNumbers(Generated):
    """A generator of the tests' scans that counts how it is asked."""

    def __init__(self) -> None:
        self.source, self.asked = Endless(), list[list[int]]()

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
    model = fit(module.MixedData(mixed, batch_size=4, num_workers=workers, on_device=True))
    again = fit(module.MixedData(MixedScans(Scans("r", REAL), Endless(), ratio=0.5, seed=1), batch_size=4))
    assert model.seen == again.seen
    assert max(map(len, made.asked)) > 1  # several at once


def test_what_cannot_be_made_on_the_device_is_refused() -> None:
    mixed = MixedScans(Scans("r", REAL), Endless())
    with pytest.raises(ConfigError, match="on_device with .'Endless'."):
        module.MixedData(mixed, on_device=True)


def test_a_checkpoint_of_another_mixture_is_refused() -> None:
    data = module.MixedData(MixedScans(Scans("r", REAL), Endless(), seed=1))
    data.load_state_dict(data.state_dict())
    with pytest.raises(ConfigError, match="seed 2"):
        data.load_state_dict({"seed": 2})


@pytest.mark.parametrize("version", module.STOLEN)
def test_releases_that_steal_are_refused(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib
    import sys

    from lidar_synth.errors import LibraryError

    monkeypatch.setitem(sys.modules, "lightning", SimpleNamespace(__version__=version))
    monkeypatch.delitem(sys.modules, "lidar_synth.integrations.lightning")
    with pytest.raises(LibraryError, match="change your passwords"):
        importlib.import_module("lidar_synth.integrations.lightning")
