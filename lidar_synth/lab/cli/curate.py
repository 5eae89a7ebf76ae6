"""``lidar-synth curate``: scores the scans of a bank and drops unusual ones."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option, echo

from lidar_synth.cli.bank import BankFolder
from lidar_synth.cli.options import (
    Json,
    Reading,
    drop_missing,
    local_path,
    options_from,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from lidar_synth.bank import Bank
    from lidar_synth.lab.curate import Scores


@options_from(Reading, after="reference")
def curate(
    bank: BankFolder,
    drop: Annotated[
        list[str] | None,
        Option(help="rule that selects scans to drop; repeatable, any match drops"),
    ] = None,
    out: Annotated[
        Path | None,
        Option(
            help="folder of the curated bank; without it nothing is written",
            parser=local_path,
        ),
    ] = None,
    reference: Annotated[
        str | None,
        Option(
            help="scans whose mean histograms to compare with [the bank's own]; the next options "
            "are of these"
        ),
    ] = None,
    sort: Annotated[
        str,
        Option(help="sort the list by this score, highest first; -SCORE: lowest first"),
    ] = "range",
    limit: Annotated[int, Option(min=0, help="number of scans to list")] = 10,
    plot: Annotated[
        Path | None,
        Option(
            help="PNG file to write with the distribution of every score",
            parser=local_path,
        ),
    ] = None,
    as_json: Json = False,
    jobs: Annotated[int, Option(min=1, help="number of worker processes")] = 1,
    **reading: Any,
) -> None:
    """Scores every scan of a bank, lists the most unusual ones, and writes a bank without those
    that match a rule.

    Scores are saved in BANK/scores.npz, those of a read-only bank or one at a URL in this folder;
    run it again to resume an interrupted run. The curated bank has its own index and links to the
    same shards. A rule joins conditions by "and"; each is a score, one of < <= > >=, and a number.
    Run it without --out to see what a rule would drop.

    \b
    Scores:
      range       distance of the range histogram to the mean histogram, 0 to 0.83
      labels      distance of the class histogram to the mean histogram, 0 to 0.83
      empty       share of cells without a return
      isolated    share of returns without three neighbours at almost the same range
      unlabelled  share of returns without a label
      floating    share of ground returns above the sensor
      speckle     share of neighbouring returns on one surface with different labels
      confidence  mean confidence of the returns
      duplicate   similarity to the most similar earlier scan, 0 to 1

    \b
    Examples:
      lidar-synth curate bank --plot scores.png
      lidar-synth curate bank --sort -confidence --limit 20
      lidar-synth curate bank --drop "confidence < 0.5" --drop "duplicate > 0.99" --out good
      lidar-synth curate bank --reference KITTI-360 --split r2flow/train \\
          --drop "range > 0.3 and empty > 0.4"
    """
    import numpy as np

    from lidar_synth.bake.edit import drop as write
    from lidar_synth.bank import Bank
    from lidar_synth.lab.curate import matching

    opened = Bank(bank)
    rules = drop or []
    _check(plot, out, rules, bank, sort)
    given = drop_missing(reading)
    scores = _scores(opened, bank, reference, given, jobs, progress=not as_json)
    dropped = np.zeros(len(opened), bool)
    for rule in rules:
        dropped |= matching(rule, scores.values)
    shown = _sorted(scores, sort)[:limit]
    if as_json:
        rows = [
            _row(opened, scores, number) | {"dropped": bool(dropped[number])}
            for number in shown.tolist()
        ]
        echo(
            json.dumps(
                {"scans": len(opened), "dropped": int(dropped.sum()), "listed": rows},
                indent=1,
            )
        )
    else:
        _table(opened, scores, shown, dropped)
    if plot is not None:
        _plot(plot, scores, dropped, bank)
    if out is None:
        return
    compared = f", compared with {scores.reference}" if scores.reference else ""
    why = (
        f"{dropped.sum()} of {len(opened)} scans left out by "
        f"{' or '.join(map(repr, rules))}{compared}"
    )
    index = write(
        opened, np.flatnonzero(dropped).tolist(), why, out, progress=not as_json
    )
    if not as_json:
        echo(f"{out}: {index.scans} scans in {len(index.shards)} shards; {why}")


def _check(
    plot: Path | None, out: Path | None, rules: list[str], bank: str, sort: str
) -> None:
    """Refuse options that do not fit, before any scan is scored."""
    import numpy as np

    from lidar_synth.errors import ConfigError, choose
    from lidar_synth.files.claims import require_outside
    from lidar_synth.lab.curate import MEANINGS, matching

    choose("score", sort.removeprefix("-"), MEANINGS)
    for rule in rules:
        matching(rule, dict.fromkeys(MEANINGS, np.zeros(1)))
    if plot is not None and plot.suffix != ".png":
        raise ConfigError(f"--plot {plot}", "a file that ends in .png")
    if out is not None and not rules:
        raise ConfigError(f"--out {out} without a rule", "--drop as well")
    if out is not None:
        require_outside(out, Path(bank))


def _scores(
    opened: "Bank",
    bank: str,
    reference: str | None,
    given: dict[str, Any],
    jobs: int,
    progress: bool,
) -> "Scores":
    """Read the saved scores of this bank and reference, or compute and save them."""
    from tempfile import TemporaryDirectory

    from lidar_synth.bank import is_url
    from lidar_synth.errors import ConfigError
    from lidar_synth.files.disk import hash_of_names
    from lidar_synth.formats import open_scans
    from lidar_synth.geometry import scan_hash
    from lidar_synth.lab.curate import (
        FILE,
        keep_features_in,
        read_scores,
        score,
        write_scores,
    )

    if given and reference is None:
        raise ConfigError(
            f"--{', --'.join(given)} without a reference", "--reference as well"
        )
    source = None if reference is None else open_scans(reference, **given)
    name = ""
    if source is not None:
        which = hash_of_names(
            [*source.ids, *(scan_hash(source[i]) for i in (0, len(source) // 2, -1))]
        )
        words = filter(None, (reference, given.get("split")))
        name = f"{len(source)} scans of {' '.join(words)} ({which[:8]})"
    elsewhere = is_url(bank) or not os.access(bank, os.W_OK)
    places = (Path(bank) / FILE, Path(f"scores-{opened.identity[:12]}.npz"))
    for saved in (read_scores(place) for place in places if place.is_file()):
        if (saved.bank, saved.reference) == (opened.identity, name):
            return saved
    path = places[elsewhere]
    keep = TemporaryDirectory() if elsewhere else keep_features_in(Path(bank))
    with keep as place:
        folder = Path(place)
        scores = score(
            opened, source, name=name, jobs=jobs, progress=progress, folder=folder
        )
        write_scores(path, scores)
    return scores


def _sorted(scores: "Scores", by: str) -> "NDArray[np.int64]":
    """Numbers of the scans, in the order of the list."""
    import numpy as np

    from lidar_synth.errors import choose

    values = choose("score", by.removeprefix("-"), scores.values)
    return np.argsort(values if by[0] == "-" else -values, kind="stable")


def _row(bank: "Bank", scores: "Scores", number: int) -> dict[str, Any]:
    twin = int(scores.twin[number])
    values = {
        name: round(float(values[number]), 4) for name, values in scores.values.items()
    }
    return {
        "number": number,
        "id": bank.ids[number],
        **values,
        "twin": twin if twin >= 0 else None,
    }


def _table(
    bank: "Bank",
    scores: "Scores",
    shown: "NDArray[np.int64]",
    dropped: "NDArray[np.bool_]",
) -> None:
    """Print percentiles of the scores, and the listed scans."""
    import numpy as np

    heads = ("lowest", "1 %", "median", "99 %", "highest")
    echo(f"{'':<12}" + "".join(f"{head:>10}" for head in heads))
    for name, values in scores.values.items():
        echo(
            f"{name:<12}"
            + "".join(f"{v:>10.4f}" for v in np.percentile(values, (0, 1, 50, 99, 100)))
        )
    echo(
        f"\n{'number':>8}  {'id':<24}"
        + "".join(f"{name:>12}" for name in scores.values)
        + "    twin"
    )
    for number in shown.tolist():
        twin = int(scores.twin[number])
        mark = "  dropped" if dropped[number] else ""
        figures = "".join(
            f"{values[number]:>12.4f}" for values in scores.values.values()
        )
        echo(f"{number:>8}  {bank.ids[number]:<24}{figures}{twin:>8}{mark}")
    echo(f"\n{dropped.sum()} of {len(bank)} scans match the rules")


def _plot(
    path: Path, scores: "Scores", dropped: "NDArray[np.bool_]", bank: str
) -> None:
    from lidar_synth.files.disk import write_file
    from lidar_synth.lab.curate import MEANINGS
    from lidar_synth.viz import histograms

    figure = histograms(
        scores.values,
        MEANINGS,
        dropped,
        f"{Path(bank).resolve().name}: {len(dropped)} scans, "
        f"{dropped.sum()} match the rules (orange)",
    )
    write_file(path, lambda file: figure.savefig(file, format="png"))
