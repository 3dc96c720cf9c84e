"""Pictures that a run of drives shows."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ssad.experiments.driving import run_images as run_pictures
from ssad.experiments.driving.run_images import write_pictures


def test_pictures_are_made_once_and_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = []

    def sheets(street: Path, path: Path) -> None:
        made.append(street.name)
        path.write_text("")
        path.with_name("shifts-severities.jpg").write_text("")

    def recording(out: Path, towns: tuple[str, ...], *, scenes: int, seconds: float, width: int) -> Path:
        assert len(towns) == scenes == 1
        assert seconds >= 0.5, "shifts of motion need more than one frame"
        assert width % 16 == 0
        return out

    def record(street: Path, *, workers: int) -> Path:
        assert workers == 0, "in this process: a run has its own already"
        return street

    def save(path: Path, picture: str) -> None:
        made.append(picture)
        path.write_text("")

    def told() -> Any:
        return json.loads((tmp_path / "pictures" / "pictures.json").read_text())

    trace = tmp_path / "traces" / "ab12.npz"
    fakes: dict[str, Any] = {
        "Recording": recording,
        "record_nuscenes": record,
        "write_sheets": sheets,
        "pick_trace": lambda folder: trace,
        "write_gallery": lambda folder: {"camera-rig.jpg": f"In {folder.name}."},
        "onboard_sheet": lambda trace, graph: f"{trace.town} {graph}",
        "save_picture": save,
        "load_trace": lambda path: {trace: SimpleNamespace(town="Nowhere")}[path],
        "load_graph": lambda path: path.relative_to(tmp_path).as_posix(),
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(run_pictures, name, fake)
    write_pictures([], tmp_path)
    assert not list(tmp_path.iterdir()), "none are asked for"
    for _ in range(2):
        write_pictures(["shifts", "camera"], tmp_path)
    assert made == ["street", "Nowhere towns/Nowhere.npz"]
    captions = told()
    assert set(captions) == {"shifts.jpg", "shifts-severities.jpg", "camera-rig.jpg", "camera.jpg"}
    assert captions["camera-rig.jpg"] == "In pictures."
    assert "(ab12)" in captions["camera.jpg"]
    (tmp_path / "pictures" / "shifts-severities.jpg").unlink()
    write_pictures(["shifts"], tmp_path)
    assert made[2:] == ["street"], "what is gone is made again"
    assert set(told()) == {"shifts.jpg", "shifts-severities.jpg"}
    trace = None  # type: ignore[assignment]
    write_pictures(["camera"], tmp_path)
    assert set(told()) == {"camera-rig.jpg"}
