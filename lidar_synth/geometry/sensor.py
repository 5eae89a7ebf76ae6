"""A LiDAR sensor as data: the directions of its beams, the columns of a revolution, its range
limits.

Frame and angles (in the whole package): right-handed sensor frame, x forward, y left, z up, metres.
elevation = asin(z / range). azimuth = -atan2(y, x), which increases clockwise seen from above, as
the columns of a range image do. Azimuth 0 is straight ahead, at the edge between columns W/2-1 and
W/2; the seam is behind the sensor. Row 0 is the highest beam.
"""

import warnings
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, choose, shorten, suggest
from lidar_synth.files.parsing import parse_yaml, read_yaml
from lidar_synth.geometry.ouster import read_metadata

Rays = Literal["centre", "corner"]
"""The point of a cell through which its ray passes: the centre (so that unprojected points project
back to the same cell) or the upper left corner, as in the public code of R2Flow and LiDM."""
_OFFSETS = {"centre": 0.5, "corner": 0.0}

MOST_CELLS = 1 << 22
"""Rows times columns of a sensor; the largest that are sold have 2^19."""

_MOUNT = 1.73
"""Metres between the road and a sensor whose ``beams`` were measured from its returns."""

_INTEGERS = ("columns", "rows", "firings", "reflectance_levels")
_NUMBERS = ("range_min", "range_max", "fov_up", "fov_down", "range_step")
_OPTIONAL = (
    "rows",
    "fov_up",
    "fov_down",
    "firings",
    "range_step",
    "reflectance_levels",
)


@dataclass(frozen=True)
class Sensor:
    """The geometry of one sensor.

    The arguments, ``up`` and ``down`` are in degrees, as in the configuration; other angles are in
    radians.

    Args:
        name: of the sensor.
        columns: W, cells of a full revolution; even, so that straight ahead is an edge.
        range_min: metres, inclusive; nearer returns are dropped.
        range_max: metres, inclusive; farther returns are dropped.
        rows: H, for beams whose elevation is linear in the row; needs ``fov_up`` and ``fov_down``,
            the outer edges of the first and the last row in degrees.
        elevations: instead of ``rows``, ``fov_up`` and ``fov_down``, the elevation of each row in
            degrees, highest first; the edges of a row lie halfway between the beams.
        beams: the measured elevation of each laser in degrees, highest first, if the rows only
            approximate it.
        heights: metres above the origin at which each laser starts, one per row; 0 by default. With
            ``elevations`` and without ``beams``, the rows are the lasers, and the rays of their
            cells start there.
        firings: of each laser in one revolution; as many as columns by default.
        azimuths: degrees, clockwise, by which each laser points away from the direction of its
            firing, one per row; 0 by default. None (``null`` or ``.nan`` in YAML) where it is not
            known: rays are cast as for 0, with a warning, and ``assign_beams`` gives no firing.
        range_step: metres, the step in which the sensor gives ranges, if it is known.
        reflectance_levels: number of values of reflectance, such as 256, if it is known.
        description: one line of text.

    Raises:
        ConfigError: on values that no sensor can have.

    Example:
        >>> from lidar_synth import Sensor
        >>> beams = {"rows": 32, "fov_up": 15.0, "fov_down": -25.0}
        >>> sensor = Sensor("mine", columns=2048, range_min=1.0, range_max=120.0, **beams)
        >>> sensor.shape
        (32, 2048)
        >>> sensor.ray_directions().shape
        (32, 2048, 3)
    """

    name: str
    columns: int
    range_min: float
    range_max: float
    rows: int | None = None
    fov_up: float | None = None
    fov_down: float | None = None
    elevations: tuple[float, ...] | None = None
    beams: tuple[float, ...] | None = None
    heights: tuple[float, ...] | None = None
    firings: int | None = None
    azimuths: tuple[float | None, ...] | None = None
    range_step: float | None = None
    reflectance_levels: int | None = None
    description: str = ""

    def __post_init__(self) -> None:
        self._check_types()
        linear = (self.rows, self.fov_up, self.fov_down)
        if (self.elevations is None) == (None in linear) or (
            self.elevations is not None and linear != (None, None, None)
        ):
            raise self._error(
                f"rows, fov_up, fov_down = {linear}, elevations = {self.elevations}",
                "either all of rows, fov_up and fov_down, or elevations",
            )
        for key in ("elevations", "beams"):
            table = getattr(self, key)
            if table is not None and (
                not np.all(np.diff(table) < 0) or max(map(abs, table)) >= 90
            ):
                raise self._error(
                    f"{key} = {table}", "degrees within +-90, highest first"
                )
        rows = self.shape[0]
        if rows < 2 or (self.rows is not None and not 90 >= self.up > self.down >= -90):
            raise self._error(
                f"{rows} rows, {linear[1:]}",
                "at least 2 rows and 90 >= fov_up > fov_down >= -90",
            )
        if self.beams is not None and len(self.beams) != rows:
            raise self._error(f"{len(self.beams)} beams", f"one per row ({rows})")
        if self.heights is not None and (
            len(self.heights) != rows or not all(abs(h) < 1 for h in self.heights)
        ):
            raise self._error(
                f"heights = {self.heights}",
                f"one per row ({rows}), within 1 m of the origin",
            )
        if self.columns < 2 or self.columns % 2:
            raise self._error(f"columns = {self.columns}", "an even number")
        if rows * max(self.columns, self.firings or 0) > MOST_CELLS:
            given = f"{rows} rows, {self.columns} columns and {self.firings} firings"
            raise self._error(given, f"at most {MOST_CELLS} cells")
        self._check_firings(rows)
        if not 0 <= self.range_min < self.range_max:
            raise self._error(
                f"range_min, range_max = {self.range_min}, {self.range_max}",
                "0 <= range_min < range_max, metres",
            )

    def _check_firings(self, rows: int) -> None:
        if self.firings is not None and self.firings < 2:
            raise self._error(f"firings = {self.firings}", "at least 2 per revolution")
        known = [abs(offset) for offset in self.azimuths or () if offset is not None]
        if self.azimuths is not None and (
            len(self.azimuths) != rows or max(known, default=0) > 180
        ):
            raise self._error(
                f"azimuths = {self.azimuths}",
                f"one per row ({rows}), within +-180 degrees",
            )
        if self.range_step is not None and not 0 < self.range_step <= 1:
            raise self._error(
                f"range_step = {self.range_step}", "metres, 0 < range_step <= 1"
            )
        if (
            self.reflectance_levels is not None
            and not 2 <= self.reflectance_levels <= 65536
        ):
            raise self._error(
                f"reflectance_levels = {self.reflectance_levels}", "2 to 65536"
            )

    def _check_types(self) -> None:
        """Check that values are texts, integers or finite numbers; convert lists to tuples of
        float, and numbers of numpy, which JSON and YAML cannot hold, to Python's."""
        for key in ("name", "description"):
            if not isinstance(getattr(self, key), str):
                raise self._error(f"{key} = {getattr(self, key)!r}", "text")
        if not self.name:
            raise self._error("an empty name", "text, which files of its scans tell")
        for key in (*_INTEGERS, *_NUMBERS):
            value = _plain(getattr(self, key))
            integer = key in _INTEGERS
            valid = _is_integer(value) if integer else _is_finite(value)
            if not valid and not (value is None and key in _OPTIONAL):
                raise self._error(
                    f"{key} = {value!r}",
                    "a whole number" if integer else "a finite number",
                )
            object.__setattr__(self, key, value)
        for key in ("elevations", "beams", "heights", "azimuths"):
            table = getattr(self, key)
            if table is None:
                continue
            is_list = isinstance(table, list | tuple) or (
                isinstance(table, np.ndarray) and table.ndim == 1
            )
            values = [_plain(value) for value in table] if is_list else []
            if key == "azimuths":
                values = [None if v != v else v for v in values]  # NaN
            numbers = [
                value for value in values if not (key == "azimuths" and value is None)
            ]
            if not values or not all(_is_finite(value) for value in numbers):
                raise self._error(f"{key} = {table!r}", "a list of finite numbers")
            object.__setattr__(
                self,
                key,
                tuple(None if value is None else float(value) for value in values),
            )

    def _error(self, given: str, expected: str) -> ConfigError:
        return ConfigError(
            f"sensor {shorten(repr(self.name), 100)}: {shorten(given, 400)}", expected
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the range image."""
        if self.elevations is not None:
            return len(self.elevations), self.columns
        return self.rows or 0, self.columns

    @property
    def up(self) -> float:
        """The upper edge of row 0, degrees."""
        if self.fov_up is not None:
            return float(self.fov_up)
        return float(np.degrees(self.edges[0]))

    @property
    def down(self) -> float:
        """The lower edge of the last row, degrees."""
        if self.fov_down is not None:
            return float(self.fov_down)
        return float(np.degrees(self.edges[-1]))

    @cached_property
    def edges(self) -> NDArray[np.float32]:
        """(H+1,) elevations of the rows' edges, highest first, radians."""
        if self.elevations is None:
            fraction = np.arange(self.shape[0] + 1) / self.shape[0]
            return _shared(np.radians(self.up - fraction * (self.up - self.down)))
        beams = np.asarray(self.elevations)
        between = (beams[1:] + beams[:-1]) / 2
        outer = 2 * beams[[0, -1]] - between[[0, -1]]
        edges: NDArray[np.float64] = np.concatenate([outer[:1], between, outer[1:]])
        return _shared(np.radians(edges))

    @cached_property
    def laser_elevations(self) -> NDArray[np.float32]:
        """(H,) elevation of each laser, highest first, radians: ``beams`` if they are given,
        otherwise the rows."""
        if self.beams is not None:
            return _shared(np.radians(self.beams))
        return _shared(self.row_elevations())

    def row_elevations(self, rays: Rays = "centre") -> NDArray[np.float32]:
        """(H,) elevation of each row, radians.

        Raises:
            ConfigError: where ``rays`` is neither "centre" nor "corner".
        """
        if not choose("rays", rays, _OFFSETS):
            return self.edges[:-1].copy()
        if self.elevations is not None:
            return np.radians(self.elevations).astype(np.float32)
        fraction = (np.arange(self.shape[0]) + 0.5) / self.shape[0]
        return np.radians(self.up - fraction * (self.up - self.down)).astype(np.float32)

    def column_azimuths(self, rays: Rays = "centre") -> NDArray[np.float32]:
        """(W,) azimuth of each column in [-pi, pi), radians, increasing clockwise; raises as
        ``row_elevations``."""
        fraction = np.arange(self.columns) + choose("rays", rays, _OFFSETS)
        fraction /= self.columns
        return ((2 * fraction - 1) * np.pi).astype(np.float32)

    def optics(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(H,) elevation of each laser in radians, and (H,) metres above the origin at which it
        starts.

        ``beams`` are the elevations of typical returns as seen from the origin, so that a laser
        that starts above the origin points further down. Most returns of a beam come from a level
        road; objects shorten the typical distance. ``elevations`` without ``beams``, as
        ``fit_sensor`` gives them, are the lasers' own.
        """
        seen = self.laser_elevations.astype(np.float64)
        heights = (
            np.zeros(len(seen)) if self.heights is None else np.asarray(self.heights)
        )
        if self.beams is None:
            return seen, heights
        typical = np.minimum(
            1 / (np.maximum(np.sin(-seen), 1e-3) / _MOUNT + 1 / 110), 20.0
        )
        return seen - heights / typical, heights

    def same_grid(self, other: "Sensor") -> bool:
        """Whether another sensor has the same rows and columns, whatever their names, beams and
        range limits."""
        return self is other or (
            self.shape == other.shape
            and bool(np.allclose(self.edges, other.edges, rtol=0, atol=1e-5))
        )

    def same_lasers(self, other: "Sensor") -> bool:
        """Whether another sensor has the same lasers, within 0.1 degrees and 1 cm. Rows, columns
        and limits may differ: ``hdl64e_lasers`` and ``hdl64e_semantic_kitti`` are one device on two
        grids."""
        if self.shape[0] != other.shape[0]:
            return False
        angle, height = np.abs(np.subtract(self.optics(), other.optics())).max(1)
        return bool(angle <= np.radians(0.1) and height <= 0.01)

    @cached_property
    def starts(self) -> NDArray[np.float32]:
        """(H,) metres above the origin at which the rays of each row start; empty where they start
        at the origin.

        Rows with ``elevations`` and ``heights`` but without ``beams`` are the lasers themselves, as
        ``fit_sensor`` gives them.
        """
        if (
            self.elevations is None
            or self.beams is not None
            or not any(self.heights or ())
        ):
            return _shared(())
        return _shared(self.heights)

    def firing_azimuths(self) -> NDArray[np.float64]:
        """(H, F) azimuth of each laser at each of its firings, radians, in the order of firing from
        behind the sensor.

        Offsets can lead beyond +-pi: firing 0 of a laser with a negative offset belongs to the end
        of the turn.
        """
        count = self.firings or self.columns
        offsets = (
            np.zeros(self.shape[0])
            if self.azimuths is None
            else np.asarray(self.azimuths, np.float64)
        )
        if unknown := int(np.isnan(offsets).sum()):
            warnings.warn(
                f"sensor {self.name!r}: the azimuth offsets of {unknown} of {len(offsets)} beams "
                "are not known; their rays are cast with 0",
                stacklevel=2,
            )
        firing = (2 * (np.arange(count) + 0.5) / count - 1) * np.pi
        return np.asarray(firing + np.radians(np.nan_to_num(offsets))[:, None])

    def ray_angles(self, rays: Rays = "centre") -> NDArray[np.float32]:
        """(2, H, W) elevation and azimuth of every cell, radians."""
        grid = np.meshgrid(
            self.row_elevations(rays), self.column_azimuths(rays), indexing="ij"
        )
        return np.stack(grid)

    def ray_directions(self, rays: Rays = "centre") -> NDArray[np.float32]:
        """(H, W, 3) unit vector x, y, z of every cell; the array is read-only and shared between
        calls."""
        return _ray_directions(self, rays)

    def grid_text(self) -> str:
        """Name, rows, columns and field of view for people: ``'town' (64 x 1024, -25.0 to 3.0
        degrees)``."""
        rows, columns = self.shape
        return f"{self.name!r} ({rows} x {columns}, {self.down:.1f} to {self.up:.1f} degrees)"

    def by_beams(self) -> "Sensor":
        """The same sensor with one row per laser, at the elevation of its returns, for unfolded
        scans."""
        if self.beams is None:
            return self
        return replace(
            self,
            name=f"{self.name}/beams",
            elevations=self.beams,
            beams=None,
            heights=None,
            rows=None,
            fov_up=None,
            fov_down=None,
        )

    def to_dict(self) -> dict[str, Any]:
        """The arguments that are set, as plain values, with the keys of the YAML file."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            k: list(v) if isinstance(v, tuple) else v
            for k, v in values.items()
            if v not in (None, "")
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Sensor":
        """Make a sensor from the values of ``to_dict``.

        Raises:
            ConfigError: on an unknown or missing key, or a value of the wrong kind.
        """
        known = [f.name for f in fields(cls)]
        if not isinstance(values, dict):
            raise ConfigError(
                f"a sensor of type {type(values).__name__}", f"a mapping of {known}"
            )
        if unknown := [key for key in values if key not in known]:
            raise ConfigError(
                f"sensor keys {shorten(str(unknown), 400)}", f"some of {known}"
            )
        if missing := [
            key
            for key in ("name", "columns", "range_min", "range_max")
            if key not in values
        ]:
            given = f"sensor {shorten(repr(values.get('name')), 100)} without {', '.join(missing)}"
            raise ConfigError(given, "text and numbers, as in sensors.yaml")
        return cls(**values)


@lru_cache(maxsize=16)
def _ray_directions(sensor: Sensor, rays: Rays) -> NDArray[np.float32]:
    elevation, azimuth = sensor.ray_angles(rays).astype(np.float64)
    rays_xyz = np.stack(
        [
            np.cos(azimuth) * np.cos(elevation),
            -np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    return _shared(np.moveaxis(rays_xyz, 0, -1))


def _shared(values: Any) -> NDArray[np.float32]:
    """New values as a read-only float32 array, which callers share."""
    array = np.ascontiguousarray(values, np.float32)
    array.setflags(write=False)
    return array


def _plain(value: Any) -> Any:
    """A number of numpy as Python's; other values as they are."""
    return value.item() if isinstance(value, np.generic) else value


def _is_finite(value: object) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # isfinite fails on very large integers.
    return bool(is_number and -1e300 < value < 1e300)  # type: ignore[operator]


def _is_integer(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _entries(values: Any, where: str) -> dict[Any, dict[str, Any]]:
    """The entries of a YAML file: {name of a sensor: its values}."""
    if not isinstance(values, dict) or not all(
        isinstance(v, dict) for v in values.values()
    ):
        raise ConfigError(
            f"{where} does not hold sensors by name ({type(values).__name__})",
            "NAME: {rows: 64, ...}, a sensor's name with its values below it",
        )
    return values


@lru_cache(maxsize=1)
def presets() -> dict[str, Sensor]:
    """The sensors of ``sensors.yaml`` by name."""
    text = (
        files("lidar_synth.geometry")
        .joinpath("sensors.yaml")
        .read_text(encoding="utf-8")
    )
    entries = _entries(parse_yaml(text, "sensors.yaml"), "sensors.yaml")
    return {
        name: Sensor.from_dict({"name": name, **values})
        for name, values in entries.items()
    }


def sensor_yaml(sensor: Sensor) -> str:
    """The YAML text of a sensor, which ``load_sensor`` reads."""
    values = sensor.to_dict()
    return yaml.safe_dump(
        {values.pop("name"): values},
        default_flow_style=None,
        sort_keys=False,
        width=120,
    )


def load_sensor(sensor: "str | Path | Sensor") -> Sensor:
    """Load a sensor: a preset by name, or one of your own from a YAML file or from an Ouster's
    metadata.

    Args:
        sensor: a name of ``presets()``; the path of a YAML file with one entry, whose keys are
            those of ``sensors.yaml``; the path of the metadata JSON of an Ouster sensor; or a
            ``Sensor``, which is returned as it is.

    Raises:
        ConfigError: on an unknown name, or a file without exactly one sensor.
        FileError: on a path that cannot be read.
        DataError: on a file that is not UTF-8 or too long for a sensor, or JSON that is not the
            metadata of an Ouster sensor.

    Example:
        >>> from lidar_synth import load_sensor
        >>> sensor = load_sensor("os1_128")
        >>> sensor.shape, sensor.range_max
        ((128, 1024), 170.0)
        >>> with open("mine.yaml", "w") as file:
        ...     _ = file.write("mine: {rows: 32, fov_up: 15, fov_down: -25, columns: 2048, ")
        ...     _ = file.write("range_min: 1, range_max: 120}")
        >>> load_sensor("mine.yaml").shape
        (32, 2048)
    """
    if isinstance(sensor, Sensor):
        return sensor
    if not isinstance(sensor, str | Path):
        raise ConfigError(
            f"sensor {shorten(repr(sensor), 40)}", "a preset's name, a file or a Sensor"
        )
    if str(sensor) in presets():
        return presets()[str(sensor)]
    path = Path(sensor)
    if path.suffix == ".json":
        return Sensor.from_dict(read_metadata(path))
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(
            f"sensor {str(sensor)!r}",
            f"one of {', '.join(presets())}, the metadata .json of an Ouster, or a .yaml file",
            suggest(sensor, presets()),
        )
    entries = _entries(
        read_yaml(path, "a file with a sensor, such as sensors.yaml"), str(path)
    )
    if len(entries) != 1:
        raise ConfigError(
            f"{path} holds {len(entries)} sensors",
            "exactly one entry: its name, then its values",
        )
    [(name, values)] = entries.items()
    return Sensor.from_dict({"name": str(name), **values})
