"""``lidar-synth evaluate``: one set of scans beside another."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from lidar_synth.datasets.recordings import Recordings


def evaluate(
    real: Annotated[Path, typer.Argument(metavar="REAL", help="the reference: a dataset's root or a folder")],
    fake: Annotated[Path, typer.Argument(metavar="FAKE", help="the scans to judge, likewise")],
    protocol: Annotated[str, typer.Option(help="r2flow | lidm | town: whose definitions")],
    split: Annotated[str | None, typer.Option(help="split of REAL, r2flow/test for instance")] = None,
    sensor: Annotated[str | None, typer.Option(help="sensor of both: a preset or a YAML file")] = None,
    segmenter: Annotated[bool, typer.Option(help="also by the features of the segmenter that knows the town")] = False,
    training_data: Annotated[bool, typer.Option(help="compare even with what the model was trained on")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="the figures as JSON")] = False,
) -> None:
    """Says how far two sets of scans lie apart: Jensen-Shannon distance and MMD from above, features on request.

    The same names mean different things in different papers: figures of two protocols are not comparable. A reference
    that shares frames with what the model was trained on flatters it and is refused, whatever the names of the splits;
    the training data of the model's teacher and autoencoder count.

    \b
    Examples:
      lidar-synth evaluate KITTI-360 samples --protocol r2flow --split r2flow/test
      lidar-synth town town --scans 500 --seed 1 && lidar-synth evaluate town samples --protocol town --json
    """
    from lidar_synth.evaluate import PROTOCOLS
    from lidar_synth.evaluate import evaluate as compare
    from lidar_synth.evaluate.leakage import measured
    from lidar_synth.evaluate.segmentation import load_judge
    from lidar_synth.formats import layout_of, open_scans

    if protocol not in PROTOCOLS:
        raise typer.BadParameter(f"{protocol!r} is none of {', '.join(PROTOCOLS)}", param_hint="--protocol")
    sources = open_scans(real, sensor=sensor, split=split), open_scans(fake, sensor=sensor)
    if not training_data:
        _refuse_training_data(measured(sources[0], layout_of(real), real, split), real, fake)
    extractors = {"the town segmenter": load_judge().features} if segmenter else {}
    scores = compare(*sources, protocol, extractors, progress=not as_json)
    if as_json:
        typer.echo(json.dumps([asdict(score) for score in scores], indent=2))
    else:
        typer.echo("\n".join(map(str, scores)))


def _refuse_training_data(reference: "Recordings", real: Path, fake: Path) -> None:
    """Where generated scans say what their model was trained on, that is no reference."""
    from lidar_synth.errors import ConfigError
    from lidar_synth.evaluate.leakage import overlap, seen_by_model_of, undecided

    seen = seen_by_model_of(fake)
    if seen is None:
        return
    if shared := overlap(seen, reference):
        raise ConfigError(
            f"{real} as a reference for {fake}, whose model was trained on {shared} of it",
            "scans that the model was not trained on",
            "Another split, or a town of another --seed; --training-data to compare nevertheless.",
        )
    if not seen:
        typer.echo(
            f"{fake} does not tell which recordings its model was trained on: not compared with {real}", err=True
        )
    elif undecided(seen, reference):
        typer.echo(
            "KITTI's object set was drawn from the raw drives; whether the two share frames is not known", err=True
        )
