"""The parts that configurations of training runs are made of; the models hold all defaults."""

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StrictBool
from torch.utils.data import ConcatDataset

from lidar_synth.errors import ConfigError, choose
from lidar_synth.formats import OnBad, open_scans
from lidar_synth.generate.checkpoint import NetworkSpec
from lidar_synth.generate.models import encoders_of, network_class
from lidar_synth.geometry import Sensor, Source, load_sensor
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.train.state import Recipe

Count = Annotated[int, Field(ge=1)]

READING = {"layout", "split", "on_bad"}
LATER = {"sensor", "fields", "topic", "reflectance_max"}
"""Keys of ``Data`` that are options of ``open_scans``; ``LATER`` came after the first caches."""


class Section(BaseModel):
    """A part of a configuration; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Data(Section):
    """Where the scans come from: the town, or a path.

    Args:
        licence: licence of the scans, which is stored in the checkpoint.
        town: number of scans of the procedural town, if they are the data.
        seed: seed of the town.
        interval: seconds between consecutive scans of the town.
        motion: whether the town's vehicle moves while the sensor turns.
        path: a dataset's root, a folder or a file; environment variables are expanded.
        layout, split, fields, topic, reflectance_max, on_bad: as for ``open_scans``.
        sensor: of the scans, as for ``open_scans``: a preset's name or a YAML file.
        cache: folder of the projected scans; by default ``cache`` in the output folder. It is
            refused if a file of the scans has another size or modification time since.
        jobs: processes that project the scans for the cache, without images.
        flip: mirror every other sample, left to right; "both" = front to back too.
        roll: rotate every sample by a random number of columns, or by as many degrees at most.
        latents: cache the latents of the autoencoder too.
        seen: recordings behind the scans, where ``path`` has copies of them
            (``Recordings.to_list``); by default they follow from the layout.
        more: further scans, which follow these; of their keys, only those that say which scans they
            are count.
    """

    licence: str
    town: Count | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    interval: float = 1.0
    motion: bool = True
    path: str | None = None
    layout: str | None = None
    split: str | None = None
    sensor: str | None = None
    fields: Count | None = None
    topic: str | None = None
    reflectance_max: float | None = None
    on_bad: OnBad = "error"
    cache: Path | None = None
    jobs: Count = 1
    flip: bool | Literal["both"] = False
    roll: StrictBool | Annotated[float, Field(ge=0, le=180)] = False
    latents: bool = False
    seen: list[dict[str, Any]] | None = None
    more: "tuple[Data, ...]" = ()

    def open(self, sensor: Sensor, instead: str = "data.path=FOLDER") -> Source:
        """The scans; ``instead`` is what else the user can give.

        Raises:
            ConfigError: on a path with a variable that is not set, or what the source refuses.
        """
        if self.more:
            sources: list[Any] = [self.parts()[0].open(sensor)]
            sources += [one.open(sensor, "data.more=[]") for one in self.more]
            return ConcatDataset(sources)
        if self.town is not None:
            return Town(self.seed, sensor, self.town, self.interval, motion=self.motion)
        path = os.path.expandvars(self.path or "")
        if "$" in path:
            raise ConfigError(
                f"data.path {self.path!r}",
                "variables that are set",
                f"Type export NAME=FOLDER, or give {instead}.",
            )
        return open_scans(path, **self.model_dump(include=READING | LATER))

    def parts(self) -> "list[Data]":
        """These scans without ``more``, then those."""
        return [self.model_copy(update={"more": ()}), *self.more]

    def describe(self) -> dict[str, Any]:
        """What tells these scans from others, plain values."""
        keys = {"seed", "interval", "motion"} if self.path else {"path"} | READING
        # caches of earlier versions do not name them
        keys |= {"motion"} if self.motion else set()
        keys |= {key for key in LATER if getattr(self, key) is None}
        keys |= {"cache", "jobs", "flip", "roll", "latents", "seen", "more"}
        facts = self.model_dump(mode="json", exclude=keys)
        if self.sensor is not None:
            facts["sensor"] = load_sensor(self.sensor).to_dict()
        if self.more:
            facts["more"] = [one.describe() for one in self.more]
        return facts


class Samples(Section):
    """Pictures of samples during a run.

    Args:
        every: iterations between two pictures; 0 = none.
        count: scans in a picture, always from the same noise.
    """

    every: Annotated[int, Field(ge=0)] = 5000
    count: Count = 8


class HeldOut(Section):
    """Scans that are not trained on, by which a run keeps its best weights and stops early.

    The loss on them is measured whenever the run is saved, and at its start; it always sees the
    same samples with the same noise. The checkpoint has the weights with the least loss.

    Args:
        data: the scans.
        samples: number of samples of a measurement; every scan counts several times if there are
            fewer.
        patience: measurements without a new least loss after which the run stops.
    """

    data: Data
    samples: Count = 32
    patience: Count = 10


class Run(Section):
    """The keys that teachers, autoencoders and students share.

    Args:
        output: folder of the run, whose name is that of the checkpoint; by default ``runs/NAME``.
        licence: licence of the weights, which is stored in the checkpoint.
        data: the scans.
        recipe: the optimisation.
        seed: seed of the order of the data, the noise and the timesteps.
        precision: "no" = float32; "bf16" = bfloat16, except on a processor that is slower in it
            than in float32.
        compile: whether to use ``torch.compile``.
        gradient_checkpointing: whether to save memory at the cost of time.
        save_every: iterations between two saves.
        samples: pictures of samples.
        held_out: scans for early stopping; None = train to the end.
        rehearsal: scans that take the place of every other sample, so that a network that starts
            from another one does not forget what it has learnt from scans like these; None =
            ``data`` alone. Not for conditional models.
    """

    output: Path
    licence: str
    data: Data
    recipe: Recipe
    seed: Annotated[int, Field(ge=0, lt=2**62)] = 0
    precision: Annotated[
        Literal["no", "bf16"], BeforeValidator(lambda v: "no" if v is False else v)
    ] = "no"
    compile: bool = False
    gradient_checkpointing: bool = False
    save_every: Count = 1000
    samples: Samples = Samples()
    held_out: HeldOut | None = None
    rehearsal: Data | None = None

    @property
    def checkpoint(self) -> Path:
        """Path of the checkpoint; its name becomes a part of the ids of generated scans."""
        return self.output / f"{self.output.name}.safetensors"


class NetworkSection(Section):
    """The network to train.

    Args:
        architecture: a name of ``NETWORKS``.
        arguments: its arguments, without resolution and channels, which follow from the data.
    """

    architecture: str = "hdit"
    arguments: dict[str, Any] = {}


class ConditionSection(Section):
    """The condition of a model.

    Args:
        kind: a name of ``CONDITIONS``: "semantic", "camera" or "layout".
        encoder: architecture of the encoder; by default the first one for this kind.
        arguments: arguments of the encoder, without sizes, which follow from the data.
        dropout: share of blank conditions in training; above 0, classifier-free guidance is
            possible.
        view_dropout: share of camera images of which only one view is kept.
        outline_dropout: share of layouts without outlines, with the ground of a random surrounding
            only.
        height: metres of the sensor above the ground, which a layout has to confirm.
        image: rows and columns of the camera's images.
        focal: focal length of the camera in pixels, which the dataset's calibration has to confirm.
        views: views side by side in the image that are resized one by one, as in LiDM.
        keep_gaps: whether narrow gaps in label maps are kept when a scan is generated, as they are
            in training; those of a teacher trained on ``data.path`` always are.
    """

    kind: Literal["semantic", "camera", "layout"]
    encoder: str | None = None
    arguments: dict[str, Any] = {}
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    view_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    outline_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    height: Annotated[float, Field(gt=0)] | None = None
    image: tuple[Count, Count] | None = None
    focal: Annotated[float, Field(gt=0)] | None = None
    views: Count | None = None
    keep_gaps: bool = False

    def part(self, resolution: tuple[int, int], target: tuple[int, int]) -> NetworkSpec:
        """The encoder, for a sensor's ``resolution`` and a state of ``target`` rows and columns.

        Raises:
            ConfigError: on an encoder of something else.
        """
        encoders = encoders_of(self.kind)
        encoder = self.encoder or encoders[0]
        choose("condition.encoder", encoder, dict.fromkeys(encoders))
        sizes = {
            "resolution": list(resolution),
            "target": list(target),
            "image": list(self.image or ()),
        }
        derived = network_class(encoder).derived_arguments
        return NetworkSpec(
            encoder, {name: sizes[name] for name in derived} | self.arguments
        )

    def options(self) -> dict[str, Any]:
        """What the checkpoint's header says about it."""
        values = self.model_dump(mode="json", exclude={"kind", "encoder", "arguments"})
        return {key: value for key, value in values.items() if value}
