"""``lidar-synth evaluate``: compares a set of generated scans with a reference set."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, BadParameter, Option, echo

from lidar_synth.cli.options import Json, Reading, drop_missing, options_from

if TYPE_CHECKING:
    from lidar_synth.geometry import Source


@options_from(Reading, after="sensor")
def evaluate(
    real: Annotated[
        Path,
        Argument(
            metavar="REAL", help="reference scans: root of a dataset, or a folder"
        ),
    ],
    fake: Annotated[
        Path,
        Argument(
            metavar="FAKE", help="scans to evaluate: root of a dataset, or a folder"
        ),
    ],
    protocol: Annotated[
        str | None,
        Option(
            help="definitions of the metrics: r2flow | lidm | r3dpa | spiral | town | general"
        ),
    ] = None,
    judge: Annotated[
        Path | None,
        Option(
            help="archive of lidar-bonnetal: how well its network recognises both sets"
        ),
    ] = None,
    objects: Annotated[
        bool,
        Option(
            help="how well a small classifier tells the cars and persons of both sets apart"
        ),
    ] = False,
    detector: Annotated[
        Path | None,
        Option(
            help="OpenPCDet's PointPillars or CenterPoint: how well it finds the boxes of both sets"
        ),
    ] = None,
    columns: Annotated[
        int | None, Option(help="width of the judge's grid; its own by default")
    ] = None,
    sensor: Annotated[
        str | None,
        Option(
            help="sensor of both sets: a preset or a YAML file; the next options are of REAL, "
            "and of FAKE where it needs them"
        ),
    ] = None,
    segmenter: Annotated[
        bool, Option(help="add metrics on features of the town's segmenter")
    ] = False,
    weights: Annotated[
        Path | None,
        Option(
            help="folder with published weights, for FRD, FRID, FPD, FSVD, FPVD, FLD"
        ),
    ] = None,
    extended: Annotated[
        bool,
        Option(
            help="of features, add unbiased forms, precision, recall, density, coverage"
        ),
    ] = False,
    intervals: Annotated[
        int, Option(help="resamples for 95 % intervals, for instance 200")
    ] = 0,
    beside: Annotated[
        bool, Option(help="print the published figures of the protocol, too")
    ] = False,
    cache: Annotated[
        Path | None, Option(help="folder in which features are kept")
    ] = None,
    processes: Annotated[
        int, Option(help="processes that extract features; needs --cache", min=1)
    ] = 1,
    training_data: Annotated[
        bool, Option(help="permit a reference that the model was trained on")
    ] = False,
    anyway: Annotated[
        bool,
        Option(help="compare fewer scans than the paper's, and other sensors"),
    ] = False,
    as_json: Json = False,
    **reading: Any,
) -> None:
    """Compares two sets of scans by a protocol: bird's-eye views (JSD, MMD), features where the
    published weights are at hand, ranges or classes.

    With --judge, a segmentation network that was trained on real streets predicts the classes of
    both sets: accuracy, IoU by class, the most frequent confusions and feature distances.

    With --objects, cars and persons of both sets are compared at the same distance and seen width:
    AUC of a classifier at real places that it has not seen, returns, surfaces, roughness.

    With --detector, a detector that was trained on KITTI or nuScenes looks for the boxes of both
    sets: average precision and recall by class and distance.

    Papers define metrics of the same name differently: scores of two protocols are not comparable.
    Fewer scans than the protocol's paper compares, and other sensors than its own, are refused. A
    reference that shares frames with the model's training data is refused, because it flatters the
    model; the training data of its teacher and autoencoder count too, and the names of the splits
    do not matter.

    \b
    Examples:
      lidar-synth evaluate KITTI-360 samples --protocol r2flow --split r2flow/test \\
          --weights metrics --beside
      lidar-synth town streets --scans 500 --seed 1 && \\
          lidar-synth evaluate streets samples --protocol town --json
      lidar-synth evaluate SemanticKITTI streets --judge squeezeseg --columns 1024
      lidar-synth evaluate SemanticKITTI streets --objects
      lidar-synth evaluate KITTI streets --detector pointpillar_7728.pth
    """
    from lidar_synth.errors import choose
    from lidar_synth.formats import open_scans
    from lidar_synth.lab.evaluate import PROTOCOLS, evaluate as compare
    from lidar_synth.lab.evaluate.features import describe_missing
    from lidar_synth.lab.evaluate.leakage import refuse_training_data
    from lidar_synth.lab.evaluate.published import compare_published as published
    from lidar_synth.lab.evaluate.segmentation import load_judge

    judges = [judge, detector, objects or None]
    judged = sum(given is not None for given in judges)
    if beside and (as_json or judged):
        raise BadParameter(
            "goes with --protocol and prints tables: leave out --json",
            param_hint="--beside",
        )
    if (protocol is not None) + judged != 1:
        raise BadParameter(
            "give --protocol, --judge, --objects or --detector, one of them",
            param_hint="--protocol",
        )
    of_protocol = {
        "--segmenter": segmenter,
        "--weights": weights,
        "--extended": extended,
        "--intervals": intervals,
        "--cache": cache,
        "--processes": processes > 1,
        "--anyway": anyway,
    }
    for needed, chosen, options in (
        ("--protocol", protocol, of_protocol),
        ("--judge", judge, {"--columns": columns}),
    ):
        for option, given in options.items():
            if given and chosen is None:
                raise BadParameter(f"goes with {needed}", param_hint=option)
    if protocol is not None:
        rules = choose("--protocol", protocol, PROTOCOLS)
    of_real = drop_missing({"sensor": sensor, **reading})
    sources = (open_scans(real, **of_real), _open_fake(fake, of_real))
    if not training_data and (note := refuse_training_data(*sources, reading["split"])):
        echo(note, err=True)
    if judge is not None:
        _recognition(judge, columns, sources, as_json)
        return
    if detector is not None:
        _boxes(detector, sources, as_json)
        return
    if objects:
        _objects(sources, as_json)
        return
    extractors = {"the town segmenter": load_judge().features} if segmenter else {}
    left_out: dict[str, str] = {}
    scores = compare(
        *sources,
        rules,
        extractors,
        progress=not as_json,
        weights=weights,
        replicates=intervals,
        extended=extended,
        anyway=anyway,
        training_data=True,  # refused above, with the split
        cache=cache,
        processes=processes,
        left_out=left_out,
    )
    _print([asdict(s) for s in scores], "\n".join(map(str, scores)), as_json)
    for note in filter(None, (describe_missing(left_out, rules), rules.unverified)):
        echo(note, err=True)
    if beside:
        echo(f"\n{published(scores)}")


def _open_fake(path: Path, given: dict[str, Any]) -> "Source":
    """FAKE, with the options of REAL but its layout and split, where it is not read without."""
    from lidar_synth.errors import ConfigError, DataError
    from lidar_synth.formats import open_scans

    plain = {name: given[name] for name in ("sensor", "on_bad") if name in given}
    try:
        source = open_scans(path, **plain)
        source.load(0)
        return source
    except DataError as error:
        try:
            return open_scans(path, **given | {"layout": None, "split": None})
        except ConfigError:  # its layout does not take them
            raise error from None


def _print(figures: object, text: str, as_json: bool) -> None:
    echo(json.dumps(figures, indent=2) if as_json else text)


def _objects(sources: "tuple[Source, Source]", as_json: bool) -> None:
    """Print how well objects of both sets can be told apart."""
    from lidar_synth.lab.evaluate.objects import as_text, compare_objects

    figures = compare_objects(*sources)
    _print(figures, as_text(figures), as_json)


def _boxes(path: Path, sources: "tuple[Source, Source]", as_json: bool) -> None:
    """Print how well a detector finds the boxes of both sets."""
    from lidar_synth.lab.proof.detection.detector_judge import (
        as_text,
        load_detector,
        recognise_boxes,
    )

    network = load_detector(path)
    figures = {
        name: recognise_boxes(network, source, name, not as_json)
        for source, name in zip(sources, ("real", "fake"), strict=True)
    }
    _print(figures, as_text(figures), as_json)


def _recognition(
    folder: Path, columns: int | None, sources: "tuple[Source, Source]", as_json: bool
) -> None:
    """Print how well the network of an archive recognises both sets."""
    from lidar_synth.lab.evaluate.recognition import as_text, compare, recognise
    from lidar_synth.lab.evaluate.street_judge import load_archive

    judge = load_archive(folder, columns)
    real, fake = (
        recognise(judge, s, name, not as_json)
        for s, name in zip(sources, ("real", "fake"), strict=True)
    )
    figures = compare(real, fake)
    _print(figures, as_text(figures), as_json)
