"""Tables of docs/results/generators.md: of the whole suite, from records of a run, also of an incomplete one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import adversarial_page, avoidable


def record(generator: str, base: str, hit: float, **more: Any) -> dict[str, Any]:
    metrics = {"applies": True, "survived": True, "CR": hit, "off_road": 0.25, "realism": None}
    told = {"generator": generator, "system": "autopilot", "cluster": base, "status": "ok", "reason": ""}
    return told | {"metrics": metrics} | more


def test_the_whole_suite_has_a_section_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, page = tmp_path / "run", tmp_path / "generators.md"
    run.mkdir()
    suite = {"scenarios": ["precrash"], "budget": 8, "keep": 3, "systems": ["autopilot", "ppo"]}
    (run / "run.json").write_text(json.dumps({"suite": suite, "cells": [{}] * 12}))
    rows = [
        record(name, f"Case/{k}", float(name == "king" or k < 2), transfer={"ppo": {"found": 0.5, "base": 0.0}})
        for name in ("random", "king")
        for k in range(5)
    ]
    rows[0]["metrics"]["survived"] = False
    rows.append(record("king", "natural/Here_1/02", 1.0) | {"status": "failed", "reason": "no"})
    (run / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    monkeypatch.setattr(adversarial_page, "RESULTS", tmp_path / "kept")
    monkeypatch.setattr(adversarial_page, "DOCUMENT", page)
    monkeypatch.setattr(adversarial_page, "LEARNED", page)
    monkeypatch.setattr("sys.argv", ["adversarial_page", f"whole+={run}"])  # to nothing, at first
    page.write_text(f"# Title\n\n{adversarial_page.BEFORE}\nothers\n")
    adversarial_page.main()
    text = page.read_text()
    assert "11 of 12 searches have run" in text
    assert "1 searches failed" in text
    king = next(line for line in text.splitlines() if line.startswith("| `king` | 5 | 1.00 ["))
    assert "| +0.75 [" in king, "over the four bases that random search was measured on, too"
    assert "| `random` | 4 | +0.50" in text
    assert text.endswith(f"{adversarial_page.BEFORE}\nothers\n")
    monkeypatch.setattr("sys.argv", ["adversarial_page"])
    adversarial_page.main()
    assert page.read_text() == text
    # what ran again or later is added
    later = [record("random", "Case/0", 0.0), record("grid", "Case/0", 0.0) | {"system": "ppo"}]
    (run / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in later))
    monkeypatch.setattr("sys.argv", ["adversarial_page", f"whole+={run}"])
    adversarial_page.main()
    text = page.read_text()
    assert "| `random` | 5 | 0.20 [" in text, "1 of 5 bases now, since the first is survived"
    assert "`ppo`, pre-crash scenarios" in text
    assert "searches have run" not in text
    (run / "run.json").write_text(json.dumps({"suite": suite | {"budget": 16}, "cells": [{}]}))
    with pytest.raises(ValueError, match="other settings"):
        adversarial_page.main()


def test_the_page_is_what_its_command_makes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    page = tmp_path / "generators.md"
    pages = {"DOCUMENT": page, "LEARNED": tmp_path / "learned.md"}
    before = {name: getattr(adversarial_page, name).read_text(encoding="utf-8") for name in pages}
    for name, path in pages.items():
        path.write_text(before[name].replace("| `frea` |", "| `other` |"), encoding="utf-8")
        monkeypatch.setattr(adversarial_page, name, path)
    monkeypatch.setattr("sys.argv", ["adversarial_page"])
    adversarial_page.main()
    assert {name: path.read_text(encoding="utf-8") for name, path in pages.items()} == before


def test_the_table_of_trainings_is_what_its_command_makes() -> None:
    shown = avoidable.DOCUMENT.read_text(encoding="utf-8").partition(avoidable.BEGIN)[2].partition(avoidable.END)[0]
    assert shown.strip() == "\n".join(avoidable.table(json.loads(avoidable.RESULTS.read_text()))).strip()


def test_every_draw_of_a_route_counts_in_the_table_of_trainings() -> None:
    hits = {f"natural/Here_{k // 2}/{k % 2:02d}": float(k < 6) for k in range(12)}
    assert avoidable.share(hits).startswith("0.50 ["), "and not the first of each route alone"
    odd = {f"natural/Here_{k // 2}/{k % 2:02d}": float(k % 2) for k in range(12)}
    assert avoidable.share(odd).startswith("0.50 "), "0.00 if later draws were taken for copies"
