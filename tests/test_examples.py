"""Every public name has an example of three to eight lines in its docstring; it runs and prints
what it shows."""

import ast
import doctest
import re
from functools import cache
from pathlib import Path
from pkgutil import resolve_name

import pytest
from layouts import write_kitti_raw, write_nuscenes
from pandaset_files import write_pandaset
from project import ROOT

import lidar_synth
from lidar_synth.bake import BakeJob, bake, make_plan
from lidar_synth.lab.town import Town, export_town
from lidar_synth.weather import CORRUPTIONS

FURTHER = {
    "lidar_synth.datasets.classes": ("Taxonomy",),
    "lidar_synth.lab.evaluate": ("Metric",),
    "lidar_synth.lab.evaluate.segmentation": ("load_judge",),
    "lidar_synth.formats.camera_boxes": ("CameraBoxes.with_boxes",),
    "lidar_synth.generate.flow.solvers": ("solve",),
    "lidar_synth.geometry.normalize": ("Normalisation",),
    "lidar_synth.geometry.projection": ("locate",),
    "lidar_synth.geometry.projection.batch": ("project_batch",),
    "lidar_synth.geometry.transfer": ("Mount", "SeenAs", "Transfer"),
    "lidar_synth.generate.generator": ("Generated",),
    "lidar_synth.generate.inpaint": ("inpaint",),
    "lidar_synth.integrations.accelerate": ("prepare",),
    "lidar_synth.labels.edit": ("insert", "measure", "move", "remove"),
    "lidar_synth.mixing": (
        "ByDomain",
        "MixedScans.batches",
        "MixedScans.domain",
        "MixedScans.loss_weight",
        "MixedScans.wrap",
        "SyntheticFirst",
        "settle",
    ),
    "lidar_synth.noise": ("gaussian",),
    "lidar_synth.lab.train": (
        "TrainConfig",
        "load_config",
        "plan_model",
        "run",
        "train_model",
    ),
    "lidar_synth.viz": ("write_view",),
    "lidar_synth.weather": tuple(kind.__name__ for kind in CORRUPTIONS.values()),
}
"""What the documents name besides ``lidar_synth.__all__``. Python keeps no docstring of a
dictionary such as ``NORMALISATIONS``: the example of its values' class shows it."""

PACKAGE = Path(lidar_synth.__file__).parent
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def public_names() -> list[str]:
    """Where to find each public name; the example of ``__version__`` is the package's."""
    package = [
        f"lidar_synth.{name}" for name in lidar_synth.__all__ if name != "__version__"
    ]
    further = [
        f"{module}.{name}" for module, names in FURTHER.items() for name in names
    ]
    return ["lidar_synth", "lidar_synth.labels.augment", *package, *further]


def named_in(text: str) -> set[str]:
    """The classes and functions of the package that a document names in its Python: by a capital or
    by a call."""
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.S))
    words = set(re.findall(r"(?<!\w)(?:[A-Z]\w+|\w+(?=\())", " ".join(blocks + spans)))
    return words & definitions()


@cache
def definitions() -> set[str]:
    """The names of all classes and functions of the package."""
    trees = [ast.parse(path.read_text()) for path in PACKAGE.rglob("*.py")]
    return {
        node.name
        for t in trees
        for node in t.body
        if isinstance(node, ast.ClassDef | ast.FunctionDef)
    }


def example_of(name: str) -> doctest.DocTest:
    """The example in the docstring of a public name, with nothing imported beforehand."""
    found = doctest.DocTestFinder(recurse=False).find(
        resolve_name(name), name, globs={}
    )
    examples = found[0].examples if found else []
    assert any(example.want for example in examples), (
        f"{name} has no example in its docstring"
    )
    lines = sum(len(example.source.splitlines()) for example in examples)
    assert 3 <= lines <= 8, f"the example of {name} has {lines} lines"
    return found[0]


def report_of(example: doctest.DocTest) -> str:
    """What doctest has to say against an example; nothing where it is right."""
    report: list[str] = []
    doctest.DocTestRunner(optionflags=FLAGS).run(example, out=report.append)
    return "".join(report)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, one_thread: None) -> Path:
    """What the examples open: the town and the bank as ``make demo`` leaves them, and a dataset in
    each layout."""
    pytest.importorskip("embreex")
    root = tmp_path_factory.mktemp("examples")
    for layout, out in {
        "semantic_kitti": "demo_out/town",
        "kitti360": "KITTI-360",
        "kitti": "KITTI",
    }.items():
        export_town(
            Town(0, "hdl64e_lasers", 3),
            root / out,
            layout,
            camera=False,
            progress=False,
        )
    write_kitti_raw(root / "KITTI-raw")
    write_nuscenes(root / "nuScenes")
    write_pandaset(root / "PandaSet")
    bake(
        make_plan(root / "demo_out" / "bank", BakeJob(count=4, seed=1)), progress=False
    )
    return root


@pytest.mark.slow
@pytest.mark.parametrize("name", public_names())
def test_the_example_runs(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert report_of(example_of(name)) == ""


def test_every_new_name_of_the_package_needs_an_example(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(lidar_synth, "__all__", [*lidar_synth.__all__, "Noise"])
    assert "lidar_synth.Noise" in public_names()


@pytest.mark.slow
def test_every_name_of_the_documents_has_an_example() -> None:
    pages = [
        ROOT / "README.md",
        *ROOT.glob("docs/start/*.md"),
        *ROOT.glob("docs/how-to/**/*.md"),
    ]
    named = set().union(*(named_in(page.read_text()) for page in pages))
    assert {"MixedScans", "load_layout", "Taxonomy"} <= named
    assert named <= {name.rsplit(".", 1)[1] for name in public_names()[2:]}


@pytest.mark.parametrize(
    ("doc", "missing"),
    [
        (None, "no example"),
        ("A town.", "no example"),
        (">>> Town(0)", "no example"),
        (">>> 1 + 1\n2", "1 lines"),
        (">>> a = 1\n" * 8 + ">>> a\n1", "9 lines"),
    ],
)
def test_a_name_without_an_example_is_noticed(
    doc: str | None, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Town, "__doc__", doc)
    with pytest.raises(AssertionError, match=missing):
        example_of("lidar_synth.Town")


def test_an_example_that_prints_something_else_is_noticed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Town, "__doc__", ">>> a = 1\n>>> b = 1\n>>> a + b\n3")
    assert "Expected:\n    3\nGot:\n    2" in report_of(example_of("lidar_synth.Town"))
