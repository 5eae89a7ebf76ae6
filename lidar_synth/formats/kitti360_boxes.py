"""KITTI-360's boxes: one XML per drive, in the world frame.

Each object (https://www.cvlibs.net/datasets/kitti-360/documentation.php, data_3d_bboxes) is a unit
cube, ``vertices``, that ``transform`` rotates, scales and moves into the world frame: its columns
are the axes of the box, scaled by its size. A moving object has one entry per frame, whose
``timestamp`` is the frame. A static object has one entry with timestamp -1; ``start_frame`` and
``end_frame`` bound the *window* of the drive, about 200 m, in which it was annotated. The file does
not contain the frames in which it is visible.

The reader therefore lists a static object in every frame whose sensor is within range of it, if its
window is at most ``MARGIN`` frames away. Cars of the next window thus appear before it begins, and
cars that parked at the same place at another time do not appear. Farther from all windows, boxes
are not known. ``Boxes`` has no tilt, so a box that is tilted relative to the sensor keeps only its
yaw.

``semanticId`` is not the id of the label images, but an older numbering (``OBJECTS``); drive 0004
has labels only.
"""

import xml.etree.ElementTree as ElementTree
from array import array
from collections.abc import Container, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import MAX_INSTANCES
from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import numbers, reading, write_file
from lidar_synth.geometry import FARTHEST, Boxes
from lidar_synth.geometry.arrays import Float64Array

MARGIN = 100
"""Maximum distance in frames (about 80 m) from an object's window at which the object is listed."""

OBJECTS = {
    13: ("car", 26, "Car"),
    14: ("truck", 27, "Truck"),
    15: ("trailer", 30, "Misc"),
    16: ("caravan", 29, "Misc"),
    17: ("motorcycle", 32, "Misc"),
    18: ("bicycle", 33, "Misc"),
    19: ("pedestrian", 24, "Pedestrian"),
    20: ("rider", 25, "Cyclist"),
    33: ("train", 31, "Tram"),
    34: ("bus", 28, "Misc"),
    36: ("unknownVehicle", 43, "Misc"),
}
"""{semanticId: (label, id in the label images, KITTI's name)} of the classes for detectors; all
others are skipped. Lossy: a rider's box does not include the bicycle, which has its own box."""

BY_LABEL = {label: semantic for semantic, (label, _, _) in OBJECTS.items()}

BY_NAME = {
    "Car": 13,
    "Van": 13,
    "Truck": 14,
    "Pedestrian": 19,
    "Person_sitting": 19,
    "Cyclist": 20,
    "Tram": 33,
    "Misc": 36,
    "DontCare": 37,
}
"""{KITTI's name: semanticId to write}. Lossy: vans become cars, and sitting persons pedestrians."""

NONE = Boxes(np.array([(0, 0, 0, 1, 1, 1, 0)]), ("DontCare",))
"""Written for a frame without boxes: of a class that is skipped, it says that there are none."""

CUBE = np.array(
    [
        (1, 1, 1),
        (1, 1, -1),
        (1, -1, 1),
        (1, -1, -1),
        (-1, 1, -1),
        (-1, 1, 1),
        (-1, -1, -1),
        (-1, -1, 1),
    ],
    np.float64,
)
"""(8, 3) twice the vertices of the unit cube, in the order of the dataset."""

FACES = "0 2 1 2 3 1 4 6 5 6 7 5 4 5 1 5 0 1 7 6 2 6 3 2 5 7 0 7 2 0 1 3 4 3 6 4"


@dataclass(frozen=True)
class WorldBoxes:
    """The objects of a drive.

    Args:
        transforms: (M, 4, 4) float64 from the unit cube to the world.
        names: (M,) KITTI's names.
        instances: (M,) int32.
        windows: (M, 2) int64 first and last frame in which an object may be listed; the same for a
            moving object.
        annotated: (K, 2) int64 first and last frames between which objects may be listed, whatever
            their class.
    """

    transforms: Float64Array
    names: NDArray[np.str_]
    instances: NDArray[np.int32]
    windows: NDArray[np.int64]
    annotated: NDArray[np.int64]

    def at(self, frame: int, pose: Float64Array, range_max: float) -> Boxes | None:
        """The boxes around one scan, in its sensor frame; None if no window covers the frame.

        Args:
            frame: number of the frame.
            pose: (4, 4) sensor to world.
            range_max: of the sensor, metres. Half the diagonal of an object may lie beyond it.
        """
        if not _cover(self.annotated, frame).any():
            return None
        now = _cover(self.windows, frame) & (
            np.linalg.norm(self.transforms[:, :3, 3] - pose[:3, 3], axis=1)
            <= range_max + np.linalg.norm(self.transforms[:, :3, :3], axis=(1, 2)) / 2
        )
        local = np.linalg.inv(pose) @ self.transforms[now]
        size = np.linalg.norm(local[:, :3, :3], axis=1)
        yaw = np.arctan2(local[:, 1, 0], local[:, 0, 0])
        return Boxes(
            np.column_stack([local[:, :3, 3], size, yaw]),
            tuple(self.names[now].tolist()),
            instance=self.instances[now],
        )


def _cover(spans: NDArray[np.int64], frame: int) -> NDArray[np.bool_]:
    return (spans[:, 0] <= frame) & (frame <= spans[:, 1])


def read_boxes(path: Path) -> WorldBoxes:
    """Read the objects of a drive's XML file whose classes are in ``OBJECTS``.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is not a file of KITTI-360, or an object's vertices do not form a box.
    """
    transforms = []
    names = []
    instances = []
    windows = []
    annotated = set()
    with parsing(path, "KITTI-360's data_3d_bboxes"):
        with reading(path):
            for _, node in ElementTree.iterparse(path):
                if node.find("transform") is None:
                    continue
                semantic = int(
                    node.findtext("semanticId")
                    or BY_LABEL.get(node.findtext("label", ""), -1)
                )
                frame, first, last = (
                    int(node.findtext(t) or -1)
                    for t in ("timestamp", "start_frame", "end_frame")
                )
                span = (first - MARGIN, last + MARGIN) if frame < 0 else (frame, frame)
                annotated.add(span)
                if semantic in OBJECTS:
                    _, image_id, name = OBJECTS[semantic]
                    transforms.append(
                        _matrix(node, "transform", (4, 4))
                        @ _unit_cube(_matrix(node, "vertices", (-1, 3)))
                    )
                    names.append(name)
                    number = int(node.findtext("instanceId") or 0)
                    if number < MAX_INSTANCES:
                        number += image_id * MAX_INSTANCES
                    instances.append(number)
                    windows.append(span)
                node.clear()
        found = WorldBoxes(
            np.array(transforms).reshape(-1, 4, 4),
            np.array(names, np.str_),
            np.array(array("i", instances)),  # refuses what NumPy 1 would wrap
            np.array(windows, np.int64).reshape(-1, 2),
            np.array(sorted(annotated), np.int64).reshape(-1, 2),
        )
    sizes = np.linalg.norm(found.transforms[:, :3, :3], axis=1)
    sound = np.isfinite(found.transforms).all(axis=(1, 2)) & (
        (sizes > 0) & (sizes <= FARTHEST)
    ).all(axis=1)
    if not sound.all():
        wrong = found.transforms[~sound][0].tolist()
        raise DataError(
            f"{path}: {np.count_nonzero(~sound)} objects are not boxes, such as {wrong}",
            "finite sizes above 0",
        )
    return found


def _matrix(
    node: ElementTree.Element, tag: str, shape: tuple[int, ...]
) -> Float64Array:
    return np.array(node.findtext(f"{tag}/data", "").split(), np.float64).reshape(shape)


def _unit_cube(vertices: Float64Array) -> Float64Array:
    """(4, 4) transform from the unit cube around the origin to the box of the vertices, usually the
    identity."""
    low = vertices.min(axis=0)
    high = vertices.max(axis=0)
    matrix = np.diag([*(high - low), 1.0])
    matrix[:3, 3] = (low + high) / 2
    return matrix


def write_boxes(path: Path, frames: Mapping[int, tuple[Boxes, Float64Array]]) -> None:
    """Write the boxes of frames, or add them to those of other frames in an existing file.

    Args:
        path: the drive's XML.
        frames: {frame: (boxes in the sensor frame, (4, 4) sensor to world)}.

    Raises:
        FileError: if it cannot be read or written.
        DataError: if the existing file is not XML, or a timestamp in it is no frame.
    """
    root = _read_others(path, frames)
    objects = [
        node
        for frame, (boxes, pose) in sorted(frames.items())
        for node in _objects(frame, boxes if len(boxes) else NONE, pose)
    ]
    # In the order of frames, so that a resumed export has the bytes of one in a single run.
    root[:] = sorted(
        [*root, *objects], key=lambda node: int(node.findtext("timestamp") or -1)
    )
    for index, node in enumerate(root):
        node.tag = f"object{index}"
        _child(node, "index").text = str(index)
    ElementTree.indent(root, " ")
    write_file(
        path,
        lambda file: ElementTree.ElementTree(root).write(
            file, "utf-8", xml_declaration=True
        ),
    )


def _read_others(path: Path, frames: Container[int]) -> ElementTree.Element:
    """What a file says about other frames; an empty root if there is no file."""
    if not path.is_file():
        return ElementTree.Element("opencv_storage")
    with parsing(path, "KITTI-360's data_3d_bboxes", "Remove it to write a new one."):
        with reading(path):
            root = ElementTree.parse(path).getroot()
        root[:] = [
            node for node in root if int(node.findtext("timestamp") or -1) not in frames
        ]
    return root


def _objects(frame: int, boxes: Boxes, pose: Float64Array) -> list[ElementTree.Element]:
    nodes = []
    # Numbers for unknown instances: no other box of the frame has them, whatever its class.
    numbered = boxes.instance % MAX_INSTANCES
    free = iter(np.setdiff1d(np.arange(1, 2 * len(boxes) + 1), numbered))
    for i, (x, y, z, length, width, height, yaw) in enumerate(
        boxes.values.astype(np.float64)
    ):
        semantic = BY_NAME.get(boxes.names[i], BY_NAME["Misc"])
        label, image_id, _ = OBJECTS.get(semantic, ("unknownObject", 44, ""))
        c = np.cos(yaw)
        s = np.sin(yaw)
        local = np.eye(4)
        local[:3, :3] = np.array([(c, -s, 0), (s, c, 0), (0, 0, 1)]) * (
            length,
            width,
            height,
        )
        local[:3, 3] = x, y, z
        instance = int(boxes.instance[i] if boxes.instance[i] >= 0 else next(free))
        instance -= (
            image_id * MAX_INSTANCES if instance // MAX_INSTANCES == image_id else 0
        )
        node = ElementTree.Element("object")
        _child(node, "label").text = label
        for tag in ("start_frame", "end_frame", "timestamp"):
            _child(node, tag).text = str(frame)
        _child(node, "dynamic").text = "1"
        _child(node, "semanticId").text = str(semantic)
        _child(node, "instanceId").text = str(instance)
        _opencv(node, "transform", (4, 4), "d", numbers((pose @ local).ravel()))
        _opencv(node, "vertices", (8, 3), "f", numbers((CUBE / 2).ravel()))
        _opencv(node, "faces", (12, 3), "u", FACES)
        nodes.append(node)
    return nodes


def _child(node: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = node.find(tag)
    return ElementTree.SubElement(node, tag) if found is None else found


def _opencv(
    node: ElementTree.Element, tag: str, shape: tuple[int, int], kind: str, data: str
) -> None:
    matrix = ElementTree.SubElement(node, tag, type_id="opencv-matrix")
    for name, text in (
        ("rows", str(shape[0])),
        ("cols", str(shape[1])),
        ("dt", kind),
        ("data", data),
    ):
        ElementTree.SubElement(matrix, name).text = text
