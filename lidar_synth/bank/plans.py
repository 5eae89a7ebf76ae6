"""Plans: what the processes of this machine will read next of cached banks.

A plan is a file that is locked as long as its process lives, and a table has the time when each
shard was last read. From both, every process knows which copies are still needed.
"""

import json
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.files.disk import remove_file
from lidar_synth.files.lock import one_writer, try_lock


class Use(NamedTuple):
    """What a plan reads of a shard: the positions of the first and last scan, and their number."""

    first: int
    last: int
    scans: int

    def joined(self, other: "Use") -> "Use":
        """What both read."""
        first = min(self.first, other.first)
        last = max(self.last, other.last)
        return Use(first, last, self.scans + other.scans)


def uses_of(shards: NDArray[np.intp]) -> dict[int, Use]:
    """What is read of each shard, in the order of the first scans.

    Args:
        shards: (N,) the shard of each scan, in order.
    """
    found, first, scans = np.unique(shards, return_index=True, return_counts=True)
    last = len(shards) - 1 - np.unique(shards[::-1], return_index=True)[1]
    uses = np.transpose((first, last, scans))
    return {int(found[i]): Use(*uses[i].tolist()) for i in np.argsort(first)}


@contextmanager
def published(
    folder: Path,
    times: str,
    since: int,
    names: Sequence[str],
    uses: Mapping[int, Use],
) -> Iterator[None]:
    """Publish a plan to the other processes.

    Args:
        folder: of the copies.
        times: name of the table in it of when each shard was last read, in ns.
        since: start of the plan, ns.
        names: names of the copies, in the order of ``uses``.
        uses: see ``uses_of``.

    Raises:
        OSError: if the file cannot be written.
    """
    path = folder / f"{secrets.token_hex(8)}.plan"
    new = path.with_suffix(".new")
    values = {
        "times": times,
        "since": since,
        "names": names,
        "shards": list(uses),
        "uses": list(uses.values()),
    }
    with one_writer(new):
        new.write_text(json.dumps(values))
        new.replace(path)
        yield
        path.unlink(missing_ok=True)


def needed(folder: Path) -> dict[str, Use]:
    """The copies in a folder that plans of living processes still need; plans of dead ones are
    removed."""
    uses: dict[str, Use] = {}
    for path in folder.glob("*.plan"):
        with try_lock(path) as dead:
            if dead:
                remove_file(path)
            else:
                for name, use in _read_plan(path).items():
                    uses[name] = use.joined(uses.get(name, use._replace(scans=0)))
    return uses


def _read_plan(path: Path) -> dict[str, Use]:
    """The copies that a plan still needs: those whose last scan comes after the first one of the
    last shard up to which all have been read."""
    with suppress(OSError):  # ended meanwhile
        plan = json.loads(path.read_text())
        times = np.fromfile(path.with_name(plan["times"]), np.int64)
        unread = np.append(times[plan["shards"]] < plan["since"], True)
        uses = [Use(*use) for use in plan["uses"]]
        begun = int(unread.argmax()) - 1
        reached = uses[begun].first if begun >= 0 else 0
        named = zip(plan["names"], uses, strict=True)
        return {name: use for name, use in named if use.last >= reached}
    return {}
