"""The frame of ``tools/try_trainers.py``: commands are judged by their output, and a failure
becomes a row."""

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

TOOLS = Path(__file__).parent.parent / "tools"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(TOOLS))
    import try_trainers

    yield try_trainers
    for name in [
        n for n in sys.modules if n.split(".")[0] in ("trainers", "try_trainers")
    ]:
        del sys.modules[name]


@pytest.fixture
def trial(script: Any, tmp_path: Path) -> Any:
    return script.Trial("some", "Some trainer", tmp_path, data=None)


PAGE = """# Some

```sh
pip install x
cd TREE    # yours
export A=B
```

```python
# own.py
KIND = "B"
```

```yaml
not: typed
```

```python
from own import KIND
print("configured as", KIND)
```

```sh
echo $PWD $A \\
    TREES --set -p ""    # more
```
"""


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


@pytest.mark.parametrize(
    ("code", "options", "message"),
    [
        ("print('loss 0.5')", {"expect": [r"loss \d"]}, None),
        ("print('loss nan')", {"expect": [r"loss \d"]}, "lacks .*loss"),
        ("import sys; sys.exit('no GPU')", {}, "exit status 1; no GPU"),
        ("import sys; sys.exit('no GPU')", {"fails": True, "expect": ["no GPU"]}, None),
        ("pass", {"fails": True}, "exit status 0"),
        ("import time; time.sleep(60)", {"minutes": 0.005}, "not finished"),
    ],
)
def test_a_command_is_judged_by_its_status_and_output(
    script: Any, trial: Any, code: str, options: dict[str, Any], message: str | None
) -> None:
    if message is None:
        trial.run("train", python(code), **options)
    else:
        with pytest.raises(script.Failed, match=message):
            trial.run("train", python(code), **options)
    [log] = (trial.folder / "logs").iterdir()
    assert log.name == "01-train.log" and log.read_text().startswith(
        f"$ {sys.executable} -c"
    )


def test_a_command_runs_as_a_user_does(
    trial: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/own")
    output = trial.run(
        "show", python("import os; print(os.getcwd(), os.environ)"), env={"GIVEN": "1"}
    )
    assert (
        str(trial.folder) in output
        and "'GIVEN': '1'" in output
        and "PYTHONPATH" not in output
    )


def test_a_trial_types_the_commands_of_the_page(
    script: Any, trial: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As they stand in the Markdown, in one shell; a name that the page no longer has fails the
    trial."""
    page = tmp_path / "docs" / "how-to" / "trainers" / "some.md"
    page.parent.mkdir(parents=True)
    page.write_text(PAGE)
    monkeypatch.setattr(sys.modules["trainers.trial"], "ROOT", tmp_path)
    said = trial.type_page(
        "type",
        Path(sys.executable),
        "some",
        {"TREE": trial.folder, "B": "C"},
        skip="^pip",
    )
    lines = [line for line in said.splitlines() if not line.startswith(("+", "$"))]
    assert lines[-2:] == ["configured as C", f"{trial.folder} C TREES --set -p "]
    with pytest.raises(script.Failed, match="some.md has no 'OUT'"):
        trial.type_page("type", Path(sys.executable), "some", {"OUT": "x"}, skip="^pip")


@pytest.mark.parametrize(
    "page",
    ["range-view", "cylinder3d", "waffleiron", "openpcdet", "pointcept", "open3d-ml"],
)
def test_pages_name_what_to_install_and_how_to_train(script: Any, page: str) -> None:
    commands = sys.modules["trainers.trial"].commands_of(page)
    assert commands[0].startswith("pip install ") and any(
        "train" in each for each in commands
    )


def test_the_source_tree_is_a_copy(
    script: Any, trial: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(script.Failed, match="SOME_ROOT= names no folder"):
        trial.tree("SOME_ROOT")
    (tmp_path / "clone" / ".git").mkdir(parents=True)
    (tmp_path / "clone" / "train.py").write_text("")
    monkeypatch.setenv("SOME_ROOT", str(tmp_path / "clone"))
    (trial.tree("SOME_ROOT") / "train.py").write_text("changed")
    assert (tmp_path / "clone" / "train.py").read_text() == "" and not (
        trial.folder / "tree" / ".git"
    ).exists()


def test_a_failure_is_a_row_and_keeps_the_rows_before(
    script: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    def rows(trial: Any) -> Iterator[Any]:
        yield trial.row("python train.py", ["training"], "a | b")
        raise script.Failed("no\nvalidation")

    monkeypatch.setitem(
        sys.modules, "trainers.some", SimpleNamespace(TITLE="Some trainer", rows=rows)
    )
    done = script.attempt("some", tmp_path, None, False)
    assert [row.failed for row in done] == [False, True]
    assert (
        script.line(done[0])
        == "| Some trainer | `python train.py` | yes | no | no | no | a \\| b | 0.0 |"
    )
    assert "| **failed**: no validation |" in script.line(done[1])


def test_every_trial_has_a_title_and_rows_and_types_its_page(script: Any) -> None:
    for name in script.names():
        module = script.importlib.import_module(f"trainers.{name}")
        assert module.TITLE and callable(module.rows)
        assert "trial.type_page(" in inspect.getsource(module)
