"""The small autoencoder: what it says of every cell, its loss, and latents that are made once."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_scan
from torch import Tensor
from torch.distributions import Laplace

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.town_codec.autoencoder import ROUGHNESS, Autoencoder
from lidar_synth.generate.models.town_codec.multiscale import LATTICES, at_lattice
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.train import (
    Autoencoding,
    Batch,
    Batches,
    Decoding,
    Losses,
    cache_latents,
    cache_scans,
    decoding_loss,
    decoding_task,
)

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
TENSORS = TensorFormat(("range", "reflectance", "label"), NORMALISATIONS["r2flow"])
SCANS = [random_scan(SENSOR, 300, i) for i in range(4)]


pytestmark = pytest.mark.usefixtures("one_thread")


def network(**arguments: Any) -> Autoencoder:
    torch.manual_seed(0)
    net = build_network(
        "autoencoder",
        {"resolution": [8, 32], "channels": 7, "widths": [12, 16], "fine": 8} | arguments,
    )
    assert isinstance(net, Autoencoder)
    with torch.no_grad():  # residual blocks, and what neighbours say, begin as nothing
        for name, weight in net.named_parameters():
            if "second" in name or "place" in name or "answer" in name:
                weight.normal_(0, 0.1)
    return net.eval()


def images() -> list[RangeImage]:
    return [project(scan, SENSOR, ["reflectance", "label"]) for scan in SCANS]


def tensors() -> Tensor:
    return TENSORS.from_images(images())


@pytest.mark.parametrize("arguments", [{}, {"wide": (1, 2)}, {"window": (3, 3)}])
def test_columns_turn_together_in_image_and_latent(arguments: dict[str, Any]) -> None:
    net = network(**arguments)
    x = tensors()
    z = net.encode(x)
    assert z.shape[1:] == net.latent_shape == (8, 2, 4)
    assert torch.allclose(net.encode(x.roll(8, -1)), z.roll(1, -1), atol=1e-5)
    assert torch.allclose(net.decode(z.roll(1, -1)), net.decode(z).roll(8, -1), atol=1e-5)
    uniform_noise = torch.rand(len(z), net.draws, *SENSOR.shape).clamp(1e-6, 1 - 1e-6)
    assert torch.allclose(
        net.decode(z.roll(1, -1), uniform_noise.roll(8, -1)),
        net.decode(z, uniform_noise).roll(8, -1),
        atol=1e-4,
    )


def test_rows_are_told_apart() -> None:
    net = network()
    same = net.decode(torch.zeros(1, *net.latent_shape))
    assert not torch.allclose(same[..., 0, :], same[..., 4, :], atol=1e-3)


def test_what_leaves_the_codec_is_what_was_said() -> None:
    net = network()
    x = tensors()
    with torch.no_grad():
        net.shift.normal_()
        net.scale.uniform_(0.5, 2)
    codec = make_codec(net, TENSORS, SENSOR.shape)
    z = codec.encode(x)
    assert torch.allclose(
        z * net.scale.view(1, -1, 1, 1) + net.shift.view(1, -1, 1, 1), net.squeeze(x), atol=1e-5
    )
    predicted = net.expand(net.squeeze(x), net.decode(z))
    fields = TENSORS.decode(codec.decode(z))
    seen = fields["range"] > 0
    assert not seen[(predicted.returned <= 0)[:, 0]].any()
    assert seen.any() and not seen.all()
    metres = TENSORS.normalisation.decode(predicted.surfaces.mode()[:, 0])
    assert torch.allclose(fields["range"][seen], metres[seen], rtol=1e-4)
    likely, code = predicted.classes.softmax(1).max(1)
    expected = torch.where(code == 19, IGNORE, code)
    assert torch.equal(fields["label"][seen].long(), expected[seen])
    assert torch.allclose(fields["confidence"][seen], likely[seen].clamp(max=0.9999), atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("lattice", LATTICES)
def test_chance_draws_what_was_said(lattice: tuple[int, int]) -> None:
    """Over many draws, coarser lattices being as they are: as many returns as the logit says, the
    medians and the spreads that were predicted."""
    net = network()
    draws = 4000
    z = torch.randn(1, *net.latent_shape)
    generator = torch.Generator().manual_seed(0)
    uniform_noise = torch.rand(draws, net.draws, *SENSOR.shape, generator=generator).clamp(
        1e-6, 1 - 1e-6
    )
    for coarser in LATTICES[: LATTICES.index(lattice)]:
        at_lattice(coarser, uniform_noise)[:] = at_lattice(coarser, uniform_noise)[:1].clone()
    with torch.inference_mode():
        images = torch.cat(
            [net.decode(z.expand(len(part), -1, -1, -1), part) for part in uniform_noise.split(500)]
        )
        predicted = net.expand(z, images[:1])
    new = torch.zeros(SENSOR.shape, dtype=torch.bool)
    at_lattice(lattice, new[None])[:] = True
    for coarser in LATTICES[: LATTICES.index(lattice)]:
        at_lattice(coarser, new[None])[:] = False
    back = images[:, 0] > -1
    share = torch.sigmoid(predicted.returned[0, 0])
    assert (back.float().mean(0) - share)[new].abs().max() < 5 * 0.5 / draws**0.5
    blank = predicted.readings.blank[0, 0].sigmoid()
    middle = predicted.readings.middles[0, 0]
    scale = predicted.readings.spreads[0, 0].exp()
    for widths, below in ((0.0, 0.5), (1.0, 0.731)):  # of a logistic distribution
        expected = torch.where(middle + widths * scale > -1, blank + (1 - blank) * below, 0)
        found = (images[:, 1] <= middle + widths * scale).float().mean(0)
        assert (found - expected)[new].abs().max() < 5 * 0.5 / draws**0.5


def test_ranges_are_rough_and_labels_are_the_likeliest() -> None:
    net = network()
    z = torch.randn(8, *net.latent_shape)
    uniform_noise = torch.rand(8, net.draws, *SENSOR.shape).clamp(1e-6, 1 - 1e-6)
    with torch.inference_mode():
        images = net.decode(z, uniform_noise)
        predicted = net.expand(z, images)
        assert torch.equal(predicted.sample(uniform_noise)[:, 1:], images[:, 1:2]), (
            "what was drawn is what is predicted, seeing the rest"
        )
    off = (images[:, :1] - predicted.surfaces.mode()).abs()[images[:, :1] > -1]
    assert off.mean().item() == pytest.approx(ROUGHNESS, rel=0.2)
    code = predicted.classes.argmax(1)
    bits = torch.stack([(code >> bit & 1) > 0 for bit in reversed(range(5))], 1)
    assert torch.equal(images[:, 2:] > 0, bits)


@pytest.mark.parametrize("rare", [0.0, 0.5])
def test_the_loss_by_hand(rare: float) -> None:
    net = network()
    x = tensors()
    weights = {"range": 5.0, "reflectance": 0.5, "label": 2.0}
    trained = Autoencoding(
        net, TENSORS, SENSOR, Losses(noise=0.0, rare=rare), METRICS["l1"], weights
    ).eval()
    predicted = net.expand(net.squeeze(x), x)
    images = [project(scan, SENSOR, ["reflectance", "label"]) for scan in SCANS]
    mask = torch.from_numpy(np.stack([image.mask for image in images]))
    label = torch.from_numpy(
        np.stack([image.channels["label"] for image in images]).astype(np.int64)
    )
    label = torch.where(label == IGNORE, 19, label)
    share = predicted.surfaces.chosen.softmax(1)
    ranges = (
        Laplace(predicted.surfaces.values, predicted.surfaces.spreads.exp())
        .log_prob(x[:, :1])
        .exp()
    )
    blank = predicted.readings.blank.sigmoid()
    off = (x[:, 1:2] - predicted.readings.middles) / predicted.readings.spreads.exp()
    number = (1 - blank) / (4 * predicted.readings.spreads.exp() * torch.cosh(off / 2) ** 2)
    others = torch.where(x[:, 1:2] > -1, number, blank + (1 - blank) * torch.sigmoid(off)).log()
    cells = torch.tensor(
        [(label == code).double().mean().item() for code in label.flatten()]
    ).reshape(label.shape)
    weight = cells.pow(-rare)

    def mean(values: Tensor, where: Tensor) -> Tensor:
        return (weight * values)[where].sum() / weight[where].sum()

    by_hand = (
        torch.nn.functional.binary_cross_entropy_with_logits(predicted.returned[:, 0], mask.float())
        - 5 * mean((share * ranges).sum(1).log(), mask)
        - 0.5 * mean(others[:, 0], mask)
        + 2
        * mean(
            torch.nn.functional.cross_entropy(predicted.classes, label, reduction="none"),
            torch.ones_like(mask),
        )
    )
    assert trained(x).item() == pytest.approx(by_hand.item(), rel=1e-5)
    assert trained(x, torch.randn_like(x)).item() == pytest.approx(by_hand.item(), rel=1e-5), (
        "noise of deviation 0"
    )
    noisy = Autoencoding(net, TENSORS, SENSOR, Losses(noise=3.0), METRICS["l1"], {}).eval()
    assert noisy(x, torch.randn_like(x)).item() != pytest.approx(noisy(x).item(), rel=1e-3)


@pytest.mark.slow
def test_it_learns_scans_and_its_latents_have_variance_one() -> None:
    net = network()
    x = tensors()
    trained = Autoencoding(net.train(), TENSORS, SENSOR, Losses(), METRICS["l1"], {})
    optimizer = torch.optim.Adam(net.parameters(), 3e-3)
    losses = []
    for _ in range(150):
        loss = trained(x, torch.randn_like(x))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] - 1
    z = net.eval().encode(x)
    assert abs(z.mean().item()) < 0.3 and 0.7 < z.std().item() < 1.5


def test_a_decoder_meets_what_the_flow_leaves() -> None:
    """Every other latent is where the student's last step ends; the others have noise of up to the
    given strength."""
    net = network()
    x = tensors()
    with torch.no_grad():
        net.scale.uniform_(0.5, 2)
    asked: list[Tensor] = []

    def velocity(y: Tensor, t: Tensor, cond: Tensor | None) -> Tensor:
        asked.append(y)
        assert t.tolist() == pytest.approx([0.25] * len(x))
        return 3 * y

    z = net.encode(x)
    noise = torch.randn_like(x)
    some = noise.flatten(1)[:, : z[0].numel()].reshape(z.shape)
    batch = Batch(x, noise, torch.tensor([0.0, 0.4, 0.75, 1.0]))
    example = decoding_task(net, velocity, 0.25, 0.2)(batch)
    torch.testing.assert_close(asked[0], 0.75 * z + 0.25 * some)
    torch.testing.assert_close(example.y[:2], (asked[0] - 0.25 * 3 * asked[0])[:2])
    shaken = net.bounded(example.y)[2:] - net.bounded(z)[2:]
    torch.testing.assert_close(
        shaken, torch.tensor([0.1, 0.2]).view(-1, 1, 1, 1) * some[2:], atol=1e-5, rtol=1e-4
    )
    assert example.velocity is x
    trained = Decoding(net, TENSORS, SENSOR, Losses(), METRICS["l1"], {})
    decoding_loss(trained, example, METRICS["l1"]).backward()
    told = {name for name, weight in net.named_parameters() if weight.grad is not None}
    assert {"from_latent.weight", "heads.weight"} <= told
    assert not {"stem.weight", "place_stem", "to_latent.bias", "merge.weight"} & told


@pytest.mark.parametrize(
    "wrong",
    [
        {"resolution": [8, 30]},
        {"bits": 4},
        {"bits": 0},
        {"codes": 40},
        {"channels": 5},
        {"depth": 1},
        {"wide": [0]},
        {"wide": [5]},
        {"window": [2, 3]},
        {"window": [7, 3]},
        {"normalisation": "metres"},
    ],
)
def test_values_that_do_not_fit_together_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        network(**wrong)


def test_images_and_latents_of_other_shapes_are_refused() -> None:
    net = network()
    with pytest.raises(DataError, match="an image of shape"):
        net.encode(torch.zeros(1, 7, 8, 16))
    with pytest.raises(DataError, match="a latent of shape"):
        net.decode(torch.zeros(1, 8, 2, 8))


@pytest.mark.parametrize("on_disk", [True, False])
def test_latents_that_were_made_before_are_those_that_are_made_on_the_way(
    on_disk: bool, tmp_path: Any
) -> None:
    cache = cache_scans(SCANS, SENSOR, TENSORS.channels, progress=False)
    codec = make_codec(network(), TENSORS, SENSOR.shape)
    folder = tmp_path if on_disk else None
    latents = cache_latents(cache, TENSORS, codec, "cpu", folder, "a", progress=False)
    again = cache_latents(cache, TENSORS, codec, "cpu", folder, "a", progress=False)
    assert isinstance(again, np.memmap) == on_disk
    live = Batches(cache, TENSORS, flip=True, codec=codec)(range(12))
    held = Batches(cache, TENSORS, flip=True, codec=codec, latents=again)(range(12))
    assert np.array_equal(latents, again)
    assert torch.allclose(held.y0, live.y0, atol=2e-3)
    assert torch.equal(held.y1, live.y1) and torch.equal(held.u, live.u)
    other = make_codec(network(depth=2), TENSORS, SENSOR.shape)
    assert not np.array_equal(
        cache_latents(cache, TENSORS, other, "cpu", folder, "b", progress=False), latents
    )


def test_latents_that_are_turned_are_those_of_turned_scans() -> None:
    cache = cache_scans(SCANS, SENSOR, TENSORS.channels, progress=False)
    codec = make_codec(network(), TENSORS, SENSOR.shape)
    latents = cache_latents(cache, TENSORS, codec, "cpu", progress=False)
    held = Batches(cache, TENSORS, flip=True, roll=True, codec=codec, latents=latents)
    found = set()
    for y0, scan in zip(held(range(16)).y0, held.scans_at(range(16)), strict=True):
        x = TENSORS.encode(cache.read([scan]))
        turned = {
            (mirrored, k): codec.encode((x.flip(-1) if mirrored else x).roll(8 * k, -1))[0]
            for mirrored in (False, True)
            for k in range(4)
        }
        [match] = [key for key, z in turned.items() if torch.allclose(z, y0, atol=2e-3)]
        found.add(match)
    assert {mirrored for mirrored, _ in found} == {False, True} and {k for _, k in found} == set(
        range(4)
    )


def test_images_whose_labels_are_hidden_are_decoded_to_their_labels_anyway() -> None:
    x = tensors()
    net = network()
    whole, hidden = (
        Autoencoding(
            net, TENSORS, SENSOR, Losses(noise=0.0, unlabelled=share), METRICS["l1"], {}
        ).eval()
        for share in (0.0, 1.0)
    )
    blank = TENSORS.from_images(
        [
            replace(i, channels={**i.channels, "label": np.full_like(i.channels["label"], IGNORE)})
            for i in images()
        ]
    )
    torch.testing.assert_close(hidden(x), whole.nll(net(blank, torch.zeros(len(x), 8, 2, 4)), x))
    assert hidden(x) != whole(x)
