"""Prints the scans of each training step: ``samples 3: town-2-000001 000000.bin``, by their ids or
their files.

Imported by a configuration: ``custom_imports = dict(imports=["mmdet3d_report", ...])``, with the
hook ``Report``.
"""

from pathlib import Path
from typing import Any

from lidar_synth.integrations.mmdet3d import Fetch
from lidar_synth.integrations.mmdet3d_slots import PREFIX, scan_of
from mmengine.hooks import Hook
from mmengine.registry import HOOKS

read = Fetch.__call__


def read_named(self: Fetch, indices: list[tuple[int, int]]) -> list[Any]:
    """The samples of a batch, each with the name of its scan."""
    samples = read(self, indices)
    for sample in samples:
        path = str(sample["data_samples"].lidar_path)
        name = scan_of(path).id if path.startswith(PREFIX) else Path(path).name
        sample["data_samples"].set_metainfo({"scan": name})
    return samples


Fetch.__call__ = read_named  # type: ignore[method-assign]


@HOOKS.register_module()
class Report(Hook):  # type: ignore[misc]
    """Prints each step's scans."""

    def after_train_iter(
        self, runner: Any, batch_idx: int, data_batch: Any = None, outputs: Any = None
    ) -> None:
        """Print them."""
        print(
            f"samples {runner.iter + 1}:",
            *(sample.scan for sample in data_batch["data_samples"]),
            flush=True,
        )
