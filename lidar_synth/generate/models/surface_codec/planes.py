"""Planes that neighbouring patches share.

The decoder predicts the planes of each patch with an error of its own, which bends walls by 3 % of
the range (the town's by 0.7 %). In inverse range a plane goes on over the patches beside it, so
that what several patches show of one wall, or of one side of a vehicle, can be made their mean.
"""

import torch

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.generate.models.surface_codec.surfaces import Surfaces

FLAT = ("car", "truck", "other-vehicle", "building", "fence")
"""Classes whose planes are shared. Planes of the ground are not, since kerbs would be lost."""
REACH = (1, 3)
"""Rows and columns of patches, to each side, whose planes are shared."""
TOLERANCE = 0.1
"""Standard deviation of the relative difference of inverse ranges between planes of one wall."""
ROUNDS = 2


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
    rows, columns = grid
    device = surfaces.inverse.device
    share, which = surfaces.weights.exp().mean(2).max(1)
    code = surfaces.classes.argmax(2).gather(1, which[:, None])[:, 0]
    kinds = torch.tensor([TRAIN_ID[name] for name in FLAT], device=device)
    flat = torch.isin(code, kinds).nonzero()[:, 0]

    steps = [torch.arange(-n, n + 1, device=device) for n in REACH]
    down, across = torch.cartesian_prod(*steps).unbind(1)
    row = flat[:, None] // columns % rows
    column = flat[:, None] % columns
    below = row + down
    inside = below.clamp(0, rows - 1)
    near = flat[:, None] + (inside - row) * columns
    near = near + (column + across) % columns - column
    counted = (inside == below) & (code[near] == code[flat, None])

    # A plane is its inverse range in the middle of a patch and the changes by row and column.
    ones = torch.ones_like(down)
    offsets = torch.stack([ones, down * patch[0], across * patch[1]], 1).float()
    middles = [torch.arange(n, device=device) - (n - 1) / 2 for n in patch]
    cells = torch.cartesian_prod(torch.ones(1, device=device), *middles)
    planes = surfaces.inverse.new_ones(len(share), 3)
    planes[flat] = surfaces.inverse[flat, which[flat]] @ (cells / cells.square().sum(0))
    for _ in range(ROUNDS):
        own, others = planes[flat], planes[near]
        ahead = own @ offsets.mT / others[..., 0]
        back = (others * offsets.flip(0)).sum(2) / own[:, :1]
        gap = ((ahead - 1).abs() + (back - 1).abs()) / (2 * TOLERANCE)
        weight = share[near] * counted * (-(gap**2) / 2).exp()
        weight = weight / weight.sum(1, keepdim=True)
        own = (weight[..., None] * others).sum(1)
        own[:, 0] -= (own * (weight @ offsets))[:, 1:].sum(1)
        planes = planes.index_put((flat,), own)
    shared = planes[flat] @ cells.mT
    shared = shared.maximum(0.05 * planes[flat, :1])
    inverse = surfaces.inverse.index_put((flat, which[flat]), shared)
    return surfaces._replace(inverse=inverse)
