"""Pedestrians and riders, as tubes and ellipsoids in a sequence of poses.

The joints of a walker follow a phase in radians; one stride is 2 pi. A rider shares one mesh, one
instance and one box with its bicycle or motorcycle, as in the labels of SemanticKITTI and KITTI.
"""

from functools import cache

import numpy as np

from lidar_synth.lab.town import bodywork
from lidar_synth.lab.town.cycles import bicycle_mesh, motorcycle_mesh
from lidar_synth.lab.town.materials import RGB, Finish
from lidar_synth.lab.town.meshes import Mesh, ball, boxes, merge, tubes
from lidar_synth.lab.town.prototype import Prototype

TOP, TROUSERS, SKIN, HAIR, SHOE, BAG = range(6)
CLOTHES: tuple[RGB, ...] = (
    (0.15, 0.17, 0.25),
    (0.10, 0.10, 0.11),
    (0.55, 0.12, 0.12),
    (0.75, 0.74, 0.70),
    (0.30, 0.42, 0.55),
    (0.34, 0.36, 0.30),
    (0.62, 0.52, 0.38),
    (0.18, 0.30, 0.22),
    (0.85, 0.80, 0.25),
    (0.45, 0.28, 0.42),
)
PHASES = 8
"""Number of poses in a walker's stride."""

_BODY = (
    Finish("cloth", (0.3, 0.3, 0.4)),
    Finish("cloth", (0.16, 0.18, 0.24)),
    Finish("skin"),
    Finish("cloth", (0.16, 0.11, 0.07)),
    Finish("plastic", (0.08, 0.07, 0.07)),
    Finish("cloth", (0.25, 0.2, 0.15)),
)


def _torso(
    hip: tuple[float, float, float],
    neck: tuple[float, float, float],
    top: int,
    head: int,
) -> Mesh:
    """The torso and the head of a person, between the hip and the neck."""
    h = np.array(hip)
    n = np.array(neck)
    chest = h + 0.62 * (n - h)
    skull = n + (n - h) / np.linalg.norm(n - h) * 0.16 + (0.02, 0, 0)
    spine = [h - 0.12 * (n - h), h, chest, h + 0.9 * (n - h), n, skull]
    trunk = tubes([(spine, (0.12, 0.155, 0.19, 0.17, 0.07, 0.05))], 8, top).triangles
    flat = ((trunk - h) * (0.72, 1.0, 1.0) + h).astype(np.float32)
    return merge(
        [
            Mesh(flat, np.full(len(flat), top, np.int32)),
            ball(skull, (0.10, 0.085, 0.13), SKIN, 5, 8),
            ball(skull + np.array((-0.02, 0, 0.035)), (0.105, 0.095, 0.12), head, 4, 8),
        ]
    )


def _walker(phase: float, stride: float, bag: bool) -> Mesh:
    """A person 1.75 m tall; ``stride`` scales the swing of the limbs, 0 = standing."""
    hip = (0.0, 0.0, 0.93 - 0.02 * stride * abs(np.sin(phase)))
    neck = (0.03, 0.0, 1.45)
    legs = []
    shoes = []
    arms = []
    hands = []
    for side, turn in ((-1, phase), (1, phase + np.pi)):
        swing = stride * 0.42 * np.sin(turn)
        bend = stride * 0.55 * max(0.0, np.cos(turn))
        y = side * 0.10
        knee = (0.44 * np.sin(swing), y, hip[2] - 0.44 * np.cos(swing))
        ankle = (
            knee[0] + 0.42 * np.sin(swing - bend),
            y,
            max(0.07, knee[2] - 0.42 * np.cos(swing - bend)),
        )
        legs.append(([(0, y, hip[2] + 0.02), knee, ankle], (0.085, 0.06, 0.045)))
        shoes.append(
            (
                [
                    (ankle[0] - 0.06, y, ankle[2] - 0.03),
                    (ankle[0] + 0.17, y, ankle[2] - 0.04),
                ],
                (0.04, 0.03),
            )
        )
        arm = -stride * 0.38 * np.sin(turn)
        elbow = (0.02 + 0.29 * np.sin(arm), side * 0.23, 1.40 - 0.29 * np.cos(arm))
        hand = (
            elbow[0] + 0.25 * np.sin(arm + 0.3),
            side * 0.24,
            elbow[2] - 0.25 * np.cos(arm + 0.3),
        )
        arms.append(([(0.02, side * 0.19, 1.41), elbow, hand], (0.055, 0.045, 0.035)))
        hands.append((np.array(hand), 0.045))
    parts = [
        _torso(hip, neck, TOP, HAIR),
        tubes(legs, 6, TROUSERS),
        tubes(shoes, 5, SHOE),
        tubes(arms, 5, TOP),
    ]
    parts += [ball(at, size, SKIN, 3, 5) for at, size in hands]
    if bag:
        parts.append(boxes([(-0.30, -0.15, 1.02)], [(-0.13, 0.15, 1.42)], BAG))
    return merge(parts)


@cache
def walker(phase: int, standing: bool = False, bag: bool = False) -> Prototype:
    """A pedestrian in pose number ``phase`` of the ``PHASES`` poses of a stride."""
    mesh = _walker(2 * np.pi * phase / PHASES, 0.12 if standing else 1.0, bag)
    return Prototype(mesh, _BODY, "Pedestrian", (30, 254))


@cache
def sitter() -> Prototype:
    """A person on a seat 0.45 m high."""
    legs = [
        (
            [(-0.05, s * 0.1, 0.52), (0.38, s * 0.11, 0.52), (0.40, s * 0.11, 0.08)],
            (0.085, 0.065, 0.045),
        )
        for s in (-1, 1)
    ]
    shoes = [
        ([(0.35, s * 0.11, 0.045), (0.58, s * 0.12, 0.035)], (0.04, 0.03))
        for s in (-1, 1)
    ]
    arms = [
        (
            [(0.0, s * 0.19, 0.98), (0.08, s * 0.24, 0.74), (0.32, s * 0.12, 0.66)],
            (0.055, 0.045, 0.04),
        )
        for s in (-1, 1)
    ]
    body = _torso((-0.06, 0, 0.52), (-0.02, 0, 1.02), TOP, HAIR)
    mesh = merge(
        [body, tubes(legs, 6, TROUSERS), tubes(shoes, 5, SHOE), tubes(arms, 5, TOP)]
    )
    return Prototype(mesh, _BODY, "Person_sitting", (30, 254))


def _rider(
    hip: tuple[float, float, float],
    neck: tuple[float, float, float],
    grip: tuple[float, float, float],
    feet: tuple[tuple[float, float], tuple[float, float]],
    head: int,
) -> Mesh:
    parts = [_torso(hip, neck, TOP, head)]
    for side, (x, z) in zip((-1, 1), feet, strict=True):
        foot = np.array((x, side * 0.11, z))
        top = np.array((hip[0], side * 0.1, hip[2]))
        middle = (foot + top) / 2
        reach = max(0.05, 0.44**2 - float(np.sum((foot - top) ** 2)) / 4) ** 0.5
        across = np.array((top[2] - foot[2], 0, foot[0] - top[0]))
        knee = middle + reach * across / np.linalg.norm(across)
        shoulder = np.array(neck) + np.array((0.0, side * 0.18, -0.04))
        hand = np.array(grip) * (1, side, 1)
        elbow = (shoulder + hand) / 2 + np.array((0.0, side * 0.05, -0.08))
        parts += [
            tubes([([top, knee, foot], (0.085, 0.06, 0.045))], 6, TROUSERS),
            tubes(
                [
                    (
                        [
                            foot - np.array((0.05, 0, 0.03)),
                            foot + np.array((0.16, 0, -0.03)),
                        ],
                        (0.04, 0.03),
                    )
                ],
                5,
                SHOE,
            ),
            tubes([([shoulder, elbow, hand], (0.055, 0.045, 0.035))], 5, TOP),
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
    person = _rider(
        (-0.22, 0, 1.0), (0.05, 0, 1.50), (0.30, 0.26, 1.05), (feet[0], feet[1]), HAIR
    )
    return _mounted(person, bicycle_mesh(), "Cyclist", (31, 253))


@cache
def motorcyclist() -> Prototype:
    """A motorcyclist with a helmet."""
    person = _rider(
        (-0.30, 0, 0.90),
        (-0.02, 0, 1.42),
        (0.42, 0.32, 1.02),
        ((0.0, 0.35), (0.0, 0.35)),
        HAIR,
    )
    return _mounted(person, motorcycle_mesh(), "Misc", (32, 255))


def _mounted(person: Mesh, machine: Mesh, name: str, raw: tuple[int, int]) -> Prototype:
    """The prototype of a rider together with the bicycle or motorcycle."""
    below = Mesh(machine.triangles, machine.slot + len(_BODY))
    frame = (Finish("paint", (0.2, 0.22, 0.26)), *bodywork.FINISHES[1:])
    return Prototype(merge([person, below]), (*_BODY, *frame), name, raw)
