"""The codec between range images and states, and training and evaluation of an autoencoder."""

from typing import Any

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from conftest import random_scan
from torch import Tensor, nn

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.generate.codec import Identity, Latent, make_codec
from lidar_synth.generate.flow.path import METRICS
from lidar_synth.generate.models import build_network
from lidar_synth.generate.models.lidm.vqvae import VQVAE
from lidar_synth.generate.models.objective import expected
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.train import (
    Autoencoding,
    Batches,
    Losses,
    Recipe,
    Training,
    autoencoder_loss,
    cache_scans,
    reconstruct,
    reconstruction_figures,
    reconstruction_task,
    steps,
)

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
TENSORS = TensorFormat(("range", "reflectance", "label"), NORMALISATIONS["r2flow"])
SCANS = [random_scan(SENSOR, 400, seed) for seed in range(4)]


pytestmark = pytest.mark.usefixtures("one_thread")


def network(**arguments: Any) -> VQVAE:
    torch.manual_seed(0)
    net = build_network(
        "vqvae",
        {
            "resolution": (8, 32),
            "channels": 7,
            "latent_channels": 6,
            "codes": 64,
            "width": 16,
            "multipliers": (1, 2),
            "strides": ((1, 2),),
            "blocks": 1,
            "groups": 4,
            **arguments,
        },
    )
    assert isinstance(net, VQVAE)
    nn.init.normal_(net.codebook.codes, std=0.3)
    return net


def tensors() -> Tensor:
    return TENSORS.from_images(
        [project(scan, SENSOR, ["reflectance", "label"]) for scan in SCANS]
    )


def autoencoding(
    metric: str = "l1", weights: dict[str, float] | None = None, **losses: float
) -> Autoencoding:
    return Autoencoding(
        network(), TENSORS, SENSOR, Losses(**losses), METRICS[metric], weights or {}
    )  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_mask_is_trained_and_removes_returns() -> None:
    x = tensors()
    net = network(mask=True)
    assert net(x).output.shape == (4, 8, 8, 32)
    training = Autoencoding(net, TENSORS, SENSOR, Losses(mask=1.0), METRICS["l1"], {})
    optimizer = torch.optim.Adam(training.parameters(), 1e-2)
    returned = x[:, :1] > -1

    def right() -> float:
        return float(
            ((net._decode(net.codebook(net._encode(x))[0])[:, 7:] > 0) == returned)
            .float()
            .mean()
        )

    before = right()
    for _ in range(40):
        optimizer.zero_grad()
        training(x).backward()
        optimizer.step()
    # a small codebook cannot reconstruct random scans much better
    assert right() > before + 0.2
    with torch.no_grad():
        image = net.eval().decode(net.encode(x))
        bits = net._decode(net.codebook(net._encode(x))[0])[:, 7:]
    assert torch.equal((image == -1).all(1, keepdim=True), bits < 0)
    without = Autoencoding(net, TENSORS, SENSOR, Losses(mask=0.0), METRICS["l1"], {})
    assert training(x) > without(x)


def test_the_adversarial_weight_balances_two_gradients() -> None:
    """Esser et al., Eq. 7: at the decoder's last layer, the adversarial gradient equals that of the
    reconstruction."""
    x = tensors()
    plain, balanced = (
        autoencoding(adversarial=0.6, adaptive=a).eval() for a in (False, True)
    )
    balanced.load_state_dict(plain.state_dict())
    last = balanced.network.decoder.head.weight
    output = balanced.network(x).output
    rec = balanced.objective.reconstruction(output, x)
    judge = balanced.discriminator
    assert judge is not None
    fooled = -judge(expected(output, TENSORS)).mean()
    one, other = (
        torch.autograd.grad(part, last, retain_graph=True)[0].norm()
        for part in (rec, fooled)
    )
    difference = 0.6 * (one / (other + 1e-4) - 1) * fooled
    torch.testing.assert_close(balanced(x) - plain(x), difference, rtol=1e-4, atol=1e-5)
    balanced(x).backward()
    assert all(p.grad is not None for p in balanced.parameters() if p.requires_grad)


@pytest.mark.parametrize("adaptive", [False, True])
def test_a_measured_loss_does_not_depend_on_the_discriminator(adaptive: bool) -> None:
    judged = autoencoding(adversarial=0.6, adaptive=adaptive).eval()
    with torch.no_grad():
        assert judged(tensors()) == autoencoding().eval()(tensors())


def test_the_codec_of_a_pixel_model_is_the_identity() -> None:
    codec = make_codec(None, TENSORS, SENSOR.shape)
    x = tensors()
    assert isinstance(codec, Identity)
    assert codec.shape == (7, 8, 32) == x.shape[1:]
    assert codec.decode(codec.encode(x)) is x


def test_the_codec_of_a_latent_model_is_its_autoencoder() -> None:
    net = network().eval()
    codec = make_codec(net, TENSORS, SENSOR.shape)
    x = tensors()
    assert isinstance(codec, Latent)
    y = codec.encode(x)
    assert y.shape[1:] == codec.shape == net.latent_shape
    assert not y.requires_grad
    out = codec.decode(y)
    assert out.shape == x.shape
    with torch.no_grad():
        assert torch.equal(out[:, :2], net.decode(y)[:, :2])
    assert out[:, 2:].abs().max() < 1  # expected values of bits that are -1 or 1
    with pytest.raises(DataError, match="a latent of shape"):
        codec.decode(y[:, :, :4])


def test_an_autoencoder_for_other_images_is_refused() -> None:
    with pytest.raises(
        DataError, match=r"images of shape \(7, 8, 32\); expected \(2, 8, 32\)"
    ):
        make_codec(
            network(),
            TensorFormat(("range", "reflectance"), NORMALISATIONS["r2flow"]),
            SENSOR.shape,
        )


def test_label_bits_are_the_expected_values_of_their_logits() -> None:
    logits = torch.randn(2, 7, 3, 4)
    said = expected(logits, TENSORS)
    assert torch.equal(said[:, :2], logits[:, :2])
    assert torch.allclose(said[:, 2:], 2 * logits[:, 2:].sigmoid() - 1, atol=1e-6)


def test_the_loss_is_the_sum_of_its_terms() -> None:
    x = tensors()
    trained = autoencoding(commitment=0.0)
    output = trained.network(x).output.detach()
    assert trained.eval().objective.reconstruction(logits_of(x), x) < 1e-3
    plain = trained.objective.reconstruction(output, x)
    bits = torch.nn.functional.binary_cross_entropy_with_logits(
        output[:, 2:], (x[:, 2:] + 1) / 2
    )
    by_hand = (
        (output[:, 0] - x[:, 0]).abs().mean()
        + (output[:, 1] - x[:, 1]).abs().mean()
        + bits
    )
    assert plain.item() == pytest.approx(by_hand.item(), rel=1e-5)
    heavy = autoencoding(
        commitment=0.0, weights={"label": 3.0}
    ).objective.reconstruction(output, x)
    assert heavy.item() == pytest.approx((by_hand + 2 * bits).item(), rel=1e-5)
    values = [
        float(autoencoding(**term).eval()(x))
        for term in ({"commitment": 0.0}, {"commitment": 1.0}, {"geometric": 10.0})
    ]
    assert values[0] < values[1] and values[0] < values[2]


def logits_of(x: Tensor) -> Tensor:
    """The output of a perfect decoder."""
    return torch.cat((x[:, :2], 20 * x[:, 2:]), 1)


def test_geometry_is_in_metres_along_the_rays() -> None:
    trained = autoencoding()
    x = tensors()
    image = project(SCANS[0], SENSOR)
    points = image.range[..., None] * SENSOR.ray_directions()
    means = points.reshape(8, 8, 4, 3).mean(2) / SENSOR.range_max
    assert np.allclose(
        trained.objective.points(x)[0].movedim(0, -1).numpy(), means, atol=1e-5
    )


def test_both_sides_of_the_adversarial_term_get_their_own_gradients() -> None:
    trained = autoencoding(adversarial=1.0)
    x = tensors()
    assert trained.discriminator is not None
    output = torch.zeros_like(x).requires_grad_()
    trained.network._adversarial(
        trained.discriminator, output, x, torch.zeros(()), trained.objective
    ).backward()
    by_both = {
        n: p.grad.clone()
        for n, p in trained.discriminator.named_parameters()
        if p.grad is not None
    }
    assert output.grad is not None and output.grad.any()
    trained.zero_grad()
    judge = trained.discriminator
    own = (
        torch.relu(1 - judge(x)).mean()
        + torch.relu(1 + judge(torch.zeros_like(x))).mean()
    )
    (own / 2).backward()
    for name, parameter in judge.named_parameters():
        assert parameter.grad is not None
        # The gradient of the adversarial term alone.
        assert torch.allclose(by_both[name], parameter.grad, atol=1e-6), name


@pytest.mark.slow
@pytest.mark.parametrize(
    "losses", [{}, {"geometric": 1.0, "adversarial": 0.05}], ids=["plain", "all terms"]
)
def test_training_reduces_the_loss_and_the_reconstruction_error(
    losses: dict[str, float],
) -> None:
    batches = Batches(
        cache_scans(SCANS, SENSOR, TENSORS.channels, progress=False), TENSORS, seed=1
    )
    trained = autoencoding(**losses)
    recipe = Recipe(
        iterations=70, batch=4, rate=3e-3, warmup=5, metric="l1", ema_every=1
    )
    training = Training(trained, recipe)
    before = reconstruction_figures(
        Latent(trained.network.eval(), TENSORS), tensors(), SENSOR
    )
    records = list(
        steps(
            training,
            reconstruction_task,
            batches,
            Accelerator(cpu=True),
            autoencoder_loss,
        )
    )
    assert sum(r.loss for r in records[-5:]) < 0.75 * sum(r.loss for r in records[:5])
    average: Any = training.average
    # Buffers are copied, not averaged.
    assert torch.equal(average.network.scale, trained.network.scale)
    after = reconstruction_figures(Latent(average.network, TENSORS), tensors(), SENSOR)
    assert set(after) == {
        "mae",
        "within_5cm",
        "drop_accuracy",
        "chamfer",
        "label_accuracy",
    }
    assert after["mae"] < before["mae"]
    if not losses:
        assert after["label_accuracy"] > before["label_accuracy"]


class Offset(VQVAE):
    """An autoencoder that returns images with a known error of the range, and drops rows of
    returns."""

    def __init__(self, metres: float, drop: int) -> None:
        super().__init__(
            (8, 32), 7, 7, 0, width=8, multipliers=(1,), strides=(), blocks=1, groups=1
        )
        self.metres = metres
        self.drop = drop

    def encode(self, x: Tensor) -> Tensor:
        return x

    def decode(self, z: Tensor, uniform_noise: Tensor | None = None) -> Tensor:
        fields = TENSORS.decode(z)
        fields["range"] = torch.where(
            fields["range"] > 0, fields["range"] + self.metres, 0.0
        )
        fields["range"][:, : self.drop] = 0
        return logits_of(TENSORS.encode(fields))


@pytest.mark.parametrize(("metres", "drop"), [(0.0, 0), (0.03, 0), (0.2, 0), (0.0, 4)])
def test_reconstruction_figures_measure_known_errors(metres: float, drop: int) -> None:
    codec = Latent(Offset(metres, drop), TENSORS)
    images = [project(scan, SENSOR, ["reflectance", "label"]) for scan in SCANS]
    for image in images:  # so that the added error stays within the range of the sensor
        image.range[image.range > 75] = 0
    figures = reconstruction_figures(codec, TENSORS.from_images(images), SENSOR)
    masks = np.stack([image.mask for image in images])
    lost = masks[:, :drop].sum((1, 2))
    seen = masks.sum((1, 2))
    assert figures["mae"] == pytest.approx(metres, abs=2e-3)
    assert figures["within_5cm"] == pytest.approx(
        float(((seen - lost) / seen).mean()) if metres < 0.05 else 0, abs=1e-3
    )
    assert figures["drop_accuracy"] == pytest.approx(
        float((1 - lost / 256).mean()), abs=1e-3
    )
    assert figures["label_accuracy"] == pytest.approx(1.0)
    if not drop:
        assert figures["chamfer"] == pytest.approx(metres, abs=3e-3)
    else:
        assert figures["chamfer"] > 0.5
    assert len(reconstruct(codec, TENSORS.from_images(images), SENSOR)) == 4


def test_negative_weights_are_refused() -> None:
    with pytest.raises(ConfigError, match="weights of at least 0"):
        Losses(geometric=-1.0)
