"""``start``: look at the scans, make synthetic ones, compare, and write down how to train."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.bake import BakeJob, BakePlan, Resources, bake, make_plan
from lidar_synth.bake.estimate import estimate
from lidar_synth.errors import ConfigError, DataError, check_count, choose
from lidar_synth.files.claims import claim, hold_writing, require_outside
from lidar_synth.files.disk import write_file
from lidar_synth.files.processes import usable_cores
from lidar_synth.formats.camera_boxes import CameraBoxes
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.generate.loading import find_model
from lidar_synth.geometry import Sensor, presets, sensor_yaml
from lidar_synth.lab.proof import ProofSettings, prove
from lidar_synth.lab.proof.detection import DetectionSettings, prove_detection
from lidar_synth.lab.proof.detection.study import DetectionWork
from lidar_synth.lab.proof.places import find_places
from lidar_synth.lab.proof.pools import TOWN_SEED
from lidar_synth.lab.start.look import Findings, look
from lidar_synth.lab.start.trainers import (
    DEFAULTS,
    MIX,
    configure,
    write_files,
    write_mixture,
)
from lidar_synth.lab.town import Town
from lidar_synth.mixing.defaults import LEAST, ends_on_real, quarter_of

MODEL = "town"
BLIND = 0.1
"""Share of the lasers that may look where the model's sensor does not; with more, the town is cast
by the user's sensor."""
LABELLED = 24
"""Labelled scans of a training of the comparison, as in the published figures."""
EPOCHS = 40
CLAIM = "start.json"
SENSOR = "sensor.yaml"
CODE = "loop.py"


@dataclass(frozen=True)
class Started:
    """What ``start`` found and made.

    Args:
        found: five lines: scans, labels, boxes, sensor, recipe.
        code: a training on the mixture, in a few lines.
        files: {path: text} of the mixture as YAML, and the trainer's configuration.
        result: of the comparison with real scans only, or why there is none.
    """

    found: tuple[str, ...]
    code: str
    files: dict[Path, str]
    result: str

    def __str__(self) -> str:
        files = [f"{path}\n{_indent(text)}" for path, text in self.files.items()]
        return "\n\n".join(
            [self.result, f"your own loop\n{_indent(self.code)}", *files]
        )


@dataclass(frozen=True)
class StartPlan:
    """What ``start`` is going to make.

    Args:
        found: what lies in the folder.
        task: "segmentation", "detection" or "unlabelled".
        cast: whether the synthetic scans are those of the town, cast by the user's sensor, instead
            of a model's.
        out: folder to write to.
        scans: number of synthetic scans.
        minutes: limit of the comparison.
        jobs: processes.
    """

    found: Findings
    task: str
    cast: bool
    out: Path
    scans: int
    minutes: float
    jobs: int

    @property
    def synthetic(self) -> Path:
        """The folder of the synthetic scans."""
        return self.out / ("town" if self.cast else "bank")

    def line(self) -> str:
        """The recipe in words."""
        source = (
            "the town as your sensor sees it"
            if self.cast
            else f"scans of model {MODEL}"
        )
        recipes = _QUARTERS if self.ends_on_real else _RECIPES
        return f"recipe   {source}, {recipes[self.task]}"

    @cached_property
    def ends_on_real(self) -> bool:
        """Whether real scans alone follow the synthetic ones: where they are of one drive, or
        as ``mix`` decides."""
        alike = self.cast or _model_sensor().same_lasers(self.found.source.sensor)
        decided = ends_on_real(len(self.found.source), alike)
        if self.task == "segmentation" and decided:
            return True
        return self.task != "unlabelled" and self.one_drive

    @cached_property
    def one_drive(self) -> bool:
        """Whether the scans are of one drive, with no poses that tell places apart."""
        return self.found.drives == 1 and _places(self) == "stretch"

    @property
    def uncompared(self) -> str:
        """Why trainings are not compared; empty if they are."""
        if not self.minutes:
            return "left out"
        if getattr(self.found.source, "on_bad", "") == "skip":
            return "scans may be skipped; lidar-synth convert --on-bad skip leaves them out"
        return "no labels" if self.task == "unlabelled" else ""

    def settings(self) -> dict[str, Any]:
        """The mixture, as trainers read it."""
        settings: dict[str, Any] = {
            "ratio": 1.0,
            "labels": "generated",
            "epoch_size": "replace",
        }
        first = self.task == "segmentation" and not self.ends_on_real
        if self.task == "detection" or first:
            settings = dict(DEFAULTS[self.task])
        if self.ends_on_real:
            settings["ratio"] = quarter_of(EPOCHS)
        if "epoch_size" in settings and len(self.found.source) < LEAST:
            settings["epoch_size"] = LEAST
        settings = {"synthetic": str(self.synthetic), **settings, "seed": 0}
        sensor = self.found.source.sensor
        if not self.cast and not sensor.same_grid(_model_sensor()):
            settings["as_sensor"] = self.sensor_name()
            plain = not self.found.options.keys() - {"sensor", "split"}
            if plain and not sensor.same_lasers(_model_sensor()):
                like = str(self.found.source.root)
                settings["as_sensor"] = {"sensor": self.sensor_name(), "like": like}
        return settings

    @property
    def arm(self) -> str:
        """The arm of the comparison."""
        arms = ("first", "quarter")
        if self.task == "segmentation":
            arms = ("pretrain", "quarter-town") if self.cast else ("recipe", "quarter")
        return arms[self.ends_on_real]

    def sensor_name(self) -> str:
        """The sensor as a preset's name or a file."""
        sensor = self.found.source.sensor
        known = presets().get(sensor.name) == sensor
        return sensor.name if known else str(self.out / SENSOR)


_ONE_DRIVE = (
    "Trained and tested on one drive: streets without labels gain more. Scans of several drives "
    "show that."
)

_QUARTERS = {
    "segmentation": "alone for 10 of 40 epochs, then your scans alone (no gain or loss shown on "
    "the street of the labels, gained 1 mIoU on unseen streets)",
    "detection": "alone for 10 of 40 epochs, then your scans alone, your objects pasted into all "
    "(lost 1 AP on the street of the labels, gained 4 on unseen streets)",
}
_RECIPES = {
    "segmentation": "alone for 30 of 40 epochs, then half of each batch, the last two your scans "
    "alone, persons and cycles of the town in the place of the model's (gained 7 to 10 mIoU "
    "with 4 labelled frames, 1.5 to 6 with 24, on unseen streets)",
    "detection": "alone for 30 of 40 epochs, then half of each batch, the last two your scans "
    "alone; your objects pasted into all (gained 27 AP over GT sampling with 4 frames)",
    "unlabelled": "alone, since your scans lack labels; then settle the network on your scans "
    "(beat 12 labelled frames alone)",
}


_SETTLE = """own = lidar_synth.MixedScans(real, ratio=0, unlabelled="allow").loader(batch_size=4)
network = lidar_synth.mixing.settle(network, own)  # its normalisation has your scans' statistics
"""


def start(
    root: str | Path,
    out: str | Path = "start",
    *,
    sensor: str | Path | None = None,
    task: str | None = None,
    scans: int = 200,
    minutes: float = 10.0,
    trainer: str | None = None,
    jobs: int | None = None,
    dry_run: bool = False,
    say: Callable[[str], None] = print,
    **reading: Any,
) -> Started | None:
    """Go from a folder of scans to a mixture for a training: look, choose, bake, compare.

    Run it again to resume.

    Args:
        root: scans in any layout that ``open_scans`` reads, with labels or boxes, or without.
        out: folder to write to: ``sensor.yaml`` if the sensor was fitted, ``bank`` or ``town``,
            ``proof``, ``mix.yaml``, ``loop.py`` and the trainer's files.
        sensor: of the scans; by default that of the files or the layout, or fitted where the points
            contradict it.
        task: "segmentation" or "detection"; by default what the scans have labels for, points
            first.
        scans: number of synthetic scans.
        minutes: limit of the comparison with real scans only; 0 leaves it out.
        trainer: one of ``lab.start.trainers.TRAINERS``, to write its configuration too.
        jobs: processes; by default one for each core. With more than one, a script
            calls this below ``if __name__ == "__main__":``.
        dry_run: only say what would be made, in how many minutes and megabytes.
        say: called with each line that tells what is done.
        reading: further options of ``open_scans``.

    Returns:
        What was found and made; None with ``dry_run``.

    Raises:
        FileError, DataError: if there are no scans, or none can be read.
        ConfigError: if no sensor fits, on a folder of another call, or an unknown trainer.

    Example:
        >>> import lidar_synth
        >>> made = lidar_synth.start(
        ...     "demo_out/town", "begin", scans=2, minutes=0, jobs=1, say=lambda line: None
        ... )
        >>> print(made.code)  # doctest: +ELLIPSIS
        import lidar_synth
        ...
        >>> sorted(path.name for path in made.files)
        ['mix.yaml']
    """
    check_count("scans", scans, 1)
    jobs = usable_cores() if jobs is None else jobs
    check_count("jobs", jobs, 1)
    if not minutes >= 0:
        raise ConfigError(f"minutes={minutes}", "0 or more")
    root = Path(root).resolve()
    out = Path(out).resolve()
    require_outside(out, root)
    found = look(root, sensor, out / SENSOR, reading)
    seen = found.lines()
    task = _task(found, task)
    if task == "detection" and isinstance(found.source, CameraBoxes):
        found = replace(found, source=found.source.with_boxes())
    cast = task == "detection" or _blind(found.source.sensor) > BLIND
    plan = StartPlan(found, task, cast, out, scans, minutes, jobs)
    if trainer is not None:
        _configure(plan, trainer)  # complains before anything is made
    lines = (*seen, plan.line())
    say("\n".join(lines))
    if dry_run:
        say(_estimate(plan))
        return None
    settings = {"root": str(root), "sensor": sensor and str(sensor), **reading}
    claim(out / CLAIM, settings | {"scans": scans, "task": task})
    with hold_writing(out / CLAIM):
        if plan.sensor_name() == str(out / SENSOR):
            write_file(out / SENSOR, sensor_yaml(found.source.sensor).encode())
        say(f"\nsynthetic scans: {plan.synthetic}")
        _make_scans(plan)
        files = {MIX: write_mixture(plan.settings())}
        if trainer is not None:
            files = _configure(plan, trainer)
        write_files(files | {CODE: _code(plan)}, out)
    result = _compare(plan, say)
    written = {out / name: text for name, text in files.items()}
    return Started(lines, _code(plan), written, result)


def _task(found: Findings, given: str | None) -> str:
    """The task that is asked for, if the scans have labels for it."""
    if given is None:
        return found.task
    choose("--task", given, DEFAULTS)
    if given not in found.tasks:
        raise ConfigError(
            f"--task {given} for {found.source.root}",
            " or ".join(found.tasks)
            or f"labels, which {found.labelled} of {found.looked} scans looked at have",
        )
    return given


def _model_sensor() -> Sensor:
    header, _ = read_header(find_model(MODEL))
    return header.sensor


def _blind(sensor: Sensor) -> float:
    """Share of a sensor's lasers that look where the model's sensor does not."""
    seen = np.degrees(_model_sensor().optics()[0])
    own = np.degrees(sensor.optics()[0])
    return float(((own < seen.min() - 0.5) | (own > seen.max() + 0.5)).mean())


def _bank(plan: StartPlan) -> BakePlan:
    """The plan of the bank."""
    job = BakeJob.model_validate({"model": MODEL, "count": plan.scans})
    return make_plan(plan.synthetic, job)


def _town(plan: StartPlan) -> DetectionWork:
    """What writes scans of the town by the user's sensor, with labels and boxes."""
    settings = DetectionSettings(synthetic=plan.scans)
    return DetectionWork(plan.found.source, settings, plan.out, plan.synthetic)


def _make_scans(plan: StartPlan) -> None:
    """Bake the bank, or write the scans of the town; those that are there are kept."""
    if plan.cast:
        _ = _town(plan).town
        return
    engine = "processes" if plan.jobs > 1 else "local"
    bake(_bank(plan), engine, Resources(plan.jobs))


def _compare(plan: StartPlan, say: Callable[[str], None]) -> str:
    """Train with and without synthetic scans; the result in words, or why there is none."""
    if plan.uncompared:
        return f"Not compared with real scans only: {plan.uncompared}."
    proof = plan.out / "proof"
    say(f"\ncomparison with real scans only, at most {plan.minutes:g} minutes: {proof}")
    try:
        if plan.task == "detection":
            return _compare_detectors(plan, proof)
        done = prove(
            plan.found.source,
            proof,
            _proof_settings(plan),
            minutes=plan.minutes,
            jobs=plan.jobs,
        )
    except (ConfigError, DataError) as error:
        return f"Not compared with real scans only: {error}"
    return _report(plan, str(done))


def _report(plan: StartPlan, table: str) -> str:
    """The result of a comparison, where to read it, and what it cannot say."""
    page = f"The page is {plan.out / 'proof' / 'index.html'}"
    if not plan.one_drive:
        return f"{table}\n\n{page}"
    return f"{table}\n\n{_ONE_DRIVE}\n{page}"


def _compare_detectors(plan: StartPlan, proof: Path) -> str:
    from lidar_synth.lab.proof.detection.page import format_table

    settings = DetectionSettings(
        arms=(plan.arm,), synthetic=plan.scans, places=_places(plan)
    )
    values = prove_detection(
        plan.found.source,
        proof,
        settings,
        minutes=plan.minutes,
        pools=plan.synthetic,
    )
    return _report(plan, format_table(values))


def _places(plan: StartPlan) -> str:
    """How places are told apart: a single drive is cut into stretches."""
    try:
        find_places(plan.found.source, "auto")
    except DataError:
        return "stretch"
    return "auto"


def _proof_settings(plan: StartPlan) -> ProofSettings:
    """A comparison of the chosen recipe, small enough for ten minutes."""
    by = _places(plan)
    places = find_places(plan.found.source, by)
    sizes = [len(scans) for scans in places.values()]
    labelled = max(1, min(LABELLED, sum(sizes) - max(sizes)))
    return ProofSettings(
        labelled=labelled,
        batch=min(4, labelled),
        arms=(plan.arm,),
        seeds=1,
        places=by,
        synthetic=min(150, plan.scans),
        model=MODEL,
    )


def _estimate(plan: StartPlan) -> str:
    """Minutes and megabytes of all that would be made, by a few scans of it."""
    if plan.cast:
        begin = time.perf_counter()
        scan = Town(TOWN_SEED, plan.found.source.sensor, 4, motion=False)[3]
        seconds = plan.scans * (time.perf_counter() - begin)
        size = plan.scans * len(scan) * 26.0  # bytes of a point in an .npz file
    else:
        expected = estimate(_bank(plan))
        seconds = expected.seconds / plan.jobs
        size = expected.bytes
    lines = [f"{plan.scans} synthetic scans: {_cost(seconds / 60, size)}"]
    if plan.uncompared:
        lines.append(f"not compared with real scans only: {plan.uncompared}")
    else:
        rows, _ = plan.found.source.sensor.shape
        pools = 0 if plan.cast else 150 * rows * 512 * 20.0
        lines.append(
            f"comparison with real scans only: at most {_cost(plan.minutes, pools)}"
        )
    return "\n".join(["", *lines, f"lidar-synth start resumes in {plan.out}"])


def _cost(minutes: float, size: float) -> str:
    return f"{minutes:.1f} minutes, {size / 1e6:.0f} MB"


def _configure(plan: StartPlan, trainer: str) -> dict[str, str]:
    task = "segmentation" if plan.task == "unlabelled" else plan.task
    root = str(plan.found.source.root)
    files = configure(trainer, task, plan.settings(), root, str(plan.out), _real(plan))
    changing = plan.found.options.keys() & {"fields", "reflectance_max", "on_bad"}
    if changing and trainer != "lightning":
        layout = "kitti_object" if task == "detection" else "semantic_kitti"
        raise ConfigError(
            f"{', '.join(sorted(changing))} with --trainer {trainer}, which reads the files itself",
            "files that need no such options",
            f"First type lidar-synth convert {root} OUT --to {layout} with them.",
        )
    return files


def _real(plan: StartPlan) -> str:
    """What opens the real scans, as Python."""
    given = "".join(f", {k}={v!r}" for k, v in plan.found.options.items())
    cropped = plan.task == "detection" and isinstance(plan.found.source, CameraBoxes)
    boxed = ".with_boxes()" if cropped else ""
    return f"open_scans({str(plan.found.source.root)!r}{given}){boxed}"


def _code(plan: StartPlan) -> str:
    """A few lines that train on the mixture."""
    unlabelled = plan.task == "unlabelled"
    detection = plan.task == "detection"
    own = plan.ends_on_real or unlabelled
    given = [f"epochs={EPOCHS}"] if detection or not own else []
    if own:
        settings = plan.settings()
        given.append(
            f"ratio={settings['ratio']}, epoch_size={settings['epoch_size']!r}"
        )
    target = "boxes" if detection else "label"
    given += ['task="detection"'] * detection
    return f"""import lidar_synth
real = lidar_synth.{_real(plan)}
train = lidar_synth.mix(real, {str(plan.synthetic)!r}, {", ".join(given)})
loader = train.loader(batch_size=4)
for epoch in range({EPOCHS}):
    for batch in loader: ...  # batch["points"], batch["{target}"], batch["domain"]
{_SETTLE if unlabelled else ""}"""


def _indent(text: str) -> str:
    return "\n".join(f"  {line}" for line in text.splitlines())
