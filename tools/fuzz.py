"""Fuzz the readers: read thousands of mutated files, each under a limit of memory and time, and
print a table.

    python tools/fuzz.py [--cases 5000] [--reader NAME ...] [--seed 0] [--jobs 2] [--keep FOLDER]
    python tools/fuzz.py --reader NAME --case NUMBER --keep FOLDER

A case is a function of reader, seed and number (and of the versions of the libraries that write the
valid files). Reading it has to give a correct result or one of the package's errors. All other
cases are listed below the table, and their files are kept. With ``--case`` one case is written to
the folder and read in this process, without limits, to inspect its error. The exit status is 1 if
any case has a flaw. Linux only. docs/research/reliability.md has the table.
"""

import argparse
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from fuzzing.cases import Cases
from fuzzing.checks import flaws
from fuzzing.run import FLAWS, Report, fuzz
from fuzzing.targets import TARGETS
from fuzzing.worker import (
    DIED,
    EQUAL,
    FOREIGN,
    MEMORY,
    REFUSED,
    SLOW,
    SOUND,
    UNSOUND,
    Limits,
)

PART = 1250
"""Cases that one process reads; readers that are fuzzed for longer are spread over several."""

COLUMNS = {
    "read equal": (EQUAL,),
    "read otherwise, sound": (SOUND,),
    "refused": (REFUSED,),
    "unsound": (UNSOUND,),
    "foreign errors": (FOREIGN,),
    "deaths": (DIED,),
    "memory": (MEMORY,),
    "time": (SLOW,),
}


def main() -> None:
    """Prints the table and the flaws."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=5000, help="for each reader")
    parser.add_argument(
        "--reader",
        action="append",
        choices=TARGETS,
        help="a reader to fuzz; repeat for several [default: all]",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--jobs", type=int, default=2, help="processes that read at a time"
    )
    parser.add_argument(
        "--memory",
        type=float,
        default=500,
        help="limit of memory of a case, in megabytes",
    )
    parser.add_argument(
        "--seconds", type=float, default=5, help="limit of time of a case, in seconds"
    )
    parser.add_argument(
        "--keep", type=Path, help="folder for the files of the cases with a flaw"
    )
    parser.add_argument(
        "--case",
        type=int,
        help="write this case to --keep, and read it in this process",
    )
    given = parser.parse_args()
    names = given.reader or list(TARGETS)
    if given.case is not None:
        if len(names) != 1 or given.keep is None:
            parser.error("--case needs one --reader and --keep")
        print(look(names[0], given.seed, given.case, given.keep))
        return
    limits = Limits(int(given.memory * 1e6), given.seconds)
    reports, failures = run(names, given.cases, given.seed, given.jobs, limits)
    print(table(reports))
    for failure in failures:
        print(f"the harness failed, and some cases of a reader are missing: {failure}")
    for name, report in reports.items():
        print_flaws(name, given.seed, report, given.keep)
    if failures or any(report.flaws for report in reports.values()):
        sys.exit(1)


def run(
    names: list[str], cases: int, seed: int, jobs: int, limits: Limits
) -> tuple[dict[str, Report], list[str]]:
    """A report for each reader, and what went wrong with the harness itself."""
    failures: list[str] = []
    reports = {name: Report() for name in names}
    parts = [
        (name, range(cases)[i : i + PART])
        for i in range(0, cases, PART)
        for name in names
    ]
    with (
        tqdm(total=cases * len(names), unit="case") as bar,
        ThreadPoolExecutor(jobs) as pool,
    ):

        def one(name: str, numbers: range) -> tuple[str, Report]:
            try:
                return name, fuzz(
                    name, TARGETS[name], numbers, seed, limits, lambda _: bar.update()
                )
            except RuntimeError as error:
                failures.append(f"cases {numbers.start} to {numbers.stop - 1}: {error}")
                return name, Report()

        for name, report in pool.map(lambda part: one(*part), parts):
            reports[name].merge(report)
    return reports, failures


def table(reports: dict[str, Report]) -> str:
    """The counts in Markdown."""
    head = ["reader", "cases", *COLUMNS, "peak MB", "slowest s"]
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    for name, report in reports.items():
        counts = [
            sum(report.counts[verdict] for verdict in verdicts)
            for verdicts in COLUMNS.values()
        ]
        row = [
            name,
            report.cases,
            *counts,
            f"{report.peak / 1e6:.0f}",
            f"{report.slowest:.2f}",
        ]
        lines.append(
            f"| {' | '.join(f'{v:,}' if isinstance(v, int) else v for v in row)} |"
        )
    return "\n".join(lines)


def print_flaws(name: str, seed: int, report: Report, keep: Path | None) -> None:
    """Each kind of flaw once, with its first cases."""
    kinds = Counter((flaw.verdict, flaw.detail[:90]) for flaw in report.flaws)
    for (verdict, detail), count in kinds.most_common():
        numbers = [
            f.number
            for f in report.flaws
            if (f.verdict, f.detail[:90]) == (verdict, detail)
        ][:3]
        print(f"{name} --seed {seed} --case {numbers}: {count} x {verdict}: {detail!r}")
        for number in numbers if keep is not None else ():
            Cases(name, TARGETS[name], seed, keep / name / f"{seed}-{number}").place(
                number
            )


def look(name: str, seed: int, number: int, keep: Path) -> str:
    """Write the file of a case, read it, and describe the outcome."""
    folder = keep / name / f"{seed}-{number}"
    root = Cases(name, TARGETS[name], seed, folder).place(number)
    print(f"the case is in {root}, the valid files are in {folder / 'valid'}")
    return (
        "\n".join(flaws(TARGETS[name].read(root)))
        or "read, and nothing is wrong with it"
    )


if __name__ == "__main__":
    assert set(FLAWS) < {
        verdict for verdicts in COLUMNS.values() for verdict in verdicts
    }
    main()
