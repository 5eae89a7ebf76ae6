"""Text of others, names, licences and data sets, as Markdown shows it literally."""

import html
import re


def escape_markdown(text: object) -> str:
    """A text on one line of Markdown, which shows it as it is: no HTML, link, code span or further
    cell of a table.

    Example:
        >>> escape_markdown("<b>[town](x)</b> | a")
        '&lt;b&gt;\\\\[town\\\\](x)&lt;/b&gt; \\\\| a'
    """
    plain = " ".join(html.escape(str(text), quote=False).split())
    return re.sub(r"([\\|`\[\]])", r"\\\1", plain)
