"""How much of its clean score a network keeps under each corruption: docs/research/weather.md.

    python tools/research/weather_calibration.py JUDGE LABELLED [--every N]

JUDGE is a folder of lidar-bonnetal's archive, LABELLED a root of SemanticKITTI. The
published shares are those of SqueezeSeg in the Robo3D benchmark.
"""

from pathlib import Path

from typer import run

from lidar_synth import SemanticKITTI
from lidar_synth.lab.evaluate.robustness import NAMES_OF_BENCHMARK, open_model, stress

PUBLISHED = (31.61, 18.85, 27.30, 22.70, 17.93, 25.01, 21.65, 27.66, 7.85)
"""SqueezeSeg's mIoU on SemanticKITTI, %: clean, then each of ``NAMES_OF_BENCHMARK``, mean of the
severities."""


def main(judge: Path, labelled: Path, every: int = 1) -> None:
    """Prints the card of every Nth scan, and the published shares."""
    source = SemanticKITTI(labelled)
    scans = [source[i] for i in range(0, len(source), every)]
    card = stress(scans, open_model(str(judge)))
    print(f"{len(scans)} scans\n\n{card.to_text()}\n\n| % | published RR | RR | off |")
    print("|---|---:|---:|---:|")
    for name, score in zip(NAMES_OF_BENCHMARK, PUBLISHED[1:], strict=True):
        share = score / PUBLISHED[0]
        own = card.resilience[name]
        row = f"{100 * share:.1f} | {100 * own:.1f} | {100 * (own - share):+.1f}"
        print(f"| {name} | {row} |")


if __name__ == "__main__":
    run(main)
