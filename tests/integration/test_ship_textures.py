"""`benchmarks.ship_textures`: what beats its controls and can be printed ships, with a card that says so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.run_folder import write_lines

import benchmarks.ship_textures as module
from ssad.core.images import save_picture
from ssad.scenarios.static.physical.textures.card import load_texture
from ssad.scenarios.static.physical.textures.inks import CHARACTERISATION, project_onto_gamut, share_outside

PAIR = {"train": "Twinford", "test": "Oldmarket", "train_images": 3, "test_images": 4}


def line(attack: str, precision: float, **changes: Any) -> dict[str, Any]:
    """Record of a camouflage, or of a control."""
    spec = {"of": None, "pair": PAIR, "around": 0, "inks": True, "approach": True, "carrier": "camouflage"}
    record = {
        "attack": attack,
        "carrier": "camouflage",
        "source": "yolov5n",
        "test": "Oldmarket",
        "train": "Twinford",
        "view": "drive",
        "detector": "yolov5n",
        "number": 0,
        "status": "ok",
        "key": attack,
        "n": 4,
        "drives": 1,
        "epochs": 2,
        "outside_gamut": 0.0,
        "artefacts": {"texture": "texture.png"},
        "metrics": dict.fromkeys(module.METRICS, precision),
        "spec": spec | {"attack": attack, "options": {"texels": 16}},
    }
    return record | changes


def test_what_inks_cannot_print_or_hides_no_more_than_a_control_does_not_ship(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, shipped = tmp_path / "run", tmp_path / "shipped"
    monkeypatch.setattr(module, "SHIPPED", shipped)
    colour = project_onto_gamut(torch.rand((3, 16, 16), generator=torch.Generator().manual_seed(0)))
    run.mkdir()
    save_picture(run / "texture.png", np.rint(colour.permute(1, 2, 0).numpy() * 255).astype(np.uint8))
    suite = {
        "name": "t",
        "kind": "physical",
        "title": "T",
        "seed": 0,
        "detectors": ["yolov5n"],
        "target": "sedan:silver:0",
        "behind": 20.0,
        "approach": {"distances": [5.0, 80.0]},
    }
    header = {"kind": "physical", "suite": suite, "cells": [], "weights": {"yolov5n": "abc"}}
    (run / "run.json").write_text(json.dumps(header))
    clean = line("clean", 1.0, carrier="", source="")
    del clean["epochs"]
    other_colours = line("das", 0.2, outside_gamut=0.37)
    any_colours = line("tpa", 0.2)
    any_colours["spec"] = any_colours["spec"] | {"inks": False}
    lines = [
        clean,
        line("grey", 0.9, source=""),
        line("vanishing", 0.1),
        other_colours,
        any_colours,
        line("adv-patch", 0.95),
    ]
    write_lines(run, lines)
    assert module.ship(run, set()) == ["vanishing-yolov5n-twinford"]
    assert sorted(path.name for path in shipped.iterdir()) == [
        "vanishing-yolov5n-twinford.json",
        "vanishing-yolov5n-twinford.png",
    ]
    texture, card = load_texture(str(shipped / "vanishing-yolov5n-twinford.json"))
    assert card.inks == CHARACTERISATION
    assert share_outside(texture) == 0.0
    assert "5 to 80 m behind" in card.data
    messages = capsys.readouterr().out
    assert "DAS in Oldmarket cannot be printed (37.0% of its texels outside the gamut of the inks)" in messages
    assert "TPA in Oldmarket cannot be printed" in messages
    assert "Adv. Patch in Oldmarket is not stronger than the controls: left out" in messages
