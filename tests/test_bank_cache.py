"""Copies of a bank's shards: how often they are fetched, kept and dropped, and what goes wrong."""

import os
import resource
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from threading import Barrier
from typing import Any

import fsspec
import numpy as np
import pytest
from banks import some_image, write_bank
from servers import Served, serve
from stores import empty_memory, new_bucket, s3_server
from test_bake_url import upload
from torch.utils.data import DataLoader

from lidar_synth import MixedScans, MixedStream, mix
from lidar_synth.bank import Bank, folder as folder_module
from lidar_synth.bank.cache import ShardCache, read_size
from lidar_synth.bank.storage import RemoteFile
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.lock import lock_alone, one_writer
from lidar_synth.geometry.sensor import load_sensor

pytest.importorskip("aiohttp")  # of the extra `remote`, which `dev` has

SCANS = 24
SHARD = 4
SHARDS = SCANS // SHARD


@pytest.fixture(scope="module")
def near(tmp_path_factory: pytest.TempPathFactory) -> Bank:
    """A bank on this machine; about 800 kB a shard."""
    root = tmp_path_factory.mktemp("near") / "bank"
    large = load_sensor("hdl64e_kitti360")
    write_bank(root, [some_image(i, large) for i in range(SCANS)], shard_size=SHARD)
    return Bank(root)


@pytest.fixture
def served(near: Bank) -> Iterator[Served]:
    with serve(Path(near.root)) as found:
        yield found


def fetched(served: Served) -> Counter[str]:
    """Number of requests by shard."""
    return Counter(name for name, _ in served.requests if name.endswith(".h5"))


def fetched_bytes(served: Served) -> int:
    return sum(size for name, size in served.requests if name.endswith(".h5"))


def held(folder: Path) -> int:
    """Bytes of the copies in a cache."""
    size = 0
    for path in folder.glob("*.h5"):
        with suppress(FileNotFoundError):  # dropped meanwhile
            size += path.stat().st_size
    return size


def room_for(bank: Bank, shards: float) -> int:
    return int(shards * max(entry.bytes for entry in bank.index.shards))


def points(bank: Any, numbers: Any) -> list[bytes]:
    return [bank[n].points.tobytes() for n in numbers]


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


# How often shards are fetched


def train(url: str, folder: Path, rank: int, seed: int, pause: Any, out: Any) -> None:
    """One of four ranks of a training over two epochs with two workers; sends its samples by epoch
    and name."""
    train = mixture(Bank(url, folder), seed=seed)
    seen = {}
    for epoch in range(2):
        train.set_epoch(epoch)
        for name, sample in loaded(train, rank, 4):
            seen[epoch, name] = sample
        pause.wait()
        pause.wait()
    out.put(seen)


def needed(bank: Bank, seed: int, epoch: int, node: int) -> set[str]:
    """The shards of the samples of two of four ranks, in batches of two."""
    plan = mixture(bank, seed=seed).plan(epoch)
    positions = [p for p in range(SCANS) if p % 8 // 4 == node]
    return {bank.index.shards[plan[p][1] // SHARD].file for p in positions}


def mixture(bank: Bank, **options: Any) -> MixedScans:
    return MixedScans(None, bank, 1.0, epoch_size=SCANS, **options)


def loaded(train: MixedScans, rank: int = 0, ranks: int = 1, workers: int = 2) -> Any:
    batches = train.batches(2, rank=rank, world_size=ranks)
    loader = DataLoader(
        train, batch_sampler=batches, num_workers=workers, collate_fn=list
    )
    for batch in loader:
        for item in batch:
            yield item["id"], item["points"].numpy().tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_each_node_fetches_what_it_needs_once(
    near: Bank, tmp_path: Path, seed: int
) -> None:
    """Two nodes of two ranks with two workers each. With seed 1 they need all shards in the first
    epoch, so that the second one makes no request."""
    context = get_context("fork")
    pause = context.Barrier(5)
    out = context.Queue()
    with serve(Path(near.root)) as one, serve(Path(near.root)) as two:
        nodes = (one, two)
        ranks = []
        for rank in range(4):
            place = (nodes[rank // 2].url, tmp_path / str(rank // 2), rank)
            ranks.append(context.Process(target=train, args=(*place, seed, pause, out)))
        for process in ranks:
            process.start()
        for epoch in range(2):
            pause.wait(120)
            for number, node in enumerate(nodes):
                wanted = needed(near, seed, 0, number)
                if epoch:
                    wanted |= needed(near, seed, 1, number)
                assert fetched(node) == dict.fromkeys(wanted, 1)
                size = sum(near.index.by_file[name].bytes for name in wanted)
                assert fetched_bytes(node) <= 1.05 * size
                assert epoch or seed == 0 or len(wanted) == SHARDS
            pause.wait(120)
        found = [out.get() for _ in ranks]
        for process in ranks:
            process.join()
    expected = mixture(near, seed=seed)
    for epoch in range(2):
        expected.set_epoch(epoch)
        together: dict[str, bytes] = {}
        for seen in found:
            together |= {name: s for (e, name), s in seen.items() if e == epoch}
        assert together == dict(loaded(expected, workers=0))


def test_shards_are_fetched_ahead_in_the_order_of_the_plan(
    served: Served, near: Bank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # so that requests arrive in order
    monkeypatch.setattr(folder_module, "_AT_ONCE", 1)
    bank = Bank(served.url, tmp_path / "cache")
    order = [20, 1, 13, 9, 21, 5, 16]
    bank.expect([0, 1, 2])  # corrected before the first read
    bank.expect(order)
    time.sleep(0.1)
    assert not fetched(served)
    assert points(bank, order[:1]) == points(near, order[:1])
    until(lambda: len(fetched(served)) == SHARDS)
    first, *files = (near.index.shards[n].file for n in (5, 0, 3, 2, 1, 4))
    # This thread asks for the first one, while the plan asks for the second.
    assert [file for file in fetched(served) if file != first] == files
    assert points(bank, order) == points(near, order)
    assert set(fetched(served).values()) == {1}
    bank.close()


def test_the_next_shard_is_requested_before_one_ends(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No request is answered before all shards have been asked for."""
    together = Barrier(SHARDS)
    real = RemoteFile.read

    def read(file: RemoteFile, offset: int, size: int) -> bytes:
        together.wait(10)
        return real(file, offset, size)

    monkeypatch.setattr(RemoteFile, "read", read)
    index = Bank(served.url).index
    cache = ShardCache(tmp_path / "cache", None, served.url, index)
    assert cache.fetch(range(SHARDS)) is None
    assert held(tmp_path / "cache") == index.size


def test_a_copy_that_another_process_makes_takes_room(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache", room_for(near, 2.1))
    part = tmp_path / "cache" / ".x.h5.12.part"
    with one_writer(part):
        os.truncate(part, room_for(near, 1.5))
        assert points(bank, [0]) == points(near, [0])
        assert part.exists() and not held(tmp_path / "cache")
    assert points(bank, [SHARD]) == points(near, [SHARD])
    assert not part.exists() and held(tmp_path / "cache")


def test_a_cache_serves_the_next_process(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    points(Bank(served.url, tmp_path / "cache"), range(SCANS))
    before = fetched(served)
    again = Bank(served.url, tmp_path / "cache")
    assert points(again, range(SCANS)) == points(near, range(SCANS))
    assert fetched(served) == before


def test_a_cache_serves_a_bank_in_s3(near: Bank, tmp_path: Path) -> None:
    with s3_server():
        url = new_bucket("cached")
        fsspec.filesystem("s3").put(f"{near.root}/", url, recursive=True)
        bank = Bank(url, tmp_path / "cache")
        assert points(bank, [3, 9]) == points(near, [3, 9])
        fsspec.filesystem("s3").rm(f"{url}/{near.index.shards[3].file}")
        with pytest.raises(
            FileError, match=r"s3://cached/bank/shard-00003.h5 cannot be"
        ):
            bank[12]
    assert points(bank, [2, 10]) == points(near, [2, 10])  # without a server


@pytest.mark.slow
def test_a_stream_fetches_each_shard_once(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache")
    train = mixture(bank)
    stream = MixedStream(train, batch_size=2, endless=False)
    loader = DataLoader(stream, batch_size=2, num_workers=2, collate_fn=list)
    for epoch in range(2):
        train.set_epoch(epoch)
        items = [item for batch in loader for item in batch]
        found = {item["id"]: item["points"].numpy().tobytes() for item in items}
        assert found == dict(loaded(mixture(near), workers=0))
        assert fetched(served) == dict.fromkeys(near.index.by_file, 1)
    bank.clear_cache()
    assert not (tmp_path / "cache").exists()


def test_settings_of_a_trainer_name_a_cache(served: Served, tmp_path: Path) -> None:
    given = {"root": served.url, "cache": str(tmp_path / "cache"), "limit": "1GB"}
    train = mix(None, given, 1.0, epoch_size=2)
    assert len(train[0]["points"])
    assert len(list((tmp_path / "cache").glob("*.h5"))) >= 1
    with pytest.raises(
        ConfigError, match="key of a bank 'limits'; expected one of 'root'"
    ):
        mix(None, {"root": served.url, "limits": 1}, 1.0)


def test_a_locality_that_is_unknown_is_refused(near: Bank) -> None:
    with pytest.raises(
        ConfigError, match="locality='scan'; expected \"shard\", or None"
    ):
        mixture(near, locality="scan")


def read_all(url: str, folder: Path) -> None:
    for number in range(SCANS):
        Bank(url, folder)[number]


def test_processes_fetch_each_shard_once(served: Served, tmp_path: Path) -> None:
    context = get_context("fork")
    readers = [
        context.Process(target=read_all, args=(served.url, tmp_path / "cache"))
        for _ in range(3)
    ]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()
    assert [reader.exitcode for reader in readers] == [0, 0, 0]
    assert set(fetched(served).values()) == {1}


# What is dropped


def test_copies_behind_the_plan_make_room(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    """In the order of the shards, with room for two: each is fetched once, and a second pass finds
    those that the first one left."""
    limit = room_for(near, 2.1)
    bank = Bank(served.url, tmp_path / "cache", limit)
    for _ in range(2):
        bank.expect(range(SCANS))
        for number in range(SCANS):
            if number % SHARD == 0:  # the thread is faster than the reader
                time.sleep(0.5)
            assert points(bank, [number]) == points(near, [number])
            assert held(tmp_path / "cache") <= limit
    assert set(fetched(served).values()) <= {1, 2}
    assert fetched_bytes(served) < 2 * near.index.size
    bank.close()


def test_a_plan_by_shards_streams_through_a_small_cache(tmp_path: Path) -> None:
    """24 shards and room for 9; the second epoch begins with copies of the first one, and they
    give way to shards that are needed before."""
    write_bank(tmp_path / "bank", [some_image(i) for i in range(96)], shard_size=SHARD)
    near = Bank(tmp_path / "bank")
    limit = room_for(near, 9.1)
    requests = []
    with serve(tmp_path) as served:
        bank = Bank(f"{served.url}/bank", tmp_path / "cache", limit)
        options: Any = {"epoch_size": 96, "locality": "shard"}
        train = MixedScans(None, bank, 1.0, **options)
        train_near = MixedScans(None, near, 1.0, **options)
        for epoch in range(2):
            train.set_epoch(epoch)
            train_near.set_epoch(epoch)
            before = fetched(served)
            for one, other in zip(loaded(train), loaded(train_near), strict=True):
                assert one == other
                assert held(tmp_path / "cache") <= limit
            requests.append(fetched(served) - before)
        bank.close()
    assert requests[0] == dict.fromkeys(near.index.by_file, 1)
    assert sum(requests[1].values()) <= 24 - 9 + 6
    # A reader that overtakes the thread, on a busy machine, reads a shard scan by scan.
    assert list(requests[1].values()).count(1) >= len(requests[1]) - 1


def test_a_plan_without_room_keeps_what_it_holds(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    """A shuffled epoch needs every shard to its end: the ones without room are read scan by scan,
    in the second epoch too."""
    limit = room_for(near, 3.1)
    bank = Bank(served.url, tmp_path / "cache", limit)
    train = mixture(bank)
    train_near = mixture(near)
    sizes = []
    for epoch in range(2):
        train.set_epoch(epoch)
        train_near.set_epoch(epoch)
        before = fetched_bytes(served)
        assert dict(loaded(train, workers=0)) == dict(loaded(train_near, workers=0))
        sizes.append(fetched_bytes(served) - before)
        assert held(tmp_path / "cache") <= limit
    assert len(list((tmp_path / "cache").glob("*.h5"))) == 3
    assert sizes[0] <= 1.05 * near.index.size
    assert sizes[1] <= 0.55 * near.index.size
    bank.close()


def test_a_shard_of_which_little_is_planned_displaces_nothing(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    """One scan of each shard: what has no room is read alone, in the second pass too."""
    bank = Bank(served.url, tmp_path / "cache", room_for(near, 2.1))
    order = list(range(0, SCANS, SHARD))
    for _ in range(2):
        bank.expect(order)
        assert points(bank, order) == points(near, order)
    bank.close()
    assert len(list((tmp_path / "cache").glob("*.h5"))) == 2
    alone = max(entry.bytes for entry in near.index.shards) / SHARD
    assert fetched_bytes(served) < room_for(near, 2.1) + 2 * 4 * 1.2 * alone


def test_without_a_plan_nothing_is_dropped(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache", room_for(near, 2.1))
    assert points(bank, range(SCANS)) == points(near, range(SCANS))
    kept = sorted((tmp_path / "cache").glob("*.h5"))
    points(bank, range(SCANS))
    assert len(kept) == 2 and sorted((tmp_path / "cache").glob("*.h5")) == kept


def test_the_plan_of_a_living_process_protects_its_copies(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache", room_for(near, 2.1))
    other = Bank(served.url, tmp_path / "cache", room_for(near, 2.1))
    bank.expect(range(2 * SHARD))
    points(bank, [0])
    until(lambda: len(list((tmp_path / "cache").glob("*.h5"))) == 2)
    kept = sorted((tmp_path / "cache").glob("*.h5"))
    other.expect([*range(2 * SHARD, SCANS), 2 * SHARD])
    points(other, [2 * SHARD])
    assert sorted((tmp_path / "cache").glob("*.h5")) == kept
    bank.close()
    until(lambda: sorted((tmp_path / "cache").glob("*.h5")) != kept)
    other.close()


def test_a_bank_that_is_gone_plans_nothing(served: Served, tmp_path: Path) -> None:
    bank = Bank(served.url, tmp_path / "cache")
    bank.expect(range(SCANS))
    assert len(list((tmp_path / "cache").glob("*.plan"))) == 1
    del bank
    until(lambda: not list((tmp_path / "cache").glob("*.plan")))


def plan_and_die(url: str, folder: Path) -> None:
    bank = Bank(url, folder)
    bank.expect(range(SCANS))
    os.kill(os.getpid(), signal.SIGKILL)


def test_the_plan_of_a_dead_process_does_not(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    folder = tmp_path / "cache"
    child = get_context("fork").Process(target=plan_and_die, args=(served.url, folder))
    child.start()
    child.join()
    assert len(list(folder.glob("*.plan"))) == 1
    bank = Bank(served.url, folder, room_for(near, 1.1))
    bank.expect(range(SCANS))
    points(bank, range(SCANS))
    assert fetched(served)[near.index.shards[-1].file] == 1
    assert len(list(folder.glob("*.plan"))) == 1  # the bank's own
    bank.close()


def test_clearing_removes_what_dead_processes_left(
    served: Served, tmp_path: Path
) -> None:
    folder = tmp_path / "cache"
    child = get_context("fork").Process(target=plan_and_die, args=(served.url, folder))
    child.start()
    child.join()
    assert len(list(folder.glob("*.plan"))) == 1
    (folder / ".x.h5.12.part").write_bytes(b"")
    Bank(served.url, folder).clear_cache()
    assert not folder.exists()


def test_another_version_of_a_bank_makes_room(tmp_path: Path) -> None:
    url = empty_memory()
    folder = tmp_path / "cache"
    for version in range(2):
        images = [some_image(10 * version + i) for i in range(6)]
        write_bank(tmp_path / str(version), images)
        upload(tmp_path / str(version), url)
        here = Bank(tmp_path / str(version))
        bank = Bank(url, folder, here.index.size)
        bank.expect(range(6))
        assert points(bank, range(6)) == points(here, range(6))
        bank.close()
    names = {f"{entry.sha256}.h5" for entry in here.index.shards}
    assert {path.name for path in folder.glob("*.h5")} == names


def test_a_cache_leaves_nothing_when_told_so(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache")
    bank.expect(range(SCANS))
    points(bank, range(SCANS))
    bank.clear_cache()
    assert not (tmp_path / "cache").exists()
    assert points(bank, [3]) == points(near, [3])
    assert not (tmp_path / "cache").exists()


def test_clearing_leaves_the_copies_of_other_banks(
    served: Served, tmp_path: Path
) -> None:
    write_bank(tmp_path / "other", [some_image(i) for i in range(4)])
    bank = Bank(served.url, tmp_path / "cache")
    other = Bank(f"file://{tmp_path}/other", tmp_path / "cache")
    points(bank, [0])
    points(other, [0])
    bank.clear_cache()
    [left] = (tmp_path / "cache").glob("*.h5")
    assert left.name == f"{other.index.shards[0].sha256}.h5"
    other.clear_cache()
    assert not (tmp_path / "cache").exists()


# Kills and damage


def hold_and_die(folder: Path) -> None:
    with lock_alone(folder / "lock"):
        (folder / ".x.h5.12.part").write_bytes(bytes(1000))
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_is_killed_while_it_copies_leaves_nothing(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache")
    child = get_context("fork").Process(target=hold_and_die, args=(tmp_path / "cache",))
    child.start()
    child.join()
    assert list((tmp_path / "cache").glob(".*.part"))
    assert points(bank, [0]) == points(near, [0])
    assert not list((tmp_path / "cache").glob(".*.part"))


def test_a_process_that_is_forked_while_a_plan_begins_reads(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python 3.11 holds a lock while it computes a cached property, which a child inherits."""
    real = np.memmap

    def slow(*given: Any) -> Any:
        time.sleep(0.3)
        return real(*given)

    monkeypatch.setattr(np, "memmap", slow)
    bank = Bank(served.url, tmp_path / "cache")
    bank.expect(range(SCANS))
    child = get_context("fork").Process(target=bank.__getitem__, args=(0,))
    child.start()
    child.join(20)
    code = child.exitcode
    child.kill()
    assert code == 0
    bank.close()


@pytest.mark.slow
def test_spawned_workers_share_a_cache(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache")
    with get_context("spawn").Pool(2) as pool:
        found = pool.starmap(points, [(bank, [n]) for n in range(SCANS)])
    assert found == [points(near, [n]) for n in range(SCANS)]
    assert fetched(served) == dict.fromkeys(near.index.by_file, 1)


def test_a_lock_that_a_forked_process_inherits_is_released(tmp_path: Path) -> None:
    with lock_alone(tmp_path / "lock"):
        child = get_context("fork").Process(target=time.sleep, args=(30,))
        child.start()
    begun = time.monotonic()
    with lock_alone(tmp_path / "lock"):
        assert time.monotonic() - begun < 5
    child.kill()
    child.join()


def test_a_cut_copy_is_fetched_again(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    points(Bank(served.url, tmp_path / "cache"), [0])
    [path] = (tmp_path / "cache").glob("*.h5")
    os.truncate(path, 1000)
    bank = Bank(served.url, tmp_path / "cache")
    assert points(bank, [0]) == points(near, [0])


def test_a_copy_that_is_lost_while_it_is_used_is_fetched_again(
    served: Served, near: Bank, tmp_path: Path
) -> None:
    bank = Bank(served.url, tmp_path / "cache")
    points(bank, [0])
    bank.close()
    for path in (tmp_path / "cache").glob("*.h5"):
        path.unlink()
    assert points(bank, [1]) == points(near, [1])
    assert fetched(served)[near.index.shards[0].file] == 2


def damage(root: Path, kind: str) -> None:
    path = root / "shard-00000.h5"
    if kind == "missing":
        path.unlink()
    elif kind == "cut":
        os.truncate(path, path.stat().st_size - 100)
    else:
        content = bytearray(path.read_bytes())
        content[-9] ^= 1
        path.write_bytes(content)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", r"bank/shard-00000.h5 cannot be read \(404"),
        ("cut", r"bank/shard-00000.h5 gave \d+ bytes for a range of \d+"),
        ("wrong", r"bank/shard-00000.h5 has sha256 .*, by the bank's index"),
    ],
)
def test_an_object_that_is_not_the_index_s_is_named(
    tmp_path: Path, kind: str, message: str
) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(4)])
    damage(tmp_path / "bank", kind)
    with serve(tmp_path) as served:
        bank = Bank(f"{served.url}/bank", tmp_path / "cache")
        bank.expect(range(4))
        with pytest.raises((FileError, DataError), match=message):
            bank.image(0)
        bank.image(2)  # another shard
        bank.close()
    assert len(list((tmp_path / "cache").glob("*.h5"))) == 1
    until(lambda: not list((tmp_path / "cache").glob(".*")))  # of the thread


# Bad input


def read_with_full_disk(url: str, folder: Path, out: Any) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
    try:
        Bank(url, folder).image(0)
    except FileError as error:
        out.put((str(error), [path.name for path in folder.glob(".*")]))


def test_a_full_disk_is_reported(served: Served, tmp_path: Path) -> None:
    out = get_context("fork").Queue()
    child = get_context("fork").Process(
        target=read_with_full_disk, args=(served.url, tmp_path / "cache", out)
    )
    child.start()
    message, left = out.get(timeout=30)
    child.join()
    assert (
        "cannot be written (File too large); expected a writable folder on a disk"
        in message
    )
    assert left == []


def test_a_disk_without_room_is_reported_at_once(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Usage:
        free = 1_000_000

    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage)
    with pytest.raises(
        FileError, match=r"cache has 0.001 GB free; expected 0.0\d+ GB for copies of"
    ):
        Bank(served.url, tmp_path / "cache")
    assert not fetched(served)


@pytest.mark.parametrize("limit", ["200", "5 PB", "GB", -1, 0, 1.5, True, "2e9 B"])
def test_a_limit_that_is_no_size_is_refused(
    served: Served, tmp_path: Path, limit: Any
) -> None:
    with pytest.raises(ConfigError, match="limit="):
        Bank(served.url, tmp_path / "cache", limit)


def test_sizes_are_read() -> None:
    assert [read_size(text) for text in ("200GB", "1.5 TB", "7B", 9)] == [
        200 * 10**9,
        15 * 10**11,
        7,
        9,
    ]


def test_a_limit_below_a_shard_is_refused(served: Served, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="limit='1kB' for a bank with a shard of"):
        Bank(served.url, tmp_path / "cache", "1kB")


def test_a_bank_in_a_folder_needs_no_cache(near: Bank, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected the URL of a bank. file:///"):
        Bank(near.root, tmp_path / "cache")


def test_a_file_is_no_cache(served: Served, tmp_path: Path) -> None:
    (tmp_path / "cache").write_bytes(b"")
    with pytest.raises(FileError, match="cache cannot be written"):
        Bank(served.url, tmp_path / "cache")
