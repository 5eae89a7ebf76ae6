"""Feature extractors: the published archives with random weights, against numbers that the peers'
own code gave."""

import importlib
import itertools
import json
import shutil
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import random_inputs as inputs
import torch
import yaml
from conftest import Golden, random_scan
from numpy.typing import NDArray
from random_archives import write
from safetensors.numpy import load_file
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.errors import (
    ConfigError,
    DataError,
    FileError,
    LibraryError,
    LidarSynthError,
)
from lidar_synth.files.disk import sha256
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.evaluate import Metric, frechet_distance
from lidar_synth.lab.evaluate.extractors import EXTRACTORS, load_extractor
from lidar_synth.lab.evaluate.extractors.archive import Archive
from lidar_synth.lab.evaluate.extractors.bonnetal import (
    POOLS,
    load_lidm,
    read_segmenter,
)
from lidar_synth.lab.evaluate.extractors.inputs import PREPARATIONS
from lidar_synth.lab.evaluate.extractors.liploc import picture
from lidar_synth.lab.evaluate.extractors.rangevit import build
from lidar_synth.lab.evaluate.street_judge import load_archive

Of = Callable[[torch.Tensor], NDArray[np.floating]]
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """An extractor's archive with random weights, written once."""
    folder = tmp_path_factory.mktemp("weights")

    def made(name: str) -> Path:
        path = folder / name / EXTRACTORS[name].archives[0]
        if name == "sparenet_pointnet":
            return path if path.exists() else write(name, path.parent)
        return path if path.exists() else write(name, path)

    return made


@pytest.fixture(scope="module")
def peer(golden: Golden) -> dict[str, NDArray[np.float32]]:
    return load_file(golden / "extractors.safetensors")


@pytest.fixture(scope="module")
def scan(peer: dict[str, NDArray[np.float32]]) -> Scan:
    return _scan(peer["points"])


def _scan(points: NDArray[np.float32]) -> Scan:
    return Scan(
        points[:, :3].copy(),
        points[:, 3].copy(),
        presets()["hdl64e_kitti360"],
        id="random",
    )


def difference(ours: NDArray[np.floating], theirs: NDArray[np.floating]) -> float:
    """Largest difference relative to the largest feature."""
    assert ours.shape == theirs.shape
    return float(abs(ours - theirs).max() / abs(theirs).max())


CLOUDS = [
    "liploc",
    "sparenet_pointnet",
    "lidm_minkowski",
    "lidm_spvcnn",
    "lidm_minkowski as r2flow",
    "lidm_spvcnn as r2flow",
]


@pytest.mark.parametrize("case", CLOUDS)
def test_features_and_distances_of_points_are_the_peers(
    case: str,
    archives: Callable[[str], Path],
    peer: dict[str, NDArray[np.float32]],
    scan: Scan,
) -> None:
    name, _, preparation = case.partition(" as ")
    if name == "liploc":
        _timm()
    extract = load_extractor(name, archives(name), preparation or None)
    found = extract([scan])
    assert found.shape == (1, EXTRACTORS[name].width)
    assert difference(found[0], peer[case]) < 1e-4
    both = [
        extract([_scan(inputs.random_points(1000, *one))])[0]
        for one in inputs.two_sets()
    ]
    assert distance(both) == pytest.approx(float(peer[f"{case} distance"][0]), rel=1e-4)


def _timm() -> ModuleType:
    """timm, which an installation may lack, or have beside a torchvision that does not fit."""
    try:
        return importlib.import_module("timm")
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"timm cannot be imported ({error})")


POOLED = {
    "rangenet53": "subsample",
    "rangenet21": "subsample",
    "r2flow_rangenet": "bands",
    "squeezeseg": "returns",
}
IMAGES = [*POOLED, "lidm_rangenet", "r3dpa_rangevit", "r3dpa_rangevit_remission"]


@pytest.fixture
def features_of(
    archives: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], Of]:
    """Features of an image (C, H, W) by an extractor's name, without its preparation of scans."""

    def made(name: str) -> Of:
        path = archives(name)
        if name in POOLED:
            segmenter = read_segmenter(Archive(path, "lidar-bonnetal"))
            return lambda image: POOLS[POOLED[name]](
                segmenter.decode(image), image
            ).numpy()
        if name == "lidm_rangenet":
            given: list[NDArray[np.float32]] = []
            changed = PREPARATIONS["lidm"]._replace(
                image=lambda scan, generated: given[-1]
            )
            monkeypatch.setitem(PREPARATIONS, "lidm", changed)
            extract = load_lidm(path, "lidm")

            def features(image: torch.Tensor) -> NDArray[np.float32]:
                # Remission is unknown.
                given.append(torch.cat([image, torch.full((1, 64, 64), -1.0)]).numpy())
                return extract([random_scan(presets()["town"], 10)])[0]

            return features
        network = build(yaml.safe_load((path / "config.yaml").read_text()))
        network.load_state_dict(
            Archive(path, "R3DPA").weights("model.ckpt")["state_dict"]
        )
        network.eval()
        return lambda image: network(image[None])[0].numpy()

    return made


def channels(name: str) -> int:
    return 4 if name in ("lidm_rangenet", "r2flow_rangenet") else 5


@pytest.mark.slow
@pytest.mark.parametrize("name", IMAGES)
def test_features_and_distances_of_images_are_the_peers(
    name: str,
    features_of: Callable[[str], Of],
    peer: dict[str, NDArray[np.float32]],
) -> None:
    of = features_of(name)
    with torch.inference_mode():
        assert difference(of(inputs.random_image(channels(name))[0]), peer[name]) < 1e-4
        both = [
            of(inputs.random_image(channels(name), *one)[0])
            for one in inputs.two_sets()
        ]
    assert distance(both) == pytest.approx(float(peer[f"{name} distance"][0]), rel=1e-4)


def distance(features: list[NDArray[np.floating]]) -> float:
    """Our Fréchet distance between two sets of inputs, of as many numbers as the peers' covariances
    allow."""
    few = inputs.reduced(np.stack(features))
    return frechet_distance(few[: inputs.PER_SET], few[inputs.PER_SET :])


def test_the_images_of_r2flow(peer: dict[str, NDArray[np.float32]], scan: Scan) -> None:
    image = PREPARATIONS["r2flow"].image(scan, False).reshape(5, -1)
    assert np.array_equal(np.flatnonzero(image[0]), peer["r2flow cells"])
    np.testing.assert_allclose(
        image[:, peer["r2flow cells"]], peer["r2flow image"], rtol=1e-6
    )
    generated = PREPARATIONS["r2flow"].image(scan, True)
    filled = generated[0] > 0
    azimuth = -np.arctan2(generated[2], generated[1])[filled] / np.pi
    column = (azimuth + 1) / 2 * 1024
    assert abs(column - np.round(column)).max() < 1e-3  # on the left edges of the cells
    np.testing.assert_allclose(
        np.linalg.norm(generated[1:4], axis=0), generated[0], atol=1e-4
    )


def test_the_images_of_lidm_move_the_returns_that_lidm_moves(
    peer: dict[str, NDArray[np.float32]], scan: Scan
) -> None:
    """Rounding decides which cell a corner belongs to: on another processor 4 % of the cells have
    been others, next to those of the peer, and 8 instead of 10 % of the returns moved."""
    image = PREPARATIONS["lidm"].image(scan, False).reshape(5, -1)
    ours = set(np.flatnonzero(image[0] > 0))
    theirs = set(peer["lidm cells"].tolist())
    assert len(ours ^ theirs) <= 0.1 * len(theirs)
    assert ours - theirs <= neighbours(theirs) and theirs - ours <= neighbours(ours)
    before = set(np.flatnonzero(PREPARATIONS["r3dpa"].image(scan, False)[0] > 0))
    # Moved to the next row or column.
    assert len(ours) < len(before) and len(ours - before) > 0.05 * len(before)
    both = np.array(sorted(ours & theirs))
    expected = peer["lidm image"][:, np.searchsorted(peer["lidm cells"], both)]
    same = np.isclose(image[:4, both], expected, rtol=1e-5).all(0)
    assert same.mean() > 0.99
    assert (image[:, image[0] <= 0] == -1).all()


def neighbours(cells: set[int]) -> set[int]:
    """The cells next to some of 64 x 1024, and they themselves."""
    near = itertools.product((-1, 0, 1), (-1, 0, 1))
    return {
        (cell // 1024 + row) * 1024 + (cell + column) % 1024
        for row, column in near
        for cell in cells
    }


def test_the_images_of_r3dpa(scan: Scan) -> None:
    image = PREPARATIONS["r3dpa"].image(scan, False)
    empty = image[0] == -1
    assert (
        (image[:4, empty] == -1).all()
        and (image[4, empty] == 0).all()
        and (image[0, ~empty] > 1).all()
    )
    np.testing.assert_allclose(
        np.linalg.norm(image[1:4, ~empty], axis=0), image[0, ~empty], rtol=1e-5
    )


def test_bytes_of_ranges_overflow_as_in_liploc() -> None:
    depth = torch.tensor([-1.0, 0.0, 10.0, 50.0, 50.2, 55.0]).repeat(64, 50)
    grey = picture(depth)[0] * 0.229 + 0.485
    assert grey.shape == (224, 224)
    assert abs(grey.mean() - np.mean([251, 0, 51, 255, 0, 24]) / 255) < 0.02


def test_the_archive_may_be_packed(
    archives: Callable[[str], Path], tmp_path: Path, scan: Scan
) -> None:
    path = archives("lidm_minkowski")
    packed = tmp_path / "minkowskinet_lidm.tar.gz"
    with tarfile.open(packed, "w:gz") as tar:
        tar.add(path, arcname="minkowskinet_lidm")
    expected = load_extractor("lidm_minkowski", path)([scan])
    assert np.array_equal(load_extractor("lidm_minkowski", packed)([scan]), expected)
    packed.write_bytes(packed.read_bytes()[:5000])
    with pytest.raises(DataError, match="truncated.*LiDAR-Diffusion"):
        load_extractor("lidm_minkowski", packed)


Change = Callable[[dict], object]  # type: ignore[type-arg]


def _edit(file: str, change: Change) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        settings = yaml.safe_load((folder / file).read_text())
        change(settings)
        (folder / file).write_text(yaml.safe_dump(settings))

    return apply


def _reweigh(file: str, change: Change) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        content = torch.load(folder / file, weights_only=True)
        change(content)
        torch.save(content, folder / file)

    return apply


def _cut(file: str) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_bytes(
        (folder / file).read_bytes()[:-1000]
    )


FAULTS: dict[str, tuple[str, Callable[[Path], object], type[LidarSynthError], str]] = {
    "code": (
        "lidm_spvcnn",
        lambda f: torch.save({"state_dict": print}, f / "model.ckpt"),
        DataError,
        "not tensors by",
    ),
    "truncated": (
        "lidm_spvcnn",
        _cut("model.ckpt"),
        DataError,
        "model.ckpt is truncated",
    ),
    "no weights": (
        "lidm_spvcnn",
        lambda f: (f / "model.ckpt").unlink(),
        FileError,
        "model.ckpt",
    ),
    "no state": (
        "lidm_minkowski",
        _reweigh("model.ckpt", lambda c: c.pop("state_dict")),
        DataError,
        "not tensors",
    ),
    "a weight is missing": (
        "lidm_minkowski",
        _reweigh("model.ckpt", lambda c: c["state_dict"].pop("stem.0.kernel")),
        DataError,
        r"another architecture \(it lacks stem.0.kernel\)",
    ),
    "a weight of another shape": (
        "lidm_minkowski",
        _reweigh(
            "model.ckpt",
            lambda c: c["state_dict"].update({"stem.0.kernel": torch.ones(2)}),
        ),
        DataError,
        r"another architecture \(it has another shape of stem.0.kernel\)",
    ),
    "a weight is not a number": (
        "lidm_minkowski",
        _reweigh(
            "model.ckpt", lambda c: c["state_dict"]["stem.0.kernel"].fill_(torch.nan)
        ),
        DataError,
        "stem.0.kernel holds values that are not finite",
    ),
    "narrower": (
        "lidm_minkowski",
        _edit("config.yaml", lambda s: s["model_params"].update(cr=0.25)),
        DataError,
        "architecture",
    ),
    "settings without widths": (
        "lidm_minkowski",
        _edit("config.yaml", lambda s: s["model_params"].pop("layer_num")),
        ConfigError,
        "layer_num",
    ),
    "settings are a list": (
        "lidm_minkowski",
        lambda f: (f / "config.yaml").write_text("[1]"),
        DataError,
        "holds list",
    ),
    "settings with code": (
        "lidm_minkowski",
        lambda f: (f / "config.yaml").write_text(
            "a: !!python/object/apply:os.getcwd []"
        ),
        ConfigError,
        "not YAML",
    ),
    "a U-Net's weights as PointNet": (
        "sparenet_pointnet",
        lambda f: torch.save({"a.weight": torch.ones(2)}, f),
        DataError,
        "SpareNet",
    ),
    "PointNet truncated": (
        "sparenet_pointnet",
        lambda f: f.write_bytes(f.read_bytes()[:-1000]),
        DataError,
        "truncated",
    ),
    "another darknet": (
        "lidm_rangenet",
        _edit("config.yaml", lambda s: s["backbone"]["extra"].update(layers=22)),
        ConfigError,
        "22 layers.*21 or 53",
    ),
    "53 layers for 21": (
        "lidm_rangenet",
        _edit("config.yaml", lambda s: s["backbone"]["extra"].update(layers=53)),
        DataError,
        "backbone: weights of another architecture",
    ),
    "means of four inputs": (
        "squeezeseg",
        _edit("arch_cfg.yaml", lambda s: s["dataset"]["sensor"]["img_means"].pop()),
        ConfigError,
        "a mean and a positive deviation",
    ),
    "a deviation of 0": (
        "squeezeseg",
        _edit(
            "arch_cfg.yaml", lambda s: s["dataset"]["sensor"].update(img_stds=[0] * 5)
        ),
        ConfigError,
        "positive deviation",
    ),
    "another stem": (
        "r3dpa_rangevit",
        _edit("config.yaml", lambda s: s.update(conv_stem="none")),
        ConfigError,
        "ConvStem",
    ),
    "without a backbone": (
        "r3dpa_rangevit",
        _edit("config.yaml", lambda s: s.pop("vit_backbone")),
        ConfigError,
        "vit_backbone",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_archive_is_refused_and_the_right_one_named(
    fault: str, archives: Callable[[str], Path], tmp_path: Path
) -> None:
    name, damage, error, message = FAULTS[fault]
    original = archives(name)
    path = tmp_path / original.name
    (shutil.copytree if original.is_dir() else shutil.copy)(original, path)
    damage(path)
    with pytest.raises(error, match=message) as caught:
        load_extractor(name, path)
    assert EXTRACTORS[name].source in str(caught.value) and ".." not in str(
        caught.value
    ).replace("../", "")


def test_what_cannot_be_extracted_is_refused(
    archives: Callable[[str], Path],
    scan: Scan,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("LIDAR_SYNTH_METRICS", raising=False)
    with pytest.raises(ConfigError, match="extractor 'inception'"):
        load_extractor("inception")
    with pytest.raises(
        ConfigError,
        match="minkowskinet or minkowskinet_lidm in the folder that LIDAR_SYNTH_METRICS",
    ):
        load_extractor("lidm_minkowski")
    with pytest.raises(ConfigError, match="none for weights; expected a folder that"):
        Metric("r2flow", weights=tmp_path / "none")
    monkeypatch.setenv("LIDAR_SYNTH_METRICS", "nowhere")
    with pytest.raises(ConfigError, match="nowhere for weights"):
        load_extractor("lidm_minkowski")
    setup = CliRunner().invoke(app, ["metrics", "setup"])
    assert setup.stdout.count(": missing") == len(EXTRACTORS)
    with pytest.raises(ConfigError, match="preparation 'spiral'"):
        load_extractor("lidm_minkowski", archives("lidm_minkowski"), "spiral")
    extract = load_extractor("lidm_minkowski", archives("lidm_minkowski"))
    with pytest.raises(DataError, match="no scans"):
        extract([])
    with pytest.raises(DataError, match="'random'.*no return in the range"):
        extract([scan[np.linalg.norm(scan.points, axis=1) > 60]])


@pytest.mark.slow
def test_a_network_without_remission_is_no_judge(
    archives: Callable[[str], Path],
) -> None:
    with pytest.raises(ConfigError, match="without remission"):
        load_archive(archives("r2flow_rangenet"))


def test_an_extractor_without_its_library_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(LibraryError, match=r"needs timm.*lidar_synth\[metrics\]"):
        load_extractor("liploc", tmp_path)
    monkeypatch.delitem(sys.modules, "timm")
    (tmp_path / "timm.py").write_text(
        "raise RuntimeError('operator torchvision::nms does not exist')"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(
        LibraryError,
        match="torchvision::nms does not exist.*torchvision of the same build",
    ):
        load_extractor("liploc", tmp_path)


def test_liploc_is_the_network_of_timm(
    archives: Callable[[str], Path], scan: Scan
) -> None:
    timm = _timm()
    path = archives("liploc")
    network = timm.create_model("resnet50", num_classes=0, global_pool="avg").eval()
    state = torch.load(path / "model.ckpt", weights_only=True)["state_dict"]
    network.load_state_dict(
        {k.removeprefix("encoder_lidar.model."): v for k, v in state.items()}
    )
    image = torch.from_numpy(PREPARATIONS["r3dpa"].image(scan, False)[0])
    with torch.inference_mode():
        expected = network(picture(image)[None])[0].numpy()
    assert np.allclose(load_extractor("liploc", path)([scan])[0], expected, rtol=1e-5)


def test_setup_says_what_to_fetch_and_what_is_there(
    archives: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIDAR_SYNTH_METRICS", str(tmp_path))
    shutil.copytree(archives("lidm_minkowski"), tmp_path / "minkowskinet")
    shutil.copy(archives("sparenet_pointnet"), tmp_path)
    (tmp_path / "darknet53-1024.tar.gz").write_bytes(b"not a tar")
    found = json.loads(CliRunner().invoke(app, ["metrics", "setup", "--json"]).stdout)
    assert list(found) == list(EXTRACTORS)
    assert (
        found["lidm_minkowski"]["state"] == f"{tmp_path / 'minkowskinet'} is readable"
    )
    assert "its hash differs" in found["sparenet_pointnet"]["state"]
    assert (
        "is not usable" in found["rangenet53"]["state"]
        and "truncated" in found["rangenet53"]["state"]
    )
    assert (
        found["lidm_spvcnn"]["state"] == "missing"
        and found["lidm_spvcnn"]["sha256"] is None
    )
    assert found["sparenet_pointnet"]["sha256"] == sha256(tmp_path / "cls_model_39.pth")
    known = [
        name
        for name, one in found.items()
        if not one["hash"].startswith("unknown: its publisher states none")
    ]
    assert known == ["sparenet_pointnet"]
    (tmp_path / "hello").write_text("hello\n")  # what `git hash-object` prints
    published = EXTRACTORS["sparenet_pointnet"]._replace(
        git_blob="ce013625030ba8dba906f756967f9e9ca394464a"
    )
    assert published.is_published(tmp_path / "hello")
    assert all("http" in one["from"] and one["licence"] for one in found.values())
    monkeypatch.delenv("LIDAR_SYNTH_METRICS")
    text = CliRunner().invoke(app, ["metrics", "setup"]).stdout
    assert "sha256" not in text and "unknown" in text
    assert "set LIDAR_SYNTH_METRICS" in text and text.count(": missing") == len(
        EXTRACTORS
    )
