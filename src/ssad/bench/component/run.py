"""`ssad run` for suites of kind `detection`: data, then boxes and, cell by cell, scores; run again to go on."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from ssad.bench.cells import source_version
from ssad.bench.component.suite import RECORDED, DetectionSuite
from ssad.bench.component.work import Cell, Job, Made, Scored, Unit, detector_of, forget_failures, make_unit, score_cell
from ssad.bench.suite import command_of
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.seeding import digest
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors import DETECTORS, SHIPPED
from ssad.evaluation.camera_truth import scenes_of
from ssad.jobs.machine import default_workers, versions, visible_gpus
from ssad.jobs.pool import Crew
from ssad.jobs.progress import Live
from ssad.jobs.store import Store
from ssad.recording.nuscenes_recorder import Recording, record_nuscenes
from ssad.scenarios.static.shifts import SHIFTS, VERSIONS, ShiftSpec, dealt_severities

# a change in any of these may change a number
_CODE = (
    "core",
    "detectors",
    "scenarios/static/shifts",
    "metrics",
    "datasets",
    "toolbox",
    "evaluation",
    "bench/component/work.py",
)
_WORLD = ("camera", "assets", "world", "roads", "drivers", "recording")
# processes that share a GPU: planning a shift and reading pictures is work for the host; and memory of each, bytes
GPU_WORKERS, GPU_SHARE = 14, 4 << 30


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that a run will do, checked before anything is written. detectors: name -> weights, "" for the
    shipped ones; data: what the results depend on of the data set."""

    suite: DetectionSuite
    detectors: tuple[tuple[str, str], ...]
    device: str
    root: Path | None
    data: Mapping[str, Any]
    weights: Mapping[str, str]

    @property
    def conditions(self) -> list[tuple[str | None, int | str]]:
        """Clean, then every shift at every severity."""
        return [(None, 0), *((shift, s) for shift in self.suite.shifts for s in self.suite.severities)]

    def key(self, detector: str, shift: str | None, severity: int | str) -> str:
        """Of a cell: a hash of all that its result depends on."""
        suite = self.suite
        parts = (detector, self.weights[detector], shift or "clean", severity, safeio.dump_json(dict(self.data)))
        code = source_version(_CODE + (_WORLD if self.root is None else ()))
        return digest("detection", code, self.device, suite.calibration, suite.seed, suite.replicates, *parts)[:16]

    def run_json(self) -> dict[str, Any]:
        """What run.json says."""
        cells = [
            {"key": self.key(d, shift, severity), "detector": d, "shift": shift, "severity": severity}
            for d, _ in self.detectors for shift, severity in self.conditions
        ]  # fmt: skip
        return {
            "identity": digest("detection run", *[c["key"] for c in cells])[:16],
            "command": command_of(self.suite.model_dump(mode="json")),
            "suite": self.suite.model_dump(mode="json"), "data": dict(self.data),
            "versions": versions(self.device) | {"shifts": str(VERSIONS[self.suite.calibration])},
            "weights": dict(self.weights), "cells": cells,
        }  # fmt: skip


def plan_detection(suite: DetectionSuite, *, device: str = "cpu") -> Plan:
    """Resolve a suite: detectors are built once, the data set is looked at. ConfigError, FormatError."""
    if len(set(suite.shifts)) != len(suite.shifts) or len(set(suite.severities)) != len(suite.severities):
        raise ConfigError(f"suite {suite.name}: a shift or a severity appears twice")
    for shift in suite.shifts:
        ShiftSpec(shift, calibration=suite.calibration)
    detectors, weights = [], {}
    for text in suite.detectors:
        name, _, file = text.partition("=")
        if name in weights:
            raise ConfigError(
                f"suite {suite.name}: detectors: {name} appears twice; tell two of a kind apart by a label, "
                f"{name}@mine=FILE"
            )
        path = str(Path(file).expanduser().resolve()) if file and file != "random" else file
        kind = name.partition("@")[0]
        if not path and kind in DETECTORS and not (SHIPPED / f"{kind}.json").is_file():
            raise ConfigError(
                f"suite {suite.name}: no weights of {kind} are shipped; give a file, {kind}=FILE "
                f"(docs/detectors.md: ssad train detector {kind}, or official ones)"
            )
        detector = detector_of(name, path, "cpu")
        if getattr(detector, "task", None) != "3d":
            raise ConfigError(f"suite {suite.name}: {name} finds 2D boxes; this suite takes 3D detectors")
        detectors.append((name, path))
        weights[name] = state_hash(detector) + source_hash(kind)
    if suite.data == RECORDED:
        about = _recording(suite, Path(RECORDED)).identity()
        about["split"] = suite.split
        if suite.split not in ("val", "all"):
            raise ConfigError(f"suite {suite.name}: recorded data have the splits val and all, not '{suite.split}'")
        return Plan(suite, tuple(detectors), device, None, about, weights)
    root = Path(suite.data).expanduser()
    if not root.is_dir():
        raise ConfigError(f"suite {suite.name}: data: {root} is no folder; give the root of a data set, or {RECORDED}")
    with NuScenes(root, suite.version) as data:
        version = data.version
        scenes_of(data, suite.split)
    tables = {
        name: hashlib.sha256(safeio.read_bytes(root / version / f"{name}.json", limit=1 << 34)).hexdigest()[:16]
        for name in ("sample", "sample_annotation", "sample_data", "calibrated_sensor")
    }
    return Plan(suite, tuple(detectors), device, root, {"version": version, "split": suite.split} | tables, weights)


def state_hash(detector: Any) -> str:
    """12 hex digits over the weights of a detector; "" for one that is no module."""
    if not hasattr(detector, "state_dict"):
        return ""
    from ssad.detectors.checkpoints import hash_state

    return hash_state(detector.state_dict())[:12]


def source_hash(name: str) -> str:
    """For a detector of one's own, `module:object`, 12 hex digits over its module's file; "" for one of ours."""
    module, colon, _ = name.partition(":")
    path = getattr(sys.modules.get(module), "__file__", None) if colon else None
    return "" if path is None else f" {hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]}"


def _recording(suite: DetectionSuite, out: Path) -> Recording:
    """On the CPU, on any machine: it decides bits."""
    own = suite.recorded
    return Recording(
        out, tuple(own.towns), tuple(own.towns), scenes=own.scenes, seconds=own.seconds, width=own.width,
        seed=own.seed,
    )  # fmt: skip


def run_detection(
    todo: Plan, folder: str | Path, *, workers: int | None = None, console: Console | None = None, retry: bool = False
) -> list[dict[str, Any]]:
    """Run what is missing (retry: and what failed) and return all records, in the order of the plan. StoreError,
    SSADError."""
    console, suite = console or Console(stderr=True), todo.suite
    header, out = todo.run_json(), Path(folder)
    with Store.open(out, header, retry=retry) as store:
        order = [cell["key"] for cell in header["cells"]]
        if all(key in store.results for key in order):
            return [store.results[key] for key in order]
        root = todo.root
        if root is None:
            recording = _recording(suite, out / "data")
            with Live("recording", suite.recorded.scenes * len(suite.recorded.towns), 0, console=console) as live:

                def recorded(done: int, of: int) -> None:
                    live.done = done
                    live.tick()

                root = record_nuscenes(recording, workers=workers, progress=recorded)
        with NuScenes(root, suite.version) as data:
            version = data.version
            scenes = scenes_of(data, suite.split)
            tokens = {name: data.scene(name).record.token for name in scenes}
        gpus = visible_gpus() if todo.device != "cpu" else []
        count = workers or min(workers_on(len(gpus)) or default_workers(), default_workers())
        threads = max(1, default_workers() // count)
        job = Job(
            out, root, version, todo.detectors, suite.calibration, suite.seed, suite.replicates, todo.device, threads
        )
        cells = [
            Cell(todo.key(d, shift, severity), d, shift, severity, _units(todo, shift, severity, tokens))
            for d, _ in todo.detectors for shift, severity in todo.conditions
        ]  # fmt: skip
        missing = [cell for cell in cells if cell.key not in store.results]
        units = list(dict.fromkeys(unit for cell in sorted(missing, key=_rank) for unit in cell.units))
        if retry:
            forget_failures(out, units)
        hands = min(count, len(units) + len(missing))
        with Live(suite.name, len(units) + len(missing), 0, console=console) as live, Crew(hands, gpus=gpus) as crew:
            for cell, result, seconds in _work(crew, job, units, missing, live):
                store.append(_record(todo, cell, header, result, seconds), None)
        return [store.results[key] for key in order]


def workers_on(gpus: int) -> int:
    """How many processes share so many GPUs (the first ones that are visible)."""
    import torch

    memory = [torch.cuda.get_device_properties(k).total_memory for k in range(gpus)]
    return sum(max(1, min(GPU_WORKERS, size // GPU_SHARE)) for size in memory)


def _work(
    crew: Crew, job: Job, units: Sequence[Unit], cells: Sequence[Cell], live: Live
) -> Iterator[tuple[Cell, dict[str, Any], float]]:
    """Cells, what their records say and the seconds of work in them, each as soon as its last unit is there.

    Seconds: of scoring, and of those units that were made now, shared by the cells that need them.
    """
    left = {cell.key: set(cell.units) for cell in cells}
    users: dict[Unit, list[Cell]] = {}
    for cell in cells:
        for unit in left[cell.key]:
            users.setdefault(unit, []).append(cell)
    made: dict[Unit, Made] = {}
    for unit in units:
        crew.add(make_unit, (job, unit))
    for done in crew.results():
        if isinstance(done, Scored):
            shared = sum(made[unit].seconds / len(users[unit]) for unit in done.cell.units)
            live.advance("reason" not in done.result)
            yield done.cell, done.result, shared + done.seconds
        else:
            made[done.unit] = done
            live.advance(not done.reason)
            for cell in users[done.unit]:
                left[cell.key].discard(done.unit)
                if left[cell.key]:
                    continue
                bad = next((made[unit] for unit in cell.units if made[unit].reason), None)
                if bad is None:
                    crew.add(score_cell, (job, cell), first=True)
                else:
                    live.advance(False)
                    yield cell, {"reason": f"{bad.unit.scene}: {bad.reason}"}, bad.seconds / len(users[bad.unit])
        live.tick()


def _rank(cell: Cell) -> int:
    """Which cells come first: clean, what the main table tells, the middle severity, the others."""
    if cell.shift is None:
        return 0
    return 1 if isinstance(cell.severity, str) else 2 + abs(cell.severity - 3)


def _units(todo: Plan, shift: str | None, severity: int | str, tokens: Mapping[str, str]) -> tuple[Unit, ...]:
    """The pieces of work that a condition needs. A severity dealt to a scene is one of the five: nothing runs twice."""
    if shift is None or severity != "random" or todo.suite.calibration == "paper":
        return tuple(Unit(shift, severity, scene) for scene in tokens)
    spec = ShiftSpec(shift, seed=todo.suite.seed, calibration=todo.suite.calibration)
    dealt = dealt_severities(spec, tokens.values())
    return tuple(Unit(shift, dealt[token], scene) for scene, token in tokens.items())


def _record(
    todo: Plan, cell: Cell, header: Mapping[str, Any], result: Mapping[str, Any], seconds: float
) -> dict[str, Any]:
    return {
        "key": cell.key, "suite": todo.suite.name, "status": "failed" if "reason" in result else "ok",
        "reason": result.get("reason", ""), "detector": cell.detector, "shift": cell.shift,
        "family": SHIFTS[cell.shift][0] if cell.shift else "clean", "severity": cell.severity,
        "seed": todo.suite.seed, "spec": {"calibration": todo.suite.calibration, "labels": "original"},
        **{k: v for k, v in result.items() if k != "reason"}, "versions": header["versions"],
        "wall_s": round(seconds, 3),
        "artefacts": {"detections": sorted({str(Path(u.path).parent) for u in cell.units})},
    }  # fmt: skip
