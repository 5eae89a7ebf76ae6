"""Hook of mkdocs: each notebook of docs/notebooks becomes a page, as it was executed, without a
script.

A link to a notebook in another page leads to that page; the notebook itself is a file beside it.
"""

import base64
import re
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

SUFFIXES = {"image/jpeg": "jpg", "image/png": "png"}


def page_of(path: Path) -> tuple[str, dict[str, bytes]]:
    """The Markdown of a notebook's page, and the pictures beside it by name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = output.get("data", {})
            kind = next((kind for kind in SUFFIXES if kind in data), None)
            if kind:
                name = f"{path.stem}-{len(pictures)}.{SUFFIXES[kind]}"
                pictures[name] = base64.b64decode(data[kind])
                parts.append(f"![Output of the cell above]({name})")
            else:
                parts.append(
                    f"```text\n{(output.get('text') or data['text/plain']).rstrip()}\n```"
                )
    title, _, rest = "\n\n".join(parts).partition("\n")
    return (
        f"{title}\n\n[Download the notebook]({path.name}){{ download }}\n{rest}\n",
        pictures,
    )


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by mkdocs with the files of the site."""
    for path in sorted(Path(config.docs_dir, "notebooks").glob("*.ipynb")):
        text, pictures = page_of(path)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by mkdocs with the Markdown of a page."""
    if page.file.src_uri.startswith("notebooks/"):
        return markdown
    return re.sub(r"(\]\([\w./-]*notebooks/\w+)\.ipynb\)", r"\1.md)", markdown)
