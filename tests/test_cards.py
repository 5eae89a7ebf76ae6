"""Model cards and gallery agree with the shipped weights and with the script that draws the
pictures."""

import re
from pathlib import Path

import numpy as np
import pytest
from hostile import MARKUP, tags_of
from PIL import Image
from project import ROOT

from lidar_synth import load_generator
from lidar_synth.files.hub import shipped_models

CARD = ROOT / "docs" / "models"
PICTURE = re.compile(r"\]\(gallery/(\w+)\.png\)")


@pytest.mark.parametrize("name", shipped_models())
def test_a_card_names_the_sizes_and_the_licence_of_its_weights(name: str) -> None:
    generator = load_generator(name)
    card = (CARD / f"{name}.md").read_text()
    flow, autoencoder = re.findall(
        r"parameters of flow, autoencoder \| ([\d.]+) M, ([\d.]+) M", card
    )[0]
    assert generator.autoencoder is not None
    sizes = [
        sum(p.numel() for p in part.parameters()) / 1e6
        for part in (generator.network, generator.autoencoder)
    ]
    assert sizes == pytest.approx([float(flow), float(autoencoder)], abs=0.05)
    assert (
        generator.header.provenance["licence"] == "MIT" and "**Licence.** MIT" in card
    )
    # A heading and ten numbers.
    assert len(re.findall(r"^[^|\n]+ \| [^|\n]+ \|.*$", card, re.M)) == 1 + 10


def quality() -> dict[tuple[str, str, str], str]:
    """{(model, steps, figure): value} of the quality page's table of the shipped models."""
    text = (ROOT / "docs/research/quality.md").read_text()
    [head] = [line for line in text.splitlines() if "| `town`, 4 steps |" in line]
    columns = []
    model = ""
    for cell in head.split("|")[2:-1]:
        named = re.match(r" `([\w-]+)`, (.*) ", cell)
        model, steps = named.groups() if named else (model, cell.strip())
        columns.append((model, steps))
    found = {}
    for line in text[text.index(head) :].splitlines()[2:]:
        if not line.startswith("|"):
            return found
        title, *cells = (cell.strip() for cell in line.split("|")[1:-1])
        for (model, steps), cell in zip(columns, cells, strict=True):
            found[model, steps, title] = cell.partition(" ")[0]
    raise AssertionError("the table has no end")


FRECHET = "Fréchet distance, segmenter"
SHARED = {
    "Fréchet distance of features": ("", "4 steps", FRECHET),
    "in 1 step": ("", "1 step", FRECHET),
    "that of `town`, other streets": ("town", "4 steps", FRECHET),
    "bird's-eye JSD": ("", "4 steps", "bird's-eye JSD"),
    "mIoU, town segmenter, %": ("", "4 steps", "mIoU with the segmenter, %"),
}
"""Rows of cards whose figure stands on the page of quality: (model, its own if empty; steps;
row)."""


@pytest.mark.parametrize("name", ["town-camera", "town-layout", "town-semantic"])
def test_a_card_and_the_page_of_quality_say_the_same(name: str) -> None:
    figures = quality()
    card = (CARD / f"{name}.md").read_text()
    rows = dict(re.findall(r"^([^|\n]+) \| ([\d.]+) \|", card, re.M))
    shared = rows.keys() & SHARED.keys()
    assert {"Fréchet distance of features"} < shared
    for row in shared:
        model, steps, title = SHARED[row]
        value = rows[row]
        decimals = len(value.partition(".")[2])
        page = float(figures[model or name, steps, title])
        assert float(value) == pytest.approx(page, abs=0.5001 * 10**-decimals), row


def test_the_method_has_the_timesteps_of_the_shipped_student() -> None:
    text = (ROOT / "docs/explanation/method.md").read_text()
    row = re.findall(r"`town`, selected here \| (.*)", text)[0]
    assert [float(t) for t in row.split(",")] == list(
        load_generator("town").header.time_grid[1:-1]
    )


def test_the_gallery_shows_exactly_the_pictures_of_its_script(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    import gallery

    shown = PICTURE.findall((ROOT / "docs/gallery.md").read_text())
    assert sorted(shown) == sorted(["channels", *gallery.PICTURES])
    for name in shown:
        path = ROOT / "docs" / "gallery" / f"{name}.png"
        assert Image.open(path).width == gallery.WIDTH
        assert path.stat().st_size < 400_000


def test_a_picture_has_all_its_images_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    import gallery

    red, blue = (
        np.full((40, 60, 3), colour, np.uint8) for colour in ((200, 0, 0), (0, 0, 200))
    )
    gallery.save(
        tmp_path / "sub" / "one.png",
        gallery.draw([[("red", red), ("blue", blue)], [("wide", red[:10])]]),
    )
    pixels = np.asarray(Image.open(tmp_path / "sub" / "one.png").convert("RGB")).astype(
        int
    )
    is_red, is_blue = (
        (np.abs(pixels - colour).sum(-1) < 30) for colour in ((200, 0, 0), (0, 0, 200))
    )
    half = gallery.WIDTH // 2
    assert is_red[:, :half].mean() > 2 * is_blue[:, :half].mean()
    assert is_blue[:, half:].mean() > 0.5


def test_tables_of_models_show_their_names_as_text(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "research"))
    from layout_quality import line
    from model_card import BEND, CLASSES, Measured, table

    classes = dict.fromkeys((*CLASSES, BEND), 1.0)
    text = (
        table([Measured(MARKUP, [], classes, np.full(20, 0.5))])
        + f"\n\n| a |{' b |' * 6}\n|---|{'---|' * 6}\n{line(MARKUP, None)}"
    )
    assert tags_of(text) == {"table", "thead", "tbody", "tr", "th", "td"}
