"""Models and banks go to the Hugging Face hub and come back, through its real client and a stand-in
of its server."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_models
import yaml
from banks import some_image, write_bank
from hub_server import TOKEN, Hub, serve_hub

from lidar_synth import Bank, Generator, load_generator, open_scans, sample_scans
from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.bake.verify import verify
from lidar_synth.errors import ConfigError, DataError, FileError, LibraryError
from lidar_synth.files.hub import Repository, front_matter, pin_revision
from lidar_synth.generate.loading import settle_model
from lidar_synth.geometry.sensor import load_sensor

huggingface_hub = pytest.importorskip("huggingface_hub")

LARGE = load_sensor("hdl64e_kitti360")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A stand-in to which the client of this process is turned, with a new cache."""
    from huggingface_hub import HfFileSystem, constants

    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    with serve_hub() as found:
        monkeypatch.setattr(constants, "ENDPOINT", found.url)
        template = found.url + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        HfFileSystem.clear_instance_cache()
        yield found
    HfFileSystem.clear_instance_cache()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return small_models.write(tmp_path / "tiny.safetensors")


def card_of(hub: Hub, repository: str) -> str:
    return hub.commits[repository][-1][1]["README.md"].decode()


def metadata_of(card: str) -> dict[str, object]:
    values = yaml.safe_load(card.split("---\n")[1])
    assert isinstance(values, dict)
    return values


def push_without_client(code: str) -> str:
    """What a process without huggingface_hub says to some code."""
    hide = "import sys; sys.modules['huggingface_hub'] = None\n"
    done = subprocess.run(
        [sys.executable, "-c", hide + code], capture_output=True, text=True, check=False
    )
    return done.stderr


# Models


def test_a_model_comes_back_as_it_went(hub: Hub, model: Path) -> None:
    generator = load_generator(model)
    url = generator.push_to_hub("me/tiny")
    digest = hub.commits["me/tiny"][-1][0]
    assert url == f"hf://me/tiny@{digest}"
    for name in (url, "hf://me/tiny", "hf://me/tiny/tiny.safetensors"):
        back = load_generator(name)
        assert (back.name, back.hash) == ("tiny", generator.hash)
        assert back.path is not None and back.path.read_bytes() == model.read_bytes()
    [here] = generator.range_images(0, [3])
    [there] = back.range_images(0, [3])
    assert np.array_equal(here.range, there.range)


def test_the_card_of_a_model_has_the_metadata_of_the_hub(hub: Hub, model: Path) -> None:
    load_generator(model).push_to_hub("me/tiny")
    card = card_of(hub, "me/tiny")
    assert metadata_of(card) == {
        "license": "mit",
        "library_name": "lidar_synth",
        "pipeline_tag": "unconditional-image-generation",
        "tags": ["lidar", "point-cloud", "range-image"],
    }
    assert huggingface_hub.ModelCard(card).data.license == "mit"
    assert "/api/validate-yaml" in [path for _, path, _ in hub.requests]
    for text in ('load_generator("hf://me/tiny")', "| data licence | none |", " M |"):
        assert text in card


def test_a_revision_stays_what_it_was(hub: Hub, model: Path, tmp_path: Path) -> None:
    first = load_generator(model).push_to_hub("me/tiny")
    before = load_generator(first).hash
    other = small_models.write(tmp_path / "new" / "tiny.safetensors", ("range",))
    load_generator(other).push_to_hub("me/tiny")
    assert load_generator(first).hash == before
    assert load_generator("hf://me/tiny").hash == load_generator(other).hash != before
    assert pin_revision(first) == first != pin_revision("hf://me/tiny")


def test_a_model_is_downloaded_once(hub: Hub, model: Path) -> None:
    url = load_generator(model).push_to_hub("me/tiny")
    for name in (url, url, "hf://me/tiny"):
        load_generator(name)
    size = model.stat().st_size
    assert sum(r[0] == "GET" and r[2] >= size for r in hub.requests) == 1


def test_several_checkpoints_have_to_be_named(
    hub: Hub, model: Path, tmp_path: Path
) -> None:
    load_generator(model).push_to_hub("me/tiny")
    other = small_models.write(tmp_path / "other.safetensors")
    load_generator(other).push_to_hub("me/tiny")
    with pytest.raises(DataError, match="other.safetensors and tiny.safetensors"):
        load_generator("hf://me/tiny")
    assert load_generator("hf://me/tiny/other.safetensors").name == "other"
    with pytest.raises(DataError, match="holds no checkpoint"):
        load_generator("hf://me/tiny/missing.safetensors")


def test_weights_without_their_file_are_not_pushed(
    hub: Hub, model: Path, tmp_path: Path
) -> None:
    generator = load_generator(model)
    with pytest.raises(ConfigError, match="not .* in a file"):
        replace(generator, path=None).push_to_hub("me/tiny")
    small_models.write(model, ("range",))
    with pytest.raises(ConfigError, match="no longer"):
        generator.push_to_hub("me/tiny")
    assert hub.requests == []


@pytest.mark.slow
def test_a_bake_names_the_commit_of_its_model(
    hub: Hub, model: Path, tmp_path: Path
) -> None:
    url = load_generator(model).push_to_hub("me/tiny")
    plan = make_plan(tmp_path / "bank", BakeJob(model="hf://me/tiny", count=3))
    assert plan.job.model == url
    bake(plan, progress=False)
    assert Bank(tmp_path / "bank")[2].id == "tiny/0/2"


def test_a_model_in_the_cache_is_named_by_its_commit(
    hub: Hub, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the hub does not answer."""
    from huggingface_hub import constants

    url = load_generator(model).push_to_hub("me/tiny")
    found = settle_model("hf://me/tiny")
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert found == settle_model("hf://me/tiny") == settle_model(url) == url
    with pytest.raises(FileError, match="hf://me/other"):
        settle_model("hf://me/other")


# Banks


def test_a_bank_comes_back_as_it_went(hub: Hub, tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", [some_image(i) for i in range(5)])
    here = Bank(tmp_path / "bank")
    url = here.push_to_hub("me/bank")
    digest = hub.commits["datasets/me/bank"][-1][0]
    assert url == f"hf://datasets/me/bank@{digest}"
    for name in (url, "hf://datasets/me/bank"):
        scans = open_scans(name)
        assert len(scans) == 5
        for number in range(5):
            assert np.array_equal(scans[number].points, here[number].points)
            assert np.array_equal(scans[number].label, here[number].label)
    there = Bank("hf://datasets/me/bank")
    assert (there.identity, there.root) == (here.identity, url)
    assert not list(verify(there.root, progress=False))


def test_a_bank_is_read_at_one_commit(hub: Hub, tmp_path: Path) -> None:
    write_bank(tmp_path / "old", [some_image(i) for i in range(2)])
    write_bank(tmp_path / "new", [some_image(i + 9) for i in range(2)])
    Bank(tmp_path / "old").push_to_hub("me/bank")
    opened = Bank("hf://datasets/me/bank")
    Bank(tmp_path / "new").push_to_hub("me/bank")
    expected = Bank(tmp_path / "old")[1].points
    assert np.array_equal(opened[1].points, expected)
    newest = Bank(tmp_path / "new")[1].points
    assert np.array_equal(Bank("hf://datasets/me/bank")[1].points, newest)


def test_reading_a_scan_transfers_little_more_than_it(hub: Hub, tmp_path: Path) -> None:
    write_bank(tmp_path, [some_image(i, LARGE) for i in range(8)], shard_size=8)
    Bank(tmp_path).push_to_hub("me/bank")
    bank = Bank("hf://datasets/me/bank")
    bank[0]
    before = sum(size for _, _, size in hub.requests)
    bank[5]
    moved = sum(size for _, _, size in hub.requests) - before
    chunks, _ = Bank(tmp_path).shard(0).chunks(5)
    assert moved <= 1.1 * sum(map(len, chunks.values()))


def test_the_card_of_a_bank_has_the_metadata_of_the_hub(hub: Hub) -> None:
    scans = sample_scans()
    scans.push_to_hub("me/street", private=True)
    card = card_of(hub, "datasets/me/street")
    assert metadata_of(card) == {
        "license": "cc-by-4.0",
        "pretty_name": "me/street",
        "size_categories": ["n<1K"],
        "task_categories": ["image-segmentation", "object-detection"],
        "tags": ["lidar", "point-cloud", "range-image"],
    }
    assert huggingface_hub.DatasetCard(card).data.license == "cc-by-4.0"
    assert "/api/validate-yaml" in [path for _, path, _ in hub.requests]
    assert 'open_scans("hf://datasets/me/street")' in card
    assert "attribute Scale AI" in card
    assert hub.private == {"datasets/me/street"}


def test_a_damaged_bank_is_not_pushed(hub: Hub, tmp_path: Path) -> None:
    [path] = write_bank(tmp_path, [some_image()])
    content = bytearray(path.read_bytes())
    content[-10] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"shard-00000.h5 has sha256"):
        Bank(tmp_path).push_to_hub("me/bank")
    assert hub.requests == []


def test_a_bank_at_a_url_is_not_pushed(hub: Hub, tmp_path: Path) -> None:
    write_bank(tmp_path, [some_image()])
    url = Bank(tmp_path).push_to_hub("me/bank")
    with pytest.raises(ConfigError, match="expected one in a folder"):
        Bank(url).push_to_hub("me/copy")


# Licences


@pytest.mark.parametrize("licence", ["", "that of the scans", "as R2Flow's: MIT"])
def test_a_bank_without_licence_is_refused(
    hub: Hub, tmp_path: Path, licence: str
) -> None:
    write_bank(tmp_path, [some_image()], licence=licence)
    bank = Bank(tmp_path)
    message = "with the licence .* expected a licence that the hub knows"
    with pytest.raises(ConfigError, match=message):
        bank.push_to_hub("me/bank")
    assert hub.requests == []
    bank.push_to_hub("me/bank", licence="mit")
    assert metadata_of(card_of(hub, "datasets/me/bank"))["license"] == "mit"
    there = Bank("hf://datasets/me/bank")
    assert there.identity == bank.identity
    assert not list(verify(there.root, progress=False))


def test_a_model_with_an_unknown_licence_is_refused(hub: Hub, model: Path) -> None:
    loaded = load_generator(model)
    provenance = loaded.header.provenance | {"licence": "that of the scans"}
    header = replace(loaded.header, provenance=provenance)
    generator = Generator(**vars(loaded) | {"header": header})
    with pytest.raises(ConfigError, match="'that of the scans'.*licence='mit'"):
        generator.push_to_hub("me/tiny")
    assert hub.requests == []
    generator.push_to_hub("me/tiny", licence="other")
    assert metadata_of(card_of(hub, "me/tiny"))["license"] == "other"


def test_the_hub_itself_can_refuse_a_card(hub: Hub, model: Path) -> None:
    with pytest.raises(FileError, match='"license" must be one of'):
        load_generator(model).push_to_hub("me/tiny", licence="gpl-3.0")
    assert hub.commits == {"me/tiny": []}


@pytest.mark.parametrize(
    ("licences", "expected"),
    [
        (["MIT"], {"license": "mit"}),
        (["CC BY-NC-SA 3.0"], {"license": "cc-by-nc-sa-3.0"}),
        (["MIT", "CC BY 4.0", "MIT"], {"license": ["mit", "cc-by-4.0"]}),
        (["MIT", "mine"], {"license": "other", "license_name": "MIT; mine"}),
        ([""], {}),
    ],
)
def test_licences_become_identifiers(
    licences: list[str], expected: dict[str, object]
) -> None:
    text = "\n".join(front_matter(licences, tags=["lidar"], empty=[]))
    assert metadata_of(text) == expected | {"tags": ["lidar"]}


# What is not there


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hf://me/missing", "a repository of the hub that you may use"),
        ("hf://me/tiny@gone", "a repository of the hub that you may use"),
        ("hf://tiny", "expected hf://user/model"),
    ],
)
def test_names_that_lead_nowhere(
    hub: Hub, model: Path, name: str, message: str
) -> None:
    load_generator(model).push_to_hub("me/tiny")
    with pytest.raises((FileError, ConfigError), match=message):
        load_generator(name)
    with pytest.raises((FileError, ConfigError), match=message):
        Bank(name.replace("hf://", "hf://datasets/"))


def test_a_wrong_token_is_a_clear_error(
    hub: Hub, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_expired")
    with pytest.raises(FileError, match=r"hf://me/tiny: .*401.*hf auth login"):
        load_generator(model).push_to_hub("me/tiny")


def test_a_private_model_needs_the_token(
    hub: Hub, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_generator(model).push_to_hub("me/tiny", private=True)
    monkeypatch.setenv("HF_TOKEN", "hf_of_another")
    with pytest.raises(FileError, match="hf auth login"):
        load_generator("hf://me/tiny")


def test_a_hub_that_does_not_answer(
    model: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    with pytest.raises(FileError, match="hf://me/tiny"):
        load_generator("hf://me/tiny")


def test_other_names_lead_to_no_request(hub: Hub, model: Path) -> None:
    load_generator(model)
    sample_scans()[0]
    assert hub.requests == []


@pytest.mark.parametrize(
    "code",
    [
        "from lidar_synth import load_generator\nload_generator('hf://me/tiny')",
        "from lidar_synth import open_scans\nopen_scans('hf://datasets/me/bank')",
        "from lidar_synth import sample_scans\nsample_scans().push_to_hub('me/x')",
    ],
)
def test_without_the_extra_the_error_says_what_to_install(code: str) -> None:
    assert LibraryError.__name__ in (said := push_without_client(code))
    assert "pip install 'lidar_synth[hub]'" in said


def test_names_of_repositories() -> None:
    for text in ("hf://a/b", "hf://datasets/a/b@main", "hf://a/b@v1/c.safetensors"):
        assert str(Repository.parse(text)) == text
    assert Repository.parse("hf://datasets/a/b@v1/sub") == Repository(
        "dataset", "a/b", "v1", "sub"
    )
