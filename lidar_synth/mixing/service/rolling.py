"""A rolling bank: a process of its own makes scans ahead of demand, and every reader copies them
from shared memory.

DataLoader workers cannot use a GPU, and a model in each of them would take too much memory. Here
one spawned process owns the model and keeps the scans that are needed next in shared memory. Under
distributed training every rank makes its own bank, on its own device::

    synth = RollingBank("town", device=f"cuda:{local_rank}", seed=0)
    train = MixedScans(real, synth, ratio=0.25)
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from inspect import signature
from numbers import Real
from pathlib import Path
from typing import Any, get_args

from numpy.typing import NDArray
from typing_extensions import Self

from lidar_synth.bank.encoding import Encoding
from lidar_synth.errors import ConfigError, check_count, choose
from lidar_synth.generate.loading import find_model, load_generator
from lidar_synth.geometry import SYNTHETIC, Scan, index_of, model_provenance
from lidar_synth.geometry.projection import unproject
from lidar_synth.mixing.service.client import Client
from lidar_synth.mixing.service.ledger import COUNTERS, Starved
from lidar_synth.mixing.service.process import (
    EXPECT,
    GET,
    GIVE_BACK,
    SET_EPOCH,
    GeneratorJob,
)
from lidar_synth.mixing.service.slots import Slots
from lidar_synth.noise import check_seed

# numbers in one message: fewer than fit into a socket's buffer, so that sending never blocks
_PART = 8192


class RollingBank:
    """Scans by number from a generator process.

    Scan ``number`` is ``generator.scans(seed, [number])`` after a bank's encoding, for any process
    and any order of access. Two settings trade this for speed: ``starved="reuse"``, and
    ``refresh``, with which the scan is a function of number and epoch.

    Workers inherit the bank when they start, forked or spawned. The generator process ends with
    ``close()``, at the end of a ``with`` block, or with the process that made the bank; its shared
    memory is freed with the last process that maps it, such as a worker.

    Args:
        model: the name of a shipped model or the path of a checkpoint; the model must be
            unconditional.
        seed: of the scans, 0 <= seed < 2^64.
        slots: number of scans in shared memory, 3 to 5 bytes per cell each. It should exceed what
            all workers request in advance: workers x ``prefetch_factor`` x batch size x ratio. A
            scan that comes again in the next epoch (the plan's ``reuse``) is kept until then if
            there is room for an epoch's scans, and made again otherwise.
        starved: what happens on a request for a scan that is not ready: ``"wait"`` for it, or
            ``"reuse"`` the scan in memory that was served least often.
        refresh: share in (0, 1]; None = off. The bank keeps a pool of scans and replaces this share
            of it with each epoch; request n gets the scan of the pool whose number is n modulo its
            size. The next epoch's scans have slots of their own.
        timeout: maximum seconds of any wait, be it for the model to load or for one scan.
        threads: of torch in the generator process; None = torch's default.
        steps, solver: as for ``Generator.range_images``.
        options: device, dtype, compile, batch and columns, as for ``load_generator``.

    Attributes:
        sensor: the sensor that defines the scans' grid.
        fields: the fields that the scans have besides their points.
        length: None, because the scans are endless.
        identity: the text that identifies the bank in a plan's hash.

    Raises:
        ConfigError: on invalid values.
        FileError, DataError: if the checkpoint cannot be read.
        ProcessError: if the generator process does not start; the message says why.

    Example:
        >>> from lidar_synth import RollingBank
        >>> with RollingBank("town", slots=2, threads=1) as bank:  # with a GPU: device="cuda"
        ...     scan = bank[7]
        >>> scan.id, sorted(scan.fields())
        ('town/0/7', ['confidence', 'label', 'reflectance'])
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
        if threads is not None:
            check_count("threads", threads, 1)
        for name in options:
            choose("option", name, signature(load_generator).parameters)
        path = find_model(model)
        # Loaded here too, so that wrong options are refused before a process starts.
        light = {"device": "cpu", "compile": False}
        generator = load_generator(path, **options | light)
        if generator.condition:
            raise ConfigError(
                f"a rolling bank of {path}, a conditional model",
                "an unconditional model",
            )
        sampling: dict[str, Any] = {"steps": steps, "solver": solver}
        list(generator.samples(seed, [], **sampling))  # refuses wrong options
        replaced = max(1, round(refresh * slots)) if refresh else 0
        self.sensor = generator.sensor
        self.fields = generator.fields | {"reflectance"}
        self.identity = (
            f"rolling:{generator.hash}:{seed}:{steps or 'own'}:{solver}:"
            f"{starved}:{replaced}{generator.variant}"
        )
        self._name = f"{path.stem}/{seed}"
        self._provenance = model_provenance(path.stem, generator.hash, seed)
        self._slots = Slots(Encoding(self.sensor, generator.fields), slots + replaced)
        job = GeneratorJob(
            path,
            seed,
            starved,
            replaced,
            threads,
            options,
            sampling,
        )
        self._client = Client(job, self._slots, timeout)

    @property
    def pid(self) -> int:
        """The process id of the generator process."""
        return self._client.pid

    def __getitem__(self, number: int) -> Scan:
        """The scan; its ``id`` says which one it is, also with ``starved`` and ``refresh``.

        Raises:
            ConfigError: on a number out of range, or a closed bank.
            TypeError: on anything but a whole number.
            ProcessError: if the generator process died, or made no scan within ``timeout`` seconds.
            DataError: if the scan's bytes in shared memory are not those that were written.
        """
        served, arrays = self.read(number)
        return replace(
            unproject(self._slots.encoding.decode(arrays)),
            id=f"{self._name}/{served}",
            domain=SYNTHETIC,
            provenance=self._provenance,
        )

    def read(self, number: int) -> tuple[int, dict[str, NDArray[Any]]]:
        """The number of the scan that serves a request, and its encoded arrays; raises as
        ``bank[number]``."""
        if not 0 <= number < 2**63:
            raise ConfigError(f"scan {number}", "0 <= number < 2^63")
        slot, served, checksum = self._client.ask(GET, index_of(number, 2**63))
        try:
            return served, self._slots.read(slot, served, checksum)
        finally:
            # if the process is dead, the next request raises an error
            with suppress(OSError):
                self._client.tell(GIVE_BACK)

    def expect(self, numbers: Sequence[int]) -> None:
        """Announce the scans that this process and its workers will request next, in order, if not
        0, 1, 2, ...

        ``MixedScans`` calls this. Under distributed training a rank requests only its share, and
        its bank makes only these scans. Without a call, the bank counts up from the highest number
        that was requested.
        """
        for start in range(0, max(len(numbers), 1), _PART):
            part = map(int, numbers[start : start + _PART])
            self._client.ask(EXPECT, start + _PART >= len(numbers), *part)

    def set_epoch(self, epoch: int) -> None:
        """Switch to the scans of this epoch; without ``refresh`` all epochs have the same scans."""
        self._client.ask(SET_EPOCH, epoch)

    def counts(self) -> dict[str, int]:
        """The numbers of scans made and served so far, and of requests that waited or were served
        another scan."""
        return dict(zip(COUNTERS, self._slots.counters.tolist(), strict=True))

    def close(self) -> None:
        """End the generator process; in a worker, only this process's connection."""
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _check(
    slots: int, seed: int, starved: str, refresh: float | None, timeout: float
) -> None:
    check_count("slots", slots, 1)
    if not (isinstance(timeout, Real) and timeout > 0):
        raise ConfigError(f"timeout={timeout!r}", "more than 0 seconds")
    check_seed(seed)
    if starved not in get_args(Starved):
        raise ConfigError(f"starved={starved!r}", f"one of {get_args(Starved)}")
    if refresh is not None and not 0 < refresh <= 1:
        raise ConfigError(f"refresh={refresh}", "a share in (0, 1], or None")
