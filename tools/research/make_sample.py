"""Write the bank of recorded scans that ships with the package (``sample_scans``).

    python tools/research/make_sample.py FRAMES [OUT]

FRAMES is a folder of Pandar64 scans from PandaSet as NN.npz (points, reflectance 0..255, label,
boxes, box_names) in the sensor's frame. OUT is lidar_synth/samples/pandaset by default.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from typer import run

from lidar_synth.bake.folder import write_bank_files
from lidar_synth.bank import Entry, Facts, Index, ShardWriter
from lidar_synth.datasets.classes import PANDASET
from lidar_synth.datasets.recordings import frames_of
from lidar_synth.files.disk import sha256
from lidar_synth.files.parsing import read_arrays
from lidar_synth.formats.pandaset_cuboids import BOXES
from lidar_synth.generate.boxed import add_boxes
from lidar_synth.geometry import Boxes, RangeImage, Scan, load_sensor
from lidar_synth.geometry.projection import project

SAMPLE = Path("lidar_synth/samples/pandaset")
SENSOR = load_sensor("pandar64")
FRAMES = range(0, 80, 10)
SEQUENCE = "002"
TERMS = (
    "PandaSet by Scale AI (https://scale.com) and Hesai (https://www.hesaitech.com), "
    "https://pandaset.org, licensed CC BY 4.0 (https://creativecommons.org/licenses/by/4.0/) with "
    "PandaSet's Dataset Terms, which also cover what is derived from the data: attribute Scale AI "
    "and Hesai; do not use their names or marks beyond attribution; do not attempt to identify "
    "persons. Changes: motion compensation was undone, the points of the Pandar64 were put on the "
    "sensor's grid, classes were mapped to those of SemanticKITTI and KITTI, boxes without a "
    "return were left out. Scale AI and Hesai do not endorse this package."
)


def read_image(path: Path) -> RangeImage:
    """A frame on the grid of the sensor, with labels and the boxes that hold a return."""
    found = read_arrays(path)
    scan = Scan(
        found["points"],
        found["reflectance"].astype(np.float32) / 255,
        SENSOR,
        label=PANDASET.decode(found["label"], str(path)),
    )
    names = [BOXES[name] for name in found["box_names"].tolist()]
    kept = np.array([name is not None for name in names])
    boxes = Boxes(found["boxes"][kept], tuple(filter(None, names)))
    return add_boxes(project(scan), boxes)


def main(frames: Path, out: Path = SAMPLE) -> None:
    """Write the bank."""
    seen = frames_of("pandaset", [f"{SEQUENCE}/{n:02d}" for n in FRAMES])
    facts = Facts(
        sensor=SENSOR,
        fields=("reflectance", "label", "instance", "boxes"),
        model="pandaset",
        checkpoint="",
        settings={"sequence": SEQUENCE, "frames": list(FRAMES)},
        label_policy="annotated",
        licence="CC-BY-4.0",
        data_licence="CC BY 4.0 with PandaSet's Dataset Terms",
        provenance={
            "data": f"PandaSet by Scale AI and Hesai, sequence {SEQUENCE}, Pandar64",
            "terms": TERMS,
            "seen": seen.to_list(),
        },
    )
    entry = Entry("shard-00000.h5", int(SEQUENCE), 0, len(FRAMES))
    out.mkdir(parents=True, exist_ok=True)
    path = out / entry.file
    with ShardWriter(path, facts, entry) as writer:
        for number in FRAMES:
            writer.append(read_image(frames / f"{number:02d}.npz"))
    entry = replace(entry, bytes=path.stat().st_size, sha256=sha256(path))
    write_bank_files(out, Index((facts,), (entry,)))


if __name__ == "__main__":
    run(main)
