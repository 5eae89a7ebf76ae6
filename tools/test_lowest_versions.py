"""Run the tests of files and banks on the lowest versions of the dependencies that pyproject.toml
declares.

    python tools/test_lowest_versions.py [--venv FOLDER] [TESTS...]

The script makes its own virtual environment and installs exactly those versions in it. Everything
else (torch, open3d and the libraries that only the tests need) comes from the environment that runs
the script: their lowest versions need gigabytes of CUDA libraries, or have no build for CPUs. The
table at the end lists the versions that were used.
"""

import argparse
import os
import re
import subprocess
import sys
import venv
from importlib.metadata import version
from pathlib import Path

import tomllib

ROOT = Path(__file__).parent.parent
KEPT = ("torch", "open3d")
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
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "dependencies"
    ]
    found = [re.match(r"([\w-]+)>=([\d.]+)", text) for text in declared]
    assert all(found), declared
    return {match[1]: match[2] for match in found if match}


def install(folder: Path, wanted: dict[str, str]) -> Path:
    """Make an environment in which these versions take precedence over the current ones; returns
    its Python."""
    venv.create(folder, with_pip=True, clear=True)
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
    (packages / "rest.pth").write_text("\n".join([str(ROOT), *here]) + "\n")
    return python


def main() -> None:
    """Installs, tests, prints the table; the exit status is that of pytest."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--venv",
        type=Path,
        default=ROOT / ".venv-lowest",
        help="folder of the environment, which is replaced",
    )
    parser.add_argument(
        "tests", nargs="*", help="test files [default: those of files and banks]"
    )
    options = parser.parse_args()
    wanted = {name: text for name, text in lowest().items() if name not in KEPT}
    python = install(options.venv.absolute(), wanted)
    tests = options.tests or [
        f"tests/{name}" for name in TESTS if (ROOT / "tests" / name).exists()
    ]
    versions = subprocess.run(
        [
            python,
            "-c",
            "import sys; from importlib.metadata import version\n"
            "for name in sys.argv[1:]: print(version(name))",
            *wanted,
        ],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(options.venv.absolute() / "numba")
    }
    done = subprocess.run(
        [python, "-m", "pytest", *tests], cwd=ROOT, env=environment, check=False
    )
    print(
        f"\nPython {sys.version.split()[0]}\n\n| dependency | declared from | tested "
        "|\n|---|---|---|"
    )
    for name, text in zip(wanted, versions, strict=True):
        print(f"| {name} | {wanted[name]} | {text} |")
    for name in KEPT:
        print(
            f"| {name} | {lowest()[name]} | {version(name)}: not at its lowest version, see above |"
        )
    print(
        f"\n{' '.join(tests)}: "
        f"{'passed' if done.returncode == 0 else f'failed, status {done.returncode}'}"
    )
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
