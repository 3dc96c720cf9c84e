"""Python's door to runs: what `ssad.run` returns, what a folder gives back, and the page and notebooks about it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import driving_lines, write_run

import ssad

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))


@pytest.fixture
def stored(tmp_path: Path) -> ssad.Results:
    header = {"suite": {"name": "s", "kind": "driving", "title": "Stored"}, "kind": "driving"}
    return ssad.load_results(write_run(tmp_path / "run", header, driving_lines()))


def test_results_have_the_lines_and_say_what_they_are(stored: ssad.Results) -> None:
    assert len(stored.rows) == len(driving_lines())
    assert [row["key"] for row in stored.rows] == [line["key"] for line in driving_lines()]
    assert f"{len(stored.rows)} of {stored.planned} cells of kind driving, 1 failed" in repr(stored)
    assert "Stored" in str(stored)
    assert "Stored" in stored._repr_html_()
    assert len(stored.failures) == 1
    assert stored.report.is_file()


def test_brackets_of_names_and_settings_stay_in_the_table_of_the_terminal(tmp_path: Path) -> None:
    header = {"suite": {"name": "s"}, "kind": "driving", "command": "ssad run s --set 'systems=[a,b]'"}
    lines = [line | {"system": "m:A?x=[b]"} if line["system"] == "a" else line for line in driving_lines()]
    told = str(ssad.load_results(write_run(tmp_path / "run", header, lines)))
    assert told.startswith("s with systems a, b")
    assert "m:A?x=[b]" in told


def test_a_title_too_long_for_its_settings_names_what_is_other(tmp_path: Path) -> None:
    sweeps = ",".join(f"{{name: pgd, radii: [{k}]}}" for k in range(30))
    command = f"ssad run s --set 'sweeps=[{sweeps}]' --set batch=24 --set 'hardened=[a]'"
    header = {"suite": {"name": "s", "title": "Attacks"}, "kind": "driving", "command": command}
    run = ssad.load_results(write_run(tmp_path / "run", header, driving_lines()))
    assert str(run).startswith("Attacks, with other sweeps, hardened")


def test_a_cell_is_found_by_the_start_of_its_key_and_one_without_a_trace_says_so(stored: ssad.Results) -> None:
    assert stored.find("a000")["key"] == "a000"
    with pytest.raises(ssad.SSADError, match="has no trace"):
        stored.trace("a000")
    with pytest.raises(ssad.SSADError, match="no cell 'zebra'"):
        stored.find("zebra")


def test_the_frame_has_a_line_a_cell_or_says_what_it_needs(
    stored: ssad.Results, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ssad.SSADError, match="needs pandas"):
        stored.frame()

    class Pandas:
        DataFrame = list  # what pandas would be given

    monkeypatch.setitem(sys.modules, "pandas", Pandas)
    table: Any = stored.frame()
    assert [line["collision"] for line in table if line["status"] == "ok"] == [
        row["metrics"]["collision"] for row in stored.rows if row["status"] == "ok"
    ]
    assert all("metrics" not in line for line in table)


def test_settings_may_be_a_mapping_and_keep_their_types() -> None:
    from ssad.results import make_plan

    settings = {"systems": ["blind"], "scenarios": "RightTurn", "spread": 1e-5, "witness": False, "reference": None}
    suite = make_plan("precrash", settings, device="cpu").suite
    assert (suite.systems, suite.scenarios, suite.spread) == (["blind"], ["RightTurn"], 1e-5)
    assert suite.witness is False
    assert suite.reference is None


def test_every_public_name_is_there() -> None:
    assert [name for name in ssad.__all__ if getattr(ssad, name, None) is None] == []
    page = (ROOT / "docs" / "reference" / "python.md").read_text()
    table = page[page.index("| Names |") : page.index("## Run a suite")]
    table = "\n".join(line for line in table.splitlines() if line.startswith("|"))
    assert set(re.findall(r"`(\w+)`", table)) == set(ssad.__all__) - {"__version__"}
    assert len(ssad.__all__) <= 22


def examples(*, perceive: bool) -> str:
    """The page's code, that of the section on perception or all other; what needs pandas left out."""
    page = (ROOT / "docs" / "reference" / "python.md").read_text()
    page = re.sub(r"<!-- pandas -->\n```.*?```", "", page, flags=re.DOTALL)
    parts = [part for part in page.split("\n## ") if part.startswith("Perceive") is perceive]
    return "import ssad\n" + "\n".join(re.findall(r"```python\n(.*?)```", "\n".join(parts), re.DOTALL))


@pytest.mark.parametrize("perceive", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_examples_of_the_page_run_and_no_library_greets(perceive: bool, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", examples(perceive=perceive)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    for library in ("Warp", "warp", "CUDA", "Module ssad"):
        assert library not in done.stdout
    if perceive:
        assert "clean ['car'" in done.stdout
    else:
        assert "unknown system 'autopilo'; closest: autopilot" in done.stdout
        assert (tmp_path / "runs" / "first" / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebooks_run(notebook: Path, tmp_path: Path) -> None:
    cells = json.loads(notebook.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    done = subprocess.run(
        [sys.executable, "-c", "import matplotlib; matplotlib.use('Agg')\n" + code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_there_are_two_notebooks_without_outputs() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["drive", "perceive"]
    for path in NOTEBOOKS:
        assert not any(cell.get("outputs") for cell in json.loads(path.read_text())["cells"])
