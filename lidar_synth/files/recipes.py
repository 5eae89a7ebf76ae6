"""Recipes: configurations that are found by name and built on shared bases.

A recipe is a YAML file. Its key ``base`` names one file or a list of files that it builds on:
    mappings are merged;
later files and the recipe's own values take precedence. Its key ``about`` describes it for
``lidar-synth recipes``. Both keys are removed before the values are checked.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lidar_synth.errors import ConfigError, shorten, suggest
from lidar_synth.files.parsing import read_yaml

Model = TypeVar("Model", bound=BaseModel)

SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class Listed:
    """A published recipe.

    Args:
        name: what ``lidar-synth train``, ``distill`` or ``bake --config`` takes.
        command: the one that runs it.
        data: what it learns from.
        size: trained parameters.
        time: how long it takes, and where that is known from.
        summary: the comment at the head of its file.
    """

    name: str
    command: str
    data: str
    size: str
    time: str
    summary: str


def folder() -> Path:
    """Where the published recipes are installed."""
    return Path(str(files("lidar_synth.recipes")))


def find_recipe(given: str | Path) -> Path:
    """The file of a recipe.

    Args:
        given: a published recipe's name, such as ``town_teacher``, or the path of a YAML file.

    Raises:
        ConfigError: on a name that no published recipe has.
    """
    path = Path(given)
    if path.suffix in SUFFIXES or path.is_file():
        return path
    published = folder() / f"{given}.yaml"
    if path.name != str(given) or not published.is_file():
        names = [p.stem for p in sorted(folder().glob("*.yaml"))]
        models = [p.stem for p in sorted((folder() / "models").glob("*.yaml"))]
        hint = suggest(given, names + models) or "lidar-synth recipes lists them."
        expected = f"a YAML file or one of {', '.join(names)}"
        raise ConfigError(f"recipe or model {str(given)!r}", expected, hint)
    return published


def read_recipe(path: Path) -> dict[str, Any]:
    """The values of a recipe on top of those of its bases, not checked yet.

    A ``sensor`` that is a YAML file is looked for beside the recipe first.

    Raises:
        FileError: where a file cannot be read.
        ConfigError: on what is no YAML, no mapping, or a base that names itself.
    """
    values = _merged(path, ())
    values.pop("about", None)
    return values


def command_of(values: Collection[str]) -> str:
    """The command that runs a recipe with these keys: "bake", "distill" or "train"."""
    if "recipe" not in values:
        return "bake"
    return "distill" if "teacher" in values else "train"


def published() -> Iterator[Listed]:
    """The recipes that come with the package, by name."""
    for path in sorted(folder().glob("*.yaml")):
        about = read_file(path).get("about")
        if not isinstance(about, dict):  # a sensor, not a recipe
            continue
        command = command_of(_merged(path, ()))
        data, size, time = (str(about[key]) for key in ("data", "size", "time"))
        yield Listed(path.stem, command, data, size, time, head_of(path))


def merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """``above`` on top of ``below``, mapping by mapping."""
    result = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merge(result[key], value) if both else value
    return result


def _merged(path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    if path in above:
        raise ConfigError(f"{path} is its own base", "bases that end")
    values = read_file(path)
    bases = values.pop("base", [])
    if isinstance(bases, str):
        bases = [bases]
    if not isinstance(bases, list):
        raise ConfigError(f"{path}: base: {bases!r}", "the name of a recipe, or a list")
    result: dict[str, Any] = {}
    for base in bases:
        result = merge(result, _merged(_base(path, base), (*above, path)))
    return merge(result, values)


def _base(path: Path, name: Any) -> Path:
    """The file of a base: beside the recipe, in its folder ``base``, or a published one."""
    for candidate in (
        path.parent / str(name),
        path.parent / "base" / f"{name}.yaml",
        path.parent / f"{name}.yaml",
        folder() / "base" / f"{name}.yaml",
        folder() / f"{name}.yaml",
    ):
        if candidate.is_file() and candidate != path:
            return candidate
    raise ConfigError(
        f"{path}: base {name!r}", f"a file beside it, or a recipe of {folder()}"
    )


def read_file(path: Path) -> dict[str, Any]:
    """The keys and values of one file, without its bases; raises as ``read_recipe``."""
    values = read_yaml(
        path, "a configuration; lidar-synth recipes lists the published ones"
    )
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds {type(values).__name__}", "keys and values")
    sensor = values.get("sensor")
    if (
        isinstance(sensor, str)
        and sensor.endswith(SUFFIXES)
        and (path.parent / sensor).is_file()
    ):
        values["sensor"] = str(path.parent / sensor)
    return values


def head_of(path: Path) -> str:
    """The first sentence of the comment at the head of a file."""
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# "))
    return " ".join(lines).split(". ")[0].rstrip(".") + "."


def validate(kind: type[Model], values: dict[str, Any], where: str) -> Model:
    """Values as the model ``kind`` checks them; ``where`` begins the message of the ConfigError."""
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{where}: {_first(kind, error)}") from error


def _first(kind: type[BaseModel], error: ValidationError) -> str:
    """The first complaint of pydantic, in one line that helps."""
    fault = error.errors()[0]
    place = ".".join(map(str, fault["loc"]))
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _keys(kind, fault["loc"][:-1])
        hint = suggest(fault["loc"][-1], known)
        return f"unknown key {place!r}; known there: {', '.join(known)}" + (
            f". {hint}" if hint else ""
        )
    if fault["type"] == "missing":
        return f"{place!r} is missing"
    return f"{place} = {shorten(repr(fault['input']), 400)}: {fault['msg']}"


def _keys(kind: Any, path: Sequence[int | str]) -> list[str]:
    """Names of the fields at a place of the configuration."""
    for level in path:
        fields = getattr(kind, "model_fields", None) or getattr(
            kind, "__pydantic_fields__", {}
        )
        kind = fields[level].annotation
    return list(
        getattr(kind, "model_fields", None) or getattr(kind, "__dataclass_fields__", {})
    )
