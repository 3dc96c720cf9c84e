"""Tables of what generators found, from runs of suite `adversarial`: into docs/results, between markers.

    ssad run adversarial --out RUN ...
    python -m benchmarks.adversarial_page NAME=RUN,RUN ...  # keeps the records' metrics in benchmarks/results
    python -m benchmarks.adversarial_page NAME+=RUN ...     # adds them to what is kept; what ran again replaces it
    python -m benchmarks.adversarial_page                   # the tables anew from what is kept

Each base scenario is a case; of natural traffic each route is a cluster. In brackets the 95 % interval. The run named
`whole` is the suite as it is: its section is put into the page when it is kept, also if not all of it has run.
"""

from __future__ import annotations

import gzip
import json
import re
import sys
from itertools import product
from math import isfinite
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.metrics import CaseValue, estimate, paired_difference

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "adversarial"
DOCUMENT = ROOT / "docs" / "results" / "generators.md"
LEARNED = ROOT / "docs" / "results" / "learned-adversaries.md"
COLUMNS = {
    "CR": "CR",
    "CR_any": "any collision",
    "off_road": "adversary off the road",
    "hit_others": "in others",
    "moving": "ego moves",
    "impact_speed": "impact, m/s",
    "avoided_by_reg157": "R157 avoids",
    "avoided_by_cc": "CC",
    "avoided_by_rss": "RSS",
    "avoided_by_fsm": "FSM",
    "avoided_by_limit": "a manoeuvre",
    "attributable": "any careful driver",
    "within_limits": "within limits",
    "realism": "realism",
    "seconds": "CPU s a base",
}
"""Metric of a record -> head of its column."""
OF_ALL = (
    "CR",
    "off_road",
    "hit_others",
    "moving",
    "impact_speed",
    "avoided_by_reg157",
    "avoided_by_cc",
    "avoided_by_rss",
    "avoided_by_fsm",
    "avoided_by_limit",
    "attributable",
    "distinct",
    "within_limits",
    "realism",
    "seconds",
)
"""Columns of the tables of all generators, where bases have many rollouts."""
HEADS = COLUMNS | {"CR": "CR within the budget", "distinct": "distinct"}
SECTION = """### All generators
`ssad run adversarial`, `python -m benchmarks.adversarial_page whole=runs/adversarial`. All meet the same bases \
with the same budget and the same seeds. CR: share of the bases that the system survives in plain replay in \
which a collision was found with the adversary on the road and in nobody else; less random's: over the bases \
that both were tried on, paired. Who avoids a collision is told of those that were saved, three a base at most, \
and happen again. `adv-ppo`, `frea` and `adv-ddpg` have one rollout a base. "found" in the tables of transfer: \
how often another system collides in what was found against this one, less how often it collides in the same \
bases.

<!-- whole: begin -->
<!-- whole: end -->

"""
WHOLE = "whole"
BEFORE = "### Searches that learn against random points"
WITH_LIMITS = ("CR", "avoided_by_reg157", "attributable")


def cluster(name: str) -> str:
    """A scenario, or the route of one with random traffic."""
    return re.sub(r"^(natural[\w-]*/\w+)/\d+$", r"\1", name)


def keep(name: str, runs: list[Path], *, add: bool = False) -> None:
    """The metrics of the records of runs with the same settings, without what cannot be shown.

    add: To those that are kept, in place of those of the same searches.
    """
    known = (*dict.fromkeys((*COLUMNS, *OF_ALL)), "applies", "survived")
    rows: list[dict[str, Any]] = []
    for line in "".join((run / "results.jsonl").read_text(encoding="utf-8") for run in runs).splitlines():
        record = json.loads(line)
        row = {"generator": record["generator"], "system": record["system"], "base": record["cluster"]}
        if record["status"] != "ok":
            rows.append(row | {"failed": record["reason"]})
            continue
        metrics = {k: float(v) for k, v in record["metrics"].items() if k in known and v is not None}
        for other, hits in record.get("transfer", {}).items():
            metrics[f"{other}: found"], metrics[f"{other}: base"] = hits["found"], hits["base"]
        rows.append(row | {k: round(v, 3) for k, v in metrics.items()})
    headers = [json.loads((run / "run.json").read_text(encoding="utf-8")) for run in runs]
    suites = [header["suite"] for header in headers]
    about = {key: suites[0][key] for key in ("scenarios", "budget", "keep")}
    if any({key: suite[key] for key in about} != about for suite in suites):
        raise ValueError(f"{name}: runs of unlike settings")
    about["systems"] = list(dict.fromkeys(name for suite in suites for name in suite["systems"]))
    about["planned"] = sum(len(header["cells"]) for header in headers)
    if add and (kept := next(RESULTS.glob(f"{name}.json*"), None)):
        before = stored(kept)
        if any(before[key] != about[key] for key in ("scenarios", "budget", "keep")):
            raise ValueError(f"{name}: the runs are of other settings than what is kept")
        about["systems"] = list(dict.fromkeys([*before["systems"], *about["systems"]]))
        about["planned"] = before["planned"]
        rows = list(
            {tuple(row[k] for k in ("generator", "system", "base")): row for row in before["rows"] + rows}.values()
        )
    about["columns"] = list(dict.fromkeys(key for row in rows for key in row))
    about["rows"] = [[row.get(key) for key in about["columns"]] for row in rows]
    text = json.dumps(about, separators=(",", ":")) + "\n"
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.json").unlink(missing_ok=True)
    (RESULTS / f"{name}.json.gz").write_bytes(gzip.compress(text.encode(), mtime=0))


def stored(path: Path) -> dict[str, Any]:
    """What was kept, its rows by column."""
    data: dict[str, Any]
    if path.suffix == ".json":
        data = json.loads(path.read_text(encoding="utf-8"))
        return data
    data = json.loads(gzip.decompress(path.read_bytes()))
    rows = [dict(zip(data["columns"], row, strict=True)) for row in data["rows"]]
    return data | {"rows": [{k: v for k, v in row.items() if v is not None} for row in rows]}


def cases(rows: list[dict[str, Any]], key: str) -> dict[str, CaseValue]:
    """Values of a metric by base."""
    return {row["base"]: CaseValue(row[key], cluster(row["base"]), row["base"]) for row in rows if key in row}


def shown(values: dict[str, CaseValue], key: str, kind: Literal["share", "bounded"] = "bounded") -> str:
    """A mean, for some metrics with its interval and number of cases."""
    if not values:
        return ""
    mean = sum(case.value for case in values.values()) / len(values)
    if key not in WITH_LIMITS:
        return f"{mean:.2f}"
    found = estimate(values.values(), kind)
    return f"{found.mean:.2f}" + (f" [{found.low:.2f}, {found.high:.2f}]" if isfinite(found.low) else "")


def tables(data: dict[str, Any]) -> list[str]:
    """A table for each system, and differences between FREA and Adv.PPO where both are."""
    lines = []
    for system in data["systems"]:
        rows = [row for row in data["rows"] if row["system"] == system and "failed" not in row]
        names = list(dict.fromkeys(row["generator"] for row in rows))
        lines += [f"`{system}`, {', '.join(data['scenarios'])}, {data['budget']} rollouts:", ""]
        lines += ["| | survived bases | " + " | ".join(COLUMNS.values()) + " |", "|---|---:|" + "---|" * len(COLUMNS)]
        known = {}
        for name in names:
            own = known[name] = alive(rows, name)
            cells = [shown(cases(own, key), key) for key in COLUMNS]
            lines.append(f"| `{name}` | {len(own)} | {' | '.join(cells)} |")
        lines.append("")
        if data["budget"] == data["keep"] == 1:
            lines += [text for name in names if (line := by_motion(name, known[name])) for text in (line, "")]
        if {"adv-ppo", "frea"} <= set(names):
            for key in ("avoided_by_reg157", "attributable"):
                both = [cases(known[name], key) for name in ("frea", "adv-ppo")]
                mean, low, high = difference(*both)
                counts = " and ".join(f"{len(group)} collisions" for group in both)
                lines.append(
                    f"`frea` less `adv-ppo`, {COLUMNS[key]}: {mean:+.2f} [{low:+.2f}, {high:+.2f}] ({counts})."
                )
            lines.append("")
    return lines


def whole_tables(data: dict[str, Any]) -> list[str]:
    """Of the whole suite: in words; then a table for each system and kind of bases, and one of transfer."""
    rows = [row for row in data["rows"] if "failed" not in row]
    lines: list[str] = []
    said: list[str] = []
    if len(data["rows"]) < data["planned"]:
        lines += [f"{len(data['rows']):,} of {data['planned']:,} searches have run; what is missing is not shown.", ""]
    if len(rows) < len(data["rows"]):
        lines += [f"{len(data['rows']) - len(rows)} searches failed.", ""]
    for system, natural in product(data["systems"], (False, True)):
        own = [row for row in rows if row["system"] == system and row["base"].startswith("natural") == natural]
        if not own:
            continue
        tried = {row["base"]: row["survived"] for row in own}
        lines += [
            f"`{system}`, {'natural traffic' if natural else 'pre-crash scenarios'}, {data['budget']} rollouts; it "
            f"survives {int(sum(tried.values()))} of {len(tried)} bases in plain replay:",
            "",
            f"| | bases | {HEADS[OF_ALL[0]]} | CR, less random's | {' | '.join(HEADS[key] for key in OF_ALL[1:])} |",
            "|---|---:|" + "---|" * (len(OF_ALL) + 1),
        ]
        by_name = {name: alive(own, name) for name in dict.fromkeys(row["generator"] for row in own)}
        usual = cases(by_name.get("random", []), "CR")
        said.append(verdict(f"`{system}`, {'natural traffic' if natural else 'pre-crash scenarios'}", by_name, usual))
        for name, group in by_name.items():
            less = "" if name == "random" else paired(cases(group, "CR"), usual, "share")
            shares = [shown(cases(group, key), key, "share" if key == "CR" else "bounded") for key in OF_ALL]
            lines.append(f"| `{name}` | {len(group)} | {' | '.join([shares[0], less, *shares[1:]])} |")
        lines += ["", *transfer(system, by_name)]
    return [*(text for text in said if text), "", *lines]


def verdict(where: str, by_name: dict[str, list[dict[str, Any]]], usual: dict[str, CaseValue]) -> str:
    """What the table of a system and a kind of bases says, in words; nothing if there is nothing to search."""
    shares = {name: sum(own) / len(own) for name, rows in by_name.items() if (own := hits(rows))}
    if not any(shares.values()) or "random" not in shares:
        return ""
    groups: dict[str, list[str]] = {"More": [], "Less": [], "No difference that is sure": []}
    for name in sorted(shares, key=lambda name: -shares[name]):
        both = {base: case for base, case in cases(by_name[name], "CR").items() if base in usual}
        if name == "random" or not both:
            continue
        found = paired_difference(both, usual, kind="share")
        sure = found.method == "beta" and found.low * found.high > 0.0
        group = ("More" if found.mean > 0.0 else "Less") if sure else "No difference that is sure"
        groups[group].append(f"`{name}` {shares[name]:.2f}")
    parts = [f" {group}: {', '.join(names)}." for group, names in groups.items() if names]
    first = f"* {where}: random search finds a collision in {shares['random']:.2f} of the bases."
    return f"{first}{''.join(parts)} {careful(by_name, shares)}".rstrip()


def hits(rows: list[dict[str, Any]]) -> list[float]:
    """Of each base, whether a collision was found."""
    return [row["CR"] for row in rows if "CR" in row]


def careful(by_name: dict[str, list[dict[str, Any]]], shares: dict[str, float]) -> str:
    """Who avoids what random search and the generator that finds most have found."""
    best = max(shares, key=lambda name: shares[name])
    parts = []
    for name in dict.fromkeys(("random", best)):
        avoided, ways = (cases(by_name[name], key) for key in ("avoided_by_reg157", "avoided_by_limit"))
        moving = cases(by_name[name], "moving")
        if len(avoided) >= 5 and ways and moving:
            mean = [sum(case.value for case in group.values()) / len(group) for group in (avoided, ways, moving)]
            parts.append(
                f"{mean[0]:.2f} of `{name}`'s collisions ({mean[1]:.2f} by some manoeuvre; "
                f"the ego moves in {mean[2]:.2f})"
            )
    return f"The careful driver of UN Regulation 157 avoids {' and '.join(parts)}." if parts else ""


def alive(rows: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """The searches of a generator that had something to change in a base that the system survives."""
    return [row for row in rows if row["generator"] == name and row.get("survived") and row.get("applies")]


def paired(first: dict[str, CaseValue], second: dict[str, CaseValue], kind: Literal["share", "mean"] = "mean") -> str:
    """Difference over the cases that both have, with its interval."""
    if not first.keys() & second.keys():
        return ""
    found = paired_difference(first, second, kind=kind)
    return f"{found.mean:+.2f}" + (f" [{found.low:+.2f}, {found.high:+.2f}]" if isfinite(found.low) else "")


def transfer(system: str, by_name: dict[str, list[dict[str, Any]]]) -> list[str]:
    """How often other systems collide in what was found, less how often in the bases."""
    others = dict.fromkeys(
        key.removesuffix(": found") for rows in by_name.values() for row in rows for key in row if key.endswith("found")
    )
    others.pop(system, None)
    if not others:
        return []
    lines = [
        f"Found against `{system}`, driven by others:",
        "",
        f"| | bases | {' | '.join(f'`{name}`' for name in others)} |",
        "|---|---:|" + "---|" * len(others),
    ]
    for name, rows in by_name.items():
        found = [row for row in rows if any(f"{other}: found" in row for other in others)]
        if found:
            shares = [paired(cases(found, f"{o}: found"), cases(found, f"{o}: base")) for o in others]
            lines.append(f"| `{name}` | {len(found)} | {' | '.join(shares)} |")
    return [*lines, ""]


def by_motion(name: str, rows: list[dict[str, Any]]) -> str:
    """What R157 avoids where the ego moves and where it stands, of one collision a base."""
    key, parts = "avoided_by_reg157", []
    for moving, what in ((1.0, "the ego moves"), (0.0, "it stands")):
        own = cases([row for row in rows if row.get("moving") == moving], key)
        if len(own) >= 5:
            parts.append(f"{shown(own, key)} of the {len(own)} graded collisions in which {what}")
    return f"`{name}`: R157 avoids {' and '.join(parts)}." if parts else ""


def difference(first: dict[str, CaseValue], second: dict[str, CaseValue]) -> tuple[float, float, float]:
    """Difference of two means over different cases of the same clusters, and its limits by resampling the clusters."""
    names = sorted({case.cluster for case in (*first.values(), *second.values())})
    place = {name: k for k, name in enumerate(names)}
    sums = np.zeros((2, 2, len(names)))  # of each group: values, cases
    for group, values in enumerate((first, second)):
        for case in values.values():
            sums[group, :, place[case.cluster]] += case.value, 1.0

    def means(weights: F64) -> F64:
        total = sums @ weights.T  # [2, 2, n]
        with np.errstate(invalid="ignore"):
            return np.asarray(total[0, 0] / total[0, 1] - total[1, 0] / total[1, 1])

    draws = generator("difference of groups").multinomial(len(names), np.full(len(names), 1 / len(names)), 4000)
    low, high = np.nanquantile(means(draws.astype(np.float64)), (0.025, 0.975)) if names else (np.nan, np.nan)
    return float(means(np.ones((1, len(names))))[0]), float(low), float(high)


def main() -> None:
    """Keep what is given, and write all tables that are kept and have a place."""
    for word in sys.argv[1:]:
        name, _, runs = word.partition("=")
        keep(name.removesuffix("+"), [Path(run) for run in runs.split(",")], add=name.endswith("+"))
    for document in (DOCUMENT, LEARNED):
        before = document.read_text(encoding="utf-8")
        after = filled(before, with_section=document == DOCUMENT)
        if after != before:
            document.write_text(after, encoding="utf-8")


def filled(whole: str, *, with_section: bool) -> str:
    """Return a page with the stored tables between its markers; with_section: a section for `WHOLE` is added."""
    for path in sorted(RESULTS.glob("*.json*")):
        name = path.name.partition(".")[0]
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        if with_section and name == WHOLE and begin not in whole:
            whole = whole.replace(BEFORE, SECTION + BEFORE)
        if begin in whole:
            lines = (whole_tables if name == WHOLE else tables)(stored(path))
            print("\n".join(lines))
            before, _, rest = whole.partition(begin)
            whole = "\n".join([before + begin, *lines, end + rest.partition(end)[2]])
    return whole


if __name__ == "__main__":
    main()
