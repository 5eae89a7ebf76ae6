"""Conditions of generation: a label map, a camera image or a layout.

A condition is an array of integers, a ``Layout``, or a real ``Scan`` that provides it::

    semantic   (H, W) uint8 train ids 0..18, 255 = unknown, on the model's sensor
               (``RangeImage.label``)
    camera     (3, h, w) uint8 red, green, blue, of the size that the model's encoder takes; or the
               image at ``Scan.image_path``, which is resized
    layout     a ``Layout``, or (5, H, W) uint8, its image on the model's sensor (``layout_image``);
               a scan with boxes provides its own layout

An encoder (``models.encoders``), trained with the velocity network, encodes it as the ``cond`` of
that network. A model that was also trained with blank conditions (``dropout``) can be guided: see
``flow.guidance.guide``.

To add a condition: write its class and enter it in ``CONDITIONS``; enter its encoder in
``models.NETWORKS``.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.parsing import read_rgb
from lidar_synth.geometry import LABELLED_ONLY, Scan, Sensor
from lidar_synth.geometry.layout import CHANNELS, CODES, Layout, layout_image, layout_of
from lidar_synth.geometry.layout.raster import depths_of
from lidar_synth.geometry.projection import project

if TYPE_CHECKING:
    from PIL.Image import Image as PILImage

HEIGHT_TOLERANCE = 0.35
"""Metres between the heights of two sensors above the ground, up to which the layout of one suits
the other."""

GAP = 2
"""Widest gap in the labels of a scan, in cells of a row, that is closed."""


class Condition(ABC):
    """One kind of condition.

    Attributes:
        name: key in ``CONDITIONS``, in a checkpoint's header and in a user's dictionary.
        field: field of ``train.ImageCache`` that stores it.
        turns: whether it has to be rotated when the scan is rotated about the vertical.
        blank: value of a blank condition.
        channels: what its shape has before the rows and columns of the encoder.
    """

    name: str
    field: str
    turns = True
    blank = 0
    channels: tuple[int, ...] = ()

    def shape(self, encoder: nn.Module) -> tuple[int, ...]:
        """The shape of one condition."""
        # Every encoder has a resolution.
        return (*self.channels, *encoder.resolution)  # type: ignore[misc]

    @abstractmethod
    def read(
        self,
        scan: Scan,
        sensor: Sensor,
        shape: tuple[int, ...],
        options: Mapping[str, Any],
    ) -> NDArray[np.uint8]:
        """The condition that a real scan provides, with the given shape."""

    def check(self, values: Tensor) -> None:  # noqa: B027 - not every kind has invalid values
        """Raise a DataError on invalid values."""

    def reduced(self, values: Tensor, u: Tensor, views: int) -> Tensor:
        """Conditions (B, ...) with less information, for training.

        Args:
            values: (B, ...) conditions.
            u: (B,) uniform random numbers in [0, 1), which choose how much remains.
            views: number of views side by side in a camera image.
        """
        return values


def bridge_gaps(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A label map without narrow gaps: up to ``GAP`` unknown cells between two known ones of a row
    take the nearer one.

    Lasers of a sensor that moves, or of another one, leave such gaps on a model's grid. To a model,
    they would be rays without a return, as through a hedge. Columns wrap around.

    Args:
        labels: (H, W) uint8 train ids, 255 = unknown.
    """
    out = labels.copy()
    for width in range(1, GAP + 1):
        for left in range(1, width + 1):
            right = width + 1 - left
            before = np.roll(labels, left, 1)
            after = np.roll(labels, -right, 1)
            gap = (out == IGNORE) & (before != IGNORE) & (after != IGNORE)
            out[gap] = (before if left <= right else after)[gap]
    return out


class SemanticMap(Condition):
    """The classes of a scan on the model's grid."""

    name = "semantic"
    field = "label"
    blank = IGNORE

    def read(
        self,
        scan: Scan,
        sensor: Sensor,
        shape: tuple[int, ...],
        options: Mapping[str, Any],
    ) -> NDArray[np.uint8]:
        """The scan's labels, projected onto ``sensor``, which need not be the scan's own.

        Narrow gaps are closed by ``bridge_gaps``, unless ``options["keep_gaps"]`` says that the
        model was trained on maps like LiDM's, whose gaps stay.

        Raises:
            DataError: on a scan without labels.
        """
        if scan.label is None:
            raise DataError(
                f"scan {scan.id!r} has no labels",
                "a labelled scan, to condition on",
                LABELLED_ONLY,
            )
        labels = project(scan, sensor, ["label"]).channels["label"]
        return labels if options.get("keep_gaps") else bridge_gaps(labels)

    def check(self, values: Tensor) -> None:
        """Check that all values are train ids or 255.

        Raises:
            DataError: on other values.
        """
        wrong = values[(values >= len(NAMES)) & (values != IGNORE)]
        if len(wrong):
            raise DataError(
                f"a label map with ids {sorted(set(wrong.tolist()))[:8]}",
                "train ids 0..18, or 255 = unknown",
                "lidar_synth.datasets.classes.SEMANTIC_KITTI.decode converts SemanticKITTI's "
                "file ids to train ids.",
            )


class CameraImage(Condition):
    """The image of a forward-facing camera."""

    name = "camera"
    field = "camera"
    turns = False
    channels = (3,)

    def read(
        self,
        scan: Scan,
        sensor: Sensor,
        shape: tuple[int, ...],
        options: Mapping[str, Any],
    ) -> NDArray[np.uint8]:
        """The image taken with the scan, see ``resize_image``.

        Raises:
            FileError: if the image cannot be read.
            DataError: on a scan without an image, a damaged one, or one of another size.
        """
        if scan.image_path is None:
            raise DataError(
                f"scan {scan.id!r} has no camera image",
                "a scan with an image_path, to condition on",
            )
        image = read_rgb(scan.image_path)
        return resize_image(image, shape, options, f"the image {scan.image_path}")

    def reduced(self, values: Tensor, u: Tensor, views: int) -> Tensor:
        """One view of each image."""
        return one_view(values, views)


def resize_image(
    image: "PILImage",
    shape: tuple[int, ...],
    options: Mapping[str, Any],
    what: str,
) -> NDArray[np.uint8]:
    """A camera image as a condition.

    Args:
        image: of the camera, in red, green and blue.
        shape: (3, h, w) of the condition.
        options: of the condition; ``options["image"]`` are the rows and columns that the image must
            have. They identify the camera of the training; an image with another field of view
            would mislead the model. ``options["views"]`` is the number of views side by side that
            are resized one by one, as in LiDM: by bicubic interpolation between the centres of
            their corner pixels, without antialiasing. Without it, the image is resized as a whole,
            with antialiasing.
        what: name of the image in errors.

    Returns:
        (3, h, w) uint8 red, green, blue.

    Raises:
        DataError: on an image of another size.
    """
    from PIL.Image import Resampling

    size = (image.height, image.width)
    if size != (wanted := tuple(options.get("image") or size)):
        raise DataError(
            f"{what} of {size} rows and columns",
            f"{wanted}, those of the camera that the model was trained on",
            "Crop or pad it, by its calibration, to what that camera sees.",
        )
    if views := options.get("views"):
        return _resize_views(np.asarray(image, np.uint8), shape, views)
    small = image.resize((shape[2], shape[1]), Resampling.BICUBIC)
    return np.asarray(small, np.uint8).transpose(2, 0, 1).copy()


def _resize_views(
    pixels: NDArray[np.uint8], shape: tuple[int, ...], views: int
) -> NDArray[np.uint8]:
    """(H, W, 3) pixels to ``shape``; the views side by side are resized separately. Columns beyond
    a multiple of ``views`` are left out."""
    width = pixels.shape[1] // views
    cut = [pixels[:, i * width : (i + 1) * width] for i in range(views)]
    stacked = torch.from_numpy(np.stack(cut)).movedim(-1, 1).float()
    resized = F.interpolate(
        stacked, (shape[1], shape[2] // views), mode="bicubic", align_corners=True
    )
    side_by_side = torch.cat(list(resized.round().clamp(0, 255)), -1)
    return side_by_side.to(torch.uint8).numpy()


class LayoutImage(Condition):
    """The image of a layout on the model's grid."""

    name = "layout"
    field = "layout"
    channels = (len(CHANNELS),)

    def read(
        self,
        scan: Scan | Layout,
        sensor: Sensor,
        shape: tuple[int, ...],
        options: Mapping[str, Any],
    ) -> NDArray[np.uint8]:
        """The image of a layout, or of the layout of a scan with boxes, on ``sensor``.

        Raises:
            DataError: on a scan without boxes, boxes out of the sensor's range, or the layout of a
                sensor that is mounted at another height than that of the training,
                ``options["height"]`` (metres).
        """
        layout = layout_of(scan) if isinstance(scan, Scan) else scan
        height = float(options.get("height") or -layout.ground[0])
        if abs(layout.ground[0] + height) > HEIGHT_TOLERANCE:
            raise DataError(
                f"layout {layout.id!r} of a sensor {-layout.ground[0]:.2f} m above the ground",
                f"{height:.2f} m, the height of the model's sensor",
                "Raise or lower boxes, ground and outlines by the difference.",
            )
        distance = np.hypot(*layout.boxes.values[:, :2].T)
        if isinstance(scan, Layout) and (far := distance > sensor.range_max).any():
            raise DataError(
                f"layout {layout.id!r}: box {int(far.argmax())} at {float(distance[far][0]):.1f} m",
                f"boxes within the sensor's range of {sensor.range_max:g} m",
            )
        return layout_image(layout, sensor)

    def check(self, values: Tensor) -> None:
        """Check the codes of classes.

        Raises:
            DataError: on other codes.
        """
        codes = values[..., 0, :, :]
        if len(wrong := codes[codes >= len(CODES)]):
            raise DataError(
                f"a layout image with codes {sorted(set(wrong.tolist()))[:8]}",
                f"0..{len(CODES) - 1}",
            )

    def reduced(self, values: Tensor, u: Tensor, views: int) -> Tensor:
        """Layout images as most users' files give them: without outlines, and with the ground only
        up to a distance that ``u`` chooses."""
        code = values[:, :1]
        ground = CODES["ground"]
        depth = depths_of(values)[:, None]
        reach = 5 * 16 ** u.to(depth).view(-1, 1, 1, 1)  # 5 to 80 m
        kept = (code >= CODES["Car"]) | ((code == ground) & (depth < reach))
        return torch.where(kept, values, 0)


CONDITIONS: dict[str, Condition] = {
    "semantic": SemanticMap(),
    "camera": CameraImage(),
    "layout": LayoutImage(),
}
"""Conditions by name."""


class Conditioned(nn.Module):
    """A velocity network together with the encoder of its condition: v(y, t, c) with c as stored,
    uint8.

    Args:
        velocity: the velocity network, which takes the output of ``encoder``.
        encoder: the encoder of the condition.
    """

    def __init__(self, velocity: nn.Module, encoder: nn.Module) -> None:
        super().__init__()
        self.velocity = velocity
        self.encoder = encoder

    @property
    def ends(self) -> bool:
        """Whether the velocity network takes the end of a step."""
        return bool(getattr(self.velocity, "ends", False))

    def forward(self, y: Tensor, t: Tensor, cond: Tensor, *end: Tensor) -> Tensor:
        """(B, ...) states, times and conditions, and ends of steps if it takes them, to velocities
        (B, ...)."""
        out: Tensor = self.velocity(y, t, self.encoder(cond), *end)
        return out


def blank(name: str, values: Tensor) -> Tensor:
    """A blank condition of the shape and dtype of ``values``."""
    return torch.full_like(values, CONDITIONS[name].blank)


def one_view(image: Tensor, views: int) -> Tensor:
    """Images (B, 3, h, w) with all views but the one right of the middle blank, as LiDM drops views
    in training."""
    width = image.shape[3] // views
    kept = views // 2
    out = torch.zeros_like(image)
    view = slice(kept * width, (kept + 1) * width)
    out[..., view] = image[..., view]
    return out


def batch_of(
    name: str,
    given: Any,
    count: int,
    sensor: Sensor,
    shape: tuple[int, ...],
    options: Mapping[str, Any],
) -> Tensor:
    """Convert a user's conditions of several scans to one tensor.

    Args:
        name: name of the model's condition.
        given: a condition for all: an array or tensor, a ``Scan`` or ``Layout``; one for each: an
            array or tensor of B, or a sequence of any of these; or a dictionary with one of these
            under ``name``, as a bank stores it.
        count: B.
        sensor: the model's sensor.
        shape: shape of one condition.
        options: options of the condition, from the checkpoint's header.

    Returns:
        (B, *shape) uint8.

    Raises:
        ConfigError: on another type, or a dictionary without ``name``.
        DataError: on another shape, invalid values, or a scan that does not provide the condition.
    """
    condition = CONDITIONS[name]
    if isinstance(given, Mapping):
        if name not in given:
            raise ConfigError(f"conditions {sorted(given)}", f"{name!r} among them")
        given = given[name]
    readable = (Scan, Layout) if name == "layout" else Scan
    if isinstance(given, readable):
        # Only LayoutImage gets a Layout.
        given = condition.read(given, sensor, shape, options)  # type: ignore[arg-type]
    elif isinstance(given, Sequence) and given and not isinstance(given, str):
        given = torch.cat(
            [batch_of(name, one, 1, sensor, shape, options) for one in given]
        )
    if not isinstance(given, Tensor | np.ndarray):
        raise ConfigError(
            f"a condition of type {type(given).__name__}",
            "an array, a Scan, or a list of them",
            "load_layout(path) reads a layout." if name == "layout" else "",
        )
    if isinstance(given, np.ndarray):
        # torch refuses flipped arrays and warns of read-only ones
        given = torch.from_numpy(np.require(given, requirements=["C", "W"]))
    values: Tensor = given
    if values.is_floating_point() or values.is_complex() or values.dtype == torch.bool:
        raise DataError(f"a {name} condition of {values.dtype}", "whole numbers, uint8")
    if values.shape not in (shape, (count, *shape)):
        raise DataError(
            f"a {name} condition of shape {tuple(values.shape)}",
            f"{shape} for all scans, or {(count, *shape)}",
        )
    if values.numel() and not 0 <= int(values.min()) <= int(values.max()) <= 255:
        raise DataError(
            f"a {name} condition from {int(values.min())} to {int(values.max())}",
            "0..255",
        )
    values = values.to(torch.uint8)
    condition.check(values)
    return values.expand(count, *shape)
