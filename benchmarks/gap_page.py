"""Write docs/results/gap.md, and its figure, from stored runs: python -m benchmarks.gap_page [NAME=DIR...]

    python -m benchmarks.gap_page benign=runs/gap-benign damage=runs/gap-damage confirm=... signs=... speed=FILE.json
    python -m benchmarks.gap_page --pick runs/gap-damage        # keys of drives worth a replay

With folders that `ssad run benchmarks/gap-benign.yaml`, gap-damage.yaml and `ssad run gap-signs` wrote, what the page
needs of them is stored first, in benchmarks/results/gap; without any, the page is made of what is stored. NAME+=DIR
adds to what is stored: conditions that were driven in DIR take the place of the stored ones. `confirm` is
gap-damage again on other drives, with the two conditions that were singled out; `speed`: of closed_loop_speed.py.

`--pick` names, for the perturbation with AP halved whose collision rate surely moved least and for the one that brought
most collisions with a small fall of AP, drives that show it: those that lost most AP without a collision, and those
whose collision is not there in the clean drive, first if it goes with the repaired error.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from benchmarks.provenance import origin, warning
from ssad.drivers.perceiving.system import PerceivingSystem
from ssad.experiments.gap.page import (
    COLOURS,
    Condition,
    cause_table,
    change,
    conditions,
    drop_table,
    family_of_line,
    rank_table,
    sign_table,
    values,
)
from ssad.metrics import CaseValue, estimate, paired_difference
from ssad.report.load import Run, load_run
from ssad.report.tables import Cell, Row, Table, to_markdown

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "gap"
FIGURE = ROOT / "docs" / "images" / "gap.png"
RUNS = ("benign", "damage", "confirm", "signs")
HALVED, SMALL = 0.5, 0.1  # falls of AP, as shares of the clean one
UNCHANGED = 0.03  # CR within which an interval must lie
KEPT = (
    "case",
    "cause",
    "cluster",
    "family",
    "group",
    "key",
    "perturbation",
    "reason",
    "repaired",
    "severity",
    "status",
    "system",
)
MEASURED = (
    "AP",
    "recall",
    "missed_burst",
    "distance_share",
    "target_recall",
    "believed",
    "phantoms",
    "collision",
    "route_completion",
    "min_ttc",
    "hard_braking",
    "impact_speed",
    "HOTA",
    "stop_signs",
    "sign_recall",
    "sign_recall_5_20",
    "sign_recall_20_40",
    "sign_read_at",
)
CEILING = "line-of-sight"
NATURAL = ("Twinford", "Crossgate")  # groups of the sets of natural traffic
COLUMNS = (
    ("AP", "AP", "bounded"),
    ("target_recall", "recall of the object that matters", "bounded"),
    ("HOTA", "HOTA", "bounded"),
    ("collision", "CR", "share"),
    ("route_completion", "RC", "bounded"),
)


def keep(name: str, folder: Path, *, add: bool = False) -> None:
    """Store what the page needs of a run, alone or with the conditions that are stored and were not driven in it."""
    run, old = load_run(folder), stored(name) if add else None
    RESULTS.mkdir(parents=True, exist_ok=True)
    again = set(map(_condition, run.lines))
    lines = [json.dumps(line) for line in (old.lines if old else ()) if _condition(line) not in again]
    for line in run.lines:
        told = {key: line[key] for key in KEPT if line.get(key) is not None}
        told["metrics"] = {key: (line.get("metrics") or {}).get(key) for key in MEASURED}
        lines.append(json.dumps(told | {"spec": {"repetition": line["spec"].get("repetition", 0)}}))
    about = {key: value for key, value in run.header.items() if key != "cells"}
    # slices of one suite have all its cells planned; of unlike suites nobody knows more than was driven
    about["cells"] = max(run.planned, old.planned if old else 0, len(lines))
    about["runs"] = 1 + (old.header.get("runs", 1) if old else 0)
    about["devices"] = list(dict.fromkeys([*(_devices(old) if old else ()), *_devices(run)]))
    about["command"] = (old or run).command
    (RESULTS / f"{name}.json").write_text(json.dumps(about, indent=1) + "\n")
    (RESULTS / f"{name}.jsonl.gz").write_bytes(gzip.compress("\n".join(lines).encode(), mtime=0))


def _devices(run: Run) -> list[str]:
    """What a run, or those that are stored together, were driven on."""
    return run.header.get("devices") or [(run.header.get("versions") or {}).get("device") or "an unknown device"]


def _condition(line: Mapping[str, Any]) -> Condition:
    return str(line["system"]), str(line["perturbation"]), int(line["severity"])


def stored(name: str) -> Run | None:
    """A run that was stored; None: there is none."""
    path = RESULTS / f"{name}.json"
    if not path.is_file():
        return None
    header = json.loads(path.read_text())
    lines = gzip.decompress(path.with_suffix(".jsonl.gz").read_bytes()).decode().splitlines()
    return Run(RESULTS, header, tuple(json.loads(line) for line in lines), {}, int(header["cells"]))


def part(run: Run, groups: Iterable[str], *, within: bool = True) -> Run:
    """The drives of some groups of scenarios, or all others."""
    chosen = set(groups)
    return replace(run, lines=tuple(line for line in run.lines if (line["group"] in chosen) == within))


def lost_share(run: Run, condition: Condition) -> float:
    """Which share of the clean AP is lost, over drives where both were measured."""
    clean = _by_drive(run, (condition[0], "none", 0))
    pairs = [
        (clean[drive]["metrics"]["AP"], line["metrics"]["AP"])
        for drive, line in _by_drive(run, condition).items()
        if drive in clean and None not in (clean[drive]["metrics"].get("AP"), line["metrics"].get("AP"))
    ]
    before, after = (sum(pair[k] for pair in pairs) for k in (0, 1))
    return 1.0 - after / before if before else math.nan


def mostly_driven(run: Run) -> list[Condition]:
    """The perturbed conditions of which more than half of the drives are there: fewer single nothing out."""
    every = conditions(run)
    most = max(map(len, every.values()), default=0)
    return [c for c, lines in every.items() if c[2] and len(lines) > most / 2]


def fewer(run: Run) -> str:
    """A sentence on the perturbed conditions that lack drives; "" if none does."""
    every = conditions(run)
    most = max(map(len, every.values()), default=0)
    several = len({c[0] for c in every if c[2]}) > 1
    short = [
        f"`{c[1]}` {c[2]}{f' ({c[0]})' if several else ''}: {len(lines)}"
        for c, lines in every.items()
        if c[2] and len(lines) < most
    ]
    return f" With fewer than {most} drives: {', '.join(short)}." if short else ""


def harmless(run: Run) -> Condition | None:
    """Of the conditions that halve AP, the one whose collision rate surely moved least; None: there is none."""
    halving = [c for c in mostly_driven(run) if lost_share(run, c) >= HALVED]
    return min(halving, key=lambda c: _most(change(run, c, "collision")), default=None)


def harmful(run: Run) -> Condition | None:
    """Of the conditions with a small fall of AP, the one with the largest rise of the collision rate."""
    mild = [c for c in mostly_driven(run) if lost_share(run, c) <= SMALL]
    return max(mild, key=lambda c: change(run, c, "collision").mean, default=None)


def picked(run: Run, most: int = 2) -> list[str]:
    """Lines that name the two conditions, each after #, and under each the keys of drives that show it."""
    found = []
    for condition, crash in ((harmless(run), False), (harmful(run), True)):
        if condition is None:
            continue
        found.append(f"# {condition[1]} {condition[2]}: {_damage(run, condition)}")
        fit: list[tuple[bool, float, str]] = []
        clean = _by_drive(run, (condition[0], "none", 0))
        for drive, line in _by_drive(run, condition).items():
            before, now = clean[drive]["metrics"] if drive in clean else {}, line["metrics"]
            if before.get("AP") is None or now.get("AP") is None or before["collision"]:
                continue
            if bool(now["collision"]) == crash:
                gone = crash and not (line.get("repaired") or {"same": True})["same"]
                fit.append((gone, 0.0 if crash else before["AP"] - now["AP"], str(line["key"])))
        found += [key for *_, key in sorted(fit, key=lambda one: one[:2], reverse=True)[:most]]
    return found


def benign_table(run: Run, title: str) -> Table:
    """Systems without perturbations, beside the line of sight."""
    every = conditions(run)
    ceiling = every[CEILING, "none", 0]
    rows = []
    for (system, name, _), lines in every.items():
        if name == "none":
            cells = [_cell(lines, key, kind) for key, _, kind in COLUMNS]
            rows.append(Row((system,), (*cells, against(lines, ceiling, "collision"))))
    heads = (*(head for _, head, _ in COLUMNS), "CR less line of sight")
    return Table("benign", title, ("System",), heads, tuple(rows))


def failing_table(run: Run) -> Table:
    """How detectors fail, in what a perfect one takes to fail alike; what no line tells is left out."""
    told = {
        key: head
        for key, head in (("missed_burst", "`burst`"), ("distance_share", "`noise`"), ("phantoms", "`phantoms`"))
        if any(line["metrics"].get(key) is not None for line in run.lines)
    }
    rows = []
    for (system, name, _), lines in conditions(run).items():
        if name == "none" and any(line["metrics"].get("recall") is not None for line in lines):
            found = _cell(lines, "recall", "bounded")
            missed = replace(found, mean=1.0 - found.mean, low=1.0 - found.high, high=1.0 - found.low)
            rows.append(Row((system,), (missed, *(_cell(lines, key, "mean") for key in told))))
    heads = ("`missed`", *told.values())
    return Table("failing", "How detectors fail, as settings of a perfect one", ("System",), heads, tuple(rows))


def against(lines: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]], name: str) -> Cell:
    """What a metric is more than in the same drives of others."""
    kind: Literal["share", "mean"] = "share" if name == "collision" else "mean"
    return Cell.of(paired_difference(values(lines, name), values(others, name), kind=kind))


def figure(run: Run, path: Path) -> None:
    """AP lost against collision rate gained, a point a condition, with 95 % intervals; some are named."""
    from matplotlib.figure import Figure

    colour = dict(zip(COLOURS, ("#d1495b", "#2e6fb7", "#7b4bb3", "#3c8d40", "#c98a1b"), strict=True))
    family = {line["perturbation"]: family_of_line(line) for line in run.lines}
    told = [(c, lost_share(run, c), change(run, c, "collision")) for c in conditions(run) if c[2]]
    told = [one for one in told if not math.isnan(one[1]) and not math.isnan(one[2].mean)]
    drawing = Figure(figsize=(7.6, 5.2), layout="constrained")
    axes = drawing.add_subplot()
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.axhspan(-UNCHANGED, UNCHANGED, color="0.92", zorder=0)
    axes.axvline(HALVED, color="0.75", linewidth=0.8, linestyle=":")
    for kind, shade in colour.items():
        own = [(lost, rise) for (_, name, _), lost, rise in told if family[name] == kind]
        if own:
            axes.errorbar(
                [lost for lost, _ in own],
                [rise.mean for _, rise in own],
                yerr=[[rise.mean - rise.low for _, rise in own], [rise.high - rise.mean for _, rise in own]],
                fmt="o",
                color=shade,
                label=kind,
                markersize=4.5,
                elinewidth=0.7,
                alpha=0.85,
            )
    for (_, name, severity), lost, rise in _outstanding(run, told):
        text = f"{name.removeprefix('wear-').removesuffix('-yolov5n-twinford')} {severity}"
        left = lost > 0.75
        axes.annotate(
            text,
            (lost, rise.mean),
            xytext=(-6 if left else 6, 5),
            textcoords="offset points",
            fontsize=8,
            ha="right" if left else "left",
        )
    axes.set_xlabel("share of the AP that is lost, on the pictures of the drives")
    axes.set_ylabel("rise of the collision rate, in the same drives")
    axes.legend(frameon=False, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    drawing.savefig(path, dpi=130)


def _outstanding(run: Run, told: Sequence[tuple[Condition, float, Cell]]) -> list[tuple[Condition, float, Cell]]:
    """The two that were singled out, and those at the edges, as far as there is room for their names."""
    wanted = [harmless(run), harmful(run)]
    numbers = [(lost, rise.mean, lost - 2.0 * rise.mean) for _, lost, rise in told]
    for k in range(3):
        order = sorted(range(len(told)), key=lambda n: numbers[n][k])
        wanted += [told[n][0] for n in (*order[:2], *order[-2:])]
    tall = max((rise.mean for *_, rise in told), default=1.0) - min((rise.mean for *_, rise in told), default=0.0)
    found: list[tuple[Condition, float, Cell]] = []
    for one in (one for name in dict.fromkeys(wanted) for one in told if one[0] == name):
        near = (abs(one[1] - lost) < 0.2 and abs(one[2].mean - rise.mean) < 0.06 * tall for _, lost, rise in found)
        if not any(near):
            found.append(one)
    return found


def page() -> list[str]:
    """Lines of Markdown of what is stored."""
    runs = {name: run for name in RUNS if (run := stored(name)) is not None}
    lines: list[str] = []
    for name, write in (("benign", _benign), ("damage", _damages), ("confirm", _confirmed), ("signs", _signs)):
        if name in runs:
            lines += ["", *write(runs[name], runs)]
    return lines + _speed() or ["", "No run is stored yet."]


def _benign(run: Run, runs: Mapping[str, Run]) -> list[str]:
    natural, crash = part(run, NATURAL), part(run, NATURAL, within=False)
    lines = ["### Without perturbations", "", _measured(run), ""]
    for title, own in (("Natural traffic", natural), ("Pre-crash scenarios", crash)):
        if own.lines:
            lines += [_smaller(benign_table(own, title)), ""]
    return [*lines, _smaller(failing_table(run)), "", _smaller(cause_table(run))]


def _damages(run: Run, runs: Mapping[str, Run]) -> list[str]:
    every = conditions(run)
    under = [c for c in every if c[2]]
    return [
        "### Damage to the component and to the system",
        "",
        f"{_measured(run)} {len(under)} conditions of {len({c[1] for c in under})} perturbations.{fewer(run)}",
        "",
        f"![Share of AP lost against rise of the collision rate](../images/{FIGURE.name})",
        "",
        _smaller(rank_table(run)),
        "",
        *_examples(run),
        "",
        _smaller(drop_table(run)),
        "",
        _smaller(cause_table(run)),
    ]


def _examples(run: Run) -> list[str]:
    """The two that break the rule, or that there is none."""
    lines = []
    for condition, what in (
        (harmless(run), "Of the conditions that take half of the AP and more, the collision rate moves least under "),
        (harmful(run), "Of those that take a tenth of it at the most, the collision rate rises most under "),
    ):
        if condition is None:
            lines.append(f"* {what.partition(',')[0]} there is none.")
            continue
        rise = change(run, condition, "collision")
        if condition == harmless(run):
            inside = _most(rise) <= UNCHANGED
            verdict = f"the interval {'lies' if inside else 'does not lie'} inside ±{UNCHANGED:g}"
        else:
            verdict = f"the interval {'excludes' if rise.low > 0.0 else 'does not exclude'} 0"
        again = [line["repaired"] for line in conditions(run)[condition] if line.get("repaired")]
        gone = sum(not one["same"] for one in again)
        repaired = f" Of its {len(again)} collisions {gone} go with that one error repaired." if again else ""
        lines.append(f"* {what}`{condition[1]}` {condition[2]}: {_damage(run, condition)}; {verdict}.{repaired}")
    return lines


def _confirmed(run: Run, runs: Mapping[str, Run]) -> list[str]:
    rows = [f"* `{c[1]}` {c[2]}: {_damage(run, c)}." for c in conditions(run) if c[2]]
    return ["### The two again, in drives that had no part in choosing them", "", _measured(run), "", *rows]


def _signs(run: Run, runs: Mapping[str, Run]) -> list[str]:
    return ["### Stop signs that are read", "", _measured(run) + fewer(run), "", _smaller(sign_table(run))]


def _speed() -> list[str]:
    path = RESULTS / "speed.json"
    if not path.is_file():
        return []
    told = json.loads(path.read_text())
    lines = ["", "### Speed of the loop", "", f"{told['device']}, `benchmarks/closed_loop_speed.py`:", ""]
    lines += [
        "| detector | cameras | scenes | looks a second | times real time, all at once | pictures/s |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for case in told["cases"]:
        speed = case["scenes"] * case["cameras"] * case["rate"] * case["simulated s"] / case["wall s"]
        lines.append(
            f"| {case['detector']} | {case['cameras']} | {case['scenes']} | {case['rate']:g} | "
            f"{case['times real time, all scenes at once']} | {speed:,.0f} |"
        )
    return lines


def _measured(run: Run) -> str:
    """What was run, on what, and how much of it."""
    failed = sum(line["status"] != "ok" for line in run.lines)
    drives = len({line["cluster"] for line in run.lines})
    in_runs = f" in {runs} runs" if (runs := run.header.get("runs", 1)) > 1 else ""
    return (
        f"`{run.command}`{in_runs}, {len(run.lines):,} of {run.planned:,} drives on {' and '.join(_devices(run))}"
        f"{f', {failed} of them failed' if failed else ''}, {drives} scenarios."
        f" {origin(run.header)}"
        f"{f' {outside}' if (outside := warning(run.header)) else ''}"
        f"{f' **Driven with earlier weights of {old}.**' if (old := ' and '.join(outdated(run))) else ''}"
    )


def outdated(run: Run) -> list[str]:
    """Detectors whose shipped weights are others than those that drove."""
    told = run.header.get("systems", {})
    systems = map(PerceivingSystem.model_validate, run.header["suite"].get("systems", ()))
    return sorted({one.detector for one in systems if one.version != told.get(one.name, one.version)})


def _damage(run: Run, condition: Condition) -> str:
    rise, driven, more = (change(run, condition, name) for name in ("collision", "route_completion", "phantoms"))
    phantoms = "" if math.isnan(more.mean) else f", phantoms a look {more.mean:+.2f} {more.interval}"
    return (
        f"{lost_share(run, condition):.0%} of the AP{phantoms}, CR {rise.mean:+.3f} {rise.interval}, "
        f"RC {driven.mean:+.3f} {driven.interval} ({rise.count})"
    )


def _smaller(table: Table) -> str:
    """A table as a part of the page: its title one level deeper."""
    return to_markdown(table).replace("## ", "#### ", 1).rstrip()


def _cell(lines: Sequence[Mapping[str, Any]], name: str, kind: str) -> Cell:
    found: list[CaseValue] = list(values(lines, name).values())
    return Cell.of(estimate(found, kind))  # type: ignore[arg-type]


def _most(cell: Cell) -> float:
    ends = [abs(one) for one in (cell.low, cell.high) if not math.isnan(one)]
    return max(ends, default=math.inf)


def _by_drive(run: Run, condition: Condition) -> dict[str, Mapping[str, Any]]:
    lines = conditions(run).get(condition, [])
    return {str(line["cluster"]): line for line in lines if line["status"] == "ok"}


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pick", type=Path, metavar="DIR")
    parser.add_argument("runs", nargs="*", metavar="NAME=DIR")
    args = parser.parse_args()
    if args.pick:
        print("\n".join(picked(load_run(args.pick))))
        return
    from benchmarks.insert import insert

    for given in args.runs:
        name, _, path = given.partition("=")
        add = name.endswith("+")
        name = name.removesuffix("+")
        if name == "speed":
            RESULTS.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, RESULTS / "speed.json")
        elif name in RUNS:
            keep(name, Path(path), add=add)
        else:
            raise SystemExit(f"{given}: expected NAME=DIR with a name of {', '.join((*RUNS, 'speed'))}")
    damage = stored("damage")
    if damage is not None:
        figure(damage, FIGURE)
    insert("results/gap.md", "results", page())


if __name__ == "__main__":
    main()
