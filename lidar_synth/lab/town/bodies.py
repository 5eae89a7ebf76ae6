"""Pedestrians and riders, as tubes and ellipsoids in a sequence of poses.

The joints of a walker follow a phase in radians; one stride is 2 pi. A rider shares one mesh, one
instance and one box with its bicycle or motorcycle, as in the labels of SemanticKITTI and KITTI.
"""

from functools import cache
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.town.catalogue import TABLES
from lidar_synth.lab.town.materials import read_finishes
from lidar_synth.lab.town.meshes import Mesh, ball, boxes, merge, tube
from lidar_synth.lab.town.objects import Prototype, assemble
from lidar_synth.lab.town.vehicles import vehicles

TOP, TROUSERS, SKIN, HAIR, SHOE, BAG = range(6)
PHASES = 8
"""Number of poses in a walker's stride."""

_BODY = read_finishes(TABLES["finishes"]["person"])


def _torso(hip: ArrayLike, neck: ArrayLike) -> Mesh:
    """The torso and the head of a person, between the hip and the neck."""
    h = np.array(hip)
    n = np.array(neck)
    up = n - h
    skull = n + up / np.linalg.norm(up) * 0.16 + np.array((0.02, 0, 0))
    spine = [h - 0.12 * up, h, h + 0.62 * up, h + 0.9 * up, n, skull]
    trunk = tube(spine, (0.15, 0.18, 0.205, 0.165, 0.085, 0.06), 8, TOP)
    flat = ((trunk.triangles - h) * (0.8, 1.0, 1.0) + h).astype(np.float32)
    hair = skull - (0.02, 0, -0.035)
    return merge(
        [
            Mesh(flat, trunk.slot),
            ball(skull, (0.11, 0.10, 0.135), SKIN, 5, 8),
            ball(hair, (0.115, 0.11, 0.125), HAIR, 4, 8),
        ]
    )


def _thigh(*joints: Any) -> Mesh:
    return tube(joints, (0.115, 0.09, 0.075), 6, TROUSERS)


def _shoe(*ends: Any) -> Mesh:
    return tube(ends, (0.05, 0.04), 5, SHOE)


def _arm(*joints: Any) -> Mesh:
    return tube(joints, (0.07, 0.06, 0.05), 5, TOP)


def _leg(
    side: int,
    turn: float,
    stride: float,
    height: float,
) -> list[Mesh]:
    """The leg and the shoe of a walker on one side; ``height`` is that of the hip."""
    swing = stride * 0.42 * np.sin(turn)
    bend = swing - stride * 0.55 * max(0.0, np.cos(turn))
    y = side * 0.12
    x = 0.44 * np.sin(swing)
    z = height - 0.44 * np.cos(swing)
    foot = x + 0.42 * np.sin(bend)
    low = max(0.07, z - 0.42 * np.cos(bend))
    return [
        _thigh((0, y, height + 0.02), (x, y, z), (foot, y, low)),
        _shoe((foot - 0.06, y, low - 0.03), (foot + 0.17, y, low - 0.04)),
    ]


def _swinging_arm(side: int, turn: float, stride: float) -> list[Mesh]:
    """The arm and the hand of a walker on one side."""
    arm = -stride * 0.38 * np.sin(turn)
    x = 0.02 + 0.29 * np.sin(arm)
    z = 1.37 - 0.29 * np.cos(arm)
    bent = arm + 0.3
    forward = x + 0.25 * np.sin(bent)
    up = z - 0.25 * np.cos(bent)
    hand = (forward, side * 0.26, up)
    return [
        _arm((0.02, side * 0.20, 1.37), (x, side * 0.25, z), hand),
        ball(hand, 0.045, SKIN, 3, 5),
    ]


def _walker(phase: float, stride: float, bag: bool) -> Mesh:
    """A person 1.75 m tall; ``stride`` scales the swing of the limbs, 0 = standing."""
    height = 0.93 - 0.02 * stride * abs(np.sin(phase))
    sides = [
        [*_leg(side, turn, stride, height), *_swinging_arm(side, turn, stride)]
        for side, turn in ((-1, phase), (1, phase + np.pi))
    ]
    parts = [_torso((0, 0, height), (0.03, 0, 1.45)), *chain(*zip(*sides, strict=True))]
    if bag:
        parts.append(boxes([(-0.30, -0.15, 1.02)], [(-0.13, 0.15, 1.42)], BAG))
    return merge(parts)


@cache
def walker(phase: int, standing: bool = False, bag: bool = False) -> Prototype:
    """A pedestrian in pose number ``phase`` of the ``PHASES`` poses of a stride."""
    mesh = _walker(2 * np.pi * phase / PHASES, 0.5 if standing else 1.0, bag)
    return Prototype(mesh, _BODY, "Pedestrian", (30, 254))


@cache
def sitter() -> Prototype:
    """A person on a seat 0.45 m high."""
    body = _torso((-0.06, 0, 0.52), (-0.02, 0, 1.02))
    mesh = merge([body, assemble("sitter")])
    return Prototype(mesh, _BODY, "Person_sitting", (30, 254))


def _bend_knee(top: Float64Array, foot: Float64Array) -> Float64Array:
    """The place of the knee of a leg of 0.88 m, in front of the line from hip to foot."""
    reach = max(0.05, 0.44**2 - float(np.sum((foot - top) ** 2)) / 4) ** 0.5
    across = np.array((top[2] - foot[2], 0, foot[0] - top[0]))
    return np.asarray((foot + top) / 2 + reach * across / np.linalg.norm(across))


def _rider(
    hip: tuple[float, float, float],
    neck: ArrayLike,
    grip: ArrayLike,
    feet: ArrayLike,
) -> Mesh:
    """A person on a saddle at ``hip``; x and z of the left and of the right foot."""
    parts = [_torso(hip, neck)]
    for side, (x, z) in zip((-1, 1), np.asarray(feet), strict=True):
        foot = np.array((x, side * 0.11, z))
        top = np.array((hip[0], side * 0.1, hip[2]))
        shoulder = np.array(neck) - (0, -side * 0.18, 0.04)
        hand = np.array(grip) * (1, side, 1)
        elbow = (shoulder + hand) / 2 + (0, side * 0.05, -0.08)
        parts += [
            _thigh(top, _bend_knee(top, foot), foot),
            _shoe(foot - (0.05, 0, 0.03), foot - (-0.16, 0, 0.03)),
            _arm(shoulder, elbow, hand),
        ]
    return merge(parts)


@cache
def cyclist(phase: int) -> Prototype:
    """A cyclist in position number ``phase`` of the ``PHASES`` positions of the pedals."""
    turn = 2 * np.pi * phase / PHASES
    feet = [
        (-0.08 + 0.17 * np.cos(a), 0.30 + 0.17 * np.sin(a))
        for a in (turn, turn + np.pi)
    ]
    person = _rider((-0.22, 0, 1.0), (0.05, 0, 1.50), (0.30, 0.26, 1.05), feet)
    return _mount(person, "bicycle", "Cyclist", (31, 253))


@cache
def motorcyclist() -> Prototype:
    """A motorcyclist with a helmet."""
    feet = [(0.0, 0.35), (0.0, 0.35)]
    person = _rider((-0.30, 0, 0.90), (-0.02, 0, 1.42), (0.42, 0.32, 1.02), feet)
    return _mount(person, "motorcycle", "Misc", (32, 255))


def _mount(
    person: Mesh,
    machine: str,
    name: str,
    raw: tuple[int, int],
) -> Prototype:
    """The prototype of a rider together with the bicycle or motorcycle."""
    below = vehicles()[machine]
    parts = Mesh(below.mesh.triangles, below.mesh.slot + len(_BODY))
    finishes = (*_BODY, *below.painted((0.2, 0.22, 0.26)))
    return Prototype(merge([person, parts]), finishes, name, raw)
