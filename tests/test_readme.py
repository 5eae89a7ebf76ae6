"""What the README shows runs as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from lidar_synth.cli import COMMANDS
from lidar_synth.town import Town, export_town

README = (Path(__file__).parent.parent / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


@pytest.mark.parametrize(("code", "seen"), list(zip(blocks("python"), ("torch.Size", "dict_keys"), strict=True)))
def test_the_ten_lines_run(code: str, seen: str, tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    export_town(Town(0, scans=3), tmp_path / "demo_out" / "town", "semantic_kitti", camera=False, progress=False)
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert seen in run.stdout


def test_the_commands_it_names_exist() -> None:
    named = set(re.findall(r"^lidar-synth +(\S+)", "\n".join(blocks("sh")), re.M))
    assert named and named <= set(COMMANDS)


def test_the_files_it_points_to_exist() -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert links
    assert all((Path(__file__).parent.parent / link).exists() for link in links), links
