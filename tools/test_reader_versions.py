"""Read banks and plans by ``integrations/reader.py`` alone, on old versions of Python, numpy and
h5py.

    python tools/test_reader_versions.py --python python3.8 numpy==1.23.5
        --python python3.10 numpy==1.23.5 h5py==3.8.0

The package writes the banks and plans of ``tests/reader_cases.py`` and its own reading of them;
each environment, made anew with the given packages and without this one, has to read the same bits.
Prints a line for each.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from reader_cases import write_cases  # noqa: E402


def environments(arguments: list[str]) -> list[list[str]]:
    """[interpreter, package, ...] for each ``--python``."""
    groups: list[list[str]] = []
    for word in arguments:
        if word == "--python":
            groups.append([])
        elif not groups or word.startswith("-"):
            sys.exit(__doc__)
        else:
            groups[-1].append(word)
    return groups if groups and all(groups) else sys.exit(__doc__)


def main() -> None:
    """Writes the cases and reads them in every environment; the exit status is 1 if one fails."""
    wanted = environments(sys.argv[1:])
    failed = False
    with tempfile.TemporaryDirectory() as made:
        work = Path(made)
        write_cases(work / "cases")
        (work / "alone").mkdir()
        shutil.copy(ROOT / "integrations" / "reader.py", work / "alone" / "reader.py")
        for number, (interpreter, *packages) in enumerate(wanted):
            folder = work / f"venv-{number}"
            subprocess.run([interpreter, "-m", "venv", folder], check=True)
            pip = [
                folder / "bin" / "python",
                "-m",
                "pip",
                "install",
                "--quiet",
                "--disable-pip-version-check",
            ]
            subprocess.run(
                [*pip, "--only-binary", ":all:", "h5py", *packages], check=True
            )
            command = [
                folder / "bin" / "python",
                ROOT / "tests" / "read_alone.py",
                work / "alone",
                work / "cases",
            ]
            failed |= subprocess.run(command, check=False).returncode != 0
    sys.exit(failed)


if __name__ == "__main__":
    main()
