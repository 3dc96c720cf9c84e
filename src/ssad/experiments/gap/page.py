"""The page of a gap run: component beside system, the damage to the one against that to the other, causes, pictures."""

from __future__ import annotations

import base64
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any, Literal

from ssad.core import safeio
from ssad.metrics import CaseValue, estimate, paired_difference
from ssad.metrics.rank import family_correlation
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.tables import METHODS, Cell, Row, Table

TEMPLATE = Path(__file__).with_name("page.html")

STEPS = re.compile(r"^(attack-.*)-[0-9]+$")  # attack-pgd-2 is of the family attack-pgd

Line = Mapping[str, Any]
Condition = tuple[str, str, int]
MAIN = {
    "AP": "AP",
    "target_recall": "recall of the object that matters",
    "believed": "believed",
    "phantoms": "phantoms a look",
    "collision": "CR",
    "route_completion": "RC",
    "min_ttc": "least TTC, s",
    "hard_braking": "hard braking",
}
DROPS = {
    "AP": "AP",
    "target_recall": "recall of the object that matters",
    "phantoms": "phantoms a look",
    "collision": "CR",
    "route_completion": "RC",
}
SIGNS = {
    "sign_recall_5_20": "read from 5 to 20 m",
    "sign_recall_20_40": "read from 20 to 40 m",
    "sign_read_at": "first read at, m",
    "stop_signs": "signs run",
}
BOUNDED = ("AP", "target_recall", "believed", "route_completion", "sign_recall_5_20", "sign_recall_20_40")
ROOM = (110.0, 13.0)  # pixels of a name in the figure
CAUSES = ("hidden", "missed", "misplaced", "late", "known")
SIZE, MARGIN = 360, 46
COLOURS = {
    "fault": "var(--s1)",
    "shift": "var(--s0)",
    "attack": "var(--s2)",
    "texture": "var(--s3)",
    "light": "var(--s4)",
}


def conditions(run: Run) -> dict[Condition, list[Line]]:
    """System, perturbation and severity -> its lines, in the order of the suite."""
    found: dict[Condition, list[Line]] = {}
    for line in run.lines:
        found.setdefault((line["system"], line["perturbation"], int(line["severity"])), []).append(line)
    return found


def summary(run: Run) -> Table:
    """The table that is shown on the terminal."""
    return replace(main_table(run), note="")


def section(run: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """The page and its tables."""
    main, drop, rank, cause, signs = (
        make(run) for make in (main_table, drop_table, rank_table, cause_table, sign_table)
    )
    tables = [main, drop, rank, cause, *([signs] if signs.rows else [])]
    failures = [
        ([line["system"], line["perturbation"], str(line["severity"]), line["cluster"]], line["reason"])
        for line in run.failures
    ]
    page = render(
        TEMPLATE,
        run,
        verdict=verdict,
        main=main,
        drop=drop,
        rank=rank,
        cause=cause,
        signs=signs,
        plot=scatter(run),
        failures=failures,
        sheets=sheets(run),
        systems=list(dict.fromkeys(c[0] for c in conditions(run))),
    )
    return page, tables


def main_table(run: Run) -> Table:
    """Component and system, a row a condition."""
    rows = []
    for (system, perturbation, severity), lines in conditions(run).items():
        head = (system, perturbation, str(severity) if severity else "")
        rows.append(Row(head, tuple(_cell(lines, name) for name in MAIN)))
    note = (
        "AP: all kinds of objects as one, the mean of those within 0.5, 1, 2 and 4 m, a drive at a time, on the "
        "pictures that the driver got in it. The object that matters is the one that the ego touches, else the one "
        "that it comes nearest to; its recall counts looks in which it is in view and found within 2 m; believed "
        "counts steps. CR: "
        "share of the drives with a collision. RC: share of the route completed. Hard braking: times above 4 m/s² a "
        f"drive. {METHODS}"
    )
    return Table(
        "gap", "Component and system", ("System", "Perturbation", "Severity"), tuple(MAIN.values()), tuple(rows), note
    )


def drop_table(run: Run) -> Table:
    """What a perturbation changes against the same drives without it."""
    rows = [
        Row(
            (system, perturbation, str(severity)),
            tuple(change(run, (system, perturbation, severity), n) for n in DROPS),
        )
        for system, perturbation, severity in conditions(run)
        if severity
    ]
    note = (
        "Perturbed less clean, in the same drives: below 0 it is lower under the perturbation. Without brackets: the "
        "range over the drives, where too few of them differ for an interval."
    )
    heads = ("System", "Perturbation", "Severity")
    return Table("changes", "What a perturbation changes", heads, tuple(DROPS.values()), tuple(rows), note)


def rank_table(run: Run) -> Table:
    """Does damage to the component tell the damage to the system?"""
    rows = []
    perturbed = [condition for condition in conditions(run) if condition[2]]
    for system in dict.fromkeys(condition[0] for condition in perturbed):
        own = [condition for condition in perturbed if condition[0] == system]
        families = [STEPS.sub(r"\1", condition[1]) for condition in own]
        for part in ("AP", "target_recall"):
            lost = [-change(run, c, part).mean for c in own]
            cells = []
            for name, sign in (("collision", 1.0), ("route_completion", -1.0)):
                harm = [sign * change(run, c, name).mean for c in own]
                cells.append(Cell.of(family_correlation(lost, harm, families)))
            rows.append(Row((system, DROPS[part], f"{len(own)} in {len(set(families))}"), tuple(cells)))
    note = (
        "Spearman's rank correlation over perturbations of what the component loses and what the system loses; 95 % "
        "interval by a bootstrap over the families of perturbations (all severities of one are one family, and "
        "so are all step counts of an attack), from five families on. n/a: one of the two does not vary."
    )
    heads = ("System", "Lost by the component", "Perturbations in families")
    return Table("rank", "Does the component's damage tell the system's?", heads, ("CR", "RC"), tuple(rows), note)


def cause_table(run: Run) -> Table:
    """What the object that was hit was to the driver before."""
    rows = []
    for (system, perturbation, severity), lines in conditions(run).items():
        found = [line["cause"] for line in lines if line.get("cause")]
        if not found:
            continue
        counts = Counter(one["cause"] for one in found)
        unknown = sorted(float(one["unknown_s"]) for one in found)
        middle = unknown[len(unknown) // 2]
        again = [line["repaired"] for line in lines if line.get("repaired")]
        gone = Cell(sum(not one["same"] for one in again), digits=0) if again else Cell(math.nan)
        numbers = [len(found), *(counts[name] for name in CAUSES)]
        cells = (*(Cell(number, digits=0) for number in numbers), Cell(middle), gone)
        rows.append(Row((system, perturbation, str(severity) if severity else ""), cells))
    note = (
        "Collisions by what the object that was hit was in most of the steps from 3 s to 0.5 s before: out of view or "
        "hidden; in view and not found; found more than 2 m from where it was; found, but not believed yet; believed "
        "where it was (then planning or prediction failed). Unknown: for how long before the contact it was not "
        "believed where it was, at most 3 s, the median. Gone when repaired: of these collisions, those that "
        "do not happen when the same drive is driven again with the object that was hit found where it is whenever it "
        "is in view, all else as it was: then this error alone decides."
    )
    heads = ("System", "Perturbation", "Severity")
    columns = ("collisions", *CAUSES, "unknown, s", "gone when repaired")
    return Table("causes", "Before a collision", heads, columns, tuple(rows), note)


def sign_table(run: Run) -> Table:
    """Stop signs, where drivers read them: from how far, and how many were run."""
    rows = [
        Row(
            (system, perturbation, str(severity) if severity else ""),
            (
                *(_cell(lines, name) for name in SIGNS),
                change(run, (system, perturbation, severity), "stop_signs") if severity else Cell(math.nan),
            ),
        )
        for (system, perturbation, severity), lines in conditions(run).items()
        if any((line.get("metrics") or {}).get("sign_recall") is not None for line in lines)
    ]
    note = (
        "Of the looks with a stop sign of the way ahead, those in which it was read; attacks on signs are made at 5 to "
        "20 m. Signs run: a drive. More than clean: the rise against the same drives without the perturbation."
    )
    heads = ("System", "Perturbation", "Severity")
    columns = (*SIGNS.values(), "more than clean")
    return Table("signs", "Stop signs that are read", heads, columns, tuple(rows), note)


def scatter(run: Run) -> str:
    """Fall of AP against rise of CR, a point a perturbation, with intervals; as SVG text, "" without perturbations."""
    points = [(c, change(run, c, "AP"), change(run, c, "collision")) for c in conditions(run) if c[2]]
    points = [(c, a, b) for c, a, b in points if not math.isnan(a.mean) and not math.isnan(b.mean)]
    if not points:
        return ""
    family = {line["perturbation"]: str(line.get("family", "")) for line in run.lines}
    left, right = _ends([-value for _, one, _ in points for value in (one.mean, one.low, one.high)])
    low, top = _ends([value for *_, one in points for value in (one.mean, one.low, one.high)])

    def x(value: float) -> float:
        return MARGIN + SIZE * (min(max(value, left), right) - left) / (right - left)

    def y(value: float) -> float:
        return 10 + SIZE * (top - min(max(value, low), top)) / (top - low)

    parts = []
    for share in _ticks(left, right):
        strong = ' style="stroke-width:2"' if share == 0.0 else ""
        parts.append(f'<line x1="{x(share):.1f}" x2="{x(share):.1f}" y1="10" y2="{SIZE + 10}" class="grid"{strong}/>')
        parts.append(f'<text x="{x(share):.1f}" y="{SIZE + 26}" text-anchor="middle">{share:g}</text>')
    for share in _ticks(low, top):
        strong = ' style="stroke-width:2"' if share == 0.0 else ""
        line = (
            f'<line x1="{MARGIN}" x2="{MARGIN + SIZE}" y1="{y(share):.1f}" y2="{y(share):.1f}" class="grid"{strong}/>'
        )
        parts.append(f'{line}<text x="{MARGIN - 6}" y="{y(share) + 4:.1f}" text-anchor="end">{share:g}</text>')
    named: list[tuple[float, float]] = []
    # of many points those get names first that are farthest from where both parts are hurt alike
    for (system, name, severity), fall, rise in sorted(points, key=lambda one: -abs(one[2].mean + one[1].mean)):
        colour, at, up = COLOURS.get(family.get(name, ""), "var(--s3)"), x(-fall.mean), y(rise.mean)
        for one, two in (((x(-fall.high), up), (x(-fall.low), up)), ((at, y(rise.low)), (at, y(rise.high)))):
            if not any(math.isnan(v) for v in (*one, *two)):
                style = 'stroke-dasharray="2 3"' if "range" in (fall.method, rise.method) else ""
                parts.append(
                    f'<line x1="{one[0]:.1f}" y1="{one[1]:.1f}" x2="{two[0]:.1f}" y2="{two[1]:.1f}" stroke="{colour}" '
                    f'opacity=".5" {style}/>'
                )
        tip = f"{system}, {name} {severity}: AP {fall.text}, CR {rise.text}, {rise.count}"
        parts.append(f'<circle cx="{at:.1f}" cy="{up:.1f}" r="4" fill="{colour}"><title>{escape(tip)}</title></circle>')
        if all(abs(at - other) > ROOM[0] or abs(up - above) > ROOM[1] for other, above in named):
            named.append((at, up))
            parts.append(f'<text x="{at + 7:.1f}" y="{up - 6:.1f}">{escape(f"{name} {severity}")}</text>')
    for row, kind in enumerate(dict.fromkeys(family.get(c[1], "") for c, _, _ in points)):
        place, colour = 22 + 16 * row, COLOURS.get(kind, "var(--s3)")
        parts.append(f'<circle cx="{MARGIN + SIZE + 64}" cy="{place}" r="5" fill="{colour}"/>')
        parts.append(f'<text x="{MARGIN + SIZE + 74}" y="{place + 4}">{escape(kind)}</text>')
    parts.append(f'<text x="{MARGIN + SIZE / 2}" y="{SIZE + 44}" text-anchor="middle">AP lost</text>')
    parts.append(
        f'<text x="12" y="{SIZE / 2}" transform="rotate(-90 12 {SIZE / 2})" text-anchor="middle">CR gained</text>'
    )
    label = "AP lost against collision rate gained, a point a perturbation"
    return (
        f'<svg viewBox="0 0 {SIZE + MARGIN + 140} {SIZE + 52}" role="img" aria-label="{label}">{"".join(parts)}</svg>'
    )


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Ends of an axis in tenths, with 0 and some room; of intervals there may be none."""
    known = [value for value in values if not math.isnan(value)]
    low, high = max(min(*known, 0.0) - 0.05, -1.0), min(max(*known, 0.1) + 0.05, 1.0)
    return math.floor(10.0 * low) / 10.0, math.ceil(10.0 * high) / 10.0


def _ticks(low: float, high: float) -> list[float]:
    """Numbers along an axis, of which one is 0."""
    step = 0.1 if high - low < 0.75 else 0.25
    return [round(k * step, 2) for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def sheets(run: Run) -> list[dict[str, str]]:
    """Sheets of drives as the suite asks: collisions first, no condition twice before each has been shown."""
    most = int(run.suite.get("sheets", 0))
    shown: Counter[Condition] = Counter()
    chosen: list[tuple[int, int, Line, str]] = []
    for line in sorted(run.lines, key=lambda line: not (line.get("metrics") or {}).get("collision")):
        path = (line.get("artefacts") or {}).get("sheet")
        if path and (run.folder / path).is_file():
            condition = (line["system"], line["perturbation"], int(line["severity"]))
            shown[condition] += 1
            chosen.append((shown[condition], len(chosen), line, path))
    found = []
    for _, _, line, path in sorted(chosen, key=lambda one: one[:2])[:most]:
        data = base64.b64encode(safeio.read_bytes(run.folder / path)).decode()
        cause = (line.get("cause") or {}).get("cause", "")
        under = f"{line['perturbation']} {line['severity']}" if line["severity"] else "clean"
        end = str(line.get("end", "")).replace("_", " ")
        caption = f"{line['system']}, {line['cluster']}, {under}: {end}{f' ({cause})' if cause else ''}"
        found.append({"caption": caption, "data": f"data:image/jpeg;base64,{data}", "key": str(line["key"])})
    return found


def values(lines: Sequence[Line], name: str) -> dict[str, CaseValue]:
    """A metric by drive: scenario and repetition."""
    found = {}
    for line in lines:
        value = (line.get("metrics") or {}).get(name) if line["status"] == "ok" else None
        cluster = str(line.get("cluster") or line["key"])
        case = f"{line.get('case') or line['key']}"
        number = math.nan if value is None else float(value)
        key = f"{cluster}#{line['spec'].get('repetition', 0)}"
        found[key] = CaseValue(number, cluster, case, failed=line["status"] != "ok")
    return found


def _cell(lines: Sequence[Line], name: str) -> Cell:
    found = values(lines, name).values()
    if name == "collision":
        return Cell.of(estimate(found, "share"))
    return Cell.of(estimate(found, "bounded" if name in BOUNDED else "mean"))


def change(run: Run, condition: Condition, name: str) -> Cell:
    """What a condition changes in a metric against the same drives without it.

    Drives that the condition does not have, such as those without a car that could wear a texture, do not count.
    """
    every = conditions(run)
    own, clean = values(every[condition], name), values(every.get((condition[0], "none", 0), []), name)
    kind: Literal["share", "mean"] = "share" if name == "collision" else "mean"
    return Cell.of(paired_difference(own, {drive: clean[drive] for drive in own if drive in clean}, kind=kind))
