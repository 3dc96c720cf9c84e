"""Page of a physical run: textures on a car, the paper's two tables beside ours, controls, heat maps, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from ssad.experiments.perception.physical.approach_page import approach_figures, approach_tables
from ssad.experiments.perception.physical.physical_run import (
    CONTROLS,
    PhysicalRun,
    Shown,
    floor_of,
    is_control,
    learns_nothing,
    lower,
    score,
    title_of,
)
from ssad.metrics import replicate_difference
from ssad.metrics.attack_success import rate_note
from ssad.report.artefacts import pictures
from ssad.report.figures import HeatMap, heat_maps
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import PHYSICAL as PUBLISHED
from ssad.report.records import Line, field
from ssad.report.tables import Table, TableCell, TableRow

TEMPLATE = Path(__file__).with_name("page.html")

SOURCE = "published by the paper: CARLA, YoloV5 and YoloV3 fine-tuned there, a camera 20 m behind"
PAPER = {
    ("clean", ""): "Benign",
    ("random", "patch"): "Random patch",
    ("adv-patch", "patch"): "Adv. Patch",
    ("random", "camouflage"): "Random camouflage",
    ("das", "camouflage"): "DAS",
    ("tpa", "camouflage"): "TPA",
}
DETECTORS = {"yolov5": "YoloV5", "yolov3": "YoloV3"}  # how a detector's name begins -> its column in the paper
BESIDE = {"Oldmarket": "Town04", "Larkhill": "Town03"}  # town of a test -> the paper's that stands in its place
SCORES = {"AP50": "AP50", "AP50_25": "AP50 > 0.25", "ASR_25": "ASR", "ASR_any_25": "ASR, any class", "n0_25": "n0"}
OTHERS = {
    "ASR_50": "ASR at 0.5",
    "n0_50": "n0 at 0.5",
    "AP50_all": "AP50, whole class",
    "AP50_all_25": "AP50 > 0.25, whole class",
    "ASR_all_25": "ASR, whole class",
    "n0_all_25": "n0, whole class",
    "confidence": "mean score",
}
COLOURS = {"delta_e": "colour difference", "outside_gamut": "outside the gamut"}
VICTIM: dict[str, Callable[[tuple[str, str, tuple[str, str]]], str]] = {
    "Town": lambda row: row[0],
    "Detector": lambda row: row[1],
    "Attack": lambda row: title_of(row[2]),
}
"""Row factors of a town, a detector and an attack."""


def main_table(run: PhysicalRun, number: int) -> Table:
    """Return attack x detector in one pair of towns, as the paper's table, with its rows between ours."""
    train, test = run.pairs[number]
    published_town = (
        BESIDE.get(test, dict(enumerate(PUBLISHED)).get(number)) if run.run.suite.get("reference") else None
    )
    names = {
        detector: next((column for prefix, column in DETECTORS.items() if detector.startswith(prefix)), "")
        for detector in run.detectors
    }
    measured = {metric for line in run.run.lines for metric in line.get("metrics") or ()}
    scores = {metric: title for metric, title in SCORES.items() if metric in measured or metric != "ASR_any_25"}
    columns = {(d, metric): f"{d} {title}" for d in run.detectors for metric, title in scores.items()}

    def published(attack: tuple[str, str]) -> list[TableRow]:
        if not published_town or attack not in PAPER or not any(names.values()):
            return []
        cells = PUBLISHED[published_town][PAPER[attack]]
        published_scores = {
            (detector, metric): number
            for detector, name in names.items()
            for metric, number in zip(("AP50", "ASR_25"), cells.get(name, (None, None)), strict=True)
        }
        return [TableRow.of_published((f"{PAPER[attack]}, {published_town}",), map(published_scores.get, columns))]

    note = (
        f"Percent, of the target alone, {_place(run.run.suite)}. AP50 counts "
        "boxes of any score, AP50 > 0.25 those above it; ASR is the share of the targets found clean above 0.25 and "
        "not found attacked; any class: and no box of any class above 0.25 covers a quarter of them. "
        f"{rate_note(floor_of(run.run))} [a, b]: 95 % "
        "interval over drives, of several draws of a control from the lowest to the highest end of theirs; a–b: the "
        "range over the draws, where drives are too few for intervals."
    )
    if published_town:
        note += (
            f" Shaded rows: {SOURCE}, {published_town}. "
            "Other towns, pictures and detectors: what can be compared is the order."
        )
    return Table.listing(
        f"physical-{test.lower()}",
        f"Trained in {train}, tested in {test}",
        run.attacks,
        rows={"Attack": title_of},
        columns=columns,
        metric=lambda attack, column: score(run.lines(test, "drive", column[0], attack), column[1]),
        published=published,
        note=note,
        source=SOURCE,
    )


def _place(suite: Mapping[str, Any]) -> str:
    """Return the camera positions of a test, in words."""
    kind = str(suite.get("target", "")).partition(":")[0]
    distances = ", ".join(f"{distance:g}" for distance in suite.get("distances", ()))
    if kind == "stop_sign":
        return f"{distances} m before it, as cars see it"
    if kind == "pedestrian":
        return f"{distances} m from it on all sides, as cars see it"
    return f"from {float(suite['behind']):g} m behind it as it drives"


def margin_table(run: PhysicalRun) -> Table:
    """Return each trained texture against the draw of a control of its carrier that comes nearest to it."""
    nearest: dict[tuple[str, str, tuple[str, str]], tuple[TableCell, tuple[str, str]]] = {}
    for (_, test), detector, attack in product(run.pairs, run.detectors, run.attacks):
        name, carrier = attack
        attack_lines = [] if name == "clean" or is_control(name) else run.lines(test, "drive", detector, attack)
        controls = [control for control in run.attacks if control[1] == carrier and learns_nothing(control[0], name)]
        differences = [
            (paired_ap_difference(draw, line), control)
            for control, line in product(controls, attack_lines)
            for draw in run.lines(test, "drive", detector, control)
        ]
        if differences:
            nearest[test, detector, attack] = min(differences, key=lambda candidate: lower(candidate[0]))

    def metric(row: tuple[str, str, tuple[str, str]], column: str) -> TableCell:
        test, detector, attack = row
        difference, control = nearest[row]
        if column == "difference":
            return difference
        return score(run.lines(test, "drive", detector, attack if column == "attack" else control), "AP50")

    return Table.listing(
        "margins",
        "Attacks against controls",
        nearest,
        rows={
            **VICTIM,
            "Nearest control": lambda row: title_of(nearest[row][1]),
            "Proves": lambda row: "nothing" if lower(nearest[row][0]) <= 0.0 else "",
        },
        columns={"attack": "attack", "control": "control", "difference": "difference"},
        metric=metric,
        note="AP50 in percent. The difference is what a control leaves less what the attack leaves in the same "
        "pictures; its interval is of paired replicates of the bootstrap over drives. Of all controls and all their "
        "draws it is that with the least lower end; above 0 the attack is stronger than all that learns nothing, "
        "elsewhere it proves nothing.",
    )


def transfer_table(run: PhysicalRun) -> Table:
    """Return textures trained against one detector, shown to all; beside them the clean target and controls."""
    sources = list(dict.fromkeys(["", *run.detectors, *(attack_key[2] for *_, attack_key in run.records)]))

    def lines_of(row: tuple[str, Shown], judge: str) -> list[Line]:
        return run.records.get((row[0], "drive", judge, row[1]), [])

    rows: list[tuple[str, Shown]] = []
    for _, test in run.pairs:
        candidates = [(test, (*attack, source)) for attack, source in product(run.attacks, sources)]
        town_rows = [row for row in candidates if sum(bool(lines_of(row, judge)) for judge in run.judges) >= 2]
        rows += town_rows if any(source for _, (*_, source) in town_rows) else []
    return Table.listing(
        "transfer",
        "Transfer between detectors",
        rows,
        rows={
            "Town": lambda row: row[0],
            "Attack": lambda row: title_of(row[1][:2]),
            "Trained against": lambda row: row[1][2],
        },
        columns={judge: judge for judge in run.judges},
        metric=lambda row, judge: score([line for line in lines_of(row, judge) if line["status"] == "ok"], "AP50"),
        note="AP50 in percent of the target; n/a where the detector does not find the clean target often enough.",
    )


def others_table(run: PhysicalRun) -> Table:
    """Return the other scores: at a higher confidence, and of the whole class."""

    def metric(row: tuple[str, str, tuple[str, str]], name: str) -> TableCell:
        test, detector, attack = row
        lines = run.lines(test, "drive", detector, attack)
        if name in COLOURS:
            return _colour_number(lines, name)
        return score(lines, name)

    towns = [test for _, test in run.pairs]
    return Table.listing(
        "others",
        "Other scores",
        [
            (test, detector, attack)
            for test, detector, attack in product(towns, run.judges, run.attacks)
            if run.lines(test, "drive", detector, attack)
        ],
        rows=VICTIM,
        columns=OTHERS | COLOURS,
        metric=metric,
        note=f"Percent. {rate_note(floor_of(run.run))} The colour difference (CIE 1976) is the mean between a texture "
        "and the paint that it covers: 0 "
        "for the paint itself, 100 for white on black. Outside the gamut: share of the texels that no inks of the "
        "shipped characterisation give.",
    )


def _colour_number(lines: Sequence[Line], name: str) -> TableCell:
    """Return a number of the colours of a texture, the mean over draws of a control; shares in percent."""
    numbers = [float(line[name]) * (100.0 if name == "outside_gamut" else 1.0) for line in lines if _has(line, name)]
    return TableCell(math.fsum(numbers) / len(numbers)) if numbers else TableCell(math.nan)


def _has(line: Line, name: str) -> bool:
    return line.get(name) is not None


def grid_table(run: PhysicalRun) -> Table:
    """Return the scores over all views of the grid, and the cell in which an attack does least."""
    lines_by_row = {
        key: finished
        for key, lines in run.records.items()
        if key[1] == "grid" and (finished := [line for line in lines if line["status"] == "ok"])
    }

    def worst_cell(row: tuple[str, str, str, Shown]) -> tuple[float, float, float] | None:
        worst_cells = [line["worst"] for line in lines_by_row[row] if line["worst"]]
        return max(worst_cells, key=lambda candidate: candidate[2], default=None)

    def metric(row: tuple[str, str, str, Shown], name: str) -> TableCell:
        if name != "worst":
            return score(lines_by_row[row], name)
        worst = worst_cell(row)
        return TableCell.value(100 * worst[2] if worst else None)

    return Table.listing(
        "grid",
        "Views from all around",
        lines_by_row,
        rows={
            "Town": lambda row: row[0],
            "Detector": lambda row: row[2],
            "Attack": lambda row: title_of(row[3][:2]),
            "Trained against": lambda row: row[3][2] if row[3][2] != row[2] else "",
            "Worst cell": lambda row: f"{worst[0]:g} m, {worst[1]:g}°" if (worst := worst_cell(row)) else "",
        },
        columns={"AP50": "AP50", "ASR_25": "ASR", "n0_25": "n0", "worst": "AP50 in the worst cell"},
        metric=metric,
        note="Percent. The worst cell of distance and azimuth (0° is the front, 90° the left) is the one in which the "
        f"attack does least; of the clean pictures the one in which the detector does. {rate_note(floor_of(run.run))}",
    )


def comparison_table(run: PhysicalRun) -> Table:
    """In each town and view the strongest attack with a carrier beside each other one, with the paired difference."""
    pairs: list[tuple[Line, Line]] = []
    carriers = list(dict.fromkeys(carrier for _, carrier in run.attacks))
    for (_, test), view, detector, carrier in product(run.pairs, ("drive", "grid"), run.detectors, carriers):
        attack_lines = []
        for attack in run.attacks:
            lines = [] if is_control(attack[0]) else run.lines(test, view, detector, attack)
            if attack[1] == carrier and lines and lines[0]["source"] and lines[0].get("replicates"):
                attack_lines.append(lines[0])
        strongest = min(attack_lines, key=lambda line: line["metrics"]["AP50"], default={})
        pairs += [(strongest, line) for line in attack_lines if line is not strongest]

    def metric(pair: tuple[Line, Line], column: str) -> TableCell:
        strongest, other = pair
        if column == "difference":
            return paired_ap_difference(other, strongest)
        return score([strongest if column == "strongest" else other], "AP50")

    return Table.listing(
        "comparison",
        "Attacks against each other",
        pairs,
        rows={
            "Town": lambda pair: pair[1]["test"],
            "View": lambda pair: "all around" if pair[1].get("view") == "grid" else "behind",
            "Detector": lambda pair: pair[1]["detector"],
            "Strongest": lambda pair: title_of((pair[0]["attack"], pair[0]["carrier"])),
            "Other": lambda pair: title_of((pair[1]["attack"], pair[1]["carrier"])),
        },
        columns={"strongest": "strongest", "other": "other", "difference": "difference"},
        metric=metric,
        note="AP50 in percent. The difference is what the other leaves less what the strongest leaves in the same "
        "pictures. Its interval is of paired replicates of the bootstrap over drives, so it can exclude zero where the "
        "two intervals overlap: some drives are harder for both.",
    )


def paired_ap_difference(larger_record: Line, smaller_record: Line) -> TableCell:
    """Return the difference of the AP50 of two records in percent; its interval where both are of the same images."""
    difference, count, drives = (
        larger_record["metrics"]["AP50"] - smaller_record["metrics"]["AP50"],
        int(larger_record["n"]),
        int(larger_record["drives"]),
    )
    if (count, drives) != (smaller_record["n"], smaller_record["drives"]) or not (
        larger_record.get("replicates") and smaller_record.get("replicates")
    ):
        return TableCell(100.0 * difference)
    pairs = zip(*(line["replicates"]["AP50"] for line in (larger_record, smaller_record)), strict=False)
    return TableCell.of(
        replicate_difference(difference, [first - second for first, second in pairs], n=count, clusters=drives).scaled(
            100.0
        )
    )


def effort_table(run: PhysicalRun) -> Table:
    """Return how the textures were trained."""
    return Table.pivot(
        "effort",
        "Training",
        [
            line
            for line in run.run.lines
            if line["status"] == "ok" and "epochs" in line and line["attack"].split()[0] not in CONTROLS
        ],
        rows={
            "Town": field("train"),
            "Detector": field("source"),
            "Attack": lambda line: title_of((line["attack"], line["carrier"])),
        },
        columns={"epochs": "epochs", "loss_before": "loss in the first epoch", "loss_after": "in the last"},
        metric=lambda lines, name: TableCell(float(lines[-1][name])),
        note="The loss is ascended; means over the first and the last epoch, each picture with its own print and "
        "noise.",
    )


def maps(run: PhysicalRun) -> list[tuple[str, str]]:
    """For each town and detector: a title, and heat maps of the clean car beside the attacked one as SVG text."""
    return _drawn(run, _map, "AP50 by distance and azimuth")


def weather_maps(run: PhysicalRun) -> list[tuple[str, str]]:
    """Return the same by elevation and weather: shares of the views in which the target is found above 0.25."""
    return _drawn(run, _weather_map, "share of views in which the target is found, by elevation and weather")


def _drawn(run: PhysicalRun, draw: Callable[..., HeatMap], label: str) -> list[tuple[str, str]]:
    """Return for each town and detector a title, and the maps of the attacks that were tested on the grid."""
    entries = []
    for _, test in run.pairs:
        for detector in run.detectors:
            grid_lines = [(attack, run.lines(test, "grid", detector, attack)) for attack in run.attacks]
            heat_map_list = [
                _bracketed(draw(lines[0], title_of(attack), clean=attack[0] == "clean"), attack, grid_lines, draw)
                for attack, lines in grid_lines
                if lines
            ]
            if heat_map_list:
                entries.append(
                    (f"{detector}, {test}", heat_maps(heat_map_list, label=f"{label}, {detector} in {test}"))
                )
    return entries


def _bracketed(
    heat_map: HeatMap,
    attack: tuple[str, str],
    grid_lines: Sequence[tuple[tuple[str, str], list[Line]]],
    draw: Callable[..., HeatMap],
) -> HeatMap:
    """Return the map of an attack with brackets where a control of its carrier leaves no more: it proves nothing there.

    Maps of the clean target and of controls stay as they are.
    """
    name, carrier = attack
    if name == "clean" or is_control(name):
        return heat_map
    control_maps = [
        draw(line, "", clean=False)
        for (control, control_carrier), lines in grid_lines
        if control_carrier == carrier and learns_nothing(control, name)
        for line in lines
    ]
    unproven = set()
    for position, value in heat_map.values.items():
        controls = [control_map.values.get(position) for control_map in control_maps]
        if value is not None and any(control is not None and control <= value for control in controls):
            unproven.add(position)
    return replace(heat_map, bracketed=frozenset(unproven))


def _weather_map(line: Line, title: str, *, clean: bool) -> HeatMap:
    """Return the map of a record by elevation and weather."""
    hits: dict[tuple[str, str], list[bool]] = {}
    for _, _, elevation, weather, clean_scores, attacked_scores in line["views"]:
        hits.setdefault((f"{elevation:g}°", weather), []).append((clean_scores if clean else attacked_scores) > 0.25)
    rows, columns = (list(dict.fromkeys(position[axis] for position in hits)) for axis in (0, 1))
    values = {position: sum(views) / len(views) for position, views in hits.items()}
    tips = {position: f"{title}: {sum(views)} of {len(views)} views" for position, views in hits.items()}
    rows.sort(key=lambda text: float(text[:-1]))
    return HeatMap(title, rows, sorted(columns), values, None, tips)


def _map(line: Line, title: str, *, clean: bool) -> HeatMap:
    """Return the map of a record by distance and azimuth."""
    values: dict[tuple[str, str], float | None] = {}
    tips = {}
    for distance, azimuth, count, clean_scores, attacked_scores in line["cells"]:
        position = (f"{distance:g} m", f"{azimuth:g}°")
        values[position] = clean_scores if clean else attacked_scores
        attacked_text = "n/a" if attacked_scores is None else f"{100 * attacked_scores:.1f}"
        clean_text = "n/a" if clean_scores is None else f"{100 * clean_scores:.1f}"
        tips[position] = (
            f"{title}, {position[0]}, {position[1]}: AP50 clean "
            f"{clean_text}{'' if clean else f', attacked {attacked_text}'}, {count} views"
        )
    rows, columns = (list(dict.fromkeys(position[axis] for position in values)) for axis in (0, 1))
    worst_cell = line["worst"]
    marked = (f"{worst_cell[0]:g} m", f"{worst_cell[1]:g}°") if worst_cell else None
    return HeatMap(title, rows, columns, values, marked, tips)


def tiles(run: PhysicalRun) -> list[dict[str, Any]]:
    """Return for each attacked detector the clean AP50 and the strongest attack, in the first town."""
    _, test = run.pairs[0]
    entries = []
    for detector in run.detectors:
        scores = {attack: score(run.lines(test, "drive", detector, attack), "AP50") for attack in run.attacks}
        trained = {
            attack: cell
            for attack, cell in scores.items()
            if attack[0] != "clean" and attack[0].split()[0] not in CONTROLS and not math.isnan(cell.mean)
        }
        strongest = min(trained, key=lambda attack: trained[attack].mean, default=None)
        carrier = strongest[1] if strongest else ""
        # lights are compared with the clean images of their hour
        clean = next(
            (
                cell
                for (name, clean_carrier), cell in scores.items()
                if name == "clean" and f"{carrier}, ".startswith(f"{clean_carrier}, ")
            ),
            next((cell for (name, _), cell in scores.items() if name == "clean"), TableCell(math.nan)),
        )
        entries.append(
            {
                "name": detector,
                "town": test,
                "clean": clean,
                "worst": title_of(strongest) if strongest else "none has run",
                "left": trained[strongest] if strongest else TableCell(math.nan),
            }
        )
    return entries


def summary(stored_run: Run) -> Table:
    """Return the table for the terminal."""
    return replace(
        main_table(PhysicalRun(stored_run), 0), note=f"Percent, of the target alone. {rate_note(floor_of(stored_run))}"
    )


def section(stored_run: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page of a physical run and its tables."""
    run = PhysicalRun(stored_run)
    main_tables = [main_table(run, number) for number in range(len(run.pairs))]
    distance_tables = approach_tables(run)
    margin_rows, others, effort = margin_table(run), others_table(run), effort_table(run)
    further_tables = [table for table in (comparison_table(run), transfer_table(run), grid_table(run)) if table.rows]
    page = render(
        TEMPLATE,
        stored_run,
        verdict=verdict,
        figures=approach_figures(run),
        distances=distance_tables,
        main=main_tables,
        margins=margin_rows,
        further=further_tables,
        others=others,
        effort=effort,
        tiles=tiles(run),
        maps=maps(run),
        weathers=weather_maps(run),
        pictures=pictures(stored_run.folder),
        failures=[
            (
                line["test"],
                line["view"],
                line["detector"],
                title_of((line["attack"], line["carrier"])),
                line["source"],
                line.get("reason", ""),
            )
            for line in stored_run.failures
        ],
    )
    return page, [*distance_tables, *main_tables, margin_rows, *further_tables, others, effort]
