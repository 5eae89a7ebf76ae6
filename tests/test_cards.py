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
from lidar_synth.generate.loading import shipped_models

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
