"""Page of an adversarial run: generators on equal terms, against random search, and their collisions from above."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2

from ssad.core.errors import SSADError
from ssad.core.folders import path_inside
from ssad.core.lane_graph import load_graph, town_file
from ssad.core.traces import load_trace
from ssad.experiments.adversarial.collision_view import draw_collision
from ssad.metrics import CaseValue, estimate
from ssad.metrics.intervals import MIN_ROUTES
from ssad.metrics.uncertainty import Kind, paired_difference
from ssad.report.default import result_table
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import NATURAL, SOURCE
from ssad.report.records import Line, field, metric_of, scenario_of
from ssad.report.tables import METHODS, Table, TableCell, TableRow

TEMPLATE = Path(__file__).with_name("page.html")

RANDOM, ADVERSARIES = "random", "adv-ppo-paper"
SUMMARY = {
    "survived": "survive plain replay",
    "proven": "proven",
    "CR_any": "raw CR",
    "CR": "CR, lawful",
    "rollouts": "rollouts to the first",
    "moving": "ego moves",
}
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
PROOF = (
    "Proven: survived bases in which a collision is found that a careful driver avoids, while the ego moves, with the "
    "adversary on its lawful side, within its vehicle's limits and touching nobody else. Raw CR: any collision with an "
    "adversary."
)
VIEWS = 24
SEARCH = {"Generator": field("generator"), "System": field("system")}


def section(run: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page of a run and its tables."""
    table_builders = (
        main_table,
        careful_table,
        budget_table,
        against_table,
        partial(group_table, metric="proven"),
        group_table,
        traffic_table,
        transfer_table,
    )
    tables = [table for table in (build_table(run) for build_table in table_builders) if table]
    failures = [
        ([str(line["generator"]), str(line["system"]), scenario_of(line)], line["status"], line["reason"])
        for line in run.failures
    ]
    return render(TEMPLATE, run, verdict=verdict, tables=tables, failures=failures, views=collision_views(run)), tables


def summary(run: Run) -> Table:
    """Return the table for the terminal."""
    full_table = main_table(run)
    positions = {str(column["name"]): index for index, column in enumerate(run.header["columns"])}
    rows = tuple(
        replace(
            row,
            cells=tuple(
                # A run of an earlier version has columns fewer; what it has not measured is n/a.
                row.cells[positions[name]] if name in positions else TableCell.value(None)
                for name in SUMMARY
            ),
        )
        for row in full_table.rows
    )
    return replace(full_table, columns=tuple(SUMMARY.values()), rows=rows, note=PROOF)


def main_table(run: Run) -> Table:
    """Return every column over all bases, by generator and system."""
    full_table = result_table(run, ("generator", "system"))
    note = (
        f"Over the base scenarios that the system survives in plain replay, {run.suite.get('budget')} rollouts each. "
        f"{PROOF} {METHODS}"
    )
    return replace(full_table, name="adversarial", title="Generators on equal terms", note=note)


def careful_table(run: Run) -> Table | None:
    """Return how avoidable and how hard the collisions are; None if none was graded."""
    if all(math.isnan(metric_of(line, "attributable")) for line in run.lines):
        return None
    return Table.pivot(
        "careful",
        "Could it have been avoided?",
        run.lines,
        rows=SEARCH,
        columns=GRADES,
        metric=lambda lines, name: _mean(
            lines, partial(metric_of, name=name), "mean" if "speed" in name else "bounded"
        ),
        note="Of the saved collisions of each base in which one was found. Careful drivers "
        "(docs/explanation/careful-drivers.md) take the wheel when the danger begins; a collision that one of them "
        "avoids is attributable to the system. Who has stopped is often hit all the same: see the columns with the "
        f"ego moving. {METHODS}",
    )


def transfer_table(run: Run) -> Table | None:
    """Return the CR of other systems in the saved scenarios, against the bases; None if none was transferred."""

    def metric(drives: Sequence[tuple[Line, str]], column: str) -> TableCell:
        with_adversary, base = (
            {str(line["key"]): _case_value(line, float(line["transfer"][system][condition])) for line, system in drives}
            for condition in ("found", "base")
        )
        if column == "difference":
            return TableCell.of(paired_difference(with_adversary, base, min_clusters=MIN_ROUTES))
        return TableCell.of(
            estimate((with_adversary if column == "found" else base).values(), "bounded", min_clusters=MIN_ROUTES)
        )

    table = Table.pivot(
        "transfer",
        "Transfer",
        [(line, system) for line in _by_search(run) for system in line.get("transfer") or ()],
        rows={
            "Generator": lambda drive: drive[0]["generator"],
            "System": lambda drive: drive[0]["system"],
            "Driven by": lambda drive: drive[1],
        },
        columns={"found": "CR in what was found", "base": "CR in the bases", "difference": "difference"},
        metric=metric,
        note="The saved scenarios of each base in which a collision was found against the system, driven by another "
        f"one; the difference is paired by base. {METHODS}",
    )
    return table if table.rows else None


def budget_table(run: Run) -> Table:
    """Return the CR within parts of the budget."""
    budget = int(run.suite.get("budget", 1))
    rollout_limits = sorted({max(1, round(budget * fraction)) for fraction in (0.125, 0.25, 0.5, 1.0)})
    return Table.pivot(
        "budget",
        "CR by rollouts spent",
        run.lines,
        rows=SEARCH,
        columns={count: f"CR within {count}" for count in rollout_limits},
        metric=lambda lines, count: _mean(lines, partial(_has_found_within, max_rollouts=count), "share"),
        note=METHODS,
    )


def against_table(run: Run) -> Table | None:
    """Return the share of proven collisions and the CR of each generator minus those of random search, by base."""
    random_lines = {system: lines for (generator, system), lines in _searches(run).items() if generator == RANDOM}

    def metric(lines: Sequence[Line], name: str) -> TableCell:
        search_pair = (lines, random_lines[str(lines[0]["system"])])
        if any(not _measured(search_lines, name) for search_lines in search_pair):
            return TableCell.value(None)
        generator_cases, random_cases = (
            {
                f"{scenario_of(line)}#{line['spec']['repetition']}": _case_value(line, metric_of(line, name))
                for line in search_lines
                if line["status"] != "ok" or not math.isnan(metric_of(line, name))
            }
            for search_lines in search_pair
        )
        return TableCell.of(paired_difference(generator_cases, random_cases, kind="share", min_clusters=MIN_ROUTES))

    table = Table.pivot(
        "against_random",
        "Against random search",
        [line for line in run.lines if str(line["generator"]) != RANDOM and str(line["system"]) in random_lines],
        rows=SEARCH,
        columns={"proven": "difference of proven", "CR": "difference of CR"},
        metric=metric,
        note="Shares of the generator minus those of random search in the same base scenarios with the same seeds. "
        f"CR: with the adversary on its side of the road and hitting nobody else. {METHODS}",
    )
    return table if table.rows else None


def group_table(run: Run, metric: str = "CR") -> Table | None:
    """Return a rate by group of base scenarios; None for proven collisions that no search of the run has measured."""
    if metric == "proven" and not _measured(run.lines, metric):
        return None
    return Table.pivot(
        "groups" if metric == "CR" else f"{metric}_groups",
        "CR by group" if metric == "CR" else "Proven collisions by group",
        run.lines,
        rows=SEARCH,
        columns={line["group"]: str(line["group"]) for line in run.lines},
        metric=lambda lines, group: _mean(
            [line for line in lines if line["group"] == group], partial(metric_of, name=metric), "share"
        ),
        note=METHODS if metric == "CR" else f"{PROOF} {METHODS}",
    )


def traffic_table(run: Run) -> Table | None:
    """Return systems in natural traffic and among Adv.PPO's adversaries by town, the paper's rows below."""
    natural_lines = [
        line
        for line in _by_search(run)
        if line["generator"] == ADVERSARIES and line["spec"].get("scenario", {}).get("type") == "NaturalJunction"
    ]
    if not natural_lines:
        return None

    def metric(drives: Sequence[tuple[Line, str]], column: str) -> TableCell:
        collided = {str(line["key"]): 1.0 - metric_of(line, "survived") for line, _ in drives}
        natural_cases = {str(line["key"]): _case_value(line, collided[str(line["key"])]) for line, _ in drives}
        adversarial = {
            str(line["key"]): _case_value(line, max(collided[str(line["key"])], _has_found(line))) for line, _ in drives
        }
        among_adversaries = drives[0][1] == "Adv.PPO"
        if column == "CR":
            return TableCell.of(
                estimate(
                    (adversarial if among_adversaries else natural_cases).values(), "share", min_clusters=MIN_ROUTES
                )
            )
        return (
            TableCell.of(paired_difference(adversarial, natural_cases, kind="share", min_clusters=MIN_ROUTES))
            if among_adversaries
            else TableCell.value(None)
        )

    return Table.pivot(
        "traffic",
        "Natural and adversarial traffic",
        [(line, traffic) for line in natural_lines for traffic in ("natural", "Adv.PPO")],
        rows={
            "System": lambda drive: drive[0]["system"],
            "Traffic": lambda drive: drive[1],
            "Town": lambda drive: drive[0]["spec"]["scenario"]["town"],
        },
        columns={"CR": "CR", "increase": "more than in natural traffic"},
        metric=metric,
        footer_rows=[
            TableRow.of_published((system, "natural" if traffic == "Autopilot" else traffic, town), (rate, None))
            for (system, traffic), by_town in NATURAL.items()
            for town, (rate, _, _) in by_town.items()
        ],
        note="Any collision with an adversary counts, wherever the adversary is. Where a system collides in natural "
        "traffic no adversary was tried; it counts as colliding among them, too. Shaded rows: "
        f"{SOURCE}. {METHODS}",
        source=SOURCE,
    )


def _has_found(line: Line) -> float:
    """Return whether any collision with an adversary was found; 0 where none was tried, NaN where the cell failed."""
    if line["status"] != "ok":
        return math.nan
    return float(bool((line["metrics"] or {}).get("CR_any")))


def collision_views(run: Run) -> list[dict[str, str]]:
    """Return collisions from above, one of each generator and group in turn: data URI, caption, command."""
    lines_by_group: dict[tuple[str, str, str], Line] = {}
    for line in run.lines:
        if "trace" in (line.get("artefacts") or {}):
            lines_by_group.setdefault((str(line["generator"]), str(line["system"]), str(line["group"])), line)
    entries = []
    for (generator, system, _), line in list(lines_by_group.items())[:VIEWS]:
        try:
            trace = load_trace(path_inside(run.folder, line["artefacts"]["trace"]))
            graph = load_graph(run.folder / "towns" / town_file(trace.town))
        except SSADError:
            continue  # named on the page as missing or damaged
        image = draw_collision(trace, graph, [int(agent) for agent in line["adversaries"]])
        encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        caption = f"{generator} against {system} in {scenario_of(line)}"
        command = f"ssad run quick --set scenarios={run.folder / line['artefacts']['scenarios']} --set systems={system}"
        uri = f"data:image/png;base64,{base64.b64encode(encoded).decode()}"
        entries.append({"data": uri, "caption": caption, "command": command})
    return entries


def _measured(lines: Sequence[Line], name: str) -> bool:
    """Return True if a line has measured a metric."""
    return any(not math.isnan(metric_of(line, name)) for line in lines)


def _searches(run: Run) -> dict[tuple[str, str], list[Line]]:
    """Return the lines by generator and system."""
    searches: dict[tuple[str, str], list[Line]] = {}
    for line in run.lines:
        searches.setdefault((str(line["generator"]), str(line["system"])), []).append(line)
    return searches


def _by_search(run: Run) -> list[Line]:
    """Return the lines, those of a search one after another."""
    return [line for lines in _searches(run).values() for line in lines]


def _has_found_within(line: Line, max_rollouts: float = math.inf) -> float:
    """Return 1 if a search has found a collision within so many rollouts, else 0; NaN without a search."""
    metrics = line.get("metrics") or {}
    if line["status"] != "ok" or metrics.get("CR") is None:
        return math.nan
    return float(bool(metrics["CR"]) and metrics["rollouts"] <= max_rollouts)


def _mean(lines: Sequence[Line], value: Callable[[Line], float], kind: Kind) -> TableCell:
    """Return the mean of a value of searches, over their base scenarios."""
    return TableCell.of(estimate([_case_value(line, value(line)) for line in lines], kind, min_clusters=MIN_ROUTES))


def _case_value(line: Line, value: float) -> CaseValue:
    """Return a search as a case of its base scenario."""
    return CaseValue(value, str(line["cluster"]), str(line["key"]), failed=line["status"] != "ok")
