"""Measure the flip rates of the shipped systems: python -m benchmarks.flip_rates FOLDER...

FOLDERs are runs of kinds with rates, such as

    ssad run precrash --set witness=false --out runs/flips

Writes `src/ssad/experiments/flip_rates.json`, which `ssad plan --detect` reads: for each run, and for each set of
scenarios in it, the flip rates of all pairs of systems, with the design effects of the routes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.world_ratio import commit
from ssad.core.errors import ConfigError
from ssad.experiments.runs import kind_of_run
from ssad.experiments.sample_size import REFERENCE, reference_entry
from ssad.report.load import Run, load_run
from ssad.scenarios.dynamic import load_scenarios


def measurements(run: Run) -> Iterator[dict[str, Any]]:
    """Yield the flip rates of a run, and those of each of its sets of scenarios."""
    kind = kind_of_run(run)
    if not kind.rates:
        raise ConfigError(f"{run.folder}: cells of kind '{run.kind}' have no rates")
    names = {
        reference: [scenario.name for scenario in load_scenarios(reference)] for reference in run.suite["scenarios"]
    }
    yield reference_entry(run, kind, list(names), [name for part in names.values() for name in part])
    if len(names) > 1:
        for reference, part in names.items():
            yield reference_entry(run, kind, [reference], part)


def main() -> None:
    """Measure, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="results folders")
    runs = [load_run(folder) for folder in parser.parse_args().folders]
    data = {
        "commit": commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "commands": [run.command for run in runs],
        "measurements": [entry for run in runs for entry in measurements(run)],
    }
    text = json.dumps(data).replace('{"rate"', '\n{"rate"').replace('{"kind"', '\n{"kind"')  # a line a pair
    REFERENCE.write_text(text + "\n", encoding="utf-8")
    for entry in data["measurements"]:
        print(f"{entry['kind']}, {' and '.join(entry['scenarios'])}: {len(entry['pairs'])} flip rates")


if __name__ == "__main__":
    main()
