"""What gets installed is what is in the repository."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_and_data_file_is_listed() -> None:
    folders = {p.parent for p in (ROOT / "lidar_synth").rglob("*.py")}
    names = {".".join(f.relative_to(ROOT).parts) for f in folders} | {"lidar_synth.integrations"}
    setuptools = PROJECT["tool"]["setuptools"]
    assert set(setuptools["packages"]) == names
    data = {
        p.relative_to(ROOT / "lidar_synth").as_posix()
        for p in (ROOT / "lidar_synth").rglob("*")
        if p.is_file() and p.suffix != ".py" and "__pycache__" not in p.parts and p.name[0] != "."
    }
    listed = set()
    for package, patterns in setuptools["package-data"].items():
        base = ROOT / package.replace(".", "/")
        listed |= {m.relative_to(ROOT / "lidar_synth").as_posix() for g in patterns for m in base.glob(g)}
    assert listed == data


def test_the_versions_agree() -> None:
    import lidar_synth

    assert lidar_synth.__version__ == PROJECT["project"]["version"]


def test_integrations_are_part_of_the_package() -> None:
    import lidar_synth.integrations

    assert lidar_synth.integrations.__file__ is not None
    assert Path(lidar_synth.integrations.__file__).parent == ROOT / "integrations"


@pytest.mark.parametrize("args", [["--help"], ["--version"]])
def test_the_command_line_starts_without_the_heavy_libraries(args: list[str]) -> None:
    code = (
        "import sys; sys.argv = ['lidar-synth', *sys.argv[1:]]\n"
        "from lidar_synth.cli import main\n"
        "try: main()\n"
        "except SystemExit as e: assert not e.code, e.code\n"
        "heavy = {'torch', 'numba', 'matplotlib', 'open3d', 'embreex'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    run = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "lidar-synth" in run.stdout.lower()


def test_every_shipped_yaml_loads_safely() -> None:
    files = [p for folder in ("lidar_synth", "configs") for p in (ROOT / folder).rglob("*.yaml")]
    assert files
    for path in files:
        assert isinstance(yaml.safe_load(path.read_text()), dict), path


@pytest.mark.parametrize("script", sorted(ROOT.glob("tools/**/[a-z]*.py")), ids=lambda path: path.stem)
def test_what_a_script_imports_from_the_package_is_there(script: Path) -> None:
    """Scripts are run by hand and by nobody else: what they lean on moves."""
    import ast
    import importlib

    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "lidar_synth":
            if "integrations" in (node.module or ""):
                continue
            module = importlib.import_module(str(node.module))
            for name in node.names:
                assert hasattr(module, name.name), f"{script.name}: {node.module} has no {name.name}"
