"""Range images as PNG files, for viewing and for exchange with other programs.

Layout::

    range/NAME.png          16 bit grey: range in steps of ``scale`` metres, 0 = no return
    reflectance/NAME.png    16 bit grey: reflectance * 65535
    label/NAME.png          8 bit palette in SemanticKITTI's colours: train id, 255 = ignore; only
                            with labels

``range`` carries a text chunk ``lidar_synth``: JSON with ``scale``, ``sensor`` (the keys of
sensors.yaml), ``id`` and ``domain``. The format is lossy: rounding errors are at most half a step,
0.61 mm for a maximum range of 80 m, and 8e-6 for reflectance; instances, the dataset's own labels,
confidence, boxes and pose are not stored. Labels are exact.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.datasets.colours import COLOURS
from lidar_synth.errors import DataError, FileError, parsing
from lidar_synth.files.disk import SKIP_HINT, list_files, write_file
from lidar_synth.files.parsing import parse_json, read_picture
from lidar_synth.formats.description import check_provenance
from lidar_synth.formats.npz import range_image
from lidar_synth.formats.points import check_scan
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.writer import GridWriter, project_scan
from lidar_synth.geometry import REAL, SYNTHETIC, RangeImage, Scan, Sensor, load_sensor
from lidar_synth.geometry.projection import unproject

STEPS = 65535
"""The largest 16-bit value: ``range_max`` in range, 1 in reflectance."""

TEXT = "lidar_synth"

CHANNELS = ("range", "reflectance", "label")
"""Names of the folders."""


class RangePNG(ScanFiles):
    """Range images as PNG: <root>/range/*.png with the folders reflectance and label, or one file
    of range.

    Args:
        root: the folder that holds ``range``, or one PNG in ``range``.
        sensor: the sensor of the grid; by default the one stored in the files.
        on_bad: see ``ScanFiles``.

    Raises:
        FileError: if the folder does not exist.
        DataError: if it holds no image.
    """

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return root.suffix == ".png" or any(root.glob("range/*.png"))

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        paths = [root] if root.is_file() else list_files(root / "range", ".png")
        base = root.absolute().parents[1] if root.is_file() else root
        stored = _stored_sensor(paths[0]) if paths else None
        super().__init__(
            base, [path.stem for path in paths], None, on_bad, stored=stored
        )
        self._given = None if sensor is None else load_sensor(sensor)

    def image(self, index: int) -> RangeImage:
        """The range image at ``index``.

        Raises:
            DataError, FileError: if it cannot be read.
        """
        return self._decode(index)[0]

    def read(self, index: int) -> Scan:
        image, facts = self._decode(index)
        scan = unproject(image)
        scan.id = self.ids[index]
        scan.domain = int(facts["domain"])
        scan.provenance = facts.get("provenance", {})
        check_scan(scan, str(channel_path(self.root, "range", self.ids[index])))
        return scan

    def _decode(self, index: int) -> tuple[RangeImage, dict[str, Any]]:
        path, reflectance, label = (
            channel_path(self.root, name, self.ids[index]) for name in CHANNELS
        )
        steps, text = read_png(path)
        facts = parse_json(
            text.get(TEXT, ""),
            f"{path}: its text",
            "a range image written by this package",
        )
        with parsing(path, "a range image written by this package"):
            sensor = Sensor.from_dict(facts["sensor"])
            scale = float(facts["scale"])
            if self._given is not None and sensor.shape != self._given.shape:
                raise ValueError(
                    f"it was made for sensor {sensor.name!r}, not for {self._given.name!r}"
                )
            if facts["domain"] not in (REAL, SYNTHETIC) or not 0 < scale < 1:
                raise ValueError(f"domain {facts['domain']!r} and scale {scale}")
            check_provenance(facts.get("provenance", {}))
            channels = {
                "reflectance": (_steps(reflectance) / np.float32(STEPS)).astype(
                    np.float32
                )
            }
            if label.is_file():
                channels["label"] = read_png(label)[0]
                if channels["label"].dtype != np.uint8:
                    raise ValueError(
                        f"{label.name} of its labels is {channels['label'].dtype}, not uint8"
                    )
            return range_image(
                _steps(path, steps) * np.float32(scale), sensor, channels, str(path)
            ), facts


def _stored_sensor(path: Path) -> Sensor | None:
    """The sensor that a file names; None if it cannot be read, so that reading the scan raises the
    error."""
    try:
        facts = parse_json(read_png(path)[1].get(TEXT, ""), str(path))
        return Sensor.from_dict(facts["sensor"])
    except (FileError, ValueError, KeyError, TypeError):
        return None


def _steps(path: Path, values: NDArray[Any] | None = None) -> NDArray[Any]:
    """The values of a 16-bit grey image."""
    values = read_png(path)[0] if values is None else values
    if (
        values.dtype.kind not in "iu"
        or values.ndim != 2
        or (values.size and values.max() > STEPS)
    ):
        raise DataError(
            f"{path} holds {values.dtype} of shape {values.shape}",
            "a picture of 16-bit grey",
            SKIP_HINT,
        )
    return values


class PNGWriter(GridWriter):
    """Writes the scan, projected onto its sensor's grid, as ``range``, ``reflectance`` and
    ``label`` PNG files."""

    keeps = frozenset({"label"})

    def _place(self, index: int, name: str | None) -> str:
        # One flat folder per channel, which other programs can read as a list of images.
        return f"range/{(name or f'{index:06d}').replace('/', '_')}.png"

    def _write_file(self, path: Path, scan: Scan) -> None:
        image = project_scan(scan)
        scale = image.sensor.range_max / STEPS
        facts = {
            "scale": scale,
            "sensor": image.sensor.to_dict(),
            "id": scan.id,
            "domain": scan.domain,
        }
        facts |= {"provenance": dict(scan.provenance)} if scan.provenance else {}
        if image.label is not None:
            write_png(
                channel_path(self.root, "label", path.stem), image.label, palette=True
            )
        reflectance = image.channels["reflectance"] * STEPS
        write_png(
            channel_path(self.root, "reflectance", path.stem),
            np.rint(reflectance).astype(np.uint16),
        )
        steps = np.where(image.mask, np.clip(np.rint(image.range / scale), 1, STEPS), 0)
        write_png(path, steps.astype(np.uint16), text=json.dumps(facts))


def channel_path(root: Path, channel: str, name: str) -> Path:
    """The path of a channel of an image."""
    return root / channel / f"{name}.png"


def read_png(path: Path) -> tuple[NDArray[Any], dict[str, str]]:
    """Read the values of a PNG, (H, W), and its text chunks.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is not an image.
    """
    picture = read_picture(path, "a PNG file")
    return np.array(picture), dict(getattr(picture, "text", {}))


def write_png(
    path: Path, values: NDArray[Any], text: str = "", palette: bool = False
) -> None:
    """The inverse of ``read_png``.

    Args:
        path: the output file.
        values: (H, W) uint16, or uint8 with a palette.
        text: content of the text chunk ``lidar_synth``.
        palette: whether to add a palette with SemanticKITTI's colours of train ids.

    Raises:
        FileError: if it cannot be written.
    """
    from PIL import Image, PngImagePlugin

    picture = Image.fromarray(values)
    if palette:
        colours = np.zeros((IGNORE + 1, 3), np.uint8)
        colours[: len(COLOURS)] = COLOURS
        picture.putpalette(colours.tobytes())
    chunk = PngImagePlugin.PngInfo()
    if text:
        chunk.add_text(TEXT, text)
    write_file(path, lambda file: picture.save(file, "PNG", pnginfo=chunk))
