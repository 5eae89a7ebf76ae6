"""The README's example is short; the documents' links and file names lead somewhere."""

import re
from pathlib import Path

import pytest
from project import ROOT

README = (ROOT / "README.md").read_text()
DOCUMENTS = [
    *sorted(ROOT.glob("*.md")),
    *sorted(ROOT.glob("docs/**/*.md")),
    ROOT / "tests/golden/README.md",
]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


def test_the_first_code_has_six_lines() -> None:
    [code] = blocks("python")  # test_docs_blocks.py runs it
    assert len([line for line in code.splitlines() if line.strip()]) <= 6


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_a_loader_with_workers_stands_below_a_guard(document: Path) -> None:
    """Else it fails as a script on macOS, where workers are spawned."""
    for code in re.findall(r"```python.*?\n(.*?)```", document.read_text(), re.S):
        if re.search(r"\.loader\([^)]*num_workers=[1-9]", code):
            assert 'if __name__ == "__main__":' in code


def anchors(text: str) -> set[str]:
    """The anchors that GitHub makes of the headings of a Markdown file."""
    headings = re.findall(
        r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.S), re.M
    )
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        for heading in headings
    }


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_to_existing_files_and_headings(document: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = document.parent / path if path else document
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_existing_files_of_the_repository(document: Path) -> None:
    named = re.findall(
        r"`((?:lidar_synth|integrations|configs|tools|tests)/[\w/.]+\w/?)`",
        document.read_text(),
    )
    assert [name for name in named if not (ROOT / name).exists()] == []
