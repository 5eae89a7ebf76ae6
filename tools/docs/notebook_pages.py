"""Hook of mkdocs: every notebook of docs/notebooks becomes a page with its stored outputs, under "Start".

The notebook itself is copied to the site too, and its page links to it.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def notebooks(config: MkDocsConfig) -> list[Path]:
    return sorted(Path(config.docs_dir).glob("notebooks/*.ipynb"))


def markdown_of(notebook: Path) -> str:
    """A notebook as Markdown: its text, its code, and what the code printed and drew."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    parts = [part for cell in cells for part in _parts(cell)]
    return "\n\n".join([*parts, f"[Download this notebook]({notebook.name}){{: download }}"]) + "\n"


def _parts(cell: dict[str, Any]) -> Iterator[str]:
    source = _text(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
    elif cell["cell_type"] == "code":
        yield f"```python\n{source}\n```"
        for output in cell["outputs"]:
            yield from _output(output)


def _output(output: dict[str, Any]) -> Iterator[str]:
    data = output.get("data", {})
    if "image/png" in data:
        yield f"![Output](data:image/png;base64,{''.join(_text(data['image/png']).split())})"
    elif text := _text(output.get("text", data.get("text/plain", ""))).strip():
        yield f"```text\n{text}\n```"


def _text(lines: str | list[str]) -> str:
    return lines if isinstance(lines, str) else "".join(lines)


def on_config(config: MkDocsConfig) -> None:
    """Called by mkdocs before it reads the navigation."""
    if found := notebooks(config):
        start = next(entry["Start"] for entry in config.nav or [] if "Start" in entry)
        start.append({"Notebooks": [f"notebooks/{path.stem}.md" for path in found]})


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Called by mkdocs with the files of the site."""
    for path in notebooks(config):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=markdown_of(path)))
