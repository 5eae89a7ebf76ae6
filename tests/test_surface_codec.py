"""The autoencoder of dense models: patches, the likelihood of cells, sampling, training."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from torch import Tensor

from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.checkpoint import CODEC, VELOCITY
from lidar_synth.generate.codec import Latent
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.generate.loading import _compile
from lidar_synth.generate.models.objective import Losses, expected
from lidar_synth.generate.models.surface_codec.autoencoder import SurfaceAutoencoder
from lidar_synth.generate.models.surface_codec.blocks import (
    PATCH,
    from_patches,
    split,
    to_patches,
)
from lidar_synth.generate.models.surface_codec.bounds import bounds_of
from lidar_synth.generate.models.surface_codec.measure_noise import PLANTS
from lidar_synth.generate.models.surface_codec.reflectance import ZeroInflatedLogistic
from lidar_synth.generate.models.surface_codec.relief import (
    SPANS,
    correlation,
    relief_fields,
)
from lidar_synth.generate.models.surface_codec.surfaces import (
    DRAWS,
    NUMBERS,
    PER_CELL,
    Noise,
    Surfaces,
    surfaces_of,
)
from lidar_synth.geometry.layout.layout import CHORD_STEP, CODES, DEPTH_STEP
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.town import Town
from lidar_synth.lab.train.autoencoder import Autoencoding
from lidar_synth.noise import uniform

K = 3
LABELS = 20
CELLS = PATCH[0] * PATCH[1]
SCALE = NORMALISATIONS["r2flow"]
FORMAT = TensorFormat(("range", "reflectance", "label"), SCALE)
COARSE = Sensor("coarse", 256, 1.45, 80.0, rows=16, fov_up=3.0, fov_down=-25.0)


FLAT = Noise(torch.zeros(LABELS), torch.zeros(LABELS, len(SPANS)), torch.zeros(LABELS))
"""No noise of cells."""


def small(**changes: object) -> SurfaceAutoencoder:
    """A network for 16 x 256 cells."""
    torch.manual_seed(0)
    arguments = {
        "encoder_widths": (16, 24),
        "widths": (16, 24),
        "reaches": (1, 2),
        "depth": 1,
    }
    return SurfaceAutoencoder(COARSE.shape, **arguments | changes)  # type: ignore[arg-type]


def random_surfaces(patches: int, spread: float = 1.0) -> Surfaces:
    generator = torch.Generator().manual_seed(3)
    numbers = K * (NUMBERS + LABELS) + CELLS * (K + PER_CELL)
    x = spread * torch.randn(patches, numbers, generator=generator)
    x[:, : K * (NUMBERS + LABELS)].view(patches, K, -1)[:, :, 0] += torch.tensor(
        [1.5, 2.3, 3.0]
    )
    return surfaces_of(x, K, LABELS, PATCH)


@settings(max_examples=20, deadline=None)
@given(
    batch=st.integers(1, 3),
    channels=st.integers(1, 4),
    rows=st.integers(1, 3),
    columns=st.integers(1, 4),
)
def test_patches_have_an_inverse(
    batch: int, channels: int, rows: int, columns: int
) -> None:
    x = torch.randn(batch, channels, rows * PATCH[0], columns * PATCH[1])
    patches = to_patches(x, PATCH)
    assert patches.shape == (batch * rows * columns, channels, CELLS)
    assert torch.equal(from_patches(patches, PATCH, (x.shape[2], x.shape[3])), x)
    assert torch.equal(patches[-1, 0], x[-1, 0, -PATCH[0] :, -PATCH[1] :].flatten())


def test_splitting_puts_the_cells_of_a_patch_beside_each_other() -> None:
    # 2 x 2 cells of 3 channels
    x = torch.arange(2 * 2 * 3, dtype=torch.float32).view(1, 12, 1, 1)
    assert split(x, (2, 2))[0, :, 1, 0].tolist() == [6, 7, 8]
    assert split(x, (2, 2))[0, :, 0, 1].tolist() == [3, 4, 5]


def test_the_likelihoods_of_all_that_a_cell_can_show_sum_to_one() -> None:
    """Numerically over ranges and reflectances, and over classes and lost returns."""
    surfaces = random_surfaces(1)
    far = torch.linspace(-0.9999, 1, 601)
    bright = torch.linspace(-1, 9, 401)
    bright[0] += 1e-6  # -1 is reflectance 0, which has a probability, not a density
    grid = torch.cartesian_prod(far, bright)
    area = (far[1] - far[0]) * (bright[2] - bright[1])
    one = Surfaces(
        surfaces.inverse[..., :1],
        torch.full((1, K, 1), 0.02),
        surfaces.returned[..., :1],
        ZeroInflatedLogistic(*(part[..., :1] for part in surfaces.reflectance)),
        surfaces.classes,
        surfaces.weights[..., :1],
    )
    nothing = torch.zeros(1, 1).long()
    total = one.log_likelihood(
        torch.tensor([[-1.0]]), torch.tensor([[-1.0]]), nothing, SCALE, (1.0, 1.0)
    ).exp()
    for code in range(LABELS):
        codes = torch.full((1, len(grid)), code)
        cells = one.log_likelihood(
            grid[None, :, 0], grid[None, :, 1], codes, SCALE, (1.0, 1.0)
        ).exp()
        dark = one.log_likelihood(
            far[None],
            torch.full((1, len(far)), -1.0),
            codes[:, : len(far)],
            SCALE,
            (1.0, 1.0),
        )
        total = total + cells.sum() * area + dark.exp().sum() * (far[1] - far[0])
    assert total.item() == pytest.approx(1, abs=0.01)


def test_samples_have_the_predicted_frequencies() -> None:
    surfaces = random_surfaces(1)
    many = Surfaces(
        *(_repeat(part, 4000) for part in surfaces[:3]),
        ZeroInflatedLogistic(*(_repeat(part, 4000) for part in surfaces.reflectance)),
        *(_repeat(part, 4000) for part in surfaces[4:]),
    )
    noise = uniform(0, [0], (4000, DRAWS, CELLS))[0]
    alike = Noise(
        torch.zeros(LABELS), torch.zeros(LABELS, len(SPANS)), torch.full((LABELS,), 0.5)
    )
    relief = torch.zeros(4000, len(SPANS), CELLS)
    distance, value, code, likely = many.sample(noise, relief, alike, SCALE).unbind(1)
    shares = surfaces.weights.exp()
    returned = (shares * surfaces.returned.sigmoid()).sum(1)
    assert torch.allclose((distance > -1).float().mean(0), returned[0], atol=0.03)
    for k, best in enumerate(surfaces.classes[0].argmax(1).tolist()):
        same = [j for j in range(K) if surfaces.classes[0, j].argmax() == best]
        assert torch.allclose(
            (code == best).float().mean(0), shares[0, same].sum(0), atol=0.03
        ), k
    assert ((value >= -1) & (likely > 0) & (likely <= 1)).all()


def _repeat(part: Tensor, times: int) -> Tensor:
    return part.expand(times, *part.shape[1:])


def test_a_wall_is_exact_in_every_cell_of_a_patch() -> None:
    """Within a patch the inverse range of a plane is linear in row and column."""
    x = torch.zeros(1, K * (NUMBERS + LABELS) + CELLS * (K + PER_CELL))
    numbers = x[:, : K * (NUMBERS + LABELS)].view(K, -1)
    numbers[0, :3] = torch.tensor([np.log(10.0), 0.5, -0.4])
    inverse = surfaces_of(x, K, LABELS, PATCH).inverse[0, 0].view(PATCH)
    assert torch.allclose(
        inverse.diff(dim=1), inverse.diff(dim=1)[0, 0].expand(2, 7), atol=1e-6
    )
    assert inverse.mean() == pytest.approx(0.1)


def test_images_are_decoded_with_valid_labels_and_ranges() -> None:
    network = small().eval()
    z = torch.randn(2, *network.latent_shape)
    noise = uniform(0, [0, 1], (network.draws, *COARSE.shape))
    images = FORMAT.to_images(Latent(network, FORMAT).decode(z, noise), COARSE)
    again = FORMAT.to_images(Latent(network, FORMAT).decode(z[1:], noise[1:]), COARSE)
    assert np.allclose(images[1].range, again[0].range, rtol=1e-4)
    for image in images:
        assert image.label is not None and set(np.unique(image.label)) <= {
            *range(19),
            255,
        }
        assert (
            (image.range == 0) | ((image.range >= 1.45) & (image.range <= 80))
        ).all()
    # The most likely image.
    assert torch.equal(*(Latent(network, FORMAT).decode(z) for _ in range(2)))


def test_half_the_columns_show_the_same_street() -> None:
    """A wider cell looks through the middle of two: on one plane, its inverse range is their
    mean."""
    x = torch.zeros(5, K * (NUMBERS + LABELS) + CELLS * (K + PER_CELL))
    x[:, :3] = torch.randn(
        5, 3, generator=torch.Generator().manual_seed(0)
    ) / 3 + torch.tensor([2.0, 0, 0])
    fine, coarse = (
        surfaces_of(x, K, LABELS, PATCH, merged).inverse[:, 0] for merged in (1, 2)
    )
    assert torch.allclose(fine.view(5, 2, 4, 2).mean(3).flatten(1), coarse, rtol=1e-5)
    network = small().eval()
    z = torch.randn(1, *network.latent_shape)
    for width in network.widths:
        assert network.decode(z, uniform(0, [0], (network.draws, 16, width))).shape == (
            1,
            7,
            16,
            width,
        )
    with pytest.raises(DataError, match="one of 256, 128"):
        network.decode(z, torch.rand(1, network.draws, 16, 100))


def layout_with_a_box() -> Tensor:
    """(1, 5, 16, 256): ground, and a car between 12 m and 15 m in eleven columns."""
    image = torch.zeros(1, 5, 16, 256, dtype=torch.uint8)
    steps = round(12 / DEPTH_STEP)
    image[:, 0] = CODES["ground"]
    values = torch.tensor(
        [CODES["Car"], steps >> 8, steps & 255, round(3 / CHORD_STEP), 0],
        dtype=torch.uint8,
    )
    image[..., 4:9, 30:41] = values.view(5, 1, 1)
    return image


def test_bounds_leave_out_what_an_image_rounds() -> None:
    """Half a step of the depth, and of the chord."""
    bounds = bounds_of(layout_with_a_box(), 256, PATCH, 20, FORMAT.normalisation)
    boxed = bounds.near < bounds.far
    near, far = (FORMAT.normalisation.decode(v[boxed]) for v in bounds[:2])
    assert boxed.sum() == 55
    assert np.allclose(near, 12 + DEPTH_STEP / 2, rtol=0, atol=1e-4)
    leave = 15 - CHORD_STEP / 2 - DEPTH_STEP / 2
    assert np.allclose(far, leave, rtol=0, atol=1e-4)


@pytest.mark.parametrize("width", [256, 128])
@pytest.mark.parametrize("cars", [1, 2, 3])
def test_objects_are_decoded_in_the_boxes_of_a_layout_only(
    cars: int, width: int
) -> None:
    network = small().eval()
    with torch.no_grad():  # classes of the three surfaces of every patch
        kinds = network.head.bias[: K * (NUMBERS + LABELS)].view(K, -1)[:, NUMBERS:]
        kinds[:cars, TRAIN_ID["car"]] += 30
        kinds[cars:, TRAIN_ID["road"]] += 30
    z = torch.randn(1, *network.latent_shape)
    noise = uniform(0, [0], (network.draws, 16, width))
    layout = layout_with_a_box()
    sensor = replace(COARSE, columns=width)

    @torch.no_grad()
    def image_of(layout: Tensor | None) -> RangeImage:
        known = None if layout is None else {"layout": layout}
        [image] = FORMAT.to_images(
            expected(network.decode(z, noise, known), FORMAT), sensor
        )
        assert image.label is not None
        return image

    free = image_of(None)
    bounded = image_of(layout)
    inside = (layout[0, 0] == CODES["Car"]).view(16, width, -1).any(2).numpy()
    object_ = bounded.mask & (bounded.channels["label"] == TRAIN_ID["car"])
    assert (free.mask & (free.channels["label"] == TRAIN_ID["car"]))[
        ~inside
    ].mean() > 0.1
    assert object_[inside].any() and not object_[~inside].any()
    # The image rounds the 3 m by up to half a step.
    leave = 15 - CHORD_STEP / 2
    assert ((bounded.range[object_] > 12) & (bounded.range[object_] < leave)).all()
    # A cell without a box shows the road instead, if its patch has one.
    assert bounded.mask[~inside].mean() == pytest.approx(
        free.mask[~inside].mean() if cars < 3 else 0, abs=0.1
    )
    # Rays through a box may miss the object.
    road = inside & (free.channels["label"] == TRAIN_ID["road"])
    assert np.array_equal(free.range[road], bounded.range[road])
    # Nothing is known of a blank layout.
    assert np.array_equal(free.range, image_of(torch.zeros_like(layout)).range)
    # What stands in a box has its class.
    layout[:, 0][layout[:, 0] == CODES["Car"]] = CODES["Cyclist"]
    assert np.array_equal(
        object_, image_of(layout).channels["label"] == TRAIN_ID["bicyclist"]
    )


@torch.no_grad()
@pytest.mark.parametrize("width", [256, 128])
def test_returns_have_the_labels_of_a_map(width: int) -> None:
    network = small().eval()
    z = torch.randn(1, *network.latent_shape)
    noise = uniform(0, [0], (network.draws, 16, width))
    labels = torch.randint(
        0,
        19,
        (1, 16, width),
        dtype=torch.uint8,
        generator=torch.Generator().manual_seed(0),
    )
    labels[..., ::3] = IGNORE
    given_map = labels.repeat_interleave(256 // width, 2)
    if width == 128:
        given_map[..., 0::2] = (
            IGNORE  # a column that stands for two has the label of the one that is known
        )
    made, free = (
        FORMAT.to_images(
            expected(network.decode(z, noise, known), FORMAT),
            replace(COARSE, columns=width),
        )[0]
        for known in ({"semantic": given_map}, None)
    )
    known = made.mask & (labels[0].numpy() != IGNORE)
    assert known.mean() > 0.1
    assert np.array_equal(made.channels["label"][known], labels[0].numpy()[known])
    assert np.array_equal(
        made.range[~known & made.mask], free.range[~known & made.mask]
    )


def test_a_cell_of_a_given_class_shows_each_surface_with_its_probability_given_the_class() -> (
    None
):
    count = 40_000
    shown = TRAIN_ID["pole"]
    numbers = torch.zeros(1, K * (NUMBERS + LABELS) + CELLS * (K + PER_CELL))
    surface = numbers[:, : K * (NUMBERS + LABELS)].view(K, -1)
    surface[:, 0] = torch.tensor([1.0, 2.0, 3.0])  # far from each other
    surface[:, 3], surface[:, 4] = -9, 20  # sharp, and always a return
    surface[:, NUMBERS + shown] = torch.tensor([0.0, 1.0, 4.0])
    surfaces = surfaces_of(numbers, K, LABELS, PATCH)
    likely = surfaces.classes[0, :, shown].exp() / K
    drawn = surfaces_of(numbers.expand(count, -1), K, LABELS, PATCH).sample(
        torch.rand(count, DRAWS, CELLS, generator=torch.Generator().manual_seed(0)),
        torch.zeros(count, len(SPANS), CELLS),
        FLAT,
        SCALE,
        codes=torch.full((count, CELLS), shown),
    )
    ranges = SCALE.decode(drawn[:, 0])
    found = torch.stack(
        [(ranges.log() - mid).abs().lt(0.3).float().mean() for mid in (1.0, 2.0, 3.0)]
    )
    assert torch.allclose(found, likely / likely.sum(), atol=0.01)
    assert (drawn[:, 2] == shown).all()


@pytest.mark.slow
def test_a_decoder_of_both_widths_can_be_compiled() -> None:
    """Compiled for both at once, torch 2.13 gives infinite values."""
    network = small().eval()
    z = torch.randn(1, 8, 4, 16, generator=torch.Generator().manual_seed(0))
    noise = [uniform(0, [0], (network.draws, 16, width)) for width in network.widths]
    with torch.inference_mode():
        expected = [network.decode(z, some) for some in noise]
        _compile({VELOCITY: torch.nn.Identity(), CODEC: network})
        for some, image in zip(noise, expected, strict=True):
            assert torch.allclose(network.decode(z, some), image, atol=1e-3)


def test_training_lowers_the_likelihood_of_a_street() -> None:
    scan = Town(seed=3, sensor=COARSE, scans=1)[0]
    x = FORMAT.from_images([project(scan, COARSE, ["reflectance", "label"])])
    network = small()
    trained = Autoencoding(
        network,
        FORMAT,
        COARSE,
        Losses(noise=0.03, rare=0.5),
        METRICS["l1"],
        {"range": 0.5},
    )
    optimizer = torch.optim.Adam(network.parameters(), 5e-3)
    losses = []
    for _ in range(30):
        loss = trained(x, torch.zeros_like(x))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] - 1
    assert network.scale.ne(1).all()  # the statistics of the latents are followed
    with torch.no_grad():
        z = network.eval().encode(x)
    assert z.shape == (1, *network.latent_shape) and z.abs().max() < 10


def test_bfloat16_gives_the_same_latents() -> None:
    """oneDNN's bfloat16 convolution with the stem's kernel and stride does not."""
    network = SurfaceAutoencoder((64, 2048)).eval()
    x = 2 * torch.rand(1, 7, 64, 2048, generator=torch.Generator().manual_seed(0)) - 1
    with torch.no_grad():
        exact = network.squeeze(x)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = network.squeeze(x)
    assert (rounded - exact).norm() < 0.03 * exact.norm()


def test_the_noise_of_scans_is_measured() -> None:
    """Images that the codec itself sampled have the noise that it sampled with."""
    network = small().eval()
    with torch.no_grad():
        numbers = network.head.bias[: K * (NUMBERS + LABELS)].view(K, -1)
        # Surfaces far apart, almost without reflectances of 0.
        numbers[:, 0] = torch.tensor([1.0, 2.3, 3.6])
        numbers[:, 3], numbers[:, 4], numbers[:, 7] = -4.5, 0.5, -6
        network.roughness.fill_(0.3)
        network.alike.fill_(0.6)
    z = torch.randn(
        6, *network.latent_shape, generator=torch.Generator().manual_seed(1)
    )
    images = []
    for i in range(6):
        images.append(
            network.decode(
                z[i : i + 1], uniform(0, [i], (network.draws, *COARSE.shape))
            )
        )
    latents = iter(network.bounded(z).split(1))
    network.squeeze = lambda x: next(latents)  # type: ignore[method-assign]
    network.measure_noise(images, noise=0.0)
    assert network.roughness.mean() == pytest.approx(0.3, abs=0.06)
    assert network.alike.mean() == pytest.approx(0.6, abs=0.12)


@pytest.mark.parametrize("merged", [1, 2])
def test_the_fields_of_relief_are_standard_normal_and_correlated_along_rows(
    merged: int,
) -> None:
    fields = relief_fields(uniform(0, [0], (64, 4096 // merged)), merged)[0]
    assert fields.mean((1, 2)).abs().max() < 0.06
    for field, span in zip(fields, SPANS, strict=True):
        # At every column.
        assert field.square().mean(0).view(-1, span // merged).mean(0) == pytest.approx(
            1, abs=0.12
        )
        for lag in range(0, 2 * span + 1, 2):
            found = (field * field.roll(-lag // merged, 1)).mean()
            assert found == pytest.approx(
                correlation(span // merged, lag // merged), abs=0.06
            )
        assert (
            torch.equal(field[::2], field[1::2])
            and (field[::2] * field[::2].roll(1, 0)).mean().abs() < 0.06
        )
    assert (fields[0] * fields[1]).mean().abs() < 0.04


def test_the_relief_of_plants_is_measured() -> None:
    """Images with a relief that is known; other classes have none."""
    network = small().eval()
    relief = torch.zeros(LABELS, 2)
    relief[PLANTS[0]], relief[PLANTS[1]] = (
        torch.tensor([1.0, 0.5]),
        torch.tensor([0.3, 1.0]),
    )
    with torch.no_grad():
        numbers = network.head.bias[: K * (NUMBERS + LABELS)].view(K, -1)
        numbers[:, 0] = torch.tensor([1.0, 2.3, 3.6])
        numbers[:, 3] = -4.5
        numbers[:, 4] = 6
        for k, plant in enumerate((*PLANTS, 13)):  # 13 is a building
            numbers[k, NUMBERS + plant] = 12
        network.roughness.fill_(0.2)
        network.relief.copy_(relief)
    z = torch.randn(
        4, *network.latent_shape, generator=torch.Generator().manual_seed(1)
    )
    images = [
        network.decode(z[i : i + 1], uniform(0, [i], (network.draws, *COARSE.shape)))
        for i in range(4)
    ]
    latents = iter(network.bounded(z).split(1))
    network.squeeze = lambda x: next(latents)  # type: ignore[method-assign]
    network.measure_noise(images, noise=0.0)
    assert torch.allclose(network.relief[list(PLANTS)], relief[list(PLANTS)], atol=0.25)
    assert not network.relief[[c for c in range(LABELS) if c not in PLANTS]].any()


@pytest.mark.parametrize(
    "changes",
    [
        {"resolution": (16, 250)},
        {"bits": 4},
        {"normalisation": "other"},
        {"channels": 6},
        {"reaches": [17]},
        {"surfaces": 5},
    ],
)
def test_arguments_that_do_not_fit_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        SurfaceAutoencoder(**{"resolution": COARSE.shape} | changes)  # type: ignore[arg-type]


def test_latents_and_images_of_another_shape_are_refused() -> None:
    network = small()
    with pytest.raises(DataError, match="a latent"):
        network.decode(torch.zeros(1, 8, 4, 17))
    with pytest.raises(DataError, match="an image"):
        network.squeeze(torch.zeros(1, 7, 16, 128))
