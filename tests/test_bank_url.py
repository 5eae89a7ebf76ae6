"""Banks at a URL: what is read over a network, and the errors when that fails."""

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import fsspec
import hypothesis.strategies as st
import numpy as np
import pytest
from banks import some_image, write_bank
from hypothesis import HealthCheck, given, settings
from servers import Served, serve
from torch.utils.data import DataLoader

import lidar_synth.bank.retries as retries
import lidar_synth.bank.storage as storage
import lidar_synth.bank.writer as writer
from lidar_synth.bank import Bank
from lidar_synth.bank.shard import _GAP, _side_by_side
from lidar_synth.bank.storage import LocalFile, RangedFile, RemoteFile
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import open_scans
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.train.cache import ImageCache, cache_scans

pytest.importorskip("aiohttp")  # of the extra `remote`, which `dev` has

LARGE = load_sensor("hdl64e_kitti360")  # 64 x 1024: about 200 kB for a scan of noise


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(5)])
    with serve(tmp_path) as found:
        yield found


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["plain", "paged", "before"])
def test_random_access_transfers_little_more_than_the_scans(
    tmp_path: Path, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Index, shard metadata and scans: at most 1.3 times the scans' bytes, and at most 4 requests
    per scan."""
    if layout == "before":  # files of older versions, whose metadata is scattered
        monkeypatch.setattr(writer, "metadata_size", lambda *_: 2048)
    images = [some_image(i, LARGE) for i in range(6)]
    facts = {
        "layout": "plain" if layout == "before" else layout,
        "provenance": {"recipe": "x" * 20_000},
    }
    write_bank(
        tmp_path / "bank", [images[i % 6] for i in range(60)], shard_size=20, **facts
    )
    here = Bank(tmp_path / "bank")
    chosen = np.random.default_rng(0).permutation(60)[:30].tolist()
    with serve(tmp_path) as served:
        bank = Bank(f"{served.url}/bank/")
        scans = 0
        for number in chosen:
            before = len(served.requests)
            assert np.array_equal(bank.image(number).range, here.image(number).range)
            scans += sum(
                map(len, here.shard(number // 20).chunks(number % 20)[0].values())
            )
            opened = len(served.requests) - before
            assert opened <= (7 if layout == "before" else 4)
        assert served.bytes <= 1.3 * scans
        assert len(served.requests) <= 4 * len(chosen)
        assert {name for name, _ in served.requests} == {
            "index.json",
            *(entry.file for entry in bank.index.shards),
        }


def test_a_new_shard_takes_two_requests(tmp_path: Path) -> None:
    write_bank(tmp_path, [some_image(i, LARGE) for i in range(4)], shard_size=1)
    with serve(tmp_path) as served:
        bank = Bank(served.url)
        for number in range(4):
            bank.image(number)
        assert [name for name, _ in served.requests[1:]] == [
            f"shard-{number:05d}.h5" for number in range(4) for _ in range(2)
        ]


def test_a_url_gives_the_same_scans_as_the_folder(
    served: Served, tmp_path: Path
) -> None:
    near = open_scans(tmp_path / "bank")
    far = open_scans(f"{served.url}/bank")
    for a, b in zip(near, far, strict=True):
        assert (
            a.id == b.id
            and np.array_equal(a.points, b.points)
            and np.array_equal(a.label, b.label)
        )


def test_a_training_keeps_the_scans_of_a_bank_at_a_url(
    served: Served, tmp_path: Path
) -> None:
    url = f"{served.url}/bank"

    def cached() -> ImageCache:
        scans = open_scans(url)
        folder = tmp_path / "cache"
        return cache_scans(scans, scans.sensor, ["range"], folder, progress=False)

    first = cached().fields["range"]
    assert np.array_equal(cached().fields["range"], first)
    write_bank(tmp_path / "bank", [some_image(i) for i in range(5, 10)])
    with pytest.raises(ConfigError, match=r"of other data \(files differ"):
        cached()


@pytest.mark.slow
def test_forked_workers_read_from_a_url(served: Served) -> None:
    bank = Bank(f"{served.url}/bank")
    # the parent process has open connections
    expected = sum(len(scan) for scan in bank)
    loader = DataLoader(
        bank, batch_size=None, num_workers=2, multiprocessing_context="fork"
    )  # type: ignore[arg-type]
    assert sum(len(scan) for scan in loader) == expected


def test_a_bank_is_read_through_the_proxy_of_the_environment(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("http_proxy", served.url)
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    far = Bank("http://bank.invalid/bank")
    assert np.array_equal(far[1].points, Bank(tmp_path / "bank")[1].points)


def test_what_fsspec_is_configured_with_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    login = {"headers": {"authorization": "Bearer token"}}
    monkeypatch.setitem(fsspec.config.conf, "http", {"client_kwargs": login})
    for scheme in ("http", "https"):
        system, _ = storage.open_system(f"{scheme}://bank.invalid/bank")
        assert system.client_kwargs == {"trust_env": True} | login


def test_a_limit_without_a_cache_is_refused(served: Served) -> None:
    with pytest.raises(ConfigError, match="limit='1GB' without cache="):
        Bank(f"{served.url}/bank", limit="1GB")


def test_a_server_without_ranges_is_refused(served: Served) -> None:
    served.ranges = False
    with pytest.raises(
        FileError,
        match=r"shard-00000.h5 gave \d+ bytes for a range of \d+; .*a server that serves",
    ):
        Bank(f"{served.url}/bank").image(0)


def test_a_busy_server_costs_no_scan(served: Served, tmp_path: Path) -> None:
    served.busy = 20
    near = Bank(tmp_path / "bank")
    for _ in range(8):
        far = Bank(f"{served.url}/bank")
        assert all(
            np.array_equal(far.image(i).range, near.image(i).range) for i in range(5)
        )
    assert len(served.requests) > 60


def test_a_silent_server_is_left_after_the_time_limit(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(storage, "PATIENCE", 0.5)
    monkeypatch.setattr(retries, "PATIENCE", 0.5)
    served.silent.add("index.json")
    start = time.monotonic()
    with pytest.raises(FileError, match=r"index.json cannot be read"):
        Bank(f"{served.url}/bank")
    assert time.monotonic() - start < 2


def test_an_endless_index_is_refused_within_limits(served: Served) -> None:
    served.endless.add("index.json")
    with pytest.raises(DataError, match=r"index.json is longer than 1000000 bytes"):
        RemoteFile(f"{served.url}/bank/index.json").read_all(1_000_000)


def test_redirects_end(served: Served) -> None:
    served.moved["index.json"] = f"{served.url}/bank/index.json"
    with pytest.raises(FileError, match=r"index.json cannot be read"):
        Bank(f"{served.url}/bank")
    served.moved = {"moved": f"{served.url}/bank/index.json"}
    assert (
        RemoteFile(f"{served.url}/bank/moved").read_all()
        == RemoteFile(f"{served.url}/bank/index.json").read_all()
    )


@pytest.mark.parametrize(
    "url",
    [
        "reference://a",
        "jupyter://a",
        "zip://a::http://b",
        "simplecache::http://a",
        "ftp://a",
    ],
)
def test_other_kinds_of_urls_are_refused(url: str) -> None:
    with pytest.raises(FileError, match=r"with scheme .*expected one of abfs"):
        Bank(f"{url}/bank")


def test_a_failed_request_is_not_reported_as_damage(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network failure must not suggest a repair."""
    monkeypatch.setattr(retries, "WAITS", (0.0,))
    bank = Bank(f"{served.url}/bank")
    served.broken.add("shard-00000.h5")
    with pytest.raises(FileError, match="shard-00000.h5 cannot be read .*500"):
        bank.image(0)
    assert bank.image(2).mask.any()
    served.broken.clear()
    assert bank.image(0).mask.any()
    served.broken.add("shard-00000.h5")
    # an open shard
    with pytest.raises(FileError, match="shard-00000.h5 cannot be read .*500"):
        bank.image(1)
    (tmp_path / "bank" / "shard-00002.h5").unlink()
    with pytest.raises(FileError, match="shard-00002.h5 cannot be read"):
        bank.image(4)
    with pytest.raises(FileError, match=r"elsewhere/index.json cannot be read"):
        Bank(f"{served.url}/elsewhere")


def test_a_truncated_shard_at_a_url_is_refused(served: Served, tmp_path: Path) -> None:
    path = tmp_path / "bank" / "shard-00001.h5"
    content = path.read_bytes()
    for length in (0, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        bank = Bank(f"{served.url}/bank")
        with pytest.raises((FileError, DataError), match="shard-00001.h5"):
            bank.image(2), bank.image(3)


def test_an_index_with_exaggerated_sizes_is_refused(
    served: Served, tmp_path: Path
) -> None:
    bank = Bank(f"{served.url}/bank")
    shards = tuple(
        replace(entry, bytes=1 << 40, scans=1 << 34) for entry in bank.index.shards
    )
    (tmp_path / "bank" / "index.json").write_bytes(
        replace(bank.index, shards=shards).to_json()
    )
    with pytest.raises(
        FileError, match=r"shard-00000.h5 gave \d+ bytes for a range of \d+"
    ):
        Bank(f"{served.url}/bank").image(0)


@pytest.fixture(params=["any", "Windows"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """This system, or one without ``os.pread``."""
    if request.param == "Windows":
        monkeypatch.delattr("os.pread", raising=False)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    size=st.integers(1, 5000),
    head=st.integers(0, 6000),
    reads=st.lists(st.tuples(st.integers(0, 5200), st.integers(0, 3000)), max_size=12),
)
def test_a_view_reads_like_the_file(
    tmp_path_factory: pytest.TempPathFactory,
    system: None,
    size: int,
    head: int,
    reads: list[tuple[int, int]],
) -> None:
    path = tmp_path_factory.mktemp("view") / "file"
    content = np.random.default_rng(size).integers(0, 256, size, np.uint8).tobytes()
    path.write_bytes(content)
    file = LocalFile(path)
    file.window = 100
    view = RangedFile(file, head)
    for offset, length in reads:
        view.seek(offset)
        with suppress(OSError):
            assert view.read(length) == content[offset : offset + length]
        if view.missing is not None:
            view.fetch_missing()
            view.seek(offset)
            assert view.read(length) == content[offset : offset + length]
        assert view.missing is None
    assert view.seek(0, 2) == size and view.seek(-1, 1) == size - 1


@given(
    st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(1, 1 << 18)), max_size=6)
)
def test_adjacent_chunks_are_read_at_once(spans: list[tuple[int, int]]) -> None:
    places = {str(i): (start, start + size) for i, (start, size) in enumerate(spans)}
    groups = _side_by_side(places)
    assert sorted(name for group in groups for name in group) == sorted(places)
    starts = [min(places[name][0] for name in group) for group in groups]
    ends = [max(places[name][1] for name in group) for group in groups]
    assert all(start > end + _GAP for start, end in zip(starts[1:], ends, strict=False))
    covered = sum(end - start for start, end in zip(starts, ends, strict=True))
    assert covered <= sum(size for _, size in spans) + _GAP * max(
        len(spans) - len(groups), 0
    )
