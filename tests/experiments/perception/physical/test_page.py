"""The page of a physical run: the paper's rows, controls, heat maps, refusals; and the paper's tables themselves."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.run_folder import write_lines

from benchmarks.physical_distance import write_figures
from ssad.experiments.perception.physical.approach_page import (
    approach_figures,
    approach_table,
    approach_tables,
    detection_table,
)
from ssad.experiments.perception.physical.page import (
    comparison_table,
    grid_table,
    main_table,
    maps,
    margin_table,
    summary,
    tiles,
    transfer_table,
)
from ssad.experiments.perception.physical.physical_run import PhysicalRun, score
from ssad.experiments.runs import write_report
from ssad.metrics.target_approach import stopping_distance
from ssad.report.figures import HeatMap, heat_maps
from ssad.report.load import load_run
from ssad.report.paper import PHYSICAL


def line(attack: str, carrier: str, ap: float, **changes: Any) -> dict[str, Any]:
    """A record."""
    found: dict[str, Any] = {
        "attack": attack,
        "carrier": carrier,
        "source": "",
        "test": "Oldmarket",
        "train": "Twinford",
        "view": "drive",
        "detector": "yolov5n",
        "number": 0,
        "status": "ok",
        "n": 40,
        "drives": 8,
        "metrics": {
            "AP50": ap,
            "AP50_25": ap,
            **({} if attack == "clean" else {"ASR_25": 1 - ap, "n0_25": 38}),
            "confidence": ap,
        },
        "intervals": {"AP50": [max(ap - 0.05, 0.0), min(ap + 0.05, 1.0)]},
    }
    found |= changes
    told = (found[key] for key in ("attack", "carrier", "source", "view", "detector", "number"))
    return found | {"key": "-".join(str(part) for part in told)}


def grid(ap: float | None, worst: list[float] | None) -> dict[str, Any]:
    """What a record of the grid has."""
    views = [[5.0, 0.0, 15.0, "day", 0.9, 0.1], [5.0, 180.0, 15.0, "night", 0.9, 0.6]]
    return {
        "view": "grid",
        "views": views,
        "cells": [[5.0, 0.0, 1, 1.0, ap], [5.0, 180.0, 1, 0.2, None]],
        "worst": worst,
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    lines = [
        line("clean", "", 0.99),
        line("random", "patch", 0.98),
        line("random", "patch", 0.90, number=1),
        line("adv-patch", "patch", 0.60, source="yolov5n", epochs=12, loss_before=-2.0, loss_after=-0.5),
        line("grey", "camouflage", 0.97),
        line("shuffled das", "camouflage", 0.5, source="yolov5n"),
        line("das", "camouflage", 0.48, source="yolov5n", epochs=12, loss_before=-2.0, loss_after=-0.5),
        line("das", "camouflage", 0.88, source="yolov5n", detector="fcos3d-light"),
        line("clean", "", 0.9, **grid(None, [5.0, 180.0, 0.2])),
        line("das", "camouflage", 0.4, source="yolov5n", **grid(0.35, [5.0, 0.0, 0.35])),
        line("tpa", "camouflage", 0.0, source="yolov5n", status="failed", reason="the texture is never in view"),
    ]
    suite = {
        "name": "t",
        "kind": "physical",
        "title": "T",
        "detectors": ["yolov5n"],
        "behind": 20.0,
        "reference": "physical",
    }
    (tmp_path / "run.json").write_text(json.dumps({"kind": "physical", "suite": suite, "cells": []}))
    write_lines(tmp_path, lines)
    return tmp_path


def approach(values: dict[float, float], first: float) -> dict[str, Any]:
    """What a record of the approach has: AP50 by distance, its interval and replicates."""
    cells = [
        {
            "distance": distance,
            "n": 40,
            "drives": 8,
            "height": 30.0,
            "AP50": ap,
            "confidence": ap / 2,
            "found": ap,
            "intervals": {"AP50": [max(ap - 0.1, 0.0), min(ap + 0.1, 1.0)]},
            "replicates": {"AP50": [ap - 0.02, ap + 0.02] * 5},
        }
        for distance, ap in values.items()
    ]
    return {
        "view": "approach",
        "approach": cells,
        "axis": [5.0, 20.0],
        "first_detected": {"distance": first, "is_end": first == 20.0, "interval": [first - 1.0, first + 1.0]},
    }


@pytest.fixture
def approached(folder: Path) -> PhysicalRun:
    """A run with an approach: at 5 m a control hides as much as the attack, at 20 m none, at 60 m the clean is lost."""
    lines = [
        line("clean", "", 0.99),
        line("clean", "", 0.9, **approach({5.0: 0.95, 20.0: 1.0, 60.0: 0.3}, 20.0)),
        line("random", "camouflage", 0.8, **approach({5.0: 0.4, 20.0: 0.9, 60.0: 0.2}, 20.0)),
        line("random", "camouflage", 0.8, number=1, **approach({5.0: 0.9, 20.0: 0.8, 60.0: 0.2}, 20.0)),
        line("vanishing", "camouflage", 0.3, source="yolov5n", **approach({5.0: 0.4, 20.0: 0.1, 60.0: 0.0}, 17.0)),
    ]
    write_lines(folder, lines)
    return PhysicalRun(load_run(folder))


def test_scores_stand_against_distance_up_to_where_the_clean_target_is_lost(approached: PhysicalRun) -> None:
    made = approach_table(approached, "AP50")
    assert made.columns == ("5 m", "20 m")
    text = {row.head[2]: [cell.text for cell in row.cells] for row in made.rows}
    assert text == {
        "clean": ["95.00", "100.00"],
        "strongest control, camouflage": ["40.00", "80.00"],
        "vanishing (strong)": ["40.00", "10.00"],
    }
    assert [row.head[3] for row in made.rows] == ["", "", "5 m"], "a control hides as much there"
    assert made.rows[2].cells[1].interval == "[0.00, 20.00]"


def test_the_figure_has_hollow_points_where_nothing_is_proven(approached: PhysicalRun) -> None:
    ((title, svg),) = approach_figures(approached)
    assert title == "yolov5n, Oldmarket, camouflage"
    assert svg.count('fill="var(--card)"') == 2, "at 5 m, of AP50 and of the mean score"
    assert svg.count("<polygon") == 3, "bands of clean, control and attack"
    assert "30 km/h" in svg
    assert "50 km/h" not in svg, "beyond the axis"


def test_judges_and_hours_have_figures_of_their_own(folder: Path) -> None:
    """A judge is shown what was trained against others; the clean target beside a light is that of its hour."""
    night, far = "light, night", {5.0: 0.9, 20.0: 0.8}
    lines = [
        line("clean", "", 0.9, detector="fcos3d-light", **approach(far, 20.0)),
        line(
            "das", "camouflage", 0.3, source="yolov5n", detector="fcos3d-light", **approach({5.0: 0.4, 20.0: 0.1}, 5.0)
        ),
        line("clean", night, 0.8, **approach(far, 18.0)),
        line("clean", "light, noon", 0.9, **approach(far, 20.0)),
        line("laser", f"{night}, watts 10.0", 0.7, source="yolov5n", **approach({5.0: 0.5, 20.0: 0.1}, 5.0)),
        line("random laser", f"{night}, watts 10.0", 0.7, **approach({5.0: 0.85, 20.0: 0.7}, 19.0)),
    ]
    write_lines(folder, lines)
    run = PhysicalRun(load_run(folder))
    assert [title for title, _ in approach_figures(run)] == [
        "fcos3d-light, Oldmarket, camouflage",
        f"yolov5n, Oldmarket, {night}, watts 10.0",
    ]
    rows = [row.head[1:3] for row in approach_table(run, "AP50").rows]
    assert rows == [
        ("fcos3d-light", "clean"),
        ("fcos3d-light", "DAS, against yolov5n"),
        ("yolov5n", "clean, night"),
        ("yolov5n", f"strongest control, {night}, watts 10.0"),
        ("yolov5n", "laser, night, watts 10.0"),
    ]


def test_a_figure_for_the_documentation_stands_alone(approached: PhysicalRun, tmp_path: Path) -> None:
    (line,) = write_figures(approached.run.folder, "physical", tmp_path)
    assert line.endswith("(../images/physical-yolov5n-oldmarket-camouflage.svg)")
    written = (tmp_path / "physical-yolov5n-oldmarket-camouflage.svg").read_text()
    assert "var(" not in written
    assert ElementTree.fromstring(written).tag == "{http://www.w3.org/2000/svg}svg"


def test_the_first_detection_stands_beside_what_a_stop_leaves(approached: PhysicalRun) -> None:
    made = detection_table(approached)
    rows = {row.head[2]: row for row in made.rows}
    assert [cell.text for cell in rows["vanishing (strong)"].cells[:2]] == ["17.0", "0.5"]
    assert rows["vanishing (strong)"].cells[3].mean == pytest.approx(17.0 - stopping_distance(80 / 3.6))
    assert rows["vanishing (strong)"].head[3] == ""
    assert rows["clean"].head[3] == "yes", "the axis ends there"
    assert "random camouflage, draw 2" in rows
    assert "Regulation 157" in made.note


def test_the_page_begins_with_the_distances(approached: PhysicalRun) -> None:
    page = write_report(approached.run.folder).read_text()
    assert page.index("Scores against distance") < page.index("Trained in Twinford")
    assert approach_tables(PhysicalRun(approached.run))[0].name == "approach-ap50"


def test_a_map_brackets_cells_in_which_a_control_hides_as_much(folder: Path) -> None:
    lines = [
        line("grey", "camouflage", 0.4, **grid(0.3, None)),
        line("das", "camouflage", 0.4, source="yolov5n", **grid(0.35, [5.0, 0.0, 0.35])),
    ]
    write_lines(folder, lines)
    ((_, svg),) = maps(PhysicalRun(load_run(folder)))
    assert "(35)" in svg
    assert "(30)" not in svg


def test_the_papers_rows_stand_below_ours(folder: Path) -> None:
    rows = main_table(PhysicalRun(load_run(folder)), 0).rows
    assert [row.head[0] for row in rows] == [
        "clean",
        "Benign, Town04",
        "random patch",
        "Random patch, Town04",
        "Adv. Patch",
        "Adv. Patch, Town04",
        "grey camouflage",
        "shuffled DAS",
        "DAS",
        "DAS, Town04",
        "TPA",
        "TPA, Town04",
    ]
    text = {row.head[0]: [cell.text for cell in row.cells] for row in rows}
    assert text["DAS, Town04"] == ["56.20", "n/a", "80.30", "n/a"]
    assert text["DAS"] == ["48.00", "48.00", "52.00", "38"]
    assert text["TPA"] == ["n/a"] * 4, "what was refused has no number"
    random = next(row for row in rows if row.head == ("random patch",)).cells[0]
    assert (random.text, random.interval) == ("94.00", "[85.00, 100.00]"), "mean of two draws, ends of their intervals"


def test_records_that_tell_of_any_class_have_a_column_of_it(folder: Path) -> None:
    """Between those of a detector; the paper has none, and records from before have none."""
    assert not any("any class" in one for one in main_table(PhysicalRun(load_run(folder)), 0).columns)
    lines = [json.loads(one) for one in (folder / "results.jsonl").read_text().splitlines()]
    for one in lines:
        one["metrics"]["ASR_any_25"] = 0.25 if one["attack"] == "das" else None
    write_lines(folder, lines)
    made = main_table(PhysicalRun(load_run(folder)), 0)
    assert [name.removeprefix("yolov5n ") for name in made.columns[2:]] == ["ASR", "ASR, any class", "n0"]
    text = {row.head[0]: [cell.text for cell in row.cells] for row in made.rows}
    assert text["DAS"] == ["48.00", "48.00", "52.00", "25.00", "38"]
    assert text["DAS, Town04"] == ["56.20", "n/a", "80.30", "n/a", "n/a"]


def test_a_success_rate_stands_beside_its_n0_or_not_at_all(folder: Path) -> None:
    made = main_table(PhysicalRun(load_run(folder)), 0)
    assert "n/a where the target is found so in less than 90% of the clean images" in made.note
    few = line("das", "camouflage", 0.5) | {"metrics": {"AP50": 0.5, "ASR_25": None, "n0_25": 3}}
    assert [score([few], name).text for name in ("ASR_25", "n0_25")] == ["n/a", "3"]
    uncounted = few | {"metrics": {"AP50": 0.5, "ASR_25": 0.67}}
    assert score([uncounted], "ASR_25").text == "n/a"
    assert score([line("das", "camouflage", 0.5)], "ASR_25").n == 38
    assert "n0: targets found clean" in summary(load_run(folder)).note


def test_the_interval_of_several_draws_covers_drives_and_draws() -> None:
    """Two draws of 100 % are as sure as their drives make them, and no surer; without intervals their range is left."""
    ends = {"AP50": [0.8, 1.0]}
    sure = [line("random", "patch", 1.0, intervals=ends), line("random", "patch", 1.0, number=1, intervals=ends)]
    assert score(sure, "AP50").interval == "[80.00, 100.00]"
    other = line("random", "patch", 0.7, number=2, intervals={"AP50": [0.5, 0.9]})
    wide = score([*sure, other], "AP50")
    assert (wide.text, wide.interval, wide.clusters) == ("90.00", "[50.00, 100.00]", 8)
    few = score([*sure, {**other, "intervals": {}}], "AP50")
    assert (few.text, few.interval, few.clusters) == ("90.00", "70.00–100.00", 3)
    assert score([{**other, "intervals": {}}], "AP50").interval == ""
    assert score(sure, "ASR_50").text == "n/a"


def test_an_attack_is_held_against_the_draw_of_a_control_that_comes_nearest(folder: Path) -> None:
    rows = {row.head[2]: row for row in margin_table(PhysicalRun(load_run(folder))).rows}
    assert rows["Adv. Patch"].head[3] == "random patch"
    assert rows["Adv. Patch"].cells[2].mean == pytest.approx(90.0 - 60.0), "the draw that hides most, not their mean"
    assert rows["DAS"].head[3] == "shuffled DAS", "of all controls of the carrier"
    assert rows["DAS"].cells[2].mean == pytest.approx(50.0 - 48.0)
    assert np.isnan(rows["DAS"].cells[2].low), "no replicates, so no interval"


def test_a_control_that_is_worse_on_average_can_come_nearer(folder: Path) -> None:
    """A draw that leaves more, but by chance less in some drives, is less surely weaker than the attack."""
    draws = np.random.default_rng(0).normal(0.0, 0.1, 200)
    lines = [
        line("das", "camouflage", 0.50, source="yolov5n", replicates={"AP50": (0.50 + draws).tolist()}),
        line("grey", "camouflage", 0.60, replicates={"AP50": (0.60 + draws).tolist()}),
        line("random", "camouflage", 0.62, replicates={"AP50": (0.62 - draws).tolist()}),
    ]
    write_lines(folder, lines)
    (row,) = margin_table(PhysicalRun(load_run(folder))).rows
    assert row.head[3] == "random camouflage"
    assert row.cells[2].mean == pytest.approx(12.0)
    assert row.cells[2].low < 0.0
    write_lines(folder, lines[:2])
    (row,) = margin_table(PhysicalRun(load_run(folder))).rows
    assert row.cells[2].low == pytest.approx(10.0, abs=0.1), "alike in every drive"


def test_attacks_are_compared_draw_by_draw_of_the_same_drives(folder: Path) -> None:
    """Hard and easy drives spread both alike: the difference is known far better than either."""
    draws = np.random.default_rng(0).normal(0.0, 0.1, 200)
    own = {"source": "yolov5n", "drives": 8}
    lines = [
        line("das", "camouflage", 0.50, replicates={"AP50": (0.50 + draws).tolist()}, **own),
        line("tpa", "camouflage", 0.40, replicates={"AP50": (0.40 + draws + 0.01 * np.sign(draws)).tolist()}, **own),
        line("adv-patch", "patch", 0.2, replicates={"AP50": (0.2 + draws).tolist()}, **own),
        line("random", "camouflage", 0.1),
    ]
    write_lines(folder, lines)
    (row,) = comparison_table(PhysicalRun(load_run(folder))).rows
    assert row.head == ("Oldmarket", "behind", "yolov5n", "TPA", "DAS"), "of one carrier, and no control"
    gap = row.cells[2]
    spread = 2.3646 * 100 * np.std(0.01 * np.sign(draws), ddof=1) * np.sqrt(8 / 7)  # Student's, 7 degrees of freedom
    assert gap.mean == pytest.approx(10.0)
    assert (gap.mean - gap.low, gap.high - gap.mean) == pytest.approx((spread, spread), rel=0.1), (
        "beta limits are close"
    )
    lines[1]["drives"] = 7
    write_lines(folder, lines)
    (row,) = comparison_table(PhysicalRun(load_run(folder))).rows
    assert np.isnan(row.cells[2].low), "other drives: no pairs"


def test_the_first_screen_shows_the_clean_pictures_of_the_hour_of_the_strongest_light(folder: Path) -> None:
    lines = [
        line("clean", "light, night", 0.3),
        line("clean", "light, noon", 0.9),
        line("shadow", "light, noon", 0.2),
        line("laser", "light, night, watts 10.0", 0.25),
    ]
    write_lines(folder, lines)
    (tile,) = tiles(PhysicalRun(load_run(folder)))
    assert (tile["worst"], tile["clean"].mean, tile["left"].mean) == ("shadow, noon", 90.0, 20.0)
    write_lines(folder, lines[:2] + lines[3:])
    (tile,) = tiles(PhysicalRun(load_run(folder)))
    assert (tile["clean"].mean, tile["left"].mean) == (30.0, 25.0)


def test_a_light_is_held_against_random_settings_of_its_own_kind(folder: Path) -> None:
    """A random projector hides more than a random laser; a laser need not be better than that."""
    night = "light, night"
    lines = [
        line("laser", night, 0.70, source="yolov5n"),
        line("random laser", night, 0.90),
        line("random laser", night, 0.94, number=1),
        line("random projector", night, 0.40),
    ]
    write_lines(folder, lines)
    (row,) = margin_table(PhysicalRun(load_run(folder))).rows
    assert row.head[2:] == ("laser, night", "random laser, night", "")
    assert row.cells[2].mean == pytest.approx(90.0 - 70.0)
    lines[0] = line("laser, searches 4", night, 0.70, source="yolov5n")
    write_lines(folder, lines)
    (row,) = margin_table(PhysicalRun(load_run(folder))).rows
    assert row.head[2:] == ("laser, searches 4, night", "random laser, night", "")


def test_transfer_and_the_worst_cell(folder: Path) -> None:
    lines = [json.loads(one) for one in (folder / "results.jsonl").read_text().splitlines()]
    write_lines(folder, [*lines, line("clean", "", 0.91, detector="fcos3d-light")])
    run = PhysicalRun(load_run(folder))
    usual, moved = transfer_table(run).rows
    assert usual.head == ("Oldmarket", "clean", "")
    assert [cell.text for cell in usual.cells] == ["99.00", "91.00"]
    assert moved.head == ("Oldmarket", "DAS", "yolov5n")
    assert [cell.text for cell in moved.cells] == ["48.00", "88.00"]
    clean, das = grid_table(run).rows
    assert clean.head[4] == "5 m, 180°"
    assert das.head[4] == "5 m, 0°"
    assert [cell.text for cell in das.cells[2:]] == ["38", "35.00"]


def test_the_page_shows_all_and_says_what_was_refused(folder: Path) -> None:
    text = write_report(folder).read_text()
    assert "the texture is never in view" in text
    assert text.count('role="img"') == 2, "distance by azimuth, elevation by weather"
    assert "AP50 clean 20.0, attacked n/a, 1 views" in text
    assert (folder / "tables" / "margins.csv").is_file()


def test_a_heat_map_is_red_where_the_value_is_low_and_marks_its_worst_cell() -> None:
    values = {("5 m", "0°"): 0.0, ("5 m", "90°"): 1.0, ("9 m", "0°"): None}
    text = heat_maps([HeatMap("m", ["5 m", "9 m"], ["0°", "90°"], values, ("5 m", "90°"), {})], label="l & l")
    assert "l &amp; l" in text
    assert [int(share) for share in re.findall(r"--crash\) (\d+)%", text)] == [70, 0]
    assert text.count(">n/a<") == 2, "one was not measured, one is absent"
    assert text.count('stroke="var(--ink)"') == 1


@pytest.mark.parametrize(("count", "wide", "high"), [(1, 1, 1), (2, 2, 1), (3, 3, 1), (4, 3, 2), (6, 3, 2), (7, 3, 3)])
def test_heat_maps_stand_in_rows_of_three(count: int, wide: int, high: int) -> None:
    maps = [HeatMap(f"m{k}", ["5 m"], ["0°", "90°"], {}) for k in range(count)]
    text = heat_maps(maps, label="l")
    size = re.search(r'viewBox="0 0 (\d+) (\d+)"', text)
    assert size is not None
    width, height = int(size[1]) // wide, int(size[2]) // high
    names = re.findall(r'<text x="(\d+)" y="(\d+)" class="name">m(\d+)<', text)
    left, top = int(names[0][0]), int(names[0][1])
    assert [((int(x) - left) / width, (int(y) - top) / height) for x, y, _ in names] == [
        (k % 3, k // 3) for k in range(count)
    ]


@pytest.mark.data
def test_the_papers_tables_are_as_the_paper_has_them(data_dir: Path) -> None:
    sources = sorted((data_dir.parent / "paper").glob("*.txt"))
    if not sources:
        pytest.skip("the paper's source is not beside the data folder")
    text = sources[0].read_text()
    for town, label in (("Town04", "physical1"), ("Town03", "physical2")):
        block = text[text.index(f"on {town} dataset") : text.index(f"label{{{label}}}")]
        rows = re.findall(r"(Benign|Random|Adv\. Patch|DAS|TPA)\}?&([\d.\-&]+)\\\\", block)
        names = list(PHYSICAL[town])
        assert len(rows) == len(names) == 6
        for name, (head, numbers) in zip(names, rows, strict=True):
            assert name.startswith(head)
            told = [None if value == "-" else float(value) for value in numbers.split("&")]
            own = PHYSICAL[town][name]
            assert told == [*own["YoloV5"], *own["YoloV3"]]
