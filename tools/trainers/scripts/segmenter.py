"""A user's Lightning module: a small segmenter.

Prints a line for each training sample, so that a resumed run can be compared with an uninterrupted
one.
"""

from typing import Any

import lightning
import torch
from torch import nn


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
        self.log(
            "validation loss",
            self.loss(self.net(batch["points"]), batch["label"]),
            batch_size=len(batch["id"]),
        )

    def on_validation_epoch_end(self) -> None:
        print(
            f"validation loss {self.trainer.callback_metrics['validation loss']:.4f}",
            flush=True,
        )

    def configure_optimizers(self) -> Any:
        return torch.optim.AdamW(self.parameters(), 1e-3)
