"""What a feature extractor is: its input, its weights and how they are loaded."""

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Scan

FOLDER_VARIABLE = "LIDAR_SYNTH_METRICS"
"""Environment variable that names the folder with the weights of all extractors."""


class Extractor(Protocol):
    """Features of a few scans."""

    def __call__(
        self, scans: Sequence[Scan], generated: bool = False
    ) -> NDArray[np.floating]:
        """n scans to (n, D) features.

        Args:
            scans: the scans; each is projected to the grid of the extractor's protocol.
            generated: whether the points are put on the rays of the range image where the protocol
                does so for generated scans only (R2Flow's).
        """


class ExtractorSpec(NamedTuple):
    """A published feature extractor.

    Args:
        measure: the distance that papers compute on its features: FRD, FRID, FPD, FSVD, FPVD or
            FLD.
        input: what its network takes.
        width: number of features D.
        archives: names under which the archive, the folder or the file is published, and looked
            for.
        files: the files in the archive or the folder.
        source: the project that publishes the weights, and where its page says to fetch them.
        licence: of the weights.
        load: ``(path, preparation) -> extractor``; see ``load_extractor``.
        preparation: how scans become inputs by default: a name of ``PREPARATIONS``.
        git_blob: hash of the published file, as git computes it, where the file lies in a git
            repository. The other projects state no hash.
    """

    measure: str
    input: Literal["range image", "cloud"]
    width: int
    archives: tuple[str, ...]
    files: tuple[str, ...]
    source: str
    licence: str
    load: Callable[[Path, str], Extractor]
    preparation: str
    git_blob: str | None = None

    def paths(self, folder: Path) -> list[Path]:
        """Where in a folder the weights may lie, an unpacked archive first."""
        return [
            folder / f"{archive}{suffix}"
            for archive in self.archives
            for suffix in ("", ".tar.gz")
        ]

    def found(self, folder: Path | None = None) -> Path | None:
        """The path of the weights in a folder, by default the one that LIDAR_SYNTH_METRICS names;
        None without.

        Raises:
            ConfigError: if there is no such folder.
        """
        named = os.environ.get(FOLDER_VARIABLE)
        folder = folder or (Path(named) if named else None)
        if folder is None:
            return None
        if not folder.is_dir():
            raise ConfigError(f"{folder} for weights", "a folder that exists")
        return next((p for p in self.paths(folder) if p.exists()), None)

    def is_published(self, path: Path) -> bool:
        """Whether a file has the hash of the published one."""
        content = path.read_bytes()
        return (
            hashlib.sha1(
                b"blob %d\0" % len(content) + content, usedforsecurity=False
            ).hexdigest()
            == self.git_blob
        )
