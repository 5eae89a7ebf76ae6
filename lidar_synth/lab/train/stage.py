"""A stage: a training of one kind, from its configuration to the parts of its checkpoint.

Each kind is a class in a file of its own: ``TeacherStage``, ``AutoencoderStage``, ``DecoderStage``,
``StudentStage``. Opening one reads the configuration and the checkpoints that it names; it computes
nothing and writes nothing. Then come, for every kind, ``open_data`` (scans are projected and kept),
``prepare`` (the timesteps of a student), the steps of ``task`` and ``loss``, and ``finish`` and
``parts`` for the checkpoint.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.bake.conditions import check_camera
from lidar_synth.errors import ConfigError
from lidar_synth.formats import ScanFiles
from lidar_synth.generate.checkpoint import (
    CODEC,
    ENCODER,
    Header,
    network_hash,
    split,
    weights_hash,
)
from lidar_synth.generate.codec import Codec, make_codec
from lidar_synth.generate.conditions import CONDITIONS, resize_image
from lidar_synth.generate.flow.path import Example, Metric, velocity_loss
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.models.bounded_latent import BoundedAutoencoder
from lidar_synth.generate.models.encoders.clip_views import ClipViewEncoder, find_clip
from lidar_synth.geometry import RangeImage, Scan, Source
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.train.cache import Other, cache_latents, cache_scans
from lidar_synth.lab.train.config import Data, Run
from lidar_synth.lab.train.data import Batch, Batches, Conditioning
from lidar_synth.lab.train.provenance import recordings_known
from lidar_synth.lab.train.ranks import ALONE, Ranks

if TYPE_CHECKING:
    from accelerate import Accelerator

Task = Callable[[Batch], Example]
"""Makes the example of a batch: the state and time at which the network is trained, and the target
velocity."""

Loss = Callable[[nn.Module, Example, Metric], Tensor]
"""The scalar loss of a network on an example, with the recipe's metric."""


class Stage:
    """A training before its first step.

    Args:
        config: of the run.
        network: the trained module.
        header: of the checkpoint.
        frozen: parts of the checkpoint that are not trained, such as the autoencoder of a latent
            model.
        device: of the training.

    Attributes:
        task: makes training examples of batches.
        loss: what is lowered.

    Raises:
        FileError, DataError: where the scans cannot be opened, or weights of CLIP are missing.
    """

    task: Task
    loss: Loss = staticmethod(velocity_loss)

    def __init__(
        self,
        config: Run,
        network: nn.Module,
        header: Header,
        frozen: Mapping[str, nn.Module],
        device: torch.device | str,
    ) -> None:
        self.config = config
        self.network = network.to(device)
        self.frozen = {
            name: part.requires_grad_(False).to(device) for name, part in frozen.items()
        }
        self.device = device
        self.header = header
        if isinstance(self.parts(network).get(ENCODER), ClipViewEncoder):
            find_clip(device)  # missing weights are noticed before scans are read
        known = recordings_known(config, header.provenance, header.sensor)
        self.add_facts(seen=known.to_list())

    def add_facts(self, **facts: Any) -> None:
        """Add to the provenance in the header."""
        provenance = self.header.provenance | facts
        self.header = replace(self.header, provenance=provenance)

    @property
    def codec(self) -> Codec:
        """The codec between tensors and states."""
        header = self.header
        return make_codec(self.frozen.get(CODEC), header.tensors, header.sensor.shape)

    def open_data(
        self,
        data: Data | None = None,
        folder: str = "cache",
        ranks: Ranks = ALONE,
    ) -> Batches:
        """The batches of the run, or of other ``data``; the scans are projected once, by all
        ``ranks`` together, and cached, in a ``folder`` of the run where the data names none.

        Raises:
            ConfigError: on scans that are mirrored or turned, with a condition that cannot be.
            DataError: on images of another camera than ``condition.focal`` says.
        """
        given = self.config.data if data is None else data
        sensor = self.header.sensor
        conditions = [self._condition(name, given) for name in self.header.conditioning]
        source = given.open(sensor)
        channels = set(self.header.channels)
        others: dict[str, Other] = {}
        conditioning = None
        for conditioning in conditions:
            field = CONDITIONS[conditioning.name].field
            if field == "label":  # a channel of the range image
                channels.add(field)
            else:
                others[field] = self._other(conditioning, source)
        kept = given.cache or self.config.output / folder
        cache = cache_scans(
            source,
            sensor,
            channels,
            kept,
            given.describe(),
            others=others,
            ranks=ranks,
            jobs=given.jobs,
        )
        batches = Batches(
            cache,
            self.header.tensors,
            self.config.seed,
            given.flip,
            given.roll,
            self.device,
            conditioning=conditioning,
        )
        if CODEC not in self.frozen:
            return batches
        codec = self.codec
        if not given.latents:
            return replace(batches, codec=codec)
        made_by = hash_encoder(self.frozen[CODEC])
        latents = cache_latents(
            cache, batches.tensors, codec, self.device, kept, made_by, ranks=ranks
        )
        return replace(batches, latents=latents)

    def _condition(self, name: str, data: Data) -> Conditioning:
        """How samples get their conditions."""
        options = self.header.conditioning[name]
        encoder = self.parts(self.network)[ENCODER]
        turned = (data.roll or data.flip == "both") and not CONDITIONS[name].turns
        if turned or (data.flip and not encoder.mirrors):
            raise ConfigError(
                f"data.flip={data.flip}, data.roll={data.roll} with the condition {name!r}, "
                f"encoder {self.header.networks[ENCODER].architecture!r}",
                "data.roll=false, data.flip=false (true without a calibration)",
            )
        less = options.get("view_dropout", 0.0) or options.get("outline_dropout", 0.0)
        blank = None
        if isinstance(encoder, ClipViewEncoder):
            black = torch.zeros(1, 3, *encoder.resolution, dtype=torch.uint8)
            blank = encoder.look(black.to(self.device))[0].cpu()
        return Conditioning(
            name,
            options.get("dropout", 0.0),
            less,
            getattr(encoder, "views", 1),
            blank,
        )

    def _other(self, about: Conditioning, source: Source) -> Other:
        """How a cache gets the conditions from the scans: as pixels, or as features of CLIP, which
        take a fiftieth of the space and are those of every epoch."""
        name = about.name
        options = self.header.conditioning[name]
        encoder = self.parts(self.network)[ENCODER]
        shape = CONDITIONS[name].shape(encoder)
        sensor = self.header.sensor
        for part in getattr(source, "datasets", [source]):
            if isinstance(part, ScanFiles):
                check_camera(part, options.get("focal"))

        def read(i: int, scan: Scan) -> NDArray[np.uint8]:
            if name == "camera" and isinstance(source, Town):  # rendered when needed
                from PIL import Image

                image = Image.fromarray(source.image(i))
                return resize_image(image, shape, options, "the town's image")
            return CONDITIONS[name].read(scan, sensor, shape, options)

        if not isinstance(encoder, ClipViewEncoder):
            return Other(shape, read)

        def look(i: int, scan: Scan) -> NDArray[np.float16]:
            image = torch.from_numpy(read(i, scan)).to(self.device)
            made = encoder.look(torch.stack((image, image.flip(-1))))
            return made.cpu().numpy().astype(np.float16)

        maker = network_hash(find_clip(self.device))[:16]
        return Other((2, *encoder.seen), look, np.float16, maker)

    def prepare(
        self, data: Batches, accelerator: "Accelerator", ranks: Ranks = ALONE
    ) -> None:
        """Compute what the first step needs, and keep it in the run's folder; most kinds need
        nothing."""

    def finish(self, network: nn.Module, data: Batches) -> None:
        """Set what is not trained but measured, before a checkpoint is written."""

    def parts(self, network: nn.Module) -> dict[str, nn.Module]:
        """The parts of the checkpoint, from the network or its averaged copy."""
        return {**split(network), **self.frozen}

    def figures(
        self, network: nn.Module, data: Batches, count: int
    ) -> dict[str, float]:
        """Figures of the first scans, for the logs."""
        return {}

    def samples(
        self, network: nn.Module, data: Batches, count: int
    ) -> Sequence[Scan | RangeImage]:
        """What a picture shows: generated scans, from the conditions of the first ones."""
        name = self.config.output.name
        generator = Generator(
            name, network, self.header, autoencoder=self.frozen.get(CODEC)
        )
        return generator.scans(0, range(count), data.conditions(range(count)))


def hash_encoder(autoencoder: nn.Module) -> str:
    """Hash of what decides an autoencoder's latents: the same for decoders trained further."""
    return weights_hash(latent_weights(autoencoder))


def latent_weights(autoencoder: nn.Module) -> dict[str, Tensor]:
    """The weights and buffers that decide an autoencoder's latents, by name, on the CPU; all of
    them where its decoder cannot be trained alone."""
    kept = autoencoder.state_dict()
    if isinstance(autoencoder, BoundedAutoencoder):
        chosen = set(map(id, autoencoder.encoder()))
        parameters = autoencoder.named_parameters()
        names = {name for name, p in parameters if id(p) in chosen}
        kept = {n: v for n, v in kept.items() if n in names | {"shift", "scale"}}
    return {name: value.cpu() for name, value in kept.items()}
