"""``lidar-synth metrics``: the weights of the feature extractors that the field's measures need."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Typer, echo

from lidar_synth.cli.options import Json

if TYPE_CHECKING:
    from lidar_synth.lab.evaluate.extractors import ExtractorSpec

metrics = Typer(
    name="metrics",
    help="Weights that the field's measures need: setup.",
    no_args_is_help=True,
)


@metrics.callback()
def _commands() -> None:
    """Keeps ``setup`` a command of its own."""


@metrics.command("setup")
def setup(
    folder: Annotated[
        Path | None,
        Argument(
            metavar="[FOLDER]",
            help="folder of the weights; default: $LIDAR_SYNTH_METRICS",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Says which files the measures need, where to get them, and which are there and readable.

    Nothing is downloaded. Put each archive, packed or unpacked, into one folder and name it in
    LIDAR_SYNTH_METRICS.

    The hash is the publisher's, where one states it. sha256 is that of the file that is here, or of
    the names and
    contents of all files of a folder: state it beside your figures.

    \b
    Examples:
      lidar-synth metrics setup
      lidar-synth metrics setup weights --json
    """
    import json
    import os

    from lidar_synth.lab.evaluate.extractors import EXTRACTORS, FOLDER_VARIABLE

    named = os.environ.get(FOLDER_VARIABLE)
    folder = folder or (Path(named) if named else None)
    found = {name: _status(name, spec, folder) for name, spec in EXTRACTORS.items()}
    if as_json:
        echo(json.dumps(found, indent=2))
        return
    where = f"{folder}" if folder else f"no folder: set {FOLDER_VARIABLE}, or name one"
    echo(f"Folder: {where}")
    for name, facts in found.items():
        echo(f"\n{name} ({facts['measure']}): {facts['state']}")
        for key in ("file", "contents", "from", "licence", "hash", "sha256"):
            if facts[key]:
                echo(f"  {key:9}{facts[key]}")


def _status(name: str, spec: "ExtractorSpec", folder: Path | None) -> dict[str, Any]:
    """What to fetch for an extractor, and whether it is there."""
    from lidar_synth.lab.evaluate.cache import weights_hash

    path = spec.found(folder) if folder and folder.is_dir() else None
    return {
        "measure": spec.measure,
        "state": _state(name, spec, path),
        "file": " or ".join(spec.archives)
        if spec.archives == spec.files
        else " or ".join(f"{archive}, {archive}.tar.gz" for archive in spec.archives),
        "contents": ", ".join(spec.files),
        "from": spec.source,
        "licence": spec.licence,
        "hash": f"git blob {spec.git_blob}"
        if spec.git_blob
        else "unknown: its publisher states none",
        "sha256": weights_hash(path) if path else None,
    }


def _state(name: str, spec: "ExtractorSpec", path: Path | None) -> str:
    from lidar_synth.errors import LidarSynthError
    from lidar_synth.lab.evaluate.extractors import load_extractor

    if path is None:
        return "missing"
    try:
        load_extractor(name, path)
    except LidarSynthError as error:
        return f"{path} is not usable: {error}"
    if spec.git_blob and not spec.is_published(path):
        return f"{path} is readable, but not the published file: its hash differs"
    return f"{path} is readable"
