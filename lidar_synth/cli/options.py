"""Command-line options from the fields of a pydantic model, and those of all commands that read."""

import inspect
from collections.abc import Callable
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, Field
from pydantic.fields import FieldInfo
from typer import Argument, BadParameter, Option

FORMATS = (
    "output format: npz (keeps every field) | kitti (.bin and .label files) | semantic_kitti | "
    "kitti_object | kitti360 | range | pcd | ply | png | webdataset | mcap | cosmos"
)
"""Help of ``--to``; names of ``formats.WRITERS``."""


def local_path(text: str) -> Path:
    """The path of a file or folder to write, for typer to parse; a URL, which ``Path`` would turn
    into a folder ``s3:``, is refused."""
    if "://" in text:
        raise BadParameter(
            f"{text}; expected a folder or file on this machine. Only bake writes to URLs: copy "
            "the result there afterwards."
        )
    return Path(text)


Source = Annotated[
    str,
    Argument(
        metavar="IN",
        help="file, folder of scans or root of a dataset; a bank may be at a URL",
    ),
]
Out = Annotated[
    Path,
    Argument(metavar="OUT", help="folder to write to", parser=local_path),
]
Format = Annotated[str, Option(help=FORMATS)]
Json = Annotated[bool, Option("--json", help="print JSON")]


class Reading(BaseModel):
    """How scans are read: the options of every command that opens a path."""

    layout: str | None = Field(
        None,
        description="layout of the input: kitti360 | semantic_kitti | kitti_object | nuscenes | "
        "pandaset | kitti_raw | bank | webdataset | mcap | py123d | cosmos | png | range | "
        "folder [detected]",
    )
    split: str | None = Field(
        None, description="split of the input, for instance r2flow/train"
    )
    fields: int | None = Field(
        None, description="floats per point in plain .bin files [4]"
    )
    topic: str | None = Field(None, description="topic of MCAP files with several")
    reflectance_max: float | None = Field(
        None,
        description="highest reflectance value in plain files, MCAP, semantic_kitti and "
        "kitti_object, for instance 255 [1; 255 in logs of drivers]",
    )
    on_bad: str | None = Field(
        None,
        description="bad scans: error = stop at the first one | skip = leave them out | "
        "drop-points = leave out their NaN and infinite points [error]",
    )


def drop_missing(values: dict[str, Any]) -> dict[str, Any]:
    """The options that the user gave."""
    return {name: value for name, value in values.items() if value is not None}


def options_from(
    kind: type[BaseModel], after: str
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator that replaces a command's ``**values`` by one option for each field of a model.

    An option that is not given is None, so that the command can tell it from one that is given.
    The help text is the field's description and default; the model itself checks the values.

    Args:
        kind: the model; its fields need descriptions.
        after: the parameter of the command that the options follow in the help.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        parameters = []
        for parameter in inspect.signature(command).parameters.values():
            if parameter.kind is not inspect.Parameter.VAR_KEYWORD:
                parameters.append(
                    parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
                )
            if parameter.name == after:
                parameters += [
                    _option(name, field) for name, field in kind.model_fields.items()
                ]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return command

    return decorate


def _option(name: str, field: FieldInfo) -> inspect.Parameter:
    """One field as a parameter that typer reads."""
    text = f"{field.description}" + (
        "" if field.default is None else f" [{field.default}]"
    )
    base = _base_type(field.annotation)
    annotation: Any
    if base is tuple:
        annotation = Annotated[
            Any, Option(help=text, parser=_names, metavar="NAME,...")
        ]
    else:
        annotation = Annotated[base | None, Option(help=text)]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
    )


def _base_type(annotation: Any) -> Any:
    """int, float, str or tuple: an annotation without None, constraints and literals."""
    origin = get_origin(annotation)
    arguments = get_args(annotation)
    if origin in (Union, UnionType):
        return _base_type(
            next(argument for argument in arguments if argument is not NoneType)
        )
    if origin is Annotated:
        return _base_type(arguments[0])
    return str if origin is Literal else origin or annotation


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, text.split(",")))
