"""Cut-in sweeps of the four careful drivers beside the grids of the Joint Research Centre (ec-jrc/JRC-FSM).

`python benchmarks/careful_cut_ins.py` drives each model through both grids: by the rules of the published script, by
these rules with one change, and by those of SSAD. It compares the encounters that end in a crash with those of the
script, which are stored in benchmarks/results/jrc_cut_ins.json. `--write` puts the tables into
docs/results/careful-drivers.md. `--reference FOLDER` takes the crashes from a checkout of ec-jrc/JRC-FSM, and runs its
script first where FOLDER/results lacks them (two to four minutes; needs pandas); with `--store` it stores them.
"""

from __future__ import annotations

import argparse
import base64
import csv
import json
import subprocess
import sys
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.types import Bool
from ssad.drivers.careful.cut_in import JRC_RULES, CutIns, SweepRules, crashes, cut_in_grid, speed_pairs
from ssad.drivers.careful.models import FSM, MODELS, RSS, CarefulHuman, CarefulModel, Reg157

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "results" / "careful-drivers.md"
STORE = ROOT / "benchmarks" / "results" / "jrc_cut_ins.json"
COMMIT = "01b05c2"
BEGIN, END = "<!-- cut-ins: begin -->", "<!-- cut-ins: end -->"
PAIRS = {"low": speed_pairs(range(10, 61, 10)), "high": speed_pairs(range(70, 131, 20), step=30)}
GAPS = {"low": range(1, 60), "high": range(1, 120, 2)}
FILE_NAMES = {"CC": "CC_human_driver", "Reg157": "Reg157", "FSM": "FSM", "RSS": "RSS"}
JRC_MODELS: dict[str, CarefulModel] = {
    "CC": CarefulHuman(wait_for_overlap=True),
    "Reg157": Reg157(reach=np.inf),
    "FSM": FSM(),
    "RSS": RSS(drifts=False),
}
"""The models with the choices of the published script."""
JRC_SWEEP: dict[str, SweepRules] = dict.fromkeys(JRC_MODELS, JRC_RULES) | {"CC": replace(JRC_RULES, safe_ttc=2.0)}
"""The rules of the published script, which ends encounters of CC above its critical TTC."""
SCRIPT = """
import sys, types
try:
    import numba
except ModuleNotFoundError:  # it only compiles two functions
    sys.modules["numba"] = types.SimpleNamespace(njit=lambda function: function)
from utility.comparison_cut_in import run_loop
run_loop(sys.argv[1])
"""


def grid(name: str) -> CutIns:
    """Return the encounters of a grid, in the order of the published script."""
    return cut_in_grid(PAIRS[name], GAPS[name])


def sweep(name: str, models: Mapping[str, CarefulModel], rules: Mapping[str, SweepRules]) -> dict[str, Bool]:
    """Return which encounters of a grid end in a crash, by model."""
    return {model: crashes(driver, grid(name), rules=rules[model]) for model, driver in models.items()}


def reference_crashes(folder: Path, name: str) -> dict[str, Bool]:
    """Return the crashes of the published script in a grid, by model; run the script where its tables are missing.

    Args:
        folder: A checkout of ec-jrc/JRC-FSM.
        name: `low` or `high`.

    Raises:
        ConfigError: The folder is no such checkout, or the script fails.
    """
    if not (folder / "utility" / "comparison_cut_in.py").is_file():
        raise ConfigError(f"{folder} is no checkout of ec-jrc/JRC-FSM: it lacks utility/comparison_cut_in.py")
    tables = folder / "results" / f"cut_in_{name}_speed"
    files = {m: [tables / f"{stem}_{ego}_{lead}.csv" for ego, lead in PAIRS[name]] for m, stem in FILE_NAMES.items()}
    if not all(file.is_file() for paths in files.values() for file in paths):
        (folder / "results").mkdir(exist_ok=True)
        command = [sys.executable, "-W", "ignore", "-c", SCRIPT, name]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise ConfigError(f"the cut-in script of {folder} fails ({reason}): install what its README names")
    return {model: np.concatenate([_crash_column(file) for file in paths]) for model, paths in files.items()}


def _crash_column(file: Path) -> Bool:
    with file.open(encoding="utf-8", newline="") as rows:
        return np.array([row["Crash"] == "True" for row in csv.DictReader(rows)])


def store(by_grid: Mapping[str, Mapping[str, Bool]]) -> None:
    """Store crashes of the published script: bits in its order, compressed, in base 64."""
    packed = {
        name: {
            model: base64.b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode()
            for model, mask in masks.items()
        }
        for name, masks in by_grid.items()
    }
    text = json.dumps({"source": "ec-jrc/JRC-FSM", "commit": COMMIT, "crashes": packed}, indent=1)
    STORE.write_text(text + "\n", encoding="utf-8")


def stored_crashes(name: str) -> dict[str, Bool]:
    """Return the stored crashes of the published script in a grid, by model."""
    packed = json.loads(STORE.read_text(encoding="utf-8"))["crashes"][name]
    count = len(grid(name))
    return {
        model: np.unpackbits(np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8), count=count).astype(bool)
        for model, text in packed.items()
    }


def row(label: str, masks: Mapping[str, Bool], columns: Sequence[str] = tuple(JRC_MODELS)) -> str:
    """Return a row of the table of shares: percent that crash by model, and of pairs of models where all are swept."""
    cells = [f"{100.0 * masks[model].mean():.2f}" if model in masks else "" for model in columns]
    if set(masks) == set(columns):
        human, fuzzy = masks["CC"], masks["FSM"]
        shares = (np.all(list(masks.values()), axis=0), human & ~fuzzy, fuzzy & ~human)
        cells += [f"{100.0 * share.mean():.2f}" for share in shares]
    else:
        cells += [""] * 3
    return f"| {label} | {' | '.join(cells)} |"


def share_table(name: str, published: Mapping[str, Bool], repeated: Mapping[str, Bool]) -> list[str]:
    """Return the shares of a grid: published, by the same rules, with one of them changed, and by SSAD's rules."""
    changes: dict[str, tuple[Mapping[str, CarefulModel], SweepRules]] = {
        "CC: no end above a TTC of 2 s": ({"CC": JRC_MODELS["CC"]}, JRC_RULES),
        "Reg157: a reach of 46 m": ({"Reg157": Reg157()}, JRC_RULES),
        "RSS: full braking at once": ({"RSS": replace(RSS(drifts=False), jerk=np.inf)}, JRC_RULES),
        "RSS: the driver may drift (definition 6)": ({"RSS": RSS()}, JRC_RULES),
    }
    lines = [
        "",
        f"Grid `{name}`: {len(grid(name)):,} encounters",
        "",
        f"| Rules | {' | '.join([*JRC_MODELS, 'all four'])} | FSM avoids, CC not | the reverse |",
        "|---|" + "---:|" * (len(JRC_MODELS) + 3),
        row("published", published),
        row("SSAD, rules of the script", repeated),
    ]
    for label, (models, rules) in changes.items():
        lines.append(row(label, sweep(name, models, dict.fromkeys(models, rules))))
    changed_rules = {
        "no lead-in": {model: replace(rules, lead_in=np.inf) for model, rules in JRC_SWEEP.items()},
        "delays within steps, braking goes on": {
            model: replace(rules, whole_steps=False) for model, rules in JRC_SWEEP.items()
        },
        "a driver is past with its rear, not its centre": {
            model: replace(rules, past_at_centre=False) for model, rules in JRC_SWEEP.items()
        },
    }
    lines += [row(label, sweep(name, JRC_MODELS, rules_by_model)) for label, rules_by_model in changed_rules.items()]
    models = {model: MODELS[model.lower()] for model in JRC_MODELS}
    lines.append(row("SSAD's own", sweep(name, models, dict.fromkeys(models, SweepRules(lead_in=JRC_RULES.lead_in)))))
    return lines


def cell_table(published: Mapping[str, Mapping[str, Bool]], repeated: Mapping[str, Mapping[str, Bool]]) -> list[str]:
    """Return how many encounters end alike in the published script and by its rules in SSAD."""
    lines = ["", "| Grid | Model | Encounters that end alike, % | Crash in the script alone | in SSAD alone |"]
    lines.append("|---|---|---:|---:|---:|")
    for name, masks in published.items():
        for model, mask in masks.items():
            crash = repeated[name][model]
            lines.append(
                f"| {name} | {model} | {100.0 * (crash == mask).mean():.2f} | {(mask & ~crash).sum()} | "
                f"{(crash & ~mask).sum()} |"
            )
    return lines


def tables(published: Mapping[str, Mapping[str, Bool]]) -> str:
    """Return the tables of shares and of encounters as Markdown."""
    repeated = {name: sweep(name, JRC_MODELS, JRC_SWEEP) for name in published}
    lines = [line for name in published for line in share_table(name, published[name], repeated[name])]
    return "\n".join([*lines, *cell_table(published, repeated), ""])


def main() -> None:
    """Print the tables, or write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, metavar="FOLDER", help="checkout of ec-jrc/JRC-FSM to compare with")
    parser.add_argument("--store", action="store_true", help="store the crashes of --reference")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/results/careful-drivers.md")
    given = parser.parse_args()
    if given.store and given.reference is None:
        parser.error("--store needs --reference FOLDER")
    began = time.process_time()
    try:
        published = {
            name: stored_crashes(name) if given.reference is None else reference_crashes(given.reference, name)
            for name in PAIRS
        }
    except ConfigError as error:
        parser.error(str(error))
    text = tables(published)
    print(text)
    print(f"{time.process_time() - began:.0f} s of CPU time")
    if given.store:
        store(published)
    if given.write:
        before, _, rest = PAGE.read_text().partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
