"""The plan of a bake: its settings, and which shard holds which scans.

A scan is a function of (checkpoint, time grid, solver, seed, index). Its bytes also depend on the
computation: precision, batch size, type of device, threads and versions. All of these are settings
of the bank. Two runs with the same settings write the same bytes; a run with other settings is
refused.

Only ``make_plan`` imports torch: a bank is read, linked and checked without it.
"""

import platform
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import deflate
import h5py
import numpy as np

from lidar_synth.bake.options import BakeJob, default_shard_size
from lidar_synth.bank import Entry, Facts
from lidar_synth.bank.chunks import filters
from lidar_synth.bank.encoding import TYPES
from lidar_synth.bank.storage import bank_root, settle_path
from lidar_synth.errors import ConfigError, choose


@dataclass(frozen=True)
class BakePlan:
    """A job, checked against its checkpoint, with the folder of the bank. Small enough to send to
    any process.

    Args:
        out: the bank's folder, absolute, or its URL.
        job: the settings, with ``batch``, ``fields`` and ``shard_size`` resolved and the path of a
            checkpoint file and of a local dataset of conditions made absolute.
        facts: the facts of the bank.
    """

    out: str | Path
    job: BakeJob
    facts: Facts

    @cached_property
    def shards(self) -> tuple[Entry, ...]:
        """The shards to write, in order; their sizes and hashes are not known yet."""
        job = self.job
        assert job.shard_size is not None
        starts = range(0, job.count, job.shard_size)
        digits = max(5, len(str(len(starts) - 1)))
        return tuple(
            Entry(
                f"shard-{number:0{digits}d}.h5",
                job.seed,
                job.first + start,
                min(job.shard_size, job.count - start),
            )
            for number, start in enumerate(starts)
        )

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that determine the bank's bytes, by name."""
        return settings_of(self.facts)

    @property
    def scan_bytes(self) -> int:
        """Size of a scan before compression."""
        return sum(
            shape[0] * shape[1] * dtype.itemsize
            for shape, dtype in self.facts.encoding.arrays().values()
        )


def settings_of(facts: Facts) -> dict[str, Any]:
    """All settings that determine the bytes of a bank with these facts, sorted by name."""
    others = {
        "checkpoint": facts.checkpoint,
        "fields": list(facts.fields),
        "compression": facts.compression,
        "layout": facts.layout,
    }
    # banks of earlier versions do not have it
    if facts.condition and "content" in facts.condition:
        others["condition_content"] = facts.condition["content"]
    return dict(sorted((facts.settings | others | facts.software).items()))


def make_plan(out: str | Path, job: BakeJob) -> BakePlan:
    """Check a job against its checkpoint and resolve its defaults, before any work starts.

    Raises:
        ConfigError: on an unknown model, solver or data type, a field that the model does not
            generate, a conditional model without conditions, or objects for a model without
            layouts.
        LibraryError: if objects are to be cast and embreex is missing; on Blosc2 without
            hdf5plugin.
        FileError, DataError: if the checkpoint or the dataset of the conditions cannot be read.
    """
    import torch

    from lidar_synth.bake.conditions import conditions_for, fingerprint, settle_objects
    from lidar_synth.generate.devices import DTYPES
    from lidar_synth.generate.flow.solvers import SOLVERS
    from lidar_synth.generate.generator import BATCH
    from lidar_synth.generate.loading import load_generator, settle_model

    choose("solver", job.solver, SOLVERS)
    choose("dtype", job.dtype, DTYPES)
    filters(job.compression)
    if job.first + job.count >= 2**63:
        raise ConfigError(
            f"scans up to index {job.first + job.count}", "less than 2^63"
        )
    generator = load_generator(job.model, columns=job.columns)
    condition = job.condition and settle_path(job.condition)
    source = conditions_for(
        generator, condition, job.condition_layout, job.condition_split
    )
    fields = _fields(job, generator.fields)
    software = {
        # Its names are at home here too: a plain import would be a circle.
        "lidar_synth": import_module("lidar_synth").__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "h5py": h5py.__version__,
        "hdf5": h5py.version.hdf5_version,
        "deflate": deflate.__version__,
        "machine": platform.machine(),
    }
    resolved = job.model_copy(
        update={
            "model": settle_model(job.model),
            "condition": condition,
            "fields": fields,
            "objects": settle_objects(generator, job.objects),
            "batch": job.batch or BATCH[job.device],
            "shard_size": job.shard_size or default_shard_size(job.count),
        }
    )
    elsewhere = {"model", "fields", "compression", "layout"}
    header = generator.header
    labelled = "generated" if "label" in header.channels else "condition"
    reference = {
        "kind": generator.condition,
        "source": condition,
        "layout": job.condition_layout,
        "split": job.condition_split,
        "content": fingerprint(source),
    }
    facts = Facts(
        sensor=generator.sensor,
        fields=fields,
        model=generator.name,
        checkpoint=generator.hash,
        settings=resolved.model_dump(exclude=elsewhere),
        label_policy=labelled if "label" in fields else "none",
        condition=reference if generator.condition else None,
        licence=str(header.provenance["licence"]),
        data_licence=str(header.provenance["data_licence"]),
        provenance=header.provenance,
        software=software,
        compression=job.compression,
        layout=job.layout,
    )
    # Absolute, as actors of Ray work in other folders.
    return BakePlan(bank_root(settle_path(out)), resolved, facts)


def _fields(job: BakeJob, generated: frozenset[str]) -> tuple[str, ...]:
    """The fields of the scans, in the order in which they are stored."""
    wanted = generated if job.fields is None else set(job.fields)
    if missing := sorted(wanted - generated):
        raise ConfigError(
            f"fields {missing} of model {job.model!r}",
            f"some of {sorted(generated)}, which it generates"
            if generated
            else "none: it generates only ranges",
            "A checkpoint with the channel 'label' generates labels with confidence."
            if "label" in missing
            else "",
        )
    return tuple(name for name in TYPES if name in wanted)
