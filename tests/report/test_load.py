"""Results folders that somebody has changed: every alteration is noticed and named; torn ends and old folders are not
errors."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.command import ssad
from helpers.run_folder import DRIVING_HEADER, driving_lines, write_run
from rich.console import Console

from ssad.core.errors import StoreError
from ssad.core.safeio import dump_json, read_json
from ssad.engine.kind import Resources
from ssad.engine.run import run
from ssad.engine.store import Store
from ssad.experiments.driving.kind import Driving, DrivingSuite
from ssad.experiments.runs import report_markdown, write_report
from ssad.report.load import load_run

RESULTS, EPISODES = "results.jsonl", "episodes.jsonl"
CELLS = 5
SCENARIOS = ["StraightObstacle", "VehiclePassing/00"]

Alter = Callable[[Path], None]


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real run of five drives, each of which ends in a collision."""
    folder = tmp_path_factory.mktemp("run")
    suite = DrivingSuite(name="small", systems=["blind"], scenarios=SCENARIOS, witness=False)
    run(Driving().plan(suite, check=False), folder, Resources(0, console=Console(file=io.StringIO(), quiet=True)))
    return folder


@pytest.fixture
def folder(finished_run: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be altered."""
    return shutil.copytree(finished_run, tmp_path / "run")


def read(folder: Path, name: str) -> list[str]:
    return (folder / name).read_text().splitlines()


def write(folder: Path, name: str, lines: list[str]) -> None:
    (folder / name).write_text("".join(f"{line}\n" for line in lines))


def edit(name: str, line: int, change: Callable[[dict[str, Any]], Any]) -> Alter:
    """Alter the record in a line (from 1; -1: the last)."""

    def alter(folder: Path) -> None:
        lines = read(folder, name)
        index = line - 1 if line > 0 else line
        record = json.loads(lines[index])
        change(record)
        lines[index] = json.dumps(record, sort_keys=True, separators=(",", ":"))
        write(folder, name, lines)

    return alter


def set_metric(name: str, line: int, metric: str, value: Any) -> Alter:
    return edit(name, line, lambda record: record["metrics"].update({metric: value}))


def set_field(name: str, line: int, field: str, value: Any) -> Alter:
    return edit(name, line, lambda record: record.update({field: value}))


def move(name: str, order: Callable[[list[str]], list[str]]) -> Alter:
    """Rearrange the lines of a file."""
    return lambda folder: write(folder, name, order(read(folder, name)))


def both(*alterations: Alter) -> Alter:
    def alter(folder: Path) -> None:
        for alteration in alterations:
            alteration(folder)

    return alter


def remove(name: str) -> Alter:
    return lambda folder: (folder / name).unlink()


def replace_text(name: str, line: int, old: str, new: str) -> Alter:
    def alter(folder: Path) -> None:
        lines = read(folder, name)
        assert re.search(old, lines[line - 1])
        lines[line - 1] = re.sub(old, new, lines[line - 1], count=1)
        write(folder, name, lines)

    return alter


CHANGED = "this line was changed after it was written"
REMEDY = "; restore the file from a copy, or run again into another folder"

ALTERATIONS: dict[str, tuple[Alter, str]] = {
    # flipped and changed values
    **{
        f"collision flipped in {name}, line {line}": (
            set_metric(name, line, "collision", False),
            f"{name}:{line}: {CHANGED}: metrics.collision is false here and true in {other}:{line}{REMEDY}",
        )
        for name, other in ((RESULTS, EPISODES), (EPISODES, RESULTS))
        for line in (1, 3, CELLS)
    },
    "the same change in both files": (
        both(*(set_metric(name, 2, "route_completion", 1.0) for name in (RESULTS, EPISODES))),
        f"{RESULTS}:2: {CHANGED}{REMEDY}",
    ),
    "a metric that only the results have": (
        edit(RESULTS, 4, lambda record: record["versions"].update(ssad="9")),
        f"{RESULTS}:4: {CHANGED}{REMEDY}",
    ),
    "a time by the clock": (set_field(RESULTS, -1, "wall_s", 0.5), f"{RESULTS}:5: {CHANGED}{REMEDY}"),
    "another system": (
        set_field(RESULTS, 2, "system", "mine"),
        f'{RESULTS}:2: {CHANGED}: system is "mine" here and "blind" in {EPISODES}:2{REMEDY}',
    ),
    "another seed": (
        edit(EPISODES, 1, lambda record: record.update(seed=record["seed"] + 1)),
        rf"{EPISODES}:1: {CHANGED}: seed is \d+ here and \d+ in {RESULTS}:1{REMEDY}",
    ),
    "another end": (set_field(EPISODES, 5, "end", "complete"), f"{EPISODES}:5: {CHANGED}{REMEDY}"),
    "another hash of the trace": (set_field(EPISODES, 3, "trace_hash", "00"), f"{EPISODES}:3: {CHANGED}{REMEDY}"),
    "a failure that was none": (
        edit(RESULTS, 1, lambda record: record.update(status="failed", metrics={})),
        f"{RESULTS}:1: {CHANGED}{REMEDY}",
    ),
    "another key": (set_field(RESULTS, 3, "key", "0123456789abcdef"), f"{RESULTS}:3: {CHANGED}{REMEDY}"),
    "a metric taken out": (
        edit(RESULTS, 2, lambda record: record["metrics"].pop("pet")),
        f"{RESULTS}:2: {CHANGED}{REMEDY}",
    ),
    "a new field": (set_field(EPISODES, 2, "note", "checked"), f"{EPISODES}:2: {CHANGED}{REMEDY}"),
    # doubled, deleted, reordered lines
    "first line doubled at the end": (
        move(RESULTS, lambda lines: [*lines, lines[0]]),
        rf"{RESULTS}:6: the cell \w+ is there twice, first in line 1; remove this line",
    ),
    "middle line doubled in place": (
        move(RESULTS, lambda lines: [*lines[:3], *lines[2:]]),
        rf"{RESULTS}:4: the cell \w+ is there twice, first in line 3; remove this line",
    ),
    "last episode doubled": (
        move(EPISODES, lambda lines: [*lines, lines[-1]]),
        rf"{EPISODES}:6: the cell \w+ is there twice, first in line 5; remove this line",
    ),
    **{
        f"line {line} of {name} deleted": (
            move(name, lambda lines, line=line: lines[: line - 1] + lines[line:]),  # type: ignore[misc]
            f"{name}:{line}: this line was written as line {line + 1}, so lines were removed or moved{REMEDY}"
            if line < CELLS
            else f"{name}:{line}: this line is missing: the run wrote 5 lines{REMEDY}",
        )
        for name in (RESULTS, EPISODES)
        for line in (1, 3, CELLS)
    },
    "last line of both deleted": (
        both(*(move(name, lambda lines: lines[:-1]) for name in (RESULTS, EPISODES))),
        f"{RESULTS}:5: this line is missing: the run wrote 5 lines{REMEDY}",
    ),
    "lines reversed": (
        move(RESULTS, lambda lines: lines[::-1]),
        f"{RESULTS}:1: this line was written as line 5, so lines were removed or moved{REMEDY}",
    ),
    "two episodes swapped": (
        move(EPISODES, lambda lines: [*lines[:3], lines[4], lines[3]]),
        f"{EPISODES}:4: this line was written as line 5, so lines were removed or moved{REMEDY}",
    ),
    "all results gone": (move(RESULTS, lambda lines: []), f"{RESULTS}:1: this line is missing: the run wrote 5 lines"),
    "no file of episodes": (remove(EPISODES), f"{EPISODES}:1: this line is missing: the run wrote 5 lines{REMEDY}"),
    "no file of counts": (remove("seal.json"), f"seal.json: is missing, though the run has lines{REMEDY}"),
    "another count": (
        lambda folder: (folder / "seal.json").write_text('{"results.jsonl": 7, "episodes.jsonl": 5}') and None,
        f"{RESULTS}:6: this line is missing: the run wrote 7 lines{REMEDY}",
    ),
    "a count that is none": (
        lambda folder: (folder / "seal.json").write_text('{"results.jsonl": "many", "episodes.jsonl": 5}') and None,
        "seal.json: does not count the lines of results.jsonl and episodes.jsonl" + REMEDY,
    ),
    "a line of one file in the other": (
        lambda folder: write(folder, EPISODES, [*read(folder, EPISODES)[:4], read(folder, RESULTS)[4]]),
        rf"{RESULTS}:5: the cell \w+ was not written with its line {EPISODES}:5{REMEDY}",
    ),
    "a line broken in the middle": (
        move(RESULTS, lambda lines: [*lines[:2], "}" + lines[2], *lines[3:]]),
        f"{RESULTS}:3: this line is broken; mend or remove it, then run again",
    ),
    "a line broken at the end": (
        move(RESULTS, lambda lines: [*lines[:4], lines[4][:-1]]),
        f"{RESULTS}:5: this line was broken after it was written{REMEDY}",
    ),
    # seals
    "a seal taken out": (
        edit(RESULTS, 2, lambda record: record.pop("seal")),
        f"{RESULTS}:2: this line has no seal, so ssad did not write it as it is{REMEDY}",
    ),
    "all seals taken out": (
        both(*(edit(RESULTS, line, lambda record: record.pop("seal")) for line in range(1, 6))),
        f"{RESULTS}:1: this line has no seal, so ssad did not write it as it is{REMEDY}",
    ),
    "another digest": (
        edit(RESULTS, 4, lambda record: record["seal"].update(digest="00")),
        f"{RESULTS}:4: {CHANGED}{REMEDY}",
    ),
    "another episode": (
        edit(RESULTS, 4, lambda record: record["seal"].update(episode="00")),
        rf"{RESULTS}:4: the cell \w+ was not written with its line {EPISODES}:4{REMEDY}",
    ),
    # absurd values
    "a rate above 1": (
        set_metric(RESULTS, 1, "route_completion", 1.2),
        rf"{RESULTS}:1: metrics.route_completion is 1.2, outside of \[0, 1\]{REMEDY}",
    ),
    "a rate below 0": (
        set_metric(EPISODES, 3, "off_road_fraction", -0.1),
        rf"{EPISODES}:3: metrics.off_road_fraction is -0.1, outside of \[0, 1\]{REMEDY}",
    ),
    "a flag that is 7": (
        set_metric(RESULTS, -1, "collision", 7),
        rf"{RESULTS}:5: metrics.collision is 7, outside of \[0, 1\]{REMEDY}",
    ),
    "a score above 100": (
        set_metric(RESULTS, 3, "driving_score", 250.0),
        rf"{RESULTS}:3: metrics.driving_score is 250.0, outside of \[0, 100\]{REMEDY}",
    ),
    "a negative count": (
        set_metric(RESULTS, 2, "red_lights", -1),
        rf"{RESULTS}:2: metrics.red_lights is -1, outside of \[0, 1e\+09\]{REMEDY}",
    ),
    "a distance beyond reason": (
        set_metric(EPISODES, 1, "driven", 1e12),
        rf"{EPISODES}:1: metrics.driven is 1000000000000.0, outside of \[0, 1e\+07\]{REMEDY}",
    ),
    "a time beyond reason": (
        set_metric(RESULTS, 2, "time", 1e300),
        rf"{RESULTS}:2: metrics.time is 1e\+300, which is no plausible number{REMEDY}",
    ),
    "a negative time by the clock": (
        set_field(RESULTS, 4, "wall_s", -1.0),
        rf"{RESULTS}:4: wall_s is -1.0, outside of \[0, 1e\+09\]{REMEDY}",
    ),
    "a negative number of cases": (
        set_field(RESULTS, 1, "n", -3),
        rf"{RESULTS}:1: n is -3, outside of \[0, 1e\+12\]{REMEDY}",
    ),
    "not a number": (
        set_metric(RESULTS, 5, "min_distance", float("nan")),
        f"{RESULTS}:5: metrics.min_distance is NaN, which is no number{REMEDY}",
    ),
    "an infinite number": (
        set_metric(EPISODES, 2, "pet", float("inf")),
        f"{EPISODES}:2: metrics.pet is Infinity, which is no number{REMEDY}",
    ),
    "a number too large for a float": (
        replace_text(RESULTS, 3, r'"time":[0-9.]+', '"time":1e999'),
        f"{RESULTS}:3: metrics.time is Infinity, which is no number{REMEDY}",
    ),
    "text in place of a number": (
        set_metric(RESULTS, 2, "time", "long"),
        f'{RESULTS}:2: metrics.time is "long", which is no number{REMEDY}',
    ),
    "a list in place of a number": (
        set_metric(EPISODES, -1, "driven", [1, 2]),
        rf"{EPISODES}:5: metrics.driven is \[1, 2\], which is no number{REMEDY}",
    ),
    "a list in place of the metrics": (
        set_field(RESULTS, 1, "metrics", []),
        rf"{RESULTS}:1: metrics is \[\], which is no object{REMEDY}",
    ),
    "a number in place of the status": (
        set_field(RESULTS, 3, "status", 0),
        f"{RESULTS}:3: status is 0, which is no text{REMEDY}",
    ),
    "no status": (
        edit(RESULTS, 3, lambda record: record.pop("status")),
        f"{RESULTS}:3: this line has no status, so it is no result of a cell{REMEDY}",
    ),
    "a number in place of the key": (
        set_field(EPISODES, 1, "key", 12),
        f"{EPISODES}:1: key is 12, which is no key of a cell{REMEDY}",
    ),
}


@pytest.mark.parametrize("name", ALTERATIONS)
def test_an_altered_folder_is_refused_with_file_line_problem_and_remedy(folder: Path, name: str) -> None:
    alter, message = ALTERATIONS[name]
    alter(folder)
    header = read_json(folder / "run.json")
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    for read_folder in (load_run, lambda path: Store.open(path, header, retry=True)):
        with pytest.raises(StoreError) as error:
            read_folder(folder)
        assert re.match(f"{re.escape(str(folder))}/{message}", str(error.value)), str(error.value)
    assert before == {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}, "nothing was mended"


def test_commands_refuse_an_altered_folder_in_a_line(folder: Path, finished_run: Path) -> None:
    set_metric(RESULTS, 1, "collision", False)(folder)
    key = json.loads(read(folder, RESULTS)[0])["key"]
    for words in (["report", folder], ["compare", finished_run, folder], ["replay", folder, key]):
        end = ssad(*words)
        assert end.returncode == 2, words
        assert re.fullmatch(rf"error: .*{RESULTS}:1: {CHANGED}.*\n", end.stderr), end.stderr


@pytest.mark.parametrize(
    "name", ["first line doubled at the end", "middle line doubled in place", "last episode doubled"]
)
def test_a_doubled_line_is_mended_as_the_message_says(folder: Path, name: str) -> None:
    alter, message = ALTERATIONS[name]
    alter(folder)
    file_name, line = message.split(":")[:2]
    move(file_name, lambda lines: lines[: int(line) - 1] + lines[int(line) :])(folder)
    assert len(load_run(folder).lines) == CELLS


def test_the_run_itself_is_intact_and_its_seals_are_no_fields(finished_run: Path) -> None:
    loaded = load_run(finished_run)
    assert loaded.sealed
    assert len(loaded.lines) == len(loaded.episodes) == loaded.planned == CELLS
    assert all(line["metrics"]["collision"] for line in loaded.lines)
    assert not any("seal" in record for record in (*loaded.lines, *loaded.episodes.values()))


def test_another_spelling_of_the_same_values_is_no_change(folder: Path) -> None:
    for name in (RESULTS, EPISODES):
        write(folder, name, [json.dumps(json.loads(line), indent=None) for line in read(folder, name)])
    assert len(load_run(folder).lines) == CELLS


@pytest.mark.parametrize("name", [RESULTS, EPISODES])
def test_a_torn_last_line_is_an_unfinished_run_and_no_error(folder: Path, name: str) -> None:
    text = (folder / name).read_text()
    for length in (len(text) - 1, len(text) - 40):
        (folder / name).write_text(text[:length])
        assert len(load_run(folder).lines) == CELLS - 1
        assert f"Not finished: {CELLS - 1} of {CELLS} cells have run." in write_report(folder).read_text()


def test_a_folder_without_seals_is_read_with_a_warning_and_its_report_says_so(tmp_path: Path) -> None:
    lines = driving_lines()
    old = write_run(tmp_path / "old", DRIVING_HEADER, lines)
    (old / "run.json").write_text(dump_json({k: v for k, v in read_json(old / "run.json").items() if k != "sealed"}))
    (old / "seal.json").unlink()
    write(old, RESULTS, [dump_json(line) for line in lines])
    with pytest.warns(UserWarning, match=r"old/results\.jsonl: its lines have no seals") as warned:
        loaded = load_run(old)
    assert len(warned) == 1
    assert not loaded.sealed
    assert len(loaded.lines) == len(lines)
    with pytest.warns(UserWarning, match="no seals"):
        assert "The records have no seals: changes to them would not be noticed." in report_markdown([old])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"metrics": {"collision": 7}}, r"results\.jsonl:1: metrics\.collision is 7, outside of \[0, 1\]"),
        ({"metrics": {"time": "x"}}, r'results\.jsonl:1: metrics\.time is "x", which is no number'),
        ({"metrics": {"time": 2.0}}, r"results\.jsonl:1: metrics\.time is 2\.0 here and 1\.5 in episodes\.jsonl:2"),
        ({"seed": 1}, r"results\.jsonl:1: seed is 1 here and 0 in episodes\.jsonl:2"),
        ({"key": "b"}, r"results\.jsonl:2: the cell b is there twice, first in line 1"),
    ],
)
def test_values_doubles_and_contradictions_are_checked_without_seals_too(
    tmp_path: Path, change: dict[str, Any], problem: str
) -> None:
    record = {"key": "a", "status": "ok", "seed": 0, "metrics": {"time": 1.5, "collision": False}}
    (tmp_path / "run.json").write_text(json.dumps({"identity": "x", "limits": {"collision": [0, 1]}}))
    write(tmp_path, RESULTS, [json.dumps(record | change), json.dumps(record | {"key": "b"})])
    write(tmp_path, EPISODES, [json.dumps({"key": "b", "seed": 0}), json.dumps(record)])
    with pytest.raises(StoreError, match=problem):
        load_run(tmp_path)


@pytest.mark.parametrize("text", ["[]", '{"limits": {"time": [0]}}', '{"limits": [0, 1]}'])
def test_a_run_json_of_somebody_else_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(StoreError, match=r"run\.json: "):
        load_run(tmp_path)
