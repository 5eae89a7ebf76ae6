"""What gets installed is what is in the repository."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from project import PYPROJECT, ROOT

MAPPED = {"lidar_synth.integrations": "integrations", "lidar_synth.recipes": "configs"}
"""Packages whose folders lie beside lidar_synth/, where readers look for them."""


def test_every_package_and_data_file_is_listed() -> None:
    folders = {p.parent for p in (ROOT / "lidar_synth").rglob("*.py")}
    names = {".".join(f.relative_to(ROOT).parts) for f in folders} | set(MAPPED)
    setuptools = PYPROJECT["tool"]["setuptools"]
    assert set(setuptools["packages"]) == names
    data = {
        p.relative_to(ROOT / "lidar_synth").as_posix()
        for p in (ROOT / "lidar_synth").rglob("*")
        if p.is_file()
        and p.suffix != ".py"
        and "__pycache__" not in p.parts
        and p.name[0] != "."
    }
    listed = set()
    for package in setuptools["package-data"].keys() - MAPPED.keys():
        patterns = setuptools["package-data"][package]
        base = ROOT / package.replace(".", "/")
        listed |= {
            m.relative_to(ROOT / "lidar_synth").as_posix()
            for g in patterns
            for m in base.glob(g)
        }
    assert listed == data


def test_every_recipe_is_listed() -> None:
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]["lidar_synth.recipes"]
    listed = {path for pattern in patterns for path in (ROOT / "configs").glob(pattern)}
    there = {
        p
        for p in (ROOT / "configs").rglob("*.*")
        if p.is_file() and "__pycache__" not in p.parts
    }
    assert there - listed == {ROOT / "configs" / "__init__.py"}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and the wheel that was built from it."""
    return build(tmp_path_factory.mktemp("built"))


def build(folder: Path) -> Path:
    """Build a fresh copy of the checkout in ``folder``."""
    rubbish = shutil.ignore_patterns(
        ".*", "__pycache__", "*.egg-info", "build", "dist", "runs", "demo_out"
    )
    shutil.copytree(
        ROOT, folder / "checkout", ignore=rubbish, copy_function=shutil.copy
    )
    shutil.copytree(ROOT / ".ci", folder / "checkout" / ".ci")
    run(
        [
            sys.executable,
            "-m",
            "build",
            "--no-isolation",
            "--outdir",
            folder,
            folder / "checkout",
        ],
        folder,
    )
    return folder


def environment_with(what: list[str | Path], folder: Path) -> Path:
    """The scripts of a new environment that has the package, installed from ``what``, and what it
    depends on."""
    venv.create(folder, with_pip=False)
    [site] = folder.glob("lib/python*/site-packages")
    # Paths that a .pth file adds are not searched for further .pth files: this checkout stays out
    # of sight.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        folder / "bin" / "python",
        "install",
        "--quiet",
    ]
    options = [
        "--disable-pip-version-check",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
    ]
    run([*pip, *options, *what], folder)
    return folder / "bin"


def run(command: list[str | Path], folder: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_wheel_works_from_any_folder(built: Path, tmp_path: Path) -> None:
    [wheel] = built.glob("*.whl")
    bare = environment_with([wheel], built / "environment")
    where = run(
        [bare / "python", "-c", "import lidar_synth; print(lidar_synth.__file__)"],
        tmp_path,
    )
    assert Path(where.strip()).is_relative_to(bare.parent)
    command = bare / "lidar-synth"
    assert "town_teacher" in run([command, "recipes"], tmp_path)
    few = ["recipe.iterations=2", "data.town=4", "samples.every=0"]
    assert (
        run([command, "train", "town_tiny", *few], tmp_path).strip()
        == "runs/town_tiny/town_tiny.safetensors"
    )
    model = tmp_path / "runs" / "town_tiny" / "town_tiny.safetensors"
    bake = ["bake", "bank", "--config", "bake_town", "--model", model, "--count", "2"]
    assert "2 scans in 1 shard," in run([command, *bake], tmp_path)


@pytest.mark.slow
def test_two_builds_have_the_same_bytes(built: Path, tmp_path: Path) -> None:
    """At other times, in other folders, and with other permissions of new files."""
    old = os.umask(0o077)
    try:
        again = build(tmp_path)
    finally:
        os.umask(old)
    for pattern, most in (("*.tar.gz", 60e6), ("*.whl", 55e6)):
        [first] = built.glob(pattern)
        [second] = again.glob(pattern)
        assert first.name == second.name
        assert first.read_bytes() == second.read_bytes()
        assert first.stat().st_size < most


@pytest.mark.slow
def test_the_unpacked_sdist_runs_its_tests(built: Path, tmp_path: Path) -> None:
    """Those of a minute; all of them take as long as those of the checkout."""
    [archive] = built.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(tmp_path, filter="data")
    [root] = tmp_path.iterdir()
    ours = {
        p.relative_to(ROOT)
        for p in (ROOT / "tests").rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    }
    assert all((root / path).is_file() for path in ours)
    some = [
        f"tests/test_{name}.py"
        for name in ("structure", "config", "readme", "sensor", "scan", "solvers")
    ]
    scripts = environment_with(["--editable", root], tmp_path / "environment")
    assert " passed" in run([scripts / "python", "-m", "pytest", *some], root)


def test_the_versions_agree() -> None:
    import lidar_synth

    version = PYPROJECT["project"]["version"]
    assert lidar_synth.__version__ == version
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version


def test_the_workflow_runs_the_command_of_the_readme_on_every_python() -> None:
    workflow = yaml.safe_load(
        (ROOT / ".github" / "workflows" / "tests.yml").read_text()
    )
    job = workflow["jobs"]["tests"]
    named = PYPROJECT["project"]["classifiers"]
    pythons = re.findall(r"Python :: (3\.\d+)", "\n".join(named))
    assert job["strategy"]["matrix"]["python"] == pythons
    systems = {name.split("-")[0] for name in job["strategy"]["matrix"]["os"]}
    assert systems == {"ubuntu", "macos", "windows"}
    [command] = [
        step["run"] for step in job["steps"] if step.get("run", "").startswith("make")
    ]
    assert command == "make test PYTHON=python"
    assert "\nmake test " in (ROOT / "README.md").read_text()


def test_the_lock_file_has_the_pinned_versions_and_a_hash_for_each_package() -> None:
    """``make lock`` writes it."""
    text = (ROOT / "requirements-dev.txt").read_text()
    found = re.findall(
        r"^([\w-]+)==(\S+)([^\n]*\n(?: +--hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)",
        text,
        re.M,
    )
    locked = {name: version for name, version, _ in found}
    assert len(found) == len(re.findall(r"^\w", text, re.M))
    pins = re.findall(
        r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.M
    )
    assert {
        plain_name(name): version for name, version in pins
    }.items() <= locked.items()
    project = PYPROJECT["project"]
    wanted = project["dependencies"] + project["optional-dependencies"]["dev"]
    assert set(names_of(wanted)) - set(locked) == {"tomli"}, "which is for Python 3.10"


def names_of(requirements: list[str]) -> Iterator[str]:
    """The packages of requirements, those of this package's extras too."""
    for text in requirements:
        [(name, extras)] = re.findall(r"^([\w.-]+)(?:\[([\w,]+)\])?", text)
        if name == "lidar_synth":
            for extra in extras.split(","):
                yield from names_of(
                    PYPROJECT["project"]["optional-dependencies"][extra]
                )
        else:
            yield plain_name(name)


def plain_name(name: str) -> str:
    """https://packaging.python.org/en/latest/specifications/name-normalization/"""
    return re.sub(r"[-_.]+", "-", name).lower()


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
    run = subprocess.run(
        [sys.executable, "-c", code, *args], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "lidar-synth" in run.stdout.lower()


def test_every_shipped_yaml_loads_safely() -> None:
    files = [
        p
        for folder in ("lidar_synth", "configs")
        for p in (ROOT / folder).rglob("*.yaml")
    ]
    assert files
    for path in files:
        assert isinstance(yaml.safe_load(path.read_text()), dict), path


@pytest.mark.parametrize(
    "script", sorted(ROOT.glob("tools/**/[a-z]*.py")), ids=lambda path: path.stem
)
def test_what_a_script_imports_from_the_package_is_there(script: Path) -> None:
    """Scripts are run by hand and by nobody else: what they lean on moves."""
    import ast
    import importlib

    for node in ast.walk(ast.parse(script.read_text())):
        if (
            isinstance(node, ast.ImportFrom)
            and (node.module or "").split(".")[0] == "lidar_synth"
        ):
            if "integrations" in (node.module or ""):
                continue
            module = importlib.import_module(str(node.module))
            for name in node.names:
                assert hasattr(module, name.name), (
                    f"{script.name}: {node.module} has no {name.name}"
                )
