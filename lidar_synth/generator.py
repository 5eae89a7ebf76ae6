"""From a checkpoint to scans: where geometry, network and flow meet.

A scan is a function of (checkpoint, condition, time grid and solver, seed, index). What else is scanned along with
it, in which order and on which device changes float rounding only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from lidar_synth.checkpoint import VELOCITY, Header, load_checkpoint
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.noise import gaussian
from lidar_synth.normalize import TensorFormat
from lidar_synth.projection import unproject
from lidar_synth.scan import SYNTHETIC, RangeImage, Scan
from lidar_synth.sensor import Sensor
from lidar_synth.solvers import solve, uniform_grid

BATCH = {"cpu": 1, "cuda": 16}
"""Scans at a time, by device: what fits a CPU's cache, what fills a GPU."""


@dataclass(frozen=True)
class Generator:
    """Scans by (seed, index).

    Args:
        name: of the checkpoint; stands in the scans' ids.
        network: the velocity network, in evaluation mode.
        header: what the checkpoint says about it.
        hash: of the checkpoint; "" for weights that are in none.
        batch: scans at a time; bounds the memory and changes nothing else.
    """

    name: str
    network: nn.Module
    header: Header
    hash: str = ""
    batch: int = 1

    @property
    def sensor(self) -> Sensor:
        """Whose grid the images have."""
        return self.header.sensor

    @property
    def tensors(self) -> TensorFormat:
        """The layout of the network's tensors."""
        return TensorFormat(self.header.channels, self.header.normalisation)

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return next(self.network.parameters()).device

    def range_images(
        self,
        seed: int,
        indices: Sequence[int],
        condition: Tensor | None = None,
        steps: int | None = None,
        solver: str = "euler",
    ) -> list[RangeImage]:
        """Generated range images.

        Args:
            seed: of the noise, 0 <= seed < 2^64.
            indices: B numbers of scans, 0 <= index < 2^63, in any order.
            condition: (K, H, W) for all or (B, K, H, W) one for each; None for an unconditional model.
            steps: of a uniform time grid; by default the checkpoint's own grid.
            solver: a name of ``SOLVERS``.

        Returns:
            B images: range in metres, 0 = no return; ``reflectance`` in [0, 1], ``label`` and its ``confidence`` in
            [0, 1] where the checkpoint has them, empty (0, 255 = ignore, 0) where there is no return.

        Raises:
            ConfigError: on a seed, index, number of steps or solver that cannot be served, a condition for a model
                that takes none, or CUDA in a DataLoader worker.
            DataError: on a condition of another shape.
        """
        images = []
        for tensor in self.samples(seed, indices, condition, steps, solver):
            images += self.tensors.to_images(tensor, self.sensor)
        return images

    def scans(
        self,
        seed: int,
        indices: Sequence[int],
        condition: Tensor | None = None,
        steps: int | None = None,
        solver: str = "euler",
    ) -> list[Scan]:
        """Generated scans: the returns of ``range_images`` through the centres of their cells.

        Their ``id`` is ``<checkpoint>/<seed>/<index>``, their ``domain`` ``SYNTHETIC``.
        """
        images = self.range_images(seed, indices, condition, steps, solver)
        return [
            replace(unproject(image), id=f"{self.name}/{seed}/{index}", domain=SYNTHETIC)
            for index, image in zip(indices, images, strict=True)
        ]

    def samples(
        self,
        seed: int,
        indices: Sequence[int],
        condition: Tensor | None = None,
        steps: int | None = None,
        solver: str = "euler",
    ) -> Iterator[Tensor]:
        """The normalised tensors behind ``range_images``, at most ``batch`` at a time: (b, C, H, W) each."""
        _refuse_worker(self.device)
        condition = self._condition(condition, len(indices))
        grid = self.header.time_grid if steps is None else uniform_grid(steps)
        shape = (self.tensors.size, *self.sensor.shape)
        for first in range(0, len(indices), self.batch):
            part = slice(first, first + self.batch)
            noise = gaussian(seed, indices[part], shape, self.device)
            with torch.inference_mode():
                yield solve(self.network, noise, grid, solver, None if condition is None else condition[part])

    def _condition(self, condition: Tensor | None, count: int) -> Tensor | None:
        """(B, K, H, W) on the device."""
        channels = self.header.networks[VELOCITY].arguments.get("condition_channels", 0)
        if condition is None and not channels:
            return None
        shape = (channels, *self.sensor.shape)
        if not channels:
            raise ConfigError(f"a condition for {self.name!r}", "none: the model is unconditional")
        if condition is None or condition.shape not in (shape, (count, *shape)):
            given = "no condition" if condition is None else f"a condition of shape {tuple(condition.shape)}"
            raise DataError(f"{given} for {self.name!r}", f"{shape} for all scans, or {(count, *shape)}")
        return condition.to(self.device).expand(count, *shape)


def load_generator(
    model: str | Path,
    *,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
    compile: bool = False,
    batch: int | None = None,
) -> Generator:
    """A generator from a shipped model or a checkpoint file.

    Args:
        model: a shipped model's name ("town") or a path to a ``.safetensors`` checkpoint.
        device: "cpu" or "cuda".
        dtype: what the network computes in; states stay float32.
        compile: by ``torch.compile``; the first scan takes long.
        batch: scans at a time; by default what suits the device.

    Raises:
        ConfigError: on an unknown name, a device that is not there, or CUDA in a DataLoader worker.
        FileError, DataError: where the checkpoint cannot be read.
    """
    device = torch.device(device)
    _refuse_worker(device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device {str(device)!r}, but torch sees no GPU", "device='cpu', or a CUDA build of torch")
    path = _find(model)
    checkpoint = load_checkpoint(path, device)
    network = checkpoint.networks[VELOCITY].to(dtype).requires_grad_(False)
    if compile:
        network.compile()
    return Generator(path.stem, network, checkpoint.header, checkpoint.hash, batch or BATCH.get(device.type, 1))


def shipped_models() -> dict[str, Path]:
    """The checkpoints that come with the package, by name."""
    folder = Path(str(files("lidar_synth"))) / "weights"
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def _find(model: str | Path) -> Path:
    shipped = shipped_models()
    if str(model) in shipped:
        return shipped[str(model)]
    path = Path(model)
    if path.suffix != ".safetensors":
        names = ", ".join(shipped) or "none in this installation"
        raise ConfigError(f"model {str(model)!r}", f"a shipped one ({names}) or a .safetensors file")
    return path


def _refuse_worker(device: torch.device) -> None:
    """No CUDA in DataLoader workers: a forked process cannot use it, a spawned one pays for a context each."""
    if device.type == "cuda" and get_worker_info() is not None:
        raise ConfigError(
            "a generator on the GPU inside a DataLoader worker",
            "one of three ways: (A) bake a bank first and read it in the workers, (B) a rolling bank that one spawned "
            "process fills, (C) mix in the main process, on the training device",
            "On the CPU, load_generator(..., device='cpu') works in workers too.",
        )
