"""``lidar-synth curate``: scores of a bank's scans, and a bank without the odd ones."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidar_synth.cli.bank import BankFolder

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from lidar_synth.bake.curate import Scores
    from lidar_synth.bank import Bank


def curate(
    bank: BankFolder,
    drop: Annotated[list[str] | None, typer.Option(help="rule; several drop what any of them means")] = None,
    out: Annotated[Path | None, typer.Option(help="folder of the curated bank; without it nothing is dropped")] = None,
    reference: Annotated[str | None, typer.Option(help="scans to compare with [the bank's own mean]")] = None,
    split: Annotated[str | None, typer.Option(help="of the reference, r2flow/test for instance")] = None,
    sort: Annotated[str, typer.Option(help="the score that the list goes by, highest first; -SCORE: lowest")] = "range",
    limit: Annotated[int, typer.Option(min=0, help="scans to list")] = 10,
    plot: Annotated[Path | None, typer.Option(help="PNG with the distribution of every score")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="scores as JSON")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="worker processes")] = 1,
) -> None:
    """Scores every scan of a bank, lists the oddest, and makes a bank without those that a rule means.

    Scores are kept in BANK/scores.npz; run it again to resume it where it was stopped. The curated bank is an index: it
    shares the shards, and no shard is written anew. A rule is conditions joined by "and", each a score, one of < <= >
    >=, and a number; run it without --out to see what it would drop.

    \b
    Scores:
      range       how far the histogram of ranges lies from the mean one, 0 to 0.83
      labels      how far that of the classes does
      empty       share of cells without a return
      unlabelled  share of returns without a label
      floating    share of ground returns above the sensor
      speckle     share of neighbours on one surface with two labels
      confidence  mean of the returns
      duplicate   likeness to the most similar earlier scan that is found, 0 to 1
    \b
    Examples:
      lidar-synth curate bank --plot scores.png
      lidar-synth curate bank --sort -confidence --limit 20
      lidar-synth curate bank --drop "confidence < 0.5" --drop "duplicate > 0.99" --out good
      lidar-synth curate bank --reference KITTI-360 --split r2flow/train --drop "range > 0.3 and empty > 0.4"
    """
    import numpy as np

    from lidar_synth.bake.curate import matching
    from lidar_synth.bake.edit import drop as write
    from lidar_synth.bank import Bank

    opened, rules = Bank(bank), drop or []
    _check(plot, out, rules)
    scores = _scores(opened, bank, reference, split, jobs, progress=not as_json)
    dropped = np.zeros(len(opened), bool)
    for rule in rules:
        dropped |= matching(rule, scores.values)
    shown = _sorted(scores, sort)[:limit]
    if as_json:
        rows = [_row(opened, scores, number) | {"dropped": bool(dropped[number])} for number in shown.tolist()]
        typer.echo(json.dumps({"scans": len(opened), "dropped": int(dropped.sum()), "listed": rows}, indent=1))
    else:
        _table(opened, scores, shown, dropped)
    if plot is not None:
        _plot(plot, scores, dropped, bank)
    if out is None:
        return
    compared = f", beside {scores.reference}" if scores.reference else ""
    why = f"{dropped.sum()} of {len(opened)} scans left out by {' or '.join(map(repr, rules))}{compared}"
    index = write(opened, np.flatnonzero(dropped).tolist(), why, out, progress=not as_json)
    if not as_json:
        typer.echo(f"{out}: {index.scans} scans in {len(index.shards)} shards; {why}")


def _check(plot: Path | None, out: Path | None, rules: list[str]) -> None:
    from lidar_synth.errors import ConfigError

    if plot is not None and plot.suffix != ".png":
        raise ConfigError(f"--plot {plot}", "a file that ends in .png")
    if out is not None and not rules:
        raise ConfigError(f"--out {out} without a rule", "--drop, too")


def _scores(
    opened: "Bank", bank: Path, reference: str | None, split: str | None, jobs: int, progress: bool
) -> "Scores":
    """From the file where it belongs to this bank and this reference; else made, and kept."""
    from lidar_synth.bake.curate import FILE, kept_in, read_scores, score, write_scores
    from lidar_synth.errors import ConfigError
    from lidar_synth.formats import open_scans

    if split is not None and reference is None:
        raise ConfigError(f"--split {split} of nothing", "--reference, too")
    source = None if reference is None else open_scans(reference, split=split)
    name = "" if source is None else f"{len(source)} scans of {' '.join(filter(None, (reference, split)))}"
    path = bank / FILE
    if path.is_file():
        there = read_scores(path)
        if (there.bank, there.reference) == (opened.identity, name):
            return there
    with kept_in(bank) as folder:
        scores = score(opened, source, name=name, jobs=jobs, progress=progress, folder=folder)
        write_scores(path, scores)
    return scores


def _sorted(scores: "Scores", by: str) -> "NDArray[np.int64]":
    """Numbers of the scans, the one to show first first."""
    import numpy as np

    from lidar_synth.formats.source import choose

    values = choose("score", by.removeprefix("-"), scores.values)
    return np.argsort(values if by[0] == "-" else -values, kind="stable")


def _row(bank: "Bank", scores: "Scores", number: int) -> dict[str, Any]:
    twin = int(scores.twin[number])
    values = {name: round(float(values[number]), 4) for name, values in scores.values.items()}
    return {"number": number, "id": bank.ids[number], **values, "twin": twin if twin >= 0 else None}


def _table(bank: "Bank", scores: "Scores", shown: "NDArray[np.int64]", dropped: "NDArray[np.bool_]") -> None:
    """How the scores are distributed, and some scans."""
    import numpy as np

    heads = ("lowest", "1 %", "median", "99 %", "highest")
    typer.echo(f"{'':<12}" + "".join(f"{head:>10}" for head in heads))
    for name, values in scores.values.items():
        typer.echo(f"{name:<12}" + "".join(f"{v:>10.4f}" for v in np.percentile(values, (0, 1, 50, 99, 100))))
    typer.echo(f"\n{'number':>8}  {'id':<24}" + "".join(f"{name:>12}" for name in scores.values) + "    twin")
    for number in shown.tolist():
        twin, mark = int(scores.twin[number]), "  dropped" if dropped[number] else ""
        figures = "".join(f"{values[number]:>12.4f}" for values in scores.values.values())
        typer.echo(f"{number:>8}  {bank.ids[number]:<24}{figures}{twin:>8}{mark}")
    typer.echo(f"\n{dropped.sum()} of {len(bank)} scans match the rules")


def _plot(path: Path, scores: "Scores", dropped: "NDArray[np.bool_]", bank: Path) -> None:
    from lidar_synth.bake.curate import MEANINGS
    from lidar_synth.files.disk import write_file
    from lidar_synth.viz import histograms

    title = f"{bank.resolve().name}: {len(dropped)} scans, {dropped.sum()} match the rules (orange)"
    figure = histograms(scores.values, MEANINGS, dropped, title)
    write_file(path, lambda file: figure.savefig(file, format="png"))
