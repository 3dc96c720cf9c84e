"""Textures as files: what is written is read again, a changed one is refused, and a suite shows them untrained."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError, FormatError, UnknownNameError
from ssad.core.images import read_image, save_picture
from ssad.core.types import U8
from ssad.experiments.perception.physical.kind import Physical, PhysicalSuite
from ssad.rendering.target import parse_target
from ssad.scenarios.static.physical import TextureSpec, make_carrier
from ssad.scenarios.static.physical.textures.card import (
    SHIPPED,
    TextureCard,
    load_texture,
    save_texture,
    shipped_textures,
)
from ssad.scenarios.static.physical.textures.folder import TextureFolder
from ssad.scenarios.static.physical.textures.inks import project_onto_gamut, share_outside
from ssad.scenarios.static.physical.textures.perturbation import Texture

CARD = TextureCard(
    "vanishing", "camouflage", {"texels": 32}, "yolov5n", "abc", "sedan:silver:0", "d", "c", 3, {"AP50": 0.1}
)


def picture(side: int = 32) -> U8:
    return np.random.default_rng(0).integers(0, 256, (side, side, 3), np.uint8)


def test_a_texture_is_read_as_it_was_written(tmp_path: Path) -> None:
    save_texture(tmp_path / "mine", picture(), CARD)
    colour, card = load_texture(str(tmp_path / "mine.json"))
    assert np.array_equal(np.rint(colour.permute(1, 2, 0).numpy() * 255), picture())
    assert (card.attack, card.options, card.metrics) == (CARD.attack, CARD.options, CARD.metrics)
    assert len(card.hash) == 64


def test_a_texture_of_inks_is_written_only_if_they_give_all_of_its_colours(tmp_path: Path) -> None:
    printed = replace(CARD, inks="FOGRA39")
    with pytest.raises(ConfigError, match=r"\d\d\.\d% of the texels are no colours of FOGRA39"):
        save_texture(tmp_path / "mine", picture(), printed)
    assert not list(tmp_path.iterdir())
    colour = project_onto_gamut(torch.from_numpy(picture()).permute(2, 0, 1).float() / 255)
    save_texture(tmp_path / "mine", np.rint(colour.permute(1, 2, 0).numpy() * 255).astype(np.uint8), printed)
    shown, card = load_texture(str(tmp_path / "mine.json"))
    assert card.inks == "FOGRA39"
    assert share_outside(shown) == 0.0


def test_what_ships_as_printable_can_be_printed() -> None:
    """Of every shipped card that names inks, and of a colour that none of them gives."""
    shares = {
        name: share_outside(colour) for name in shipped_textures() for colour, card in [load_texture(name)] if card.inks
    }
    assert shares == dict.fromkeys(shares, 0.0)
    assert share_outside(torch.tensor([0.0, 0.0, 1.0])[:, None, None]) == 1.0


def test_a_texture_of_your_own_is_projected_on_request(tmp_path: Path) -> None:
    save_texture(tmp_path / "mine", picture(), CARD)
    own, projected = (Texture(str(tmp_path / "mine.json"), project=project) for project in (False, True))
    assert share_outside(own.printed_texture().colour) > 0.3
    assert share_outside(projected.printed_texture().colour) == 0.0
    assert own.version() != projected.version()


def test_a_changed_or_broken_texture_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "mine"
    save_texture(path, picture(), CARD)
    other = picture()
    other[0, 0, 0] ^= 1
    save_picture(path.with_suffix(".png"), other)
    with pytest.raises(FormatError, match="not the texture that its card describes"):
        load_texture(str(path.with_suffix(".json")))
    about = json.loads(path.with_suffix(".json").read_text())
    for wrong in ({"attack": "x"}, about | {"colour": 1}, [1]):
        path.with_suffix(".json").write_text(json.dumps(wrong))
        with pytest.raises(FormatError, match="not the card of a texture"):
            load_texture(str(path.with_suffix(".json")))
    with pytest.raises(UnknownNameError, match="no-such"):
        load_texture("no-such")


def test_what_is_shipped_is_whole() -> None:
    assert len(shipped_textures()) == len(list(SHIPPED.glob("*.png")))
    for name in shipped_textures():
        colour, card = load_texture(name)
        assert 0.0 <= float(colour.min()) <= float(colour.max()) <= 1.0
        assert card.command.startswith("ssad run"), name
        assert card.metrics["AP50"] < 0.9, name
        assert make_carrier(card.carrier, card.options).on(parse_target(card.target).mesh()).size == tuple(
            colour.shape[1:]
        ), name


def suite(entry: dict[str, object]) -> PhysicalSuite:
    attacks = [entry, {"name": "shuffled", "of": "vanishing"}]
    return PhysicalSuite.model_validate({"kind": "physical", "name": "t", "detectors": ["yolov5n"], "attacks": attacks})


def test_a_suite_shows_a_texture_in_place_of_training(tmp_path: Path) -> None:
    save_texture(tmp_path / "mine", picture(), CARD)
    file = str(tmp_path / "mine.json")
    plan = Physical().plan(suite({"name": "vanishing", "texture": file}))
    cells = [cell for cell in plan.cells if cell.fields["attack"] != "clean"]
    assert {cell.fields["source"] for cell in cells} == {"yolov5n"}
    spec = TextureSpec.of_row(cells[0].spec)
    assert spec.trained == ""
    surface_size = (32, 32)
    surface = type("S", (), {"size": surface_size, "mask": np.ones(surface_size, bool)})()
    folder = TextureFolder(tmp_path / "textures")
    given = {"views": lambda: pytest.fail("trained"), "detector": lambda: pytest.fail("trained")}
    colour = folder.texture(spec, surface, **given)  # type: ignore[arg-type]
    assert torch.equal(colour, load_texture(file)[0])
    assert np.array_equal(read_image(folder.image_path(spec)), picture())
    shuffled = folder.texture(TextureSpec.of_row(cells[1].spec), surface, **given)  # type: ignore[arg-type]
    assert not torch.equal(shuffled, colour)
    assert torch.equal(shuffled.flatten(1).sort(1).values, colour.flatten(1).sort(1).values)


@pytest.mark.parametrize(
    ("change", "side", "message"),
    [
        ({"options": {"texels": 64}}, 32, "its card says"),
        ({"name": "das"}, 32, "of vanishing on sedan:silver:0, not of das"),
        ({}, 16, r"\[16, 16\] texels, its surface has \[32, 32\]"),
    ],
)
def test_a_texture_that_does_not_fit_is_refused(
    tmp_path: Path, change: dict[str, object], side: int, message: str
) -> None:
    save_texture(tmp_path / "mine", picture(side), CARD)
    entry = {"name": "vanishing", "texture": str(tmp_path / "mine.json")} | change
    with pytest.raises(ConfigError, match=message):
        Physical().plan(
            PhysicalSuite.model_validate(
                {"kind": "physical", "name": "t", "detectors": ["yolov5n"], "attacks": [entry]}
            )
        )
