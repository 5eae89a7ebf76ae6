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
from lidar_synth.generate.codec import make_codec
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.surface_codec.autoencoder import SurfaceAutoencoder
from lidar_synth.generate.models.surface_codec.reflectance import ZeroInflatedLogistic
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
from lidar_synth.lab.train.stage import hash_encoder

SENSOR = Sensor("small", 64, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
TENSORS = TensorFormat(("range", "reflectance", "label"), NORMALISATIONS["r2flow"])
SCANS = [random_scan(SENSOR, 300, i) for i in range(4)]


pytestmark = pytest.mark.usefixtures("one_thread")


def network(**arguments: Any) -> SurfaceAutoencoder:
    torch.manual_seed(0)
    small = {
        "encoder_widths": [12, 16],
        "widths": [12, 16],
        "reaches": [1, 2],
        "depth": 1,
    }
    net = build_network(
        "surfaces", {"resolution": [8, 64], "channels": 7} | small | arguments
    )
    assert isinstance(net, SurfaceAutoencoder)
    with torch.no_grad():  # residual blocks begin as nothing
        for name, weight in net.named_parameters():
            if "second" in name or "place" in name or "mix" in name:
                weight.normal_(0, 0.1)
    return net.eval()


def images() -> list[RangeImage]:
    return [project(scan, SENSOR, ["reflectance", "label"]) for scan in SCANS]


def tensors() -> Tensor:
    return TENSORS.from_images(images())


def test_columns_turn_together_in_image_and_latent() -> None:
    net = network()
    x = tensors()
    z = net.encode(x)
    assert z.shape[1:] == net.latent_shape == (8, 2, 4)
    assert torch.allclose(net.encode(x.roll(16, -1)), z.roll(1, -1), atol=1e-5)
    noise = torch.rand(len(z), net.draws, *SENSOR.shape).clamp(1e-6, 1 - 1e-6)
    turned = net.decode(z.roll(1, -1), noise.roll(16, -1))
    same = (
        torch.isclose(turned, net.decode(z, noise).roll(16, -1), atol=1e-3)
        .float()
        .mean()
    )
    assert same > 0.999  # rounding may choose another surface


def test_rows_are_told_apart() -> None:
    net = network()
    same = net.decode(torch.zeros(1, *net.latent_shape))
    assert not torch.allclose(same[..., 0, :], same[..., 4, :], atol=1e-3)


@pytest.mark.parametrize("rare", [0.0, 0.5])
def test_the_loss_by_hand(rare: float) -> None:
    """Every cell is a mixture of the surfaces of its patch."""
    net = network()
    x = tensors()
    weights = {"range": 5.0, "reflectance": 0.5}
    trained = Autoencoding(
        net, TENSORS, SENSOR, Losses(noise=0.0, rare=rare), METRICS["l1"], weights
    ).eval()
    with torch.no_grad():
        surfaces = net.expand(net.squeeze(x))
    label = np.stack([image.channels["label"] for image in images()]).astype(np.int64)
    label = np.where(label == IGNORE, 19, label)
    shares = np.bincount(label.ravel(), minlength=20) / label.size
    total = 0.0
    weight = 0.0
    for i, row, column in np.ndindex(label.shape):
        patch = (i * 4 + row // 2) * 8 + column // 8
        cell = row % 2 * 8 + column % 8
        code = label[i, row, column]
        likely = 0.0
        for k in range(net.surfaces):
            returned = surfaces.returned[patch, k, cell].sigmoid()
            if x[i, 0, row, column] > -1:
                inverse = surfaces.inverse[patch, k, cell]
                middle = TENSORS.normalisation.encode(1 / inverse)
                distance = Laplace(middle, surfaces.scale[patch, k, 0])
                parts = [
                    part.expand_as(surfaces.weights) for part in surfaces.reflectance
                ]
                values = ZeroInflatedLogistic(*(part[patch, k, cell] for part in parts))
                shown = distance.log_prob(x[i, 0, row, column]) * 5
                shown = shown - 0.5 * values.nll(x[i, 1, row, column])
                one = returned * (shown + surfaces.classes[patch, k, code]).exp()
            else:
                one = 1 - returned
            likely = likely + surfaces.weights[patch, k, cell].exp() * one
        total += shares[code] ** -rare * -float(likely.log())
        weight += shares[code] ** -rare
    assert trained(x).item() == pytest.approx(total / weight, rel=1e-4)
    assert trained(x, torch.randn_like(x)).item() == pytest.approx(
        total / weight, rel=1e-4
    ), "noise of deviation 0"
    noisy = Autoencoding(
        net, TENSORS, SENSOR, Losses(noise=3.0), METRICS["l1"], {}
    ).eval()
    assert noisy(x, torch.randn_like(x)).item() != pytest.approx(
        noisy(x).item(), rel=1e-3
    )


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
        shaken,
        torch.tensor([0.1, 0.2]).view(-1, 1, 1, 1) * some[2:],
        atol=1e-5,
        rtol=1e-4,
    )
    assert example.velocity is x
    trained = Decoding(net, TENSORS, SENSOR, Losses(), METRICS["l1"], {})
    decoding_loss(trained, example, METRICS["l1"]).backward()
    told = {name for name, weight in net.named_parameters() if weight.grad is not None}
    assert {"from_latent.weight", "head.weight"} <= told
    assert not {"stem.weight", "place_stem", "to_latent.bias", "merge.weight"} & told


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
        cache_latents(cache, TENSORS, other, "cpu", folder, "b", progress=False),
        latents,
    )


def test_the_name_of_latents_tells_their_encoder_alone() -> None:
    net = network()
    before = hash_encoder(net)
    with torch.no_grad():
        net.get_parameter("head.weight").add_(1)
    assert hash_encoder(net) == before
    with torch.no_grad():
        net.get_parameter("to_latent.bias").add_(1)
    changed = hash_encoder(net)
    net.get_buffer("scale").mul_(2)
    assert len({before, changed, hash_encoder(net)}) == 3


def test_latents_that_are_turned_are_those_of_turned_scans() -> None:
    cache = cache_scans(SCANS, SENSOR, TENSORS.channels, progress=False)
    codec = make_codec(network(), TENSORS, SENSOR.shape)
    latents = cache_latents(cache, TENSORS, codec, "cpu", progress=False)
    held = Batches(cache, TENSORS, flip=True, roll=True, codec=codec, latents=latents)
    found = set()
    for y0, scan in zip(held(range(16)).y0, held.scans_at(range(16)), strict=True):
        x = TENSORS.encode(cache.read([scan]))
        turned = {
            (mirrored, k): codec.encode(
                (x.flip(-1) if mirrored else x).roll(16 * k, -1)
            )[0]
            for mirrored in (False, True)
            for k in range(4)
        }
        [match] = [key for key, z in turned.items() if torch.allclose(z, y0, atol=2e-3)]
        found.add(match)
    assert {mirrored for mirrored, _ in found} == {False, True} and {
        k for _, k in found
    } == set(range(4))


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
            replace(
                i,
                channels={
                    **i.channels,
                    "label": np.full_like(i.channels["label"], IGNORE),
                },
            )
            for i in images()
        ]
    )
    seen = net(blank, torch.zeros(len(x), *net.latent_shape))
    torch.testing.assert_close(hidden(x), net.nll(seen, x, whole.objective))
    assert hidden(x) != whole(x)
