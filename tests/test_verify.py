"""Maintenance of banks: verify finds damage, repair regenerates it; merge, split and head keep
every scan."""

import json
import os
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from banks import some_image, write_bank
from test_generator import write
from typer.testing import CliRunner

import lidar_synth.bake.repair as repair_module
from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.bake.edit import head, merge, split
from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bake.making import NOTE
from lidar_synth.bake.repair import repair
from lidar_synth.bake.verify import AGREE, agreement, regenerate, verify
from lidar_synth.bank import INDEX, Bank, Index
from lidar_synth.bank.index import SETTINGS
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import sha256
from lidar_synth.files.lock import lock_shared
from lidar_synth.geometry.scan import RangeImage


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


def baked(out: Path, model: Path, **settings: Any) -> Path:
    bake(
        make_plan(
            out,
            BakeJob(**{"model": str(model), "count": 8, "shard_size": 3} | settings),
        ),
        progress=False,
    )
    return out


@pytest.fixture(scope="module")
def original(model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return baked(tmp_path_factory.mktemp("original") / "bank", model)


@pytest.fixture
def root(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "bank"))


def shards(root: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in root.glob("*.h5")}


def call(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


# Verify


def flip(path: Path, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "flip": (
        lambda path: flip(path, 8 * path.stat().st_size // 2),
        r"has \d+ bytes and sha256",
    ),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:-9]), "the index lists"),
    "longer": (
        lambda path: path.write_bytes(path.read_bytes() + b"x"),
        "the index lists",
    ),
    "missing": (lambda path: path.unlink(), r"cannot be read \(No such file"),
    "another": (
        lambda path: shutil.copyfile(path.with_name("shard-00000.h5"), path),
        "holds scans 0 to 2 of seed 0",
    ),
}


def test_an_intact_bank_needs_no_repair(root: Path, model: Path) -> None:
    assert verify(root, progress=False) == [] and repair(root, progress=False) == {}
    status, output = call("verify", root, "--deep", "--model", model, "--sample", 3)
    assert (
        status == 0
        and f"{root}: intact" in output
        and "3 scans regenerated, at least 100.00%" in output
    )


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_found_and_repaired(
    root: Path, original: Path, model: Path, kind: str
) -> None:
    damage, message = DAMAGE[kind]
    damage(root / "shard-00001.h5")
    status, output = call("verify", root)
    assert (
        status == 1 and "shard-00001.h5: " in output and "lidar-synth repair" in output
    )
    problems = verify(root, progress=False)
    assert {p.file for p in problems} == {"shard-00001.h5"}
    assert any(re.search(message, p.what) for p in problems)
    assert repair(root, str(model), progress=False) == {"shard-00001.h5": "regenerated"}
    assert shards(root) == shards(original) and verify(root, progress=False) == []
    assert (root / INDEX).read_bytes() == (original / INDEX).read_bytes()


def test_every_flipped_bit_is_found(root: Path) -> None:
    path = root / "shard-00002.h5"
    content = path.read_bytes()
    for bit in (
        np.random.default_rng(1).choice(8 * len(content), 40, replace=False).tolist()
    ):
        flip(path, bit)
        assert verify(root, progress=False), f"bit {bit}"
        path.write_bytes(content)
    assert verify(root, progress=False) == []


def test_a_damaged_scan_is_named(root: Path) -> None:
    """A file with the hash in the index, but with a scan that does not match its CRC: only reading
    it shows that."""
    path = root / "shard-00001.h5"
    with h5py.File(path, "r+") as file:
        file["label"][2, 3, 4] = 18 - file["label"][2, 3, 4] % 19
    index = Index.from_json((root / INDEX).read_bytes(), INDEX)
    entry = replace(index.shards[1], bytes=path.stat().st_size, sha256=sha256(path))
    write_bank_files(
        root, replace(index, shards=(index.shards[0], entry, index.shards[2]))
    )
    [problem] = verify(root, progress=False)
    assert (
        problem.file == "shard-00001.h5"
        and "scan 2 cannot be read (its CRC does not match)" in problem.what
    )


def test_unlisted_shards_are_found(root: Path) -> None:
    root = root.rename(root.with_name("a bank"))
    extra = Path(shutil.copyfile(root / "shard-00000.h5", root / "shard-00009.h5"))
    status, output = call("verify", root)
    assert status == 1 and f"{extra.name}: is not in the index: remove it" in output
    assert "lidar-synth repair" not in output
    (root / "README.md").unlink()
    assert f"lidar-synth repair {shlex.quote(str(root))} " in call("verify", root)[1]


SIDE = ["README.md", "croissant.json", SETTINGS]


def sides(root: Path) -> dict[str, bytes]:
    return {name: (root / name).read_bytes() for name in SIDE}


SIDE_DAMAGE: dict[str, Callable[[Path, np.random.Generator], object]] = {
    "flip": lambda path, rng: flip(path, int(rng.integers(8 * path.stat().st_size))),
    "cut": lambda path, rng: os.truncate(path, int(rng.integers(path.stat().st_size))),
    "longer": lambda path, rng: path.write_bytes(path.read_bytes() + b" "),
    "missing": lambda path, rng: path.unlink(),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SIDE)
@pytest.mark.parametrize("kind", SIDE_DAMAGE)
def test_damage_of_other_files_is_found_and_repaired(
    root: Path, original: Path, name: str, kind: str
) -> None:
    rng = np.random.default_rng(SIDE.index(name))
    for _ in range(20 if kind in ("flip", "cut") else 1):
        SIDE_DAMAGE[kind](root / name, rng)
        [problem] = verify(root, progress=False)
        assert problem.file == name
        assert repair(root, progress=False) == {name: "rewritten from the index"}
        assert verify(root, progress=False) == [] and sides(root) == sides(original)
        assert (root / INDEX).read_bytes() == (original / INDEX).read_bytes()


def test_repair_removes_what_a_killed_repair_left(root: Path, model: Path) -> None:
    part = root / ".shard-00000.h5.1.part"
    part.write_bytes(b"half a shard")
    assert repair(root, str(model), progress=False) == {
        part.name: "removed: a killed repair left it"
    }
    assert not part.exists() and repair(root, str(model), progress=False) == {}


@pytest.mark.skipif(os.name == "nt", reason="files are not locked on Windows")
@pytest.mark.parametrize("claim", [SETTINGS, NOTE])
def test_repair_leaves_a_folder_that_another_process_fills(
    root: Path, claim: str
) -> None:
    part = root / ".shard-00000.h5.1.part"
    part.write_bytes(b"half a shard")
    (root / claim).touch()
    with (
        lock_shared(root / claim),
        pytest.raises(ConfigError, match="bank, in which another process works"),
    ):
        repair(root, progress=False)
    assert part.exists()


def test_verify_and_repair_report_damage_of_other_files(
    root: Path, model: Path
) -> None:
    (root / SETTINGS).write_text("{}")
    status, output = call("verify", root)
    assert (
        status == 1
        and f"{SETTINGS}: has sha256" in output
        and "was damaged or edited" in output
    )
    status, output = call("repair", root)
    assert status == 0 and f"{SETTINGS}: rewritten from the index" in output
    assert (
        bake(
            make_plan(root, BakeJob(model=str(model), count=8, shard_size=3)),
            progress=False,
        )
        is not None
    )


def test_a_renamed_bank_is_intact(root: Path, tmp_path: Path) -> None:
    assert verify(root.rename(tmp_path / "other"), progress=False) == []


def test_repair_rebuilds_a_bank_from_its_shards(root: Path, original: Path) -> None:
    for name in (*SIDE, INDEX):
        (root / name).unlink()
    assert repair(root, progress=False) == {INDEX: "rebuilt from the shards"}
    assert (
        sides(root) == sides(original)
        and (root / INDEX).read_bytes() == (original / INDEX).read_bytes()
    )


def test_an_index_of_an_older_version_lists_no_other_files(
    root: Path, original: Path, model: Path
) -> None:
    """It is the same bank; its settings file with another order of keys is kept."""
    values = json.loads((root / INDEX).read_bytes())
    assert set(values.pop("files")) == set(SIDE)
    values["checksum"] = Bank(original).identity
    (root / INDEX).write_text(json.dumps(values))
    settings = json.loads((root / SETTINGS).read_bytes())
    (root / SETTINGS).write_text(json.dumps(dict(reversed(settings.items())), indent=1))
    assert Bank(root).identity == Bank(original).identity
    (root / "README.md").unlink()
    assert verify(root, progress=False) == [] and repair(root, progress=False) == {}
    bake(
        make_plan(root, BakeJob(model=str(model), count=8, shard_size=3)),
        progress=False,
    )
    assert list(json.loads((root / SETTINGS).read_bytes())) == list(reversed(settings))
    assert verify(root, progress=False) == [] and (root / "README.md").is_file()
    flip(root / SETTINGS, 80)
    assert repair(root, progress=False) == {SETTINGS: "rewritten from the index"}
    assert sides(root) == sides(original)


def test_deep_verification_samples_other_scans_each_time(
    root: Path, model: Path
) -> None:
    outputs = [
        call("verify", root, "--deep", "--model", model, "--sample", 2)[1]
        for _ in range(2)
    ]
    seeds = [
        re.findall(r"scans selected by --seed (\d+)", output) for output in outputs
    ]
    assert len(seeds[0]) == len(seeds[1]) == 1 and seeds[0] != seeds[1]
    assert (
        "selected by --seed 7"
        in call("verify", root, "--deep", "--model", model, "--sample", 2, "--seed", 7)[
            1
        ]
    )
    samples = [
        frozenset(regenerate(root, str(model), 2, progress=False)) for _ in range(8)
    ]
    assert len(set(samples)) > 1
    again = [
        set(regenerate(root, str(model), 2, progress=False, seed=7)) for _ in range(2)
    ]
    assert again[0] == again[1] and len(again[0]) == 2


def test_a_shard_may_be_open_in_plain_h5py(root: Path) -> None:
    """In this process; both can read it, in either order."""
    path = root / "shard-00001.h5"
    bank = Bank(root)
    for options in (
        {},
        {"locking": True},
        {"locking": False},
        {"libver": "latest"},
        {"driver": "stdio"},
    ):
        with h5py.File(path, "r", **options) as plain:
            assert verify(root, progress=False) == []
            assert np.array_equal(plain["range"][0], bank.shard(1).read(0)["range"])
        with h5py.File(path, "r", **options) as plain:  # the bank has it open now
            assert plain["range"].shape == (3, 8, 32)
        bank.close()
    with h5py.File(path, "r+"):
        assert len(bank[4].points)


def test_options_of_deep_verification_alone_are_refused(root: Path) -> None:
    with pytest.raises(ConfigError, match="--sample and --seed without --deep"):
        call("verify", root, "--sample", 3, "--seed", 0)


def test_deep_verification_finds_scans_that_do_not_match_their_seeds(
    tmp_path: Path, model: Path
) -> None:
    honest = Bank(baked(tmp_path / "honest", model, seed=5))
    stored = {
        name: getattr(honest.facts, name)
        for name in ("settings", "checkpoint", "fields")
    }
    write_bank(tmp_path / "false", [some_image(i) for i in range(8)], **stored)
    assert verify(tmp_path / "false", progress=False) == []
    assert (
        max(regenerate(tmp_path / "false", str(model), progress=False).values()) < AGREE
    )
    status, output = call("verify", tmp_path / "false", "--deep", "--model", model)
    assert status == 1 and "of its cells agree with the regenerated scan" in output
    other = write(tmp_path / "other.safetensors", ("range",))
    with pytest.raises(
        ConfigError,
        match=r"other.*the checkpoint that made the bank's scans, small .*--model",
    ):
        regenerate(honest.root, str(other), progress=False)
    with pytest.raises(ConfigError, match="model 'small'; expected a shipped one"):
        call("verify", honest.root, "--deep")


def test_a_bank_of_a_gpu_needs_none_to_be_verified_and_repaired(
    tmp_path: Path, model: Path
) -> None:
    made = Bank(baked(tmp_path / "made", model, seed=5, dtype="bfloat16"))
    settings = made.facts.settings | {"device": "cuda"}
    stored = {name: getattr(made.facts, name) for name in ("checkpoint", "fields")}
    images = [made.image(i) for i in range(8)]
    [first, *_] = write_bank(tmp_path / "gpu", images, settings=settings, **stored)
    assert (
        min(regenerate(tmp_path / "gpu", str(model), progress=False).values()) > AGREE
    )
    first.unlink()
    done = repair(tmp_path / "gpu", str(model), progress=False)
    assert done[first.name].startswith("regenerated")
    assert verify(tmp_path / "gpu", progress=False) == []
    assert Bank(tmp_path / "gpu").facts.settings["device"] == "cuda"


# Repair


@pytest.mark.parametrize("lost", [True, False])
def test_a_lost_or_damaged_index_is_rebuilt(
    root: Path, original: Path, model: Path, lost: bool
) -> None:
    if lost:
        (root / INDEX).unlink()
    else:
        (root / INDEX).write_text(
            (root / INDEX).read_text().replace('"seed": 0', '"seed": 1', 1)
        )
    (root / "shard-00002.h5").unlink()
    flip(root / "shard-00000.h5", 8 * 5000)
    with pytest.raises((DataError, FileError)):
        verify(root, progress=False)
    done = repair(root, str(model), progress=False)
    assert done == {
        INDEX: "rebuilt from the shards",
        "shard-00000.h5": "regenerated",
        "shard-00002.h5": "regenerated",
    }
    assert (
        shards(root) == shards(original)
        and (root / INDEX).read_bytes() == (original / INDEX).read_bytes()
    )


def test_banks_beyond_repair_are_reported(root: Path, tmp_path: Path) -> None:
    (root / INDEX).unlink()
    with pytest.raises(DataError, match="and no shard of .* can be read"):
        repair(tmp_path, progress=False)
    for path in root.glob("*.h5"):
        flip(path, 8 * 50)
    with pytest.raises(DataError, match="and no shard of .* can be read"):
        repair(root, progress=False)
    write_bank(tmp_path / "strange", [some_image()])
    (tmp_path / "strange" / "shard-00000.h5").unlink()
    with pytest.raises(ConfigError, match="model 'small'; expected a shipped one"):
        repair(tmp_path / "strange", progress=False)
    [shard] = write_bank(tmp_path / "recorded", [some_image()], checkpoint="")
    shard.unlink()
    with pytest.raises(DataError, match="recorded scans, which no model makes again"):
        repair(tmp_path / "recorded", progress=False)


def test_an_index_is_not_rebuilt_from_some_shards_of_a_bake_or_of_several(
    root: Path, tmp_path: Path, model: Path
) -> None:
    """Else a part of a bank, or shards of two, would become a whole bake."""
    part = tmp_path / "part"
    head(Bank(root), 4, part, progress=False)
    both = Path(shutil.copytree(root, tmp_path / "both"))
    other = baked(tmp_path / "other", model, steps=2)
    shutil.copyfile(other / "shard-00001.h5", both / "shard-00001.h5")
    for name in ("shard-00002.h5", SETTINGS):
        (root / name).unlink()
    for folder, message in (
        (part, "of different bakes"),
        (both, "of different bakes"),
        (root, "shard-00002.h5 is not there, nor .bake.json"),
    ):
        (folder / INDEX).unlink()
        before = shards(folder)
        with pytest.raises(DataError, match=f"{message}.*expected a copy of the index"):
            repair(folder, str(model), progress=False)
        assert shards(folder) == before and not (folder / INDEX).exists()


def test_cells_with_other_labels_do_not_agree() -> None:
    one, other = some_image(), some_image()
    assert agreement(one, other) == 1
    other.channels["label"][0, :4] = (other.channels["label"][0, :4] + 1) % 19
    assert agreement(one, other) == 1 - 4 / one.range.size


def test_a_repair_with_different_bytes_is_recorded(
    root: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Like a repair on another machine: the scans are equal up to rounding, their bytes differ.
    What an interrupted one has made is kept."""
    before = [scan.points for scan in Bank(root)]
    write_shard = repair_module.write_shard

    class Rounding:
        def __init__(self, generator: Any) -> None:
            self.generator = generator
            self.batch = generator.batch
            self.sensor = generator.sensor

        def range_images(self, *arguments: Any, **options: Any) -> list[RangeImage]:
            images: list[RangeImage] = self.generator.range_images(
                *arguments, **options
            )
            for image in images:
                image.range[image.mask] = np.minimum(
                    image.range[image.mask] * np.float32(1 + 1e-4), 80
                )
            return images

    stops = [KeyboardInterrupt]

    def round_or_stop(generator: Any, part: Path, *rest: Any) -> None:
        if "shard-00002" in part.name and stops:
            raise stops.pop()
        write_shard(Rounding(generator), part, *rest)

    monkeypatch.setattr(repair_module, "write_shard", round_or_stop)
    for name in ("shard-00001.h5", "shard-00002.h5"):
        (root / name).unlink()
    with pytest.raises(KeyboardInterrupt):
        repair(root, str(model), progress=False)
    assert repair(root, str(model), progress=False) == {
        "shard-00002.h5": "regenerated, with different bytes"
    }
    assert verify(root, progress=False) == []
    assert "shard-00001.h5 was regenerated with torch" in Bank(root).index.repairs[0]
    assert "with different bytes" in (root / "README.md").read_text()
    for old, new in zip(before, (scan.points for scan in Bank(root)), strict=True):
        assert np.allclose(old, new, rtol=1e-3)
    bake_again = make_plan(root, BakeJob(model=str(model), count=8, shard_size=3))
    index = bake(bake_again, progress=False)
    assert index is not None and index.repairs  # resuming keeps the record


def test_the_repair_command(root: Path, model: Path) -> None:
    status, output = call("repair", root, "--model", model)
    assert status == 0 and f"{root}: intact, nothing to do" in output
    (root / "shard-00001.h5").unlink()
    status, output = call("repair", root, "--model", model)
    assert status == 0 and "shard-00001.h5: regenerated" in output


# Merge, split, head


def names_and_points(*roots: Path) -> list[tuple[str, bytes]]:
    return [(scan.id, scan.points.tobytes()) for root in roots for scan in Bank(root)]


def test_split_and_merge_are_inverse(root: Path, tmp_path: Path) -> None:
    parts = split(
        Bank(root),
        {tmp_path / "a": 0.5, tmp_path / "b": 0.25, tmp_path / "c": 0.25},
        progress=False,
    )
    assert [index.scans for index in parts.values()] == [4, 2, 2]
    assert names_and_points(*parts) == names_and_points(root)
    assert all(verify(part, progress=False) == [] for part in parts)
    index = merge([Bank(part) for part in parts], tmp_path / "merged", progress=False)
    assert index.scans == 8 and len(index.sources) == 1
    assert names_and_points(tmp_path / "merged") == names_and_points(root)
    assert verify(tmp_path / "merged", progress=False) == []


def test_banks_of_links_are_merged_as_their_files(root: Path, tmp_path: Path) -> None:
    """The cache of the hub keeps files as relative links."""
    linked = tmp_path / "snapshots" / "bank"
    linked.mkdir(parents=True)
    for path in root.iterdir():
        (linked / path.name).symlink_to(Path("../..", "bank", path.name))
    merge([Bank(linked)], tmp_path / "merged", progress=False)
    assert verify(tmp_path / "merged", progress=False) == []
    assert names_and_points(tmp_path / "merged") == names_and_points(root)


def test_head_takes_the_first_scans(root: Path, tmp_path: Path, model: Path) -> None:
    status, output = call("bank", "head", root, tmp_path / "head", "--count", 4)
    assert status == 0 and f"{tmp_path / 'head'}: 4 scans in 2 shards" in output
    assert names_and_points(tmp_path / "head") == names_and_points(root)[:4]
    assert (tmp_path / "head" / "shard-00000.h5").read_bytes() == (
        root / "shard-00000.h5"
    ).read_bytes()
    before = shards(tmp_path / "head")
    (tmp_path / "head" / "shard-00001.h5").unlink()
    assert repair(tmp_path / "head", str(model), progress=False) == {
        "shard-00001.h5": "regenerated"
    }
    assert shards(tmp_path / "head") == before
    for count in (0, 9):
        with pytest.raises(
            ConfigError, match=f"the first {count} scans of .*; expected 1 to 8"
        ):
            head(Bank(root), count, tmp_path / "none", progress=False)


def test_banks_of_several_bakes_can_be_merged_and_repaired(
    root: Path, tmp_path: Path, model: Path
) -> None:
    other = baked(tmp_path / "other", model, first=8, count=4)
    status, _ = call("bank", "merge", tmp_path / "all", root, other)
    assert status == 0
    assert names_and_points(tmp_path / "all") == names_and_points(root, other)
    bank = Bank(tmp_path / "all")
    assert len(bank.index.sources) == 2 and bank[11].id == "small/0/11"
    (tmp_path / "all" / "shard-00003.h5").unlink()
    assert repair(tmp_path / "all", str(model), progress=False) == {
        "shard-00003.h5": "regenerated"
    }
    assert names_and_points(tmp_path / "all") == names_and_points(root, other)
    with pytest.raises(
        ConfigError, match="both hold scan 6 of seed 0; expected every scan only once"
    ):
        merge(
            [Bank(root), Bank(baked(tmp_path / "over", model, first=6, count=4))],
            tmp_path / "x",
            progress=False,
        )
    write_bank(tmp_path / "few", [some_image()])
    with pytest.raises(
        ConfigError,
        match=r"few holds \('reflectance', 'label'\) of sensor 'small' .*; expected",
    ):
        merge([Bank(root), Bank(tmp_path / "few")], tmp_path / "x", progress=False)
    assert not (tmp_path / "x").exists()


def test_invalid_edits_are_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="was filled with|holds another bank"):
        head(Bank(root), 2, root, progress=False)
    for shares in ({"a": 0.5, "b": 0.6}, {"a": 1.5, "b": -0.5}, {"a": 0.99, "b": 0.01}):
        with pytest.raises(ConfigError, match="sum to 1|at least one scan"):
            split(
                Bank(root),
                {tmp_path / name: share for name, share in shares.items()},
                progress=False,
            )
    for part in ("train", "train=much", "=0.5", "q/=0.5"):
        with pytest.raises(ConfigError, match=f"part '{part}'; expected FOLDER=SHARE"):
            call("bank", "split", root, "q=0.5", part)
    (tmp_path / "file").touch()
    with pytest.raises(FileError, match=r"file.\.made\.json cannot be written"):
        head(Bank(root), 2, tmp_path / "file", progress=False)


def test_info_describes_a_bank(root: Path) -> None:
    status, output = call("info", root)
    assert status == 0
    for text in (
        "scans         8",
        "small, 8 x 32",
        "1.45 to 80 m in steps of 1.22 mm",
        "reflectance, label, confidence",
    ):
        assert text in output
    found = json.loads(call("info", root, "--json")[1])
    assert (found["scans"], found["shards"], found["identity"]) == (
        8,
        3,
        Bank(root).identity,
    )
    with pytest.raises(FileError, match="holds no bank"):
        call("info", root / "nowhere")


def test_repair_says_where_it_may_not_remove(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    (root / ".shard-00000.h5.1.part").write_bytes(b"half a shard")
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(FileError, match=r"part cannot be written \(Permission denied"):
        repair(root, progress=False)
