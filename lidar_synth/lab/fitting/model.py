"""The joint fit of beams, mounting and motion.

A tilt or an offset of the given frame, and the motion during a turn that motion compensation has
added, bend the lines of the beams (geometry/lines.py); both are linear in the residual while they
are small, so Gauss-Newton steps with robust (Cauchy) weights find them together with the beams.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lidar_synth.geometry.arrays import Float64Array, Int64Array
from lidar_synth.geometry.lines import nearest_beams, residuals
from lidar_synth.geometry.motion import rotate

STEPS = 12
CAP = np.radians(0.1)
"""Residuals count up to this in the comparison of models, radians."""

PRIOR_HEIGHT = 0.03
PRIOR_SPEED = 20.0
PRIOR_TURN = 2.0
"""Standard deviations of heights about their median (metres), speeds (m/s) and turn rates
(rad/s)."""
PRIOR_HEIGHT_STEP = 0.0002
"""Scale of the differences between the heights of neighbouring beams, metres."""


@dataclass
class Cloud:
    """The points of several scans.

    Args:
        points: (N, 3) metres, in the frame in which they are given.
        scan: (N,) number of the scan of each.
        time: (N,) seconds of each point within its scan; zero if not known.
        ring: (N,) number of the beam, -1 = not known.
        kept: whether the rings come from the file and stay as they are.
    """

    points: Float64Array
    scan: Int64Array
    time: Float64Array
    ring: Int64Array
    kept: bool = False


@dataclass(frozen=True)
class Model:
    """Beams, mounting and motion.

    Args:
        tangents: (B,) tangents of the elevations, highest first.
        heights: (B,) metres above the origin.
        offset: (3,) the sensor's origin in the given frame, metres.
        turn: (3, 3) rotation from the sensor's frame to the given one.
        motion: (S, 6) velocity (m/s) and turn rate (rad/s) during each scan.
    """

    tangents: Float64Array
    heights: Float64Array
    offset: Float64Array
    turn: Float64Array
    motion: Float64Array

    def aligned(self, cloud: Cloud) -> Float64Array:
        """(N, 3) points in the sensor's own frame at the moment of each."""
        points = cloud.points
        if self.motion.any():
            step = self.motion[cloud.scan] * cloud.time[:, None]
            points = rotate(points - step[:, :3], -step[:, 3:])
        return np.asarray((points - self.offset) @ self.turn)


def refine(
    cloud: Cloud, model: Model, free: frozenset[str], steps: int = STEPS
) -> tuple[Model, Cloud]:
    """Fit the model to a cloud.

    Args:
        cloud: with rings of the beams of ``model``, or -1 everywhere.
        model: where to start.
        free: which parts besides the tangents to fit, of "heights", "mount" and "motion".
        steps: number of Gauss-Newton steps; rings that are not kept are assigned again before each.

    Returns:
        The model, and the cloud with its rings.
    """
    for _ in range(steps):
        points = model.aligned(cloud)
        if not cloud.kept:
            cloud = replace(
                cloud, ring=nearest_beams(points, model.tangents, model.heights)
            )
        model = _step(cloud, points, model, free)
    return model, cloud


def _step(
    cloud: Cloud, points: Float64Array, model: Model, free: frozenset[str]
) -> Model:
    beams = len(model.tangents)
    scans = len(model.motion)
    residual = residuals(points, cloud.ring, model.tangents, model.heights)
    spread = _spread_of_scans(residual, cloud.scan, scans)
    scale = float(spread.min())
    jacobian = _jacobian(points, cloud, model)
    weight = (scale / spread[cloud.scan]) ** 2 / (
        1 + (residual / spread[cloud.scan]) ** 2
    )
    size = 2 * beams + 6 + 6 * scans
    normal = np.zeros((size, size))
    right = np.zeros(size)
    key = cloud.scan * beams + cloud.ring
    order = np.argsort(key, kind="stable")
    for block in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        ring = int(cloud.ring[block[0]])
        scan = int(cloud.scan[block[0]])
        own = 2 * beams + 6 + 6 * scan
        index = np.r_[2 * ring, 2 * ring + 1, 2 * beams : 2 * beams + 6, own : own + 6]
        part = jacobian[block]
        weighted = part * weight[block, None]
        normal[np.ix_(index, index)] += weighted.T @ part
        right[index] -= weighted.T @ residual[block]
    _add_priors(normal, right, model, scale)
    step = _solve(normal, right, _active(beams, scans, free))
    return _moved(model, step)


def _spread_of_scans(
    residual: Float64Array, scan: Int64Array, scans: int
) -> Float64Array:
    """(S,) scale of the robust weights, radians: a scan that is still bent by motion keeps a wide
    one."""
    spread = np.full(scans, np.inf)
    for number in np.unique(scan):
        spread[number] = max(
            2.0 * float(np.median(np.abs(residual[scan == number]))), 1e-7
        )
    return spread


def _jacobian(points: Float64Array, cloud: Cloud, model: Model) -> Float64Array:
    """(N, 14) change of the residual per tangent, height, mounting (offset, tilt) and motion (the
    same, times time)."""
    x, y, z = points.T
    rho = np.maximum(np.hypot(x, y), 1e-3)
    tangent = model.tangents[cloud.ring]
    # residual = (z - h - rho tan e) rho / (rho^2 + (z - h)^2), to first order
    gain = rho / (rho**2 + (z - model.heights[cloud.ring]) ** 2)
    lever = 1 + tangent * z / rho
    shift = np.stack(
        [
            tangent * x / rho,
            tangent * y / rho,
            -np.ones_like(x),
            -y * lever,
            x * lever,
            0 * x,
        ],
        1,
    )
    columns = [-rho[:, None], -np.ones((len(x), 1)), shift, shift * cloud.time[:, None]]
    return np.asarray(np.concatenate(columns, 1) * gain[:, None])


def _add_priors(
    normal: Float64Array, right: Float64Array, model: Model, scale: float
) -> None:
    beams = len(model.tangents)
    scans = len(model.motion)
    sigma = np.full(len(right), np.inf)
    now = np.zeros(len(right))
    sigma[1 : 2 * beams : 2] = PRIOR_HEIGHT
    now[1 : 2 * beams : 2] = model.heights - np.median(model.heights)
    motion = slice(2 * beams + 6, None)
    sigma[motion] = np.tile(np.repeat([PRIOR_SPEED, PRIOR_TURN], 3), scans)
    now[motion] = model.motion.ravel()
    strength = (scale / sigma) ** 2
    normal[np.diag_indices_from(normal)] += strength
    right -= strength * now
    _add_block_prior(normal, right, model, scale)


def _add_block_prior(
    normal: Float64Array, right: Float64Array, model: Model, scale: float
) -> None:
    """Lasers of one block stand at nearly the same height; robust, because there can be several
    blocks."""
    step = np.diff(model.heights)
    alike = (scale / PRIOR_HEIGHT_STEP) ** 2 / (1 + (step / PRIOR_HEIGHT_STEP) ** 2)
    upper = 2 * np.arange(len(step)) + 1
    lower = upper + 2
    normal[upper, upper] += alike
    normal[lower, lower] += alike
    normal[upper, lower] -= alike
    normal[lower, upper] -= alike
    right[upper] += alike * step
    right[lower] -= alike * step


def _active(beams: int, scans: int, free: frozenset[str]) -> NDArray[np.bool_]:
    """Which unknowns are fitted. A turn about the vertical axis changes no elevation; heights
    include a common one."""
    beam = [True, "heights" in free]
    mount = np.array([True, True, "heights" not in free, True, True, False]) & (
        "mount" in free
    )
    motion = np.array([True, True, True, True, True, False]) & ("motion" in free)
    return np.concatenate([np.tile(beam, beams), mount, np.tile(motion, scans)])


def _solve(
    normal: Float64Array, right: Float64Array, active: NDArray[np.bool_]
) -> Float64Array:
    step = np.zeros(len(right))
    use = np.flatnonzero(active & (np.diag(normal) > 0))
    size = 1 / np.sqrt(np.diag(normal)[use])
    scaled = normal[np.ix_(use, use)] * size[:, None] * size + 1e-12 * np.eye(len(use))
    step[use] = size * np.linalg.solve(scaled, size * right[use])
    return step


def _moved(model: Model, step: Float64Array) -> Model:
    """The model after a step; the mounting moves in the sensor's frame."""
    beams = len(model.tangents)
    shift = step[2 * beams : 2 * beams + 3]
    tilt = step[2 * beams + 3 : 2 * beams + 6]
    turned = Rotation.from_rotvec(tilt).as_matrix()
    motion = model.motion + step[2 * beams + 6 :].reshape(-1, 6)
    return Model(
        tangents=model.tangents + step[: 2 * beams : 2],
        heights=model.heights + step[1 : 2 * beams : 2],
        offset=model.offset + model.turn @ shift,
        turn=model.turn @ turned,
        motion=motion,
    )
