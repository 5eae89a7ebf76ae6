"""Conditions: from users and from real scans, their encoders, training, and invalid input."""

import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_scan
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, DataError, FileError, LibraryError
from lidar_synth.generate.conditions import (
    CONDITIONS,
    batch_of,
    blank,
    bridge_gaps,
    one_view,
)
from lidar_synth.generate.flow.guidance import guide
from lidar_synth.generate.models import NETWORKS, build_network, encoders_of
from lidar_synth.generate.models.encoders.calibrated_camera import SightEncoder
from lidar_synth.generate.models.encoders.camera_views import split_views
from lidar_synth.generate.models.encoders.clip_views import (
    CLIP_VARIABLE,
    CLIP_WIDTH,
    load_frozen_clip,
)
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.lab.town.camera import CAMERA
from lidar_synth.lab.train import Batches, Conditioning, Other, cache_scans

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
TOWN = load_sensor("town")
TENSORS = TensorFormat(("range",), NORMALISATIONS["r2flow"])
CAMERA_SHAPE = (3, 32, 64)
OPTIONS: dict[str, Any] = {"image": [40, 80]}


pytestmark = pytest.mark.usefixtures("one_thread")


def picture(path: Path, size: tuple[int, int] = (40, 80), seed: int = 0) -> Path:
    """Write a PNG of the given rows and columns."""
    Image.fromarray(
        np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
    ).save(path)
    return path


def some_scan(tmp_path: Path, seed: int = 0) -> Scan:
    scan = random_scan(SENSOR, 400, seed)
    scan.points[:100, 2], scan.label[:100] = -1.7, 8  # some of it is a road
    boxes = Boxes(np.float32([[12, 3, -0.9, 4, 2, 1.6, 0.4]]), ("Car",))
    return replace(
        scan, boxes=boxes, image_path=picture(tmp_path / f"{seed}.png", seed=seed)
    )


@pytest.mark.parametrize("name", CONDITIONS)
def test_encoders_accept_what_every_condition_reads_from_a_scan(
    name: str, tmp_path: Path
) -> None:
    condition = CONDITIONS[name]
    scan = some_scan(tmp_path)
    encoder = {
        "semantic": lambda: build_network(
            "semantic_map", {"resolution": (8, 32), "target": (4, 16)}
        ),
        "camera": lambda: build_network(
            "views",
            {"resolution": (32, 64), "views": 2, "channels": 5, "widths": (4, 8)},
        ),
        "layout": lambda: build_network(
            "layout", {"resolution": (8, 32), "target": (4, 16), "channels": 7}
        ),
    }[name]()
    shape = condition.shape(encoder)
    values = condition.read(scan, SENSOR, shape, OPTIONS)
    assert (values.shape, values.dtype) == (shape, np.uint8)
    given = batch_of(name, scan, 3, SENSOR, shape, OPTIONS)
    assert torch.equal(given, torch.from_numpy(values).expand(3, *shape))
    encoded = encoder(given)
    assert (
        encoded.shape
        == {
            "semantic": (3, 8, 4, 16),
            "camera": (3, 2 * 8 * 8, 5),
            "layout": (3, 7, 4, 16),
        }[name]
    )
    assert (blank(name, given) == condition.blank).all()
    assert set(encoders_of(name)) <= set(NETWORKS)


def test_labels_of_another_sensor_are_projected_onto_the_grid_of_the_model() -> None:
    other = replace(SENSOR, name="other", columns=64, rows=16)
    scan = random_scan(other, 3000)
    labels = CONDITIONS["semantic"].read(scan, SENSOR, SENSOR.shape, {})
    assert np.array_equal(
        labels, bridge_gaps(project(scan, SENSOR, ["label"]).channels["label"])
    )


def test_a_model_of_maps_with_gaps_is_given_the_gaps_of_a_scan() -> None:
    scan = random_scan(SENSOR, 3000)
    labels = CONDITIONS["semantic"].read(
        scan, SENSOR, SENSOR.shape, {"keep_gaps": True}
    )
    projected = project(scan, SENSOR, ["label"]).channels["label"]
    assert np.array_equal(labels, projected)
    assert not np.array_equal(labels, bridge_gaps(projected))


def test_views_are_resized_one_by_one_between_their_corners(tmp_path: Path) -> None:
    """As LiDM does: bicubic, align_corners, no antialiasing."""
    path = picture(tmp_path / "a.png", (37, 83))
    scan = replace(random_scan(SENSOR, 10), image_path=path)
    options = {"image": [37, 83], "views": 4}
    resized = CONDITIONS["camera"].read(scan, SENSOR, (3, 10, 4 * 12), options)
    pixels = np.asarray(Image.open(path)).transpose(2, 0, 1)[:, :, :80]
    given = pixels.reshape(3, 37, 4, 20)
    made = resized.reshape(3, 10, 4, 12)
    corners = np.ix_(range(3), [0, -1], range(4), [0, -1])
    assert np.array_equal(made[corners], given[corners])
    rows = np.linspace(0, 36, 10)
    columns = np.linspace(0, 19, 12)
    view = 2
    wanted = sum(
        cubic(rows[:, None], i)[:, 0, None]
        * cubic(columns[:, None], j)[:, 0][None]
        * given[0, np.clip(i, 0, 36), view, np.clip(j, 0, 19)]
        for i in range(-2, 39)
        for j in range(-2, 22)
    )
    assert np.abs(made[0, :, view] - wanted.clip(0, 255)).max() <= 0.51


def test_a_grey_image_of_16_bits_is_that_of_8_bits(tmp_path: Path) -> None:
    grey = np.arange(40 * 80, dtype=np.uint16).reshape(40, 80) * 20
    made = []
    for name, values in (("a", grey), ("b", (grey >> 8).astype(np.uint8))):
        path = tmp_path / f"{name}.png"
        Image.fromarray(values).save(path)
        scan = replace(random_scan(SENSOR, 10), image_path=path)
        made.append(batch_of("camera", scan, 1, SENSOR, CAMERA_SHAPE, {}))
    assert torch.equal(*made) and made[0].float().std() > 10


def cubic(at: NDArray[np.float64], place: int) -> NDArray[np.float64]:
    """Keys' kernel with a = -0.75, which PyTorch's bicubic interpolation uses."""
    x = np.abs(at - place)
    near = 1.25 * x**3 - 2.25 * x**2 + 1
    far = -0.75 * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))


@pytest.mark.parametrize("method", ["rescale", "patches"])
def test_label_maps_are_encoded_by_class_and_place(method: str) -> None:
    net = build_network(
        "semantic_map",
        {"resolution": (8, 32), "target": (4, 8), "channels": 6, "method": method},
    )
    labels = torch.full((1, 8, 32), 3, dtype=torch.uint8)
    same = net(labels)
    assert torch.allclose(same, same[:, :, :1, :1].expand_as(same), atol=1e-6)
    labels[:, 2:4, 4:8] = IGNORE  # the patch in row 1, column 1
    changed = (net(labels) - same).abs().amax(1)[0] > 1e-6
    assert changed[1, 1]
    assert not changed[3, 5]
    if method == "patches":
        assert changed.sum() == 1


def test_all_train_ids_are_encoded_differently() -> None:
    net = build_network(
        "semantic_map", {"resolution": (4, 5), "target": (4, 5), "channels": 20}
    )
    ids = torch.tensor([*range(len(NAMES)), IGNORE], dtype=torch.uint8).view(1, 4, 5)
    net.mix.weight.data.copy_(torch.eye(20)[..., None, None])
    assert torch.equal(net(ids)[0].flatten(1), torch.eye(20))


def test_an_image_is_split_into_views_from_left_to_right() -> None:
    image = torch.arange(2 * 3 * 4 * 12).reshape(2, 3, 4, 12)
    views = split_views(image, 3)
    assert torch.equal(views[4], image[1, :, :, 4:8])
    left = one_view(image, 3)
    assert torch.equal(left[..., 4:8], image[..., 4:8])
    assert not left[..., :4].any() and not left[..., 8:].any()


def sight(sensor: Sensor = TOWN, **arguments: Any) -> SightEncoder:
    torch.manual_seed(0)
    return SightEncoder(
        **{
            "target": sensor.shape,
            "image": (376, 1408),
            "image_from_sensor": CAMERA.image_from_sensor.tolist(),
            "resolution": (32, 64),
            "channels": 5,
            "widths": (4, 8),
            "angles": torch.from_numpy(sensor.ray_angles()),
        }
        | arguments
    ).eval()


def test_the_calibration_gives_the_pixel_of_every_cell() -> None:
    points = unproject(RangeImage(np.full(TOWN.shape, 15, np.float32), TOWN, {})).points
    pixels, depth = CAMERA.pixels(points)
    inside = (
        (depth > 1)
        & (pixels > -0.5).all(1)
        & (pixels < np.array([1407.5, 375.5])).all(1)
    )
    places = sight(distance=15.0).pixel_coordinates().reshape(-1, 2).numpy()
    assert (
        np.array_equal((np.abs(places) <= 1).all(1), inside)
        and 0.1 < inside.mean() < 0.3
    )
    assert np.allclose(
        ((places + 1) * [1408, 376] - 1)[inside] / 2, pixels[inside], atol=0.01
    )


@torch.no_grad()
def test_a_cell_depends_only_on_its_part_of_the_image() -> None:
    encoder = sight()
    image = torch.zeros(1, 3, 32, 64, dtype=torch.uint8)
    before = encoder(image)
    image[..., :8] = 255  # the left eighth
    changed = (encoder(image) != before).any(1)[0]
    place = encoder.pixel_coordinates()[..., 0]
    seen = (encoder.pixel_coordinates().abs() <= 1).all(-1)
    assert before.shape == (1, 5, *TOWN.shape)
    assert changed[seen & (place < -0.8)].all() and not changed[place > -0.4].any()
    assert torch.equal(before[0, -1] == 1, seen) and not before[0, :, ~seen].any()


def test_the_position_embeddings_of_views_and_cells_are_used_and_trained() -> None:
    net = build_network(
        "views", {"resolution": (32, 64), "views": 2, "channels": 5, "widths": (4, 8)}
    )
    image = torch.randint(0, 256, (2, 3, 32, 64), dtype=torch.uint8)
    swapped = torch.cat((image[..., 32:], image[..., :32]), -1)
    net.eval()
    a = net(image)
    b = net(swapped)
    assert not torch.allclose(a[:, :64], b[:, 64:], atol=1e-4)
    net.train()(image).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and parameter.grad.any(), name


# --- conditions of users
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "given", "error", "message"),
    [
        (
            "semantic",
            np.full((8, 32), 40, np.uint8),
            DataError,
            r"ids \[40\]; expected train ids 0..18, or 255",
        ),
        ("semantic", np.full((8, 32), 1000), DataError, "from 1000 to 1000"),
        (
            "semantic",
            np.zeros((64, 1024), np.uint8),
            DataError,
            r"of shape \(64, 1024\); expected \(8, 32\)",
        ),
        ("semantic", np.zeros((2, 8, 32), np.uint8), DataError, r"or \(3, 8, 32\)"),
        (
            "semantic",
            torch.zeros(8, 32),
            DataError,
            "semantic condition of torch.float32; expected whole numbers",
        ),
        ("semantic", "map.png", ConfigError, "a condition of type str"),
        (
            "semantic",
            {"camera": 1},
            ConfigError,
            r"conditions \['camera'\]; expected 'semantic' among them",
        ),
        (
            "layout",
            "street.yaml",
            ConfigError,
            "a condition of type str.* load_layout",
        ),
        ("semantic", [], ConfigError, "a condition of type list"),
        ("semantic", ["map"] * 3, ConfigError, "a condition of type str"),
        (
            "semantic",
            [np.zeros(SENSOR.shape, np.uint8)] * 2,
            DataError,
            r"semantic condition of shape \(2, ",
        ),
        (
            "camera",
            np.zeros((3, 32, 60), np.uint8),
            DataError,
            r"camera condition of shape \(3, 32, 60\)",
        ),
    ],
)
def test_invalid_conditions_are_refused(
    name: str, given: Any, error: type[Exception], message: str
) -> None:
    shape = SENSOR.shape if name == "semantic" else CAMERA_SHAPE
    with pytest.raises(error, match=message):
        batch_of(name, given, 3, SENSOR, shape, OPTIONS)


def test_one_condition_for_each_scan_in_every_form(tmp_path: Path) -> None:
    scan = some_scan(tmp_path)
    shape = SENSOR.shape
    maps = [np.full(shape, n, np.uint8) for n in range(2)]
    maps.append(CONDITIONS["semantic"].read(scan, SENSOR, shape, {}))
    expected = torch.from_numpy(np.stack(maps))
    tensors = [torch.from_numpy(each) for each in maps]
    dictionaries = [{"semantic": each} for each in maps]
    for given in (maps, tuple(tensors), dictionaries, [*maps[:2], scan], expected):
        assert torch.equal(batch_of("semantic", given, 3, SENSOR, shape, {}), expected)


def test_flipped_and_read_only_arrays_are_taken_as_they_are() -> None:
    given = np.arange(256, dtype=np.uint8).reshape(SENSOR.shape) % 19
    given = given[:, ::-1]
    frozen = given.copy()
    frozen.setflags(write=False)
    torch.set_warn_always(True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        taken = [
            batch_of("semantic", one, 1, SENSOR, SENSOR.shape, {})
            for one in (given, frozen)
        ]
    torch.set_warn_always(False)
    assert torch.equal(*taken) and np.array_equal(taken[0][0], given)


def test_scans_without_the_condition_are_refused(tmp_path: Path) -> None:
    scan = some_scan(tmp_path)
    with pytest.raises(DataError, match="'random-0' has no labels"):
        batch_of("semantic", replace(scan, label=None), 1, SENSOR, SENSOR.shape, {})
    with pytest.raises(DataError, match="'random-0' has no camera image"):
        batch_of("camera", replace(scan, image_path=None), 1, SENSOR, CAMERA_SHAPE, {})
    picture(tmp_path / "other.png", (40, 70))
    with pytest.raises(
        DataError,
        match=r"other.png of \(40, 70\) rows and columns; expected \(40, 80\), those of the camera",
    ):
        batch_of(
            "camera",
            replace(scan, image_path=tmp_path / "other.png"),
            1,
            SENSOR,
            CAMERA_SHAPE,
            OPTIONS,
        )
    (tmp_path / "cut.png").write_bytes((tmp_path / "0.png").read_bytes()[:200])
    with pytest.raises(DataError, match=r"cut.png cannot be read"):
        batch_of(
            "camera",
            replace(scan, image_path=tmp_path / "cut.png"),
            1,
            SENSOR,
            CAMERA_SHAPE,
            OPTIONS,
        )
    with pytest.raises(FileError, match=r"nowhere.png cannot be read"):
        batch_of(
            "camera",
            replace(scan, image_path=tmp_path / "nowhere.png"),
            1,
            SENSOR,
            CAMERA_SHAPE,
            OPTIONS,
        )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"target": (3, 16)}, r"label map of \(8, 32\)|a label map"),
        ({"target": (8, 64)}, "multiple"),
        ({"target": (4, 16), "method": "guess"}, "one of rescale, patches"),
        ({"resolution": (12, 32), "target": (4, 16)}, "powers of two"),
    ],
)
def test_sizes_that_do_not_divide_are_refused(
    arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        build_network("semantic_map", {"resolution": (8, 32)} | arguments)


def test_an_invalid_calibration_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected 3 rows of 4 numbers"):
        sight(image_from_sensor=[[1.0, 2.0]])
    with pytest.raises(ConfigError, match="an image of"):
        sight(resolution=(30, 64))


# --- training
# --------------------------------------------------------------------------------------------------


def conditioned_batches(tmp_path: Path, name: str, **options: Any) -> Batches:
    scans = [some_scan(tmp_path, seed) for seed in range(4)]
    shapes = {"camera": CAMERA_SHAPE, "layout": (5, *SENSOR.shape)}

    def reader(kind: str) -> Callable[[int, Scan], NDArray[np.uint8]]:
        return lambda i, scan: CONDITIONS[kind].read(
            scan, SENSOR, shapes[kind], OPTIONS
        )

    others = {kind: Other(shape, reader(kind)) for kind, shape in shapes.items()}
    about = {
        key: options.pop(key) for key in ("dropout", "reduction") if key in options
    }
    cache = cache_scans(
        scans, SENSOR, ["range", "label"], progress=False, others=others
    )
    return Batches(
        cache, TENSORS, 3, conditioning=Conditioning(name, views=2, **about), **options
    )


def test_conditions_stay_with_their_scans(tmp_path: Path) -> None:
    plain = conditioned_batches(tmp_path, "semantic")
    moved = conditioned_batches(tmp_path, "semantic", flip=True, roll=True)
    for batches in (plain, moved):
        y0, _, _, cond = batches(range(8))
        assert cond is not None and cond.shape == (8, 8, 32)
        empty = TENSORS.decode(y0)["range"] == 0
        assert (
            cond[empty] == IGNORE
        ).all()  # cells without a return have no label, also after a rotation
    whole = plain.conditions(range(8))
    assert whole is not None and torch.equal(whole, plain(range(8)).cond)  # type: ignore[arg-type]
    assert not torch.equal(whole, moved(range(8)).cond)  # type: ignore[arg-type]


def test_camera_images_are_mirrored_with_the_scan_but_not_rotated(
    tmp_path: Path,
) -> None:
    plain, flipped = (
        conditioned_batches(tmp_path, "camera", flip=flip) for flip in (False, True)
    )
    a = plain(range(16))
    b = flipped(range(16))
    assert a.cond is not None and b.cond is not None
    mirrored = torch.tensor(
        [not torch.equal(x, y) for x, y in zip(a.y0, b.y0, strict=True)]
    )
    assert 0 < mirrored.sum() < 16
    for i, is_mirrored in enumerate(mirrored):
        assert torch.equal(b.cond[i], a.cond[i].flip(-1) if is_mirrored else a.cond[i])


@pytest.mark.parametrize("name", CONDITIONS)
def test_dropout_blanks_only_its_share_of_the_conditions(
    name: str, tmp_path: Path
) -> None:
    plain = conditioned_batches(tmp_path, name)
    dropped = conditioned_batches(tmp_path, name, dropout=0.25)
    a = plain(range(200))
    b = dropped(range(200))
    assert torch.equal(a.y0, b.y0) and torch.equal(a.y1, b.y1)
    assert a.cond is not None and b.cond is not None
    is_blank = (b.cond == CONDITIONS[name].blank).flatten(1).all(1)
    assert 30 <= int(is_blank.sum()) <= 70
    assert torch.equal(a.cond[~is_blank], b.cond[~is_blank])


def test_a_reduced_camera_image_keeps_one_view(tmp_path: Path) -> None:
    cond = conditioned_batches(tmp_path, "camera", reduction=0.5)(range(60)).cond
    assert cond is not None
    left = (cond[..., :32] == 0).flatten(1).all(1)
    right = (cond[..., 32:] == 0).flatten(1).all(1)
    assert 15 <= int(left.sum()) <= 45
    assert not right.any()


def test_a_cache_with_images_resumes_and_refuses_other_images(tmp_path: Path) -> None:
    scans = [some_scan(tmp_path, seed) for seed in range(3)]
    others = {
        "camera": Other(
            CAMERA_SHAPE,
            lambda i, s: CONDITIONS["camera"].read(s, SENSOR, CAMERA_SHAPE, OPTIONS),
        )
    }
    cache = cache_scans(
        scans, SENSOR, ["range"], tmp_path / "cache", progress=False, others=others
    )
    again = cache_scans(
        scans, SENSOR, ["range"], tmp_path / "cache", progress=False, others=others
    )
    assert np.array_equal(cache.fields["camera"], again.fields["camera"])
    assert again.read([1])["camera"].dtype == torch.uint8
    with pytest.raises(
        ConfigError, match=r"the cache of other data \(others.camera differ\)"
    ):
        cache_scans(scans, SENSOR, ["range"], tmp_path / "cache", progress=False)


# --- guidance
# --------------------------------------------------------------------------------------------------


def test_guidance_extrapolates_from_the_blank_condition() -> None:
    calls = []

    def velocity(y: Tensor, t: Tensor, c: Tensor) -> Tensor:
        calls.append(len(y))
        return y * t.view(-1, 1) + c.float() ** 2

    y = torch.randn(3, 2)
    t = torch.rand(3)
    cond = torch.tensor([[1.0, 2], [3, 4], [5, 6]])
    nothing = torch.tensor([0.5, 1])
    with_condition = velocity(y, t, cond)
    without = velocity(y, t, nothing.expand(3, 2))
    calls.clear()
    for scale in (0.0, 1.5, 4.0):
        out = guide(velocity, scale, nothing)(y, t, cond)
        assert torch.allclose(
            out, without + scale * (with_condition - without), atol=1e-5
        )
    assert calls == [6, 6, 6]
    assert guide(velocity, 1.0, nothing) is velocity


# --- CLIP
# --------------------------------------------------------------------------------------------------


class Tower(nn.Module):
    """A stand-in for CLIP's vision tower: the mean colour of an image in 768 channels."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))

    def encode_image(self, x: Tensor) -> Tensor:
        assert x.shape[1:] == (3, 224, 224)
        return x.mean((1, 2, 3))[:, None].expand(-1, CLIP_WIDTH) * self.weight

    def forward(self, pixel_values: Tensor) -> Any:
        return SimpleNamespace(image_embeds=self.encode_image(pixel_values))


@pytest.fixture
def clip_libraries(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """transformers and open_clip with the stand-in; the list records the loaded files."""
    asked: list[str] = []

    def from_pretrained(
        place: str, local_files_only: bool, use_safetensors: bool
    ) -> Tower:
        assert local_files_only and use_safetensors
        asked.append(f"transformers {Path(place).name}")
        return Tower()

    def create_model(name: str, pretrained: str) -> Tower:
        asked.append(f"open_clip {name} {Path(pretrained).name}")
        return Tower()

    holder = SimpleNamespace(
        CLIPVisionModelWithProjection=SimpleNamespace(from_pretrained=from_pretrained)
    )
    monkeypatch.setitem(sys.modules, "transformers", holder)
    monkeypatch.setitem(
        sys.modules, "open_clip", SimpleNamespace(create_model=create_model)
    )
    load_frozen_clip.cache_clear()
    yield asked
    load_frozen_clip.cache_clear()


@pytest.mark.parametrize("form", ["folder", "file"])
def test_frozen_clip_encodes_each_view_and_only_other_layers_are_trained(
    form: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    clip_libraries: list[str],
) -> None:
    place = tmp_path / ("clip" if form == "folder" else "clip.safetensors")
    place.mkdir() if form == "folder" else place.write_bytes(b"")
    monkeypatch.setenv(CLIP_VARIABLE, str(place))
    net = build_network("clip_views", {"views": 2, "channels": 6})
    assert {name for name, _ in net.named_parameters()} == {
        "view_embedding",
        "project.weight",
        "project.bias",
    }
    image = torch.randint(0, 256, (3, 3, 224, 448), dtype=torch.uint8)
    tokens = net(image)
    assert tokens.shape == (3, 2, 6)
    tokens.square().mean().backward()
    assert all(p.grad is not None and p.grad.any() for p in net.parameters())
    assert load_frozen_clip(str(place), "cpu").training is False
    assert not any(
        p.requires_grad for p in load_frozen_clip(str(place), "cpu").parameters()
    )
    assert len(clip_libraries) == 1  # loaded once


def test_missing_clip_weights_or_libraries_are_reported_with_a_hint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_frozen_clip.cache_clear()
    net = build_network("clip_views", {"views": 2})
    image = torch.zeros(1, 3, 224, 448, dtype=torch.uint8)
    monkeypatch.delenv(CLIP_VARIABLE, raising=False)
    with pytest.raises(
        FileError,
        match=r"LIDAR_SYNTH_CLIP is not set.*set LIDAR_SYNTH_CLIP to it; or train with .*'views'",
    ):
        net(image)
    monkeypatch.setenv(CLIP_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(FileError, match=r"LIDAR_SYNTH_CLIP=.*nowhere"):
        net(image)
    (tmp_path / "clip.pt").write_bytes(b"")
    monkeypatch.setenv(CLIP_VARIABLE, str(tmp_path / "clip.pt"))
    with pytest.raises(FileError, match=r"expected a folder, or a .safetensors file"):
        net(image)
    for place, library in (
        (tmp_path, "transformers"),
        (tmp_path / "clip.safetensors", "open_clip"),
    ):
        (tmp_path / "clip.safetensors").write_bytes(b"")
        monkeypatch.setenv(CLIP_VARIABLE, str(place))
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(
            LibraryError, match=rf"{library}\w* is not installed.*pip install {library}"
        ):
            net(image)
