"""Page of an adversarial run: generators on equal terms, against random search, and their collisions from above."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2

from ssad.core.errors import SSADError
from ssad.core.lane_graph import load_graph, town_file
from ssad.core.traces import load_trace
from ssad.experiments.adversarial.collision_view import found_view
from ssad.metrics import CaseValue, estimate
from ssad.metrics.uncertainty import paired_difference
from ssad.report.default import result_table
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import NATURAL, SOURCE
from ssad.report.tables import METHODS, Cell, Row, Table

TEMPLATE = Path(__file__).with_name("page.html")

RANDOM, ADVERSARIES = "random", "adv-ppo"
SUMMARY = ("survived", "CR", "rollouts", "distinct", "moving", "attributable")
GRADES = {
    "moving": "ego moves",
    "avoided_by_cc": "CC avoids",
    "avoided_by_reg157": "Reg157 avoids",
    "avoided_by_rss": "RSS avoids",
    "avoided_by_fsm": "FSM avoids",
    "attributable": "any of these avoids",
    "attributable_moving": "the same, ego moves",
    "avoided_by_limit": "a manoeuvre avoids",
    "impact_speed": "impact speed, m/s",
}
NOTE = "CR: survived bases in which a collision is found; avoidable: of the saved collisions, by a careful driver"
VIEWS = 24
Line = Mapping[str, Any]


def section(run: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page of a run and its tables."""
    table_builders = main_table, careful_table, budget_table, against_table, group_table, traffic_table, transfer_table
    tables = [table for table in (build_table(run) for build_table in table_builders) if table]
    failures = [
        ([str(line.get(name, "")) for name in ("generator", "system", "cluster")], line["status"], line["reason"])
        for line in run.failures
    ]
    return render(TEMPLATE, run, verdict=verdict, tables=tables, failures=failures, views=views(run)), tables


def summary(run: Run) -> Table:
    """Return the table for the terminal."""
    full_table = main_table(run)
    column_indices = [index for index, column in enumerate(run.header["columns"]) if column["name"] in SUMMARY]
    rows = tuple(replace(row, cells=tuple(row.cells[index] for index in column_indices)) for row in full_table.rows)
    columns = "survive plain replay", "CR", "rollouts to the first", "distinct", "ego moves", "avoidable"
    return replace(full_table, columns=columns, rows=rows, note=NOTE)


def main_table(run: Run) -> Table:
    """Return every column over all bases, by generator and system."""
    full_table = result_table(replace(run, header={**run.header, "factors": ["generator", "system"]}))
    note = (
        f"Over the base scenarios that the system survives in plain replay, {run.suite.get('budget')} rollouts each. "
        f"{METHODS}"
    )
    return replace(full_table, name="adversarial", title="Generators on equal terms", note=note)


def careful_table(run: Run) -> Table | None:
    """Return how avoidable and how hard the collisions are; None if none was graded."""
    rows = []
    for row_head, lines in _searches(run).items():
        cells = [
            Cell.of(
                estimate([_case(line, _metric(line, name)) for line in lines], "mean" if "speed" in name else "bounded")
            )
            for name in GRADES
        ]
        rows.append(Row(row_head, tuple(cells)))
    if all(math.isnan(_metric(line, "attributable")) for line in run.lines):
        return None
    note = (
        "Of the saved collisions of each base in which one was found. Careful drivers "
        "(docs/explanation/careful-drivers.md) take the wheel when the danger begins; "
        "a collision that one of them avoids is attributable to the system. Who has stopped is "
        f"often hit all the same: see the columns with the ego moving. {METHODS}"
    )
    heads = ("Generator", "System")
    return Table("careful", "Could it have been avoided?", heads, tuple(GRADES.values()), tuple(rows), note)


def transfer_table(run: Run) -> Table | None:
    """Return the CR of other systems in the saved scenarios, against the bases; None if none was transferred."""
    rows = []
    for row_head, lines in _searches(run).items():
        transferred = [line for line in lines if line.get("transfer")]
        for system in dict.fromkeys(name for line in transferred for name in line["transfer"]):
            with_adversary, base = (
                {str(line["key"]): _case(line, float(line["transfer"][system][condition])) for line in transferred}
                for condition in ("found", "base")
            )
            difference = Cell.of(paired_difference(with_adversary, base))
            rates = [Cell.of(estimate(list(condition.values()), "bounded")) for condition in (with_adversary, base)]
            rows.append(Row((*row_head, system), (*rates, difference)))
    if not rows:
        return None
    note = (
        "The saved scenarios of each base in which a collision was found against the system, driven by another one; "
        f"the difference is paired by base. {METHODS}"
    )
    columns = "CR in what was found", "CR in the bases", "difference"
    return Table("transfer", "Transfer", ("Generator", "System", "Driven by"), columns, tuple(rows), note)


def budget_table(run: Run) -> Table:
    """Return the CR within parts of the budget."""
    budget = int(run.suite.get("budget", 1))
    rollout_limits = sorted({max(1, round(budget * share)) for share in (0.125, 0.25, 0.5, 1.0)})
    rows = []
    for row_head, lines in _searches(run).items():
        cells = []
        for rollout_limit in rollout_limits:
            cases = [_case(line, _within(line, rollout_limit)) for line in lines]
            cells.append(Cell.of(estimate(cases, "share")))
        rows.append(Row(row_head, tuple(cells)))
    columns = tuple(f"CR within {count}" for count in rollout_limits)
    return Table("budget", "CR by rollouts spent", ("Generator", "System"), columns, tuple(rows), METHODS)


def against_table(run: Run) -> Table | None:
    """Return the CR of each generator minus that of random search, over the same bases."""
    searches = _searches(run)
    rows = []
    for (generator, system), lines in searches.items():
        random_lines = searches.get((RANDOM, system))
        if random_lines is None or generator == RANDOM:
            continue
        generator_cases, random_cases = (
            {
                f"{line['cluster']}#{line['spec']['repetition']}": _case(line, _within(line))
                for line in search_lines
                if line["status"] != "ok" or not math.isnan(_within(line))
            }
            for search_lines in (lines, random_lines)
        )
        rows.append(
            Row((generator, system), (Cell.of(paired_difference(generator_cases, random_cases, kind="share")),))
        )
    if not rows:
        return None
    note = f"CR of the generator minus that of random search in the same base scenarios with the same seeds. {METHODS}"
    heads = ("Generator", "System")
    return Table("against_random", "Against random search", heads, ("difference of CR",), tuple(rows), note)


def group_table(run: Run) -> Table:
    """Return the CR by group of base scenarios."""
    groups = list(dict.fromkeys(str(line["group"]) for line in run.lines))
    rows = []
    for row_head, lines in _searches(run).items():
        cells = [
            Cell.of(estimate([_case(line, _within(line)) for line in lines if line["group"] == group], "share"))
            for group in groups
        ]
        rows.append(Row(row_head, tuple(cells)))
    return Table("groups", "CR by group", ("Generator", "System"), tuple(groups), tuple(rows), METHODS)


def traffic_table(run: Run) -> Table | None:
    """Return systems in natural traffic and among Adv.PPO's adversaries by town, the paper's rows below."""
    rows = []
    for (generator, system), lines in _searches(run).items():
        natural = [line for line in lines if line["spec"].get("scenario", {}).get("type") == "NaturalJunction"]
        if generator != ADVERSARIES:
            continue
        for town in dict.fromkeys(str(line["spec"]["scenario"]["town"]) for line in natural):
            town_lines = [line for line in natural if line["spec"]["scenario"]["town"] == town]
            natural_cases = {str(line["key"]): _case(line, 1.0 - _metric(line, "survived")) for line in town_lines}
            adversarial_cases = {
                str(line["key"]): _case(line, max(1.0 - _metric(line, "survived"), _found(line))) for line in town_lines
            }
            increase = paired_difference(adversarial_cases, natural_cases, kind="share")
            for traffic, cases, difference in (
                ("natural", natural_cases, None),
                ("Adv.PPO", adversarial_cases, increase),
            ):
                cells = (
                    Cell.of(estimate(cases.values(), "share")),
                    Cell.of(difference) if difference else Cell(math.nan),
                )
                rows.append(Row((system, traffic, town), cells))
    if not rows:
        return None
    for (system, traffic), by_town in NATURAL.items():
        for town, (rate, _, _) in by_town.items():
            traffic_name = "natural" if traffic == "Autopilot" else traffic
            rows.append(Row((system, traffic_name, town), (Cell(rate), Cell(math.nan)), published=True))
    note = (
        "Any collision with an adversary counts, wherever the adversary is. Where a system collides in natural traffic "
        f"no adversary was tried; it counts as colliding among them, too. Shaded rows: {SOURCE}. {METHODS}"
    )
    heads = ("System", "Traffic", "Town")
    columns = ("CR", "more than in natural traffic")
    return Table("traffic", "Natural and adversarial traffic", heads, columns, tuple(rows), note, SOURCE)


def _found(line: Line) -> float:
    """Return whether any collision with an adversary was found; 0 where none was tried, NaN where the cell failed."""
    if line["status"] != "ok":
        return math.nan
    return float(bool((line["metrics"] or {}).get("CR_any")))


def views(run: Run) -> list[dict[str, str]]:
    """Return collisions from above, one of each generator and group in turn: data URI, caption, command."""
    lines_by_group: dict[tuple[str, str, str], Line] = {}
    for line in run.lines:
        if "trace" in (line.get("artefacts") or {}):
            lines_by_group.setdefault((str(line["generator"]), str(line["system"]), str(line["group"])), line)
    entries = []
    for (generator, system, _), line in list(lines_by_group.items())[:VIEWS]:
        try:
            trace = load_trace(run.folder / line["artefacts"]["trace"])
            graph = load_graph(run.folder / "towns" / town_file(trace.town))
        except SSADError:
            continue  # named on the page as missing or damaged
        picture = found_view(trace, graph, [int(agent) for agent in line["adversaries"]])
        encoded = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()
        caption = f"{generator} against {system} in {line['cluster']}"
        command = f"ssad run quick --set scenarios={run.folder / line['artefacts']['scenarios']} --set systems={system}"
        uri = f"data:image/png;base64,{base64.b64encode(encoded).decode()}"
        entries.append({"data": uri, "caption": caption, "command": command})
    return entries


def _searches(run: Run) -> dict[tuple[str, str], list[Line]]:
    """Return the lines by generator and system."""
    searches: dict[tuple[str, str], list[Line]] = {}
    for line in run.lines:
        searches.setdefault((str(line["generator"]), str(line["system"])), []).append(line)
    return searches


def _within(line: Line, most: float = math.inf) -> float:
    """Whether a search has found a collision within so many rollouts; NaN: nothing to search, or it failed."""
    metrics = line.get("metrics") or {}
    if line["status"] != "ok" or metrics.get("CR") is None:
        return math.nan
    return float(bool(metrics["CR"]) and metrics["rollouts"] <= most)


def _metric(line: Line, name: str) -> float:
    """Return a metric of a line; NaN if it was not measured."""
    value = (line.get("metrics") or {}).get(name)
    return math.nan if value is None else float(value)


def _case(line: Line, value: float) -> CaseValue:
    """Return a search as a case of its base scenario."""
    return CaseValue(value, str(line["cluster"]), str(line["key"]), failed=line["status"] != "ok")
