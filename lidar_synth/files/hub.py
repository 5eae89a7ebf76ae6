"""Models by name: those that ship with the package, and models and banks on the Hugging Face hub,
their cards and uploads (extra ``hub``).

``hf://user/model`` names a model and ``hf://datasets/user/bank`` a bank; ``@REVISION`` behind it is
a branch, a tag or the hash of a commit. Everything is read from one commit, so that what others
push meanwhile is not mixed in. Only such names lead to a request.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from lidar_synth.errors import (
    ConfigError,
    DataError,
    FileError,
    LidarSynthError,
    needs,
)

LICENCES = frozenset(
    "apache-2.0 mit bsd-2-clause bsd-3-clause cc0-1.0 pddl cdla-permissive-2.0 cc-by-2.0 cc-by-3.0 "
    "cc-by-4.0 cc-by-sa-3.0 cc-by-sa-4.0 cc-by-nc-2.0 cc-by-nc-3.0 cc-by-nc-4.0 cc-by-nc-sa-2.0 "
    "cc-by-nc-sa-3.0 cc-by-nc-sa-4.0 cc-by-nd-4.0 cc-by-nc-nd-3.0 cc-by-nc-nd-4.0 gpl-3.0 "
    "agpl-3.0 mpl-2.0 odbl odc-by openrail etalab-2.0 other".split()
)
"""The hub's identifiers of licences (https://huggingface.co/docs/hub/repositories-licenses)."""

_SCHEME = "hf://"
_URL = re.compile(
    r"hf://(datasets/)?(?!datasets/|spaces/|buckets/)([\w.-]+/[\w.-]+)(?:@([^/]+))?/?(.*)"
)
_COMMIT = re.compile("[0-9a-f]{40}")


@dataclass(frozen=True)
class Repository:
    """A model or a bank on the hub.

    Args:
        kind: "model" or "dataset".
        name: ``user/name``.
        revision: a branch, a tag or a commit; None = the main branch.
        path: of a file or folder in it, or "".
    """

    kind: str
    name: str
    revision: str | None = None
    path: str = ""

    def __str__(self) -> str:
        kind = "datasets/" if self.kind == "dataset" else ""
        revision = "" if self.revision is None else f"@{self.revision}"
        path = self.path and f"/{self.path}"
        return f"{_SCHEME}{kind}{self.name}{revision}{path}"

    @classmethod
    def parse(cls, url: str) -> "Repository":
        """The repository that a URL names.

        Raises:
            ConfigError: on another kind of URL.
        """
        found = _URL.fullmatch(url)
        if found is None:
            raise ConfigError(
                url,
                "hf://user/model or hf://datasets/user/bank, perhaps with @REVISION",
            )
        kind = "dataset" if found[1] else "model"
        return cls(kind, found[2], found[3], found[4])


def shipped_models() -> dict[str, Path]:
    """The checkpoints that ship with the package: {name: path}."""
    folder = Path(str(files("lidar_synth"))) / "weights"
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def refuse_ambiguous(name: Any) -> None:
    """Refuse the name of a shipped model that is also the name of a folder here.

    Raises:
        ConfigError: on such a name.
    """
    if name in shipped_models() and Path(name).is_dir():
        raise ConfigError(
            f"{name!r}, which is both a model and a folder here",
            "a name of one of them",
            f"Write ./{name} for the folder; for the model, rename the folder.",
        )


def is_on_hub(name: object) -> bool:
    """Whether a name is that of something on the hub."""
    return str(name).startswith(_SCHEME)


def pin_revision(url: str) -> str:
    """The URL with the hash of the commit that its revision stands for now.

    Raises:
        ConfigError: on a URL that names no repository.
        FileError: if the hub has no such repository or revision, or does not answer.
        LibraryError: without the extra ``hub``.
    """
    there = Repository.parse(url)
    if _COMMIT.fullmatch(there.revision or ""):
        return url
    with _hub_errors(url):
        from huggingface_hub import HfApi

        found = HfApi().repo_info(
            there.name, repo_type=there.kind, revision=there.revision
        )
    return str(replace(there, revision=found.sha))


def fetch_model(url: str) -> Path:
    """The checkpoint of a model on the hub, in the hub's cache on this machine.

    Args:
        url: ``hf://user/model``, or with ``/FILE.safetensors`` where there are several.

    Raises:
        DataError: unless there is one checkpoint; otherwise as ``pin_revision``.
    """
    there = Repository.parse(url)
    paths = sorted(_download(there).glob(there.path or "*.safetensors"))
    if len(paths) != 1:
        names = " and ".join(path.name for path in paths) or "no checkpoint"
        raise DataError(
            f"{url} holds {names}",
            "one .safetensors file",
            f"Name one: {url}/FILE.safetensors.",
        )
    return paths[0]


def pin_model(url: str) -> str:
    """The URL of a model with the hash of the commit that ``fetch_model`` gives for it: where the
    hub does not answer, of that in the cache. Raises as ``pin_revision``."""
    there = Repository.parse(url)
    return str(replace(there, revision=_download(there).name))


def _download(there: Repository) -> Path:
    """The folder of a commit in the hub's cache, named by its hash, with a model's checkpoints."""
    with _hub_errors(str(there)):
        from huggingface_hub import snapshot_download

        folder = snapshot_download(
            there.name,
            repo_type=there.kind,
            revision=there.revision,
            allow_patterns=there.path or "*.safetensors",
        )
    return Path(folder)


def push(
    there: Repository, card: bytes, files: Mapping[str, bytes | Path], private: bool
) -> str:
    """Upload a card, as README.md, and other files in one commit; what else is there stays.

    Args:
        there: a new or an existing repository.
        card: its content.
        files: {name: content, or a path with it}.
        private: whether a new repository is private.

    Returns:
        The URL with the hash of the commit.

    Raises:
        ConfigError: on a card without licence.
        FileError: if the hub refuses it or does not answer.
        LibraryError: without the extra ``hub``.
    """
    with _hub_errors(str(there)):
        from huggingface_hub import CommitOperationAdd, HfApi

        _require_licence(there, card)
        contents = {"README.md": card, **files}
        added = [CommitOperationAdd(*pair) for pair in contents.items()]
        hub = HfApi()
        hub.create_repo(
            there.name, repo_type=there.kind, private=private, exist_ok=True
        )
        done = hub.create_commit(
            there.name, added, repo_type=there.kind, commit_message="Upload"
        )
    return str(replace(there, revision=done.oid))


def front_matter(licences: Iterable[str], **values: Any) -> list[str]:
    """The lines that a card of the hub begins with.

    Args:
        licences: texts such as "CC BY 4.0" or "MIT". One that the hub has no identifier for makes
            it "other", with the texts as its name.
        values: further metadata; what is empty is left out.
    """
    texts = list(dict.fromkeys(filter(None, licences)))
    known = ["-".join(text.lower().split()) for text in texts]
    if set(known) <= LICENCES:
        values |= {"license": known[0] if len(known) == 1 else known}
    else:
        values |= {"license": "other", "license_name": "; ".join(texts)}
    lines = [f"{k}: {json.dumps(value)}" for k, value in values.items() if value]
    return ["---", *lines, "---", ""]


def _require_licence(there: Repository, card: bytes) -> None:
    """Refuse a card without a licence of the hub."""
    from huggingface_hub import DatasetCard, ModelCard

    kind = DatasetCard if there.kind == "dataset" else ModelCard
    data = kind(card.decode()).data
    if not data.get("license") or data.get("license_name"):
        stated = data.get("license_name") or ""
        raise ConfigError(
            f"{there} with the licence {stated!r}",
            "a licence that the hub knows, such as mit or cc-by-4.0",
            "Name that of the weights or scans: push_to_hub(..., licence='mit').",
        )


@contextmanager
def _hub_errors(url: str) -> Iterator[None]:
    """Errors of the hub as those of the package."""
    try:
        with needs("hub", f"{url}, but huggingface_hub"):
            yield
    except LidarSynthError:
        raise
    except Exception as error:  # the library's, and those of the client that it uses
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(
            f"{url}: {reason}",
            "a repository of the hub that you may use",
            "Check its name and revision; `hf auth login` is needed for private ones and to push.",
        ) from error
