"""Exports of lights: what somebody has changed in them is refused in one line, and no code that they name runs."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from ssad.core.errors import SSADError
from ssad.scenarios.static.physical.lights import TargetSize, make_light
from ssad.scenarios.static.physical.lights.export import LightSetup, export_light, load_light

VALUES = {name: low for name, (low, _) in make_light("flashlight", {}).ranges(TargetSize(4.9, 2.06, 1.51)).items()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"values": {**VALUES, "red": "much"}}, "no exported light"),
        ({"values": {name: value for name, value in VALUES.items() if name != "red"}}, "values lack red"),
        ({"target": {"car": 1}}, "target is"),
        ({"target": "zeppelin"}, "zeppelin"),
        ({"hour": 3}, "hour is"),
        ({"attack": "turn_of_code:run", "options": {}}, "is code, which a file must not name"),
    ],
)
def test_a_changed_description_is_refused_and_runs_nothing(
    change: dict[str, Any], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "turn_of_code.py").write_text("def run(): pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    export_light(tmp_path, LightSetup("flashlight", {}, "night", "sedan:black:0", VALUES))
    assert load_light(tmp_path).values == VALUES
    description = json.loads((tmp_path / "light.json").read_text())
    (tmp_path / "light.json").write_text(json.dumps(description | change))
    with pytest.raises(SSADError, match=words) as refusal:
        load_light(tmp_path)
    assert "\n" not in str(refusal.value)
    assert "turn_of_code" not in sys.modules
