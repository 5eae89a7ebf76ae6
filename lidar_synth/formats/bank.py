"""Reader of banks ("lidar-synth-bank/1" and /2); ``lidar_synth.bank`` describes the format."""

from pathlib import Path
from typing import Any

from lidar_synth.bank import Bank, is_bank
from lidar_synth.errors import ConfigError
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.geometry import Scan, Sensor, load_sensor


class BankScans(ScanFiles):
    """A bank: <root>/index.json and its shards; on disk, or at a URL that fsspec supports.

    Args:
        root: the bank's folder, or its URL.
        sensor: the expected sensor; by default the bank's own.
        on_bad: see ``ScanFiles``.

    Attributes:
        root: the path of the bank's folder, or the text of its URL.

    Raises:
        FileError: if there is no bank, or a shard is missing.
        DataError: if the index is damaged or of another version.
        ConfigError: if the bank has another sensor.
        LibraryError: on a URL whose file system is not installed.
    """

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return is_bank(root)

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        self.bank = Bank(root)
        if sensor and not load_sensor(sensor).same_grid(self.bank.sensor):
            raise ConfigError(
                f"sensor {sensor} for {root}",
                f"{self.bank.sensor.name!r}, whose scans it holds",
            )
        place: Any = self.bank.root  # text where it is a URL
        super().__init__(place, self.bank.ids, None, on_bad, stored=self.bank.sensor)
        self.options["bank"] = self.bank.identity

    def read(self, index: int) -> Scan:
        return self.bank[index]
