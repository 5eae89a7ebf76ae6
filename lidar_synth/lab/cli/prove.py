"""``lidar-synth prove``: what synthetic scans add to a labelled dataset."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option, echo

from lidar_synth.cli.options import Reading, drop_missing, options_from

_ARMS = (
    "a training to compare, repeatable: real | longer | exchange | town | skin | "
    "generator | pretrain | pretrain-skin | pretrain-generator | alone | "
    "pretrain-learnt | quarter | quarter-town | recipe [exchange, recipe, quarter]; "
    "of detectors: real | gt_sampling | objects | half | first | layouts | quarter | town"
)


@options_from(Reading, after="sensor")
def prove(
    root: Annotated[
        Path,
        Argument(metavar="ROOT", help="labelled scans, in any layout that is read"),
    ],
    out: Annotated[
        Path,
        Option(help="folder of the page and of all that is needed to resume"),
    ] = Path("proof"),
    minutes: Annotated[
        float | None, Option(min=1, help="limit of the time [none]")
    ] = None,
    labelled: Annotated[
        int | None,
        Option(min=1, help="labelled scans of a training [all, at most 200]"),
    ] = None,
    arm: Annotated[list[str] | None, Option(help=_ARMS)] = None,
    ratio: Annotated[
        list[float] | None,
        Option(help="(segmentation) share of synthetic scans, repeatable [0.5]"),
    ] = None,
    iterations: Annotated[
        int | None,
        Option(
            min=10,
            help="of each training; fewer if --minutes is short [1000, of a detector 800]",
        ),
    ] = None,
    batch: Annotated[
        int | None,
        Option(min=1, help="scans of an iteration [4, of a detector 2]"),
    ] = None,
    seeds: Annotated[
        int | None, Option(min=1, help="repetitions of each training [2]")
    ] = None,
    places: Annotated[
        str | None,
        Option(
            help="how places are told apart: drive | pose | stretch | stretch:N [auto]"
        ),
    ] = None,
    model: Annotated[
        str | None,
        Option(
            help="(segmentation) model of the arms with a generator: a name or a file [town]"
        ),
    ] = None,
    synthetic: Annotated[
        int | None,
        Option(min=1, help="synthetic scans of each kind [150, for a detector 120]"),
    ] = None,
    classes: Annotated[
        str | None,
        Option(
            help="(segmentation) pooled classes: semantic_kitti | pandaset | kitti360 | nuscenes "
            "[auto]"
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        Option(
            metavar="CLASS", help="(segmentation) mean IoU over this class, repeatable"
        ),
    ] = None,
    trainer: Annotated[
        str | None,
        Option(
            help="(segmentation) your own trainer: a command with {job}, the mixture as YAML"
        ),
    ] = None,
    sensor: Annotated[
        str | None, Option(help="sensor of the scans: a preset or a YAML file")
    ] = None,
    beams: Annotated[
        int | None,
        Option(
            metavar="N",
            help="(segmentation) evenly spaced beams that all scans keep, such as 32 [all]",
        ),
    ] = None,
    tests: Annotated[
        Path | None,
        Option(help="(segmentation) labelled scans of other places to test on"),
    ] = None,
    pools: Annotated[
        Path | None,
        Option(help="folder of the synthetic scans, to share between runs"),
    ] = None,
    jobs: Annotated[
        int | None, Option(min=1, help="(segmentation) processes [one for each core]")
    ] = None,
    task: Annotated[
        str,
        Option(help="segmentation | detection: cars and persons, by boxes"),
    ] = "segmentation",
    device: Annotated[
        str, Option(help="of the small network: cpu | cuda | cuda:1 | ...")
    ] = "cpu",
    dry_run: Annotated[
        bool, Option("--dry-run", help="print the plan and do nothing")
    ] = False,
    **reading: Any,
) -> None:
    """Trains a small network with and without synthetic scans, and tests on places that were left
    out, or on other scans.

    Writes a page with paired differences and their intervals, index.html in the output folder. Run
    it again to resume, or to add arms, shares and seeds.

    \b
    Examples:
      lidar-synth prove SemanticKITTI --labelled 24 --minutes 60
      lidar-synth prove SemanticKITTI --split train --labelled 24 --tests validation_scans
      lidar-synth prove KITTI --task detection --labelled 8 --arm objects --arm first
      lidar-synth prove SemanticKITTI --arm exchange --arm town --arm pretrain \\
          --ratio 0.25 --ratio 0.5 --dry-run
    """
    from lidar_synth.files.processes import usable_cores
    from lidar_synth.formats import open_scans
    from lidar_synth.lab.proof import (
        CommandTrainer,
        ProofSettings,
        prove as run,
        reference,
    )
    from lidar_synth.lab.proof.plan import describe
    from lidar_synth.lab.proof.planning import make_plan

    given = drop_missing(reading)
    both = {
        "labelled": labelled,
        "arms": tuple(arm or ()) or None,
        "iterations": iterations,
        "batch": batch,
        "seeds": seeds,
        "places": places,
        "synthetic": synthetic,
    }
    own: dict[str, Any] = {"model": model, "classes": classes, "beams": beams}
    if task != "segmentation":
        more = {
            "trainer": trainer,
            "tests": tests,
            "jobs": jobs,
            "ratio": ratio or None,
            "only": only or None,
        }
        _check_task(task, own | more)
        source = open_scans(root, sensor=sensor, **given)
        _prove_detection(
            source,
            out,
            drop_missing(both),
            dry_run,
            device=device,
            **drop_missing({"minutes": minutes, "pools": pools}),
        )
        return
    settings = ProofSettings(
        **drop_missing(both | own),
        ratios=tuple(ratio or ProofSettings.ratios),
        only=tuple(only or ()),
        columns=None if trainer else 512,
    )
    chosen = CommandTrainer(trainer) if trainer else reference
    source = open_scans(root, sensor=sensor, **given)
    # Split and layout are of ROOT.
    given |= {"split": None, "layout": None}
    others = open_scans(tests, sensor=sensor, **given) if tests else None
    if dry_run:
        jobs = jobs or usable_cores()
        plan, _ = make_plan(
            source, settings, minutes, jobs, tests=others, device=device
        )
        echo(describe(plan))
        return
    proof = run(
        source,
        out,
        settings,
        minutes=minutes,
        jobs=jobs,
        trainer=chosen,
        pools=pools,
        tests=others,
        device=device,
    )
    echo(f"{proof}\n\nThe page is {(out / 'index.html').resolve()}")


def _check_task(task: str, of_segmentation: dict[str, Any]) -> None:
    from lidar_synth.errors import ConfigError, choose

    choose("--task", task, dict.fromkeys(("segmentation", "detection")))
    if given := drop_missing(of_segmentation):
        raise ConfigError(
            f"--task {task} with --{', --'.join(given)}",
            f"none of the options of segmentation: --{', --'.join(of_segmentation)}",
        )


def _prove_detection(
    source: Any, out: Path, given: dict[str, Any], dry_run: bool, **options: Any
) -> None:
    from lidar_synth.lab.proof.detection import DetectionSettings, prove_detection
    from lidar_synth.lab.proof.detection.page import format_table
    from lidar_synth.lab.proof.detection.study import (
        DetectionWork,
        describe,
        with_boxes,
    )

    settings = DetectionSettings(**given)
    if dry_run:
        work = DetectionWork(with_boxes(source), settings, out, out)
        echo(describe(work))
        return
    values = prove_detection(source, out, settings, **options)
    echo(f"{format_table(values)}\n\nThe page is {(out / 'index.html').resolve()}")
