"""What a bake shall make, and its plan: which shard holds which scans.

A scan is a function of (checkpoint, time grid and solver, seed, index). Its bytes depend also on what computes it:
precision, micro-batch, kind of device, threads and versions. All of these are settings of the bank, so that two runs
with the same settings write the same bytes, and a run with other ones is refused.
"""

import platform
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import deflate
import h5py
import numpy as np
import torch

import lidar_synth
from lidar_synth.bake.conditions import conditions_for
from lidar_synth.bake.options import BakeJob
from lidar_synth.bank import Entry, Facts
from lidar_synth.bank.encoding import TYPES
from lidar_synth.errors import ConfigError
from lidar_synth.flow.solvers import SOLVERS
from lidar_synth.formats.source import choose
from lidar_synth.generate.generator import BATCH, load_generator

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""What a network may compute in, by name."""


@dataclass(frozen=True)
class BakePlan:
    """A job on a checkpoint that was looked at, and where its bank goes. Small, and can be sent to any process.

    Args:
        out: the bank's folder.
        job: the settings, with ``batch`` and ``fields`` settled and ``model`` as a path where it is one.
        facts: what the bank will say about its scans.
    """

    out: Path
    job: BakeJob
    facts: Facts

    @cached_property
    def shards(self) -> tuple[Entry, ...]:
        """The shards to make, in order, sizes and hashes not known yet."""
        job = self.job
        starts = range(0, job.count, job.shard_size)
        digits = max(5, len(str(len(starts) - 1)))
        return tuple(
            Entry(f"shard-{number:0{digits}d}.h5", job.seed, job.first + start, min(job.shard_size, job.count - start))
            for number, start in enumerate(starts)
        )

    @property
    def settings(self) -> dict[str, Any]:
        """All that decides the bank's bytes, by name."""
        return settings_of(self.facts)

    @property
    def scan_bytes(self) -> int:
        """Size of a scan before compression."""
        return sum(shape[0] * shape[1] * dtype.itemsize for shape, dtype in self.facts.encoding.arrays().values())


def settings_of(facts: Facts) -> dict[str, Any]:
    """All that decides the bytes of a bank with these facts, by name, sorted."""
    others = {"checkpoint": facts.checkpoint, "fields": list(facts.fields), "compression": facts.compression,
              "layout": facts.layout}  # fmt: skip
    return dict(sorted((facts.settings | others | facts.software).items()))


def make_plan(out: str | Path, job: BakeJob) -> BakePlan:
    """Look at the checkpoint and settle what the job leaves open, before any work starts.

    Raises:
        ConfigError: on a model, solver, precision or device that is not there, a field that the model does not give,
            or a conditional model without conditions.
        FileError, DataError: where the checkpoint or the dataset of the conditions cannot be read.
    """
    choose("solver", job.solver, SOLVERS)
    choose("dtype", job.dtype, DTYPES)
    if job.first + job.count >= 2**63:
        raise ConfigError(f"scans up to index {job.first + job.count}", "less than 2^63")
    generator = load_generator(job.model)
    conditions_for(generator, job.condition, job.condition_layout, job.condition_split)
    fields = _fields(job, generator.fields)
    software = {"lidar_synth": lidar_synth.__version__, "torch": torch.__version__, "numpy": np.__version__,
                "h5py": h5py.__version__, "hdf5": h5py.version.hdf5_version, "deflate": deflate.__version__,
                "machine": platform.machine()}  # fmt: skip
    model = Path(job.model)
    settled = job.model_copy(
        update={
            "model": str(model.resolve()) if model.suffix == ".safetensors" else job.model,
            "fields": fields,
            "batch": job.batch or BATCH[job.device],
        }
    )
    header = generator.header
    labelled = "generated" if "label" in header.channels else "condition"
    reference = {"kind": generator.condition, "source": job.condition, "layout": job.condition_layout,
                 "split": job.condition_split}  # fmt: skip
    facts = Facts(
        sensor=header.sensor, fields=fields, model=generator.name, checkpoint=generator.hash,
        settings=settled.model_dump(exclude={"model", "fields", "compression", "layout"}),
        label_policy=labelled if "label" in fields else "none", condition=reference if generator.condition else None,
        licence=str(header.provenance["licence"]), data_licence=str(header.provenance["data_licence"]),
        provenance=header.provenance, software=software, compression=job.compression, layout=job.layout,
    )  # fmt: skip
    return BakePlan(Path(out), settled, facts)


def _fields(job: BakeJob, given: frozenset[str]) -> tuple[str, ...]:
    """What the scans will carry, in the order in which it is stored."""
    wanted = given if job.fields is None else set(job.fields)
    if lacking := sorted(wanted - given):
        raise ConfigError(
            f"fields {lacking} of model {job.model!r}",
            f"some of {sorted(given)}: what the model gives" if given else "none: the model gives ranges only",
            "A checkpoint whose channels have 'label' gives labels and their confidence." if "label" in lacking else "",
        )
    return tuple(name for name in TYPES if name in wanted)
