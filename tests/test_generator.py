"""The generator: a scan is a function of (checkpoint, condition, grid, seed, index); invalid
requests are refused."""

import copy
import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from conftest import random_scan
from hypothesis import given, settings
from PIL import Image
from small_models import GRID, SENSOR, write

import lidar_synth.generate.devices as devices
from lidar_synth.bake.job import make_plan
from lidar_synth.bake.options import BakeJob
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files import hub
from lidar_synth.files.hub import shipped_models
from lidar_synth.generate.checkpoint import (
    CODEC,
    VELOCITY,
    Header,
    NetworkSpec,
    save_checkpoint,
)
from lidar_synth.generate.conditions import GAP, bridge_gaps
from lidar_synth.generate.flow.solvers import solve, uniform_grid
from lidar_synth.generate.generator import Generator
from lidar_synth.generate.inpaint import check_model, inpaint
from lidar_synth.generate.loading import load_generator
from lidar_synth.generate.models import NETWORKS, build_network
from lidar_synth.generate.models.network import Autoencoder
from lidar_synth.geometry.normalize import CHANNELS, NORMALISATIONS
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import SYNTHETIC, RangeImage
from lidar_synth.lab.town import Town
from lidar_synth.noise import gaussian


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("generator") / "small.safetensors")


@pytest.fixture(scope="module")
def generator(path: Path) -> Generator:
    return load_generator(path)


def test_images_are_the_solution_of_the_flow_from_the_documented_noise(
    generator: Generator,
) -> None:
    noise = gaussian(5, [3, 9], (generator.tensors.size, *SENSOR.shape))
    with torch.inference_mode():
        expected = generator.tensors.to_images(
            solve(generator.network, noise, GRID), SENSOR
        )
    images = generator.range_images(5, [3, 9])
    for image, other in zip(images, expected, strict=True):
        assert np.allclose(image.range, other.range, atol=1e-3)
        assert set(image.channels) == {"reflectance", "label", "confidence"}
        assert (image.label[~image.mask] == IGNORE).all()
        assert (image.channels["confidence"][~image.mask] == 0).all()
    assert 0.05 < images[0].mask.mean() < 0.95
    assert not np.array_equal(images[0].range, images[1].range)


@pytest.mark.slow
@settings(max_examples=10)
@given(
    indices=st.lists(st.integers(0, 2**62), min_size=1, max_size=5),
    batch=st.integers(1, 3),
)
def test_a_scan_does_not_depend_on_the_others_of_its_batch(
    generator: Generator, indices: list[int], batch: int
) -> None:
    together = torch.cat(list(replace(generator, batch=batch).samples(7, indices)))
    for i, index in enumerate(indices):
        alone = torch.cat(list(generator.samples(7, [index])))
        assert (together[i] - alone[0]).abs().max() <= 1e-4


def test_the_batch_size_limits_the_scans_solved_at_once(generator: Generator) -> None:
    sizes = [len(tensor) for tensor in replace(generator, batch=3).samples(0, range(7))]
    assert sizes == [3, 3, 1]
    assert generator.range_images(0, []) == []


def test_the_callers_precision_and_mode_do_not_change_scans(
    generator: Generator,
) -> None:
    [image] = generator.range_images(0, [3])
    hole = image.range > 10
    [drawn] = inpaint(generator, [image], [hole], 1, [0])
    with torch.autocast("cpu", torch.bfloat16):
        for _ in generator.samples(0, [3]):
            assert torch.is_autocast_enabled("cpu")
            assert not torch.is_inference_mode_enabled()
        [same] = generator.range_images(0, [3])
        [redrawn] = inpaint(generator, [image], [hole], 1, [0])
    assert np.array_equal(image.range, same.range)
    assert np.array_equal(drawn.range, redrawn.range)


def test_scans_are_the_returns_of_the_images(generator: Generator) -> None:
    [image], [scan] = generator.range_images(2, [11]), generator.scans(2, [11])
    assert (scan.id, scan.domain, scan.sensor) == ("small/2/11", SYNTHETIC, SENSOR)
    assert len(scan) == image.mask.sum()
    assert np.array_equal(scan.label, image.label[image.mask])
    assert np.array_equal(scan.confidence, image.channels["confidence"][image.mask])
    # Every return is projected into its own cell.
    assert np.array_equal(project(scan).mask, image.mask)


def test_an_unknown_sampling_option_is_refused(generator: Generator) -> None:
    for call in (generator.scans, generator.range_images):
        with pytest.raises(TypeError, match="unexpected keyword argument 'step'"):
            call(0, [0], step=2)


def test_arguments_that_are_no_numbers_of_scans_are_refused(path: Path) -> None:
    for batch in (0, -1, 2.5):
        with pytest.raises(
            ConfigError, match=f"batch {batch}; expected a whole number"
        ):
            load_generator(path, batch=batch)  # type: ignore[arg-type]
    for dtype in ("float16", torch.int8):
        with pytest.raises(ConfigError, match="a floating-point type"):
            load_generator(path, dtype=dtype)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"indices=3; expected a list of them, \[3\]"):
        load_generator(path).scans(0, 3)  # type: ignore[arg-type]


def test_steps_and_solver_replace_the_checkpoints_own_grid(
    generator: Generator,
) -> None:
    noise = gaussian(0, [0], (generator.tensors.size, *SENSOR.shape))
    known = (1.0, 0.3, 0.0)
    trained = replace(generator, header=replace(generator.header, other_grids=(known,)))
    own = len(GRID) - 1
    assert own == 3
    for made_by, steps, solver, grid in (
        (generator, 2, "euler", uniform_grid(2)),
        (generator, 5, "heun", uniform_grid(5)),
        (generator, own, "euler", GRID),
        (trained, 2, "euler", known),
        (trained, 5, "euler", uniform_grid(5)),
    ):
        [tensor] = made_by.samples(0, [0], steps=steps, solver=solver)
        with torch.inference_mode():
            assert torch.allclose(
                tensor, solve(generator.network, noise, grid, solver), atol=1e-5
            )
    match = torch.rand(2, *noise.shape[1:3]).tolist()
    header = replace(trained.header, matches={"2": match})
    matched = replace(trained, header=Header.from_dict(header.to_dict()))
    [tensor] = matched.samples(0, [0], steps=2)
    [other] = matched.samples(0, [0], times=uniform_grid(2))
    with torch.inference_mode():
        state = solve(generator.network, noise, known)
        assert torch.allclose(other, solve(generator.network, noise, uniform_grid(2)))
    scale, shift = torch.tensor(match)[..., None]
    assert torch.allclose(tensor, state * scale + shift, atol=1e-5)
    given = (1.0, 0.9, 0.4, 0.0)
    [tensor] = generator.samples(0, [0], times=given)
    with torch.inference_mode():
        wanted = solve(generator.network, noise, given, "euler")
    assert torch.allclose(tensor, wanted, atol=1e-5)
    for wrong in ((1, 0.5), (1, 0.2, 0.4, 0), (1, 0.5, 0.5, 0), (), ("1", "a")):
        with pytest.raises(ConfigError, match=r"descending times from 1 to 0"):
            list(generator.samples(0, [0], times=wrong))
    with pytest.raises(ConfigError, match="one of the two"):
        list(generator.samples(0, [0], times=given, steps=2))
    for steps in (0, 2.5):
        with pytest.raises(ConfigError, match=f"steps {steps}; expected a whole"):
            generator.scans(0, [0], steps=steps)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="solver 'rk4'"):
        generator.scans(0, [0], solver="rk4")


@pytest.mark.parametrize("channels", [("range",), ("range", "reflectance")])
def test_scans_have_the_channels_of_the_checkpoint(
    channels: tuple[str, ...], tmp_path: Path
) -> None:
    generator = load_generator(write(tmp_path / "few.safetensors", channels))
    [image], [scan] = generator.range_images(0, [0]), generator.scans(0, [0])
    assert set(image.channels) == set(channels) - {"range"}
    assert (scan.label, scan.confidence) == (None, None)


def test_lower_precision_stays_close(path: Path, generator: Generator) -> None:
    rough = load_generator(path, dtype=torch.bfloat16)
    [a], [b] = generator.samples(0, [0]), rough.samples(0, [0])
    assert b.dtype == torch.float32
    assert 0 < (a - b).abs().mean() < 0.05


def label_maps(count: int) -> np.ndarray:
    return (
        np.random.default_rng(0)
        .choice([0, 8, 18, IGNORE], (count, *SENSOR.shape))
        .astype(np.uint8)
    )


def test_arrays_tensors_and_dictionaries_are_accepted_as_conditions(
    tmp_path: Path, generator: Generator
) -> None:
    conditioned = load_generator(
        write(tmp_path / "conditioned.safetensors", ("range",), 0.0)
    )
    many = label_maps(3)
    with torch.device("meta"):  # the trainer's default device
        same = conditioned.range_images(0, [4, 4], many[0])
    assert np.allclose(same[0].range, same[1].range, atol=1e-3)
    images = conditioned.range_images(0, [4, 4, 4], torch.from_numpy(many))
    [third] = conditioned.range_images(0, [4], {"semantic": many[2], "camera": None})
    assert np.allclose(images[2].range, third.range, atol=1e-3)
    assert not np.allclose(images[0].range, third.range, atol=1e-3)
    with pytest.raises(
        DataError,
        match=r"of shape \(8, 16\); expected \(8, 32\) for all scans, or \(1, 8, 32\)",
    ):
        conditioned.scans(0, [0], np.zeros((8, 16), np.uint8))
    with pytest.raises(DataError, match="no condition for 'conditioned'"):
        conditioned.scans(0, [0])
    assert conditioned.scans(0, [], condition=[]) == []
    with pytest.raises(ConfigError, match="the model is unconditional"):
        generator.scans(0, [0], many[0])
    assert (generator.condition, conditioned.condition) == (None, "semantic")


def test_a_label_map_also_labels_the_generated_scan(
    tmp_path: Path, generator: Generator
) -> None:
    conditioned = load_generator(
        write(tmp_path / "conditioned.safetensors", ("range", "reflectance"), 0.0)
    )
    assert (
        conditioned.fields == {"reflectance", "label", "confidence"} == generator.fields
    )
    [labels] = label_maps(1)
    [image], [scan] = (
        conditioned.range_images(0, [1], labels),
        conditioned.scans(0, [1], labels),
    )
    assert image.mask.any() and not image.mask.all()
    assert np.array_equal(image.label, np.where(image.mask, labels, IGNORE))
    assert np.array_equal(
        image.channels["confidence"], (image.label != IGNORE).astype(np.float32)
    )
    assert np.array_equal(scan.label, labels[image.mask])


def test_real_scans_provide_their_labels_as_conditions(tmp_path: Path) -> None:
    conditioned = load_generator(
        write(tmp_path / "conditioned.safetensors", ("range",), 0.0)
    )
    scans = [random_scan(SENSOR, 400, seed) for seed in range(2)]
    maps = np.stack(
        [
            bridge_gaps(project(scan, SENSOR, ["label"]).channels["label"])
            for scan in scans
        ]
    )
    for a, b in zip(
        conditioned.scans(0, [1, 2], scans),
        conditioned.scans(0, [1, 2], maps),
        strict=True,
    ):
        assert np.array_equal(a.points, b.points)
    [a], [b] = conditioned.scans(0, [1], scans[1]), conditioned.scans(0, [1], maps[1])
    assert np.array_equal(a.points, b.points)


@pytest.mark.parametrize("seed", range(3))
def test_narrow_gaps_of_a_label_map_are_closed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = np.where(
        rng.random((8, 64)) < 0.5, IGNORE, rng.integers(0, 19, (8, 64))
    ).astype(np.uint8)
    given = labels.copy()
    made = bridge_gaps(labels)
    assert np.array_equal(labels, given)
    for row, out in zip(labels, made, strict=True):
        known = np.flatnonzero(row != IGNORE)
        for i in np.flatnonzero(row == IGNORE):
            left = ((i - known) % 64).min()
            right = ((known - i) % 64).min()
            wanted = IGNORE
            if left + right - 1 <= GAP:
                wanted = (
                    row[(i - left) % 64] if left <= right else row[(i + right) % 64]
                )
            assert out[i] == wanted
        assert np.array_equal(out[known], row[known])


def test_guidance_interpolates_between_blank_and_given_condition(
    tmp_path: Path,
) -> None:
    guided = load_generator(write(tmp_path / "guided.safetensors", ("range",), 0.1))
    maps = label_maps(2)
    [plain] = guided.samples(0, [1], maps[0], guidance=1.0)
    [more] = guided.samples(0, [1], maps[0], guidance=2.0)
    [nothing] = guided.samples(0, [1], np.full_like(maps[0], IGNORE))
    [none] = guided.samples(0, [1], maps[0], guidance=0.0)
    assert torch.allclose(none, nothing, atol=1e-4)
    assert not torch.allclose(plain, more, atol=1e-2)
    many = torch.cat(
        list(replace(guided, batch=2).samples(0, [1, 5], maps, guidance=2.0))
    )
    assert torch.allclose(many[0], more[0], atol=1e-4)
    for wrong in (float("nan"), -1, 101):
        with pytest.raises(ConfigError, match=f"guidance {wrong}; expected 0 to 100"):
            next(guided.samples(0, [1], maps[0], guidance=wrong))
    never = load_generator(write(tmp_path / "never.safetensors", ("range",), 0.0))
    with pytest.raises(
        ConfigError,
        match="guidance 2.0 for 'never'; expected 1: .*trained without blank conditions",
    ):
        never.scans(0, [1], maps[0], guidance=2.0)


def test_models_are_found_by_shipped_name_or_by_path(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "weights").mkdir()
    monkeypatch.setattr(hub, "files", lambda package: tmp_path)
    with pytest.raises(
        ConfigError,
        match=r"model 'town'; expected a shipped one \(none in this installation\)",
    ):
        load_generator("town")
    (tmp_path / "weights" / "town.safetensors").write_bytes(path.read_bytes())
    assert load_generator("town").scans(0, [True])[0].id == "town/0/1"
    with pytest.raises(
        ConfigError,
        match=r"model 'city'; expected a shipped one \(town\), a .safetensors file or hf:",
    ):
        load_generator("city")
    with pytest.raises(FileError, match="nowhere"):
        load_generator(tmp_path / "nowhere.safetensors")
    with pytest.raises(ConfigError, match=r"\.pth"):
        load_generator(tmp_path / "peer.pth")


CODECS = {
    "vqvae": {
        "latent_channels": 4,
        "codes": 16,
        "width": 8,
        "multipliers": [1, 2],
        "strides": [[1, 2]],
        "blocks": 1,
        "attention": False,
        "groups": 4,
    },
    "surfaces": {
        "latent_channels": 4,
        "encoder_widths": [8, 8],
        "widths": [8, 8],
        "reaches": [1],
        "depth": 1,
    },
}


def write_latent(path: Path, architecture: str) -> Path:
    """Write a latent model with random weights."""
    given = {"resolution": SENSOR.shape, "channels": 7}
    codec = NetworkSpec(architecture, given | CODECS[architecture])
    torch.manual_seed(0)
    needed = (
        {"angles": torch.from_numpy(SENSOR.ray_angles())}
        if NETWORKS[architecture].needs_ray_angles
        else {}
    )
    autoencoder = build_network(architecture, codec.arguments | needed)
    channels, *resolution = autoencoder.latent_shape
    arguments = {
        "resolution": resolution,
        "channels": channels,
        "width": 16,
        "time_width": 16,
        "depths": (1,),
        "heads": (2,),
        "patch": (1, 1),
        "window": (1, 1),
    }
    flow = build_network("hdit", arguments | {"angles": torch.zeros(2, *resolution)})
    header = Header(
        networks={VELOCITY: NetworkSpec("hdit", arguments), CODEC: codec},
        sensor=SENSOR,
        channels=tuple(CHANNELS),
        normalisation=NORMALISATIONS["r2flow"],
        time_grid=GRID,
        provenance={"data": "none", "data_licence": "none", "licence": "MIT"},
    )
    save_checkpoint(path, header, {VELOCITY: flow, CODEC: autoencoder})
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    "architecture",
    [name for name, cls in NETWORKS.items() if issubclass(cls, Autoencoder)],
)
def test_compile_compiles_the_decoder_too(
    architecture: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Uses a backend that counts graphs and convolutions; the default backend needs a C++
    compiler."""
    graphs: list[int] = []

    def counting(graph: torch.fx.GraphModule, inputs: object) -> object:
        graphs.append(sum("conv" in str(node.target) for node in graph.graph.nodes))
        return graph.forward

    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=counting))
    path = write_latent(tmp_path / "latent.safetensors", architecture)
    compiled = load_generator(path, compile=True)
    eager = load_generator(path)
    z = torch.randn(1, *eager.codec.shape)
    uniform_noise = torch.full((1, eager.codec.draws, *SENSOR.shape), 0.4)
    given = uniform_noise if eager.codec.draws else None
    torch.testing.assert_close(
        compiled.codec.decode(z, given), eager.codec.decode(z, given)
    )
    assert sum(graphs) >= 5
    before = len(graphs)
    compiled.scans(0, [0])
    assert len(graphs) > before  # those of the flow
    for copied in (copy.deepcopy(compiled), pickle.loads(pickle.dumps(compiled))):
        for parameter in copied.autoencoder.parameters():
            torch.nn.init.zeros_(parameter)
        decoded = copied.codec.decode(z, given)
        assert not torch.allclose(decoded, eager.codec.decode(z, given))


def test_a_damaged_shipped_checkpoint_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """One byte could change the time grid or the range limit."""
    content = shipped_models()["town"].read_bytes()
    (tmp_path / "weights").mkdir()
    damaged = tmp_path / "weights" / "town.safetensors"
    for key in (b'range_max\\": 80.', b'time_grid\\": [1.0, 0.'):
        place = content.index(key) + len(key)
        damaged.write_bytes(content[:place] + b"9" + content[place + 1 :])
        monkeypatch.setattr(hub, "files", lambda package: tmp_path)
        with pytest.raises(DataError, match="does not match its checksum"):
            load_generator("town")


@pytest.mark.parametrize("device", ["gpu", "cuda:99", "meta", "cpu:1"])
def test_an_unavailable_device_is_refused(path: Path, device: str) -> None:
    with pytest.raises(
        ConfigError, match=rf"device '{device}'; expected an available one: cpu"
    ):
        load_generator(path, device=device)


def test_mps_is_refused_if_it_is_unavailable(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(
        ConfigError, match="device 'mps'; expected an available one: cpu"
    ):
        load_generator(path, device="mps")


@pytest.mark.slow
def test_the_shipped_models_generate_scans(tmp_path: Path) -> None:
    town = Town(1, scans=1)
    Image.fromarray(town.image(0)).save(tmp_path / "seen.png")
    real = replace(town[0], image_path=tmp_path / "seen.png")
    for name, file in shipped_models().items():
        assert file.stat().st_size <= 16e6
        generator = load_generator(name)
        [scan] = generator.scans(0, [0], real if generator.condition else None)
        assert scan.label is not None
        assert len(scan) > 10_000


def test_a_gpu_is_refused_if_it_is_unavailable_and_in_dataloader_workers(
    path: Path, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not torch.cuda.is_available():
        with pytest.raises(
            ConfigError, match="device 'cuda'; expected an available one: cpu"
        ):
            load_generator(path, device="cuda")
    monkeypatch.setattr(devices, "get_worker_info", lambda: SimpleNamespace(id=0))
    three_ways = r"\(A\) bake .*\(B\) a rolling .*\(C\) mix in"
    for device in ("cuda", "xpu:1", "mps"):
        with pytest.raises(ConfigError, match=three_ways):
            load_generator(path, device=device)
    monkeypatch.setattr(Generator, "device", torch.device("cuda"))
    with pytest.raises(ConfigError, match=three_ways):
        generator.scans(0, [0])
    monkeypatch.setattr(Generator, "device", torch.device("cpu"))
    assert generator.scans(0, [0])


def test_a_dense_model_generates_half_of_its_columns(tmp_path: Path) -> None:
    path = write_latent(tmp_path / "dense.safetensors", "surfaces")
    full = load_generator(path)
    half = load_generator(path, columns=SENSOR.columns // 2)
    assert half.sensor.columns == SENSOR.columns // 2 and full.sensor == SENSOR
    image = full.range_images(0, [3])[0]
    coarse = half.range_images(0, [3])[0]
    assert coarse.range.shape == (image.range.shape[0], image.range.shape[1] // 2)
    assert half.scans(0, [3])[0].sensor == half.sensor
    plans = [
        make_plan(tmp_path, BakeJob(model=str(path), count=2, columns=c))
        for c in (None, SENSOR.columns // 2)
    ]
    assert [plan.facts.sensor.columns for plan in plans] == [
        SENSOR.columns,
        SENSOR.columns // 2,
    ]
    assert [plan.facts.settings["columns"] for plan in plans] == [
        None,
        SENSOR.columns // 2,
    ]
    with pytest.raises(ConfigError, match="one of"):
        load_generator(path, columns=10)
    with pytest.raises(ConfigError, match="one of 2048, 1024"):
        load_generator("town", columns=512)


def test_a_drawn_hole_leaves_what_surrounds_it_on_the_grid_of_the_training() -> None:
    """Also for a model that decodes to fewer columns."""
    generator = load_generator("town", columns=1024)
    whole = load_generator("town")
    [image] = whole.range_images(seed=0, indices=[0], steps=1)
    hole = (image.range > 10) & (image.range < 15)
    bare = RangeImage(image.range, image.sensor)
    labels = image.channels["label"]
    labelled = RangeImage(image.range, image.sensor, {"label": labels})
    drawn, other = inpaint(
        generator, [bare, labelled], [hole, hole], seed=1, indices=[0, 0]
    )
    assert (drawn.channels["label"][~hole] == IGNORE).all()
    for name in ("reflectance", "confidence"):
        assert not drawn.channels[name][~hole].any()
    assert (drawn.channels["label"][hole & drawn.mask] != IGNORE).any()
    known = labels[~hole] != IGNORE
    assert np.array_equal(other.channels["confidence"][~hole], known)
    narrow = r"\(64 x 1024\) for a model of .*\(64 x 2048\)"
    with pytest.raises(DataError, match=narrow):
        check_model(generator, generator.sensor)
