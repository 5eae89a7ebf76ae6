"""Bakes into object stores: the same bytes as on a disk, whatever kills or disturbs them."""

import base64
import hashlib
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import fsspec
import pytest
from bakes import COUNT, files, plan_in
from banks import some_image, write_bank
from fsspec.implementations.memory import MemoryFileSystem
from servers import serve
from stores import empty_memory, files_at, new_bucket, s3_server
from test_generator import write
from test_verify import call

import lidar_synth.bank.retries as retries
from lidar_synth.bake import ENGINES, BakePlan, Resources, Share, bake, bake_shard
from lidar_synth.bake.edit import head, merge
from lidar_synth.bake.folder import finish, prepare
from lidar_synth.bake.remote import list_finished
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import verify
from lidar_synth.bank import INDEX, Bank
from lidar_synth.bank.folder import RemoteFolder, open_folder
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import open_scans
from lidar_synth.formats.models import models_of

KILLS = 20


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


@pytest.fixture(scope="module")
def expected(model: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of the bank on a disk."""
    plan = plan_in(tmp_path_factory.mktemp("expected") / "bank", model)
    bake(plan, progress=False)
    return files(plan.out)


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    with s3_server() as url:
        yield url


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def plan_at(url: str, model: Path, **settings: Any) -> BakePlan:
    return plan_in(url, model, **settings)  # type: ignore[arg-type]


class Killed(BaseException):
    """Ends a bake as a kill does: nothing handles it."""


def kill_at(moment: int, after: bool, patch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Kill this process's bake before or after a change of the store; returns their count."""
    changes = 0

    def wrap(name: str) -> None:
        real = getattr(MemoryFileSystem, name)

        def changed(self: Any, *given: Any, **options: Any) -> Any:
            nonlocal changes
            changes += 1
            if changes == moment and not after:
                raise Killed
            real(self, *given, **options)
            if changes == moment:
                raise Killed

        patch.setattr(MemoryFileSystem, name, changed)

    for name in ("pipe_file", "put_file", "rm"):
        wrap(name)
    return lambda: changes


# The same bytes


def test_a_bake_into_memory_writes_the_bytes_of_a_folder(
    model: Path, expected: dict[str, bytes], temporary: Path
) -> None:
    plan = plan_at(empty_memory() + "/", model)
    index = bake(plan, progress=False)
    assert index is not None and files_at("memory://bucket/bank") == expected
    assert not list(temporary.iterdir())
    assert verify(plan.out, progress=False) == []
    assert bake(plan, progress=False) == index  # nothing is left to do


def test_a_bake_into_s3_writes_the_bytes_of_a_folder(
    model: Path, expected: dict[str, bytes], s3: str, tmp_path: Path
) -> None:
    plan = plan_at(new_bucket("same"), model)
    bake(plan, progress=False)
    assert files_at(str(plan.out)) == expected
    assert verify(plan.out, progress=False) == []
    far = open_scans(str(plan.out))
    assert len(far) == COUNT and len(far[3].points)


def test_a_bake_into_a_file_url_resumes(
    model: Path, expected: dict[str, bytes], tmp_path: Path
) -> None:
    plan = plan_at((tmp_path / "new" / "bank").as_uri(), model)
    assert bake(plan, share=Share(0, 2), progress=False) is None
    made: list[int] = []
    ENGINES["local"](plan, range(4), Resources(), made.append)
    assert made == [3, 1, 1, 1, 3, 1] and finish(plan) is not None
    assert files_at(str(plan.out)) == expected
    assert verify(plan.out, progress=False) == []
    assert len(open_scans(str(plan.out))) == COUNT


def test_shards_are_uploaded_with_their_checksum(model: Path, s3: str) -> None:
    plan = plan_at(new_bucket("sums"), model)
    bake(plan, progress=False)
    for entry in Bank(plan.out).index.shards:
        told = fsspec.filesystem("s3").call_s3(
            "head_object",
            Bucket="sums",
            Key=f"bank/{entry.file}",
            ChecksumMode="ENABLED",
        )
        assert base64.b64decode(told["ChecksumSHA256"]).hex() == entry.sha256


@pytest.mark.slow
def test_worker_processes_bake_into_s3(
    model: Path, expected: dict[str, bytes], s3: str
) -> None:
    plan = plan_at(new_bucket("workers"), model)
    prepare(plan)
    ENGINES["processes"](plan, range(4), Resources(2), lambda scans: None)
    finish(plan)
    assert files_at(str(plan.out)) == expected


@pytest.mark.slow
def test_the_command_bakes_and_verifies_at_a_url(
    model: Path, expected: dict[str, bytes], s3: str
) -> None:
    url = new_bucket("command")
    options = f"--model {model} --count {COUNT} --shard-size 3 --seed 4".split()
    for words in (["bake", url, *options], ["verify", url], ["info", url]):
        command = [sys.executable, "-m", "lidar_synth", *words]
        subprocess.run(command, check=True, capture_output=True)
    assert files_at(url) == expected


# Interruptions


@pytest.mark.slow
@pytest.mark.parametrize("after", [False, True])
def test_a_bake_that_is_killed_at_any_change_of_the_store_resumes(
    model: Path, expected: dict[str, bytes], after: bool
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        count = kill_at(-1, after, patch)
        bake(plan_at(empty_memory(), model), progress=False)
        changes = count()
    assert changes > 12  # settings, 4 shards with records, 3 files and the records
    for moment in range(1, changes + 1):
        plan = plan_at(empty_memory(), model)
        with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
            kill_at(moment, after, patch)
            bake(plan, progress=False)
        complete = INDEX in open_folder(plan.out).sizes()
        assert not complete or verify(plan.out, progress=False) == []
        bake(plan, progress=False)
        assert files_at(str(plan.out)) == expected


def test_finished_shards_are_not_made_again(model: Path) -> None:
    plan = plan_at(empty_memory(), model)
    assert bake(plan, share=Share(0, 2), progress=False) is None
    assert sorted(list_finished(plan, str(plan.out))) == [
        "shard-00000.h5",
        "shard-00002.h5",
    ]
    made: list[int] = []
    prepare(plan)
    ENGINES["local"](plan, [1, 3], Resources(), made.append)
    assert sum(made) == 4
    assert finish(plan) is not None


def in_child(plan: BakePlan) -> Any:
    """A process that bakes."""
    child = get_context("fork").Process(target=bake, args=(plan, "local"))
    child.start()
    return child


@pytest.mark.slow
def test_bakes_into_s3_that_are_killed_at_random_moments_resume(
    model: Path, expected: dict[str, bytes], s3: str
) -> None:
    plan = plan_at(new_bucket("timed"), model)
    begun = time.monotonic()
    in_child(plan).join()
    seconds = time.monotonic() - begun
    assert files_at(str(plan.out)) == expected
    rng = random.Random(48)
    killed = 0
    for kill in range(KILLS):
        plan = plan_at(new_bucket(f"killed-{kill}"), model)
        child = in_child(plan)
        time.sleep(rng.uniform(0, seconds))
        os.kill(child.pid, signal.SIGKILL)
        child.join()
        killed += child.exitcode == -signal.SIGKILL
        again = in_child(plan)
        again.join()
        assert again.exitcode == 0
        assert files_at(str(plan.out)) == expected
        assert verify(plan.out, progress=False) == []
    assert killed > KILLS // 2


# Several bakes at once


@pytest.mark.slow
def test_two_bakes_into_s3_at_once_write_the_same_bytes(
    model: Path, expected: dict[str, bytes], s3: str
) -> None:
    plan = plan_at(new_bucket("both"), model)
    children = [in_child(plan) for _ in range(2)]
    for child in children:
        child.join()
    assert [child.exitcode for child in children] == [0, 0]
    assert files_at(str(plan.out)) == expected


def test_a_bake_that_another_one_overtakes_ends_well(
    model: Path, expected: dict[str, bytes]
) -> None:
    """The other one completes the bank while this one makes its first shard."""
    plan = plan_at(empty_memory(), model)
    prepare(plan)
    overtaken: list[int] = []

    def progress(scans: int) -> None:
        if not overtaken:
            overtaken.append(scans)
            bake(plan, progress=False)

    bake_shard(plan, 0, progress)
    assert finish(plan) is not None
    assert files_at(str(plan.out)) == expected


def test_a_shard_with_two_records_is_made_again(
    model: Path, expected: dict[str, bytes]
) -> None:
    """Processors that round differently may upload different bytes at the same time."""
    plan = plan_at(empty_memory(), model)
    bake(plan, share=Share(0, 2), progress=False)
    size = len(expected["shard-00000.h5"])
    record = f".lidar_synth/shard-00000.h5-{size}-{'0' * 64}"
    open_folder(plan.out).write(record, b"")
    assert bake(plan, share=Share(1, 2), progress=False) is None
    assert bake(plan, progress=False) is not None
    assert files_at(str(plan.out)) == expected


def test_other_settings_are_refused(model: Path) -> None:
    url = empty_memory()
    prepare(plan_at(url, model))
    with pytest.raises(ConfigError, match="memory://bucket/bank was filled with"):
        prepare(plan_at(url, model, seed=5))


@pytest.mark.parametrize("name", [INDEX, "shard-00000.h5", "README.md"])
def test_a_place_with_other_files_is_refused(model: Path, name: str) -> None:
    url = empty_memory()
    open_folder(url).write(name, b"mine")
    with pytest.raises(ConfigError, match="memory://bucket/bank holds a"):
        bake(plan_at(url, model), progress=False)
    assert files_at(url) == {name: b"mine"}


def test_the_first_of_two_claims_wins(model: Path) -> None:
    """Settings that are written between the listing and the claim of another bake."""
    plan = plan_at(empty_memory(), model)
    listed = RemoteFolder.sizes

    def late(self: RemoteFolder) -> dict[str, int]:
        found = listed(self)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RemoteFolder, "sizes", listed)
            prepare(plan)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RemoteFolder, "sizes", late)
        with pytest.raises(ConfigError, match="was filled with"):
            prepare(plan_at(str(plan.out), model, seed=5))


# Damage


def put(url: str, name: str, content: bytes) -> None:
    fsspec.filesystem("memory").pipe_file(f"{url}/{name}", content)


DAMAGE: dict[str, tuple[Callable[[bytes], bytes | None], str]] = {
    "missing": (lambda content: None, "cannot be read"),
    "cut": (lambda content: content[:-100], "has .* bytes and sha256"),
    "longer": (lambda content: content + b"x", "has .* bytes and sha256"),
    "empty": (lambda content: b"", "has 0 bytes and sha256"),
    "flipped": (
        lambda content: content[:-9] + bytes([content[-9] ^ 1]) + content[-8:],
        "sha256",
    ),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_wrong_object_is_named_and_repaired(
    model: Path, expected: dict[str, bytes], kind: str, temporary: Path
) -> None:
    url = empty_memory()
    bake(plan_at(url, model), progress=False)
    spoil, message = DAMAGE[kind]
    content = spoil(expected["shard-00001.h5"])
    if content is None:
        RemoteFolder(url).remove(["shard-00001.h5"])
    else:
        put(url, "shard-00001.h5", content)
    put(url, "README.md", b"edited")
    problems = verify(url, progress=False)
    assert {p.file for p in problems} == {"shard-00001.h5", "README.md"}
    assert any(re.search(message, p.what) for p in problems)
    assert repair(url, str(model), progress=False) == {
        "README.md": "rewritten from the index",
        "shard-00001.h5": "regenerated",
    }
    assert files_at(url) == expected
    assert not list(temporary.iterdir())


def test_a_lost_index_is_rebuilt(model: Path, expected: dict[str, bytes]) -> None:
    url = empty_memory()
    bake(plan_at(url, model), progress=False)
    RemoteFolder(url).remove([INDEX, "shard-00002.h5"])
    done = repair(url, str(model), progress=False)
    assert done[INDEX] == "rebuilt from the shards"
    assert done["shard-00002.h5"] == "regenerated"
    assert files_at(url) == expected


def test_an_unfinished_bake_is_told_from_a_bank(model: Path) -> None:
    url = empty_memory()
    with pytest.raises(DataError, match=r"holds no bank: [^;]* no shard of [^;]*; exp"):
        repair(url, progress=False)
    bake(plan_at(url, model), share=Share(0, 2), progress=False)
    with pytest.raises(FileError, match="bank holds no bank: .* bake again to resume"):
        Bank(url)


def test_a_strange_shard_is_reported(model: Path, expected: dict[str, bytes]) -> None:
    url = empty_memory()
    bake(plan_at(url, model), progress=False)
    put(url, "shard-00009.h5", b"strange")
    [problem] = verify(url, progress=False)
    assert (problem.file, problem.what) == (
        "shard-00009.h5",
        "is not in the index: remove it",
    )


def test_a_bank_in_a_folder_below_is_another_one(
    model: Path, expected: dict[str, bytes]
) -> None:
    url = empty_memory()
    bake(plan_at(f"{url}/val", model), progress=False)
    bake(plan_at(url, model), progress=False)
    assert verify(url, progress=False) == []
    RemoteFolder(url).remove([INDEX])
    put(f"{url}/val", "shard-00009.h5", expected["shard-00003.h5"])
    below = files_at(f"{url}/val")
    assert repair(url, str(model), progress=False) == {INDEX: "rebuilt from the shards"}
    assert files_at(f"{url}/val") == below


def test_a_missing_shard_of_a_finished_bank_is_made_by_a_bake(
    model: Path, expected: dict[str, bytes]
) -> None:
    plan = plan_at(empty_memory(), model)
    bake(plan, progress=False)
    RemoteFolder(str(plan.out)).remove(["shard-00001.h5"])
    bake(plan, progress=False)
    assert files_at(str(plan.out)) == expected


# New banks from those at a URL


def upload(root: Path, url: str) -> None:
    for path in root.iterdir():
        put(url, path.name, path.read_bytes())


def test_banks_at_urls_are_merged(tmp_path: Path) -> None:
    url = empty_memory()
    write_bank(tmp_path / "far", [some_image(i) for i in range(4)])
    write_bank(tmp_path / "near", [some_image(i) for i in range(4)])
    near = head(Bank(tmp_path / "near"), 3, tmp_path / "three", progress=False)
    upload(tmp_path / "far", url)
    merged = head(Bank(url), 3, tmp_path / "head", progress=False)
    assert merged.shards == near.shards
    (tmp_path / "far" / "shard-00000.h5").write_bytes(b"")
    content = bytearray(fsspec.filesystem("memory").cat_file(f"{url}/shard-00000.h5"))
    content[-9] ^= 1
    put(url, "shard-00000.h5", bytes(content))
    with pytest.raises(DataError, match=r"bank/shard-00000.h5 has sha256 .* by the"):
        merge([Bank(url)], tmp_path / "merged", progress=False)
    assert not list((tmp_path / "merged").glob("*.h5"))


def test_a_bank_at_a_url_is_curated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = empty_memory()
    write_bank(tmp_path / "bank", [some_image(i) for i in range(4)])
    upload(tmp_path / "bank", url)
    monkeypatch.chdir(tmp_path)
    for root, out in ((tmp_path / "bank", "near"), (url, "far")):
        call("curate", root, "--drop", "empty > 0.32", "--out", out)
    assert Bank("near").index.shards == Bank("far").index.shards
    assert 0 < len(Bank("far")) < 4
    assert len(list(tmp_path.glob("scores-*.npz"))) == 1


BANK = "BANK"
ELSEWHERE = "s3://mine/out"


@pytest.mark.parametrize(
    "words",
    [
        ("bank", "merge", ELSEWHERE, BANK),
        ("bank", "head", BANK, ELSEWHERE, "--count", "1"),
        ("bank", "split", BANK, f"{ELSEWHERE}=1"),
        ("bank", "as-sensor", BANK, ELSEWHERE, "--sensor", "os1_128"),
        ("convert", BANK, ELSEWHERE, "--to", "npz"),
        ("curate", BANK, "--drop", "empty > 0.32", "--out", ELSEWHERE),
        ("edit", "remove", BANK, ELSEWHERE, "--name", "Car"),
        ("label", "kitti360", BANK, ELSEWHERE),
        ("sample", ELSEWHERE, "--count", "1"),
        ("town", ELSEWHERE, "--scans", "1"),
        ("view", BANK, "--out", f"{ELSEWHERE}.png"),
    ],
    ids=" ".join,
)
def test_a_url_is_no_folder_to_write_to(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(4)])
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    given = [str(tmp_path / "bank") if word == BANK else word for word in words]
    status, output = call(*given)
    assert status == 2
    assert "s3://mine/out" in output and "Only bake writes to URLs" in output
    assert not list(Path().iterdir())


def test_a_bank_at_a_url_is_converted_and_viewed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = empty_memory()
    images = [some_image(i) for i in range(4)]
    write_bank(tmp_path / "bank", images, provenance={"data": ["mine"]})
    upload(tmp_path / "bank", url)
    for folder in (tmp_path, tmp_path / "out"):
        monkeypatch.chdir(folder)
        assert call("convert", url, tmp_path / "out", "--to", "npz")[0] == 0
        monkeypatch.undo()
    assert len(open_scans(tmp_path / "out")) == 4
    assert models_of(tmp_path / "out") == [{"data": ["mine"]}]
    assert url in repr(open_scans(url))
    assert call("view", url, "--out", tmp_path / "one.html")[0] == 0


# Faults of stores


def test_a_busy_store_costs_nothing(
    model: Path, expected: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retries, "WAITS", (0.0, 0.0))
    real = MemoryFileSystem.put_file
    calls = 0

    def busy(self: Any, *given: Any, **options: Any) -> None:
        nonlocal calls
        calls += 1
        if calls % 3:
            raise OSError("SlowDown")
        real(self, *given, **options)

    monkeypatch.setattr(MemoryFileSystem, "put_file", busy)
    bake(plan_at(empty_memory(), model), progress=False)
    assert files_at("memory://bucket/bank") == expected and calls == 12


def test_expired_credentials_are_reported_at_once(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def expired(self: Any, *given: Any, **options: Any) -> None:
        raise PermissionError("The provided token has expired.")

    monkeypatch.setattr(MemoryFileSystem, "pipe_file", expired)
    begun = time.monotonic()
    with pytest.raises(
        FileError, match=r"json cannot be written \(The .* URL that can be w"
    ):
        bake(plan_at(empty_memory(), model), progress=False)
    assert time.monotonic() - begun < 5


def test_a_store_that_cuts_an_upload_is_reported(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(self: Any, source: str, target: str, **options: Any) -> None:
        self.pipe_file(target, Path(source).read_bytes()[:-1])

    monkeypatch.setattr(MemoryFileSystem, "put_file", cut)
    plan = plan_at(empty_memory(), model)
    with pytest.raises(FileError, match=r"shard-00000.h5 has \d+ bytes after \d+ were"):
        bake(plan, progress=False)
    assert list_finished(plan, str(plan.out)) == {}


def test_a_missing_bucket_is_reported(model: Path, s3: str) -> None:
    with pytest.raises(FileError, match=r"s3://nowhere/bank/.bake.json cannot be writ"):
        bake(plan_at("s3://nowhere/bank", model), progress=False)


def test_a_web_server_cannot_be_baked_into(model: Path, tmp_path: Path) -> None:
    with serve(tmp_path) as served, pytest.raises(FileError, match="cannot be written"):
        bake(plan_at(f"{served.url}/bank", model), progress=False)


def test_a_bank_on_a_web_server_is_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retries, "WAITS", ())
    [*_, last] = write_bank(tmp_path / "bank", [some_image(i) for i in range(4)])
    with serve(tmp_path) as served:
        assert verify(f"{served.url}/bank", progress=False) == []
        last.write_bytes(last.read_bytes()[:-5])
        [problem, *_] = verify(f"{served.url}/bank", progress=False)
        served.broken.add("bank")  # its listing
        with pytest.warns(UserWarning, match="not in the index were not looked for"):
            [again, *_] = verify(f"{served.url}/bank", progress=False)
    assert problem.file == again.file == last.name
    assert hashlib.sha256(last.read_bytes()).hexdigest()[:12] in problem.what
