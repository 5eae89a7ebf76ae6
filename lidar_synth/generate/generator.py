"""Generation of scans from a checkpoint.

A scan is a function of (checkpoint, condition, time grid and solver, seed, index). The other scans
of its batch, their order and the device change only float rounding.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import Unpack

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, check_count, choose
from lidar_synth.files.hub import Repository, push
from lidar_synth.generate import boxed
from lidar_synth.generate.card import model_card
from lidar_synth.generate.checkpoint import Header, read_header
from lidar_synth.generate.codec import Codec, make_codec
from lidar_synth.generate.conditions import CONDITIONS, Conditioned, batch_of, blank
from lidar_synth.generate.devices import refuse_worker, without_autocast
from lidar_synth.generate.flow.guidance import guide
from lidar_synth.generate.flow.path import Velocity
from lidar_synth.generate.flow.solvers import SOLVERS, mean_velocity, read_grid, solve
from lidar_synth.geometry import (
    SYNTHETIC,
    RangeImage,
    Scan,
    Sensor,
    identity_of,
    model_provenance,
)
from lidar_synth.geometry.normalize import TensorFormat
from lidar_synth.geometry.projection import unproject
from lidar_synth.noise import gaussian, uniform

BATCH = {"cpu": 1, "cuda": 16}
"""Default batch size by device: few enough for a CPU's cache, enough to fill a GPU."""


class SamplingOptions(TypedDict, total=False):
    """Options of ``Generator.range_images``, ``scans`` and ``samples``.

    Attributes:
        steps: number of steps, on the times that the checkpoint has for it, else on a uniform grid;
            None, the default, uses the checkpoint's own number.
        times: the time grid instead of ``steps``: descending times from 1 to 0, such as
            (1, 0.86, 0.58, 0.22, 0).
        solver: a key of ``SOLVERS``, by default "euler".
        guidance: scale of classifier-free guidance; 1, the default, is no guidance. A larger scale
            follows the condition more closely; any scale but 1 doubles the computation, and leaves
            the moments of fewer steps unmatched.
    """

    steps: int | None
    times: Sequence[float] | None
    solver: str
    guidance: float


_ALIGNED = 512  # bytes

_OPTIONS = dict.fromkeys(("objects", *SamplingOptions.__annotations__))


@dataclass(frozen=True)
class Generator:
    """A generative model; a scan is a function of (seed, index). ``load_generator`` loads one.

    Args:
        name: name of the checkpoint, which is part of the scans' ids.
        network: the flow, ``checkpoint.join`` of the checkpoint's networks, in evaluation mode.
        header: the checkpoint's header.
        hash: the checkpoint's hash; "" for weights without a checkpoint.
        batch: number of scans computed at a time; it affects only memory and speed.
        autoencoder: the autoencoder of a latent model; None for a pixel model.
        columns: number of columns of the scans, if the autoencoder decodes to several widths; None
            = the checkpoint's.
        path: the checkpoint's file; None for weights without one.

    Example:
        >>> from lidar_synth import Generator, load_generator
        >>> generator = load_generator("town")
        >>> isinstance(generator, Generator), generator.sensor.shape
        (True, (64, 2048))
        >>> [image] = generator.range_images(seed=0, indices=[3], steps=2)
        >>> image.range.shape, sorted(image.channels)
        ((64, 2048), ['confidence', 'label', 'reflectance'])
    """

    name: str
    network: nn.Module
    header: Header
    hash: str = ""
    batch: int = 1
    autoencoder: nn.Module | None = None
    columns: int | None = None
    path: Path | None = None

    def __post_init__(self) -> None:
        check_count("batch", self.batch, 1)
        widths = getattr(self.autoencoder, "widths", (self.header.sensor.columns,))
        if self.columns is not None and self.columns not in widths:
            raise ConfigError(
                f"{self.columns} columns of {self.name!r}",
                f"one of {', '.join(map(str, widths))}",
            )

    def __repr__(self) -> str:
        size = f"{sum(p.numel() for p in self.network.parameters()) / 1e6:.1f} M parameters"
        fields = ", ".join(sorted(self.fields))
        return f"Generator {self.name!r}: {size}\n  sensor {self.sensor.grid_text()}; {fields}"

    @property
    def sensor(self) -> Sensor:
        """The sensor that defines the grid of the range images."""
        sensor = self.header.sensor
        if self.columns in (None, sensor.columns):
            return sensor
        return replace(sensor, columns=self.columns)

    @property
    def tensors(self) -> TensorFormat:
        """The channels and normalisation of the network's tensors."""
        return TensorFormat(self.header.channels, self.header.normalisation)

    @property
    def codec(self) -> Codec:
        """The mapping between tensors and the states of the flow."""
        return make_codec(self.autoencoder, self.tensors, self.header.sensor.shape)

    @property
    def variant(self) -> str:
        """The settings other than the checkpoint that determine the scans, columns and precision,
        as a text; "" for the checkpoint's own."""
        dtype = next(self.network.parameters()).dtype
        columns = (
            "" if self.sensor == self.header.sensor else f":{self.columns} columns"
        )
        return columns + ("" if dtype == torch.float32 else f":{dtype}")

    @property
    def condition(self) -> str | None:
        """The name of the model's condition, a key of ``conditions.CONDITIONS``; None for an
        unconditional model."""
        return next(iter(self.header.conditioning), None)

    @property
    def fields(self) -> frozenset[str]:
        """The fields of its scans: some of "reflectance", "label", "confidence", "instance" and
        "boxes"."""
        labelled = "label" in self.header.channels or self.condition == "semantic"
        fields = set(self.header.channels) - {"range"} | (
            boxed.FIELDS if self.condition == "layout" else set()
        )
        return frozenset(fields | {"label", "confidence"} if labelled else fields)

    @property
    def device(self) -> torch.device:
        """The device of the network."""
        return next(self.network.parameters()).device

    def push_to_hub(
        self, name: str, *, licence: str | None = None, private: bool = False
    ) -> str:
        """Upload the checkpoint and a card to the Hugging Face hub, in one commit.

        Args:
            name: ``user/model``, new or existing.
            licence: of the weights, an identifier of the hub such as "mit"; by default the one that
                the checkpoint states.
            private: whether a new repository is private.

        Returns:
            What ``load_generator`` takes, ``hf://user/model@COMMIT``.

        Raises:
            ConfigError: on weights without a checkpoint, or a licence that the hub does not know.
            FileError: if the hub refuses it or does not answer.
            LibraryError: without the extra ``hub``.
        """
        if self.path is None or read_header(self.path)[1] != self.hash:
            raise ConfigError(
                f"generator {self.name!r}, whose checkpoint is not (or no longer) in a file",
                "one of load_generator",
            )
        repository = Repository("model", name)
        parts = [self.network, *filter(None, [self.autoencoder])]
        size = sum(p.numel() for part in parts for p in part.parameters())
        card = model_card(str(repository), self.header, self.hash, size, licence)
        return push(repository, card.encode(), {self.path.name: self.path}, private)

    def __getstate__(self) -> dict[str, Any]:
        """A fork server passes at most 250 file descriptors to a new process, one for each tensor,
        so the weights are put into one block first. Elsewhere they are taken apart again, as each
        tensor would be pickled with the whole block."""
        networks = nn.ModuleList(filter(None, [self.network, self.autoencoder]))
        tensors = [*networks.parameters(), *networks.buffers()]
        if get_spawning_popen() is None:
            for tensor in tensors:
                if tensor.nbytes < tensor.untyped_storage().nbytes():
                    tensor.data = tensor.clone()
        elif len({t.untyped_storage().data_ptr() for t in tensors}) > 1:
            # aligned as torch aligns them, so that products have the same bits
            sizes = (-(-t.nbytes // _ALIGNED) * _ALIGNED for t in tensors)
            starts = [*accumulate(sizes, initial=0)]
            block = torch.empty(starts[-1], dtype=torch.uint8, device=self.device)
            for tensor, start in zip(tensors, starts, strict=False):
                part = block[start : start + tensor.nbytes].view(tensor.dtype)
                tensor.data = part.as_strided(tensor.shape, tensor.stride()).copy_(
                    tensor
                )
        return vars(self)

    def as_synthetic(self, seed: int = 0) -> "Generated":
        """The scans of a seed by number, made when they are read."""
        return Generated(self, seed)

    def range_images(
        self,
        seed: int,
        indices: Sequence[int],
        condition: Any = None,
        objects: boxed.Drawer | None = None,
        **options: Unpack[SamplingOptions],
    ) -> list[RangeImage]:
        """Generate range images.

        Args:
            seed: seed of the noise, 0 <= seed < 2^64.
            indices: indices of B scans, 0 <= index < 2^63, in any order.
            condition: one condition for all scans, or B of them; None for an unconditional model. A
                semantic map is a (H, W) uint8 array of train ids, 255 = unknown, such as the
                ``label`` of a range image on the model's sensor; a camera image is (3, h, w) uint8;
                a layout is a ``Layout``. A real ``Scan``, or a list of B, provides the condition
                itself: its projected labels, the image at its ``image_path``, or its layout. In a
                dictionary of conditions, the one with the condition's name is used. See
                ``conditions``.
            objects: such as ``ObjectBank.from_town_shapes()``: the objects of layouts are
                cast from these, and the model draws the street around them.
            options: ``steps`` or ``times``, ``solver`` and ``guidance``; see
                ``SamplingOptions``.

        Returns:
            B images: range in metres, 0 = no return; ``reflectance`` in [0, 1], ``label`` and its
            ``confidence`` in [0, 1] if the checkpoint has them. They are empty (0, 255 = ignore, 0)
            where there is no return. If a model conditioned on semantic maps does not generate
            labels, ``label`` is the map's where there is a return, with confidence 1 where the
            map's label is known. The autoencoder of "town-semantic" gives returns the map's labels
            too, with their probabilities as confidence. A model conditioned on a ``Layout`` or on
            the layout of a scan gives the image the boxes that hold a return, and their numbers in
            ``instance``.

        Raises:
            ConfigError: on an invalid seed, index, number of steps or solver, a condition for an
                unconditional model, guidance outside 0 to 100 or of a model that was trained
                without blank conditions, objects that cannot be cast or do not have the layout's
                classes, or a GPU in a DataLoader worker.
            FileError: if the image of a scan cannot be read.
            DataError: on a condition of another shape or with invalid values, or if a condition is
                missing.
        """
        if isinstance(indices, int):
            raise ConfigError(f"indices={indices}", f"a list of them, [{indices}]")
        if not len(indices):
            return []
        conditions = self.condition_tensor(condition, len(indices))
        boxes = None
        if self.condition == "layout":
            boxes = boxed.boxes_of(condition, len(indices))
        castable = boxes is not None and isinstance(objects, boxed.Drawer)
        if objects is not None and not castable:
            raise ConfigError(
                f"{objects!r} as objects for {self.name!r}",
                "ObjectBank.from_town_shapes(), for layouts of a model of layouts",
            )
        images = []
        for tensor in self.samples(seed, indices, conditions, **options):
            images += self.tensors.to_images(tensor, self.sensor)
        if (
            self.condition == "semantic"
            and "label" not in self.header.channels
            and conditions is not None
        ):
            for image, labels in zip(images, conditions.cpu().numpy(), strict=True):
                label = np.where(image.mask, labels, np.uint8(IGNORE))
                image.channels["label"] = label
                image.channels["confidence"] = (label != IGNORE).astype(np.float32)
        if boxes is None:
            return images
        add = boxed.add_boxes
        if objects is not None:
            add = partial(boxed.draw_boxes, objects=objects)
        return [add(*pair) for pair in zip(images, boxes, strict=True)]

    def scans(
        self,
        seed: int,
        indices: Sequence[int],
        condition: Any = None,
        objects: boxed.Drawer | None = None,
        **options: Unpack[SamplingOptions],
    ) -> list[Scan]:
        """Generate scans: the returns of ``range_images`` through the centres of their cells.

        Arguments and errors are those of ``range_images``. The ``id`` of a scan is
        ``<checkpoint>/<seed>/<index>``, and its ``domain`` is ``SYNTHETIC``.
        """
        images = self.range_images(seed, indices, condition, objects, **options)
        provenance = model_provenance(self.name, self.hash, seed)
        return [
            replace(
                unproject(image),
                id=f"{self.name}/{seed}/{index:d}",
                domain=SYNTHETIC,
                provenance=provenance,
            )
            for index, image in zip(indices, images, strict=True)
        ]

    def samples(
        self,
        seed: int,
        indices: Sequence[int],
        condition: Any = None,
        *,
        steps: int | None = None,
        times: Sequence[float] | None = None,
        solver: str = "euler",
        guidance: float = 1.0,
    ) -> Iterator[Tensor]:
        """Yield the normalised tensors behind ``range_images``: (b, C, H, W) each, with b at most
        ``batch``.

        Arguments and errors are those of ``range_images``.
        """
        refuse_worker(self.device)
        if not 0 <= guidance <= 100:
            raise ConfigError(f"guidance {guidance}", "0 to 100; 1 is no guidance")
        conditions = self.condition_tensor(condition, len(indices))
        codec = self.codec
        grid = self.header.grid(steps) if times is None else read_grid(times)
        if times is not None and steps is not None:
            raise ConfigError(f"steps {steps} and times {grid}", "one of the two")
        choose("solver", solver, SOLVERS)
        if solver != "euler" and getattr(self.network, "ends", False):
            raise ConfigError(
                f"solver {solver!r} for {self.name!r}",
                "'euler': it predicts mean velocities of steps",
            )
        for first in range(0, len(indices), self.batch):
            part = slice(first, first + self.batch)
            noise, draws = self.draw_noise(seed, indices[part], self.sensor)
            with torch.inference_mode(), without_autocast(self.device):
                values = None if conditions is None else conditions[part]
                velocity, encoded = self._flow(values, guidance, grid)
                state = solve(velocity, noise, grid, solver, encoded)
                if guidance == 1:
                    state = self.header.match(state, grid)
                given = None if values is None else {str(self.condition): values}
                tensors = codec.decode(state, draws, given)
            yield tensors

    def draw_noise(
        self, seed: int, indices: Sequence[int], sensor: Sensor
    ) -> tuple[Tensor, Tensor | None]:
        """The noise (B, *codec.shape) that flows start from, and the uniform noise (B, draws, H, W)
        of a decoder that samples, else None, on a sensor's grid."""
        codec = self.codec
        noise = gaussian(seed, indices, codec.shape, self.device)
        if not codec.draws:
            return noise, None
        shape = (codec.draws, *sensor.shape)
        return noise, uniform(seed, indices, shape, self.device)

    def _flow(
        self, condition: Tensor | None, guidance: float, grid: Sequence[float]
    ) -> tuple[Velocity, Tensor | None]:
        """The velocity to solve on a grid, and its condition, encoded once rather than at every
        step."""
        options = self.header.conditioning.get(str(self.condition), {})
        if guidance != 1 and (condition is None or not options.get("dropout")):
            raise ConfigError(
                f"guidance {guidance} for {self.name!r}",
                "1: it was trained without blank conditions, which guidance needs",
                "Train it with condition.dropout=0.1.",
            )
        if condition is None or not isinstance(self.network, Conditioned):
            return mean_velocity(self.network, grid), condition
        encode: Callable[[Tensor], Tensor] = self.network.encoder
        unconditional = (
            encode(blank(str(self.condition), condition[:1]))[0]
            if guidance != 1
            else condition
        )
        velocity = mean_velocity(self.network.velocity, grid)
        return guide(velocity, guidance, unconditional), encode(condition)

    def condition_tensor(self, given: Any, count: int) -> Tensor | None:
        """The conditions (B, ...) as the network takes them, on its device; None for an
        unconditional model.

        Args:
            given: as ``condition`` of ``range_images``, which names the errors too.
            count: B.
        """
        if self.condition is None:
            if given is None:
                return None
            raise ConfigError(
                f"a condition for {self.name!r}", "none: the model is unconditional"
            )
        if given is None:
            raise DataError(
                f"no condition for {self.name!r}",
                f"condition=... ({self.condition}), or real scans",
            )
        if not isinstance(self.network, Conditioned):
            raise ConfigError(
                f"{self.name!r} without the encoder of its condition",
                "a checkpoint with all its parts",
            )
        options = self.header.conditioning[self.condition]
        encoder = self.network.encoder
        features = getattr(encoder, "seen", None)  # shape of an image's features
        if isinstance(given, Tensor) and given.shape[1:] == features:
            return given.to(self.device)  # a training keeps these instead of images
        shape = CONDITIONS[self.condition].shape(encoder)
        return batch_of(
            self.condition, given, count, self.header.sensor, shape, options
        ).to(self.device)


class Generated:
    """Scans that a generator makes on access, in the process that accesses them.

    Args:
        generator: the model. On the CPU it also works in DataLoader workers. On a GPU it works in
            the main process only; in a worker it raises an error that names the three ways to use a
            GPU's scans.
        seed: of the scans; the number of a scan is its index.
        condition: for a conditional model, an indexable source of conditions, such as the real
            scans. Scan n is conditioned on entry n modulo the source's length;
            ``Generator.range_images`` lists the kinds of entries.
        cache: number of latest scans that each process keeps in memory (about 1 MB each at 64 x
            1024), which saves time if a process accesses a scan again: with ``reuse``, an epoch
            later.
        sampling: objects, steps, solver and guidance, as for ``Generator.scans``.

    Raises:
        ConfigError: on a negative cache, an unknown option, a conditional model without
            conditions, or conditions for an unconditional model.

    Example:
        >>> from lidar_synth import load_generator, open_scans
        >>> from lidar_synth.generate.generator import Generated
        >>> real = open_scans("demo_out/town")
        >>> synth = Generated(load_generator("town-semantic"), condition=real)  # for MixedScans
        >>> sorted(synth[0].fields())
        ['confidence', 'label', 'reflectance']
    """

    length: None = None
    on_demand = True
    """Reading the first scan would start the network."""

    def __init__(
        self,
        generator: Generator,
        seed: int = 0,
        *,
        condition: Any = None,
        cache: int = 0,
        **sampling: Any,
    ) -> None:
        check_count("cache", cache, 0)
        for name in sampling:
            choose("sampling option", name, _OPTIONS)
        conditioned = condition is not None and len(condition) > 0
        if conditioned != (generator.condition is not None):
            raise ConfigError(
                f"{'conditions' if conditioned else 'no conditions'} for {generator.name!r}",
                f"a source of conditions ({generator.condition})"
                if generator.condition
                else "none",
                "Generated(generator, condition=real) conditions it on the scans of a source.",
            )
        self.generator = generator
        self.seed = seed
        self.condition = condition
        self._sampling = sampling
        self._cache_size = cache
        self._cached: OrderedDict[int, Scan] = OrderedDict()

    @property
    def sensor(self) -> Sensor:
        """The sensor of the generator."""
        return self.generator.sensor

    @property
    def fields(self) -> frozenset[str]:
        """The fields that the scans have besides their points."""
        return self.generator.fields | {"reflectance"}

    @property
    def identity(self) -> str:
        """The checkpoint, the seed, the sampling options and the conditions as one text."""
        model = self.generator.hash or self.generator.name
        options = {
            k: getattr(v, "identity", v)
            for k, v in sorted(self._sampling.items())
            if v is not None
        }
        conditions = "" if self.condition is None else identity_of(self.condition)
        return f"generated:{model}:{self.seed}:{options}:{conditions}{self.generator.variant}"

    def __getitem__(self, number: int) -> Scan:
        if number in self._cached:
            self._cached.move_to_end(number)
            return self._cached[number]
        [scan] = self.scans([number])
        self._cached[number] = scan
        if len(self._cached) > self._cache_size:
            self._cached.popitem(last=False)
        return scan

    def scans(self, numbers: Sequence[int]) -> list[Scan]:
        """Several scans at once, which is faster on a GPU."""
        condition = (
            None
            if self.condition is None
            else [self.condition[n % len(self.condition)] for n in numbers]
        )
        return self.generator.scans(self.seed, numbers, condition, **self._sampling)

    def __repr__(self) -> str:
        fields = ", ".join(sorted(self.fields))
        made_by = f"Generated by {self.generator.name!r}, seed {self.seed}"
        return f"{made_by}\n  sensor {self.sensor.grid_text()}; {fields}"

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cached": OrderedDict()}
