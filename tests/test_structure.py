"""The shape of the package: imports run one way, and what is public stays small enough to read."""

import ast
import graphlib
from pathlib import Path

import lidar_synth

ORDER = """errors files datasets noise geometry models flow generate labels bank formats mixing town evaluate bake viz
train proof cli""".split()
"""A module may import only from those before it."""

PACKAGE = Path(lidar_synth.__file__).parent
INTEGRATIONS = PACKAGE.parent / "integrations"


def imported(path: Path) -> set[str]:
    """The second part of every ``lidar_synth.<part>`` that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            names = [f"{node.module}.{a.name}" for a in node.names] if node.module == "lidar_synth" else [node.module]
            names = [n for n in names if n != "lidar_synth.__version__"]
        elif isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        else:
            continue
        found |= {n.split(".")[1] for n in names if n.startswith("lidar_synth.")}
    return found


def backward_imports(root: Path) -> list[str]:
    """Every import in the package that runs against ``ORDER``."""
    wrong = []
    for path in sorted(root.rglob("*.py")):
        part = path.relative_to(root).parts[0].removesuffix(".py")
        if part in ("__init__", "__main__"):
            continue
        assert part in ORDER, f"{path}: give it its place in ORDER"
        wrong += [f"{part} imports {o}" for o in imported(path) if o not in ORDER[: ORDER.index(part) + 1]]
    return wrong


def test_imports_run_one_way() -> None:
    assert backward_imports(PACKAGE) == []


def test_a_backward_import_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "noise.py").write_text("from lidar_synth.flow.path import interpolate\n")
    (tmp_path / "flow.py").write_text("import numpy\nfrom lidar_synth import noise\n")
    assert backward_imports(tmp_path) == ["noise imports flow"]


def test_the_package_never_imports_its_integrations() -> None:
    assert all("integrations" not in imported(p) for p in PACKAGE.rglob("*.py") if INTEGRATIONS not in p.parents)


ROOMS = 19
LINES = 400
PUBLIC = {"lidar_synth.__main__"}
"""Modules for users, which nothing in the repository has to import."""


def modules() -> dict[str, Path]:
    """Every module of the package by its name."""
    names = {".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): p for p in PACKAGE.rglob("*.py")}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


def imports_of(path: Path, known: dict[str, Path]) -> set[str]:
    """The package's modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {m if (m := f"{node.module}.{a.name}") in known else node.module for a in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
    return found & known.keys()


def test_the_package_has_few_rooms() -> None:
    there = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}
    assert there - {"__init__", "__main__"} == set(ORDER)
    assert len(ORDER) <= ROOMS


def test_no_modules_import_each_other_in_a_circle() -> None:
    known = modules()
    graph = {name: imports_of(path, known) - {name} for name, path in known.items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError


def test_every_module_is_imported_by_something() -> None:
    known = modules()
    outside = [p for folder in ("integrations", "tools") for p in (PACKAGE.parent / folder).rglob("*.py")]
    used = set().union(*(imports_of(path, known) - {name} for name, path in known.items()))
    used |= set().union(*(imports_of(path, known) for path in outside))
    packages = {name for name, path in known.items() if path.name == "__init__.py"}
    assert known.keys() - used - packages == PUBLIC


def test_no_file_is_too_long_to_read() -> None:
    root = PACKAGE.parent
    folders = [root / name for name in ("lidar_synth", "integrations", "tools", "tests", "configs")]
    long = {p.name for f in folders for p in f.rglob("*.py") if len(p.read_text().splitlines()) > LINES}
    assert long == set()


def test_open3d_is_imported_by_nothing_at_import_time() -> None:
    """On a bare machine its import fails; everything else has to work."""
    for path in PACKAGE.rglob("*.py"):
        top = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.Import | ast.ImportFrom)]
        names = [a.name for n in top for a in n.names] + [n.module or "" for n in top if isinstance(n, ast.ImportFrom)]
        assert not any(n.split(".")[0] == "open3d" for n in names), path


def test_what_the_package_offers_can_be_imported() -> None:
    for name in lidar_synth.__all__:
        assert getattr(lidar_synth, name) is not None
