"""Export of a mixture as SemanticKITTI's or KITTI's folders, which every trainer reads.

The folders are complete: labels for every scan (some trainers read a missing ``.label`` as "car"),
and for detectors label_2, calib, image_2, planes and ImageSets, so that a trainer's stock loader
and converter read them.
"""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from lidar_synth.integrations.detection import ground_plane, plane_in_camera
from lidar_synth.integrations.mmdet3d_lists import write_plane
from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.claims import claim
from lidar_synth.files.disk import write_file
from lidar_synth.formats import KITTIObject
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.kitti_object import OBJECT_CAMERA, KITTIObjectWriter
from lidar_synth.formats.semantic_kitti import SPLITS, SemanticKITTIWriter
from lidar_synth.formats.writer import Writer
from lidar_synth.geometry import Scan, Source, identity_of, scan_hash
from lidar_synth.mixing import MixedScans

COMPARED = 3
"""Number of real, synthetic and validation scans by which a resumed export is compared with the one
it continues."""
MANIFEST = "mixture.csv"
SETTINGS = ".mixture.json"


def export_mixture(
    mixed: MixedScans,
    out: str | Path,
    layout: Literal["semantic_kitti", "kitti"],
    *,
    epoch: int = 0,
    calibration: Calibration | None = None,
    validation: Source | None = None,
    progress: bool = True,
) -> int:
    """Write all samples of a mixture in an epoch; a rerun resumes an interrupted export.

    Scans are numbered by their positions, in sequence 00 (the others of the training are empty) or
    in ``training``, the first also in ``testing``. ``mixture.csv`` lists frame, domain and id of
    each, and the plan's hash. Scans for validation become sequence 08, or follow the mixture's in
    ``training`` and are listed in ``ImageSets/val.txt``.

    Args:
        mixed: a mixture of scans, with ``to_sample=lambda scan, rng: scan``.
        out: output folder.
        layout: ``"semantic_kitti"`` or ``"kitti"`` (the object set).
        epoch: the epoch to write.
        calibration: camera 2, for ``"kitti"``; by default an ideal camera at the sensor.
        validation: real scans that are not in the mixture, for the trainer's validation.
        progress: whether to show a progress bar.

    Returns:
        Number of scans written by this run.

    Raises:
        ConfigError: on another layout, a mixture whose samples are not scans, or a folder with
            another mixture or epoch.
        DataError: on a scan without labels (``"semantic_kitti"``) or boxes (``"kitti"``).
        FileError: if the folder cannot be written.
    """
    if layout not in ("semantic_kitti", "kitti"):
        raise ConfigError(f"layout {layout!r}", "'semantic_kitti' or 'kitti'")
    root = Path(out)
    count = len(mixed)
    camera = calibration or OBJECT_CAMERA
    held_out = [] if validation is None else validation
    compared = [held_out[number] for number in range(min(COMPARED, len(held_out)))]
    claim(
        root / SETTINGS,
        {
            "plan": mixed.plan(epoch).hash,
            "samples": _first_samples(mixed, epoch),
            "layout": layout,
            "projection": camera.projection.tolist(),
            "camera_from_sensor": camera.camera_from_sensor.tolist(),
            "image": camera.image_size,
            "validation": None
            if validation is None
            else [identity_of(validation), *map(scan_hash, compared)],
        },
    )
    kitti = layout == "kitti"
    writer: Writer = KITTIObjectWriter(root) if kitti else SemanticKITTIWriter(root)
    rows = [f"frame,domain,id # plan {mixed.plan(epoch).hash}"]
    written = 0
    for position in tqdm(range(count), unit="scan", disable=not progress):
        scan = _sample(mixed, epoch, position)
        rows.append(f"{position:06d},{scan.domain},{scan.id}")
        written += _write(writer, scan, position, camera)
    first = count if kitti else 0
    others = writer if kitti else SemanticKITTIWriter(root, sequence="08")
    for number in tqdm(
        range(len(held_out)), "validation", unit="scan", disable=not progress
    ):
        scan = replace(held_out[number], id=f"validation {number}")
        written += _write(others, scan, first + number, camera)
    if kitti:  # the converters of OpenPCDet and MMDetection3D need a test split
        tests = KITTIObjectWriter(root, part="testing")
        _write(tests, _sample(mixed, epoch, 0), 0, camera)
    else:
        _add_sequences(root)
    writer.finish()
    if kitti and validation is not None:
        _write_split(root, "train", range(count))
        _write_split(root, "val", range(count, count + len(held_out)))
    write_file(root / MANIFEST, "".join(f"{row}\n" for row in rows).encode())
    return written


def _add_sequences(root: Path) -> None:
    """Make the folder of each training sequence: Pointcept, Open3D-ML and SPVNAS list them all."""
    for sequence in SPLITS["train"] or ():
        folder = root / "sequences" / sequence / "velodyne"
        folder.mkdir(parents=True, exist_ok=True)


def _write_split(root: Path, split: str, frames: range) -> None:
    """Write KITTI's list of the frames of a split."""
    listed = "".join(f"{frame:06d}\n" for frame in frames)
    write_file(root / "ImageSets" / f"{split}.txt", listed.encode())


def _write(writer: Writer, scan: Scan, number: int, camera: Calibration) -> int:
    """Write a scan with all files of the layout; returns the number of scans written, 0 if it
    exists."""
    if writer.complete(number):
        return 0
    kitti = isinstance(writer, KITTIObjectWriter)
    needed = "boxes" if kitti else "label"
    if getattr(scan, needed) is None:
        raise DataError(
            f"scan {scan.id!r} has no {needed}",
            f"{needed} for this layout",
            "Choose a label policy.",
        )
    if kitti:
        _write_plane(writer.root, f"{number:06d}", scan, camera)
    writer.write(scan, number, calibration=camera if kitti else None)
    return 1


def _sample(mixed: MixedScans, epoch: int, position: int) -> Scan:
    scan = mixed.sample(epoch, position)
    if not isinstance(scan, Scan):
        raise ConfigError(
            f"samples of the type {type(scan).__name__}",
            "scans: to_sample=lambda scan, rng: scan",
        )
    return scan


def _first_samples(mixed: MixedScans, epoch: int) -> list[str]:
    """Hashes of the first samples of each domain, which depend on the label policy and the
    augmentation; the plan does not."""
    synthetic = mixed.plan(epoch).domain
    first = [np.flatnonzero(kind)[:COMPARED] for kind in (~synthetic, synthetic)]
    return [scan_hash(_sample(mixed, epoch, int(n))) for n in np.concatenate(first)]


def write_planes(root: str | Path, split: str = "trainval") -> int:
    """Fit and write the ground planes that are missing in ``training/planes`` of KITTI's folder,
    for GT sampling.

    Returns:
        Number of planes written.

    Raises:
        DataError: on a scan without ground or calibration.
        FileError: if they cannot be written.
    """
    scans = KITTIObject(root, split)
    written = 0
    for number, name in enumerate(
        tqdm(scans.ids, "fitting planes", unit="scan", leave=False, disable=None)
    ):
        frame = name.split("/")[1]
        if not (Path(root) / "training" / "planes" / f"{frame}.txt").is_file():
            camera = scans.calibration(number)
            if camera is None:
                raise DataError(
                    f"scan {name} of {root} has no calibration",
                    f"training/calib/{frame}.txt",
                )
            _write_plane(Path(root), frame, scans[number], camera)
            written += 1
    return written


def _write_plane(root: Path, frame: str, scan: Scan, camera: Calibration) -> None:
    path = root / "training" / "planes" / f"{frame}.txt"
    write_plane(path, plane_in_camera(ground_plane(scan), camera))
