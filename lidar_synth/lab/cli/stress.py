"""``lidar-synth stress``: a robustness card of a segmentation network."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, BadParameter, Option, echo

from lidar_synth.cli.options import Json, Reading, drop_missing, options_from


@options_from(Reading, after="sensor")
def stress(
    scans: Annotated[
        Path,
        Argument(metavar="SCANS", help="labelled scans: a dataset or folder"),
    ],
    model: Annotated[
        str | None,
        Argument(
            metavar="[MODEL]",
            help="module:function | a folder of predictions | an archive of lidar-bonnetal | town",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        Option(help="folder to which the corrupted scans are written"),
    ] = None,
    corruptions: Annotated[
        str,
        Option(help="names, separated by commas; all [the benchmark's eight]"),
    ] = "",
    baseline: Annotated[
        Path | None,
        Option(help="another network's card (--json), for CE [MinkUNet-18's figures]"),
    ] = None,
    view: Annotated[
        Path | None,
        Option(help="page (.html) or picture (.png) of the first scan, corrupted"),
    ] = None,
    sensor: Annotated[
        str | None, Option(help="sensor of SCANS: a preset or a YAML file")
    ] = None,
    seed: Annotated[int, Option(help="of the corruptions", min=0)] = 0,
    as_json: Json = False,
    **reading: Any,
) -> None:
    """Corrupts labelled scans by weather and failing sensors at three severities, and prints how
    much of its mIoU a network keeps, as the Robo3D benchmark measures it: RR is the share of the
    clean mIoU, CE the error divided by that of a baseline; the mean is over the benchmark's
    corruptions.

    module:function is called with each scan (points, reflectance) and returns the classes of its
    points, 0 to 18. A network that runs elsewhere predicts the scans of --out, which have
    SemanticKITTI's layout; MODEL is then the folder of its predictions, fog/heavy/**/000000.label.

    Published figures are of other scans: for a fair CE give the --baseline of a network of your
    own.

    \b
    Examples:
      lidar-synth stress my_scans town --view card.html
      lidar-synth stress SemanticKITTI my_network:predict --json > card.json
      lidar-synth stress my_scans --out stressed
      lidar-synth stress my_scans predictions --baseline card.json
    """
    import json

    from lidar_synth.files.claims import require_outside
    from lidar_synth.formats import open_scans
    from lidar_synth.lab.evaluate import robustness
    from lidar_synth.viz import view_suffix, write_view
    from lidar_synth.weather import CORRUPTIONS

    if model is None and out is None:
        raise BadParameter("give MODEL, --out, or both", param_hint="MODEL")
    if view is not None:
        view_suffix(view)
    names = robustness.NAMES_OF_BENCHMARK
    if corruptions:
        given = (name.strip() for name in corruptions.split(","))
        names = tuple(CORRUPTIONS if corruptions == "all" else dict.fromkeys(given))
    source = open_scans(scans, sensor=sensor, **drop_missing(reading))
    if out is not None:
        require_outside(out, scans)
        written = robustness.write_cases(source, out, names, seed)
        echo(f"{out}: {written} scans written", err=True)
    if model is None:
        return
    other = robustness.read_means(baseline) if baseline else robustness.BASELINE
    network = robustness.open_model(model)
    card = robustness.stress(source, network, names, other, seed, not as_json)
    if view is not None:
        notes = card.to_text().replace("\n", "\n\n")  # a paragraph for each row
        write_view(view, robustness.show_cases(source[0], names, seed), notes=notes)
    echo(json.dumps(card.to_dict(), indent=1) if as_json else card.to_text())
