"""A skin: what the returns of a real sensor look like, as maps from the town's distributions to
those of real scans."""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from lidar_synth.errors import ConfigError, DataError, suggest
from lidar_synth.files.disk import read_file, write_file
from lidar_synth.geometry import Sensor
from lidar_synth.geometry.arrays import Float32Array, Int32Array
from lidar_synth.lab.town.skin.features import (
    BAND,
    BANDS,
    CELLS,
    LARGEST,
    ROUGH,
    STRATA,
    STRATUM_KIND,
    RayFeatures,
    find_features,
    find_strata,
)
from lidar_synth.lab.town.skin.tables import lookup

FORMAT = "lidar-synth-skin/1"
SUFFIX = ".skin"
LONGEST = 4 << 20
"""Bytes, largest file of a skin."""
MEANS = 65
RESIDUALS = 33
"""Quantiles of the local mean, and of the residuals of reflectance and range."""
PARTS = 4
"""Parts of a stratum, by the rank of the local mean, in which residuals of reflectance are
tabulated."""
TOWN_STEP = 1 / 256
"""Step of the reflectance of the physical model."""
SOFT = 0.3
BOXED = 0.05
"""Metres by which a point moves at most, and a point of an object with a box."""

WHITE = 0.6
"""Share of the change of a residual by which its return moves: its neighbours move, too. (White
noise has 1 / 1.67.)"""

_FINE = 129
"""Grid points of the tables that are computed from the quantiles."""
_GRID = np.linspace(0, 1, _FINE, dtype=np.float32)
_SIGNED = np.linspace(-1, 1, _FINE, dtype=np.float32)
_ROOTS = np.sign(_SIGNED) * _SIGNED**2
"""Grid of residuals in [-1, 1], fine about 0."""


def shapes(rows: int) -> dict[str, tuple[int, ...]]:
    """The arrays of a skin for a sensor of ``rows`` lasers."""
    return {
        "cuts": (CELLS, ROUGH - 1),
        "mean_town": (BANDS, MEANS),
        "mean_real": (BANDS, MEANS),
        "residual_town": (STRATA * PARTS, RESIDUALS),
        "residual_real": (STRATA * PARTS, RESIDUALS),
        "range_town": (STRATA, RESIDUALS),
        "range_real": (STRATA, RESIDUALS),
        "offset": (2, rows),
        "missing": (STRATA,),
        "missing_laser": (rows,),
    }


class Dressed(NamedTuple):
    """The returns of a scan with a skin.

    Args:
        shift: (N,) metres by which each point moves along its ray.
        reflectance: (N,) in [0, 1].
        kept: (N,) bool, which points return.
    """

    shift: Float32Array
    reflectance: Float32Array
    kept: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Skin:
    """The look of a real sensor's returns, learnt by ``fit_skin``.

    Args:
        sensor: the sensor.
        step: step of its reflectance, 0 if it is not known.
        provenance: the scans that it was learnt from, their licence, and the town that they were
            compared with.
        arrays: {name: values} of ``shapes``: ``cuts`` of the roughness, quantiles of the town and
            the real ones that replace them, the ``offset`` of each laser's reflectance, and the
            probability that a return is ``missing`` by stratum, with a factor by laser.

    Example:
        >>> from lidar_synth import Town, load_skin
        >>> skin = load_skin("pandar64")
        >>> skin.sensor.shape[0], skin.provenance["licence"][:9]
        (64, 'CC BY 4.0')
        >>> scan = Town(sensor=skin.sensor, skin=skin, scans=1)[0]
    """

    sensor: Sensor
    step: float
    provenance: dict[str, Any]
    arrays: dict[str, Float32Array]

    def __post_init__(self) -> None:
        expected = shapes(self.sensor.shape[0])
        given = {name: array.shape for name, array in self.arrays.items()}
        if given != expected:
            raise ConfigError(f"a skin with arrays {given}", f"{expected}")
        if not all(
            np.isfinite(array).all() and np.abs(array).max() <= 1000
            for array in self.arrays.values()
        ):
            raise ConfigError(
                "a skin with values that are not finite, or too large",
                "those of fit_skin",
            )
        if not 0 <= self.step <= 0.5:
            raise ConfigError(
                f"a skin whose reflectance has a step of {self.step}", "0 to 0.5"
            )

    def __reduce__(self) -> tuple[type["Skin"], tuple[object, ...]]:
        return Skin, (self.sensor, self.step, self.provenance, self.arrays)

    @cached_property
    def _maps(self) -> tuple[Float32Array, Float32Array, Float32Array]:
        a = self.arrays
        return (
            lookup(a["mean_town"], a["mean_real"], _GRID),
            lookup(a["residual_town"], a["residual_real"], _ROOTS),
            lookup(a["range_town"], a["range_real"], _ROOTS * np.float32(LARGEST)),
        )

    def check(self, sensor: Sensor) -> None:
        """Check that a sensor is the skin's: the same lasers and firings.

        Raises:
            ConfigError: if it is another one.
        """
        mine = self.sensor.laser_elevations
        other = sensor.laser_elevations
        limit = np.radians(0.3)
        if mine.shape != other.shape or np.abs(mine - other).max() > limit:
            raise ConfigError(
                f"sensor {sensor.name!r} with a skin of {self.sensor.name!r}",
                "a sensor with the same beams",
                f"Use sensor={self.sensor.name!r}, or fit a skin for {sensor.name!r}.",
            )
        fired = [s.firings or s.columns for s in (self.sensor, sensor)]
        if fired[0] != fired[1]:
            raise ConfigError(
                f"{fired[1]} firings with a skin of {fired[0]} firings per turn",
                "the same number",
            )

    def apply(
        self,
        points: Float32Array,
        reflectance: Float32Array,
        ring: NDArray[np.integer],
        boxed: NDArray[np.bool_],
        rng: np.random.Generator,
    ) -> Dressed:
        """Give the returns of a town's scan the look of the real sensor's.

        Args:
            points: (N, 3) metres, ring by ring, each ring by azimuth.
            reflectance: (N,) in [0, 1) in steps of ``TOWN_STEP``, by lasers of equal gain.
            ring: (N,) row of each point's laser.
            boxed: (N,) whether a point belongs to an object with a box; such points move by
                ``BOXED`` at most.
            rng: samples the returns that are missing.
        """
        uniform = rng.random((2, len(points)), np.float32)
        bright = reflectance + uniform[0] * np.float32(TOWN_STEP)
        rows = np.ascontiguousarray(ring, np.int32)
        found = find_features(points, bright, rows, self.sensor)
        return self.dress(
            found,
            find_strata(found, self.arrays["cuts"]),
            bright,
            rows,
            boxed,
            uniform[1],
        )

    def dress(
        self,
        found: RayFeatures,
        stratum: Int32Array,
        bright: Float32Array,
        rows: Int32Array,
        boxed: NDArray[np.bool_],
        uniform: Float32Array,
    ) -> Dressed:
        """``apply`` with features and random numbers (N,) that are at hand."""
        a = self.arrays
        mean, residual, distance = self._maps
        cuts = np.ascontiguousarray(a["mean_town"][:, _part_quantiles()])
        return Dressed(
            *_dress(
                found.mean,
                found.residual,
                stratum,
                bright,
                rows,
                boxed,
                uniform,
                cuts,
                mean,
                residual,
                distance,
                a["offset"],
                a["missing"],
                a["missing_laser"],
                float(self.step),
                max(float(np.median(a["mean_real"])), 1e-3),
            )
        )

    def summary(self) -> dict[str, Any]:
        """Provenance and a few figures, as plain values."""
        spread = {
            name: np.ptp(
                self.arrays[name][:, [RESIDUALS // 4, -1 - RESIDUALS // 4]], axis=1
            )
            for name in ("residual_town", "residual_real", "range_town", "range_real")
        }
        return {
            "sensor": self.sensor.name,
            **{k: v for k, v in self.provenance.items() if k != "town"},
            **{f"town: {k}": v for k, v in self.provenance.get("town", {}).items()},
            "reflectance, step": self.step,
            "reflectance, median": float(np.median(self.arrays["mean_real"]).round(3)),
            "lasers, spread of reflectance": float(
                self.arrays["offset"][0].std().round(3)
            ),
            "returns missing, at most": float(self.arrays["missing"].max().round(3)),
            **{
                f"{name}, median spread": float(np.median(v).round(4))
                for name, v in spread.items()
            },
        }

    @cached_property
    def digest(self) -> str:
        """sha256 of everything that the file holds."""
        return _checksum(*self._content())

    def _content(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """The header of the file, without its checksum, and the arrays."""
        header = {
            "format": FORMAT,
            "sensor": self.sensor.to_dict(),
            "reflectance_step": self.step,
            "provenance": self.provenance,
        }
        return header, {
            name: np.ascontiguousarray(v, np.float16) for name, v in self.arrays.items()
        }

    def save(self, path: str | Path) -> None:
        """Write the skin to a file; the same skin gives the same bytes.

        Raises:
            ConfigError: on a name that does not end in ``.skin``.
            FileError: if it cannot be written.
        """
        if Path(path).suffix != SUFFIX:
            raise ConfigError(f"skin {path}", f"a name that ends in {SUFFIX}")
        header, arrays = self._content()
        header["checksum"] = _checksum(header, arrays)
        write_file(
            Path(path),
            save(arrays, {"lidar_synth": json.dumps(header, sort_keys=True)}),
            durable=True,
        )


def part_of(
    mean: Float32Array, stratum: Int32Array, quantiles: Float32Array
) -> NDArray[np.int64]:
    """(N,) stratum and part of each return: the rank of its local mean among the quantiles (BANDS,
    MEANS)."""
    cuts = quantiles[:, _part_quantiles()]
    part: NDArray[np.int64] = (mean[:, None] >= cuts[BAND[stratum]]).sum(1)
    return stratum.astype(np.int64) * PARTS + part


def _part_quantiles() -> NDArray[np.intp]:
    return np.asarray(np.arange(1, PARTS) * (MEANS - 1) // PARTS, np.intp)


@njit(cache=True)
def _at(table: Float32Array, row: int, x: float) -> float:
    """The value of a table's row at x in [0, 1], between its grid points."""
    place = min(max(x, 0.0), 1.0) * (table.shape[1] - 1)
    low = min(int(place), table.shape[1] - 2)
    return float(
        table[row, low] + (place - low) * (table[row, low + 1] - table[row, low])
    )


@njit(cache=True)
def _root(x: float) -> float:
    """The place of a residual x in [-1, 1] on the grid, in [0, 1]."""
    if x >= 0:
        return float(0.5 + 0.5 * np.sqrt(x))
    return float(0.5 - 0.5 * np.sqrt(-x))


@njit(cache=True)
def _dress(
    mean: Float32Array,
    residual: Float32Array,
    stratum: Int32Array,
    bright: Float32Array,
    ring: Int32Array,
    boxed: NDArray[np.bool_],
    uniform: Float32Array,
    cuts: Float32Array,
    to_mean: Float32Array,
    to_residual: Float32Array,
    to_range: Float32Array,
    offset: Float32Array,
    missing: Float32Array,
    missing_laser: Float32Array,
    step: float,
    middle: float,
) -> tuple[Float32Array, Float32Array, NDArray[np.bool_]]:
    count = len(mean)
    shift = np.zeros(count, np.float32)
    value = np.empty(count, np.float32)
    kept = np.ones(count, np.bool_)
    for i in range(count):
        s = stratum[i]
        part = 0
        for k in range(cuts.shape[1]):
            if mean[i] >= cuts[BAND[s], k]:
                part += 1
        v = _at(to_mean, BAND[s], mean[i]) + _at(
            to_residual, s * (cuts.shape[1] + 1) + part, _root(bright[i] - mean[i])
        )
        # The offset of a laser fades out towards 0.
        v += offset[min(STRATUM_KIND[s], 1), ring[i]] * min(max(v / middle, 0.0), 1.0)
        v = min(max(v, 0.0), 1.0)
        value[i] = round(v / step) * step if step > 0 else v
        if not np.isnan(residual[i]):
            limit = BOXED if boxed[i] else SOFT
            moved = WHITE * (
                _at(to_range, s, _root(residual[i] / LARGEST)) - residual[i]
            )
            shift[i] = min(max(moved, -limit), limit)
        kept[i] = uniform[i] >= missing[s] * missing_laser[ring[i]]
    return shift, value, kept


def _checksum(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> str:
    """sha256 of a header and of the names, types, shapes and bytes of arrays."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(
            f"{name} {arrays[name].dtype} {arrays[name].shape}\n".encode()
            + arrays[name].tobytes()
        )
    return digest.hexdigest()


def _find_file(skin: str | Path) -> Path:
    """The file of a skin that ships with the package, or of one's own."""
    path = Path(skin)
    if path.suffix == SUFFIX:
        return path
    folder = Path(str(files("lidar_synth.lab.town.skin")))
    names = sorted(p.stem for p in folder.glob(f"*{SUFFIX}"))
    if str(skin) not in names:
        expected = f"one of {', '.join(names)}, or a file that ends in {SUFFIX}"
        raise ConfigError(f"skin {str(skin)!r}", expected, suggest(str(skin), names))
    return folder / f"{skin}{SUFFIX}"


def load_skin(skin: "str | Path | Skin") -> Skin:
    """Load a skin: one that ships with the package by its name, or one of your own from a file.

    Args:
        skin: the name of a shipped skin; the path of a file that ends in ``.skin``; or a ``Skin``,
            which is returned.

    Raises:
        ConfigError: on an unknown name.
        FileError: on a path that cannot be read.
        DataError: on a file that is not a skin of this version, or damaged.

    Example:
        >>> from lidar_synth import load_skin
        >>> skin = load_skin("pandar64")
        >>> skin.sensor.name, skin.sensor.shape[0]
        ('pandar64', 64)
    """
    if isinstance(skin, Skin):
        return skin
    path = _find_file(skin)
    content = read_file(path, f"a file of {FORMAT}", LONGEST)
    try:
        start = int.from_bytes(content[:8], "little") + 8
        header = json.loads(json.loads(content[8:start])["__metadata__"]["lidar_synth"])
        if header["format"] != FORMAT:
            raise ConfigError(f"format {header['format']!r}", repr(FORMAT))
        stored = load(content)
        if header.pop("checksum", None) != _checksum(header, stored):
            raise ConfigError(
                "content that does not match its checksum",
                "an intact file",
                "Copy it again.",
            )
        arrays = {name: values.astype(np.float32) for name, values in stored.items()}
        return Skin(
            Sensor.from_dict(header["sensor"]),
            float(header["reflectance_step"]),
            dict(header["provenance"]),
            arrays,
        )
    except (
        SafetensorError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise DataError(
            f"{path} is not a skin of this version ({error})",
            f"an intact file of {FORMAT}",
        ) from error
