"""Planes that neighbouring patches share."""

import torch
from torch import Tensor

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.generate.models.surface_codec.planes import share_planes
from lidar_synth.generate.models.surface_codec.reflectance import ZeroInflatedLogistic
from lidar_synth.generate.models.surface_codec.surfaces import Surfaces

GRID = (4, 12)
PATCH = (2, 8)
BUILDING = TRAIN_ID["building"]


def surfaces(inverse: Tensor, kinds: Tensor) -> Surfaces:
    """The surfaces of one image whose patches show the first of two: ``inverse`` (N, P) of class
    ``kinds`` (N,); the second is at 40 m."""
    count, cells = inverse.shape
    both = torch.stack([inverse, torch.full_like(inverse, 1 / 40)], 1)
    classes = torch.full((count, 2, 20), -10.0)
    classes[torch.arange(count), 0, kinds] = 0
    weights = torch.tensor([0.8, 0.2]).log()[:, None].expand(count, 2, cells)
    zero = torch.zeros(count, 2, cells)
    reflectance = ZeroInflatedLogistic(zero, zero[..., :1], zero[..., :1])
    return Surfaces(both, zero[..., :1] + 0.01, zero, reflectance, classes, weights)


def wall(slope: float = 0.0005) -> Tensor:
    """(48, 16) inverse ranges, 1 / m, of a plane that changes by ``slope`` from column to column,
    so that there is a step where the columns wrap around."""
    rows, columns = GRID
    i = torch.arange(rows * PATCH[0]).float()[:, None]
    j = torch.arange(columns * PATCH[1]).float()
    image = 0.06 + 0.001 * i + slope * j
    tiles = image.view(rows, PATCH[0], columns, PATCH[1]).transpose(1, 2)
    return tiles.reshape(rows * columns, -1)


def of_class(name: str) -> Tensor:
    """The class of all patches."""
    return torch.full((GRID[0] * GRID[1],), TRAIN_ID[name])


def test_a_plane_stays_as_it_is() -> None:
    before = surfaces(wall(), of_class("building"))
    torch.testing.assert_close(
        share_planes(before, GRID, PATCH).inverse, before.inverse
    )


def test_errors_of_patches_are_averaged() -> None:
    true = wall()
    error = 0.03 * torch.randn(len(true), 1, generator=torch.Generator().manual_seed(0))
    shared = share_planes(
        surfaces(true * (1 + error), of_class("building")), GRID, PATCH
    )
    left = (shared.inverse[:, 0] / true - 1).square().mean().sqrt()
    assert left < 0.35 * error.square().mean().sqrt()
    assert (shared.inverse[:, 1] == 1 / 40).all()


def test_plants_and_ground_keep_their_planes() -> None:
    error = 0.03 * torch.randn(48, 1, generator=torch.Generator().manual_seed(0))
    for name in ("vegetation", "terrain", "road", "pole", "person"):
        before = surfaces(wall() * (1 + error), of_class(name))
        assert (share_planes(before, GRID, PATCH).inverse == before.inverse).all()


def test_a_step_between_walls_stays() -> None:
    """A wall at 10 m and one at 6 m behind each other do not become one."""
    near = torch.arange(48) % GRID[1] < 6
    inverse = torch.where(near, 1 / 6, 1 / 10)[:, None].expand(-1, 16)
    shared = share_planes(surfaces(inverse, of_class("building")), GRID, PATCH)
    torch.testing.assert_close(shared.inverse[:, 0], inverse, rtol=1e-3, atol=0)


def test_other_classes_are_no_neighbours() -> None:
    fence = torch.arange(48) % GRID[1] < 6
    kinds = torch.where(fence, TRAIN_ID["fence"], BUILDING)
    inverse = torch.where(fence, 0.102, 0.1)[:, None].expand(-1, 16)
    shared = share_planes(surfaces(inverse, kinds), GRID, PATCH)
    torch.testing.assert_close(shared.inverse[:, 0], inverse)


def test_columns_wrap_around_and_rows_do_not() -> None:
    """A patch of another range changes those around it, over the seam of the columns."""
    inverse = torch.full((48, 16), 0.1)
    inverse[0] = 0.105
    shared = share_planes(surfaces(inverse, of_class("building")), GRID, PATCH)
    changed = ((shared.inverse[:, 0] - inverse).abs() > 1e-6).all(1).view(GRID)
    assert changed[0, -1] and changed[0, 1] and changed[1, 0]
    assert not changed[3].any()


def test_images_of_a_batch_do_not_meet() -> None:
    one = surfaces(wall(), of_class("building"))
    two = surfaces(torch.full((48, 16), 0.101), of_class("building"))
    pairs = zip(one, two, strict=True)
    batch = Surfaces(
        *(
            ZeroInflatedLogistic(
                *(torch.cat(parts) for parts in zip(a, b, strict=True))
            )
            if isinstance(a, tuple)
            else torch.cat([a, b])
            for a, b in pairs
        )
    )
    apart = [share_planes(part, GRID, PATCH).inverse for part in (one, two)]
    together = share_planes(batch, GRID, PATCH).inverse
    torch.testing.assert_close(together, torch.cat(apart))


def test_half_the_columns_see_the_same_planes() -> None:
    """Decoded to half the columns, each is at the middle of two."""
    error = 0.03 * torch.randn(48, 1, generator=torch.Generator().manual_seed(0))
    whole = wall() * (1 + error)
    half = whole.view(48, 2, 4, 2).mean(3).reshape(48, 8)
    kinds = of_class("building")
    fine = share_planes(surfaces(whole, kinds), GRID, PATCH).inverse[:, 0]
    coarse = share_planes(surfaces(half, kinds), GRID, (2, 4)).inverse[:, 0]
    torch.testing.assert_close(coarse, fine.view(48, 2, 4, 2).mean(3).reshape(48, 8))
