"""Hook of mkdocs: text that follows from the code is generated when the site is built.

A page has a line ``<!-- generated: NAME -->``; the function of that name in ``GENERATED`` returns
what replaces it. mkdocstrings then replaces ``::: NAME`` by the documentation of a name.
"""

import inspect
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import griffe
from typer import Context
from typer.core import TyperGroup
from typer.main import get_command

import lidar_synth
from lidar_synth.cli import COMMANDS, app
from lidar_synth.generate.models.objective import Losses
from lidar_synth.lab.train.config import (
    ConditionSection,
    Data,
    DistillConfig,
    ModelConfig,
    ModelStage,
    NetworkSection,
    Run,
    Samples,
    SelectionSettings,
    TrainConfig,
    published,
    published_models,
)
from lidar_synth.lab.train.state import Recipe

TOPICS = {
    "formats": "Load",
    "geometry": "Load",
    "bank": "Load",
    "datasets": "Load",
    "mixing": "Mix",
    "weather": "Mix",
    "labels": "Mix",
    "generate": "Generate",
    "viz": "Look",
    "lab": "Lab",
    "errors": "Errors",
}
"""Headings of the API by the package's folder in which a name lies."""

FURTHER = (
    "lidar_synth.geometry.projection.batch.project_batch",
    "lidar_synth.geometry.transfer.transfer.Transfer",
    "lidar_synth.geometry.transfer.transfer.SeenAs",
    "lidar_synth.geometry.transfer.mount.Mount",
    "lidar_synth.geometry.transfer.returns.Measurement",
    "lidar_synth.geometry.transfer.response.Response",
    "lidar_synth.generate.generator.Generated",
    "lidar_synth.mixing.items.to_item",
    "lidar_synth.mixing.collate.Collate",
    "lidar_synth.labels.augment",
    "lidar_synth.labels.edit.removal.remove",
    "lidar_synth.labels.edit.insertion.insert",
    "lidar_synth.labels.edit.insertion.move",
    "lidar_synth.labels.edit.unboxed.measure",
    "lidar_synth.labels.edit.unboxed.remove_unboxed",
    "lidar_synth.datasets.classes.Taxonomy",
    "lidar_synth.weather.fog.Fog",
    "lidar_synth.weather.precipitation.Rain",
    "lidar_synth.weather.precipitation.Snow",
    "lidar_synth.weather.wet_ground.WetGround",
    "lidar_synth.weather.sensor.MotionBlur",
    "lidar_synth.weather.sensor.MissingBeams",
    "lidar_synth.weather.sensor.CrossSensor",
    "lidar_synth.weather.sensor.Crosstalk",
    "lidar_synth.weather.sensor.IncompleteEcho",
    "lidar_synth.weather.sensor.LowPower",
    "lidar_synth.weather.cover.Spray",
    "lidar_synth.weather.cover.Dirt",
    "lidar_synth.lab.evaluate.loop_metric.Metric",
    "lidar_synth.lab.evaluate.segmentation.load_judge",
    "lidar_synth.lab.train.runs.run",
    "lidar_synth.lab.train.config.load.load_config",
    "lidar_synth.lab.train.model_plan.plan_model",
    "lidar_synth.lab.train.models.train_model",
    "lidar_synth.viz.write_view",
)
"""Names that pages use besides those of ``lidar_synth``."""

SECTIONS: dict[str, tuple[type, ...]] = {
    "": (Run, TrainConfig),
    "data": (Data,),
    "network": (NetworkSection,),
    "condition": (ConditionSection,),
    "recipe": (Recipe,),
    "losses": (Losses,),
    "samples": (Samples,),
    "distill": (DistillConfig,),
    "selection": (SelectionSettings,),
    "models": (ModelConfig,),
    "stages": (ModelStage,),
}
"""Keys of a recipe that hold further keys; "" = the keys on top, "distill" = those of a student
besides, "models" = those of a model of several stages."""


def topic_of(home: str) -> str:
    """The heading of a module."""
    return next(
        topic for folder, topic in TOPICS.items() if f"{home}.".startswith(f"{folder}.")
    )


def api(topic: str) -> str:
    """Every public name of a topic."""
    topics: dict[str, list[str]] = {heading: [] for heading in TOPICS.values()}
    for name, home in lidar_synth._HOME.items():
        given = getattr(lidar_synth, name)
        topics[topic_of(home)].append(f"{given.__module__}.{given.__qualname__}")
    for name in FURTHER:
        topics[topic_of(name.removeprefix("lidar_synth."))].append(name)
    return "\n".join(f"::: {name}\n" for name in topics[topic])


def command_line() -> str:
    """The help of every command, in the order of the program's own help."""
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    names = [*COMMANDS, "bank", "edit", "sensor", "skin", "metrics"]
    return "\n".join(_helps(group, Context(group, info_name="lidar-synth"), names))


def _helps(group: TyperGroup, above: Context, names: list[str]) -> Iterator[str]:
    for name in names:
        command = group.commands[name]
        context = Context(command, info_name=name, parent=above)
        if isinstance(command, TyperGroup):
            yield from _helps(command, context, list(command.commands))
        else:
            title = context.command_path.removeprefix("lidar-synth ")
            yield f"## {title}\n\n```text\n{command.get_help(context)}\n```\n"


def recipes() -> str:
    """The table of ``lidar-synth recipes``."""
    rows = ["| command | data | parameters | time |", "|---|---|---:|---|"]
    for one in (*published_models(), *published()):
        command = "bake OUT --config" if one.command == "bake" else one.command
        rows.append(
            f"| `{command} {one.name}` | {one.data} | {one.size} | {one.time} |"
        )
    return "\n".join(rows)


def recipe_keys() -> str:
    """A table of the keys of each section of a recipe."""
    titles = {
        "": "Keys of every recipe",
        "distill": "Keys of a student's recipe",
        "models": "Keys of a model's file",
    }
    parts = []
    for name, models in SECTIONS.items():
        rows = [row for model in models for row in _keys(model)]
        parts.append(
            f"## {titles.get(name, f'`{name}`')}\n\n| key | default | meaning |\n|---|---|---|\n"
            + "\n".join(rows)
        )
    return "\n\n".join(parts)


def _keys(model: type[Any]) -> Iterator[str]:
    """A row for each key that the docstring of a model explains."""
    fields = getattr(model, "model_fields", None) or model.__dataclass_fields__
    docstring = griffe.Docstring(inspect.getdoc(model) or "").parse(
        "google", warnings=False
    )
    for section in docstring:
        if section.kind is griffe.DocstringSectionKind.parameters:
            for one in section.value:
                yield (
                    f"| `{one.name}` | {_default(fields, one.name)} | "
                    f"{' '.join(one.description.split())} |"
                )


def _default(fields: Any, names: str) -> str:
    """The defaults of one or several keys; those of a section are shown in its own table."""
    plain = (str, int, float, tuple, type(None))
    given = [fields[name].default for name in names.split(", ")]
    return ", ".join(
        "none" if v is None else f"`{v}`" for v in given if isinstance(v, plain)
    )


GENERATED: dict[str, Callable[[], str]] = {
    **{f"api-{topic.lower()}": partial(api, topic) for topic in TOPICS.values()},
    "command-line": command_line,
    "recipes": recipes,
    "recipe-keys": recipe_keys,
}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs with the Markdown of a page."""
    return re.sub(
        r"^<!-- generated: (.*?) -->$",
        lambda found: GENERATED[found[1]](),
        markdown,
        flags=re.M,
    )
