"""``lidar-synth prove``: what synthetic scans add to a labelled dataset."""

from pathlib import Path
from typing import Annotated, Any

import typer

_ARMS = (
    "a training to compare, repeatable: real | longer | exchange | town | skin | "
    "generator | pretrain | pretrain-skin | pretrain-generator | alone | "
    "pretrain-learnt | quarter | quarter-town | recipe [exchange, recipe, quarter]; "
    "of detectors: real | gt_sampling | objects | half | first | quarter | town"
)


def prove(
    root: Annotated[
        Path,
        typer.Argument(
            metavar="ROOT", help="labelled scans, in any layout that is read"
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(help="folder of the page and of all that is needed to resume"),
    ] = Path("proof"),
    minutes: Annotated[
        float | None, typer.Option(min=1, help="limit of the time [none]")
    ] = None,
    labelled: Annotated[
        int | None,
        typer.Option(min=1, help="labelled scans of a training [all, at most 200]"),
    ] = None,
    arm: Annotated[list[str] | None, typer.Option(help=_ARMS)] = None,
    ratio: Annotated[
        list[float] | None,
        typer.Option(help="share of synthetic scans, repeatable [0.5]"),
    ] = None,
    iterations: Annotated[
        int, typer.Option(min=10, help="of each training; fewer if --minutes is short")
    ] = 1000,
    batch: Annotated[
        int | None,
        typer.Option(min=1, help="scans of an iteration [4, of a detector 2]"),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="repetitions of each training")] = 2,
    places: Annotated[
        str,
        typer.Option(
            help="how places are told apart: auto | drive | pose | stretch | stretch:N"
        ),
    ] = "auto",
    model: Annotated[
        str, typer.Option(help="of the arms with a generator: a name or a file")
    ] = "town",
    synthetic: Annotated[
        int, typer.Option(min=1, help="synthetic scans of each kind")
    ] = 150,
    classes: Annotated[
        str,
        typer.Option(
            help="pooled classes: auto | semantic_kitti | pandaset | kitti360 | nuscenes"
        ),
    ] = "auto",
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="CLASS", help="mean IoU over this class, repeatable"),
    ] = None,
    trainer: Annotated[
        str | None,
        typer.Option(
            help="your own trainer: a command with {job}, the mixture as YAML"
        ),
    ] = None,
    sensor: Annotated[
        str | None, typer.Option(help="sensor of the scans: a preset or a YAML file")
    ] = None,
    beams: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="evenly spaced beams that all scans keep, such as 32 [all]",
        ),
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="split of ROOT, if its layout has splits")
    ] = None,
    tests: Annotated[
        Path | None,
        typer.Option(help="labelled scans of other places to test on"),
    ] = None,
    pools: Annotated[
        Path | None,
        typer.Option(help="folder of the synthetic scans, to share between runs"),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="processes [one for each core]")
    ] = None,
    task: Annotated[
        str,
        typer.Option(help="segmentation | detection: cars and persons, by boxes"),
    ] = "segmentation",
    device: Annotated[
        str, typer.Option(help="of the small network: cpu | cuda | cuda:1 | ...")
    ] = "cpu",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="print the plan and do nothing")
    ] = False,
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
    from lidar_synth.lab.proof import CommandTrainer, ProofSettings, reference
    from lidar_synth.lab.proof import prove as run
    from lidar_synth.lab.proof.plan import describe
    from lidar_synth.lab.proof.planning import make_plan

    if task != "segmentation":
        further = {
            "--trainer": trainer,
            "--tests": tests,
            "--ratio": ratio,
            "--only": only,
            "--beams": beams,
            "--model": model != "town",
            "--classes": classes != "auto",
        }
        _check_task(task, [name for name, given in further.items() if given])
        options = {
            "labelled": labelled,
            "arms": tuple(arm or ()),
            "batch": batch,
            "iterations": iterations,
            "seeds": seeds,
            "places": places,
            "synthetic": synthetic,
        }
        source = open_scans(root, sensor=sensor, split=split)
        _prove_detection(source, out, options, minutes, pools, device, dry_run)
        return
    settings = ProofSettings(
        labelled=labelled,
        arms=tuple(arm or ProofSettings.arms),
        ratios=tuple(ratio or (0.5,)),
        iterations=iterations,
        batch=batch or 4,
        seeds=seeds,
        places=places,
        synthetic=synthetic,
        model=model,
        classes=classes,
        only=tuple(only or ()),
        beams=beams,
        columns=None if trainer else 512,
    )
    source = open_scans(root, sensor=sensor, split=split)
    others = open_scans(tests, sensor=sensor) if tests else None
    if dry_run:
        jobs = jobs or usable_cores()
        plan, _ = make_plan(
            source, settings, minutes, jobs, tests=others, device=device
        )
        typer.echo(describe(plan))
        return
    chosen = CommandTrainer(trainer) if trainer else reference
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
    typer.echo(f"{proof}\n\nThe page is {(out / 'index.html').resolve()}")


def _check_task(task: str, further: list[str]) -> None:
    from lidar_synth.errors import ConfigError, choose

    choose("--task", task, dict.fromkeys(("segmentation", "detection")))
    if further:
        raise ConfigError(
            f"--task {task} with {', '.join(further)}",
            "--task detection without options of segmentation",
        )


def _prove_detection(
    source: Any,
    out: Path,
    options: dict[str, Any],
    minutes: float | None,
    pools: Path | None,
    device: str,
    dry_run: bool,
) -> None:
    from lidar_synth.lab.proof.detection import DetectionSettings, prove_detection
    from lidar_synth.lab.proof.detection.page import format_table
    from lidar_synth.lab.proof.detection.study import (
        DetectionWork,
        describe,
        with_boxes,
    )

    given = {name: value for name, value in options.items() if value}
    settings = DetectionSettings(**given)
    if dry_run:
        work = DetectionWork(with_boxes(source), settings, out, pools or out)
        typer.echo(describe(work))
        return
    values = prove_detection(
        source,
        out,
        settings,
        minutes=float("inf") if minutes is None else minutes,
        pools=pools,
        device=device,
    )
    page = (out / "index.html").resolve()
    typer.echo(f"{format_table(values)}\n\nThe page is {page}")
