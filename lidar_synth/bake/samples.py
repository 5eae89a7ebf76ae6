"""Generated scans in the files of any format."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from lidar_synth.bake.conditions import (
    ConditionSource,
    conditions,
    conditions_for,
    fingerprint,
    open_objects,
    settle_objects,
)
from lidar_synth.bake.options import Drawing
from lidar_synth.bank.storage import settle_path
from lidar_synth.datasets.recordings import NOTE, seen_by
from lidar_synth.errors import choose
from lidar_synth.formats import WRITERS
from lidar_synth.formats.convert import Report
from lidar_synth.generate.devices import DTYPES
from lidar_synth.generate.generator import Generator, SamplingOptions
from lidar_synth.generate.loading import load_generator
from lidar_synth.geometry import Scan

_ELSEWHERE = {
    "model",
    "count",
    "batch",
    "device",
    "condition_layout",
    "condition_split",
}
"""Settings that change no file, or that the names of the model and of the conditions tell."""


def write_samples(
    out: Path, job: Drawing, to: str, times: Sequence[float] | None
) -> Report:
    """Write those of a job's scans that are missing in a folder.

    Args:
        out: the folder.
        job: the settings.
        to: the format, a key of ``WRITERS``.
        times: the time grid, instead of the job's steps; None = these.

    Raises:
        ConfigError: as ``Writer.hold``, ``load_generator``, ``conditions_for`` and
            ``Generator.scans``.
        FileError, DataError: if the checkpoint or a condition cannot be read or a file be written.
        LibraryError: if objects are to be cast and embreex is missing.
    """
    writer = choose("--to", to, WRITERS)(out)
    generator = load_generator(
        job.model,
        device=job.device,
        dtype=choose("dtype", job.dtype, DTYPES),
        batch=job.batch,
        columns=job.columns,
    )
    source = conditions_for(
        generator, job.condition, job.condition_layout, job.condition_split
    )
    provenance = generator.header.provenance
    settings = {
        **job.model_dump(exclude=_ELSEWHERE),
        "to": to,
        "times": times,
        "condition": job.condition and settle_path(job.condition),
        "objects": settle_objects(generator, job.objects),
        "checkpoint": generator.hash,
        "conditions": fingerprint(source),
        "trained_on": provenance["data"],
        "seen": seen_by(provenance).to_list(),
    }
    options: SamplingOptions = {
        "steps": job.steps,
        "times": times,
        "solver": job.solver,
        "guidance": job.guidance,
    }
    with writer.hold(NOTE, settings):
        missing = [i for i in range(job.count) if not writer.complete(i)]
        report = Report(kept=job.count - len(missing))
        made = _scans(
            generator, job.seed, missing, source, settings["objects"], options
        )
        for index, scan in made:
            writer.write(scan, index)
            report.add(writer, scan)
        writer.finish()
    return report


def _scans(
    generator: Generator,
    seed: int,
    numbers: Sequence[int],
    source: ConditionSource | None,
    objects: str | None,
    options: SamplingOptions,
) -> Iterator[tuple[int, Scan]]:
    """Numbers and their scans, with a progress bar."""
    size = generator.batch
    with tqdm(total=len(numbers), desc="scans", unit="scan") as bar:
        for first in range(0, len(numbers), size):
            batch = numbers[first : first + size]
            scans = generator.scans(
                seed,
                batch,
                conditions(source, batch),
                open_objects(objects, generator.sensor),
                **options,
            )
            yield from zip(batch, scans, strict=True)
            bar.update(len(batch))
