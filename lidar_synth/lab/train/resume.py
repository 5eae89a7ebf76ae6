"""What a run may be resumed with: the settings that it began with, and more iterations."""

import os
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

from lidar_synth.errors import ConfigError
from lidar_synth.files.hub import shipped_models
from lidar_synth.generate.checkpoint import Header, read_header
from lidar_synth.generate.loading import find_model
from lidar_synth.lab.train.config import PARENTS, Run, read_values, validate
from lidar_synth.lab.train.config.load import Config
from lidar_synth.lab.train.schedules import SCHEDULES
from lidar_synth.lab.train.state import read_progress

HARMLESS = {
    "output",
    "save_every",
    "samples.every",
    "samples.count",
    "compile",
    "gradient_checkpointing",
    "data.cache",
    "data.jobs",
    "data.licence",  # of a selection of timesteps
}
"""Keys that change where things lie, how much is written, what is said of it and how fast it goes,
and not what is learned."""
MORE = "recipe.iterations"
"""What may grow, and may shrink before the learning rate falls."""
_SHOWN = 4  # differences in one message


def check_resumed(config: Run) -> None:
    """Refuse to resume a run with other settings than those in the ``config.yaml`` of its output
    folder.

    Raises:
        ConfigError: naming the differences, or where fewer iterations than before would change the
            steps done.
        FileError: where there is no ``config.yaml``, or the state cannot be read.
        DataError: on a file that is not a state.
    """
    began = read_beginning(config)
    before, now = (
        flatten(without_wording(some.model_dump(mode="json")))
        for some in (began, config)
    )
    if now[MORE] > before[MORE] or _same_steps(config, began.recipe.iterations):
        before[MORE] = now[MORE]
    _refuse_others(config, (before | now).keys() - HARMLESS, before, now)


def read_beginning(config: Config) -> Config:
    """The configuration with which the run in the output folder of ``config`` was started or
    resumed last.

    Raises:
        ConfigError: if it is damaged.
        FileError: where it cannot be read.
    """
    path = config.output / "config.yaml"
    return validate(type(config), read_values(path, type(config)), str(path))


def _same_steps(config: Run, before: int) -> bool:
    """Whether all steps done had the learning rate that they have with the iterations of
    ``config``."""
    recipe = config.recipe
    done = read_progress(config.output).step
    rates = {
        SCHEDULES[recipe.schedule](max(0, done - 1), recipe.warmup, i)
        for i in (before, recipe.iterations)
    }
    return done < recipe.iterations and len(rates) == 1


def check_parents(config: Run, header: Header) -> None:
    """Refuse to resume a run whose teacher, start or autoencoder is another one now, under the old
    path.

    Args:
        config: of the run.
        header: what its checkpoint is going to say.

    Raises:
        ConfigError: naming what is another one.
    """
    if config.checkpoint.exists():  # else killed before its first checkpoint
        before = read_header(config.checkpoint)[0].provenance
        _refuse_others(config, PARENTS, before, header.provenance)


def check_done(config: Run) -> None:
    """Refuse to keep a finished run with other settings than it had, or if a checkpoint that it
    started from is another one now.

    Raises:
        ConfigError: naming what differs, and as ``check_resumed``.
        FileError, DataError: where the run cannot be read.
    """
    check_resumed(config)
    facts = read_header(config.checkpoint)[0].provenance
    for key in PARENTS:
        path = getattr(config, key, None)
        if path is None or is_missing(path):
            continue
        if facts.get(key) != read_header(find_model(path))[1]:
            raise ConfigError(
                f"{config.output}, which was made from another {key} than {path} is now",
                "the same one",
                f"Remove {config.output} to run the stage again, or give another folder.",
            )


def is_missing(path: Path) -> bool:
    """Whether there is no checkpoint to start from: neither a file nor a shipped model of that
    name."""
    return str(path) not in shipped_models() and not path.is_file()


def _refuse_others(
    config: Run,
    keys: Container[str],
    before: Mapping[str, Any],
    now: Mapping[str, Any],
) -> None:
    """Refuse other values than before of these keys, in the order of the configuration."""
    named = [
        f"{key}={now.get(key)!r} (it began with {before.get(key)!r})"
        for key in {**before, **now}
        if key in keys and now.get(key) != before.get(key)
    ]
    if not named:
        return
    more = f" and {len(named) - _SHOWN} more" if len(named) > _SHOWN else ""
    raise ConfigError(
        f"--resume of {config.output} with {', '.join(named[:_SHOWN])}{more}",
        "the settings that it began with; more recipe.iterations, or fewer before the rate "
        "falls, are allowed",
        "Give those, or another folder for a new run (output=FOLDER, --out of reproduce).",
    )


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dots between the levels of a key."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        # An empty mapping is a value: nothing else would stand for it.
        if isinstance(value, Mapping) and value:
            result |= flatten(value, f"{prefix}{key}.")
        else:
            result[f"{prefix}{key}"] = value
    return result


def without_wording(values: Any) -> Any:
    """Settings without what is said of a licence, and with whole paths, as they are now."""
    if isinstance(values, list):
        return [without_wording(one) for one in values]
    if not isinstance(values, dict):
        return values
    plain = {key: without_wording(values[key]) for key in values if key != "licence"}
    if path := plain.get("path"):
        plain["path"] = os.path.realpath(os.path.expandvars(path))
    return plain
