"""Models that several runs make one after the other: a YAML file names each run's recipe and its
share of the time.

Published ones are in ``configs/models``; ``lidar-synth train NAME`` runs their stages.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import Field

from lidar_synth.errors import ConfigError
from lidar_synth.files.recipes import (
    SUFFIXES,
    Listed,
    folder,
    head_of,
    read_file,
    read_recipe,
    validate,
)
from lidar_synth.lab.train.config.sections import Run, Section

PARENTS = ("teacher", "weaker", "init", "codec")
"""Keys of a recipe that name checkpoints; a provenance holds their hashes under the same names."""


class ModelStage(Section):
    """A run of a recipe.

    Args:
        recipe: a published recipe's name, or a YAML file beside that of the model.
        minutes: of training, as long as ``--minutes`` gives no other sum.
        needs: {key of the recipe: the earlier stage whose checkpoint it names}; ``MODEL/STAGE`` is
            a stage of another model, whose folder lies beside that of this one.
    """

    recipe: str
    minutes: Annotated[float, Field(gt=0)]
    needs: Annotated[dict[str, str], Field(default_factory=dict)]


class ModelConfig(Section):
    """A model and the stages that make it.

    Args:
        stages: {name: recipe, minutes and needs}, in order; the last one makes the model.
    """

    stages: Annotated[dict[str, ModelStage], Field(min_length=1)]


def find_model_file(given: str | Path) -> Path | None:
    """The file of a model of stages; None for a recipe.

    Args:
        given: the name of a published model, such as ``town``, or a YAML file, which is a
            model's if it has the key ``stages``.
    """
    path = Path(given)
    if path.suffix in SUFFIXES:
        return path if "stages" in read_file(path) else None
    published = folder() / "models" / f"{given}.yaml"
    return published if path.name == str(given) and published.is_file() else None


def load_model(path: Path) -> ModelConfig:
    """The stages of a model.

    Raises:
        FileError: where the file cannot be read.
        ConfigError: on what is no model, or a stage that needs one that is not before it.
    """
    model = validate(ModelConfig, read_recipe(path), str(path))
    earlier: list[str] = []
    for name, stage in model.stages.items():
        if not name.isidentifier() or name in Run.model_fields:
            raise ConfigError(
                f"{path}: stage {name!r}",
                "a name of letters, digits and _, and no key of a recipe",
            )
        for key, other in stage.needs.items():
            if key not in PARENTS:
                raise ConfigError(
                    f"{path}: {name}.needs with {key!r}",
                    f"keys among {', '.join(PARENTS)}",
                )
            if "/" not in other and other not in earlier:
                known = ", ".join(earlier) or "none"
                raise ConfigError(
                    f"{path}: {name}.needs with the stage {other!r}",
                    f"an earlier one ({known})",
                )
        earlier.append(name)
    return model


def published_models() -> Iterator[Listed]:
    """The models of stages that come with the package, by name; their time is that of training."""
    for path in sorted(
        (folder() / "models").glob("*.yaml"), key=lambda path: path.stem
    ):
        about = read_file(path)["about"]
        hours = sum(stage.minutes for stage in load_model(path).stages.values()) / 60
        time = f"{hours:.1f} h, the default limit"
        yield Listed(
            path.stem, "train", about["data"], about["size"], time, head_of(path)
        )
