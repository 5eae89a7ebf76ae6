"""What each table of the LiDAR-Flow paper needs: ``tables.yaml``."""

from functools import cache
from importlib.resources import files
from typing import Any

from lidar_synth.errors import choose
from lidar_synth.files.parsing import parse_yaml
from lidar_synth.lab.train.config import Section


class Task(Section):
    """One of the paper's tasks.

    Args:
        stages: {stage: recipe}, in order.
        protocol: a name of ``PROTOCOLS``.
        layout, split: of the scans that the generated ones are compared with.
        conditional: whether these scans are the conditions, too.
        scans: number of generated scans.
        milliseconds: of a scan in four steps, by the paper's table 6.
    """

    stages: dict[str, str]
    protocol: str
    layout: str
    split: str
    conditional: bool = False
    scans: int
    milliseconds: int


class PaperTable(Section):
    """One of the paper's tables.

    Args:
        tasks: names of its tasks.
        rows: (stage or strategy, steps) of its rows; none in the table of times.
    """

    tasks: tuple[str, ...]
    rows: tuple[tuple[str, int], ...] = ()


class Tables(Section):
    """The file.

    Args:
        tasks: by name.
        tables: by name, table1 to table6.
        tiny: {all, a stage, a network or a task: values of recipes at the scale "tiny"}.
    """

    tasks: dict[str, Task]
    tables: dict[str, PaperTable]
    tiny: dict[str, dict[str, Any]]


@cache
def read_tables() -> Tables:
    """The tables of the paper."""
    path = files("lidar_synth.lab.reproduce").joinpath("tables.yaml")
    return Tables(**parse_yaml(path.read_text(encoding="utf-8"), str(path)))


def find_table(name: str) -> PaperTable:
    """A table by its name.

    Raises:
        ConfigError: on an unknown one.
    """
    return choose("table", name, read_tables().tables)
