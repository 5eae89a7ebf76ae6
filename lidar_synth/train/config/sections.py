"""The parts that configurations of training runs are made of; the models hold all defaults."""

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from lidar_synth.errors import ConfigError
from lidar_synth.formats import open_scans
from lidar_synth.generate.checkpoint import NetworkSpec
from lidar_synth.geometry.scan import Source
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.models import encoders_of, network_class
from lidar_synth.town.town import Town
from lidar_synth.train.state import Recipe

Count = Annotated[int, Field(ge=1)]


class Section(BaseModel):
    """A part of a configuration; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Data(Section):
    """Where the scans come from: the town, or a path.

    Args:
        licence: of the scans; it will stand in the checkpoint.
        town: so many scans of the embedded town.
        seed: of the town.
        interval: seconds between neighbouring scans of the town.
        path: a dataset's root, a folder or a file; environment variables are filled in.
        layout, split: of the path, as ``open_scans`` takes them.
        on_bad: "error", or "skip" to leave out scans that cannot be read.
        cache: folder of the projected scans; by default ``cache`` beside the run's output.
        flip: mirror every other sample.
        roll: turn every sample by a random number of columns.
        latents: keep what an autoencoder makes of the scans in the cache too: where it takes longer than a look at
            the disk, and scans are not turned.
    """

    licence: str
    town: Count | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    interval: float = 1.0
    path: str | None = None
    layout: str | None = None
    split: str | None = None
    on_bad: Literal["error", "skip"] = "error"
    cache: Path | None = None
    flip: bool = False
    roll: bool = False
    latents: bool = False

    def open(self, sensor: Sensor) -> Source:
        """The scans.

        Raises:
            ConfigError: on a path with a variable that is not set, or what the source refuses.
        """
        if self.town is not None:
            return Town(self.seed, sensor, self.town, self.interval)
        path = os.path.expandvars(self.path or "")
        if "$" in path:
            raise ConfigError(f"data.path {self.path!r}", "variables that are set", "Or give data.path=FOLDER.")
        return open_scans(path, layout=self.layout, split=self.split, on_bad=self.on_bad)

    def describe(self) -> dict[str, Any]:
        """What tells these scans from others, plain values."""
        keys = {"seed", "interval"} if self.path else {"path", "layout", "split", "on_bad"}
        return self.model_dump(mode="json", exclude=keys | {"cache", "flip", "roll", "latents"})


class Samples(Section):
    """Pictures while a run goes on.

    Args:
        every: iterations between two; 0 = none.
        count: scans in each, always from the same noise.
    """

    every: Annotated[int, Field(ge=0)] = 5000
    count: Count = 8


class Run(Section):
    """What teacher and student have in common.

    Args:
        output: folder of the run; its last part names the checkpoint.
        licence: of the weights; it will stand in the checkpoint.
        data: the scans.
        recipe: how the weights are moved.
        seed: of the data's order, the noise and the times.
        precision: "no" = float32 (to YAML that word is false), or "bf16".
        compile: by ``torch.compile``.
        gradient_checkpointing: less memory, more time.
        save_every: iterations between two saves.
        samples: pictures.
    """

    output: Path
    licence: str
    data: Data
    recipe: Recipe
    seed: Annotated[int, Field(ge=0, lt=2**62)] = 0
    precision: Annotated[Literal["no", "bf16"], BeforeValidator(lambda v: "no" if v is False else v)] = "no"
    compile: bool = False
    gradient_checkpointing: bool = False
    save_every: Count = 1000
    samples: Samples = Samples()


class Network(Section):
    """Architecture (a name of ``NETWORKS``) and its arguments, without resolution and channels, which follow."""

    architecture: str = "hdit"
    arguments: dict[str, Any] = {}


class Condition(Section):
    """What a model is conditioned on.

    Args:
        kind: a name of ``CONDITIONS``.
        encoder: one of the architectures that take it; by default the first.
        arguments: of the encoder, without the sizes, which follow.
        dropout: share of blank conditions in training; above 0 the model can be guided.
        view_dropout: share of camera images of which one view is left.
        image: rows and columns that camera images have to have: those of one camera.
        focal: focal length in pixels that this camera's calibration has to tell.
    """

    kind: Literal["semantic", "camera"]
    encoder: str | None = None
    arguments: dict[str, Any] = {}
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    view_dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    image: tuple[Count, Count] | None = None
    focal: Annotated[float, Field(gt=0)] | None = None

    def part(self, resolution: tuple[int, int], target: tuple[int, int]) -> NetworkSpec:
        """The encoder, for a sensor's ``resolution`` and a state of ``target`` rows and columns.

        Raises:
            ConfigError: on an encoder of something else.
        """
        encoders = encoders_of(self.kind)
        if (encoder := self.encoder or encoders[0]) not in encoders:
            raise ConfigError(f"condition.encoder {encoder!r}", f"one of {', '.join(encoders)}")
        sizes = {"resolution": list(resolution), "target": list(target), "image": list(self.image or ())}
        derived = network_class(encoder).derived_arguments
        return NetworkSpec(encoder, {name: sizes[name] for name in derived} | self.arguments)

    def options(self) -> dict[str, Any]:
        """What the checkpoint's header says about it."""
        values = self.model_dump(mode="json", include={"dropout", "view_dropout", "image", "focal"})
        return {key: value for key, value in values.items() if value}
