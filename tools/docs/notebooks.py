"""Executes the notebooks of docs/notebooks and keeps their outputs, which the site shows: ``make
notebooks``.

    python tools/docs/notebooks.py [NOTEBOOK...]

Each runs in an empty folder of its own. The notebook's metadata record a hash of its code, by which
a test sees that the outputs belong to the code.
"""

import hashlib
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent.parent / "docs" / "notebooks"


def code_hash(book: nbformat.NotebookNode) -> str:
    """sha256 of the code of all cells."""
    code = "\n\0\n".join(cell.source for cell in book.cells if cell.cell_type == "code")
    return hashlib.sha256(code.encode()).hexdigest()


def execute(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Run a notebook in a folder; progress bars are left out of its outputs.

    Raises:
        CellExecutionError: where a cell fails.
    """
    book = nbformat.read(path, as_version=4)
    environment = os.environ | {"IPYTHONDIR": str(folder / ".ipython")}
    client = NotebookClient(
        book,
        timeout=600,
        record_timing=False,
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute(env=environment)
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs = [
                output for output in cell.outputs if output.get("name") != "stderr"
            ]
    return book


def main() -> None:
    """Executes the given notebooks, or all."""
    for path in [Path(given) for given in sys.argv[1:]] or sorted(
        FOLDER.glob("*.ipynb")
    ):
        with TemporaryDirectory() as folder:
            book = execute(path, Path(folder))
        kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
        book.metadata = {"kernelspec": kernel, "code_sha256": code_hash(book)}
        nbformat.write(book, path)
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
