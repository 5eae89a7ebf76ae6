"""Firings per turn and the azimuth offset of each beam.

The azimuths of a beam lie on a lattice where the sensor fires at fixed angles (Ouster) or reads its
encoder in steps (Velodyne: 4000 per turn). On a lattice finer than the firings, firings skip steps
in a pattern that changes with the rotation speed. All beams show the same pattern, each turned by
its own offset, so correlation finds the offsets. With the time of each point, or points in the
order of time, the offset is the azimuth beyond that of the turning head.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lidar_synth.geometry.arrays import Float64Array, Int64Array

FAR = 4.0
"""Metres; nearer points are left out where the time gives the offsets."""

DISTANT = 20.0
"""Metres; the azimuths of nearer points depend on the lasers' lateral offset too much to find a
lattice."""

BINS = 1 << 17
"""Bins of a turn in the search for a lattice."""

COHERENT = 0.5
"""Share of the points on a common phase from which azimuths are on a lattice."""

LARGEST_OFFSET = 20.0
"""Degrees."""

SIDES = np.arange(-0.06, 0.0601, 0.002)
"""Lateral offsets of lasers that are tried, metres."""

FEWEST = 10
"""A beam needs as many far points in a scan for its offset by the time."""

FEW = 100
"""A beam needs as many points in a scan."""

UNEVEN = 0.23
"""Spread of the steps between neighbouring points, in their mean, from which too many firings
between them are missing: an encoder's is 0.21, that of points of which half are missing at random
0.34."""


@dataclass(frozen=True)
class Azimuths:
    """What is known of the firings.

    Args:
        firings: of each beam in a turn; None if not found.
        lattice: steps of a turn on which the azimuths lie, None if they lie on none.
        offsets: (B,) degrees, clockwise, NaN for beams of which it is not known; None if not found.
        known: how the offsets are known: "time", "encoder", "one firing" (up to a multiple of the
            angle between firings) or "".
        spread: degrees, the median disagreement of offsets between scans or within them.
        sides: (B,) metres, by which each laser stands left of the axis, as it looks outward; zero
            if not found.
    """

    firings: int | None = None
    lattice: int | None = None
    offsets: Float64Array | None = None
    known: str = ""
    spread: float = 0.0
    sides: Float64Array | None = None


@dataclass(frozen=True)
class Turn:
    """One scan in the sensor's frame: (N,) azimuth in turns (clockwise), distance from the axis,
    beam, time or None."""

    azimuth: Float64Array
    rho: Float64Array
    ring: Int64Array
    time: Float64Array | None


def turn_of(points: Float64Array, ring: Int64Array, time: Float64Array | None) -> Turn:
    """A scan as azimuths.

    Args:
        points: (N, 3) metres, in the sensor's frame.
        ring: (N,) beam.
        time: (N,) anything that grows with time, None if not known.
    """
    azimuth = (-np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)) % 1.0
    return Turn(azimuth, np.hypot(points[:, 0], points[:, 1]), ring, time)


def fit_azimuths(turns: list[Turn], beams: int) -> Azimuths:
    """Firings and offsets from some scans of a sensor with this number of beams."""
    counts = [count for turn in turns if (count := _firings(turn, beams))]
    timed = all(turn.time is not None for turn in turns)
    if not counts and timed:
        by_scan = np.stack([_offsets_by_time(turn, beams) for turn in turns])
        return Azimuths(None, None, *_combined(by_scan, beams, "time"))
    if not counts:
        return Azimuths()
    firings = float(np.median(counts))
    lattices = [(_lattice(turn, beams, firings)) for turn in turns]
    coherence, lattice = max(lattices)
    on_lattice = coherence > COHERENT
    locked = on_lattice and abs(lattice / firings - 1) < 0.02
    count = lattice if locked else round(firings)
    size = lattice if on_lattice else None
    if timed:
        by_scan = np.stack([_offsets_by_time(turn, beams) for turn in turns])
        return Azimuths(count, size, *_combined(by_scan, beams, "time"))
    if not on_lattice:
        return Azimuths(count)
    # Motion compensation blurs the lattice, so only scans that show it count.
    clear = [
        turn
        for turn, (value, found) in zip(turns, lattices, strict=True)
        if value > COHERENT and found == lattice
    ]
    sides = np.median([_sides(turn, beams, lattice) for turn in clear], axis=0)
    phases = [_phases(turn, beams, lattice, sides) for turn in clear]
    if locked:
        by_scan = np.stack([(_wrap(phase - 0.5)) * 360 / lattice for phase in phases])
        return Azimuths(
            count, size, *_combined(by_scan, beams, "one firing", 360 / lattice), sides
        )
    by_scan = np.stack(
        [
            _by_pattern(t, beams, lattice, sides, p)
            for t, p in zip(clear, phases, strict=True)
        ]
    )
    return Azimuths(count, size, *_combined(by_scan, beams, "encoder"), sides)


def _wrap(turns: Float64Array) -> Float64Array:
    """The same fraction of a period in [-0.5, 0.5)."""
    return np.asarray((turns + 0.5) % 1.0 - 0.5)


def _combined(
    by_scan: Float64Array, beams: int, known: str, period: float = 360.0
) -> tuple[Float64Array | None, str, float]:
    """Offsets (B,) as the median over scans (S, B), how they are known, and the median
    disagreement.

    A beam of which no scan knows the offset has NaN.
    """
    reference = np.nan_to_num(by_scan[0])
    turned = reference + period * _wrap((by_scan - reference) / period)
    seen = ~np.isnan(turned).all(0)
    if not seen.any():
        return None, "", 0.0
    offsets = np.full(beams, np.nan)
    offsets[seen] = np.nanmedian(turned[:, seen], axis=0)
    spread = float(np.nanmedian(np.abs(turned[:, seen] - offsets[seen])))
    return offsets, known, spread


def _firings(turn: Turn, beams: int) -> float:
    """Firings per turn: one over the mean step between neighbouring points of a beam; 0 if too many
    are missing."""
    steps = []
    for beam in range(beams):
        own = np.sort(turn.azimuth[turn.ring == beam])
        if len(own) >= FEW:
            steps.append(np.diff(own))
    if not steps:
        return 0.0
    positive = [step[step > 2e-5] for step in steps]
    typical = float(np.median(np.concatenate(positive)))
    # Longer steps are missing returns. An encoder makes single steps up to half as long.
    single = [
        step[(step > 0.3 * typical) & (step < 1.4 * typical)] for step in positive
    ]
    single = [step for step in single if len(step)]
    if np.median([step.std() / step.mean() for step in single]) > UNEVEN:
        return 0.0
    return float(np.median([1 / step.mean() for step in single]))


def _measure_powers(turn: Turn, beams: int) -> Iterator[Float64Array]:
    """The power spectrum of the azimuths of each beam with enough distant points."""
    for beam in range(beams):
        own = turn.azimuth[(turn.ring == beam) & (turn.rho > DISTANT)]
        if len(own) >= FEW:
            bins = (own * BINS).astype(np.int64) % BINS
            histogram = np.bincount(bins, minlength=BINS)
            yield (np.abs(np.fft.rfft(histogram)) / len(own)) ** 2


def _lattice(turn: Turn, beams: int, firings: float) -> tuple[float, int]:
    """Coherence and number of steps per turn of the coarsest lattice of the azimuths."""
    powers = list(_measure_powers(turn, beams))
    if not powers:
        return 0.0, 0
    first = int(0.9 * firings)
    last = int(min(4.5 * firings, BINS / 8))
    coherence = np.sqrt(np.sum(powers, axis=0)[first:last] / len(powers))
    best = float(coherence.max(initial=0.0))
    strong = np.flatnonzero(coherence > 0.8 * best)
    if not len(strong):
        return 0.0, 0
    near = strong[strong < strong[0] + 3]
    return best, first + int(near[np.argmax(coherence[near])])


def _sides(turn: Turn, beams: int, lattice: int) -> Float64Array:
    """(B,) lateral offset of each laser, metres, that makes its azimuths most coherent."""
    sides = np.zeros(beams)
    for beam in range(beams):
        own = turn.ring == beam
        if own.sum() < FEW:
            continue
        azimuth = turn.azimuth[own][::2]
        near = 1 / (2 * np.pi * turn.rho[own][::2])
        phase = 2j * np.pi * lattice * (azimuth + SIDES[:, None] * near)
        value = np.abs(np.exp(phase).mean(1))
        best = int(np.argmax(value))
        sides[beam] = (
            SIDES[best] if value[best] > value[len(SIDES) // 2] + 0.02 else 0.0
        )
    return sides


def _phases(turn: Turn, beams: int, lattice: int, sides: Float64Array) -> Float64Array:
    """(B,) the part of a lattice step by which each beam's azimuths differ from whole steps, in
    [-0.5, 0.5)."""
    seen = turn.azimuth + sides[turn.ring] / (2 * np.pi * turn.rho)
    wave = np.exp(2j * np.pi * lattice * seen)
    real, imaginary = (
        np.bincount(turn.ring, part, beams) for part in (wave.real, wave.imag)
    )
    phase = np.arctan2(imaginary, real) / (2 * np.pi)
    return np.where(np.bincount(turn.ring, minlength=beams) >= FEW, phase, np.nan)


def _by_pattern(
    turn: Turn,
    beams: int,
    lattice: int,
    sides: Float64Array,
    phases: Float64Array,
) -> Float64Array:
    """(B,) degrees: offsets that align the patterns of skipped encoder steps; their median is 0."""
    seen = turn.azimuth + sides[turn.ring] / (2 * np.pi * turn.rho)
    step = (
        np.round(lattice * seen - np.nan_to_num(phases)[turn.ring]).astype(np.int64)
        % lattice
    )
    hit = np.zeros((beams, lattice), bool)
    hit[turn.ring, step] = True
    following = np.roll(hit, -1, 1)
    second = np.roll(hit, -2, 1)
    pattern = np.where(hit & following, 1.0, np.where(hit & second, -0.2, 0.0))
    spectrum = np.fft.rfft(pattern, axis=1)
    reach = round(LARGEST_OFFSET / 360 * lattice)
    wave = 2j * np.pi * np.arange(spectrum.shape[1]) / lattice
    common = spectrum[int(hit.sum(1).argmax())]
    lag = np.zeros(beams, np.int64)
    for _ in range(3):
        likeness = np.fft.irfft(spectrum * np.conj(common), lattice, axis=1)
        likeness = np.concatenate([likeness[:, -reach:], likeness[:, : reach + 1]], 1)
        lag = likeness.argmax(1) - reach
        common = (spectrum * np.exp(wave * lag[:, None])).mean(0)
    offsets = np.where(np.isnan(phases), np.nan, (lag + phases) * 360 / lattice)
    return np.asarray(offsets - np.nanmedian(offsets))


def _offsets_by_time(turn: Turn, beams: int) -> Float64Array:
    """(B,) degrees beyond the azimuth of the turning head, which is a smooth function of time;
    their median is 0."""
    assert turn.time is not None
    beyond_near = turn.rho > FAR
    count = np.bincount(turn.ring[beyond_near], minlength=beams)
    far = np.flatnonzero(beyond_near & (count >= FEWEST)[turn.ring])
    far = far[np.argsort(turn.time[far], kind="stable")]
    offsets = np.full(beams, np.nan)
    if len(far) < FEW:
        return offsets
    ring = turn.ring[far]
    azimuth = turn.azimuth[far]
    offsets[np.unique(ring)] = 0.0
    part = np.minimum(np.arange(len(far)) * PARTS // len(far), PARTS - 1)
    time = turn.time[far]
    centre = np.array([time[part == i].mean() for i in range(PARTS)])
    for _ in range(4):
        head = azimuth - offsets[ring] / 360
        wave = np.exp(2j * np.pi * head)
        mean = np.bincount(part, wave.real, PARTS) + 1j * np.bincount(
            part, wave.imag, PARTS
        )
        path = np.unwrap(np.angle(mean)) / (2 * np.pi)
        slope = np.gradient(path, centre)
        beyond = _wrap(azimuth - path[part] - slope[part] * (time - centre[part])) * 360
        for beam in np.unique(ring):
            offsets[beam] = np.median(beyond[ring == beam])
        offsets -= np.nanmedian(offsets)
    return offsets


PARTS = 300
"""Parts of a turn in which the head turns at constant speed."""
