"""``lidar-synth check-mix``: compares the scans of a mixture with real ones before training."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option, echo

from lidar_synth.cli.options import Reading, drop_missing, options_from

if TYPE_CHECKING:
    from lidar_synth.geometry import Scan
    from lidar_synth.mixing.meaning import Meaning


@options_from(Reading, after="sensor")
def check_mix(
    mix: Annotated[
        Path,
        Argument(
            metavar="MIX.yaml", help="settings of a mixture, as trainers take them"
        ),
    ],
    real: Annotated[
        Path,
        Argument(
            metavar="REAL", help="folder or root of the dataset with the real scans"
        ),
    ],
    out: Annotated[
        Path | None,
        Option(help="picture to write: .png (sheet) or .html (interactive page)"),
    ] = None,
    count: Annotated[
        int, Option(min=4, max=64, help="number of scans of each kind")
    ] = 8,
    sensor: Annotated[
        str | None, Option(help="sensor of the real scans [named by the files]")
    ] = None,
    **reading: Any,
) -> None:
    """Compares synthetic scans with real ones: points, rows, ground, columns and classes, side by
    side.

    Exit status 2 if they certainly mean something else: another unit, axis, origin, scale or
    numbering of classes.

    \b
    Examples:
      lidar-synth check-mix mix.yaml kitti/ --out mix.png
    """
    from lidar_synth.errors import ConfigError
    from lidar_synth.formats import open_scans
    from lidar_synth.geometry import spread
    from lidar_synth.mixing.compare import USUAL_IGNORE, report
    from lidar_synth.mixing.meaning import (
        contradictions,
        measure_tables,
        rows_in_use,
        table_of,
    )
    from lidar_synth.mixing.settings import (
        mix_for_trainer as make_mixture,
        read_settings,
    )
    from lidar_synth.viz import view_suffix, write_view

    if out is not None:
        view_suffix(out)
    source = open_scans(real, sensor=sensor, **drop_missing(reading))
    settings = read_settings(mix)
    # Ids of the trainer's files; here both kinds have train ids.
    settings.pop("classes", None)
    mixture = make_mixture(len(source), settings, weighs=True)
    with suppress(ConfigError):  # the schedule ends
        epochs = (e for e in range(100) if mixture.plan(e).synthetics)
        mixture.set_epoch(next(epochs, 0))
    chosen = [i for i in range(len(mixture)) if mixture.domain(i)][:count]
    if not chosen:
        raise ConfigError("a mixture without synthetic scans", "a ratio above 0")
    kinds: list[list[Scan]] = [
        [source[i] for i in spread(range(len(source)), count)],
        [mixture[i] for i in chosen],
    ]
    theirs, ours = (
        measure_tables([table_of(scan) for scan in scans], USUAL_IGNORE)
        for scans in kinds
    )
    _print(theirs, ours, *(rows_in_use(scans) for scans in kinds))
    if out is not None:
        write_view(
            out,
            [*kinds[0][:4], *kinds[1][:4]],
            title=f"{real.resolve().name}, then {mix.name}",
        )
        echo(f"{out}: real scans, then synthetic ones")
    report(list(contradictions(theirs, ours)))


def _print(real: "Meaning", synthetic: "Meaning", *rows: int) -> None:
    from lidar_synth.datasets.classes import NAMES
    from lidar_synth.mixing.meaning import NAMES_OF_COLUMNS

    print(f"{'':<22}{'real':>28}{'synthetic':>28}")
    both = (real, synthetic)
    lines = [
        ("points of a scan", [f"{each.points:,.0f}" for each in both]),
        ("rows in use", [str(each) for each in rows]),
        ("ground, m", [f"{each.ground:.2f}" for each in both]),
    ]
    for number, name in enumerate(NAMES_OF_COLUMNS):
        lines.append(
            (
                f"{name}: 1, 50, 99 %",
                [
                    "  ".join(f"{v:.3g}" for v in each.quantiles[number])
                    for each in both
                ],
            )
        )
    for value in sorted(real.classes.keys() | synthetic.classes.keys()):
        looks = [each.classes.get(value) for each in both]
        name = NAMES[value] if value < len(NAMES) else str(value)
        cells = [
            "-"
            if k is None
            else f"{k.share:.1%}  {k.height:.1f} m high  {k.range:.0f} m away"
            for k in looks
        ]
        lines.append((f"{value} {name}", cells))
    for name, cells in lines:
        print(f"{name:<22}" + "".join(f"{cell:>28}" for cell in cells))
