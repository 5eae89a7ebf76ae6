"""Hook of mkdocs: ``$...$`` and ``$$...$$`` become MathML when the site is built, so that a page
loads no script.

pymdownx.arithmatex finds the equations (and leaves code alone); this file converts what it marks.
"""

import html
import re
from typing import Any

from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.S)
BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.S)


def on_page_content(content: str, **_: Any) -> str:
    """Called by mkdocs with the HTML of a page."""
    content = INLINE.sub(
        lambda found: convert(html.unescape(found[1]).strip()), content
    )
    return BLOCK.sub(
        lambda found: convert(html.unescape(found[1]).strip(), display="block"), content
    )
