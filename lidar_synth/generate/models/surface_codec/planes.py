"""Planes that neighbouring patches share.

The decoder predicts the planes of each patch with an error of its own, which bends walls by 3 % of
the range (the town's by 0.7 %). In inverse range a plane goes on over the patches beside it, so
that what several patches show of one wall, or of one side of a vehicle, can be made their mean.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.generate.models.surface_codec.surfaces import Surfaces

FLAT = ("car", "truck", "other-vehicle", "building", "fence")
"""Classes whose planes are shared. Planes of the ground are not, since kerbs would be lost."""
REACH = (1, 3)
"""Rows and columns of patches, to each side, whose planes are shared."""
TOLERANCE = 0.1
"""Standard deviation of the relative difference of inverse ranges between planes of one wall."""
ROUNDS = 2
_LEAST = 1e-6


def share_planes(
    surfaces: Surfaces, grid: tuple[int, int], patch: tuple[int, int]
) -> Surfaces:
    """Surfaces whose planes go on in the patches beside them.

    The likeliest surface of a patch, if it is flat, gets the mean plane of the patches around it
    whose likeliest surface has its class. They count by its probability and by how well each
    plane predicts the other's middle.

    Args:
        surfaces: of all patches of images, row by row.
        grid: rows and columns of patches in an image; columns wrap around.
        patch: rows and columns of a patch.
    """
    device = surfaces.inverse.device
    share, which = surfaces.weights.exp().mean(2).max(1)
    code = surfaces.classes.argmax(2).gather(1, which[:, None])[:, 0]
    kinds = torch.tensor([TRAIN_ID[name] for name in FLAT], device=device)
    flat = torch.isin(code, kinds)
    which = which[:, None, None].expand(-1, 1, surfaces.inverse.shape[2])
    inverse = surfaces.inverse.gather(1, which)[:, 0]

    # A plane is its inverse range in the middle of a patch and the changes by row and column.
    one = inverse.new_ones(1)
    middles = [one.new_tensor(range(n)) - (n - 1) / 2 for n in patch]
    cells = torch.cartesian_prod(one, *middles)
    planes = (inverse @ (cells / cells.square().sum(0))).mT.view(3, -1, *grid)
    steps = [torch.arange(-n, n + 1, device=device) for n in REACH]
    down, across = torch.cartesian_prod(*steps).T.view(2, -1, 1, 1, 1)
    down, across = down * patch[0], across * patch[1]
    code = code.view(-1, *grid)
    counted = _around(share.view_as(code)) * (_around(code) == code)
    for _ in range(ROUNDS):
        far, tilt, turn = _around(planes).unbind(1)
        ahead = planes[0] + planes[1] * down + planes[2] * across
        back = far - tilt * down - turn * across
        # outside the image, far is 0 and nothing is counted
        gap = (ahead / far.clamp_min(_LEAST) - 1).abs() + (back / planes[0] - 1).abs()
        weight = counted * (-((gap / (2 * TOLERANCE)) ** 2) / 2).exp()
        weight = weight / weight.sum(0).clamp_min(_LEAST)
        slopes = [(weight * tilt).sum(0), (weight * turn).sum(0)]
        middle = weight * (far - slopes[0] * down - slopes[1] * across)
        mean = torch.stack([middle.sum(0), *slopes])
        planes = torch.where(flat.view_as(code), mean, planes)
    shared = planes.flatten(1).mT @ cells.mT
    shared = shared.maximum(0.05 * inverse)
    shared = torch.where(flat[:, None], shared, inverse)
    return surfaces._replace(
        inverse=surfaces.inverse.scatter(1, which, shared[:, None])
    )


def _around(maps: Tensor) -> Tensor:
    """(n, ..., h, w) values of the patches around each of (..., h, w), 0 outside of the rows."""
    h, w = maps.shape[-2:]
    down, across = REACH
    columns = torch.arange(-across, w + across, device=maps.device) % w
    wide = F.pad(maps[..., columns], (0, 0, down, down))
    return torch.stack(
        [
            wide[..., i : i + h, j : j + w]
            for i in range(2 * down + 1)
            for j in range(2 * across + 1)
        ]
    )
