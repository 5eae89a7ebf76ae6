"""The command line ``lidar-synth``: one file per command, one place where errors become exit statuses.

Exit status 0 = done, 1 = the run failed with one clear message, 2 = the call was wrong.
"""

import sys
from collections.abc import Callable
from typing import Any

import typer

from lidar_synth.errors import ConfigError, LidarSynthError

app = typer.Typer(
    name="lidar-synth",
    help="Synthetic LiDAR scans for perception training: generate, mix, bake, convert, look.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _register() -> None:
    commands: dict[str, Callable[..., Any]] = {}
    for name, command in commands.items():
        app.command(name)(command)


_register()


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except LidarSynthError as error:
        print(f"lidar-synth: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ConfigError) else 1)
    except KeyboardInterrupt:
        print("lidar-synth: interrupted", file=sys.stderr)
        sys.exit(1)
