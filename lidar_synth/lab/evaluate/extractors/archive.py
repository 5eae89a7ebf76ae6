"""Reading of the archives in which the extractors' authors publish weights: a folder, or a ``.tar``
with one folder.

Nothing is unpacked to disk, and no code of a file runs.
"""

import tarfile
import zlib
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

from torch import Tensor, nn

from lidar_synth.errors import DataError, FileError, LidarSynthError
from lidar_synth.files.disk import read_file
from lidar_synth.files.parsing import LONGEST_YAML, TarMember, parse_yaml
from lidar_synth.files.torch_files import unpickle

MOST_BYTES = 2 << 30
"""Maximum size of a file of an archive."""

MOST_PACKED = 64 << 20, 20
"""How much an archive may unpack into: these bytes, and so many times its size."""


class Archive:
    """The files of a published archive.

    Args:
        path: a folder with the files, or a ``.tar``, ``.tar.gz`` or ``.tgz`` that holds them, in
            one folder or none.
        project: the project that publishes it, for errors.
    """

    def __init__(self, path: Path, project: str) -> None:
        self.path = Path(path)
        self.project = project

    def yaml(self, name: str) -> dict[str, Any]:
        """The settings in a YAML file.

        Raises:
            FileError: if the file is missing.
            DataError: if it is not YAML, or not a mapping.
        """
        where = self.path / name
        content = parse_yaml(
            self._read(name, LONGEST_YAML).decode(errors="replace"), str(where)
        )
        if not isinstance(content, dict):
            raise DataError(
                f"{where} holds {type(content).__name__}",
                f"the settings that {self.project} writes",
            )
        return content

    def weights(self, name: str) -> Any:
        """The content of a pickle of tensors and plain values.

        Raises:
            FileError: if the file is missing.
            DataError: if it is damaged, or contains code.
        """
        return unpickle(
            BytesIO(self._read(name, MOST_BYTES)), self.path / name, self.project
        )

    def _read(self, name: str, at_most: int) -> bytes:
        if self.path.is_dir():
            return read_file(self.path / name, f"a file of {self.project}", at_most)
        if not self.path.is_file():
            raise FileError(
                f"{self.path} does not exist",
                f"an archive of {self.project}, or a folder with its files",
            )
        try:
            with tarfile.open(self.path, tarinfo=TarMember) as tar:
                return self._member(tar, name, at_most)
        except (tarfile.TarError, EOFError, zlib.error, OSError, ValueError) as error:
            if isinstance(error, LidarSynthError):
                raise
            raise DataError(
                f"{self.path} is truncated, damaged or no archive ({error})",
                f"an intact archive of {self.project}",
            ) from error

    def _member(self, tar: tarfile.TarFile, name: str, at_most: int) -> bytes:
        least, factor = MOST_PACKED
        most = least + factor * self.path.stat().st_size
        for member in tar:
            # the next one would unpack all of it
            if member.offset_data + member.size > most:
                raise DataError(
                    f"{self.path}: {member.name[:100]} declares {member.size} bytes",
                    f"an archive that unpacks into at most {most} bytes",
                )
            parts = PurePosixPath(member.name).parts
            if parts[-1:] == (name,) and len(parts) <= 3 and member.isfile():
                if member.size > at_most:
                    raise DataError(
                        f"{self.path}: {name} declares {member.size} bytes",
                        f"at most {at_most}",
                    )
                file = tar.extractfile(member)
                assert file is not None  # it is a file
                return file.read()
        raise FileError(
            f"{self.path} without {name}", f"the archive that {self.project} publishes"
        )


def _some(names: Sequence[str]) -> str:
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")


def _check_architecture(
    own: Mapping[str, Tensor], given: Mapping[str, Tensor], where: str
) -> None:
    """Refuse weights of other names or shapes than a module's own."""
    differences = {
        "lacks": [k for k in own if k not in given],
        "has another shape of": [
            k for k, v in given.items() if k in own and v.shape != own[k].shape
        ],
        "has": [k for k in given if k not in own],
    }
    if any(differences.values()):
        found = "; ".join(
            f"it {what} {_some(names)}" for what, names in differences.items() if names
        )
        raise DataError(
            f"{where}: weights of another architecture ({found})",
            "those of the published network",
        )


def load_weights(
    module: nn.Module, state: Any, where: str, extra: bool = False
) -> None:
    """Load a state dictionary, checking names and shapes.

    Args:
        module: takes the weights.
        state: what the file holds.
        where: the file, for errors.
        extra: whether names that the module does not have are left out, as the peers' own loaders
            do.

    Raises:
        DataError: on weights of another architecture, or values that are not finite.
    """
    if not isinstance(state, Mapping) or not all(
        isinstance(value, Tensor) for value in state.values()
    ):
        raise DataError(
            f"{where}: its weights are not tensors by name",
            "the state dictionary of a network",
        )
    own = module.state_dict()
    # Absent before PyTorch 0.4.1.
    counters = {k: v for k, v in own.items() if k.endswith("num_batches_tracked")}
    chosen = counters | {k: v for k, v in state.items() if k in own or not extra}
    _check_architecture(own, chosen, where)
    module.load_state_dict(chosen)
    if bad := [
        k for k, v in chosen.items() if v.is_floating_point() and not v.isfinite().all()
    ]:
        raise DataError(
            f"{where}: {bad[0]} holds values that are not finite", "finite weights"
        )
