"""The doctor finds what is missing and names the line that mends it."""

import importlib
import json
import re
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
import typer
from project import PYPROJECT
from typer.testing import CliRunner

from lidar_synth.cli import diagnosis as doctor
from lidar_synth.cli.diagnosis import (
    DATA_ROOTS,
    SHARED_OBJECTS,
    Finding,
    examine,
    report,
    works,
)
from lidar_synth.cli.doctor import doctor as command
from lidar_synth.lab.evaluate.extractors.specification import FOLDER_VARIABLE

app = typer.Typer(add_completion=False)
app.command()(command)


def named(findings: list[Finding], name: str) -> Finding:
    [found] = [finding for finding in findings if finding.name == name]
    return found


@pytest.fixture
def importing(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Makes the import of one module raise, or give another module."""
    real = importlib.import_module

    def change(name: str, outcome: Exception | ModuleType) -> None:
        def fake(wanted: str, package: str | None = None) -> ModuleType:
            if wanted != name:
                return real(wanted, package)
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        monkeypatch.setattr(doctor.importlib, "import_module", fake)  # type: ignore[attr-defined]

    return change


def test_this_machine_works() -> None:
    findings = examine()
    assert works(findings)
    assert named(findings, "torch").found == torch.__version__
    assert named(findings, "projection").state == "ok"
    assert re.search(r"\d+ cores", named(findings, "CPU").found)


def test_every_dependency_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, by its name and the least version, and as installed if it is."""
    project = PYPROJECT["project"]
    lines = list(project["dependencies"])
    for extra, needed in project["optional-dependencies"].items():
        if extra not in doctor.DEVELOPMENT:
            lines += [f"{line}; extra == '{extra}'" for line in needed]
    names = [re.split(r"[\[!>=<; ]", line)[0] for line in lines]
    monkeypatch.setattr(doctor, "requires", lambda package: lines)
    findings = list(doctor._libraries())[1:-1]  # Python before, the projection after
    assert [finding.name for finding in findings] == names
    for finding in findings:
        if finding.found == "not installed":
            with pytest.raises(PackageNotFoundError):
                version(finding.name)
    assert set(doctor.OPTIONAL) | set(doctor.MODULES) <= set(names)


@pytest.mark.parametrize("line", ["h5py>=99.1", "h5py[a,b] >=99.1", "h5py!=3.2,>=99.1"])
def test_a_least_version_is_found(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "requires", lambda package: [line])
    found = named(list(doctor._libraries()), "h5py")
    assert found.found.endswith(", older than 99.1")


def test_a_required_library_that_is_missing_breaks_the_package(
    importing: Callable[..., None],
) -> None:
    importing("h5py", ModuleNotFoundError("No module named 'h5py'"))
    findings = examine()
    lost = named(findings, "h5py")
    assert (lost.state, lost.found) == ("broken", "not installed")
    assert re.fullmatch(r"pip install 'h5py>=[\d.]+'", lost.fix)
    assert not works(findings)
    assert "The package does not work" in report(findings)


def test_an_old_library_is_told_by_its_version(importing: Callable[..., None]) -> None:
    old = ModuleType("numba")
    old.__version__ = "0.9.1"  # type: ignore[attr-defined]
    importing("numba", old)
    found = named(examine(), "numba")
    assert found.state == "broken"
    assert re.match(r"0\.9\.1, older than 0\.\d\d", found.found), (
        "numbers, not text, are compared"
    )


def test_open3d_without_its_system_libraries(
    importing: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the packages whose libraries are missing are named, and the package works without."""
    importing("open3d", OSError("libusb-1.0.so.0: cannot open shared object file"))
    monkeypatch.setattr(doctor.sys, "platform", "linux")  # type: ignore[attr-defined]
    monkeypatch.setattr(
        doctor,
        "_loads",
        lambda library: library not in ("libusb-1.0.so.0", "libEGL.so.1"),
    )
    findings = list(doctor._libraries())
    found = named(findings, "open3d")
    assert (found.state, found.found) == ("absent", "lacks system libraries")
    assert found.fix.endswith(
        "apt-get install -y --no-install-recommends libusb-1.0-0 libegl1"
    )
    assert works(findings)
    assert found.fix in report(findings)
    assert "3-D window" in report(findings)


def test_open3d_that_fails_for_another_reason_shows_it(
    importing: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    importing("open3d", ImportError("numpy.core.multiarray failed"))
    monkeypatch.setattr(doctor, "_loads", lambda library: True)
    found = named(list(doctor._libraries()), "open3d")
    assert found.state == "check"
    assert "numpy.core.multiarray failed" in found.found


def test_which_libraries_load_is_asked_of_the_system() -> None:
    assert not doctor._loads("libdoes-not-exist.so.1")
    assert set(doctor.missing_packages()) <= set(SHARED_OBJECTS.values())


def test_a_projection_that_goes_wrong_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    import lidar_synth.geometry.projection

    def shifted(scan: Any) -> SimpleNamespace:
        return SimpleNamespace(
            range=lidar_synth.geometry.projection.spherical.project(scan).range * 1.001
        )

    monkeypatch.setattr(lidar_synth.geometry.projection, "project", shifted)
    assert doctor._geometry().state == "broken"


def test_the_cards_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    card = SimpleNamespace(
        name="NVIDIA H200", total_memory=139 * 2**30, major=9, minor=0
    )
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda number: card)
    [found] = doctor._cuda()
    assert (found.name, found.state) == ("cuda:0", "ok")
    assert found.found.startswith("NVIDIA H200, 139 GiB, compute 9.0")


@pytest.mark.parametrize(
    ("driver", "build", "state", "found"),
    [
        (None, None, "absent", "no NVIDIA driver: torch computes on cpu, mps"),
        ("/usr/bin/nvidia-smi", None, "check", "built for the CPU"),
        ("/usr/bin/nvidia-smi", "13.0", "check", "finds no GPU"),
    ],
)
def test_why_there_is_no_card(
    monkeypatch: pytest.MonkeyPatch,
    driver: str | None,
    build: str | None,
    state: str,
    found: str,
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.version, "cuda", build)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: driver)  # type: ignore[attr-defined]
    [finding] = doctor._cuda()
    assert finding.state == state
    assert found in finding.found


@pytest.mark.parametrize("variable", sorted({*DATA_ROOTS, FOLDER_VARIABLE}))
def test_data_roots_are_checked(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(variable, raising=False)
    assert named(list(doctor._data()), variable).found == "not set"
    monkeypatch.setenv(variable, str(tmp_path / "nowhere"))
    assert "is not a folder" in named(list(doctor._data()), variable).found
    monkeypatch.setenv(variable, str(tmp_path))
    empty = named(list(doctor._data()), variable)
    pattern, companions = DATA_ROOTS[variable]
    assert (empty.state, pattern in empty.found) == ("check", True)
    file = tmp_path / pattern.replace("*", "0")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"")
    right = named(list(doctor._data()), variable)
    assert right.state == "ok"
    assert all(name in right.found for name in companions)
    for name in companions:
        (tmp_path / name).mkdir(parents=True)
    assert named(list(doctor._data()), variable).found == str(tmp_path)


def test_the_command_tells_the_same_to_people_and_to_scripts() -> None:
    people = CliRunner().invoke(app)
    scripts = CliRunner().invoke(app, ["--json"])
    assert (people.exit_code, scripts.exit_code) == (0, 0)
    told = json.loads(scripts.stdout)
    assert told["works"] is True
    for finding in told["findings"]:
        assert f"{finding['state']:<7} {finding['name']}" in people.stdout
    assert people.stdout.strip().endswith("The package works.")


def test_the_command_fails_where_the_package_does(
    importing: Callable[..., None],
) -> None:
    importing("safetensors", ImportError("no version information"))
    result = CliRunner().invoke(app, ["--json"])
    assert result.exit_code == 1
    assert json.loads(result.stdout)["works"] is False


def test_nothing_that_only_developers_need_is_listed() -> None:
    names = {finding.name for finding in examine()}
    assert "pydantic" in names and "submitit" in names
    assert not names & {"mkdocs-material", "nbclient", "flask", "moto"}
