"""``lidar-synth label``: labels for scans of a dataset that publishes them in another form."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from lidar_synth.cli.options import Json, local_path

if TYPE_CHECKING:
    from lidar_synth.lab.kitti360.report import LabelReport


def label(
    dataset: Annotated[str, Argument(metavar="DATASET", help="kitti360")],
    root: Annotated[
        Path,
        Argument(metavar="ROOT", help="root of the dataset, with data_3d_semantics"),
    ],
    out: Annotated[
        Path,
        Argument(
            metavar="OUT", help="folder to write to; may be ROOT", parser=local_path
        ),
    ],
    split: Annotated[
        str, Option(help="drives to label, for instance r2flow/train")
    ] = "all",
    against: Annotated[
        Path | None,
        Option(help="folder with known labels per scan, to compare the new ones with"),
    ] = None,
    jobs: Annotated[
        int, Option(help="number of worker processes; each needs 1 to 3 GB")
    ] = 1,
    dry_run: Annotated[
        bool,
        Option("--dry-run", help="only count the frames that would get labels"),
    ] = False,
    as_json: Json = False,
) -> None:
    """Labels KITTI-360's scans from its accumulated clouds, with a confidence per point and a
    report by class.

    Run it again to resume an interrupted run.

    \b
    Examples:
      lidar-synth label kitti360 KITTI-360 labels --jobs 2
      lidar-synth label kitti360 KITTI-360 KITTI-360 --split r2flow/train --dry-run
      lidar-synth label kitti360 my_town labels --against my_town
    """
    import json

    from lidar_synth.errors import choose
    from lidar_synth.lab.kitti360.labels import label_scans, plan_labels

    choose("dataset", dataset, {"kitti360": None})
    if dry_run:
        plan = plan_labels(root, split)
        windows = len(plan.jobs)
        if as_json:
            print(json.dumps({"scans": plan.frames, "windows": windows}))
        else:
            print(f"{plan.frames} scans in {windows} windows would get labels")
        _print_frames(plan.without_pose, plan.outside, plan.without_clouds)
        return
    report = label_scans(
        root, out, split=split, against=against, jobs=jobs, progress=not as_json
    )
    if as_json:
        print(json.dumps(report.to_dict(), indent=1))
    else:
        _print(report, out)


def _print(report: "LabelReport", out: Path) -> None:
    print(
        f"{out}: {sum(report.labelled.values())} scans labelled, {report.kept} windows were "
        "complete already"
    )
    _print_frames(report.without_pose, report.outside, report.without_clouds)
    for drive, frames in report.misfits.items():
        if frames:
            print(
                f"  {drive}: {len(frames)} scans do not lie on the clouds and got no labels",
                file=sys.stderr,
            )
    for drive, metres in report.moved.items():
        if metres:
            far = (
                f"lay up to {max(metres):.2f} m off the clouds and were laid onto them: check its "
                "poses"
            )
            print(f"  {drive}: {len(metres)} scans {far}", file=sys.stderr)
    print(
        "\n"
        + "  ".join(f"{name} {share:.1%}" for name, share in report.totals().items())
        + "\n"
    )
    names = ("points", "confidence", "covered", "right")
    rows = report.classes()
    shown = [n for n in names if any(row[n] is not None for row in rows.values())]
    print(f"{'class':<15}" + "".join(f"{name:>12}" for name in shown))
    for name, row in rows.items():
        cells = [
            ""
            if row[n] is None
            else f"{row[n]:,}"
            if n == "points"
            else f"{row[n]:.3f}"
            for n in shown
        ]
        print(f"{name:<15}" + "".join(f"{cell:>12}" for cell in cells))


def _print_frames(
    without_pose: dict[str, int],
    outside: dict[str, int],
    without_clouds: tuple[str, ...],
) -> None:
    for counts, reason in (
        (without_pose, "have no pose"),
        (outside, "lie outside all windows"),
    ):
        for drive, count in counts.items():
            if count:
                print(
                    f"  {drive}: {count} frames {reason} and get no labels",
                    file=sys.stderr,
                )
    if without_clouds:
        print(
            f"  without accumulated clouds: {', '.join(without_clouds)}",
            file=sys.stderr,
        )
