"""Geometry compared with outputs of the code of R2Flow and LiDM, with their conventions where they
differ from ours."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Golden, ring_numbers
from safetensors.torch import load_file

from lidar_synth.formats.points import read_points
from lidar_synth.geometry.normalize import NORMALISATIONS, Normalisation
from lidar_synth.geometry.projection import project, unfold, unproject
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor

HERE = Path(__file__).parent / "golden"
R2FLOW = load_file(HERE / "r2flow_lidar_utility.safetensors")
POINTS = np.load(HERE / "r2flow_projection_synthetic.npz")


def hdl64(columns: int, low: float = 0.0, high: float = 1e6, rows: int = 64) -> Sensor:
    """The grid of R2Flow and LiDM; the golden images of R2Flow are stored before its range mask."""
    return Sensor("peer", columns, low, high, rows=rows, fov_up=3.0, fov_down=-25.0)


def lidm(columns: int, rows: int = 64) -> Sensor:
    """LiDM's grid; its range limits of 1 and 56 m are exclusive, ours are inclusive."""
    return hdl64(
        columns,
        float(np.nextafter(np.float32(1), 2)),
        float(np.nextafter(np.float32(56), 0)),
        rows,
    )


@pytest.mark.parametrize(
    "key",
    sorted(
        k for k in POINTS if "spherical" in k or k.startswith("synthetic/unfolding")
    ),
)
def test_r2flow_projection_of_random_points(key: str) -> None:
    """All except the unfolding of more rings than rows, where R2Flow's behaviour is not copied."""
    name, _, kind = key.partition("/")
    columns = int(kind.split("x")[1])
    points = POINTS[f"{name}/points"]
    scan = Scan(points[:, :3].copy(), points[:, 3].copy(), hdl64(columns, rows=16))
    if "spherical" in kind:
        image = project(scan)
    else:
        # R2Flow counts rows up from the last ring.
        ring = ring_numbers(scan.points)
        image = unfold(replace(scan, ring=ring + 15 - ring.max()))
    assert np.array_equal(image.range, POINTS[key][..., 4])
    assert np.array_equal(image.reflectance, POINTS[key][..., 3])


@pytest.mark.parametrize("columns", [64, 256])
def test_lidm_projection_of_random_points(columns: int) -> None:
    golden = np.load(HERE / "lidm_projection_synthetic.npz")
    points = POINTS["synthetic/points"]
    image = project(
        Scan(points[:, :3].copy(), points[:, 3].copy(), lidm(columns, rows=16))
    )
    assert np.array_equal(
        np.where(image.mask, image.range, -1), golden[f"synthetic/range_16x{columns}"]
    )
    assert np.array_equal(
        np.where(image.mask, image.reflectance, -1),
        golden[f"synthetic/remission_16x{columns}"],
    )


@pytest.mark.parametrize("columns", [1024, 2048])
def test_r2flow_ray_angles(columns: int) -> None:
    """R2Flow's azimuth increases counter-clockwise, ours clockwise."""
    elevation, azimuth = hdl64(columns).ray_angles("corner")
    rows, cols = (R2FLOW[f"angles_64x{columns}/{k}"].numpy() for k in ("rows", "cols"))
    expected = R2FLOW[f"angles_64x{columns}/values"].numpy()
    assert np.allclose(elevation[np.ix_(rows, cols)], expected[0], atol=1e-6)
    assert np.allclose(-azimuth[np.ix_(rows, cols)], expected[1], atol=1e-6)


@pytest.mark.parametrize(
    ("golden", "ours"),
    [
        ("logscale", "r2flow"),
        ("inverse", "r2flow_inverse"),
        ("metric", "r2flow_metric"),
    ],
)
def test_r2flow_scales(golden: str, ours: str) -> None:
    scale = NORMALISATIONS[ours]
    depth = R2FLOW["input.depth"]
    assert torch.equal(scale.inside(depth).float(), R2FLOW["mask"])
    assert torch.allclose(
        scale.encode(depth), R2FLOW[f"{golden}/normalised"], rtol=1e-5, atol=1e-6
    )
    for given, restored in (
        (f"{golden}/normalised", f"{golden}/restored"),
        ("noise", f"{golden}/restored_of_noise"),
    ):
        assert torch.allclose(scale.decode(R2FLOW[given]), R2FLOW[restored], rtol=1e-5)


def test_r2flow_points() -> None:
    depth = torch.where(
        NORMALISATIONS["r2flow"].inside(R2FLOW["input.depth"]), R2FLOW["input.depth"], 0
    )
    for values, expected in zip(
        depth[:, 0].numpy(), R2FLOW["cartesian/normalised"].numpy(), strict=True
    ):
        image = RangeImage(values, hdl64(16, rows=8))
        points = unproject(image, rays="corner").points
        assert np.allclose(points, expected[:, image.mask].T, atol=1e-4)
        assert not expected[:, ~image.mask].any()


@pytest.fixture(scope="module")
def kitti_scan(real_scans: Path) -> Scan:
    points = read_points(real_scans / "kitti_object/training/velodyne/000000.bin")
    return Scan(points[:, :3], points[:, 3], hdl64(1024))


@pytest.mark.parametrize("columns", [1024, 2048])
@pytest.mark.parametrize("kind", ["spherical", "unfolding"])
def test_r2flow_projection_of_a_real_scan(
    golden: Golden, kitti_scan: Scan, kind: str, columns: int
) -> None:
    expected = np.load(golden / "r2flow_projection.npz")
    image = (project if kind == "spherical" else unfold)(kitti_scan, hdl64(columns))
    different = image.range != expected[f"{kind}_{columns}/depth"].reshape(64, columns)
    assert different.sum() <= {1024: 5, 2048: 40}[columns]
    same = ~different
    assert np.array_equal(
        image.reflectance[same],
        expected[f"{kind}_{columns}/reflectance"].reshape(64, columns)[same],
    )


def test_lidm_projection_of_a_real_scan(golden: Golden, kitti_scan: Scan) -> None:
    expected = np.load(golden / "lidm_projection.npz")
    image = project(kitti_scan, lidm(1024))
    different = np.where(image.mask, image.range, -1) != expected["range"]
    assert different.sum() <= 5
    assert np.array_equal(
        np.where(image.mask, image.reflectance, -1)[~different],
        expected["remission"][~different],
    )


@pytest.mark.parametrize(("name", "offset"), [("log", 1e-4), ("linear", 0.0)])
def test_lidm_scales_and_points(
    golden: Golden, kitti_scan: Scan, name: str, offset: float
) -> None:
    """LiDM adds 0.1 mm before the logarithm and does not subtract it again; its rays point to cell
    corners."""
    expected = np.load(golden / "lidm_projection.npz")
    scale: Normalisation = NORMALISATIONS[f"lidm_{name}"]
    image = project(kitti_scan, lidm(1024))
    x = scale.encode(torch.from_numpy(image.range))
    stored = expected["log/image" if name == "log" else "crop_linear_image"]
    assert np.allclose(x.numpy()[: len(stored)], stored, atol=1e-6)
    decoded = RangeImage(scale.decode(x).numpy(), image.sensor)
    points = unproject(decoded, rays="corner").points[:4096]
    far = points * (1 + offset / np.linalg.norm(points, axis=1, keepdims=True))
    assert np.allclose(far, expected[f"{name}/points_first_4096"], atol=1e-4)
    assert np.array_equal(
        decoded.mask, np.asarray(expected[f"{name}/mask"]).reshape(64, 1024) > 0
    )


def test_a_third_party_projection_of_a_semantic_kitti_scan(real_scans: Path) -> None:
    theirs = np.load(real_scans / "semantic_kitti/range_images_64x1024/00_000000.npz")[
        "image"
    ]
    points = read_points(real_scans / "semantic_kitti/sequences/00/velodyne/000000.bin")
    image = project(Scan(points[:, :3], points[:, 3], hdl64(1024)))
    assert np.array_equal(image.range, theirs[..., 4])
    assert np.array_equal(image.reflectance, theirs[..., 3])
