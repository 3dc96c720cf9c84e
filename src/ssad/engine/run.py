"""The engine of every kind: cells become records in a folder, and a repeated run continues where it stopped."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.machine import default_workers, machine_properties, versions
from ssad.core.run_records import value_problem
from ssad.core.seeding import digest
from ssad.engine.command import command_of
from ssad.engine.kind import Cell, CellError, Job, Kind, Plan, Resources
from ssad.engine.pool import Pool, open_pool
from ssad.engine.progress import LiveProgress
from ssad.engine.store import Store
from ssad.engine.task import Task, TaskOutcome

MAX_HASHED_BYTES = 1 << 30  # bytes of an artefact that is hashed


def run(
    plan: Plan,
    folder: str | Path,
    resources: Resources | None = None,
    *,
    retry: bool = False,
    only: Mapping[str, Sequence[str]] | None = None,
) -> list[dict[str, Any]]:
    """Run the missing cells (retry: and failed ones) and return all records, in the order of the plan.

    Args:
        plan: The whole run.
        folder: Folder of its records.
        resources: Resources of the run.
        retry: Whether failed cells run again; of a slice, those that are in it.
        only: Run a slice: the cells whose fields, or name, have one of these values, as text.

    Raises:
        ConfigError: No cell has such a value.
        StoreError: The folder cannot be written, is in use, or holds another run.
        SSADError: No worker can start, or data cannot be made.
    """
    resources = resources or Resources(device=plan.device)
    selected_cells = select_cells(plan, only or {})  # a wrong name raises before a folder is made
    header, results_folder = run_json(plan), Path(folder).resolve()
    with Store.open(folder, header, retry=[cell.key for cell in selected_cells] if retry else False) as store:
        missing = sorted((c for c in selected_cells if c.key not in store.results), key=plan.kind.order)
        if missing:
            retried_cells = [cell for cell in missing if cell.key in store.retried]
            settings = plan.kind.prepare(plan, results_folder, resources, retry=retried_cells)
            job = Job(results_folder, plan.device, settings)
            _Schedule(plan, job, store, header["versions"], resources).run_cells(missing)
        return [store.results[cell.key] for cell in plan.cells if cell.key in store.results]


def select_cells(plan: Plan, only: Mapping[str, Sequence[str]]) -> list[Cell]:
    """Return the cells whose fields, or name, have one of these values, as text.

    A value "a,b" means a and b, unless a cell has that very value.

    Raises:
        ConfigError: No cell has such a field or value.
    """
    rows = [{"name": cell.name} | {key: _text(value) for key, value in cell.fields.items()} for cell in plan.cells]
    selected = list(zip(plan.cells, rows, strict=True))
    for field, texts in only.items():
        field_values = dict.fromkeys(row[field] for row in rows if field in row)
        if not field_values:
            raise unknown_name("field of cells", field, dict.fromkeys(key for row in rows for key in row))
        selected_values = [
            value for text in map(str, texts) for value in ([text] if text in field_values else text.split(","))
        ]
        for value in selected_values:
            if value not in field_values:
                raise unknown_name(field, value.strip(), field_values)
        selected = [(cell, row) for cell, row in selected if row.get(field) in selected_values]
    if not selected:
        condition = " and ".join(f"{field}={','.join(map(str, texts))}" for field, texts in only.items())
        raise ConfigError(f"no cell has {condition} at once")
    return [cell for cell, _ in selected]


def _text(value: Any) -> str:
    """Return the value of a field as one writes it: 10 and not 10.0."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def run_json(plan: Plan) -> dict[str, Any]:
    """Return the content of run.json. `identity` covers all that results depend on: a folder holds one run."""
    kind = plan.kind
    return {
        "identity": digest("run", plan.device, *[cell.key for cell in plan.cells])[:16],
        "kind": kind.name,
        "suite": plan.suite.model_dump(mode="json"),
        "command": command_of(plan.suite, plan.device),
        "versions": {**versions(plan.device), **plan.versions},
        "code": kind.code,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine_properties(),
        "columns": [{key: value for key, value in vars(c).items() if key != "limits"} for c in kind.columns],
        "limits": {name: list(pair) for name, pair in kind.limits.items()},
        "factors": list(kind.factors),
        "cells": [{"key": c.key, "name": c.name, "seed": c.seed, **c.fields} for c in plan.cells],
        **plan.inputs,
    }


class _Schedule:
    """Dependencies of a run: shared pieces of work first, then cells in batches, one by one where a batch fails."""

    def __init__(self, plan: Plan, job: Job, store: Store, versions: Mapping[str, str], resources: Resources) -> None:
        self.plan, self.kind, self.job, self.store = plan, plan.kind, job, store
        self.versions, self.resources = versions, resources
        self.timeout: float = plan.suite.timeout_s
        self.waiting_pieces: dict[str, set[str]] = {}  # cell key -> pieces that it waits for
        self.waiting_cells: dict[tuple[str, str], list[Cell]] = {}  # piece and system -> cells that wait for it
        self.sharing: dict[str, dict[str, None]] = {}  # piece -> systems that wait for it, in order
        self.data: dict[str, Any] = {}
        self.shared_seconds: dict[str, float] = {}  # cell key -> its part of the seconds of its pieces
        self.unshared_systems: set[str] = set()  # systems that share no pieces any more
        self.failure_counts: Counter[str] = Counter()  # system -> its crashes and time-outs
        self.given_up: dict[str, TaskOutcome] = {}
        self.pool: Pool
        self.progress: LiveProgress

    def run_cells(self, missing: Sequence[Cell]) -> None:
        """Run cells until each has a record."""
        for cell in missing:
            pieces = self.kind.pieces(cell, self.job)
            self.data |= pieces
            self.waiting_pieces[cell.key] = set(pieces)
            for name in pieces:
                self.waiting_cells.setdefault((name, cell.system), []).append(cell)
                self.sharing.setdefault(name, {})[cell.system] = None
        ready_cells = [cell for cell in missing if not self.waiting_pieces[cell.key]]
        task_count = len(self.data) + len(missing)
        resources = self.resources
        workers = self.kind.workers(self.plan, resources.workers)
        initialiser = (
            _start_worker,
            (self.kind, self.job),
        )  # of every kind: importing it takes seconds that are no cell's
        total = len(self.plan.cells) + len(self.data)
        finished_count = len(self.plan.cells) - len(missing)
        with (
            open_pool(
                task_count, workers=workers, ray=resources.ray, device=self.plan.device, start=initialiser
            ) as self.pool,
            LiveProgress(self.plan.suite.name, total, finished_count, console=resources.console) as self.progress,
        ):
            # Pieces first: cells wait for them, and some take long.
            for name in self.data:
                self._add_piece(name, list(self.sharing[name]))
            for batch in self.kind.batches(self.plan, ready_cells, min(task_count, workers or default_workers())):
                self._add(batch)
            for outcome in self.pool.outcomes(self.progress.tick):
                if isinstance(outcome.task.label, list):
                    self._batch_ended(outcome.task.label, outcome)
                else:
                    name, systems = outcome.task.label
                    self._piece_ended(name, systems, outcome)

    def _add(self, batch: list[Cell], *, first: bool = False) -> None:
        # a batch may take longer than one cell, but not the sum of all
        time_limit = self.timeout * (1 if len(batch) == 1 else 2)
        self.pool.add(Task(_execute_batch, (self.kind, batch, self.job), time_limit, label=batch), first=first)

    def _add_piece(self, name: str, systems: Sequence[str], *, first: bool = False) -> None:
        argument = (self.kind, name, self.data[name], tuple(systems), self.job)
        self.pool.add(Task(_make_piece, argument, self.timeout, label=(name, tuple(systems))), first=first)

    def _piece_ended(self, name: str, systems: Sequence[str], outcome: TaskOutcome) -> None:
        """Release the cells that waited; a piece that failed for several systems is done again for each alone."""
        if outcome.status != "ok" and len(systems) > 1:
            for system in systems:
                if system in self.unshared_systems:
                    self._release(name, system)
                else:
                    self._add_piece(name, [system], first=True)
            return
        for system in systems:
            self._release(name, system, outcome.seconds / len(systems))
        if outcome.status != "ok":
            self._stop_sharing(systems[0])
            self._count_failure(systems[0], outcome)

    def _release(self, name: str, system: str, seconds: float = 0.0) -> None:
        waiting_cells = self.waiting_cells.pop((name, system), [])
        self.sharing[name].pop(system, None)
        if not self.sharing[name]:
            self.progress.advance(True)
        # The cells that used a shared piece carry its seconds in equal parts.
        for cell in waiting_cells:
            self.shared_seconds[cell.key] = self.shared_seconds.get(cell.key, 0.0) + seconds / len(waiting_cells)
            self.waiting_pieces[cell.key].discard(name)
            if self.waiting_pieces[cell.key]:
                continue
            if cell.system in self.given_up:
                self._give_up(cell)
            else:
                self._add([cell], first=True)

    def _batch_ended(self, batch: list[Cell], outcome: TaskOutcome) -> None:
        if outcome.status == "ok":
            for cell in batch:
                result = dict(outcome.value[cell.key])
                seconds = result.pop("wall_s", outcome.seconds / len(batch)) + self.shared_seconds.get(cell.key, 0.0)
                self._record(cell, "ok", "", result, seconds)
        elif len(batch) > 1:
            for cell in batch:
                self._add([cell], first=True)
        else:
            reason = outcome.reason
            if outcome.status == "timeout":
                reason = f"took longer than {self.timeout:g} s"
            self._record(
                batch[0], outcome.status, reason, {}, outcome.seconds + self.shared_seconds.get(batch[0].key, 0.0)
            )
            self._count_failure(batch[0].system, outcome)

    def _stop_sharing(self, system: str) -> None:
        """Exclude a system that failed alone from shared pieces: its cells do without them from now on."""
        if system in self.unshared_systems:
            return
        self.unshared_systems.add(system)
        for task in self.pool.drop(lambda task: isinstance(task.label, tuple) and system in task.label[1]):
            name, systems = task.label
            remaining_systems = [candidate for candidate in systems if candidate != system]
            if remaining_systems:
                self._add_piece(name, remaining_systems)
            self._release(name, system)

    def _count_failure(self, system: str, outcome: TaskOutcome) -> None:
        """Count a system's time-outs and crashes; after `patience` of them, give it up."""
        if self.kind.patience is None or outcome.status not in ("timeout", "crashed"):
            return
        self.failure_counts[system] += 1
        if self.failure_counts[system] == self.kind.patience:
            self.given_up[system] = outcome
            for task in self.pool.drop(lambda task: isinstance(task.label, list) and task.label[0].system == system):
                for cell in task.label:
                    self._give_up(cell)

    def _give_up(self, cell: Cell) -> None:
        outcome = self.given_up[cell.system]
        reason = f"not tried after {self.kind.patience} others of {cell.system} ended like this: {outcome.reason}"
        self._record(cell, outcome.status, reason, {}, 0.0)

    def _record(self, cell: Cell, status: str, reason: str, result: dict[str, Any], seconds: float) -> None:
        """Append a line to results.jsonl, and one to episodes.jsonl if the kind has one."""
        shared_fields: dict[str, Any] = {
            "key": cell.key,
            "suite": self.plan.suite.name,
            **cell.fields,
            "seed": cell.seed,
        }
        episode = result.pop("episode", None)
        record = (
            shared_fields
            | {
                "status": status,
                "reason": reason,
                "spec": dict(cell.spec),
                "metrics": {},
                "n": 1,
                "versions": dict(self.versions),
                "wall_s": round(seconds, 4),
                "artefacts": {},
            }
            | result
        )
        self.store.append(record, None if episode is None else shared_fields | episode)
        self.progress.advance(status == "ok")


def _start_worker(argument: tuple[Kind, Job]) -> None:
    kind, job = argument
    kind.start(job)


def _make_piece(argument: tuple[Kind, str, Any, Sequence[str], Job]) -> None:
    kind, name, data, systems, job = argument
    kind.make(name, data, systems, job)


def _execute_batch(argument: tuple[Kind, list[Cell], Job]) -> dict[str, Mapping[str, Any]]:
    """Return the results of a batch, checked to be plain data, with the hashes of their artefacts."""
    kind, batch, job = argument
    results = kind.execute(batch, job)
    if set(results) != {cell.key for cell in batch}:
        raise CellError(f"the kind {kind.name} answered for other cells")
    checked_results: dict[str, Mapping[str, Any]] = {}
    for key, result in results.items():
        try:
            safeio.dump_json(dict(result))
        except (TypeError, ValueError) as error:
            raise CellError(f"the result is not plain data: {error}") from None
        if problem := value_problem({"status": "ok", **result}, kind.limits):
            raise CellError(f"the result is impossible: {problem}")
        paths = [
            path
            for value in result.get("artefacts", {}).values()
            for path in ([value] if isinstance(value, str) else value)
        ]
        checked_results[key] = {**result, "hashes": hash_artefacts(job.folder, paths)}
    return checked_results


def hash_artefacts(folder: Path, paths: Iterable[str]) -> dict[str, str]:
    """Return path below the folder -> 32 hex digits of BLAKE2b, of files and of all files in folders."""
    hashes = {}
    for path in (folder / name for name in paths):
        for artefact in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if artefact.is_file():
                content = safeio.read_bytes(artefact, limit=MAX_HASHED_BYTES)
                name = os.path.relpath(artefact, folder)
                hashes[name] = hashlib.blake2b(content, digest_size=16).hexdigest()
    return hashes
