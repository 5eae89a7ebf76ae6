"""Run the tests of files and banks on the lowest versions of the dependencies that pyproject.toml
declares.

    python tools/test_lowest_versions.py [--venv FOLDER] [TESTS...]

The script makes its own virtual environment and installs exactly those versions in it. Everything
else (torch and the libraries that only the tests need) comes from the environment that runs the
script: the lowest version of torch needs gigabytes of CUDA libraries. The table at the end lists
the versions that were used.
"""

import os
import re
import subprocess
import sys
import venv as environments
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import tomllib
from typer import Argument, run

ROOT = Path(__file__).parent.parent
KEPT = ("torch",)
"""Dependencies whose version stays that of the environment that runs this."""

TESTS = (
    "test_formats.py",
    "test_formats_annotations.py",
    "test_bad_input.py",
    "test_bad_files.py",
    "test_bank.py",
    "test_bank_encoding.py",
    "test_bank_damage.py",
    "test_bank_hostile.py",
    "test_bank_url.py",
    "test_convert.py",
    "test_convert_content.py",
    "test_paste.py",
    "test_object_bank.py",
    "test_curate.py",
    "test_curated_banks.py",
    "test_curate_rules.py",
    "test_verify.py",
    "test_projection.py",
    "test_sensor.py",
    "test_config.py",
    "test_checkpoint.py",
    "test_files.py",
)


def lowest() -> dict[str, str]:
    """{distribution: lowest version} of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = project["dependencies"]
    found = [re.match(r"([\w-]+)>=([\d.]+)", text) for text in declared]
    assert all(found), declared
    return {match[1]: match[2] for match in found if match}


def install(folder: Path, wanted: dict[str, str]) -> Path:
    """Make an environment in which these versions take precedence over the current ones; returns
    its Python."""
    environments.create(folder, with_pip=True, clear=True)
    python = folder / "bin" / "python"
    pins = [f"{name}=={text}" for name, text in wanted.items()]
    pip = [
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--only-binary",
        ":all:",
    ]
    subprocess.run([*pip, *pins], check=True)
    packages = next((folder / "lib").glob("python*")) / "site-packages"
    here = [path for path in sys.path if path.endswith("-packages")]
    # as site folders: the checkout is installed there by a .pth file
    (packages / "rest.pth").write_text(
        f"import site; list(map(site.addsitedir, {here!r}))\n"
    )
    return python


def versions(python: Path, names: Iterable[str]) -> list[str]:
    """The versions of distributions in an environment."""
    code = "import sys; from importlib.metadata import version; print(*map(version, sys.argv[1:]))"
    call = [python, "-c", code, *names]
    return subprocess.run(
        call, check=True, capture_output=True, text=True
    ).stdout.split()


def main(
    venv: Path = ROOT / ".venv-lowest",
    tests: Annotated[list[str] | None, Argument()] = None,
) -> None:
    """Installs, runs the tests, by default those of files and banks, and prints the table; the
    exit status is that of pytest."""
    declared = lowest()
    wanted = {name: text for name, text in declared.items() if name not in KEPT}
    python = install(venv.absolute(), wanted)
    files = (f"tests/{name}" for name in TESTS)
    chosen = tests or [name for name in files if (ROOT / name).exists()]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(venv.absolute() / "numba")}
    call = [python, "-m", "pytest", *chosen]
    status = subprocess.run(call, cwd=ROOT, env=environment, check=False).returncode
    print(f"\nPython {sys.version.split()[0]}\n")
    print("| dependency | declared from | tested |\n|---|---|---|")
    for name, text in zip(wanted, versions(python, wanted), strict=True):
        print(f"| {name} | {wanted[name]} | {text} |")
    for name in KEPT:
        used = f"{version(name)}: not at its lowest version, see above"
        print(f"| {name} | {declared[name]} | {used} |")
    outcome = f"failed, status {status}" if status else "passed"
    print(f"\n{' '.join(chosen)}: {outcome}")
    sys.exit(status)


if __name__ == "__main__":
    run(main)
