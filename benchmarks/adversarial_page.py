"""Tables of what generators found, from runs of suite `adversarial`: into docs/generators.md, between their markers.

    ssad run adversarial --out RUN ...
    python -m benchmarks.adversarial_page NAME=RUN,RUN ...  # keeps the records' metrics in benchmarks/results
    python -m benchmarks.adversarial_page                   # the tables anew from what is kept

Each base scenario is a case; of natural traffic each route is a cluster. In brackets the 95 % interval.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.metrics import CaseValue, estimate

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "adversarial"
DOCUMENT = ROOT / "docs" / "generators.md"
COLUMNS = {
    "CR": "CR", "CR_any": "any collision", "off_road": "adversary off the road", "hit_others": "in others",
    "moving": "ego moves", "impact_speed": "impact, m/s", "avoided_by_reg157": "R157 avoids",
    "avoided_by_cc": "CC", "avoided_by_rss": "RSS", "avoided_by_fsm": "FSM", "avoided_by_limit": "a manoeuvre",
    "attributable": "any careful driver", "within_limits": "within limits", "realism": "realism",
    "seconds": "CPU s a base",
}  # fmt: skip
"""Metric of a record -> head of its column."""
WITH_LIMITS = ("CR", "avoided_by_reg157", "attributable")


def cluster(name: str) -> str:
    """A scenario, or the route of one with random traffic."""
    return re.sub(r"^(natural[\w-]*/\w+)/\d+$", r"\1", name)


def keep(name: str, runs: list[Path]) -> None:
    """The metrics of the records of runs with the same settings, without what cannot be shown."""
    rows = []
    for line in "".join((run / "results.jsonl").read_text(encoding="utf-8") for run in runs).splitlines():
        record = json.loads(line)
        if record["status"] != "ok":
            rows.append({"failed": record["reason"], "generator": record["generator"], "system": record["system"]})
            continue
        metrics = {k: v for k, v in record["metrics"].items() if k in (*COLUMNS, "applies", "survived")}
        short = {k: round(float(v), 4) for k, v in metrics.items() if v is not None}
        rows.append({"generator": record["generator"], "system": record["system"],
                     "base": record["cluster"], **short})  # fmt: skip
    suites = [json.loads((run / "run.json").read_text(encoding="utf-8"))["suite"] for run in runs]
    about = {key: suites[0][key] for key in ("scenarios", "budget", "keep")}
    if any({key: suite[key] for key in about} != about for suite in suites):
        raise ValueError(f"{name}: runs of unlike settings")
    about["systems"] = list(dict.fromkeys(name for suite in suites for name in suite["systems"]))
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(about | {"rows": rows}, separators=(",", ":")) + "\n", encoding="utf-8")


def cases(rows: list[dict[str, Any]], key: str) -> dict[str, CaseValue]:
    """Values of a metric by base."""
    return {row["base"]: CaseValue(row[key], cluster(row["base"]), row["base"]) for row in rows if key in row}


def shown(values: dict[str, CaseValue], key: str) -> str:
    """A mean, for some metrics with its interval and number of cases."""
    if not values:
        return ""
    mean = sum(case.value for case in values.values()) / len(values)
    if key not in WITH_LIMITS:
        return f"{mean:.2f}"
    found = estimate(values.values(), "bounded")
    return f"{found.mean:.2f} [{found.low:.2f}, {found.high:.2f}]"


def tables(data: dict[str, Any]) -> list[str]:
    """A table for each system, and differences between FREA and Adv.PPO where both are."""
    lines = []
    for system in data["systems"]:
        rows = [row for row in data["rows"] if row["system"] == system and "failed" not in row]
        names = list(dict.fromkeys(row["generator"] for row in rows))
        lines += [f"`{system}`, {', '.join(data['scenarios'])}, {data['budget']} rollouts:", ""]
        lines += ["| | survived bases | " + " | ".join(COLUMNS.values()) + " |", "|---|---:|" + "---|" * len(COLUMNS)]
        alive = {}
        for name in names:
            own = [row for row in rows if row["generator"] == name and row.get("survived") and row.get("applies")]
            alive[name] = own
            cells = [shown(cases(own, key), key) for key in COLUMNS]
            lines.append(f"| `{name}` | {len(own)} | {' | '.join(cells)} |")
        lines.append("")
        if data["budget"] == data["keep"] == 1:
            lines += [text for name in names if (line := by_motion(name, alive[name])) for text in (line, "")]
        if {"adv-ppo", "frea"} <= set(names):
            for key in ("avoided_by_reg157", "attributable"):
                both = [cases(alive[name], key) for name in ("frea", "adv-ppo")]
                mean, low, high = difference(*both)
                counts = " and ".join(f"{len(group)} collisions" for group in both)
                lines.append(
                    f"`frea` less `adv-ppo`, {COLUMNS[key]}: {mean:+.2f} [{low:+.2f}, {high:+.2f}] ({counts})."
                )
            lines.append("")
    return lines


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
        keep(name, [Path(run) for run in runs.split(",")])
    whole = DOCUMENT.read_text(encoding="utf-8")
    for path in sorted(RESULTS.glob("*.json")):
        begin, end = f"<!-- {path.stem}: begin -->", f"<!-- {path.stem}: end -->"
        lines = tables(json.loads(path.read_text(encoding="utf-8")))
        print("\n".join(lines))
        if begin in whole:
            before, _, rest = whole.partition(begin)
            whole = "\n".join([before + begin, *lines, end + rest.partition(end)[2]])
    DOCUMENT.write_text(whole, encoding="utf-8")


if __name__ == "__main__":
    main()
