"""What the report shows is honest: one interval for one number, copies never count, n/a, files that are gone."""

from __future__ import annotations

import csv
import hashlib
import html.parser
import json
import re
from pathlib import Path
from typing import Any

import pytest
from helpers.metric_traces import make_trace
from helpers.run_folder import DRIVING_HEADER, driving_line, driving_lines, write_run
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ssad.core.errors import StoreError
from ssad.core.traces import save_trace, trace_hash
from ssad.experiments.runs import write_report
from ssad.report import check_artefacts


class _Text(html.parser.HTMLParser):
    """Texts of cards and table rows, each as the list of its parts."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.cards: dict[str, list[str]] = {}
        self.circles: list[str] = []
        self._into: list[str] | None = None
        self._skip = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        name = dict(attrs).get("class") or ""
        if tag == "tr":
            self._into = []
            self.rows.append(self._into)
        elif tag == "div" and name == "part":
            self._into = []
            self.cards[f"card {len(self.cards)}"] = self._into
        elif tag == "title":
            self._into = self.circles

    def handle_data(self, data: str) -> None:
        if self._into is not None and data.strip():
            self._into.append(data.strip())


def read_page(path: Path) -> _Text:
    page = _Text()
    page.feed(path.read_text())
    return page


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def after(parts: list[str], label: str) -> tuple[str, str]:
    """Number and interval that follow a label of a card."""
    at = parts.index(label)
    return parts[at + 1], parts[at + 2]


def test_one_interval_for_one_number(tmp_path: Path) -> None:
    page = read_page(write_report(write_run(tmp_path / "run", DRIVING_HEADER, driving_lines())))
    cards = list(page.cards.values())
    assert [c[0].split(",")[0] for c in cards] == ["pre-crash", "natural traffic"] * 2
    tables = {
        name: read_csv(tmp_path / "run" / "tables" / f"{name}.csv") for name in ("precrash", "metrics", "natural")
    }
    for card, system, average in ((cards[0], "a", "Avg."), (cards[1], "a", "Avg. natural"), (cards[2], "b", "Avg.")):
        for label, symbol in (
            ("collision rate", "CR"),
            ("route completion", "RC"),
            ("driving score, without stop signs", "DS"),
        ):
            number, interval = after(card, label)
            (line,) = [
                r for r in tables["metrics"] if (r["system"], r["group"], r["column"]) == (system, average, symbol)
            ]
            low, high = float(line["low"]), float(line["high"])
            assert (number, interval) == (f"{float(line['mean']):.2f}", f"[{low:.2f}, {high:.2f}]")
            assert line["method"] == "beta"
            if symbol == "CR":
                assert any(f"{system}: {number}, " in t and interval in t for t in page.circles)
            if symbol in ("CR", "RC") and average == "Avg.":
                (other,) = [
                    r
                    for r in tables["precrash"]
                    if (r["metric"], r["system"], r["column"], r["source"]) == (symbol, system, "Avg.", "ours")
                ]
                assert (other["mean"], other["low"], other["high"]) == (line["mean"], line["low"], line["high"])
                row = next(r for r in page.rows if r[:2] == [symbol, system] or (r[0] == system and interval in r))
                assert [number, interval] == [part for part in row if "failed" not in part][-2:]
    towns = {(r["system"], r["town"], r["column"]): r for r in tables["natural"] if r["source"] == "ours"}
    number, interval = after(cards[1], "collision rate")
    line = towns["a", "mean of the towns", "CR"]
    assert interval == f"[{float(line['low']):.2f}, {float(line['high']):.2f}]"


def test_rows_of_four_clusters_show_their_range(tmp_path: Path) -> None:
    write_report(write_run(tmp_path, DRIVING_HEADER, driving_lines()))
    for line in read_csv(tmp_path / "tables" / "precrash.csv"):
        if line["source"] == "ours" and line["mean"]:
            average = line["column"] == "Avg."
            assert int(line["clusters"]) == (32 if average else 4)
            assert (line["method"] == "range") == (not average or line["metric"] == "OR"), line
    text = (tmp_path / "tables" / "precrash.md").read_text()
    assert re.search(r"\| CR \| a \| \d\.\d\d \d\.\d\d–\d\.\d\d \|", text)
    assert "Episodes in a cell: a 8 in 4 clusters, b 8 in 4 clusters." in text


LINES = driving_lines()[:40] + driving_lines()[64:76] + driving_lines()[-1:]


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(0, len(LINES) - 1), min_size=1, max_size=60))
def test_copies_change_no_table(tmp_path: Path, copies: list[int]) -> None:
    plain = tmp_path / "plain"
    if not plain.exists():
        write_report(write_run(plain, DRIVING_HEADER, LINES))
    ran = [k for k in copies if LINES[k]["status"] == "ok"]
    more = LINES + [LINES[k] | {"key": f"copy{number}"} for number, k in enumerate(ran)]
    write_report(write_run(tmp_path / "copies", DRIVING_HEADER, more))
    for path in sorted((plain / "tables").iterdir()):
        assert (tmp_path / "copies" / "tables" / path.name).read_bytes() == path.read_bytes()


def test_without_a_case_the_hash_of_the_trace_tells_copies(tmp_path: Path) -> None:
    lines = [driving_line(f"k{k}", "RightTurn", "RightTurn/00") for k in range(6)]
    for line in lines:
        del line["case"], line["cluster"]
    episodes = [{"key": f"k{k}", "end": "complete", "trace_hash": f"h{k % 2}"} for k in range(6)]
    write_run(tmp_path, DRIVING_HEADER, lines, episodes)
    write_report(tmp_path)
    found = {(r["group"], r["column"]): r for r in read_csv(tmp_path / "tables" / "metrics.csv")}
    assert (found["Right-turn", "CR"]["n"], found["Right-turn", "CR"]["clusters"]) == ("2", "1")


def test_what_is_not_measured_is_not_a_number(tmp_path: Path) -> None:
    lines = [driving_line(f"k{k}", "RightTurn", f"r{k}", red_lights=None if k < 2 else 3) for k in range(4)]
    for line in lines:
        del line["metrics"]["lane_invasions"]
    page = write_report(write_run(tmp_path, DRIVING_HEADER, lines)).read_text()
    found = {r["column"]: r for r in read_csv(tmp_path / "tables" / "metrics.csv") if r["group"] == "Right-turn"}
    for symbol in ("SS", "LI", "MD"):
        assert [found[symbol][k] for k in ("mean", "low", "high", "n", "method")] == [""] * 5
    assert (found["RR"]["mean"], found["RR"]["n"]) == ("3.0", "2")
    assert "<b>n/a</b>" in page
    assert "driving score, without stop signs" in page
    assert "SS is not measured" in page
    # a world with stop signs
    lines = [driving_line(f"k{k}", "RightTurn", f"r{k}", stop_signs=k) for k in range(4)]
    page = write_report(write_run(tmp_path, DRIVING_HEADER, lines)).read_text()
    assert "without stop signs" not in page
    found = {r["column"]: r for r in read_csv(tmp_path / "tables" / "metrics.csv") if r["group"] == "Right-turn"}
    assert found["SS"]["mean"] == "1.5"


def digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def test_files_that_are_gone_or_altered_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    (folder / "files").mkdir(parents=True)
    lines: list[dict[str, Any]] = []
    for k in range(8):
        path = folder / "files" / f"{k}.bin"
        path.write_bytes(bytes([k]) * 100)
        names = {"one": f"files/{k}.bin"} if k % 2 else {"several": [f"files/{k}.bin", "files"]}
        lines.append(driving_line(f"k{k}", "RightTurn", f"r{k}") | {"artefacts": names})
        lines[-1]["hashes"] = {f"files/{k}.bin": digest(path)}
    write_run(folder, DRIVING_HEADER, lines)
    assert check_artefacts(folder) == []
    assert "Missing or altered" not in write_report(folder).read_text()
    (folder / "files" / "3.bin").unlink()
    (folder / "files" / "4.bin").write_bytes(b"other")
    assert check_artefacts(folder) == ["files/3.bin is missing", "files/4.bin is not as the run left it"]
    for k in (0, 1, 2, 5, 6, 7):
        (folder / "files" / f"{k}.bin").unlink()
    page = write_report(folder).read_text()
    assert "Missing or altered files: 8" in page
    assert "files/4.bin is not as the run left it" in page
    assert "and 3 more" in page
    lines[0]["artefacts"] = {"one": "../outside.bin"}
    (tmp_path / "outside.bin").write_text("x")
    assert "../outside.bin lies outside the run folder" in check_artefacts(write_run(folder, DRIVING_HEADER, lines))


def test_traces_without_hashes_are_held_against_their_episodes(tmp_path: Path) -> None:
    lines, episodes = [], []
    for k in range(4):
        trace = make_trace(5 + k, driven=list(range(5 + k)))
        save_trace(tmp_path / "traces" / f"k{k}.npz", trace)
        lines.append(driving_line(f"k{k}", "RightTurn", f"r{k}") | {"artefacts": {"trace": f"traces/k{k}.npz"}})
        episodes.append({"key": f"k{k}", "end": "complete", "trace_hash": trace_hash(trace)})
    write_run(tmp_path, DRIVING_HEADER, lines, episodes)
    assert check_artefacts(tmp_path) == []
    (tmp_path / "traces" / "k0.npz").unlink()
    save_trace(tmp_path / "traces" / "k1.npz", make_trace(9))
    (tmp_path / "traces" / "k2.npz").write_bytes(b"torn")
    assert check_artefacts(tmp_path) == [
        "traces/k0.npz is missing",
        "traces/k1.npz is not as the run left it",
        "traces/k2.npz is damaged",
    ]


def detector_line(key: str, detector: str, attack: str, **more: Any) -> dict[str, Any]:
    return {"key": key, "status": "ok", "reason": "", "detector": detector, "spec": {"attack": attack}, "n": 40} | more


def test_a_kind_without_a_section_gets_a_page(tmp_path: Path) -> None:
    columns = [
        {"name": "recall", "title": "Recall", "unit": "", "better": "higher"},
        {"name": "fooled", "title": "Fooled", "better": "lower"},
        {"name": "size", "title": "Size", "unit": "px"},
    ]
    lines = [
        detector_line("k0", "yolo", "fgsm", metrics={"recall": 0.28, "size": 4.5}, intervals={"recall": [0.2, 0.37]}),
        *(
            detector_line(f"k{k}", "yolo", "<pgd>", metrics={"fooled": k % 3 == 0, "recall": None}, case=f"c{k}")
            for k in range(1, 11)
        ),
        detector_line("copy", "yolo", "<pgd>", metrics={"fooled": True}, case="c3"),
        detector_line("dead", "fcos3d", "fgsm", status="crash", reason="it <died>", metrics={}),
    ]
    header = {
        "kind": "adversarial_patch",
        "command": "ssad run patch",
        "columns": columns,
        "factors": ["detector", "attack"],
        "suite": {"name": "patch", "title": "Patches", "seed": 3},
    }
    write_run(tmp_path, header, lines)
    (tmp_path / "pictures").mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "pictures" / "one.png")
    (tmp_path / "pictures" / "pictures.json").write_text(json.dumps({"one.png": "A <patch>.", "gone.png": "Gone."}))
    text = write_report(tmp_path).read_text()
    page = read_page(tmp_path / "report.html")
    assert page.rows[0] == ["detector", "attack", "Recall", "Fooled", "Size, px"]
    assert page.rows[1] == ["yolo", "fgsm", "0.28", "[0.20, 0.37]", "n/a", "4.50"]
    assert page.rows[2][:4] == ["<pgd>", "n/a", "0.30", page.rows[2][3]]
    assert page.rows[3][:8] == ["fcos3d", "fgsm", *["n/a", "1 failed"] * 3]
    assert page.rows[-1][:4] == ["fcos3d", "fgsm", "crash", "it <died>"]
    found = {(r["attack"], r["column"]): r for r in read_csv(tmp_path / "tables" / "results.csv")}
    assert found["fgsm", "Recall"]["method"] or found["<pgd>", "Fooled"]["method"] == "beta"
    assert (found["<pgd>", "Fooled"]["n"], found["<pgd>", "Fooled"]["mean"]) == ("10", "0.3")
    for words in ("adversarial_patch suite patch", "ssad run patch", "ssad 0", "A &lt;patch&gt;.", "data:image/png"):
        assert words in text
    assert "Gone." not in text


def test_a_kind_without_columns_or_factors_gets_those_of_its_lines(tmp_path: Path) -> None:
    lines = [{"key": "x", "status": "ok", "metrics": {"speed": 2.0}}, {"key": "y", "status": "ok", "metrics": {}}]
    write_report(write_run(tmp_path, {"kind": "no-such.kind", "suite": {}}, lines))
    found = [(r["key"], r["column"], r["mean"]) for r in read_csv(tmp_path / "tables" / "results.csv")]
    assert found == [("x", "speed", "2.0"), ("y", "speed", "")]


def detection_line(shift: str | None, severity: Any, scenes: int) -> dict[str, Any]:
    score = 0.4 if shift is None else 0.2
    # the replicates of both lines go up and down together, those under a shift with a little of their own
    own = 0.0 if shift is None else 0.01
    draws = [score * (1 + 0.02 * ((7 * k) % 11 - 5) + own * ((3 * k) % 7 - 3)) for k in range(50)]
    names = ("mAP", "NDS", "AP_car")
    family = "clean" if shift is None else "environment"
    return {
        "key": f"{shift}{severity}",
        "status": "ok",
        "reason": "",
        "detector": "d",
        "shift": shift,
        "severity": severity,
        "family": family,
        "metrics": dict.fromkeys(names, score),
        "n": 8 * scenes,
        "scenes": scenes,
        "replicates": dict.fromkeys(names, draws),
        "applied": {},
        "intervals": {name: [0.9 * score, 1.1 * score] for name in names},
    }


@pytest.mark.parametrize("scenes", [4, 24])
def test_detection_has_one_interval_for_one_number(tmp_path: Path, scenes: int) -> None:
    suite = {
        "name": "x",
        "detectors": ["d"],
        "shifts": ["fog"],
        "severities": [3],
        "calibration": "physical",
        "seed": 0,
    }
    lines = [detection_line(None, 0, scenes), detection_line("fog", 3, scenes)]
    lines[1]["metrics"]["AP_car"] = None
    page = read_page(write_report(write_run(tmp_path, {"kind": "detection", "suite": suite}, lines)))
    tables = {name: read_csv(tmp_path / "tables" / f"{name}.csv") for name in ("shifts", "severities", "car", "left")}
    clean, fog = (
        next(r for r in tables["shifts"] if r["shift"] == s and "NDS" in r["column"]) for s in ("clean", "fog")
    )
    by_severity = next(r for r in tables["severities"] if r["metric"] == "NDS")
    keys = ("mean", "low", "high", "n", "clusters", "method")
    assert [fog[k] for k in keys] == [by_severity[k] for k in keys]
    assert (clean["n"], clean["clusters"]) == (str(8 * scenes), str(scenes))
    assert next(r for r in tables["car"] if r["shift"] == "fog")["mean"] == ""
    card = next(iter(page.cards.values()))
    text = (tmp_path / "report.html").read_text()
    if scenes < 5:
        assert clean["low"] == clean["high"] == ""
        assert "no intervals, since 4 scenes are too few" in text
    else:
        low, high = float(clean["low"]), float(clean["high"])
        assert after(card, "NDS, %") == ("40.00", f"[{low:.2f}, {high:.2f}]")
        assert low < 40 < high
        assert "bootstrap over 24 scenes" in text
        # what is left is paired: its interval is narrower than the ratio of the two intervals
        left = next(r for r in tables["left"] if "NDS" in r["column"])
        assert 46 < float(left["low"]) < 50 < float(left["high"]) < 54
        assert float(fog["high"]) / low > 0.56


def test_a_folder_without_results_says_so(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"run\.json is missing"):
        check_artefacts(tmp_path)
