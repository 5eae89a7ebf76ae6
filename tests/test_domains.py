"""Real and synthetic scans as two domains: weights of the loss, the schedule that ends on real
scans, statistics and layers by domain."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from streets import street

from lidar_synth import (
    MixedScans,
    MixedStream,
    Sources,
    load_generator,
    load_sensor,
    mix,
)
from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import ConfigError
from lidar_synth.formats import WRITERS
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.transfer import Transfer
from lidar_synth.labels.augment import drop_reflectance
from lidar_synth.mixing import (
    ByDomain,
    SyntheticFirst,
    defaults,
    make_schedule,
    settle,
    to_item,
)
from lidar_synth.mixing.settings import mix_for_trainer

REAL = [street(i) for i in range(4)]
SYNTHETIC = [street(10 + i) for i in range(4)]


def weights(mixed: MixedScans, epoch: int) -> dict[int, set[float]]:
    """{domain: weights of its items} in an epoch."""
    mixed.set_epoch(epoch)
    found: dict[int, set[float]] = {}
    for i in range(len(mixed)):
        item = mixed[i]
        assert item["loss_weight"] == mixed.loss_weight(i)
        found.setdefault(item["domain"], set()).add(item["loss_weight"])
    return found


def test_synthetic_items_have_the_weight_of_their_epoch() -> None:
    mixed = MixedScans(REAL, SYNTHETIC, 0.5, loss_weight={0: 0.5, 2: 0.1})
    assert weights(mixed, 0) == {0: {1.0}, 1: {0.5}}
    assert weights(mixed, 1) == {0: {1.0}, 1: {0.5}}
    assert weights(mixed, 2) == {0: {1.0}, 1: {0.1}}


def test_sources_have_weights_of_their_own() -> None:
    synthetic = Sources(SYNTHETIC[:2], SYNTHETIC[2:], loss_weights=[0.5, 1])
    mixed = MixedScans(REAL, synthetic, 0.5, loss_weight=0.2)
    assert weights(mixed, 0) == {0: {1.0}, 1: {0.1, 0.2}}


@pytest.mark.parametrize("collate", ["offsets", "padded", "range"])
def test_batches_have_the_weights_in_the_order_of_their_domains(collate: Any) -> None:
    mixed = MixedScans(
        REAL, SYNTHETIC, 0.5, loss_weight=0.25, balanced=True, collate=collate
    )
    for batch in mixed.loader(4):
        expected = torch.where(batch["domain"] == 1, 0.25, 1.0)
        assert torch.equal(batch["loss_weight"], expected)
    stream = MixedStream(mixed, batch_size=4, endless=False)
    assert sorted(item["loss_weight"] for item in stream) == [0.25] * 4 + [1.0] * 4


def test_dicts_with_the_values_of_an_item_have_its_weight() -> None:
    def to_sample(scan: Scan, rng: np.random.Generator) -> dict[str, Any]:
        return {**to_item(scan, rng), "first": scan.points[0]}

    mixed = MixedScans(REAL, SYNTHETIC, 0.5, loss_weight=0.25, to_sample=to_sample)
    [batch] = mixed.loader(8)
    expected = [mixed.loss_weight(i) for i in range(8)]
    assert batch["loss_weight"].tolist() == expected
    assert set(expected) == {0.25, 1.0}


def test_a_weighted_loss_moves_the_network_as_far_as_its_weights() -> None:
    mixed = MixedScans(REAL, SYNTHETIC, 0.5, loss_weight=0.1, collate="padded")
    scale = torch.ones(1, requires_grad=True)
    batch = mixed.collate([mixed[i] for i in range(len(mixed))])
    loss = (batch["loss_weight"] * scale).sum()
    loss.backward()
    assert scale.grad is not None
    assert scale.grad.item() == pytest.approx(4 * 1 + 4 * 0.1)


@pytest.mark.parametrize("wrong", [-0.1, 1.5, "much", {3: 0.5}, {0: -1}])
def test_other_weights_are_refused(wrong: Any) -> None:
    with pytest.raises(ConfigError, match="loss_weight"):
        MixedScans(REAL, SYNTHETIC, 0.5, loss_weight=wrong)


@pytest.mark.parametrize("wrong", [[0.5], [0.5, -1], np.array([0.5, 2])])
def test_other_weights_of_sources_are_refused(wrong: Any) -> None:
    with pytest.raises(ConfigError, match="weight"):
        Sources(SYNTHETIC, SYNTHETIC, loss_weights=wrong)


@pytest.mark.parametrize(
    ("schedule", "expected"),
    [
        (SyntheticFirst(8), [8] * 6 + [4] * 2 + [0] * 2),
        (SyntheticFirst(20), [8] * 15 + [4] * 4 + [0] * 3),
    ],
)
def test_a_named_schedule_ends_on_real_scans(
    schedule: SyntheticFirst, expected: list[int]
) -> None:
    mixed = MixedScans(REAL, SYNTHETIC, schedule, epoch_size=8)
    found = []
    for epoch in range(schedule.epochs + 2):
        mixed.set_epoch(epoch)
        found.append(sum(mixed.domain(i) for i in range(len(mixed))))
    assert found == expected
    assert make_schedule({"synthetic_first": schedule.epochs}) == schedule


@pytest.mark.parametrize("wrong", [{"epochs": 3}, {"epochs": 8, "share": 2}])
def test_a_schedule_needs_epochs_and_a_share(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        SyntheticFirst(**wrong)


def test_a_segmenters_default_takes_synthetic_scans_first(
    caplog: pytest.LogCaptureFixture,
) -> None:
    mixed = mix(REAL, SYNTHETIC, epochs=8)
    shares = []
    for epoch in range(8):
        mixed.set_epoch(epoch)
        assert len(mixed) == 100
        shares.append(sum(mixed.domain(i) for i in range(100)) / 100)
    assert shares == [1.0] * 6 + [0.5] * 2
    assert "measured" not in caplog.text
    given = mix(REAL, SYNTHETIC, 0.25, epochs=8)
    assert len(given) != 100 and given.mixture.ratio(0) == 0.25


@pytest.mark.slow
def test_a_segmenters_default_puts_persons_of_the_town_in_the_place_of_a_models() -> (
    None
):
    generated = load_generator("town").scans(0, [0, 1, 2])
    person = TRAIN_ID["person"]
    car = TRAIN_ID["car"]

    def keep(scan: Scan, rng: np.random.Generator) -> Scan:
        return scan

    made = mix(generated, generated, epochs=8, to_sample=keep)
    plain = mix(generated, generated, epochs=8, to_sample=keep, labels="generated")
    for index in range(6):
        before, after = plain[index], made[index]
        assert before.id == after.id and after.boxes is None
        assert (after.label == person).sum() > (before.label == person).sum() + 30
        # what stands behind a person is hidden
        assert (after.label == car).sum() > 0.7 * (before.label == car).sum()


@pytest.mark.parametrize("embreex", [True, False])
def test_persons_are_pasted_where_synthetic_scans_come_first(
    embreex: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if not embreex:
        monkeypatch.setattr(defaults, "find_spec", lambda name: None)
    [few, many] = (
        defaults.segmentation_options(range(n), 8, None, True) for n in (4, 41)
    )
    assert few["labels"] == (defaults.TOWN_OBJECTS if embreex else "generated")
    assert "labels" not in many
    assert ("without embreex" in caplog.text) is not embreex


QUARTER = [1.0] * 2 + [0.0] * 6


def ratios(mixed: MixedScans) -> list[float]:
    return [mixed.mixture.ratio(epoch) for epoch in range(8)]


def test_a_segmenters_default_ends_on_real_scans_where_they_are_many(
    caplog: pytest.LogCaptureFixture,
) -> None:
    some = mix([REAL[0]] * 25, SYNTHETIC, epochs=8)
    assert "more than 24 labelled scans (25 here)" in caplog.text
    assert some.mixture.ratio(5) == 1
    assert ratios(mix([REAL[0]] * 41, SYNTHETIC, epochs=8)) == QUARTER
    with pytest.raises(ConfigError, match="3 epochs.*at least 4"):
        mix([REAL[0]] * 41, SYNTHETIC, epochs=3)


def test_a_segmenters_default_needs_labels() -> None:
    blank = [replace(scan, label=None, instance=None) for scan in REAL]
    for real in (blank, Sources(REAL, blank)):
        with pytest.raises(ConfigError, match=r"without labels.*ratio=1\.0"):
            mix(real, SYNTHETIC, epochs=8)
    with pytest.raises(ConfigError, match="synthetic scans only have"):
        mix(REAL, blank, epochs=8)
    alone = mix(blank, SYNTHETIC, ratio=1.0, epoch_size=400)
    assert sum(alone.domain(i) for i in range(400)) == 400


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [("hdl64e_lasers", [1.0] * 6 + [0.5] * 2), ("os1_64", QUARTER)],
)
def test_a_segmenters_default_depends_on_lasers_and_not_on_grids(
    sensor: str, expected: list[float]
) -> None:
    """The shipped models are of ``hdl64e_lasers``, KITTI's datasets of the same device on another
    grid."""
    kitti, other = (
        Transfer(load_sensor(name)) for name in ("hdl64e_semantic_kitti", sensor)
    )
    mixed = mix([kitti(s) for s in REAL], [other(s) for s in SYNTHETIC], epochs=8)
    assert ratios(mixed) == expected


def test_settings_of_trainers_take_a_schedule_by_name() -> None:
    mixed = mix_for_trainer(
        8,
        {"synthetic": SYNTHETIC, "ratio": {"synthetic_first": 20}, "epoch_size": 8},
        lambda scan, rng: scan,
    )
    mixed.set_epoch(19)
    assert [mixed[i] for i in range(8)] != []
    assert sum(mixed.domain(i) for i in range(8)) == 0


def test_settings_name_the_folder_of_the_real_scans_that_a_policy_mixes_in(
    tmp_path: Path,
) -> None:
    writer = WRITERS["npz"](tmp_path)
    writer.write(REAL[0], 0)
    writer.finish()
    settings = {"synthetic": SYNTHETIC, "ratio": 0.5}

    def scans(real: Any) -> list[Any]:
        labels = {"lasermix": {"real": real}}
        mixed = mix_for_trainer(4, settings | {"labels": labels})
        return [mixed[i] for i in range(len(mixed)) if mixed.domain(i)]

    made = scans(str(tmp_path))
    assert len(made) == 4
    for found, wanted in zip(made, scans(REAL[:1]), strict=True):
        assert np.array_equal(found.points, wanted.points)


def test_settling_takes_the_statistics_of_its_batches_alone() -> None:
    network = torch.nn.Sequential(torch.nn.BatchNorm1d(1), torch.nn.ReLU())
    network[0].running_mean.fill_(9.0)
    batches = [{"points": torch.full((8, 1), float(value))} for value in (1, 3)]
    settled = settle(network, batches, lambda model, batch: model(batch["points"]))
    assert settled[0].running_mean.item() == 2.0
    assert network[0].running_mean.item() == 9.0
    assert not settled.training
    assert settled[0].momentum == network[0].momentum
    with pytest.raises(ConfigError, match="no batch"):
        settle(network, [])


def test_settling_leaves_the_layers_of_the_other_domain() -> None:
    layer = ByDomain(torch.nn.BatchNorm1d(1))
    layer.layers[1].running_mean.fill_(5.0)
    layer.layers[1].num_batches_tracked.fill_(7)
    layer.domain = torch.ones(4)  # of the last training batch
    settled = settle(layer, [torch.full((4, 1), -3.0)])
    assert [norm.running_mean.item() for norm in settled.layers] == [-3.0, 5.0]
    assert settled.layers[1].num_batches_tracked == 7
    assert layer.domain is not None


def test_an_evaluation_takes_the_real_layer_unless_domains_are_set() -> None:
    layer = ByDomain(torch.nn.BatchNorm1d(1))
    layer.layers[1].running_mean.fill_(5.0)
    x = torch.ones(4, 1)
    layer.domain = torch.ones(4)
    torch.nn.Sequential(layer).eval()
    assert torch.equal(layer(x), layer.layers[0](x))
    layer.domain = torch.ones(4)
    assert torch.equal(layer(x), layer.layers[1](x))


def test_each_domain_has_its_layer_and_its_statistics() -> None:
    layer = ByDomain(torch.nn.BatchNorm1d(2, momentum=1.0))
    x = torch.arange(12.0).reshape(6, 2)
    layer.domain = torch.tensor([0, 1, 0, 1, 1, 0])
    out = layer(x)
    for number in (0, 1):
        mine = layer.domain == number
        assert torch.allclose(out[mine].mean(0), torch.zeros(2), atol=1e-6)
        assert torch.equal(layer.layers[number].running_mean, x[mine].mean(0))
    layer.domain = None
    layer.eval()
    expected = (x - x[[0, 2, 5]].mean(0)) / x[[0, 2, 5]].var(0).add(1e-5).sqrt()
    assert torch.allclose(layer(x), expected)


def test_points_of_a_batch_need_a_domain_each() -> None:
    layer = ByDomain(torch.nn.Linear(4, 8))
    batch = next(iter(MixedScans(REAL, SYNTHETIC, 0.5).loader(4)))
    layer.domain = batch["domain"]
    with pytest.raises(ConfigError, match=r"4 domains for.*repeat_interleave"):
        layer(batch["points"])
    layer.domain = batch["domain"].repeat_interleave(batch["offsets"].diff())
    out = layer(batch["points"])
    start = int(batch["offsets"][3])
    last = layer.layers[int(batch["domain"][3])]
    assert torch.allclose(out[start:], last(batch["points"][start:]), atol=1e-5)


def test_domains_are_real_or_synthetic_and_a_batch_may_be_empty() -> None:
    layer = ByDomain(torch.nn.Linear(4, 8))
    layer.domain = torch.tensor([0, 1, 2])
    with pytest.raises(
        ConfigError, match=r"3 domains.*2 of them 0 or 1; .*0 real or 1"
    ):
        layer(torch.zeros(3, 4))
    layer.domain = torch.zeros(0)
    assert layer(torch.zeros(0, 4)).shape == (0, 8)


def test_reflectance_is_dropped_by_chance() -> None:
    rng = np.random.default_rng(0)
    scan = REAL[0]
    assert not drop_reflectance(scan, rng).reflectance.any()
    assert drop_reflectance(scan, rng, 0.0) is scan
    assert scan.reflectance.any()
    dropped = [drop_reflectance(scan, rng, 0.5) is not scan for _ in range(200)]
    assert 70 < sum(dropped) < 130


def test_a_ratio_takes_the_place_of_the_recipe_and_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def wrap(**options: Any) -> MixedScans:
        return MixedScans.wrap(
            range(8), SYNTHETIC, to_sample=lambda scan, rng: 0, **options
        )

    for make in (partial(mix, REAL, SYNTHETIC), wrap):
        assert ratios(make(ratio=0.5, epochs=8)) == [0.5] * 8
        assert caplog.text.count("epochs=8 has no effect beside ratio=0.5") == 1
        caplog.clear()
    assert ratios(wrap(epochs=8)) != ratios(wrap()) == [0.25] * 8
    assert "has no effect" not in caplog.text


def test_a_schedule_of_weights_that_is_too_short_is_named_before_the_epoch() -> None:
    mixed = MixedScans(REAL, SYNTHETIC, 0.5, loss_weight=[1.0, 0.1])
    mixed.set_epoch(1)
    with pytest.raises(ConfigError, match="^loss_weight in epoch 2; expected"):
        mixed.set_epoch(2)
    assert mixed.epoch == 1
    with pytest.raises(ConfigError, match=r"^loss_weight=\{0: 1, 3: 9\}; expected"):
        MixedScans(REAL, SYNTHETIC, 0.5, loss_weight={0: 1, 3: 9})


def test_a_wrapped_dataset_gets_the_recipe_too() -> None:
    """A trainer's settings with ``epochs`` are those of ``mix``, by the number of its samples."""
    few = mix(REAL, SYNTHETIC, epochs=8)
    settings = {"synthetic": SYNTHETIC, "epochs": 8}
    for count, like in (
        (len(REAL), few),
        (41, mix([REAL[0]] * 41, SYNTHETIC, epochs=8)),
    ):
        made = mix_for_trainer(count, settings, to_item)
        assert ratios(made) == ratios(like) and len(made) == len(like)
    other = {"as_sensor": "vlp16"}
    assert ratios(mix_for_trainer(4, settings | other, to_item)) == QUARTER
    given = MixedScans.wrap(
        range(4), SYNTHETIC, 0.25, to_sample=to_item, epochs=8, compare=False
    )
    assert given.mixture.ratio(0) == 0.25


def test_the_recipe_for_detectors_has_synthetic_scans_first_and_pastes_objects() -> (
    None
):
    mixed = mix(REAL, SYNTHETIC, task="detection", epochs=8)
    shares = []
    boxes = []
    for epoch in (0, 5, 6, 7):
        mixed.set_epoch(epoch)
        shares.append(sum(mixed.domain(i) for i in range(len(mixed))))
        items = [mixed[i] for i in range(len(mixed))]
        boxes += [len(item["boxes"]) for item in items]
        domains = [mixed.domain(i) for i in range(len(mixed))]
        assert [item["domain"] for item in items] == domains  # with pasted objects too
    assert shares == [4, 4, 2, 2]
    own = [len(scan.boxes) for scan in REAL + SYNTHETIC if scan.boxes is not None]
    assert np.mean(boxes) > np.mean(own)
    half = mix(REAL, SYNTHETIC, 0.5, task="detection", epochs=8)
    assert sum(half.domain(i) for i in range(len(half))) == 2


@pytest.mark.parametrize(
    "wrong", [{"task": "tracking"}, {"task": "detection"}, {"epochs": 3}]
)
def test_a_recipe_that_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"task|epochs"):
        mix(REAL, SYNTHETIC, **({"task": "detection"} | wrong))
