"""The notebooks of docs/notebooks run from top to bottom; what they show was made by their code."""

import base64
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from commands import check
from documents import blocks_of, name_of, spans_of
from project import ROOT

nbformat = pytest.importorskip("nbformat")
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LARGEST = 60_000
"""Bytes of a picture."""


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """``tools/docs/notebooks.py``; what it starts computes with one thread."""
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "docs"))
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(variable, "1")
    import notebooks

    yield notebooks
    sys.modules.pop("notebooks")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_the_notebook_runs(notebook: Path, runner: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    book = runner.execute(notebook, tmp_path)
    assert kinds(book) == kinds(nbformat.read(notebook, 4))


def kinds(book: "nbformat.NotebookNode") -> list[list[str]]:
    """The kinds of output of every cell of code, such as a stream and a picture."""
    return [
        sorted(
            {
                kind
                for output in cell.outputs
                for kind in output.get("data", {output.output_type: None})
            }
        )
        for cell in book.cells
        if cell.cell_type == "code"
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "code", ["assert 1 + 1 == 3", "import lidar_synth.no_such_module"]
)
def test_a_notebook_that_fails_is_noticed(
    code: str, runner: ModuleType, tmp_path: Path
) -> None:
    from nbclient.exceptions import CellExecutionError

    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    nbformat.write(book, tmp_path / "wrong.ipynb")
    with pytest.raises(CellExecutionError):
        runner.execute(tmp_path / "wrong.ipynb", tmp_path)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_the_outputs_are_those_of_the_code(notebook: Path, runner: ModuleType) -> None:
    book = nbformat.read(notebook, 4)
    assert book.metadata["code_sha256"] == runner.code_hash(book), (
        "make notebooks runs it again"
    )
    cells = [cell for cell in book.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert not any(
        output.output_type == "error" for cell in cells for output in cell.outputs
    )


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_pictures_are_small(notebook: Path) -> None:
    cells = [
        cell for cell in nbformat.read(notebook, 4).cells if cell.cell_type == "code"
    ]
    data = [output.get("data", {}) for cell in cells for output in cell.outputs]
    pictures = [
        base64.b64decode(text)
        for one in data
        for kind, text in one.items()
        if kind.startswith("image/")
    ]
    assert pictures
    assert [len(picture) for picture in pictures if len(picture) > LARGEST] == []


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_the_commands_in_the_text_of_a_notebook_are_right(notebook: Path) -> None:
    for cell in nbformat.read(notebook, 4).cells:
        if cell.cell_type == "markdown":
            assert blocks_of(cell.source) == [], "code belongs into cells"
            for _, command in spans_of(cell.source):
                check(command)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_the_page_of_a_notebook_has_all_of_it(notebook: Path) -> None:
    pytest.importorskip("mkdocs")
    text, pictures = runpy.run_path(str(ROOT / "tools/docs/notebook_pages.py"))[
        "page_of"
    ](notebook)
    assert text.startswith("# ") and f"]({notebook.name})" in text.split("##")[0]
    assert all(
        cell.source.partition("\n")[2] in text
        for cell in nbformat.read(notebook, 4).cells
    )
    assert pictures and all(f"]({name})" in text for name in pictures)
    assert all(data.startswith((b"\xff\xd8", b"\x89PNG")) for data in pictures.values())


def test_a_link_to_a_notebook_leads_to_its_page() -> None:
    pytest.importorskip("mkdocs")
    rewrite = runpy.run_path(str(ROOT / "tools/docs/notebook_pages.py"))[
        "on_page_markdown"
    ]
    text = "[a](../notebooks/mix_and_look.ipynb), [b](x.ipynb)"
    page = SimpleNamespace(file=SimpleNamespace(src_uri="how-to/mix.md"))
    assert rewrite(text, page) == "[a](../notebooks/mix_and_look.md), [b](x.ipynb)"
