"""Kind `driving`: driving systems x scenarios x repetitions in the embedded world; an episode a cell."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import Field

from ssad.bench.kind import Cell, Column, Job, Kind, Names, Plan, Replay, Resources, SuiteBase, grouped
from ssad.core import safeio
from ssad.core.errors import ConfigError, SSADError, UnknownNameError
from ssad.core.images import save_picture
from ssad.core.lane_graph import SignKind, load_graph, save_graph, town_file
from ssad.core.safeio import plain
from ssad.core.seeding import seed32
from ssad.core.traces import first_difference, load_trace, motion_hash, save_trace, trace_hash
from ssad.core.types import Scenario
from ssad.jobs.machine import quiet_warp
from ssad.metrics import METRICS, episode_metrics
from ssad.recording.closed_loop import (
    HIGHWAY,
    HIGHWAY_TYPE,
    drive,
    embedded,
    episode_of,
    grade_of,
    in_highway,
    load_world,
    policies_of,
    scenario_json,
    system_version,
    town,
    town_version,
    type_version,
)

if TYPE_CHECKING:
    from ssad.drivers.careful.grade import Grade

EMBEDDED = "embedded"  # the name of SSAD's own world as a simulator


class DrivingSuite(SuiteBase):
    """One table: systems x scenarios x repetitions.

    Attributes:
        systems: names, or module:object.
        scenarios: what `load_scenarios` understands (sets, types, names, YAML files), or highway-env: that simulator's
            intersection and highway.
        simulator: embedded, SSAD's own world; or carla://HOST:PORT, a CARLA server (docs/carla.md).
        repetitions: episodes of each pair; the first is the nominal case.
        spread: how far the other repetitions are drawn around it, 1 being the natural spread (docs/scenarios.md); 0:
            not at all, then scenarios without traffic of their own give copies, which count once.
        chunk: cells that run as one batch of the world (results do not depend on it).
        witness: grade each collision: which careful drivers avoid it, and could anybody (docs/careful.md).
        pictures: what the report shows besides (shifts: contact sheets of the distribution shifts; camera: what the
            camera sees).
    """

    kind: Literal["driving"] = "driving"
    systems: Names
    scenarios: Names
    simulator: str = EMBEDDED
    repetitions: int = Field(default=1, ge=1, le=100_000)
    spread: float = Field(default=1.0, ge=0, le=10, allow_inf_nan=False)
    timeout_s: float = Field(default=120.0, gt=0, allow_inf_nan=False)
    chunk: int = Field(default=16, ge=1, le=4096)
    witness: bool = True
    pictures: list[Literal["shifts", "camera"]] = Field(default=[])

    def beside(self, path: Path) -> Self:
        """Scenario files are looked for in the working folder, then beside the suite."""

        def find(ref: str) -> str:
            near = path.parent / ref
            return str(near) if ref.endswith((".yaml", ".yml")) and not Path(ref).exists() and near.exists() else ref

        return self.model_copy(update={"scenarios": [find(ref) for ref in self.scenarios]})


class Driving(Kind):
    """See the module."""

    name = "driving"
    suite = DrivingSuite
    columns = tuple(Column(m.symbol, m.title, m.unit, m.better) for m in METRICS.values() if m.field)
    factors = ("system", "group")

    def plan(self, suite: DrivingSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Systems, scenarios and towns are looked up; with `check`, each scenario is built once."""
        systems = {name: system_version(name) for name in suite.systems}
        if len(systems) != len(suite.systems):
            raise ConfigError(f"suite {suite.name}: systems: a name appears twice")
        scenarios = suite_scenarios(suite)
        if suite.simulator != EMBEDDED:
            from ssad.interchange.carla import Server, probe

            server = Server.of(suite.simulator)
            if any(s.type == HIGHWAY_TYPE for s in scenarios):
                raise ConfigError(f"suite {suite.name}: scenarios of highway-env do not run in {server}")
            if check:
                probe(server)
        towns = {name: town_version(town(name)) for name in sorted({s.town for s in scenarios})}
        cells = tuple(self._cells(suite, scenarios, systems=systems, towns=towns))
        if check:
            for cell in cells[: len(scenarios) * suite.repetitions : suite.repetitions]:
                _check(cell)
        return Plan(self, suite, device, cells, {"towns": towns, "systems": systems})

    def _cells(
        self,
        suite: DrivingSuite,
        scenarios: Sequence[Scenario],
        *,
        systems: Mapping[str, str],
        towns: Mapping[str, str],
    ) -> Sequence[Cell]:
        """The seed does not depend on the system: systems meet the same episodes."""
        found = []
        for system in suite.systems:
            for scenario in scenarios:
                data = scenario_json(scenario)
                text = safeio.dump_json(data)
                group = scenario.group or scenario.type
                versions = [systems[system], towns.get(scenario.town, ""), type_version(scenario.type)]
                versions += [system_version(name) for name in policies_of(scenario)]
                for repetition in range(suite.repetitions):
                    seed = seed32("episode", suite.seed, text, repetition)
                    name = f"{system}/{scenario.name}{f'#{repetition}' if repetition else ''}"
                    spec = {"scenario": data, "system": system, "repetition": repetition}
                    spec["spread"] = suite.spread if repetition else 0.0
                    if suite.simulator != EMBEDDED:
                        spec["simulator"] = suite.simulator
                    fields = {"system": system, "group": group, "cluster": scenario.name}
                    found.append(self.make_cell(name, system, seed, fields, spec, *versions))
        return found

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Copies of the towns lie beside the results, so that a report can be made where they are not imported."""
        keep_towns(plan.inputs["towns"], folder)
        if resources.ray and plan.suite.simulator != EMBEDDED:
            raise ConfigError(f"suite {plan.suite.name}: one worker drives {plan.suite.simulator}; leave out --ray")
        return {"witness": plan.suite.witness}

    def workers(self, plan: Plan, asked: int | None) -> int | None:
        """A CARLA server runs one world: one worker drives it."""
        return asked if asked == 0 or plan.suite.simulator == EMBEDDED else 1

    def batches(self, plan: Plan, cells: Sequence[Cell], workers: int) -> list[list[Cell]]:
        """Cells that share a system and a simulator; with few cells a smaller batch keeps all workers busy."""
        chunk = plan.suite.chunk if plan.suite.simulator == EMBEDDED else 1
        return grouped(cells, chunk, workers=workers, by=lambda c: (c.system, in_highway(c)))

    def start(self, job: Job) -> None:
        """Loads the world's kernels, which are compiled on first use."""
        load_world(job.device)

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Drives the episodes as one batch of the world, measures them, writes their traces."""
        began = time.perf_counter()
        episodes, traces = drive(cells, device=job.device)
        shared = (time.perf_counter() - began) / len(cells)
        results: dict[str, dict[str, Any]] = {}
        for cell, episode, trace in zip(cells, episodes, traces, strict=True):
            began = time.perf_counter()
            artefact = f"traces/{cell.key}.npz"
            save_trace(job.folder / artefact, trace)
            signs = bool((town(trace.town).sign_kind == SignKind.STOP).any())
            metrics = plain(episode_metrics(trace, stop_signs=signs).as_dict())
            found: Grade | None = None
            if job.settings["witness"] and trace.end == "collision" and embedded(cell):
                found = grade_of(episode, trace, job.device)
                metrics |= found.metrics()
            about = {"scenario": episode.scenario.name, "repetition": cell.spec["repetition"], "town": trace.town}
            about |= {"end": trace.end, "trace_hash": trace_hash(trace), "trace": artefact, "metrics": metrics}
            result = {
                "metrics": metrics,
                "artefacts": {"trace": artefact},
                "episode": about,
                "case": motion_hash(trace),
            }
            if found is not None:
                result["witness"] = plain(found.as_dict())
            results[cell.key] = result | {"wall_s": shared + time.perf_counter() - began}
        return results

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Drives the episode again and compares every bit of its trace."""
        quiet_warp()
        recorded = load_trace(folder / record["artefacts"]["trace"])
        _, (trace,) = drive([cell], device=plan.device)
        return Replay(cell, first_difference(recorded, trace), trace, town(trace.town))

    def finish(self, plan: Plan, folder: Path) -> None:
        """The pictures that the suite asks for, made once beside its results."""
        make_pictures(plan.suite.pictures, folder)


def keep_towns(names: Iterable[str], folder: Path) -> None:
    """Copies of towns in a results folder, for a report where they are not imported, and room for traces."""
    for name in names:
        path = folder / "towns" / town_file(name)
        if not path.exists():
            save_graph(town(name), path)
    safeio.make_folder(folder / "traces")


def suite_scenarios(suite: DrivingSuite) -> tuple[Scenario, ...]:
    """All scenarios of a suite, in order, each once. ConfigError when two differ but share a name."""
    from ssad.interchange.highway_env import highway_scenarios
    from ssad.scenarios.dynamic import load_scenarios

    found: dict[str, Scenario] = {}
    for ref in suite.scenarios:
        try:
            loaded = highway_scenarios() if ref == HIGHWAY else load_scenarios(ref)
        except UnknownNameError as error:
            raise UnknownNameError(f"suite {suite.name}: {error}") from None
        for scenario in loaded:
            if found.setdefault(scenario.name, scenario) != scenario:
                raise ConfigError(
                    f"suite {suite.name}: two different scenarios are named '{scenario.name}' (one from {ref}); "
                    "rename one"
                )
    return tuple(found.values())


def _check(cell: Cell) -> None:
    try:
        episode_of(cell)
    except SSADError as error:
        name = f"scenario {cell.spec['scenario']['name']}"
        raise type(error)(str(error) if name in str(error) else f"{name}: {error}") from None


def make_pictures(names: Sequence[str], folder: Path) -> None:
    """Make what is missing of DIR/pictures; pictures.json says what each shows.

    Raises:
        StoreError: A file cannot be written.
    """
    target, captions = folder / "pictures", {}
    if "shifts" in names:
        captions["shifts.jpg"] = "The 11 natural distribution shifts at severity 3, on a street of Larkhill."
        captions["shifts-severities.jpg"] = "Each shift at severities 1 to 5."
        if not all((target / name).is_file() for name in captions):
            from ssad.recording.nuscenes_recorder import Recording, record_nuscenes
            from ssad.toolbox.contact_sheet import write_sheets

            with tempfile.TemporaryDirectory() as temporary:
                street = Recording(Path(temporary) / "street", ("Larkhill",), scenes=1, seconds=0.5, width=960)
                write_sheets(record_nuscenes(street, workers=0), safeio.make_folder(target) / "shifts.jpg")
    if "camera" in names:
        from ssad.recording.camera_sheets import write_gallery
        from ssad.recording.onboard import onboard_sheet, pick_trace

        captions |= write_gallery(safeio.make_folder(target))
        chosen = pick_trace(folder)
        if chosen is not None:
            captions["camera.jpg"] = f"An episode of this run ({chosen.stem}) from the ego's camera and from above."
            if not (target / "camera.jpg").is_file():
                trace = load_trace(chosen)
                graph = load_graph(folder / "towns" / town_file(trace.town))
                save_picture(target / "camera.jpg", onboard_sheet(trace, graph))
    if captions:
        safeio.write_atomic(target / "pictures.json", safeio.dump_json(captions, indent=1) + "\n")
