"""The trainings of an adaptation, one after the other, each a recipe of ``configs/`` on the user's
scans.

The limit of time is divided by ``STAGES``; what an early stop leaves goes to the stages after it. A
stage is a training run in a folder of its own, so that an interrupted adaptation goes on where it
stopped.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lidar_synth.files.recipes import merge
from lidar_synth.generate.checkpoint import CODEC, Header
from lidar_synth.lab.train.adaptation.scans import HELD, TRAIN, Prepared
from lidar_synth.lab.train.config import DistillConfig, TrainConfig, load_config
from lidar_synth.lab.train.runs import run
from lidar_synth.lab.train.schedules import ENDLESS
from lidar_synth.lab.train.staged import StagedRuns

TOWN_SEED = 0
TOWN_HELD = 7100
TOWN_HELD_SCANS = 16
"""Seeds of the towns to train on and to hold out, and the scans that are held out."""
CODEC_SAMPLES = 12
FLOW_SAMPLES = 32
"""Samples of a measurement on held-out scans."""
INTERVAL = 2.0
"""Seconds between two scans of the town."""
TOWN_LICENCE = "MIT (procedural, no one's data)"
UNLABELLED = 0.5
"""Share of the town's images that an autoencoder labels without having seen their labels."""


FEW_STEPS = 16
"""Most steps of a student. The grid of a model of more is a teacher's: its student gets one of its
own."""
SELECTION = {"candidates": 50, "trajectories": 32}
"""Of that grid: as for the shipped models, some minutes on a processor."""


class AdaptationStage(NamedTuple):
    """One training.

    Args:
        recipe: a name in ``configs/``.
        share: of the limit of time.
        town: whether it learns from the town cast through the user's sensor, in place of the user's
            scans.
        about: what it does, for the plan.
    """

    recipe: str
    share: float
    town: bool
    about: str


STAGES = {
    "labels": AdaptationStage(
        "adapt_codec", 0.2, True, "the autoencoder learns to label scans, on the town"
    ),
    "codec": AdaptationStage(
        "adapt_codec", 0.35, False, "the autoencoder, on your scans and the town"
    ),
    "flow_town": AdaptationStage(
        "adapt_flow", 0.2, True, "the flow, on the town as your sensor sees it"
    ),
    "flow": AdaptationStage("adapt_flow", 0.25, False, "the flow, on your scans"),
    "student": AdaptationStage(
        "adapt_student", 0.2, False, "the student of few steps, on your scans"
    ),
}
"""Stages by name, in order."""


def stages_for(header: Header, labelled: bool, town: int) -> dict[str, AdaptationStage]:
    """The stages of a model.

    Args:
        header: of the model.
        labelled: whether the scans have labels.
        town: number of scans of the town.
    """
    left_out = set()
    if CODEC not in header.networks:
        left_out |= {"labels", "codec"}
    if labelled or "label" not in header.channels:
        left_out |= {"labels"}
    if not town:
        left_out |= {"flow_town"}
    return {name: stage for name, stage in STAGES.items() if name not in left_out}


def shares(stages: Mapping[str, AdaptationStage]) -> dict[str, float]:
    """The share of each stage of the limit of time."""
    return {name: stage.share for name, stage in stages.items()}


@dataclass(frozen=True)
class Work:
    """What all stages of an adaptation share.

    Args:
        folder: of the runs.
        header: of the model on the user's sensor.
        scans: the prepared scans.
        licence: of the scans and therefore of the weights.
        town: number of scans of the town.
        stages: the stages.
        overrides: {name of a stage: values on top of its recipe}.
    """

    folder: Path
    header: Header
    scans: Prepared
    licence: str
    town: int
    stages: Mapping[str, AdaptationStage]
    overrides: Mapping[str, Mapping[str, Any]]

    @property
    def latent(self) -> bool:
        """Whether the model has an autoencoder."""
        return CODEC in self.header.networks

    @property
    def runs(self) -> StagedRuns:
        """The runs of the stages."""
        return StagedRuns(self.folder, shares(self.stages))

    def train(
        self, name: str, start: Path, limit: float, codec: Path | None = None
    ) -> Path:
        """Run or resume a stage, unless it is done: more steps would change what the next one began
        with.

        Args:
            name: of the stage.
            start: the checkpoint that it starts from.
            limit: minutes of all stages.
            codec: the checkpoint whose autoencoder takes the place of the start's.

        Returns:
            The checkpoint with the best weights.
        """
        if not self.runs.is_done(name):
            minutes = max(0.0, self.runs.budgets(limit)[name] - self.runs.spent(name))
            run(self.config(name, start, codec), resume=True, minutes=minutes)
            self.runs.mark_done(name)
        return self.runs.checkpoint(name)

    def config(
        self, name: str, start: Path, codec: Path | None = None
    ) -> TrainConfig | DistillConfig:
        """The configuration of a stage; of a flow, with another autoencoder."""
        kind: type[TrainConfig] | type[DistillConfig] = (
            DistillConfig if name == "student" else TrainConfig
        )
        values = merge(self._own(name, start), dict(self.overrides.get(name, {})))
        if codec is not None:
            values["codec"] = str(codec)
        return load_config(kind, self.stages[name].recipe, values=values)

    def _own(self, name: str, start: Path) -> dict[str, Any]:
        stage = self.stages[name]
        data = self._town(TOWN_SEED, self.town) if stage.town else self._scans(TRAIN)
        held = (
            self._town(TOWN_HELD, min(TOWN_HELD_SCANS, self.town))
            if stage.town
            else self._scans(HELD)
        )
        codec = stage.recipe == "adapt_codec"
        latents = {"latents": self.latent and not codec}
        values: dict[str, Any] = {
            "output": str(self.runs.folder_of(name)),
            "licence": self.licence,
            "data": data | latents,
            "held_out": {
                "data": held | latents | {"flip": True},
                "samples": CODEC_SAMPLES if codec else FLOW_SAMPLES,
            },
            "recipe": {"iterations": ENDLESS},
        }
        if name == "student":
            values["teacher"] = str(start)
            grid = self.header.time_grid
            if len(grid) - 1 <= FEW_STEPS:
                return values | {"grid": list(grid), "intervals": len(grid) - 1}
            return values | {"selection": SELECTION}
        if name == "codec" and self.town:
            town = self._town(TOWN_SEED, self.town)
            values["rehearsal"] = town | {"flip": True, "roll": True}
        if name == "labels":
            values["losses"] = {"unlabelled": UNLABELLED}
        return values | {"init": str(start)}

    def _scans(self, part: str) -> dict[str, Any]:
        seen = self.scans.recordings.to_list()
        return {
            "path": str(self.scans.path(part)),
            "layout": "range",
            "licence": self.licence,
            "seen": seen,
        }

    def _town(self, seed: int, count: int) -> dict[str, Any]:
        cast = {"town": count, "seed": seed, "interval": INTERVAL, "motion": False}
        return cast | {
            "path": None,
            "licence": TOWN_LICENCE,
            "cache": str(self.folder / f"town-{seed}"),
        }
