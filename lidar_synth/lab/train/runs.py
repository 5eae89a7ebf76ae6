"""Training runs: from a configuration to a checkpoint in the output folder.

The folder holds::

    config.yaml              the configuration, overrides included
    cache/                   the projected scans
    selection.npz            a student's timesteps, or how far their selection has come
    state.safetensors        the state from which an interrupted run resumes
    held_out.json            losses on held-out scans, if there are any
    <folder>.safetensors     the checkpoint: the averaged weights; the best ones, if there are
                             held-out scans
    samples/, logs/          pictures; scalars for TensorBoard
"""

import math
import os
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml
from tqdm import tqdm

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.files.disk import write_file, writing
from lidar_synth.files.lock import one_writer
from lidar_synth.generate.checkpoint import save_checkpoint
from lidar_synth.lab.train.autoencoder import AutoencoderStage
from lidar_synth.lab.train.config import DistillConfig, Run, TrainConfig
from lidar_synth.lab.train.data import Batches, InTurns, micro_batches
from lidar_synth.lab.train.decoder import DecoderStage
from lidar_synth.lab.train.held_out import Watch
from lidar_synth.lab.train.interrupts import first_signal
from lidar_synth.lab.train.loop import EVERY, Record, read_figures, steps
from lidar_synth.lab.train.norms import share_norms
from lidar_synth.lab.train.precision import choose_precision, has_gpu
from lidar_synth.lab.train.ranks import Ranks
from lidar_synth.lab.train.resume import check_parents, check_resumed
from lidar_synth.lab.train.stage import Stage
from lidar_synth.lab.train.state import (
    STATE,
    Training,
    set_damaged_aside,
    write_state,
)
from lidar_synth.lab.train.student import StudentStage
from lidar_synth.lab.train.teacher import TeacherStage
from lidar_synth.viz import write_view

if TYPE_CHECKING:
    from accelerate import Accelerator


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
        minutes: save and stop after this time; 0 = after one step.

    Returns:
        Path of the checkpoint, which ``load_generator`` reads.

    Raises:
        ConfigError: if the folder holds a run and ``resume`` is not set, or holds a run with other
            settings, or one whose best weights were removed; on minutes that are no time; on a
            batch that cannot be divided.
        LibraryError: if Accelerate (extra ``train``) is not installed.
        DataError: if the loss becomes NaN or infinite; the last saved state is kept.
        KeyboardInterrupt: on SIGINT or SIGTERM, after the state was saved; at once on a second one.

    Example:
        >>> from lidar_synth.lab.train import TrainConfig, load_config, run
        >>> changes = ["recipe.iterations=1", "recipe.batch=1", "data.town=2", "samples.every=0"]
        >>> run(load_config(TrainConfig, "town_tiny", [*changes, "output=runs/mine"])).as_posix()
        'runs/mine/mine.safetensors'
    """
    if minutes is not None and not 0 <= minutes < math.inf:
        raise ConfigError(f"{minutes} minutes", "a finite number of at least 0")
    state = config.output / STATE
    if state.exists():
        _check_resumable(config, resume)
    with _accelerator(config) as accelerator, _lock(config, accelerator):
        ranks = Ranks(accelerator.process_index, accelerator.num_processes)
        recipe = config.recipe
        # A batch that cannot be divided is refused before scans are read.
        micro_batches(0, recipe.batch, recipe.accumulate, *ranks)
        stage = open_stage(config, accelerator.device)
        training = Training(stage.network, config.recipe)
        if state.exists():
            check_parents(config, stage.header)
            training.load(state)
        if accelerator.is_main_process:  # after all checks
            values = yaml.safe_dump(config.model_dump(mode="json"))
            write_file(config.output / "config.yaml", values.encode())
        data = stage.open_data(ranks=ranks)
        stage.prepare(data, accelerator, ranks)
        batches = _add_rehearsal(stage, data, ranks)
        held = None
        if config.held_out is not None:
            held = stage.open_data(config.held_out.data, "held_out", ranks)
        if ranks.size > 1:
            share_norms(training.network)
        _compile(stage)
        training.began = time.monotonic()  # preparing the data is no training
        keeper = None
        if accelerator.is_main_process:
            limited = minutes is not None
            keeper = _Keeper(stage, training, data, held, accelerator, limited)
        _train(stage, training, batches, accelerator, keeper, minutes)
        accelerator.wait_for_everyone()
    return config.checkpoint


def open_stage(
    config: TrainConfig | DistillConfig, device: torch.device | str = "cpu"
) -> Stage:
    """The training of a configuration; nothing is computed or written.

    Raises:
        ConfigError: where the configuration does not fit the checkpoints that it names.
        FileError, DataError: where they, or the scans, cannot be read.
    """
    if isinstance(config, DistillConfig):
        return StudentStage(config, device)
    if config.decoder:
        return DecoderStage(config, device)
    if config.autoencodes:
        return AutoencoderStage(config, device)
    return TeacherStage(config, device)


def _check_resumable(config: Run, resume: bool) -> None:
    """Refuse a folder that holds a run, unless it is to be resumed with the same settings."""
    if not resume:
        raise ConfigError(
            f"{config.output} holds a run",
            "--resume to continue it, or another output=FOLDER",
        )
    set_damaged_aside(config.output)
    if (config.output / STATE).exists():
        check_resumed(config)


def _add_rehearsal(stage: Stage, data: Batches, ranks: Ranks) -> Batches | InTurns:
    """The data in turns with the scans that are rehearsed, if any."""
    config = stage.config
    if config.rehearsal is None:
        return data
    others = stage.open_data(config.rehearsal, "rehearsal", ranks)
    return InTurns(data, replace(others, seed=config.seed + 1))


def _compile(stage: Stage) -> None:
    """Let the network compute as the configuration says."""
    if stage.config.compile:
        stage.network.compile()
    saves_memory: Any = stage.config.gradient_checkpointing
    for module in stage.network.modules():
        if hasattr(module, "gradient_checkpointing"):
            module.gradient_checkpointing = saves_memory


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
    from torch.utils import tensorboard  # noqa: F401  # by all processes at once: it takes seconds

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
    on_cpu = "LOCAL_RANK" in os.environ and not has_gpu()
    try:
        yield Accelerator(mixed_precision=precision, cpu=on_cpu)
    finally:
        if not by_caller:
            AcceleratorState._reset_state()


@contextmanager
def _lock(config: Run, accelerator: "Accelerator") -> Iterator[None]:
    """Let one run at a time write to the output folder, and remove what a killed one was writing.

    Raises:
        ConfigError: if another run writes there.
        FileError: if the folder cannot be written.
    """
    if not accelerator.is_main_process:
        yield
        return
    with ExitStack() as held:
        with writing(config.output):
            config.output.mkdir(parents=True, exist_ok=True)
            free = held.enter_context(one_writer(config.output / ".lock"))
        if not free:
            raise ConfigError(
                f"another run is training in {config.output}",
                "one at a time, or another output=FOLDER",
            )
        for part in config.output.rglob(".*.part"):
            part.unlink(missing_ok=True)
        yield


def _train(
    stage: Stage,
    training: Training,
    batches: Batches | InTurns,
    accelerator: "Accelerator",
    keeper: "_Keeper | None",
    minutes: float | None,
) -> None:
    """The steps of a stage of any kind, until the end of the recipe, of the time or of patience."""
    end = math.inf if minutes is None else time.monotonic() + 60 * minutes
    interrupted = False
    with first_signal() as received:
        for record in steps(training, stage.task, batches, accelerator, stage.loss):
            stops = time.monotonic() > end or (keeper is not None and keeper.exhausted)
            late = _all_stop(stops, record.step, accelerator)
            interrupted = _all_stop(bool(received), record.step, accelerator)
            last = late or record.step == training.recipe.iterations
            if keeper is not None:
                keeper.keep(record, last)
                if interrupted and not last:
                    keeper.interrupt()
            if late or interrupted:
                break
    if keeper is not None:
        keeper.close()
    if interrupted:
        raise KeyboardInterrupt


def _all_stop(stops: bool, step: int, accelerator: "Accelerator") -> bool:
    """Whether all processes stop: at the same step, whose clock ever is ahead."""
    if accelerator.num_processes == 1:
        return stops
    if step % EVERY:  # it would wait for the device
        return False
    here = torch.tensor(float(stops), device=accelerator.device)
    return bool(accelerator.reduce(here).item() > 0)


def _writes_behind(device: torch.device) -> bool:
    """Whether states are copied, and written by a thread."""
    return device.type != "cpu"


class _Keeper:
    """What the main process keeps of a run: checkpoints, states, a bar, numbers and pictures."""

    def __init__(
        self,
        stage: Stage,
        training: Training,
        data: Batches,
        held: Batches | None,
        accelerator: "Accelerator",
        limited: bool,
    ) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.stage = stage
        self.config = stage.config
        self.training = training
        self.data = data
        self.accelerator = accelerator
        self.thread = ThreadPoolExecutor(1)
        self.writing: Future[None] | None = None
        self.watch = None
        if self.config.held_out is not None and held is not None:
            given = self.config.held_out
            self.watch = Watch(stage, given, held, training, accelerator)
            if not self.watch.measured:
                self.save_checkpoint()
                self.save_state()
        self.restore_checkpoint()
        logs = self.config.output / "logs"
        self.board: Any = SummaryWriter(logs, purge_step=training.step + 1)
        self.bar = tqdm(
            total=None if limited else self.config.recipe.iterations,
            initial=training.step,
            desc=self.config.output.name,
            unit="step",
        )
        self.records: list[Record] = []

    def restore_checkpoint(self) -> None:
        """Write the checkpoint of a resumed run again, if it was removed.

        Raises:
            ConfigError: if it had other weights than the last ones.
        """
        path = self.config.checkpoint
        ended = self.training.step >= self.config.recipe.iterations
        if path.exists() or not (self.watch or ended):
            return
        if self.watch and not self.watch.is_best(self.training):
            raise ConfigError(
                f"{path}, which is missing",
                "the file of this run, which had the best weights on held-out scans",
                "Put it back, or give another output=FOLDER.",
            )
        self.save_checkpoint()

    @property
    def exhausted(self) -> bool:
        """Whether the loss on held-out scans has stopped falling."""
        return self.watch is not None and self.watch.exhausted

    def keep(self, record: Record, last: bool) -> None:
        """Keep what is due after a step."""
        self.records.append(record)
        self.bar.update()
        every = self.config.samples.every
        saves = last or record.step % self.config.save_every == 0
        if saves or record.step % EVERY == 0:
            self.log()
        if saves:
            self.wait()
            self.save_checkpoint()
        if every and (last or record.step % every == 0):
            with self.accelerator.autocast():
                self.draw()
        if saves:  # behind all else: what is lost in between is trained again
            self.save_state()

    def interrupt(self) -> None:
        """Keep the state alone, which takes little time: who asked may wait for seconds only."""
        if self.records:
            self.log()
        self.wait()
        self.save_state()

    def log(self) -> None:
        """Write the numbers since the last call, which are finite, or nothing is saved."""
        figures = read_figures(self.records)
        mean = sum(loss for loss, _ in figures) / len(figures)
        values = {
            "loss": mean,
            "gradient": figures[-1][1],
            "rate": self.records[-1].rate,
        }
        evaluations = sum(record.teacher_evaluations for record in self.records)
        if evaluations:
            values["teacher_evaluations"] = evaluations
        self._add(values)
        self.bar.set_postfix(loss=f"{mean:.4f}", refresh=False)
        self.records.clear()

    def _add(self, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self.board.add_scalar(name, value, self.training.step)

    def save_state(self) -> None:
        """Write the state from which an interrupted run resumes; from a GPU, while it goes on."""
        path = self.config.output / STATE
        if _writes_behind(self.accelerator.device):
            held = self.training.held(copy=True)
            self.writing = self.thread.submit(write_state, path, *held)
        else:  # a copy would take as much memory again
            self.training.save(path)

    def wait(self) -> None:
        """Wait until the last state is written; raises what it has raised."""
        if self.writing is not None:
            self.writing.result()

    def save_checkpoint(self) -> None:
        """Write the checkpoint, if it is the best."""
        average = self.training.average
        if self.watch is None or self.watch.measure(self.training):
            self.stage.finish(average, self.data)
            facts: dict[str, Any] = {"iterations": self.training.step}
            if self.watch is not None:
                facts["held_out_loss"] = self.watch.least
            header = self.stage.header
            header = replace(header, provenance=header.provenance | facts)
            save_checkpoint(self.config.checkpoint, header, self.stage.parts(average))

    def draw(self) -> None:
        """Draw samples, and write their figures."""
        shown = (self.training.average, self.data, self.config.samples.count)
        self._add(self.stage.figures(*shown))
        step = self.training.step
        write_view(
            self.config.output / "samples" / f"{step:07d}.png",
            self.stage.samples(*shown),
            title=f"{self.config.output.name}, {step} iterations",
        )

    def close(self) -> None:
        """End the bar and the logs, and what is still written."""
        self.wait()
        self.bar.close()
        self.board.close()
