"""``adapt``: from a shipped model to a user's sensor and streets."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidar_synth.errors import ConfigError, DataError, choose
from lidar_synth.files.claims import claim
from lidar_synth.files.disk import hash_of_names
from lidar_synth.formats import ScanFiles, layout_of, open_scans
from lidar_synth.generate.checkpoint import (
    CODEC,
    Checkpoint,
    Header,
    load_checkpoint,
    save_checkpoint,
)
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.loading import find_model
from lidar_synth.geometry import Sensor
from lidar_synth.lab.train.adaptation.card import figures, provenance_of, write_card
from lidar_synth.lab.train.adaptation.regrid import (
    check_movable,
    fit_grid,
    regrid,
)
from lidar_synth.lab.train.adaptation.scans import Split, label, prepare, split
from lidar_synth.lab.train.adaptation.stages import (
    STAGES,
    AdaptationStage,
    Work,
    shares,
    stages_for,
)
from lidar_synth.lab.train.runs import require_accelerate
from lidar_synth.lab.train.staged import StagedRuns

MINUTES = 120.0
TOWN_SCANS = 400
"""Scans of the town that are cast through the user's sensor."""
SETTINGS = "adapt.json"


@dataclass(frozen=True)
class AdaptPlan:
    """An adaptation before it begins.

    Args:
        model: the checkpoint that is adapted.
        name: its name.
        source: the scans.
        root: where they are.
        layout: theirs.
        sensor: of the adapted model.
        labelled: whether the scans have labels.
        parts: how the scans are split.
        stages: the trainings.
        minutes: their limit of time.
        town: number of scans of the town.
        out: the checkpoint to write.
        work: folder of all that is needed to resume.
    """

    model: Checkpoint
    name: str
    source: ScanFiles
    root: Path
    layout: str
    sensor: Sensor
    labelled: bool
    parts: Split
    stages: Mapping[str, AdaptationStage]
    minutes: float
    town: int
    out: Path
    work: Path

    def __str__(self) -> str:
        """The plan in words."""
        own = self.source.sensor
        rows, columns = self.sensor.shape
        budgets = StagedRuns(self.work, shares(self.stages)).budgets(self.minutes)
        lines = [
            f"{self.name} -> {self.out}",
            f"sensor {own.name}: {own.shape[0]} x {own.columns}, as {rows} x {columns} cells from "
            f"{self.sensor.range_min:g} to {self.sensor.range_max:g} m",
            f"{len(self.parts.train)} scans to train on, {len(self.parts.between)} left out, "
            f"{len(self.parts.held_out)} held out: the last ones, from "
            f"{self.source.ids[self.parts.held_out[0]]}",
            "with their labels"
            if self.labelled
            else "without labels: generated labels are the model's own guess, learnt on the town",
            *self._lost(),
            f"at most {self.minutes:g} minutes:",
            *(
                f"  {name:<10} {minutes:6.1f}  {self.stages[name].about}"
                for name, minutes in budgets.items()
            ),
            f"the folder {self.work} keeps what is needed to resume",
        ]
        return "\n".join(lines)

    def _lost(self) -> list[str]:
        """The numbers of steps that the model knows and the adapted one does not."""
        header = self.model.header
        if not header.other_grids:
            return []
        others = " and ".join(str(len(grid) - 1) for grid in header.other_grids)
        return [
            f"a student of {len(header.time_grid) - 1} steps: the times of {others} steps, which "
            f"{self.name} knows, are lost"
        ]


def plan_adaptation(
    model: str | Path,
    scans: str | Path,
    out: str | Path,
    minutes: float = MINUTES,
    sensor: str | Path | Sensor | None = None,
    town: int = TOWN_SCANS,
    **reading: Any,
) -> AdaptPlan:
    """The plan of an adaptation; the arguments and errors are those of ``adapt``."""
    out = Path(out)
    root = Path(scans)
    if out.suffix != ".safetensors" or out.exists():
        given = f"{out}, which exists" if out.exists() else str(out)
        raise ConfigError(
            f"the output {given}", "a new file whose name ends in .safetensors"
        )
    if minutes <= 0 or town < 0:
        raise ConfigError(
            f"{minutes:g} minutes and {town} scans of the town",
            "more than 0, and at least 0",
        )
    start = load_checkpoint(find_model(model))
    check_movable(start.header)
    layout = reading.get("layout") or layout_of(root)
    source = open_scans(root, sensor=sensor, **reading)
    parts = split(source.ids)
    first = source[0]
    labelled = first.label is not None
    header = start.header
    if (
        not labelled
        and "label" in header.channels
        and (CODEC not in header.networks or not town)
    ):
        raise DataError(
            f"scans without labels, such as {first.id!r}, for a model with labels",
            "scans with labels; or a model with an autoencoder and scans of the town, on which "
            "it learns to label",
            "lidar-synth adapt town",
        )
    stages = stages_for(header, labelled, town)
    grid = fit_grid(source.sensor, header)
    return AdaptPlan(
        start,
        Path(str(model)).stem,
        source,
        root,
        layout,
        grid,
        labelled,
        parts,
        stages,
        minutes,
        town,
        out,
        out.with_suffix(".adapt"),
    )


def adapt(
    model: str | Path,
    scans: str | Path,
    out: str | Path,
    *,
    minutes: float = MINUTES,
    licence: str = "that of the scans",
    sensor: str | Path | Sensor | None = None,
    town: int = TOWN_SCANS,
    overrides: Mapping[str, Mapping[str, Any]] | None = None,
    progress: bool = True,
    **reading: Any,
) -> Path:
    """Adapt a model to the sensor and the streets of 20 to 200 scans.

    The autoencoder, the flow and the student are trained one after the other, with early stopping
    on the last fifth of the scans. A card is written beside the checkpoint. The same call resumes
    an interrupted adaptation.

    Args:
        model: ``"town"``, or ``"town-semantic"``, which then takes anyone's label maps; or
            the path of a checkpoint.
        scans: scans of one sensor, in any layout that is read. Labelled scans teach the model their
            labels. Without labels it keeps guesses, which it learns on the town.
        out: the checkpoint to write, a ``.safetensors`` file.
        minutes: limit of the time of all trainings.
        licence: of the scans, and therefore of the weights.
        sensor: of the scans, if it is not the one that they or their layout name.
        town: number of scans of the town, cast through the sensor, on which the flow is trained
            first, and which the autoencoder learns beside yours, so that it does not forget classes
            that yours lack; 0 = none.
        overrides: {name of a stage: values of its recipe}.
        progress: show a bar while the scans are read; the trainings always show theirs.
        reading: further options of ``open_scans``.

    Returns:
        The path of the checkpoint, for ``load_generator``.

    Raises:
        ConfigError: if the output exists, its folder holds another adaptation, the model cannot be
            adapted, or the sensor has rows that its networks cannot have.
        DataError: on fewer than 12 scans, scans of several sensors, some scans without labels, or
            labels of another table.
        LibraryError: if Accelerate is not installed.

    Example:
        >>> from lidar_synth import adapt
        >>> try:
        ...     adapt("town", "demo_out/town", "mine.safetensors", minutes=120)
        ... except ValueError as error:
        ...     print(str(error).split(";")[0])
        3 scans
    """
    plan = plan_adaptation(model, scans, out, minutes, sensor, town, **reading)
    for name in overrides or {}:
        choose("stage", name, STAGES)
    require_accelerate()
    claim(plan.work / SETTINGS, _settings(plan))
    prepared = prepare(
        plan.source, plan.layout, plan.root, plan.sensor, plan.work / "scans", progress
    )
    if prepared.labelled != plan.labelled:
        raise DataError(
            f"{plan.root}: some scans have labels, some have none",
            "labels for all or none",
        )
    start = plan.work / "start.safetensors"
    if not start.is_file():
        header, networks = regrid(plan.model, plan.sensor)
        provenance = header.provenance | {
            "init": plan.model.hash,
            "init_provenance": plan.model.header.provenance,
        }
        save_checkpoint(start, replace(header, provenance=provenance), networks)
    work = Work(
        plan.work,
        load_checkpoint(start).header,
        prepared,
        licence,
        town,
        plan.stages,
        overrides or {},
    )
    return _finish(plan, _train(work, start, minutes), start, licence)


def _train(work: Work, start: Path, minutes: float) -> Work:
    """Run all stages, each from the checkpoint of the one before; return the work with the scans'
    labels."""
    flow = start
    for name in work.stages:
        if name in ("labels", "codec"):
            start = work.train(name, start, minutes)
            if name == "labels":
                made = load_checkpoint(start)
                latent: Any = Latent(
                    made.networks[CODEC],  # type: ignore[arg-type]
                    made.header.tensors,
                )
                work = replace(
                    work, scans=label(work.scans, latent, work.folder / "labelled")
                )
        elif name == "student":
            flow = work.train(name, flow, minutes)
        else:
            codec = start if work.latent else None
            flow = work.train(name, flow, minutes, codec)
    return work


def _finish(plan: AdaptPlan, work: Work, start: Path, licence: str) -> Path:
    """Write the checkpoint and its card."""
    made = load_checkpoint(work.runs.checkpoint("student"))
    found = figures(work, made)
    provenance = provenance_of(plan.name, plan.model, work, made, found)
    header: Header = replace(made.header, provenance=provenance)
    write_card(plan.out.with_suffix(".md"), plan.out, work, header, found)
    save_checkpoint(plan.out, header, made.networks)
    return plan.out


def _settings(plan: AdaptPlan) -> dict[str, Any]:
    """What a resumed adaptation has in common with the one that began."""
    indices = (*plan.parts.train, *plan.parts.held_out)
    return {
        "model": plan.model.hash,
        "scans": str(plan.root.resolve()),
        "ids": hash_of_names([plan.source.ids[i] for i in indices]),
        "sensor": plan.sensor.to_dict(),
        "town": plan.town,
        **plan.source.options,
    }
