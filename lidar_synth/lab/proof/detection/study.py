"""``prove_detection``: trainings of a detector on a few real scans, tested on places left out."""

import json
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from lidar_synth.errors import ConfigError, DataError, check_count, parsing, suggest
from lidar_synth.files.claims import claim
from lidar_synth.files.disk import hash_of_names, write_file
from lidar_synth.files.parsing import read_sealed, seal
from lidar_synth.formats import open_scans
from lidar_synth.formats.camera_boxes import CameraBoxes
from lidar_synth.generate.devices import check_device
from lidar_synth.geometry import Source
from lidar_synth.geometry.overlap import count_overlapping
from lidar_synth.lab.proof.arms import EPOCHS
from lidar_synth.lab.proof.detection.arms import (
    ARMS,
    BASE,
    OWN,
    DetectionArm,
    make_mixture,
)
from lidar_synth.lab.proof.detection.bev import Found, view
from lidar_synth.lab.proof.detection.boxes import detected
from lidar_synth.lab.proof.detection.network import (
    Detector,
    detect,
    train,
)
from lidar_synth.lab.proof.detection.page import body
from lidar_synth.lab.proof.detection.pools import draw_layouts, make_town
from lidar_synth.lab.proof.detection.scores import Truth
from lidar_synth.lab.proof.detection.summary import summarise
from lidar_synth.lab.proof.machine import command_line, machine
from lidar_synth.lab.proof.page import write_body
from lidar_synth.lab.proof.places import (
    Places,
    choose,
    find_places,
    names_of,
    refuse_skipping,
)
from lidar_synth.lab.proof.plan import count_scans
from lidar_synth.lab.train.segmentation import endless_batches
from lidar_synth.labels import ObjectBank

log = logging.getLogger(__name__)

RATE = 3e-3
MOST_OVERLAPPING = 0.1
"""Share of a scan's boxes that may overlap another of their class without a warning."""


@dataclass(frozen=True)
class DetectionSettings:
    """The settings of ``prove_detection``.

    Args:
        labelled: number of real scans with boxes that each training gets; all, if the places that
            a seed trains on have fewer.
        arms: names of ``ARMS``; "gt_sampling" is always among them.
        iterations: of each training.
        batch: scans of an iteration.
        seeds: repetitions, with other weights, order and scans. Two in a row exchange the halves
            of the places, so that each place is tested on once.
        places: how places are found: "auto" or a name of ``SPLITS``.
        synthetic: scans of the town.

    Raises:
        ConfigError: on an unknown arm, or numbers below 1.
    """

    labelled: int = 4
    arms: tuple[str, ...] = ("objects", "first", "town")
    iterations: int = 800
    batch: int = 2
    seeds: int = 2
    places: str = "auto"
    synthetic: int = 120

    def __post_init__(self) -> None:
        for name in ("labelled", "iterations", "batch", "seeds", "synthetic"):
            check_count(name, getattr(self, name), 1)
        if unknown := [name for name in self.arms if name not in ARMS]:
            raise ConfigError(
                f"arm {', '.join(map(repr, unknown))}",
                f"some of {', '.join(ARMS)}",
                suggest(unknown[0], ARMS),
            )

    @property
    def compared(self) -> list[str]:
        """The names of the arms, ``BASE`` included, in the order of ``ARMS``."""
        return [name for name in ARMS if name in {BASE, *self.arms}]


def with_boxes(source: Source) -> Source:
    """A source as detectors learn from it: of KITTI, the scans with boxes, in the camera's view;
    raises as ``refuse_skipping``."""
    refuse_skipping(source)
    return source.with_boxes() if isinstance(source, CameraBoxes) else source


def half_of(
    places: Places,
    seed: int,
) -> list[str]:
    """The names of the places that a seed tests on; seeds 2n and 2n + 1 share them out.

    Raises:
        ConfigError: on a negative seed.
    """
    names = sorted(places)
    order = np.random.default_rng(seed // 2).permutation(len(names))
    return sorted(names[i] for i in order[seed % 2 :: 2])


@dataclass
class DetectionWork:
    """The scans of a comparison, and where its results are kept.

    Args:
        source: real scans with boxes.
        settings: what is compared.
        out: the folder of results.
        pool: the folder of the town's scans; those of their layouts are beside it.
        device: on which the detector computes.
    """

    source: Source
    settings: DetectionSettings
    out: Path
    pool: Path
    device: str = "cpu"

    @cached_property
    def places(self) -> Places:
        """The places of the source."""
        return find_places(self.source, self.settings.places)

    @cached_property
    def town(self) -> Source:
        """Scans of the town by the sensor of the real scans; raises as ``make_town``."""
        return make_town(self.pool, self.source[0].sensor, self.settings.synthetic)

    @cached_property
    def generated(self) -> Source:
        """Scans of the layouts of the town's scans; raises as ``draw_layouts``."""
        return draw_layouts(self.pool.with_name(f"{self.pool.name}_layouts"), self.town)

    def synthetic(self, arm: DetectionArm) -> Source | None:
        """The synthetic scans of an arm; None if it has none."""
        if arm.ratio == 0:
            return None
        return self.generated if arm.generated else self.town

    @cached_property
    def objects(self) -> ObjectBank:
        """Objects of the town."""
        bank: ObjectBank = ObjectBank.from_town(self.source[0].sensor)
        return bank

    def labelled(self, seed: int) -> list[int]:
        """Indices of the scans that a seed trains on, from the places that it does not test."""
        held_out = half_of(self.places, seed)
        others = {n: i for n, i in self.places.items() if n not in held_out}
        rng = np.random.default_rng((seed, self.settings.labelled))
        count = min(self.settings.labelled, sum(map(len, others.values())))
        return choose(others, count, rng)

    def tested(self, seed: int) -> dict[str, list[int]]:
        """{place: indices of its scans} that a seed tests on."""
        return {name: self.places[name] for name in half_of(self.places, seed)}

    def path(
        self,
        arm: str,
        seed: int,
    ) -> Path:
        """The file of an outcome."""
        return self.out / "runs" / f"{arm}-{self.settings.labelled}-{seed}.json"

    def run(
        self,
        name: str,
        seed: int,
    ) -> dict[str, Any]:
        """Train and test one detector."""
        arm = ARMS[name]
        start = time.monotonic()
        torch.manual_seed(seed)
        network = Detector().to(self.device)
        labelled = [self.source[i] for i in self.labelled(seed)]
        epoch_size = self.settings.batch * max(1, self.settings.iterations // EPOCHS)
        objects = self.objects if set(arm.pasted) - {OWN} else None
        mixed = make_mixture(
            arm,
            labelled,
            self.synthetic(arm),
            objects,
            seed,
            epoch_size,
        )
        batches: Iterator[Any] = endless_batches(mixed, self.settings.batch)
        losses = train(
            network,
            batches,
            self.settings.iterations,
            RATE,
            name,
        )
        seconds = time.monotonic() - start
        return {
            "found": self._detect(network, seed),
            "losses": [float(part.mean()) for part in np.array_split(losses, 10)],
            "seconds": seconds,
        }

    def _detect(
        self,
        network: nn.Module,
        seed: int,
    ) -> dict[str, Any]:
        """{index of a tested scan: what is found in it}, as plain values."""
        indices = [i for part in self.tested(seed).values() for i in part]
        # One at a time: half of the places may be more than the memory holds.
        scans = (self.source[i] for i in indices)
        found = detect(network, (view(s.points, s.reflectance) for s in scans))
        return {
            str(index): {name: values.tolist() for name, values in vars(one).items()}
            for index, one in zip(indices, found, strict=True)
        }

    def outcome(
        self,
        arm: str,
        seed: int,
    ) -> dict[int, Found]:
        """{index of a tested scan: what a training found in it}.

        Raises:
            FileError: if the training is not there.
            DataError: if its file is damaged.
        """
        path = self.path(arm, seed)
        values = read_sealed(path, "the outcome of a training")
        with parsing(path, "what was detected", "Remove it."):
            return {int(i): _found(one) for i, one in values["found"].items()}


def _found(values: Mapping[str, Any]) -> Found:
    return Found(
        np.array(values["boxes"], np.float32).reshape(-1, 7),
        np.array(values["scores"], np.float32),
        np.array(values["classes"], np.int64),
    )


def prove_detection(
    scans: str | Path | Source,
    out: str | Path = "proof",
    settings: DetectionSettings | None = None,
    *,
    minutes: float = float("inf"),
    pools: str | Path | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Measure what the town adds to a few real scans with boxes, for a small detector.

    Half of the places are left out of each training and tested on. Run it again to resume, or to
    add arms and seeds.

    Args:
        scans: real scans with boxes: what ``open_scans`` opens, or a source. KITTI's are
            cropped to the camera's view (``KITTIObject.with_boxes``).
        out: folder to write to: outcomes, ``results.json`` and the page ``index.html``.
        settings: of the comparison.
        minutes: no training begins after so many.
        pools: folder of the town's scans, which several comparisons may share.
        device: on which the detector computes, such as "cuda".

    Returns:
        The values of ``results.json``.

    Raises:
        ConfigError: on settings that do not fit the scans, a device that is not there, or a folder
            with another comparison.
        DataError: on one place only, or scans without boxes.
    """
    check_device(device)
    start = time.monotonic()
    out = Path(out)
    settings = settings or DetectionSettings()
    source = with_boxes(open_scans(scans) if isinstance(scans, str | Path) else scans)
    work = DetectionWork(source, settings, out, Path(pools or out / "town"), device)
    truths = _truths(source)
    claim(out / "study.json", _identity(work))
    for seed in range(settings.seeds):
        for arm in settings.compared:
            path = work.path(arm, seed)
            if path.exists() or time.monotonic() - start > 60 * minutes:
                continue
            write_file(path, seal(work.run(arm, seed)))
    return report(work, truths)


def _truths(source: Source) -> dict[int, Truth]:
    """{index of a scan: its boxes}; warns of scans in which many overlap."""
    truths = {}
    for index in range(len(source)):
        scan = source[index]
        truths[index] = Truth.of(scan)
        boxes = detected(scan)
        count = count_overlapping(boxes)
        if count > MOST_OVERLAPPING * len(boxes):
            log.warning(
                f"{scan.id}: {count} of {len(boxes)} boxes overlap one of their class; if moving "
                "objects have a box at each place of their way, leave this scan out"
            )
    return truths


def describe(work: DetectionWork) -> str:
    """What would be trained and tested, in words, by a look at the boxes of the first scan.

    Raises:
        ConfigError, DataError: as ``find_places``; a DataError also on a scan without boxes.
    """
    settings = work.settings
    detected(work.source[0])
    counts = [f"{name} ({len(part)})" for name, part in work.places.items()]
    trainings = settings.seeds * len(settings.compared)
    lines = [
        f"{len(work.source)} scans in {len(counts)} places: {', '.join(counts)}",
        *(
            f"seed {seed}: {len(work.labelled(seed))} labelled scans, "
            f"tested on {', '.join(work.tested(seed))}"
            for seed in range(settings.seeds)
        ),
        f"{trainings} trainings of {settings.iterations} iterations of {settings.batch}:",
        *(f"  {name:<12}{ARMS[name].title}" for name in settings.compared),
    ]
    return "\n".join(lines)


def _identity(work: DetectionWork) -> dict[str, Any]:
    """Plain values that determine every training."""
    own = asdict(work.settings)
    for name in ("arms", "seeds", "labelled"):  # they add trainings
        del own[name]
    scans = hash_of_names(names_of(work.source))
    own |= getattr(work.source, "options", {})
    own["sensor"] = work.source[0].sensor.to_dict()
    # Protocol 1 had another schedule; 2 settled each network. Their folders are refused.
    return {"scans": scans, "protocol": 3, **own}


def report(
    work: DetectionWork,
    truths: Mapping[int, Truth],
) -> dict[str, Any]:
    """Summarise the trainings that are there, and write ``results.json`` and the page.

    Raises:
        DataError: if there is no seed with all arms.
    """
    names = work.settings.compared
    seeds = [
        seed
        for seed in range(work.settings.seeds)
        if all(work.path(name, seed).is_file() for name in names)
    ]
    if not seeds:
        raise DataError("no seed with trainings of all arms", "one", "Give more time.")
    found = {name: {seed: work.outcome(name, seed) for seed in seeds} for name in names}
    values = summarise(found, truths, {seed: work.tested(seed) for seed in seeds})
    values |= {
        "labelled": count_scans([len(work.labelled(s)) for s in seeds], "real scan"),
        "settings": asdict(work.settings),
        "sensor": work.source[0].sensor.name,
        "machine": machine(work.device),
        "date": time.strftime("%Y-%m-%d"),
        "command": command_line(),
    }
    name = f"results-{work.settings.labelled}.json"
    write_file(work.out / name, (json.dumps(values, indent=1) + "\n").encode())
    write_body(work.out / "index.html", body(values))
    return values
