"""Pictures of attacks: they are made where the attacks are."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ssad.experiments.perception.physical import target_sheets
from ssad.experiments.suites import load_suite


def test_pictures_are_shown_on_the_device_of_the_attacks(tmp_path: Path, monkeypatch: Any) -> None:
    suite: Any = load_suite("physical-road")
    (tmp_path / "data" / "Oldmarket" / "annotations").mkdir(parents=True)
    monkeypatch.setattr(target_sheets, "_textures_shown", lambda *_: {"road": SimpleNamespace(source="", of="")})
    asked = []

    def sheet(name: str, clips: Any, **_: Any) -> Any:
        asked.append(clips.device)
        return np.zeros((8, 8, 3), np.uint8)

    flat = SimpleNamespace(task="2d")
    attacks: Any = SimpleNamespace(folder=tmp_path, device="cuda:3", sheet=sheet, detector=lambda _: flat)
    target_sheets.write_sheets(attacks, suite, [])
    assert asked == ["cuda:3"], "clips on another device than the textures cannot be shown"
