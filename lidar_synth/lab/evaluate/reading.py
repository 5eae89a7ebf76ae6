"""Reading the scans of a set that is measured."""

from collections.abc import Iterable, Iterator

from tqdm import tqdm

from lidar_synth.geometry import Scan, Source


def readable(
    source: Source,
    numbers: Iterable[int] | None = None,
    name: str = "scans",
    progress: bool = False,
) -> Iterator[Scan]:
    """Each scan of a source once: none in the place of one that ``on_bad="skip"`` skips.

    Args:
        source: the scans.
        numbers: of those that are read; None = all.
        name: what the progress bar calls them.
        progress: whether to show a progress bar.
    """
    load = getattr(source, "load_or_skip", source.__getitem__)
    chosen = range(len(source)) if numbers is None else numbers
    for number in tqdm(chosen, desc=name, disable=not progress):
        if (scan := load(number)) is not None:
            yield scan
