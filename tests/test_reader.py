"""The reader without the package: the same scans and samples bit for bit, and clear refusals."""

import ast
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from banks import some_image, write_bank
from lidar_synth.integrations import reader
from lidar_synth.integrations.plan import main, write_plan
from lidar_synth.integrations.reader import Bank, MixedEpochs, ReaderError
from reader_cases import BANKS, EPOCHS, MIXTURES, write_cases
from test_bank_hostile import HARMFUL, WRONG, harmful, places, with_value
from torch.utils.data import DataLoader

from lidar_synth.bank.chunks import checksum
from lidar_synth.errors import ConfigError
from lidar_synth.files.disk import sha256
from lidar_synth.files.parsing import json_checksum

SOURCE = Path(reader.__file__)
STANDARD = {
    "bisect",
    "collections",
    "contextlib",
    "hashlib",
    "json",
    "multiprocessing",
    "os",
    "pathlib",
    "re",
    "typing",
    "zipfile",
    "zlib",
    "__future__",
}


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cases")
    write_cases(folder)
    return folder


def test_a_copy_alone_reads_every_bank_and_plan_bit_for_bit(
    cases: Path, tmp_path: Path
) -> None:
    """``tools/test_reader_versions.py`` runs the same with old versions of Python, numpy and
    h5py."""
    assert len(list((cases / "banks").iterdir())) == len(BANKS) and len(
        list((cases / "plans").iterdir())
    ) == len(MIXTURES)
    shutil.copy(SOURCE, tmp_path / "reader.py")
    command = [sys.executable, Path(__file__).parent / "read_alone.py", tmp_path, cases]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "are equal, bit for bit" in done.stdout


def test_the_file_is_of_python_3_8_and_imports_numpy_and_h5py_alone() -> None:
    tree = ast.parse(SOURCE.read_text(), feature_version=(3, 8))
    names = [
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    ]
    names += [
        node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
    ]
    assert {name.split(".")[0] for name in names} - STANDARD == {"numpy", "h5py"}


def test_numbers_out_of_range_and_negative_ones(cases: Path) -> None:
    bank = Bank(cases / "banks" / "curated" / "bank")
    assert bank[-1].id == bank[len(bank) - 1].id
    for number in (len(bank), -len(bank) - 1):
        with pytest.raises(IndexError):
            bank[number]


def resealed(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the index of a bank and write it with a matching checksum."""
    values = json.loads((root / "index.json").read_text())
    del values["checksum"]
    change(values)
    (root / "index.json").write_text(
        json.dumps({**values, "checksum": json_checksum(values)})
    )


def registered(bank: Path, shard: Path) -> Bank:
    """The bank whose index names this file, with its size and hash, as its first shard."""
    entry = {"file": shard.name, "bytes": shard.stat().st_size, "sha256": sha256(shard)}
    resealed(bank, lambda values: values["shards"][0].update(entry))
    return Bank(bank)


@pytest.mark.parametrize("what", HARMFUL)
def test_a_malicious_shard_is_refused(tmp_path: Path, what: str) -> None:
    good, bad = harmful(tmp_path, what)
    assert len(Bank(good.parent)[1].points)
    bank = registered(bad.parent, bad)
    bank.verify()
    with pytest.raises(ReaderError, match=r"bad\.h5.* cannot be read"):
        bank[0]


def link(file: h5py.File, other: Path) -> None:
    del file["range"]
    file["range"] = h5py.ExternalLink(str(other), "/range")


def changed(name: str, value: int) -> Callable[[h5py.File, Path], None]:
    """Write a value of the first scan through HDF5, which stores its own checksums with it."""

    def change(file: h5py.File, _: Path) -> None:
        file[name][(0,) * file[name].ndim] = value

    return change


INVALID: dict[str, tuple[Callable[[h5py.File, Path], None], str]] = {
    "a link to a valid shard": (link, "range is a link to another object"),
    "another range": (changed("range", 4711), "CRC"),
    "another label": (changed("label", 3), "CRC"),
    "another seed": (changed("seed", 6), "CRC"),
    "another index": (changed("index", 9), "CRC"),
    "another CRC": (changed("crc", 1), "CRC"),
}


@pytest.mark.parametrize("what", INVALID)
def test_a_shard_with_other_values_is_refused(tmp_path: Path, what: str) -> None:
    change, message = INVALID[what]
    [good], [bad] = (
        write_bank(tmp_path / name, [some_image(0), some_image(1)])
        for name in ("good", "bad")
    )
    with h5py.File(bad, "r+", libver=("v110", "v110")) as file:
        change(file, good)
    with pytest.raises(ReaderError, match=message):
        registered(bad.parent, bad)[0]


@pytest.mark.parametrize(("name", "code"), [("label", 19), ("confidence", 16)])
def test_codes_without_a_meaning_are_refused(
    tmp_path: Path, name: str, code: int
) -> None:
    [path] = write_bank(tmp_path, [some_image(0)], fields=("label", "confidence"))
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        file[name][0, 0, 0] = code
        arrays = {name: file[name][0] for name in ("range", "label", "confidence")}
        file["crc"][0] = checksum(5, 0, arrays)
    with pytest.raises(ReaderError, match=f"it has {name}s above"):
        registered(tmp_path, path)[0]


def values(scan: Any) -> list[Any]:
    """A scan in values that compare by ``==``, bit for bit."""
    return [
        value.tobytes() if isinstance(value, np.ndarray) else value for value in scan
    ]


@pytest.mark.slow
def test_no_flipped_bit_gives_another_scan(tmp_path: Path) -> None:
    [path] = write_bank(
        tmp_path, [some_image(0), some_image(1)], fields=("reflectance", "label")
    )
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    expected = [values(Bank(tmp_path)[number]) for number in range(2)]
    for place in rng.integers(0, len(content), 200).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        bank = Bank(tmp_path)
        with pytest.raises(ReaderError, match="SHA-256"):
            bank.verify()
        try:
            assert [values(bank[number]) for number in range(2)] == expected
        except ReaderError:
            refused += 1
    assert refused > 10


def test_an_edited_index_is_read_or_refused(tmp_path: Path) -> None:
    write_bank(tmp_path, [some_image(i) for i in range(3)])
    text = (tmp_path / "index.json").read_text()
    values = {
        key: value
        for key, value in json.loads(text).items()
        if key not in ("checksum", "files")
    }
    values["shards"][0]["dropped"] = [1]
    values["scans"] -= 1
    (tmp_path / "index.json").write_text(
        json.dumps({**values, "checksum": json_checksum(values)})
    )
    assert len(Bank(tmp_path)) == 2
    refused = 0
    tried = [(path, wrong) for path in places(values) for wrong in WRONG]
    for path, wrong in tried[::3]:
        edited = with_value(values, path, wrong)
        (tmp_path / "index.json").write_text(
            json.dumps({**edited, "checksum": json_checksum(edited)})
        )
        try:
            bank = Bank(tmp_path)
            bank[0], bank[len(bank) - 1]
        except ReaderError:
            refused += 1
        except Exception as error:
            pytest.fail(
                f"{path} = {str(wrong)[:40]!r}: {type(error).__name__}: {error}"
            )
    assert refused > 0.5 * len(tried[::3])


def remove_index(root: Path) -> None:
    (root / "index.json").unlink()


def newer(root: Path) -> None:
    resealed(root, lambda values: values.update(format="lidar-synth-bank/3"))


def edited(root: Path) -> None:
    (root / "index.json").write_text(
        (root / "index.json").read_text().replace('"seed": 5', '"seed": 4')
    )


def blosc2(root: Path) -> None:
    resealed(root, lambda values: values["sources"][0].update(compression="blosc2"))


REFUSED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no index": (
        remove_index,
        "index.json cannot be read .*No such file.*the folder of a finished bank",
    ),
    "no shard": (
        lambda root: next(root.glob("*.h5")).unlink(),
        "is 0 bytes long, not .*copy it again",
    ),
    "truncated": (
        lambda root: next(root.glob("*.h5")).write_bytes(b"1"),
        "is 1 bytes long, not .*copy it again",
    ),
    "newer": (newer, "format .lidar-synth-bank/3., expected one of"),
    "blosc2": (blosc2, "compressed by 'blosc2'; bake it with --compression gzip"),
    "edited": (edited, "does not match its checksum"),
    "no JSON": (
        lambda root: (root / "index.json").write_text("["),
        "index.json cannot be read",
    ),
    "nested": (
        lambda root: (root / "index.json").write_text("[" * 10**6),
        "index.json cannot be read",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_bank_that_cannot_be_read_is_refused(tmp_path: Path, what: str) -> None:
    change, message = REFUSED[what]
    write_bank(tmp_path, [some_image(i) for i in range(2)])
    change(tmp_path)
    with pytest.raises(ReaderError, match=message):
        Bank(tmp_path)


def planned(cases: Path, name: str, real: Any = None, **options: Any) -> MixedEpochs:
    bank, count, _ = MIXTURES[name]
    given = range(count) if real is None else real
    return MixedEpochs(
        cases / "plans" / name / "plan.npz",
        given,
        Bank(cases / "banks" / bank / "bank"),
        **options,
    )


def number_of(sample: Any) -> str:
    return str(sample if isinstance(sample, int) else sample.id)


def plain(samples: list[Any]) -> list[str]:
    """The collate function of the test below."""
    return [number_of(sample) for sample in samples]


@pytest.mark.parametrize(
    ("workers", "start"), [(0, None), (2, None), (1, "spawn")], ids=str
)
def test_workers_follow_the_epoch(cases: Path, workers: int, start: str | None) -> None:
    train = planned(cases, "generated")
    loader = DataLoader(
        train,  # type: ignore[arg-type]
        4,
        collate_fn=plain,
        num_workers=workers,
        persistent_workers=workers > 0,
        multiprocessing_context=start,
    )
    orders = []
    for epoch in (0, 1, 2, 0):
        train.set_epoch(epoch)
        orders.append([name for batch in loader for name in batch])
        assert orders[-1] == [number_of(train[i]) for i in range(len(train))]
    assert orders[0] == orders[3] and len({tuple(order) for order in orders}) == EPOCHS


def test_real_samples_are_the_trainers_own_and_scans_get_its_form(cases: Path) -> None:
    train = planned(
        cases,
        "generated",
        real=lambda number: ("real", number),
        to_sample=lambda scan: ("made", scan.id),
    )
    kinds = [train[i][0] for i in range(len(train))]
    assert [kind == "made" for kind in kinds] == [
        bool(train.domain(i)) for i in range(len(train))
    ]
    with pytest.raises(IndexError):
        train[len(train)]


def replace_member(path: Path, name: str, value: Any) -> None:
    members = {**dict(np.load(path)), name: value}
    np.savez(path, **members)


WRONG_PLANS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (
        Path.unlink,
        "plan.npz cannot be read .*python -m lidar_synth.integrations.plan makes a plan",
    ),
    "no archive": (lambda path: path.write_text("x"), "plan.npz cannot be read"),
    "another file": (lambda path: np.savez(path, a=1), "plan.npz cannot be read"),
    "objects": (
        lambda path: np.savez(path, settings=np.array([{}])),
        "plan.npz cannot be read",
    ),
    "newer": (
        lambda path: rewrite(path, format="lidar-synth-epochs/2"),
        "format 'lidar-synth-epochs/2', expected",
    ),
    "another bank": (
        lambda path: rewrite(path, bank="x"),
        "made with another bank than",
    ),
    "other real samples": (
        lambda path: rewrite(path, real=12),
        "for 12 real samples, but there are 11",
    ),
    "too few scans": (
        lambda path: replace_member(path, "epoch-0", np.full((15, 2), (1, 5))),
        "do not exist",
    ),
    "a negative number": (
        lambda path: replace_member(path, "epoch-0", np.full((15, 2), (0, -1))),
        "do not exist",
    ),
    "another source": (
        lambda path: replace_member(path, "epoch-0", np.full((15, 2), (2, 0))),
        "epoch 0 cannot be",
    ),
    "another length": (
        lambda path: replace_member(path, "epoch-0", np.zeros((3, 2), np.int64)),
        "epoch 0 cannot be",
    ),
    "truncated": (
        lambda path: path.write_bytes(path.read_bytes()[:-200]),
        "plan.npz cannot be read",
    ),
}


def rewrite(path: Path, **changes: Any) -> None:
    """Change the settings of a plan."""
    settings = json.loads(np.load(path)["settings"].tobytes()) | changes
    replace_member(
        path, "settings", np.frombuffer(json.dumps(settings).encode(), np.uint8)
    )


@pytest.mark.parametrize("what", WRONG_PLANS)
def test_a_plan_that_does_not_fit_is_refused(
    cases: Path, tmp_path: Path, what: str
) -> None:
    change, message = WRONG_PLANS[what]
    path = tmp_path / "plan.npz"
    shutil.copy(cases / "plans" / "generated" / "plan.npz", path)
    bank = Bank(cases / "banks" / "all fields" / "bank")
    assert len(MixedEpochs(path, range(11), bank)) == 15
    change(path)
    with pytest.raises(ReaderError, match=message):
        MixedEpochs(path, range(11), bank)[0]


def test_an_epoch_after_the_last_is_refused(cases: Path) -> None:
    with pytest.raises(
        ReaderError,
        match="epoch 3 of a plan of 3 epochs; make it again with more --epochs",
    ):
        planned(cases, "generated").set_epoch(3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"labels": "paste"}, "labels='paste'.*generated, condition, boxes, none"),
        ({"labels": {"generated": {"kind": 1}}}, "argument 'kind'; expected arguments"),
        ({"as_sensor": "vlp16"}, "as_sensor: vlp16 for a plan file; expected none"),
        ({"augment": ["fog"]}, r"augment: \['fog'\] for a plan file; expected none"),
        ({"labels": "pseudo"}, "labels='pseudo'"),
        (
            {"synthetic": "town"},
            "synthetic: town; expected a bank. lidar-synth bake OUT",
        ),
        ({"synthetic": None}, "synthetic: None; expected a bank"),
        ({"unknown": 1}, "setting of a mixture 'unknown'"),
    ],
)
def test_mixtures_that_need_the_package_in_the_trainer_are_refused(
    cases: Path, tmp_path: Path, settings: dict[str, Any], message: str
) -> None:
    bank = str(cases / "banks" / "all fields" / "bank")
    with pytest.raises(ConfigError, match=message):
        write_plan(
            {"synthetic": bank, "ratio": 0.5, **settings},
            tmp_path / "plan.npz",
            real=4,
            epochs=1,
        )
    assert not list(tmp_path.iterdir())


def test_a_plan_takes_a_bank_in_every_form(cases: Path, tmp_path: Path) -> None:
    root = cases / "banks" / "all fields" / "bank"
    hashes = [
        write_plan({"synthetic": each}, tmp_path / "plan.npz", real=4, epochs=1)
        for each in (root, f"file://{root}", {"root": str(root)})
    ]
    assert hashes[1:] == hashes[:-1]


@pytest.mark.parametrize("labels", ["boxes", "generated", "condition"])
def test_a_plan_of_boxes_says_that_the_reader_keeps_unboxed_objects(
    cases: Path, tmp_path: Path, labels: str
) -> None:
    settings = {
        "synthetic": str(cases / "banks" / "boxes" / "bank"),
        "ratio": 0.5,
        "labels": labels,
    }
    with pytest.raises(
        ConfigError,
        match="of a bank with boxes for a plan file; expected unboxed: keep",
    ):
        write_plan(settings, tmp_path / "plan.npz", real=4, epochs=1)
    write_plan(settings | {"unboxed": "keep"}, tmp_path / "plan.npz", real=4, epochs=1)


@pytest.mark.slow
def test_the_command_line(
    cases: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The documented line, and its exit status 2 on wrong settings."""
    name, real, _ = MIXTURES["generated"]
    command = [
        sys.executable,
        "-m",
        "lidar_synth.integrations.plan",
        str(cases / "plans" / "generated" / "mix.yaml"),
    ]
    line = [
        *command,
        str(tmp_path / "plan.npz"),
        "--real",
        str(real),
        "--epochs",
        str(EPOCHS),
    ]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    assert "3 epochs, the first with plan " in done.stdout
    train = MixedEpochs(
        tmp_path / "plan.npz", range(real), Bank(cases / "banks" / name / "bank")
    )
    assert train.settings["hashes"] == planned(cases, "generated").settings["hashes"]
    monkeypatch.setattr(sys, "argv", [*line[2:-1], "0"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "0 epochs" in capsys.readouterr().err
