"""The readers that are fuzzed, one line each in ``TARGETS``: how to write a small valid dataset,
and how to read it.

Those of scans and banks are written here, all others in ``saved``.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import safetensors.torch
import torch
import yaml
from banks import SENSOR, some_image, write_bank
from layouts import some_camera, some_scan, write_kitti_raw, write_nuscenes
from lidar_synth.integrations.mixture import mix_for_trainer, read_settings
from mcap_files import cloud, record
from ouster_files import ouster_metadata
from pandaset_files import write_pandaset

from fuzzing import saved, trees
from lidar_synth.bank import ShardReader
from lidar_synth.files.disk import write_named_matrices
from lidar_synth.formats import READERS, WRITERS, layout_of, open_scans
from lidar_synth.generate.checkpoint import (
    VELOCITY,
    Header,
    NetworkSpec,
    load_checkpoint,
    read_header,
    save_checkpoint,
    weights_hash,
)
from lidar_synth.generate.models import build_network
from lidar_synth.geometry.normalize import NORMALISATIONS
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor

SCANS = 8
"""A reader of a dataset reads this many of its scans at most."""


@dataclass(frozen=True)
class Target:
    """A reader and what it is given.

    Args:
        make: writes a small valid dataset into a folder; the same bytes every time.
        read: reads the folder and returns all that it found, for ``checks``.
        files: patterns of the names of the files that are mutated.
        mend: makes checksums of the folder fit again after a mutation, where they can be; done for
            half of the cases.
        change: changes files and folders as such, in the place of the content of one file.
        writes: whether reading writes into the folder, which is then made anew for every case.
    """

    make: Callable[[Path], object]
    read: Callable[[Path], Any]
    files: tuple[str, ...] = ("*",)
    mend: Callable[[Path], object] | None = None
    change: Callable[[Path, Random], object] | None = None
    writes: bool = False


def scans(**fields: bool) -> list[Scan]:
    """Two scans of a small sensor, with boxes and poses."""
    made = [some_scan(i, SENSOR, 150) for i in range(2)]  # type: ignore[arg-type]
    for scan in made:
        scan.confidence = np.linspace(0, 1, len(scan), dtype=np.float32)
        scan.ring = (np.arange(len(scan)) % 8).astype(np.int16)
    return made


def write(to: str, root: Path) -> None:
    """Two scans in one of the package's formats, with a camera and its images where the format has
    a place for them."""
    writer = WRITERS[to](root, calibration=some_camera())
    image = np.full((13, 35, 3), 128, np.uint8)
    for index, scan in enumerate(scans()):
        writer.write(scan, index, image=image)
    writer.finish()


def some_rows() -> np.ndarray:
    """(N, 4) float32 x, y, z, reflectance of a scan, every point twice, one half behind the
    other."""
    scan = scans()[0]
    return np.tile(np.column_stack([scan.points, scan.reflectance])[:50], (2, 1))


def make_pcd(root: Path) -> None:
    """Binary as the package writes it; and, as other tools do, text and LZF."""
    write("pcd", root)
    rows = some_rows()
    told = f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\n"
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 "
        f"1 1\n{told}"
    )
    (root / "text.pcd").write_text(head + "DATA ascii\n" + lines_of(rows))
    columns = [column.tobytes() for column in rows.T.astype("<f4")]
    packed = b"".join(lzf(column[: len(column) // 2]) for column in columns)
    sizes = len(packed).to_bytes(4, "little") + sum(map(len, columns)).to_bytes(
        4, "little"
    )
    (root / "packed.pcd").write_bytes(
        head.encode() + b"DATA binary_compressed\n" + sizes + packed
    )


def lines_of(rows: np.ndarray) -> str:
    return "".join(" ".join(f"{value:g}" for value in row) + "\n" for row in rows)


def lzf(plain: bytes) -> bytes:
    """LZF of these bytes twice, one behind the other: runs of bytes as they are, then references to
    them."""
    runs = [plain[i : i + 32] for i in range(0, len(plain), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    back = len(plain) - 1
    assert len(plain) % 100 == 0, "the references are to 100 bytes each"
    return packed + bytes([7 << 5 | back >> 8, 100 - 9, back & 255]) * (
        len(plain) // 100
    )


def make_ply(root: Path) -> None:
    """Binary as the package writes it; and, as other tools do, text and the other order of bytes,
    with faces."""
    write("ply", root)
    rows = some_rows()
    fields = "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "intensity")
    )
    head = (
        f"ply\nformat {{}} 1.0\ncomment by hand\nelement vertex {len(rows)}\n{fields}"
    )
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (root / "text.ply").write_text(
        head.format("ascii") + faces + lines_of(rows) + "3 0 1 2\n"
    )
    body = rows.astype(">f4").tobytes() + b"\x03" + np.arange(3, dtype=">i4").tobytes()
    (root / "big.ply").write_bytes(
        (head.format("binary_big_endian") + faces).encode() + body
    )


def make_mcap(root: Path) -> None:
    """As the package writes it; and plain, without checksums, so that changes reach the points."""
    from mcap.writer import CompressionType

    write("mcap", root)
    messages = [("/points", number, cloud(number, 4, 9)) for number in range(2)]
    plain = CompressionType.NONE
    record(root / "driver.mcap", messages, compression=plain, enable_crcs=False)


def make_npy(root: Path) -> None:
    """Points as plain arrays."""
    root.mkdir()
    for index, scan in enumerate(scans()):
        np.save(root / f"{index}.npy", np.column_stack([scan.points, scan.reflectance]))


def make_range_arrays(root: Path) -> None:
    """Range images as others' arrays: range, range and reflectance, and six values a cell."""
    root.mkdir()
    image = some_image()
    assert image.reflectance is not None and image.label is not None
    xyz = SENSOR.ray_directions() * image.range[..., None]
    # 255 = ignore becomes 0 = unlabelled
    classes = (image.label + np.uint8(1)).astype(np.float32)
    np.save(root / "one.npy", image.range)
    np.save(root / "two.npy", np.stack([image.range, image.reflectance]))
    stack = np.dstack([xyz, image.reflectance, image.range, classes])
    np.save(root / "six.npy", stack.astype(np.float32))


def make_kitti_raw(root: Path) -> None:
    """A drive with tracklets and a day's calibration."""
    write_kitti_raw(root, 2)
    camera = some_camera()
    transform = camera.camera_from_sensor
    velo = {"R": transform[:3, :3], "T": transform[:3, 3]}
    cam = {
        "S_rect_02": np.array(camera.image_size),
        "R_rect_00": np.eye(3),
        "P_rect_02": camera.projection,
    }
    write_named_matrices(root / "2011_09_26" / "calib_velo_to_cam.txt", velo)
    write_named_matrices(root / "2011_09_26" / "calib_cam_to_cam.txt", cam)


def make_bank(root: Path) -> None:
    """Two shards with every array."""
    images = [some_image(i) for i in range(3)]
    write_bank(
        root,
        images,
        shard_size=2,
        fields=("reflectance", "label", "confidence"),
        provenance={"data": "none"},
    )


def make_sensors(root: Path) -> None:
    """One sensor with linear beams, one with a table of them."""
    root.mkdir()
    linear = {
        "rows": 8,
        "fov_up": 3.0,
        "fov_down": -25.0,
        "columns": 32,
        "range_min": 1.45,
        "range_max": 80.0,
    }
    table = {
        "elevations": [4.0, 2.5, 0.0, -10.0],
        "beams": [4.1, 2.4, 0.1, -9.0],
        "heights": [0.1, 0.1, 0.0, 0.0],
        "columns": 32,
        "range_min": 0.5,
        "range_max": 120.0,
        "description": "a table",
    }
    (root / "linear.yaml").write_text(yaml.safe_dump({"linear": linear}))
    (root / "grouped.json").write_text(json.dumps(ouster_metadata()))
    (root / "flat.json").write_text(json.dumps(ouster_metadata(flat=True)))
    (root / "table.yaml").write_text("# a comment\n" + yaml.safe_dump({"table": table}))


def make_checkpoint(root: Path) -> None:
    """A small velocity network with every key that a header has."""
    arguments = {
        "resolution": [8, 32],
        "channels": 7,
        "width": 16,
        "time_width": 8,
        "depths": [1, 1],
        "heads": [2, 2],
    }
    header = Header(
        networks={VELOCITY: NetworkSpec("hdit", arguments)},
        sensor=SENSOR,
        normalisation=NORMALISATIONS["r2flow"],
        channels=("range", "reflectance", "label"),
        time_grid=(1.0, 0.86, 0.58, 0.22, 0.0),
        provenance={
            "data": "none",
            "data_licence": "none",
            "licence": "MIT",
            "metrics": {"jsd": 0.1},
        },
        conditioning={"semantic": {"classes": 19}},
    )
    torch.manual_seed(0)
    network = build_network(
        "hdit", arguments | {"angles": torch.from_numpy(SENSOR.ray_angles())}
    )
    save_checkpoint(root / "model.safetensors", header, {VELOCITY: network})


def make_mixture(root: Path) -> None:
    """A bank, and the settings of a mixture with it that use every key."""
    write_bank(
        root / "bank",
        [some_image(i) for i in range(3)],
        fields=("reflectance", "label", "confidence"),
    )
    settings = {
        "synthetic": "bank",
        "ratio": {0: 0.5, 3: 0.25},
        "labels": {"generated": {"threshold": 0.3}},
        "seed": 7,
        "reuse": 2,
        "epoch_size": "add",
        "unboxed": "close",
        "as_sensor": None,
    }
    (root / "mix.yaml").write_text("# a comment\n" + yaml.safe_dump(settings))


def read_mixture(root: Path) -> list[Any]:
    """The synthetic scans of the first epochs of a mixture."""
    settings = read_settings(root / "mix.yaml")
    if settings.get("synthetic") == "bank":
        settings["synthetic"] = root / "bank"
    mixed = mix_for_trainer(4, settings, lambda scan, rng: scan)
    found: list[Any] = []
    for epoch in range(4):
        mixed.set_epoch(epoch)
        found += [mixed[i] for i in range(min(len(mixed), SCANS)) if mixed.domain(i)]
    return found


def make_described(root: Path) -> None:
    """Folders with a description of their scans: a full one, a short one, and two of earlier
    versions."""
    for name in ("full", "short", "town", "mark"):
        write("kitti", root / name)
        if name != "full":
            (root / name / "scans.json").unlink()
    (root / "short" / "scans.json").write_text(
        json.dumps({"format": "lidar-synth-scans/1", "sensor": "os1_128"})
    )
    (root / "town" / "town.json").write_text(
        json.dumps({"seed": 3, "interval": 0.1, "sensor": SENSOR.to_dict()})
    )
    (root / "mark" / "synthetic.json").write_text("{}")


def make_folders(root: Path) -> None:
    """A small dataset of each layout."""
    for name in FOLDERS:
        TARGETS[name].make(root / name)


def read_all(root: Path) -> list[Any]:
    """The scans of all datasets in a folder."""
    found: list[Any] = []
    for folder in sorted(root.iterdir()):
        source: Any = open_scans(folder)
        for index in range(min(len(source), SCANS)):
            found += [source[index], source.calibration(index)]
    return found


def read(layout: str, root: Path, **options: Any) -> list[Any]:
    """Scans, images and cameras of a dataset, through the reader and through what recognises its
    layout."""
    layout_of(root)
    source: Any = READERS[layout](root, **options)
    found: list[Any] = [source.sensor]
    for index in range(min(len(source), SCANS)):
        found += [source[index], source.calibration(index)]
        found += [source.image(index)] if hasattr(source, "image") else []
    return found


def read_shard(root: Path) -> list[Any]:
    """Every scan of a shard by itself, without an index that knows its size and hash."""
    found: list[Any] = []
    with ShardReader(root / "shard-00000.h5", "shard-00000.h5") as shard:
        for position in range(min(shard.entry.scans, SCANS)):
            found += [shard.encoding.decode(shard.read(position))]
            shard.condition(position)
    return found


def read_sensors(root: Path) -> list[Any]:
    """The sensors, after their rays were made."""
    found = [
        load_sensor(root / name)
        for name in ("linear.yaml", "table.yaml", "grouped.json", "flat.json")
    ]
    for sensor in found:
        sensor.ray_directions()
    return [*found]


def read_checkpoint(root: Path) -> list[Any]:
    """Header and networks."""
    path = root / "model.safetensors"
    return [read_header(path)[0], load_checkpoint(path)]


def mend_index(root: Path) -> None:
    """The sizes, hashes and checksum of a bank's index as its files are."""
    values = json.loads((root / "index.json").read_text())
    for entry in values["shards"]:
        content = (root / entry["file"]).read_bytes()
        entry |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    values.pop("checksum", None)
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    values["checksum"] = hashlib.sha256(text.encode()).hexdigest()
    (root / "index.json").write_text(json.dumps(values))


def mend_checkpoint(root: Path) -> None:
    """The sums of the weights and of the header as they are."""
    path = root / "model.safetensors"
    tensors = safetensors.torch.load_file(path)
    with safetensors.safe_open(path, "pt") as file:
        values = json.loads(file.metadata()["lidar_synth"])
    values["weights"] = weights_hash(tensors)
    values.pop("checksum", None)
    text = json.dumps(values, sort_keys=True, allow_nan=False)
    values["checksum"] = hashlib.sha256(text.encode()).hexdigest()
    safetensors.torch.save_file(tensors, path, {"lidar_synth": json.dumps(values)})


TARGETS: dict[str, Target] = {
    "bin": Target(partial(write, "kitti"), partial(read, "folder")),
    "npy": Target(make_npy, partial(read, "folder")),
    "npz": Target(partial(write, "npz"), partial(read, "folder")),
    "pcd": Target(make_pcd, partial(read, "folder")),
    "ply": Target(make_ply, partial(read, "folder")),
    "range": Target(partial(write, "range"), partial(read, "range")),
    "range_npy": Target(make_range_arrays, partial(read, "range", sensor=SENSOR)),
    "png": Target(partial(write, "png"), partial(read, "png")),
    "webdataset": Target(partial(write, "webdataset"), partial(read, "webdataset")),
    "mcap": Target(make_mcap, partial(read, "mcap")),
    "cosmos": Target(partial(write, "cosmos"), partial(read, "cosmos")),
    "semantic_kitti": Target(
        partial(write, "semantic_kitti"), partial(read, "semantic_kitti")
    ),
    "kitti_object": Target(
        partial(write, "kitti_object"), partial(read, "kitti_object")
    ),
    "kitti_raw": Target(make_kitti_raw, partial(read, "kitti_raw")),
    "kitti360": Target(partial(write, "kitti360"), partial(read, "kitti360")),
    "nuscenes": Target(partial(write_nuscenes, count=2), partial(read, "nuscenes")),
    "pandaset": Target(partial(write_pandaset, count=2), partial(read, "pandaset")),
    "bank": Target(
        make_bank, partial(read, "bank"), files=("*.h5", "index.json"), mend=mend_index
    ),
    "bank_index": Target(
        make_bank, partial(read, "bank"), files=("index.json",), mend=mend_index
    ),
    "bank_shard": Target(make_bank, read_shard, files=("shard-00000.h5",)),
    "sensor": Target(make_sensors, read_sensors),
    "mixture": Target(make_mixture, read_mixture, files=("mix.yaml",)),
    "checkpoint": Target(make_checkpoint, read_checkpoint, mend=mend_checkpoint),
    "archives": Target(
        saved.make_archives,
        saved.read_archives,
        files=("*.pth", "*.pt", "*.tar", "*.tgz"),
    ),
    "judges": Target(saved.make_judges, saved.read_judges, files=("*.yaml",)),
    "importers": Target(saved.make_importers, saved.read_importers, writes=True),
    "states": Target(
        saved.make_states, saved.read_states, mend=saved.mend_states, writes=True
    ),
    "objects": Target(saved.make_objects, saved.read_objects),
    "layouts": Target(saved.make_layouts, saved.read_layouts),
    "recipes": Target(saved.make_recipes, saved.read_recipes),
    "skins": Target(saved.make_skins, saved.read_skins, mend=saved.mend_skin),
    "scans_json": Target(make_described, read_all, files=("scans.json",)),
    "folders": Target(make_folders, read_all, files=(), change=trees.rearrange),
}
"""By name. A reader of ``READERS`` is read by ``partial(read, LAYOUT)``; a test sees that none is
left out."""

FOLDERS = (
    "bin",
    "npz",
    "range",
    "png",
    "webdataset",
    "semantic_kitti",
    "kitti_object",
    "kitti_raw",
    "kitti360",
    "nuscenes",
    "pandaset",
    "bank",
)
"""Targets of which ``folders`` has a dataset."""
