"""Generated scans in the files of any format."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from lidar_synth.bake.conditions import (
    ConditionSource,
    conditions,
    fingerprint,
    open_objects,
)
from lidar_synth.datasets.recordings import NOTE, seen_by
from lidar_synth.formats.writer import Writer
from lidar_synth.generate.generator import Generator, SamplingOptions
from lidar_synth.geometry import Scan


@dataclass(frozen=True)
class ScansOfSeed:
    """The scans of a seed by number.

    Args:
        generator: the model.
        seed: of the scans.
        source: their conditions; None for an unconditional model.
        objects: what stands in the boxes of layouts, as ``settle_objects`` names it.
        options: of the generator.
    """

    generator: Generator
    seed: int
    source: ConditionSource | None
    objects: str | None
    options: SamplingOptions

    def write(self, writer: Writer, count: int, settings: dict[str, Any]) -> int:
        """Write those of the first ``count`` scans that are missing; returns how many they were.

        Args:
            writer: of the files.
            count: number of scans.
            settings: what else determines the files, as plain values.

        Raises:
            ConfigError: as ``Writer.hold`` and ``Generator.scans``.
            FileError, DataError: if a condition cannot be read or a file be written.
        """
        provenance = self.generator.header.provenance
        own = {
            "checkpoint": self.generator.hash,
            "seed": self.seed,
            "conditions": fingerprint(self.source),
            "objects": self.objects,
            "trained_on": provenance["data"],
            "seen": seen_by(provenance).to_list(),
        }
        with writer.hold(NOTE, {**self.options, **settings, **own}):
            missing = [i for i in range(count) if not writer.complete(i)]
            for index, scan in self._scans(missing):
                writer.write(scan, index)
            writer.finish()
        return len(missing)

    def _scans(self, numbers: Sequence[int]) -> Iterator[tuple[int, Scan]]:
        """Numbers and their scans, with a progress bar."""
        size = self.generator.batch
        with tqdm(total=len(numbers), desc="scans", unit="scan") as bar:
            for first in range(0, len(numbers), size):
                batch = numbers[first : first + size]
                scans = self.generator.scans(
                    self.seed,
                    batch,
                    conditions(self.source, batch),
                    open_objects(self.objects, self.generator.sensor),
                    **self.options,
                )
                yield from zip(batch, scans, strict=True)
                bar.update(len(batch))
