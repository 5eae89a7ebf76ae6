"""The shipped weights in use: every source and label policy, mixed with the town and with real
scans."""

import json
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader

from lidar_synth import (
    MixedScans,
    RollingBank,
    SemanticKITTI,
    Source,
    Town,
    load_generator,
)
from lidar_synth.bank import Bank
from lidar_synth.bank.encoding import Encoding
from lidar_synth.cli.bake import bake
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import ConfigError
from lidar_synth.files.hub import shipped_models
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.generate.generator import Generated, Generator
from lidar_synth.geometry.layout.layout import CODES
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.lab.evaluate.conditions import sight_agreement
from lidar_synth.lab.town import STRETCH_FRAMES
from lidar_synth.labels import POLICIES

SCANS = 3
FIELDS = ("reflectance", "label", "confidence")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def generator() -> Generator:
    return load_generator("town")


def test_models_load_without_the_compiler_of_torch_and_draw_nothing() -> None:
    """The compiler's import takes longer than all else."""
    code = """if True:
        import sys
        import torch
        from lidar_synth.files.hub import shipped_models
        from lidar_synth.generate.loading import load_generator
        before = torch.get_rng_state()
        for name in shipped_models():
            load_generator(name)
        assert torch.equal(torch.get_rng_state(), before)
        assert not {"torch._dynamo", "sympy"} & sys.modules.keys()
    """
    subprocess.run([sys.executable, "-c", code], check=True)


def test_another_default_dtype_changes_no_scan() -> None:
    generator = load_generator("town-layout", columns=1024)
    layout = np.zeros((5, *generator.header.sensor.shape), np.uint8)
    layout[:4] = [[[CODES["Car"]]], [[40]], [[0]], [[7]]]
    [expected] = generator.samples(0, [0], layout, steps=1)
    torch.set_default_dtype(torch.bfloat16)
    try:
        [image] = generator.samples(0, [0], layout, steps=1)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(image, expected)


@pytest.mark.parametrize("columns", [2048, 1024])
def test_returns_of_a_label_map_have_its_labels(columns: int) -> None:
    street = Town(3, "hdl64e_lasers", 1, motion=False)[0]
    generator = load_generator("town-semantic", columns=columns)
    wanted = project(street, generator.sensor, ["label"])
    for steps in (4, 1):
        [image] = generator.range_images(0, [0], street, steps=steps)
        known = image.mask & wanted.mask & (wanted.label != IGNORE)
        assert known.sum() > 0.8 * wanted.mask.sum()
        same = (image.label == wanted.label)[known].mean()
        # A column that stands for two has the label of one.
        assert same == 1 or (columns == 1024 and same > 0.9)
        near = np.abs(image.range - wanted.range)[known] < 0.05 * wanted.range[known]
        assert near.mean() > 0.5  # it stands where the map's scan stood, roughly


def test_an_ordinary_pickle_leaves_the_weights_where_they_are(
    generator: Generator,
) -> None:
    places = [p.data_ptr() for p in generator.network.parameters()]
    pickle.dumps(generator)
    assert [p.data_ptr() for p in generator.network.parameters()] == places


def first_range(generators: list[Generator]) -> Any:
    return generators[0].range_images(0, [1], steps=1)[0].range


@pytest.mark.slow
def test_two_generators_go_into_a_worker_that_is_not_forked(
    generator: Generator,
) -> None:
    """Of a fork server, which takes 250 descriptors: the default since Python 3.14."""
    before = len(pickle.dumps(generator))
    two = [generator, load_generator("town")]
    loader = DataLoader(
        two,  # type: ignore[arg-type]
        num_workers=1,
        collate_fn=first_range,
        multiprocessing_context="forkserver",
    )
    expected = first_range([load_generator("town")])
    assert [np.array_equal(made, expected) for made in loader] == [True, True]
    assert len(pickle.dumps(generator)) == before
    assert np.array_equal(first_range([generator]), expected)


@pytest.mark.slow
def test_scans_follow_their_images(tmp_path: Path) -> None:
    town = Town(3, "hdl64e_lasers", 6 * STRETCH_FRAMES, motion=False)
    streets = []
    for i in range(0, len(town), STRETCH_FRAMES):
        Image.fromarray(town.image(i)).save(path := tmp_path / f"{i}.png")
        streets.append(replace(town[i], image_path=path))
    generator = load_generator("town-camera")
    # the same noise for all
    made = [generator.scans(0, [0], scan, steps=2)[0] for scan in streets]
    assert made[0].sensor == streets[0].sensor
    own, other = (
        sight_agreement(made, some).value
        for some in (streets, [*streets[1:], streets[0]])
    )
    assert own > other + 0.02


@pytest.fixture(scope="module")
def sources(
    generator: Generator, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Any]]:
    """The same scans from every kind of source."""
    folder = tmp_path_factory.mktemp("shipped") / "bank"
    bake(folder, count=SCANS, model="town", seed=0)
    with RollingBank("town", seed=0, slots=SCANS, threads=1) as rolling:
        held = generator.scans(0, range(SCANS))
        yield {
            "generator": Generated(generator, seed=0),
            "bank": Bank(folder),
            "rolling": rolling,
            "list": held,
        }


@pytest.fixture(scope="module", params=["the town", "SemanticKITTI"])
def real(request: pytest.FixtureRequest) -> Source:
    if request.param == "the town":
        town = Town(5, "hdl64e_lasers", SCANS)
        return [town[i] for i in range(SCANS)]
    root = os.environ.get("LIDAR_SYNTH_REAL_SCANS")
    if not root:
        pytest.skip("LIDAR_SYNTH_REAL_SCANS is not set")
    source = SemanticKITTI(
        Path(root) / "semantic_kitti", sensor="hdl64e_lasers", split="train"
    )
    return [source[i] for i in range(SCANS)]


@pytest.mark.parametrize("name", shipped_models())
def test_shipped_weights_state_their_licence_and_no_local_paths(name: str) -> None:
    provenance = read_header(shipped_models()[name])[0].provenance
    assert (provenance["licence"], provenance["data_licence"][:3]) == ("MIT", "MIT")
    assert not re.search(r"[\"']/\w", json.dumps(provenance))


def sure(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """A teacher for pseudo labels with high confidence in half of the points."""
    return np.full(len(scan), 8, np.uint8), (np.arange(len(scan)) % 2).astype(
        np.float32
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bank", "rolling", "list"])
def test_every_source_gives_the_same_scan(
    kind: str, sources: dict[str, Any], generator: Generator
) -> None:
    encoding = Encoding(generator.sensor, FIELDS)
    for number in range(SCANS):
        scan = sources[kind][number]
        assert scan.domain == SYNTHETIC
        index = int(scan.id.split("/")[-1])
        given = encoding.encode(project(scan, generator.sensor, FIELDS))
        whole = encoding.encode(generator.range_images(0, [index])[0])
        for name, values in whole.items():
            assert (
                abs(given[name].astype(int) - values.astype(int)) <= 1
            ).mean() > 0.9999, (
                number,
                name,
            )


@pytest.mark.slow
# the shipped models generate no boxes
@pytest.mark.parametrize("policy", [p for p in POLICIES if p not in ("boxes", "paste")])
@pytest.mark.parametrize("kind", ["generator", "bank", "rolling", "list"])
def test_every_source_and_label_policy_mixes_with_real_scans(
    kind: str, policy: str, sources: dict[str, Any], real: Source
) -> None:
    train = MixedScans(
        real,
        sources[kind],
        0.5,
        labels={policy: {"teacher": sure} if policy == "pseudo" else {}},
        unlabelled="allow",
    )
    seen = {0: 0, 1: 0}
    for batch in DataLoader(train, 3, collate_fn=train.collate):
        for i, domain in enumerate(batch["domain"].tolist()):
            seen[domain] += 1
            label = batch["label"][batch["offsets"][i] : batch["offsets"][i + 1]]
            known = (label != IGNORE).float().mean()
            if domain and policy in ("none", "ignore"):
                assert known == 0
            elif domain and policy == "pseudo":
                assert set(torch.unique(label).tolist()) == {8, IGNORE}
            else:
                assert known > 0.5
    assert seen == {0: SCANS, 1: SCANS}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["generator", "bank", "rolling", "list"])
def test_no_source_has_boxes_for_detectors(
    kind: str, sources: dict[str, Any], real: Source
) -> None:
    with pytest.raises(ConfigError, match="labels='boxes'"):
        MixedScans(real, sources[kind], 0.5, labels="boxes", unlabelled="allow")
