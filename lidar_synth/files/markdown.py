"""Text of others, names, licences and data sets, as Markdown shows it literally."""

import html
import re
from collections.abc import Mapping


def escape_markdown(text: object) -> str:
    """A text on one line of Markdown, which shows it as it is: no HTML, link, code span or further
    cell of a table.

    Example:
        >>> escape_markdown("<b>[town](x)</b> | a")
        '&lt;b&gt;\\\\[town\\\\](x)&lt;/b&gt; \\\\| a'
    """
    plain = " ".join(html.escape(str(text), quote=False).split())
    return re.sub(r"([\\|`\[\]])", r"\\\1", plain)


def list_facts(facts: Mapping[str, object]) -> list[str]:
    """The lines of a table with a row for each fact.

    Example:
        >>> list_facts({"scans": 8})
        ['| | |', '|---|---|', '| scans | 8 |']
    """
    rows = [f"| {name} | {escape_markdown(value)} |" for name, value in facts.items()]
    return ["| | |", "|---|---|", *rows]
