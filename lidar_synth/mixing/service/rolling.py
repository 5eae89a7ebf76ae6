"""A rolling bank: scans made by a process of their own, ahead of demand, and copied out by every reader.

DataLoader workers cannot use a GPU, and a model in each of them is many too many. Here one spawned process owns the
model and keeps the scans that will be asked for next in shared memory; under distributed training every rank makes a
bank of its own, on its own device::

    synth = RollingBank("town", device=f"cuda:{local_rank}", seed=0)
    train = MixedScans(real, synth, ratio=0.25)
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, get_args

from numpy.typing import NDArray

from lidar_synth.bank.encoding import Encoding
from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.generate.generator import find_model
from lidar_synth.geometry.projection import unproject
from lidar_synth.geometry.scan import SYNTHETIC, RangeImage, Scan
from lidar_synth.mixing.service.client import Client
from lidar_synth.mixing.service.ledger import COUNTERS, Starved
from lidar_synth.mixing.service.process import EXPECT, GET, GIVE_BACK, SET_EPOCH, Plan
from lidar_synth.mixing.service.slots import Slots

_PART = 8192  # numbers in one message: less than a socket holds, so that sending never waits


class RollingBank:
    """Scans by number from a generator process.

    Scan ``number`` is ``generator.scans(seed, [number])`` as a bank encodes it, in whichever order scans are asked
    for and by whichever process. Two settings give that up for speed: ``starved="reuse"``, and ``refresh``, with
    which the scan is a function of number and epoch.

    Workers get the bank by being started with it, forked or spawned. It ends with ``close()``, with its ``with``
    block, or with the process that made it, and leaves nothing behind however that one ends.

    Args:
        model: a shipped model's name or a path to a checkpoint, unconditional.
        seed: of the scans, 0 <= seed < 2^64.
        slots: scans held in shared memory, 3 to 5 bytes a cell each. More than all workers ask for ahead: workers x
            ``prefetch_factor`` x batch size x ratio; a scan that comes again in the next epoch (the plan's ``reuse``)
            is kept until then where there is room for an epoch's scans, and otherwise made again.
        starved: what a request does whose scan is not there yet: ``"wait"`` for it, or ``"reuse"`` the held one that
            was served least.
        refresh: in (0, 1]: hold a pool of scans and replace this share of it with each epoch; request n gets the
            scan of the pool whose number is n modulo its size. The next epoch's scans have slots of their own.
        timeout: seconds that any wait may last: for the model to load, or for one scan.
        threads: of torch in the generator process; None = torch's own choice.
        steps, solver: as ``Generator.range_images`` takes them.
        options: device, dtype, compile and batch, as ``load_generator`` takes them.

    Attributes:
        sensor: whose grid the scans have.
        fields: what they carry beside their points.
        length: None, for scans without end.
        identity: what a plan's hash knows the bank by.

    Raises:
        ConfigError: on values that cannot be served.
        FileError, DataError: where the checkpoint cannot be read.
        ProcessError: where the generator process does not start, with its reason.
    """

    length: None = None

    def __init__(
        self,
        model: str | Path,
        *,
        seed: int = 0,
        slots: int = 64,
        starved: Starved = "wait",
        refresh: float | None = None,
        timeout: float = 120.0,
        threads: int | None = None,
        steps: int | None = None,
        solver: str = "euler",
        **options: Any,
    ) -> None:
        _check(slots, seed, starved, refresh, timeout)
        path = find_model(model)
        header, checksum = read_header(path)
        if header.conditioning:
            raise ConfigError(f"a rolling bank of {path}, a conditional model", "an unconditional model")
        made = set(header.channels) | ({"confidence"} if "label" in header.channels else set())
        replaced = round((refresh or 0) * slots)
        self.sensor = header.sensor
        self.fields = frozenset(made - {"range"} | {"reflectance"})
        self.identity = f"rolling:{checksum}:{seed}:{steps or 'own'}:{solver}:{starved}:{replaced}"
        self._name = f"{path.stem}/{seed}"
        self._slots = Slots(Encoding(header.sensor, made), slots + replaced)
        plan = Plan(path, seed, starved, replaced, threads, options, {"steps": steps, "solver": solver})
        self._client = Client(plan, self._slots, timeout)

    @property
    def pid(self) -> int:
        """The number of the generator process."""
        return self._client.pid

    def __getitem__(self, number: int) -> Scan:
        """The scan; its ``id`` tells which one it is, with ``starved`` and ``refresh`` too.

        Raises:
            ConfigError: on a number that is none, or a bank that is closed.
            ProcessError: where the generator process died or gave no scan within ``timeout`` seconds.
            DataError: where the scan's bytes are not those that were made.
        """
        made, arrays = self.read(number)
        return replace(unproject(self._slots.encoding.decode(arrays)), id=f"{self._name}/{made}", domain=SYNTHETIC)

    def image(self, number: int) -> RangeImage:
        """The range image of the scan at ``number``; raises as ``bank[number]``."""
        return self._slots.encoding.decode(self.read(number)[1])

    def read(self, number: int) -> tuple[int, dict[str, NDArray[Any]]]:
        """Which scan answers a request, and a copy of its encoded arrays; raises as ``bank[number]``."""
        if not 0 <= number < 2**63:
            raise ConfigError(f"scan {number}", "0 <= number < 2^63")
        slot, made, checksum = self._client.ask(GET, int(number))
        try:
            return made, self._slots.read(slot, made, checksum)
        finally:
            with suppress(OSError):  # where it is dead, the next request says so
                self._client.tell(GIVE_BACK)

    def expect(self, numbers: Sequence[int]) -> None:
        """Say which scans this process and its workers will ask for next, in order, where it is not 0, 1, 2, ...

        ``MixedScans`` does so. Under distributed training a rank asks for its share only; what it does not ask for
        need not be made. Without a word, the bank counts up from the highest number that was asked for.
        """
        for start in range(0, max(len(numbers), 1), _PART):
            part = map(int, numbers[start : start + _PART])
            self._client.ask(EXPECT, start + _PART >= len(numbers), *part)

    def set_epoch(self, epoch: int) -> None:
        """Go on to the scans of this epoch; only ``refresh`` makes a difference between epochs."""
        self._client.ask(SET_EPOCH, epoch)

    def counts(self) -> dict[str, int]:
        """How many scans were made and served so far, and how many requests waited or were served another scan."""
        return dict(zip(COUNTERS, self._slots.counters.tolist(), strict=True))

    def close(self) -> None:
        """End the generator process; in a worker, only this process's connection."""
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _check(slots: int, seed: int, starved: str, refresh: float | None, timeout: float) -> None:
    if slots < 1 or timeout <= 0:
        raise ConfigError(f"slots={slots}, timeout={timeout}", "at least 1 slot, and more than 0 seconds")
    if not 0 <= seed < 2**64:
        raise ConfigError(f"seed {seed}", "0 <= seed < 2^64")
    if starved not in get_args(Starved):
        raise ConfigError(f"starved={starved!r}", f"one of {get_args(Starved)}")
    if refresh is not None and not 0 < refresh <= 1:
        raise ConfigError(f"refresh={refresh}", "a share in (0, 1], or None")
