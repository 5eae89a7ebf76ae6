"""Documents stay short: every page has a limit of words, counted as ``wc -w`` does, and so has
their sum."""

import re
from pathlib import Path

import pytest
from project import ROOT

LIMITS = {
    "README.md": 800,
    "CHANGELOG.md": 1_100,
    "docs/index.md": 210,
    "docs/start/install.md": 150,
    "docs/start/tutorial.md": 460,
    "docs/faq.md": 130,
    "docs/how-to/choose.md": 168,
    "docs/explanation/comparison.md": 130,
    "docs/how-to/mix.md": 685,
    "docs/how-to/trainers/index.md": 325,
    "docs/how-to/trainers/mmdetection3d.md": 230,
    "docs/how-to/trainers/openpcdet.md": 160,
    "docs/how-to/trainers/pointcept.md": 125,
    "docs/how-to/trainers/range-view.md": 140,
    "docs/how-to/trainers/cylinder3d.md": 80,
    "docs/how-to/trainers/open3d-ml.md": 110,
    "docs/how-to/trainers/waffleiron.md": 70,
    "docs/how-to/trainers/lightning.md": 120,
    "docs/how-to/trainers/reader.md": 150,
    "docs/how-to/trainers/other.md": 80,
    "docs/how-to/your-sensor.md": 400,
    "docs/how-to/your-dataset.md": 330,
    "docs/how-to/pandaset.md": 190,
    "docs/how-to/label-kitti360.md": 135,
    "docs/how-to/another-sensor.md": 180,
    "docs/how-to/skin.md": 170,
    "docs/how-to/measure.md": 340,
    "docs/how-to/adapt.md": 160,
    "docs/how-to/train-a-generator.md": 380,
    "docs/how-to/edit.md": 160,
    "docs/how-to/layouts.md": 150,
    "docs/how-to/bake.md": 363,
    "docs/how-to/look.md": 130,
    "docs/how-to/prove.md": 225,
    "docs/how-to/weather.md": 333,
    "docs/reference/api.md": 40,
    "docs/reference/api/load.md": 15,
    "docs/reference/api/mix.md": 15,
    "docs/reference/api/generate.md": 15,
    "docs/reference/api/look.md": 15,
    "docs/reference/api/lab.md": 15,
    "docs/reference/command-line.md": 30,
    "docs/reference/recipes.md": 80,
    "docs/reference/descriptions.md": 230,
    "docs/reliability.md": 330,
    "docs/explanation/method.md": 320,
    "docs/explanation/determinism.md": 200,
    "docs/town.md": 290,
    "docs/models/town.md": 200,
    "docs/models/town-semantic.md": 190,
    "docs/models/town-camera.md": 190,
    "docs/models/town-layout.md": 160,
    "docs/models/skin-pandar64.md": 140,
    "docs/gallery.md": 110,
}
"""The main path: what a user reads. Notes in docs/research/ and notebooks are not counted."""

MAIN_PATH = 9_050
"""Words of all pages of docs/ on the main path."""

PAGES = [
    p
    for p in sorted((ROOT / "docs").rglob("*.md"))
    if not {"research", "notebooks"} & set(p.parts)
]


def words(page: Path) -> int:
    """As ``wc -w`` counts them, without comments, which no reader sees."""
    return len(
        re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.S).split()
    )


@pytest.mark.parametrize("name", LIMITS)
def test_a_page_keeps_to_its_limit(name: str) -> None:
    assert words(ROOT / name) <= LIMITS[name]


def test_every_page_has_a_limit() -> None:
    assert {page.relative_to(ROOT).as_posix() for page in PAGES} == set(LIMITS) - {
        "README.md",
        "CHANGELOG.md",
    }


def test_the_main_path_is_short() -> None:
    assert sum(map(words, PAGES)) <= MAIN_PATH


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_begins_with_what_the_reader_can_do(page: Path) -> None:
    lines = [
        line
        for line in page.read_text(encoding="utf-8").splitlines()
        if line and not line.startswith("<!--")
    ]
    title, first, *_ = [*lines, ""]
    assert title.startswith("# ") and re.match(r"[\w`*\[]", first), (
        "a title, and then a sentence"
    )
