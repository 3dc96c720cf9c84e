"""`ssad run`: a suite becomes cells, cells become records in a folder; run again to go on where it stopped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from ssad.bench.cells import Cell, code_version, make_cells, system_version, town_version
from ssad.bench.suite import Suite, command_of, suite_scenarios
from ssad.core.errors import ConfigError, SSADError
from ssad.core.seeding import digest
from ssad.jobs.machine import default_workers, versions
from ssad.jobs.progress import Live
from ssad.jobs.runner import EXECUTE, Runner
from ssad.jobs.store import Store, read_run


@dataclass(frozen=True)
class Plan:
    """Everything that a run will do, known and checked before anything is written."""

    suite: Suite
    cells: tuple[Cell, ...]
    device: str
    towns: Mapping[str, str]
    systems: Mapping[str, str]

    def run_json(self) -> dict[str, Any]:
        """What run.json says. `identity` covers all that results depend on, so a folder holds one run only."""
        return {
            "identity": digest("run", self.device, *[cell.key for cell in self.cells])[:16],
            "suite": self.suite.model_dump(mode="json"),
            "command": command_of(self.suite.model_dump(mode="json")),
            "versions": versions(self.device),
            "code": code_version(),
            "towns": dict(self.towns),
            "systems": dict(self.systems),
            "cells": [
                {"key": c.key, "system": c.system, "scenario": c.scenario["name"], "group": c.group, "seed": c.seed}
                | {"repetition": c.repetition, "town": c.scenario["town"]}
                for c in self.cells
            ],
        }


def plan(suite: Suite, *, device: str = "cpu", check: bool = True) -> Plan:
    """Resolve a suite. With `check`, each scenario is built once, so that bad input ends here and not in a record."""
    from ssad.bench.execute import episode_of, town

    systems = {name: system_version(name) for name in suite.systems}
    if len(systems) != len(suite.systems):
        raise ConfigError(f"suite {suite.name}: systems: a name appears twice")
    scenarios = suite_scenarios(suite)
    towns = {name: town_version(town(name)) for name in sorted({s.town for s in scenarios})}
    cells = make_cells(suite, scenarios, systems=systems, towns=towns)
    if check:
        for cell in cells:
            if cell.system == suite.systems[0] and cell.repetition == 0:
                _check(cell, episode_of)
    return Plan(suite, cells, device, towns, systems)


def _check(cell: Cell, build: Any) -> None:
    try:
        build(cell.as_dict())
    except SSADError as error:
        name = f"scenario {cell.scenario['name']}"
        raise type(error)(str(error) if name in str(error) else f"{name}: {error}") from None


def run(
    todo: Plan,
    folder: str | Path,
    *,
    workers: int | None = None,
    execute: str = EXECUTE,
    console: Console | None = None,
    retry: bool = False,
) -> list[dict[str, Any]]:
    """Run what is missing (retry: and what failed) and return all records, in the order of the plan. StoreError,
    SSADError."""
    console = console or Console(stderr=True)
    suite, header = todo.suite, todo.run_json()
    with Store.open(folder, header, retry=retry) as store:
        missing = [cell for cell in todo.cells if cell.key not in store.results]
        _keep_towns(Path(folder), todo.towns)
        settings = {"folder": str(Path(folder).resolve()), "device": todo.device, "witness": suite.witness}
        count = min(workers or default_workers(), max(1, len(missing)))
        # with few cells a smaller chunk keeps all workers busy
        chunk = max(1, min(suite.chunk, -(-len(missing) // count)))
        runner = Runner(execute=execute, settings=settings, workers=count, chunk=chunk, timeout_s=suite.timeout_s)
        if missing:
            done = len(todo.cells) - len(missing)
            with Live(suite.name, len(todo.cells), done, console=console) as live:

                def finish(cell: Cell, result: Mapping[str, Any]) -> None:
                    store.append(*_records(cell, result, suite.name, header["versions"]))
                    live.advance(result["status"] == "ok")

                runner.run(missing, finish, live.tick)
        return [store.results[cell.key] for cell in todo.cells]


def _keep_towns(folder: Path, towns: Iterable[str]) -> None:
    """Copies of the towns lie beside the results, so that a report can be made where they are not imported."""
    from ssad.bench.execute import town
    from ssad.roads import save_graph

    for name in towns:
        path = folder / "towns" / f"{name}.npz"
        if Path(name).name == name and not path.exists():
            save_graph(town(name), path)


def _records(
    cell: Cell, result: Mapping[str, Any], suite: str, found: Mapping[str, str]
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The line for results.jsonl, and the one for episodes.jsonl when there is an episode."""
    common: dict[str, Any] = {
        "key": cell.key,
        "suite": suite,
        "system": cell.system,
        "group": cell.group,
        "seed": cell.seed,
    }
    record = common | {
        "status": result["status"],
        "reason": result["reason"],
        "spec": {"scenario": dict(cell.scenario), "system": cell.system, "repetition": cell.repetition},
        "metrics": result.get("metrics", {}),
        "n": result.get("n", 1),
        "versions": dict(found),
        "wall_s": result.get("wall_s", 0.0),
        "artefacts": result.get("artefacts", {}),
    }
    if "witness" in result:
        record["witness"] = result["witness"]
    if result["status"] != "ok":
        return record, None
    episode = common | {"scenario": cell.scenario["name"], "repetition": cell.repetition}
    kept = {name: result[name] for name in ("town", "end", "trace_hash", "metrics") if name in result}
    return record, episode | kept | {"trace": record["artefacts"].get("trace", "")}


def read_plan(folder: str | Path) -> Plan:
    """The plan of a folder that holds a run. StoreError when code, towns or systems have changed since."""
    header = read_run(folder)
    suite = Suite.model_validate(header["suite"])
    todo = plan(suite, device=header["versions"]["device"], check=False)
    if todo.run_json()["identity"] != header["identity"]:
        changed = [name for name in ("code", "towns", "systems") if todo.run_json()[name] != header[name]]
        what = ", ".join(changed) or "scenarios"
        raise ConfigError(f"{folder}: {what} changed since this run was made; run the suite again to compare")
    return todo
