"""The shape of the package: imports run one way, and what is public stays small enough to read."""

import ast
import graphlib
import subprocess
import sys
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path

import pytest
from banks import some_image, write_bank
from mypy import api
from project import PYPROJECT
from sizes import size_of

import lidar_synth
from lidar_synth.bank import Bank
from lidar_synth.lab import curate
from lidar_synth.labels import POLICIES

ORDER = """
errors files datasets noise geometry weather generate.models generate.flow generate labels bank
formats mixing bake viz cli
lab lab.importers lab.fitting lab.kitti360 lab.town lab.evaluate lab.curate lab.train lab.proof
lab.start lab.reproduce lab.cli
""".split()
"""A module may import only from those before it and its own: the plugin (before ``lab``) never
imports the laboratory."""

PACKAGE = Path(lidar_synth.__file__).parent
INTEGRATIONS = PACKAGE.parent / "integrations"


def imported(path: Path) -> set[str]:
    """Every module of the package that a file imports, wherever in it, without the name
    ``lidar_synth``."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            whole = node.module != "lidar_synth"
            names = (
                [node.module]
                if whole
                else [f"lidar_synth.{a.name}" for a in node.names]
            )
            names = [n for n in names if n != "lidar_synth.__version__"]
        elif isinstance(node, ast.Import):
            names = [a.name for a in node.names]
        else:
            continue
        found |= {
            n.removeprefix("lidar_synth.")
            for n in names
            if n.startswith("lidar_synth.")
        }
    return found


def place(module: str) -> int:
    """The place of a module in ``ORDER``."""
    parts = module.split(".")
    prefixes = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
    room = next((p for p in prefixes if p in ORDER), None)
    assert room is not None, f"{module}: give it its place in ORDER"
    return ORDER.index(room)


def backward_imports(root: Path) -> list[str]:
    """Every import in the package that runs against ``ORDER``."""
    wrong = []
    for path in sorted(root.rglob("*.py")):
        module = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(
            ".__init__"
        )
        if module in ("__init__", "__main__"):
            continue
        known = [o for o in imported(path) if not o.startswith("integrations")]
        wrong += [f"{module} imports {o}" for o in known if place(o) > place(module)]
    return wrong


def test_imports_run_one_way() -> None:
    assert backward_imports(PACKAGE) == []


def test_a_backward_import_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "noise.py").write_text(
        "from lidar_synth.generate.flow.path import interpolate\n"
    )
    (tmp_path / "labels.py").write_text("import numpy\nfrom lidar_synth import noise\n")
    assert backward_imports(tmp_path) == ["noise imports generate.flow.path"]


def test_integrations_never_import_the_laboratory() -> None:
    files = [
        p
        for p in INTEGRATIONS.rglob("*.py")
        if any(m.startswith("lab.") for m in imported(p))
    ]
    assert files == []


def test_the_package_never_imports_its_integrations() -> None:
    assert all(
        not any(m.startswith("integrations") for m in imported(p))
        for p in PACKAGE.rglob("*.py")
        if INTEGRATIONS not in p.parents
    )


def test_the_oldest_python_has_what_is_imported_of_its_library(tmp_path: Path) -> None:
    """Else only a test on that version would notice."""
    imports = {
        ast.unparse(node)
        for path in [*PACKAGE.rglob("*.py"), *INTEGRATIONS.rglob("*.py")]
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        and (getattr(node, "module", None) or node.names[0].name).split(".")[0]
        in sys.stdlib_module_names
    }
    path = tmp_path / "imports.py"
    path.write_text("\n".join(sorted(imports)))
    oldest = PYPROJECT["project"]["requires-python"].removeprefix(">=")
    # Several modules may have one name.
    options = ["--config-file=", "--disable-error-code=assignment"]
    cache = f"--cache-dir={tmp_path}"
    found, _, status = api.run(
        [*options, cache, f"--python-version={oldest}", str(path)]
    )
    assert status == 0, found


ROOMS = 15
PUBLIC = {"lidar_synth.__main__"}
"""Modules for users, which nothing in the repository has to import."""


def modules() -> dict[str, Path]:
    """Every module of the package by its name."""
    names = {
        ".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): p
        for p in PACKAGE.rglob("*.py")
    }
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


def imports_of(path: Path, known: dict[str, Path]) -> set[str]:
    """The package's modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {
                m if (m := f"{node.module}.{a.name}") in known else node.module
                for a in node.names
            }
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
    return found & known.keys()


def test_the_package_has_few_rooms() -> None:
    there = {
        p.stem
        for p in PACKAGE.iterdir()
        if p.suffix == ".py" or (p / "__init__.py").is_file()
    }
    assert there - {"__init__", "__main__"} == {
        room for room in ORDER if "." not in room
    }
    assert len(there) <= ROOMS + 2


def test_no_modules_import_each_other_in_a_circle() -> None:
    known = modules()
    graph = {name: imports_of(path, known) - {name} for name, path in known.items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError


def unused(importers: Collection[str], folders: Iterable[str]) -> set[str]:
    """The modules of the package that no module of ``importers``, and no file of the folders
    beside it, imports."""
    known = modules()
    used = set().union(*(imports_of(known[name], known) - {name} for name in importers))
    for folder in folders:
        for path in (PACKAGE.parent / folder).rglob("*.py"):
            used |= imports_of(path, known)
    # Loaded by name.
    used |= {f"lidar_synth.labels.{home.split('.')[0]}" for home in POLICIES.values()}
    packages = {name for name, path in known.items() if path.name == "__init__.py"}
    return known.keys() - used - packages


def test_every_module_is_imported_by_something() -> None:
    commands = {name for name in modules() if name.startswith("lidar_synth.lab.cli.")}
    assert unused(modules(), ["integrations", "tools"]) - commands == PUBLIC


def test_what_only_the_laboratory_imports_is_part_of_it() -> None:
    plugin = {name for name in modules() if not name.startswith("lidar_synth.lab.")}
    assert unused(plugin, ["integrations"]) & plugin == PUBLIC | {
        "lidar_synth.files.torch_files",  # every parser stands in files
        "lidar_synth.generate.flow.distill",  # the paper's method
        "lidar_synth.generate.flow.timesteps",
        "lidar_synth.geometry.projection.batch",  # for trainers on a GPU
    }


LIMITS = {
    "plugin": (168_420, 5.91, 130),
    "laboratory": (139_100, 6.0, 130),
    "tools": (38_370, 5.8, 130),
}
"""Most tokens, tokens a code line, and tokens of nine in ten functions, by shelf. Lower them when
the code has become smaller."""

FILE = 3400
"""Most tokens of a file."""


def files_of(shelf: str) -> list[Path]:
    """The Python files of a shelf."""
    if shelf == "tools":
        return sorted((PACKAGE.parent / "tools").rglob("*.py"))
    inside = shelf == "laboratory"
    return [
        p
        for p in sorted(PACKAGE.rglob("*.py"))
        if (PACKAGE / "lab" in p.parents) == inside
    ]


@pytest.mark.parametrize("shelf", LIMITS)
def test_a_shelf_stays_small(shelf: str) -> None:
    size = size_of(files_of(shelf))
    tokens, a_line, a_function = LIMITS[shelf]
    assert size.tokens <= tokens
    assert size.tokens / size.lines <= a_line
    assert size.functions[int(0.9 * len(size.functions))] <= a_function


def test_no_file_is_too_long_to_read() -> None:
    folders = [
        PACKAGE.parent / n for n in ("lidar_synth", "integrations", "tools", "tests")
    ]
    files = [p for folder in folders for p in folder.rglob("*.py")]
    assert {p.name for p in files if size_of([p]).tokens > FILE} == set()


def test_packing_lines_does_not_make_code_smaller(tmp_path: Path) -> None:
    path = tmp_path / "code.py"
    path.write_text(
        '"""Words."""\n\n\ndef f(a, b):\n    """Words."""\n    c = a\n    return c + b\n'
    )
    spread = size_of([path])
    path.write_text("def f(a, b): c = a; return c + b  # words\n")
    packed = size_of([path])
    assert (spread.lines, spread.tokens, spread.functions) == (3, 11, [11])
    assert packed.lines == 1 and packed.tokens == 12  # the semicolon


def test_open3d_is_imported_by_nothing_at_import_time() -> None:
    """On a bare machine its import fails; everything else has to work."""
    for path in PACKAGE.rglob("*.py"):
        top = [
            n
            for n in ast.parse(path.read_text()).body
            if isinstance(n, ast.Import | ast.ImportFrom)
        ]
        names = [a.name for n in top for a in n.names] + [
            n.module or "" for n in top if isinstance(n, ast.ImportFrom)
        ]
        assert not any(n.split(".")[0] == "open3d" for n in names), path


def test_what_the_package_offers_can_be_imported() -> None:
    for name in lidar_synth.__all__:
        assert getattr(lidar_synth, name) is not None


def test_a_mixture_loads_few_modules_and_no_network() -> None:
    code = "import sys; from lidar_synth import MixedScans; print(*sys.modules)"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = {name for name in out.stdout.split() if name.startswith("lidar_synth")}
    assert len(loaded) <= 50
    assert not [
        n for n in loaded if n.startswith(("lidar_synth.lab.", "lidar_synth.generate"))
    ]


def test_banks_and_files_are_read_without_torch() -> None:
    code = "import sys, lidar_synth.bank, lidar_synth.formats; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


WITHOUT_TORCH = """
town town --scans 1 --no-camera --layout semantic_kitti
convert town npz --to npz
verify bank
bank merge merged bank
bank head bank head --count 1
curate bank
"""
"""Commands that run no network; torch takes longer to import than they take."""


def test_commands_without_a_network_import_no_torch(tmp_path: Path) -> None:
    write_bank(tmp_path / "bank", [some_image(seed) for seed in (0, 1)])
    scores = curate.score(Bank(tmp_path / "bank"))
    curate.write_scores(tmp_path / "bank" / curate.FILE, scores)
    code = f"""if True:
        import shlex, sys
        from lidar_synth.cli import app
        for line in {WITHOUT_TORCH.strip().splitlines()}:
            app(shlex.split(line), standalone_mode=False)
            assert "torch" not in sys.modules, line
    """
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


def repeated_classes(folder: Path) -> set[str]:
    """The names of classes that stand more than once in a folder's files."""
    trees = [ast.parse(path.read_text()) for path in folder.rglob("*.py")]
    names = Counter(
        n.name for tree in trees for n in ast.walk(tree) if isinstance(n, ast.ClassDef)
    )
    return {name for name, count in names.items() if count > 1}


def test_no_class_name_stands_twice() -> None:
    assert repeated_classes(PACKAGE) == set()
    # Open3D-ML and Pointcept are configured by the name of the dataset that it extends.
    assert repeated_classes(INTEGRATIONS) == {"MixedSemanticKITTI"}
