"""Wrong options and commands: each is answered in one line that names the nearest ones."""

from typing import Any

from typer.core import TyperGroup

from lidar_synth.errors import suggest

_NUMBER = ("--count", "--scans", "--synthetic")
MEANT = {
    "--n": _NUMBER,
    "--num": _NUMBER,
    "--number": _NUMBER,
    "--count": _NUMBER,
    "--scans": _NUMBER,
    "--samples": _NUMBER,
    "--output": ("--out",),
    "--format": ("--to", "--layout"),
    "--epochs": ("--iterations",),
    "--steps": ("--iterations",),
    "--batch-size": ("--batch",),
    "--gpu": ("--device",),
    "--cuda": ("--device",),
    "--checkpoint": ("--model",),
    "--weights": ("--model",),
    "--ckpt": ("--model",),
    "--dataset": ("--layout",),
    "--workers": ("--jobs",),
    "--metrics": ("--protocol",),
}
"""Options of other tools, and what they are called here."""

MEANT_COMMANDS = {
    "generate": "sample",
    "mix": "check-mix",
    "fit": "sensor",
    "visualize": "view",
    "show": "view",
    "simulate": "town",
    "finetune": "adapt",
    "benchmark": "prove",
    "init": "start",
    "export": "convert",
    "help": "--help",
}
"""Commands of other tools, and what they are called here."""


class Commands(TyperGroup):
    """A group of commands that explains wrong options and commands of all below it."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the first sentence of each command, whole."""
        rows = []
        for name, command in self.commands.items():
            said = " ".join((command.help or "").split())
            rows.append((name, f"{said.split('. ')[0].rstrip('.')}."))
        with formatter.section("Commands"):
            formatter.write_dl(rows)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; a complaint about its arguments names the nearest ones."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            _explain(error)
            raise


def _explain(error: Any) -> None:
    """Complete the message of an error of usage; other errors are left alone."""
    message = getattr(error, "message", "")
    context: Any = getattr(error, "ctx", None)
    if context is None:
        return
    command = context.command
    name = context.command_path.replace("root", "lidar-synth", 1)
    if hasattr(error, "possibilities"):
        error.possibilities = None
        error.message = f"No such option: {error.option_name} of {name}. " + _options(
            error.option_name, command
        )
    elif message.startswith("No such command"):
        wrong = message.split("'")[1]
        hint = suggest(MEANT_COMMANDS.get(wrong, wrong), [*command.commands, "--help"])
        there = ", ".join(command.commands)
        error.message = f"No such command {wrong!r}. {hint or f'{name} has {there}.'}"


def _options(given: str, command: Any) -> str:
    """The options of a command that are nearest to a wrong one; all if none is near."""
    names = [
        name for param in command.params for name in param.opts if name[:2] == "--"
    ]
    meant = [name for name in MEANT.get(given, ()) if name in names]
    if meant:
        return suggest(meant[0], meant)
    if any(param.name == "overrides" for param in command.params):
        return "Keys of a recipe are given as key=value, such as recipe.iterations=3."
    if given == "--output" and any(param.name == "out" for param in command.params):
        return "The folder is the argument OUT."
    return suggest(given, names) or f"It has {', '.join([*names, '--help'])}."
