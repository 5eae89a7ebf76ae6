"""A user's Lightning script: a small segmenter on a mixture of SemanticKITTI and a bank, validated on sequence 08.

Prints a line for each training sample, so that a resumed run can be compared with an uninterrupted one.
"""

import argparse
from pathlib import Path
from typing import Any

import lightning
import torch
from lidar_synth.integrations.lightning import MixedData
from torch import nn

from lidar_synth import Bank, MixedScans
from lidar_synth.formats import SemanticKITTI


class Segmenter(lightning.LightningModule):
    """A network with one hidden layer that classifies points by position and reflectance."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(4, 32), nn.ReLU(), nn.Linear(32, 19))
        self.loss = nn.CrossEntropyLoss(ignore_index=255)

    def training_step(self, batch: Any, index: int) -> Any:
        loss = self.loss(self.net(batch["points"]), batch["label"])
        for domain, name in zip(batch["domain"].tolist(), batch["id"], strict=True):
            print(f"sample epoch {self.current_epoch} domain {domain} {name}")
        print(f"loss {loss:.4f}", flush=True)
        return loss

    def validation_step(self, batch: Any, index: int) -> None:
        self.log("validation loss", self.loss(self.net(batch["points"]), batch["label"]), batch_size=len(batch["id"]))

    def on_validation_epoch_end(self) -> None:
        print(f"validation loss {self.trainer.callback_metrics['validation loss']:.4f}", flush=True)

    def configure_optimizers(self) -> Any:
        return torch.optim.AdamW(self.parameters(), 1e-3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--scans", required=True, help="SemanticKITTI's dataset folder")
    parser.add_argument("--bank", required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder of the checkpoint last.ckpt")
    parser.add_argument("--max-epochs", type=int, default=2)
    parser.add_argument("--max-steps", type=int, default=-1)
    parser.add_argument("--resume", help="checkpoint")
    options = parser.parse_args()
    real = SemanticKITTI(options.scans, split="train")
    data = MixedData(
        train=MixedScans(real, Bank(options.bank), ratio=0.25),
        val=SemanticKITTI(options.scans, split="val"), batch_size=2, num_workers=2,
    )  # fmt: skip
    checkpoints = lightning.pytorch.callbacks.ModelCheckpoint(options.out, "last", every_n_train_steps=1)
    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=options.max_epochs, max_steps=options.max_steps, logger=False,
        callbacks=[checkpoints], enable_progress_bar=False, use_distributed_sampler=False,
    )  # fmt: skip
    trainer.fit(Segmenter(), data, ckpt_path=options.resume)
