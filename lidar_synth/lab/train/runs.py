"""Training runs: from a configuration to a checkpoint in the output folder.

The folder holds::

    config.yaml              the configuration, overrides included
    cache/                   the projected scans
    selection.npz            a student's timesteps and how they were selected
    state.safetensors        the state from which an interrupted run resumes
    held_out.json            losses on held-out scans, if there are any
    <folder>.safetensors     the checkpoint: the averaged weights; the best ones, if there are held-out scans
    samples/, logs/          pictures; scalars for TensorBoard
"""

import math
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml
from tqdm import tqdm

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.files.disk import unwritable, write_file
from lidar_synth.files.lock import one_writer
from lidar_synth.generate.checkpoint import save_checkpoint
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.generator import Generator
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.lab.train.autoencoder import (
    Autoencoding,
    reconstruct,
    reconstruction_figures,
)
from lidar_synth.lab.train.config import DistillConfig, Run, TrainConfig
from lidar_synth.lab.train.data import Batches, InTurns
from lidar_synth.lab.train.held_out import Watch, open_watch
from lidar_synth.lab.train.loop import Record, steps
from lidar_synth.lab.train.plan import TrainingPlan, make_plan, open_data
from lidar_synth.lab.train.precision import choose_precision
from lidar_synth.lab.train.resume import check_parents, check_resumed
from lidar_synth.lab.train.state import STATE, Training, set_damaged_aside
from lidar_synth.viz import write_view

if TYPE_CHECKING:
    from accelerate import Accelerator

_LOG_EVERY = 10  # steps between two numbers in the logs


def run(
    config: TrainConfig | DistillConfig,
    resume: bool = False,
    minutes: float | None = None,
) -> Path:
    """Train a teacher, an autoencoder or a student, with a progress bar, logs, pictures and saved
    states.

    Args:
        config: ``TrainConfig`` for a teacher or an autoencoder, ``DistillConfig`` for a student
            (``load_config``).
        resume: continue from the state in the output folder, if there is one; the settings must be
            the same.
        minutes: save and stop after this time.

    Returns:
        Path of the checkpoint, which ``load_generator`` reads.

    Raises:
        ConfigError: if the folder holds a run and ``resume`` is not set, or holds a run with other
            settings.
        LibraryError: if Accelerate (extra ``train``) is not installed.
        DataError: if the loss becomes NaN or infinite; the last saved state is kept.

    Example:
        >>> from lidar_synth.lab.train import TrainConfig, load_config, run
        >>> changes = ["recipe.iterations=1", "recipe.batch=1", "data.town=2", "samples.every=0", "output=runs/mine"]
        >>> run(load_config(TrainConfig, "town_tiny", changes)).as_posix()
        'runs/mine/mine.safetensors'
    """
    state = config.output / STATE
    if state.exists():
        if not resume:
            raise ConfigError(
                f"{config.output} holds a run",
                "--resume to continue it, or another output=FOLDER",
            )
        set_damaged_aside(config.output)
    if state.exists():
        check_resumed(config)
    with (
        _accelerator(config) as accelerator,
        _lock(config, accelerator.is_main_process),
    ):
        plan = make_plan(config, accelerator)
        training = Training(plan.network.to(accelerator.device), config.recipe)
        if state.exists():
            check_parents(config, plan.header)
            training.load(state)
        if accelerator.is_main_process:  # after all checks
            write_file(
                config.output / "config.yaml",
                yaml.safe_dump(config.model_dump(mode="json")).encode(),
            )
        if config.compile:
            plan.network.compile()
        for module in plan.network.modules():
            if hasattr(module, "gradient_checkpointing"):
                module.gradient_checkpointing = config.gradient_checkpointing  # type: ignore[assignment]
        return _train(config, plan, training, accelerator, minutes)


def require_accelerate() -> None:
    """Check for the library that trainings need.

    Raises:
        LibraryError: if it is not installed.
    """
    try:
        import accelerate  # noqa: F401
    except ImportError as error:
        hint = "pip install 'lidar_synth[train]'"
        raise LibraryError(
            "Accelerate is not installed", "the extra 'train'", hint
        ) from error


@contextmanager
def _accelerator(config: Run) -> Iterator["Accelerator"]:
    """Accelerate's handle for one run.

    Accelerate keeps the first precision of a process. It is cleared after the run, so that the next
    one can have another, unless the caller had set up Accelerate before.
    """
    require_accelerate()
    from accelerate import Accelerator
    from accelerate.state import AcceleratorState, is_initialized

    by_caller = is_initialized()
    precision = choose_precision(config.precision)
    if by_caller and AcceleratorState().mixed_precision not in (
        config.precision,
        precision,
    ):
        given = f"precision={config.precision}, where this process has set up Accelerate with"
        raise ConfigError(
            f"{given} {AcceleratorState().mixed_precision!r}",
            "the same precision, or a new process",
        )
    # Without cpu=True, Accelerate treats the processes of torchrun on a machine without GPU as
    # separate runs.
    gpu = (
        torch.cuda.is_available()
        or torch.xpu.is_available()
        or torch.backends.mps.is_available()
    )
    try:
        yield Accelerator(
            mixed_precision=precision, cpu="LOCAL_RANK" in os.environ and not gpu
        )
    finally:
        if not by_caller:
            AcceleratorState._reset_state()


@contextmanager
def _lock(config: Run, main: bool) -> Iterator[None]:
    """Let one run at a time write to the output folder, and remove what a killed one was writing.

    Raises:
        ConfigError: if another run writes there.
        FileError: if the folder cannot be written.
    """
    if not main:
        yield
        return
    with ExitStack() as held:
        try:
            config.output.mkdir(parents=True, exist_ok=True)
            free = held.enter_context(one_writer(config.output / ".lock"))
        except OSError as error:
            raise unwritable(config.output, error) from error
        if not free:
            raise ConfigError(
                f"another run is training in {config.output}",
                "one at a time, or another output=FOLDER",
            )
        for part in config.output.rglob(".*.part"):
            part.unlink(missing_ok=True)
        yield


def checkpoint_path(config: Run) -> Path:
    """Path of a run's checkpoint; its name becomes a part of the ids of generated scans."""
    return config.output / f"{config.output.name}.safetensors"


def _train(
    config: Run,
    plan: TrainingPlan,
    training: Training,
    accelerator: "Accelerator",
    minutes: float | None,
) -> Path:
    """The loop with logs and saved states."""
    with accelerator.main_process_first():
        data = open_data(config, plan, accelerator.device)
        batches: Batches | InTurns = data
        if config.rehearsal is not None:
            others = open_data(
                config, plan, accelerator.device, config.rehearsal, "rehearsal"
            )
            batches = InTurns(data, replace(others, seed=config.seed + 1))
    training.began = time.monotonic()  # preparing the data is no training
    log = (
        _Log(config, training.step, minutes is not None)
        if accelerator.is_main_process
        else None
    )
    watch = (
        open_watch(config, plan, training, accelerator)
        if config.held_out and log is not None
        else None
    )
    if watch is not None and not watch.measured:
        _save_checkpoint(config, plan, training, data, watch)
        training.save(config.output / STATE)
    end = math.inf if minutes is None else time.monotonic() + 60 * minutes
    for record in steps(training, plan.task, batches, accelerator, plan.loss):
        # All processes stop at the same step, whose clock ever is ahead.
        stops = time.monotonic() > end or (watch is not None and watch.exhausted)
        late = (
            accelerator.reduce(
                torch.tensor(float(stops), device=accelerator.device)
            ).item()
            > 0
        )
        last = late or record.step == config.recipe.iterations
        if log is not None:
            log.add(record)
            saves = last or record.step % config.save_every == 0
            if saves:
                _save_checkpoint(config, plan, training, data, watch)
            if config.samples.every and (
                last or record.step % config.samples.every == 0
            ):
                with accelerator.autocast():
                    log.picture(plan, training, data)
            if saves:
                training.save(config.output / STATE)
        if late:
            break
    if log is not None:
        log.close()
    accelerator.wait_for_everyone()
    return checkpoint_path(config)


def _save_checkpoint(
    config: Run,
    plan: TrainingPlan,
    training: Training,
    data: Batches,
    watch: Watch | None,
) -> None:
    """Write the checkpoint, if it is the best. The state is written behind it and behind the
    picture: what is lost in between is trained again."""
    if watch is None or watch.measure(training):
        if isinstance(training.average, Autoencoding):
            training.average.finish(data)
        facts = {"iterations": training.step} | (
            {} if watch is None else {"held_out_loss": watch.least}
        )
        header = replace(plan.header, provenance=plan.header.provenance | facts)
        save_checkpoint(checkpoint_path(config), header, plan.parts(training.average))


class _Log:
    """A bar, TensorBoard's numbers, pictures."""

    def __init__(self, config: Run, step: int, limited: bool) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.config = config
        self.board: Any = SummaryWriter(config.output / "logs", purge_step=step + 1)
        total = None if limited else config.recipe.iterations
        self.bar = tqdm(total=total, initial=step, desc=config.output.name, unit="step")
        self.records: list[Record] = []

    def add(self, record: Record) -> None:
        self.records.append(record)
        self.bar.update()
        if record.step % _LOG_EVERY and record.step != self.config.recipe.iterations:
            return
        mean = sum(r.loss for r in self.records) / len(self.records)
        evaluations = sum(r.teacher_evaluations for r in self.records)
        self.records.clear()
        for name, value in (
            ("loss", mean),
            ("gradient", record.gradient),
            ("rate", record.rate),
        ):
            self.board.add_scalar(name, value, record.step)
        if evaluations:
            self.board.add_scalar("teacher_evaluations", evaluations, record.step)
        self.bar.set_postfix(loss=f"{mean:.4f}", refresh=False)

    def close(self) -> None:
        self.bar.close()
        self.board.close()

    def picture(self, plan: TrainingPlan, training: Training, data: Batches) -> None:
        """Samples of a flow, from the first scans' conditions; of an autoencoder what went in and
        what came out."""
        name = self.config.output.name
        some = range(self.config.samples.count)
        given: list[Scan] | list[RangeImage]
        if isinstance(training.average, Autoencoding):
            given = self._reconstructions(plan, training.average, data)
        else:
            generator = Generator(
                name, training.average, plan.header, autoencoder=plan.autoencoder
            )
            given = generator.scans(0, some, data.conditions(some))
        write_view(
            self.config.output / "samples" / f"{training.step:07d}.png",
            given,
            title=f"{name}, {training.step} iterations",
        )

    def _reconstructions(
        self, plan: TrainingPlan, trained: Autoencoding, data: Batches
    ) -> list[RangeImage]:
        """Real range images, each followed by its reconstruction; figures go to the logs."""
        codec = Latent(trained.network, plan.header.tensors)
        images = data(range(self.config.samples.count)).y0
        for name, value in reconstruction_figures(
            codec, images, plan.header.sensor
        ).items():
            self.board.add_scalar(f"reconstruction/{name}", value, self.bar.n)
        pairs = zip(
            plan.header.tensors.to_images(images, plan.header.sensor),
            reconstruct(codec, images, plan.header.sensor),
            strict=True,
        )
        return [image for both in pairs for image in both]
