"""Extension of griffe, which reads docstrings for mkdocstrings: a section ``Example:`` is shown as
code."""

import re
from typing import Any

import griffe


class Examples(griffe.Extension):
    """Griffe knows the section ``Examples:``; any other heading would become a box of prose."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = re.sub(
                r"^(\s*)Example:$", r"\1Examples:", obj.docstring.value, flags=re.M
            )
