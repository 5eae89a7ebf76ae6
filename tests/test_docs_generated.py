"""What is generated when the site is built: equations, the API, the command line, recipes and their
keys."""

import re
import runpy
from typing import Any

import pytest
from project import ROOT

import lidar_synth
from lidar_synth.cli import COMMANDS
from lidar_synth.lab.train.config import published, published_models

markdown = pytest.importorskip("markdown")
pytest.importorskip("latex2mathml")
pytest.importorskip("griffe")

TABLES: dict[str, Any] = runpy.run_path(str(ROOT / "tools/docs/tables.py"))
EQUATIONS: dict[str, Any] = runpy.run_path(str(ROOT / "tools/docs/equations.py"))


def rendered(text: str) -> str:
    """The HTML of a page with the site's extensions for equations and code."""
    extensions = ["pymdownx.arithmatex", "pymdownx.superfences"]
    options = {"pymdownx.arithmatex": {"generic": True}}
    html = markdown.markdown(text, extensions=extensions, extension_configs=options)
    content: str = EQUATIONS["on_page_content"](html)
    return content


def test_equations_become_mathml() -> None:
    html = rendered("At $t < 1$ the state is\n\n$$y_t = (1 - t)\\, y_0 + t\\, y_1$$\n")
    assert html.count("<math") == 2 and html.count('display="block"') == 1
    assert "arithmatex" not in html and "<msub>" in html and "&#x0003C;" in html


def test_dollars_in_code_stay() -> None:
    html = rendered("`$KITTI360_ROOT` and `$HOME`\n\n```sh\ncp $A $B\n```\n")
    assert (
        "<math" not in html
        and "$KITTI360_ROOT" in html
        and "$A $B" in re.sub("<.*?>", "", html)
    )


def test_the_api_has_every_public_name() -> None:
    listed = {
        line.rpartition(".")[2]
        for name, text in TABLES["GENERATED"].items()
        for line in text().splitlines()
        if name.startswith("api-") and line.startswith("::: ")
    }
    assert set(lidar_synth.__all__) - {"__version__"} <= listed


def test_the_command_line_has_every_command_and_no_control_characters() -> None:
    text = TABLES["command_line"]()
    groups = (
        "bank merge",
        "bank split",
        "bank head",
        "bank as-sensor",
        "edit remove",
        "edit insert",
        "edit move",
        "sensor fit",
        "skin fit",
        "skin show",
        "metrics setup",
    )
    assert re.findall(r"^## (.*)$", text, re.M) == [*COMMANDS, *groups]
    assert text.isprintable() or set(filter(lambda c: not c.isprintable(), text)) == {
        "\n"
    }


def test_every_recipe_is_listed_with_its_time() -> None:
    text = TABLES["recipes"]()
    assert all(
        f"{one.name}` |" in text and one.time in text
        for one in (*published_models(), *published())
    )


@pytest.mark.parametrize("section", TABLES["SECTIONS"], ids=lambda name: name or "top")
def test_every_key_of_a_recipe_is_explained(section: str) -> None:
    for model in TABLES["SECTIONS"][section]:
        own = {
            name
            for name in vars(model).get("__annotations__", {})
            if not name.startswith("_")
        }
        explained = {
            name
            for row in TABLES["_keys"](model)
            for name in row.split("`")[1].split(", ")
        }
        assert explained == own, model


def test_generated_text_takes_the_place_of_its_mark() -> None:
    page = TABLES["on_page_markdown"](
        "# Recipes\n\n<!-- generated: recipes -->\n\nAfter.\n"
    )
    assert "town_tiny" in page and "<!--" not in page and page.endswith("After.\n")
