"""Encoder of one calibrated camera's images: every cell of the state gets the image features along
its ray."""

from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.generate.models.convolution import check_shape, halve, pair, reduced
from lidar_synth.generate.models.network import Encoder
from lidar_synth.generate.models.positions import RayAngles


class SightEncoder(Encoder):
    """Encodes a camera image as feature maps on the grid of the state, using the camera's
    calibration.

    Convolutions compute features of the image. Each cell samples them at the pixel onto which the
    point ``distance`` metres along the cell's ray projects. Nearer and farther points project to
    slightly different pixels, because the camera and the sensor are apart; the receptive field of
    the features covers this parallax. The last map is 1 where the cell lies within the image.

    Unlike attention to tokens, the correspondence between cells and pixels is not learnt, so that
    minutes of training on hundreds of images suffice. The encoder is specific to one camera and its
    mounting.

    Args:
        target: rows and columns of the state.
        image: rows and columns of the camera's images.
        image_from_sensor: (3, 4) projection from homogeneous points in the sensor frame to pixels
            of such an image (``Calibration.image_from_sensor``).
        resolution: h, w to which images are resized.
        channels: channels of the maps.
        widths: channels of the convolutions, each of which halves rows and columns.
        distance: distance of the projected points in metres.
        angles: (2, rows, columns) elevation and azimuth (clockwise from ahead) of every cell,
            radians; None if a checkpoint will be loaded.

    Raises:
        ConfigError: on values that do not fit together.
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ("target", "image")
    needs_ray_angles: ClassVar[bool] = True
    condition: ClassVar[str] = "camera"
    argument: ClassVar[str] = "condition_channels"
    mirrors: ClassVar[bool] = False  # the calibration is that of images as they are

    def __init__(
        self,
        target: Sequence[int],
        image: Sequence[int],
        image_from_sensor: Sequence[Sequence[float]],
        resolution: Sequence[int] = (96, 320),
        channels: int = 32,
        widths: Sequence[int] = (32, 64, 96),
        distance: float = 15.0,
        angles: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.resolution = pair(resolution)
        self.image = pair(image)
        self.channels = channels
        self.distance = distance
        self.matrix = [[float(v) for v in row] for row in image_from_sensor]
        if [len(row) for row in self.matrix] != [4, 4, 4]:
            raise ConfigError(
                f"image_from_sensor {image_from_sensor}", "3 rows of 4 numbers"
            )
        reduced(self.resolution, [(2, 2)] * len(widths), "an image")
        self.angles = RayAngles(target, angles)
        self.body = halve(widths)
        self.body.append(nn.Conv2d(widths[-1], channels - 1, 3, 1, 1))

    def pixel_coordinates(self) -> Tensor:
        """The (rows, columns, 2) image position of every cell: column and row, from -1 to 1 within
        the image, and 9 for points behind the camera."""
        elevation, azimuth = self.angles.cells
        flat = elevation.cos()
        ray = torch.stack(
            [flat * azimuth.cos(), -flat * azimuth.sin(), elevation.sin()], -1
        )
        points = torch.cat([self.distance * ray, torch.ones_like(ray[..., :1])], -1)
        pixels = points @ torch.tensor(self.matrix, device=ray.device).T
        ahead = pixels[..., 2:] > 1.0
        size = torch.tensor(self.image[::-1], device=ray.device)
        position = (2 * pixels[..., :2] / pixels[..., 2:] + 1) / size - 1
        return torch.where(ahead, position, torch.full_like(position, 9.0))

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, h, w) uint8 to (B, channels, rows, columns).

        Raises:
            DataError: on another size.
        """
        check_shape(image, (3, *self.resolution), "a camera image")
        x = image.to(next(self.body.parameters()).dtype) / 127.5 - 1
        features = self.body(x.contiguous(memory_format=torch.channels_last)).float()
        positions = self.pixel_coordinates()
        visible = (
            (positions.abs() <= 1)
            .all(-1)
            .float()
            .expand(len(x), 1, *positions.shape[:2])
        )
        maps = F.grid_sample(
            features, positions.expand(len(x), *positions.shape), align_corners=False
        )
        return torch.cat([maps * visible, visible], 1).to(x.dtype)
