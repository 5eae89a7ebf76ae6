"""What a run may be resumed with: the settings that it began with, and more iterations."""

from collections.abc import Mapping
from typing import Any

from lidar_synth.errors import ConfigError
from lidar_synth.generate.checkpoint import Header, read_header
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
}
"""Keys that change where things lie, how much is written and how fast it goes, and not what is
learned."""
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
    began = began_with(config)
    before = flat(began.model_dump(mode="json"))
    now = flat(config.model_dump(mode="json"))
    if now[MORE] > before[MORE] or _same_steps(config, began.recipe.iterations):
        before[MORE] = now[MORE]
    if differs := [
        k for k in before | now if before.get(k) != now.get(k) and k not in HARMLESS
    ]:
        raise _other(config, differs, before, now)


def began_with(config: Config) -> Config:
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
    path = config.output / f"{config.output.name}.safetensors"
    if not path.exists():  # killed before its first checkpoint
        return
    before, now = (
        {k: str(h.provenance.get(k)) for k in PARENTS}
        for h in (read_header(path)[0], header)
    )
    if differs := [k for k in PARENTS if before[k] != now[k]]:
        raise _other(config, differs, before, now)


def _other(
    config: Run, differs: list[str], before: Mapping[str, Any], now: Mapping[str, Any]
) -> ConfigError:
    named = [
        f"{key}={now.get(key)!r} (it began with {before.get(key)!r})" for key in differs
    ]
    more = f" and {len(named) - _SHOWN} more" if len(named) > _SHOWN else ""
    return ConfigError(
        f"--resume of {config.output} with {', '.join(named[:_SHOWN])}{more}",
        "the settings that it began with; more recipe.iterations, or fewer before the rate "
        "falls, are allowed",
        "Give those, or another output=FOLDER for a new run.",
    )


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with dots between the levels of a key."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        # An empty mapping is a value: nothing else would stand for it.
        result |= (
            flat(value, f"{prefix}{key}.")
            if isinstance(value, Mapping) and value
            else {f"{prefix}{key}": value}
        )
    return result
