"""The command line ``lidar-synth``: one file per command; this module converts errors to exit
statuses.

Exit status 0 = success, 1 = the run failed, 2 = wrong options or arguments, 130 = interrupted by
Ctrl-C; a failure prints one message.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Annotated, Any

from typer import Exit, Option, Typer

from lidar_synth import __version__
from lidar_synth.cli.bake import bake
from lidar_synth.cli.bank import bank, info, repair, verify
from lidar_synth.cli.check_mix import check_mix
from lidar_synth.cli.convert import convert
from lidar_synth.cli.doctor import doctor
from lidar_synth.cli.edit import edit
from lidar_synth.cli.sample import sample
from lidar_synth.cli.usage import Commands
from lidar_synth.cli.view import view
from lidar_synth.errors import ConfigError, LidarSynthError

INTERRUPTED = 130
"""Exit status after Ctrl-C, as of a program that a shell saw end by SIGINT; typer exits with it,
without a message."""

COMMANDS: dict[str, Callable[..., None] | str] = {
    "start": "start",
    "town": "town",
    "convert": convert,
    "label": "label",
    "view": view,
    "sample": sample,
    "bake": bake,
    "verify": verify,
    "repair": repair,
    "info": info,
    "curate": "curate",
    "recipes": "recipes",
    "train": "train",
    "distill": "train",
    "evaluate": "evaluate",
    "stress": "stress",
    "prove": "prove",
    "reproduce": "reproduce",
    "adapt": "adapt",
    "check-mix": check_mix,
    "import": "import_",
    "doctor": doctor,
}
"""Commands by name, in the order of the help text; of the laboratory's, the module of
``lidar_synth.lab.cli``."""

GROUPS: list[Typer | str] = [bank, edit, "sensor", "skin", "metrics"]
"""Commands with commands of their own; the laboratory's by name."""

app = Typer(
    cls=Commands,
    name="lidar-synth",
    help=(
        "Synthetic LiDAR scans for perception training: generate, bake, curate, convert, "
        "evaluate, view."
    ),
    no_args_is_help=True,
    invoke_without_command=True,
    add_completion=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.callback()
def _options(
    version: Annotated[
        bool,
        Option("--version", help="Print the version and exit.", is_eager=True),
    ] = False,
) -> None:
    if version:
        print(f"lidar-synth {__version__}")
        raise Exit


def _load(module: str, name: str) -> Any:
    return getattr(import_module(f"lidar_synth.lab.cli.{module}"), name)


for _name, _command in COMMANDS.items():
    if isinstance(_command, str):
        _command = _load(_command, "import_" if _name == "import" else _name)
    app.command(_name)(_command)
for _group in GROUPS:
    app.add_typer(
        _load(_group, _group) if isinstance(_group, str) else _group, cls=Commands
    )


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except LidarSynthError as error:
        print(f"lidar-synth: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ConfigError) else 1)
    except (KeyboardInterrupt, SystemExit) as stop:
        if isinstance(stop, SystemExit) and stop.code != INTERRUPTED:
            raise
        # An object that was half made (a compiler's pass of numba, say) fails when it is deleted.
        sys.unraisablehook = lambda _: None
        print("lidar-synth: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
