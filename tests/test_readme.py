"""The README's code runs as printed; the documents' links and file names lead somewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from project import ROOT

from lidar_synth.town import Town, export_town

README = (ROOT / "README.md").read_text()
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("docs/**/*.md")), ROOT / "tests/golden/README.md"]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


@pytest.mark.slow
def test_the_ten_lines_run(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    [code] = blocks("python")
    export_town(Town(0, scans=3), tmp_path / "demo_out" / "town", "semantic_kitti", camera=False, progress=False)
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "torch.Size" in run.stdout


def anchors(text: str) -> set[str]:
    """The anchors that GitHub makes of the headings of a Markdown file."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


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
    named = re.findall(r"`((?:lidar_synth|integrations|configs|tools|tests)/[\w/.]+\w/?)`", document.read_text())
    assert [name for name in named if not (ROOT / name).exists()] == []
