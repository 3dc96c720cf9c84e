"""Kind `gap`: perceiving systems x scenarios x perturbations of their cameras x severities; an episode a cell.

The same drive gives metrics of the component, on the very pictures that the driver got, and metrics of the system.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ssad.bench.kind import Cell, Column, Job, Kind, Names, Plan, Replay, Resources, SuiteBase, grouped
from ssad.bench.kinds.driving import keep_towns, suite_scenarios
from ssad.core import safeio
from ssad.core.driving import Driver
from ssad.core.errors import ConfigError
from ssad.core.images import save_picture
from ssad.core.lane_graph import SignKind
from ssad.core.nuscenes_names import CAMERAS
from ssad.core.safeio import plain
from ssad.core.seeding import digest, seed32
from ssad.core.traces import first_difference, load_trace, motion_hash, save_trace, trace_hash
from ssad.core.types import Episode, EpisodeTrace
from ssad.drivers.perceiving.driver import Known, Perceiving, Sighting
from ssad.drivers.perceiving.eyes import CameraEyes, PerfectEyes, front
from ssad.drivers.perceiving.repair import Repair
from ssad.drivers.perceiving.signs import SignReading
from ssad.drivers.perceiving.tracker import Tracking
from ssad.evaluation.drive_perception import (
    BANDS,
    Watcher,
    cause_of_collision,
    component_metrics,
    hard_braking,
    impact_speed,
    phantom_stop,
    sign_metrics,
)
from ssad.evaluation.drive_sheet import Seen, drive_film, drive_sheet
from ssad.jobs.machine import quiet_warp
from ssad.metrics import episode_metrics
from ssad.recording.closed_loop import (
    episode_of,
    load_world,
    scenario_json,
    system_of,
    system_version,
    town,
    town_version,
    type_version,
)
from ssad.recording.loop_perturbations import (
    NONE,
    TEXTURE,
    check_perturbation,
    perturbation_names,
    perturbed,
    signs_of_route,
    texture_version,
    wearer,
    who_wears,
    worn,
)

EVERY = 0.2  # s from one frame of a film to the next
Share = Field(default=0.0, ge=0, lt=1, allow_inf_nan=False)


class System(BaseModel):
    """A perceiving system of a suite.

    Attributes:
        name: what tables call it.
        detector: `ssad list detectors`; truth: a perfect detector, which is told the truth.
        weights: a file of weights; none: the shipped ones.
        cameras: of the nuScenes rig.
        width: of their pictures, pixels.
        input_width: width to which a 3D detector resizes them; none: its own.
        rate: looks a second.
        latency: s from a picture to its detections.
        confirm: hits from which an object is believed (H).
        reserve: looks without a hit that it stays believed for (R).
        high, low: scores of the tracker's two stages.
        reads_signs: whether it knows of stop signs only what its detector reads; else those of the map.
        sign_memory: s that a sign is remembered after it was last read; none: until it has been passed.
        missed, burst, noise, phantoms: how a perfect detector fails (`ssad.drivers.perceiving.eyes.PerfectEyes`).
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    name: str = Field(min_length=1)
    detector: str = "fcos3d-light"
    weights: str | None = None
    cameras: list[Literal[CAMERAS]] = Field(default=["CAM_FRONT"], min_length=1)  # type: ignore[valid-type]
    width: int = Field(default=640, ge=64, le=1600)
    input_width: int | None = Field(default=None, ge=64, le=3200)
    rate: float = Field(default=5.0, gt=0, le=100, allow_inf_nan=False)
    latency: float = Field(default=0.1, ge=0, le=10, allow_inf_nan=False)
    confirm: int = Field(default=2, ge=1)
    reserve: int = Field(default=6, ge=0)
    high: float = Field(default=0.3, ge=0, le=1)
    low: float = Field(default=0.1, ge=0, le=1)
    reads_signs: bool = False
    sign_memory: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    missed: float = Share
    burst: float = Field(default=3.0, ge=1, allow_inf_nan=False)
    noise: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    phantoms: float = Field(default=0.0, ge=0, allow_inf_nan=False)

    @property
    def perfect(self) -> bool:
        """Whether it is told the truth."""
        return self.detector == "truth"

    def make(
        self, watch: Callable[[Sighting | Known], None] | None = None, *, repair: Repair | None = None
    ) -> Perceiving:
        """The driver; `watch` is told what it sees, `repair` mends one error of it."""
        cameras = front(self.width, self.cameras)
        eyes: CameraEyes | PerfectEyes
        if self.perfect:
            eyes = PerfectEyes(
                cameras, missed=self.missed, burst=self.burst, noise=self.noise, phantoms=self.phantoms
            )  # fmt: skip
        else:
            eyes = CameraEyes(_detector(self.detector, self.weights, self.input_width), cameras, threshold=self.low)
        tracking = Tracking(confirm=self.confirm, reserve=self.reserve, high=self.high, low=self.low)
        memory = float("inf") if self.sign_memory is None else self.sign_memory
        signs = SignReading(confirm=self.confirm, memory=memory, score=self.high) if self.reads_signs else None
        return Perceiving(
            eyes, rate=self.rate, latency=self.latency, tracking=tracking, watch=watch, repair=repair, signs=signs
        )  # fmt: skip


class GapSuite(SuiteBase):
    """Systems x scenarios x perturbations.

    Attributes:
        systems: perceiving systems; names must differ.
        ceilings: systems that are told the truth, without perturbations (`ssad list systems`).
        scenarios: what `load_scenarios` understands.
        perturbations: names (docs/gap.md); "none" always runs.
        severities: 1 to 5.
        repetitions, spread, chunk: as in suites of kind driving.
        sheets: pictures of so many drives, collisions first.
        repair: whether drives that end in a collision are driven again with the object that was hit found where it is,
            which tells whether this error alone is to blame.
    """

    kind: Literal["gap"] = "gap"
    systems: list[System] = Field(min_length=1)
    ceilings: list[str] = Field(default=["autopilot", "line-of-sight"])
    scenarios: Names
    perturbations: list[str] = Field(default=[])
    severities: list[int] = Field(default=[3], min_length=1)
    repetitions: int = Field(default=1, ge=1, le=100_000)
    spread: float = Field(default=1.0, ge=0, le=10, allow_inf_nan=False)
    timeout_s: float = Field(default=1200.0, gt=0, allow_inf_nan=False)
    chunk: int = Field(default=4, ge=1, le=4096)
    sheets: int = Field(default=6, ge=0)
    repair: bool = True

    def beside(self, path: Path) -> Self:
        """Scenario files are looked for in the working folder, then beside the suite."""
        near = [str(path.parent / ref) for ref in self.scenarios]
        files = [ref.endswith((".yaml", ".yml")) and not Path(ref).exists() for ref in self.scenarios]
        found = [n if f and Path(n).exists() else ref for ref, n, f in zip(self.scenarios, near, files, strict=True)]
        return self.model_copy(update={"scenarios": found})


class Gap(Kind):
    """See the module."""

    name = "gap"
    suite = GapSuite
    columns = (
        Column("AP", "AP of all objects, on the drive's pictures", "", "higher"),
        Column("recall", "recall of the objects in view, within 2 m", "", "higher"),
        Column("target_recall", "recall of the object that matters", "", "higher"),
        *(
            Column(f"target_recall_{a:.0f}_{b:.0f}", f"the same from {a:.0f} to {b:.0f} m", "", "higher")
            for a, b in BANDS
        ),
        Column("distance_error", "error of its distance", "m", "lower"),
        Column("phantoms", "phantoms a look", "", "lower"),
        Column("believed", "share of the steps in which it is believed where it is", "", "higher"),
        Column("switches", "changes of its track", "", "lower"),
        Column("collision", "CR", "", "lower"),
        Column("impact_speed", "impact speed", "m/s", "lower"),
        Column("route_completion", "RC", "", "higher"),
        Column("min_ttc", "least time to collision", "s", "higher"),
        Column("stop_signs", "stop signs run", "", "lower"),
        Column("sign_recall", "share of the looks in which the stop sign ahead was read", "", "higher"),
        Column("sign_read_at", "m from a stop sign at which one was first read", "m", "higher"),
        Column("hard_braking", "times of braking above 4 m/s^2", "", "lower"),
        Column("phantom_stop_s", "time stood before a phantom", "s", "lower"),
    )
    factors = ("system", "perturbation", "severity")

    def plan(self, suite: GapSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Names are looked up, detectors are built once; with `check`, each scenario is built once."""
        names = [one.name for one in suite.systems] + suite.ceilings
        if len(set(names)) != len(names):
            raise ConfigError(f"suite {suite.name}: systems: a name appears twice")
        for name in suite.perturbations:
            check_perturbation(name)
        if any(severity not in range(1, 6) for severity in suite.severities):
            raise ConfigError(f"suite {suite.name}: severities are 1 to 5, not {suite.severities}")
        versions = {one.name: _version(one) for one in suite.systems}
        versions |= {name: system_version(name) for name in suite.ceilings}
        scenarios = suite_scenarios(suite)  # type: ignore[arg-type]  # the same attributes
        towns = {name: town_version(town(name)) for name in sorted({s.town for s in scenarios})}
        conditions = _conditions(suite)
        wearers: dict[tuple[str, str], int | None] = {}
        kinds = {name: who_wears(name) for name in suite.perturbations if perturbation_names()[name] == TEXTURE}
        if check or kinds:
            for scenario in scenarios:
                episode = episode_of(self._cell(suite, scenario, conditions[0], 0, versions, towns))
                for name, kind in kinds.items():
                    wearers[name, scenario.name] = wearer(kind, episode, town(scenario.town))
        cells = [
            self._cell(
                suite,
                scenario,
                condition,
                repetition,
                versions,
                towns,
                worn_by=wearers.get((condition[1], scenario.name)),
            )
            for condition in conditions
            for scenario in scenarios
            for repetition in range(suite.repetitions)
            if _family(condition) != TEXTURE or wearers[condition[1], scenario.name] is not None
        ]
        return Plan(self, suite, device, tuple(cells), {"towns": towns, "systems": versions})

    def _cell(  # noqa: PLR0917  # plain values
        self, suite: GapSuite, scenario: Any, condition: tuple[Any, str, int], repetition: int,
        versions: Mapping[str, str], towns: Mapping[str, str], *, worn_by: int | None = None,
    ) -> Cell:  # fmt: skip
        """The seed depends on the scenario and the repetition alone, so that all conditions meet the same drives."""
        system, perturbation, severity = condition
        name = system if isinstance(system, str) else system.name
        data = scenario_json(scenario)
        seed = seed32("episode", suite.seed, safeio.dump_json(data), repetition)
        under = f"{perturbation}-{severity}/" if perturbation != NONE else ""
        title = f"{name}/{under}{scenario.name}{f'#{repetition}' if repetition else ''}"
        spec = {
            "scenario": data, "system": name, "repetition": repetition,
            "settings": None if isinstance(system, str) else system.model_dump(mode="json"),
            "spread": suite.spread if repetition else 0.0, "perturbation": perturbation, "severity": severity,
            "repair": suite.repair and not isinstance(system, str),
        }  # fmt: skip
        texture = ""
        if _family(condition) == TEXTURE:
            spec["wearer"], texture = worn_by, texture_version(perturbation)
        fields = {
            "system": name, "perturbation": perturbation, "severity": severity,
            "family": perturbation_names()[perturbation], "group": scenario.group or scenario.type,
            "cluster": scenario.name,
        }  # fmt: skip
        inputs = (versions[name], towns.get(scenario.town, ""), type_version(scenario.type), suite.seed, texture)
        return self.make_cell(title, name, seed, fields, spec, *inputs)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Copies of the towns lie beside the results."""
        keep_towns(plan.inputs["towns"], folder)
        return {"seed": plan.suite.seed, "sheets": plan.suite.sheets > 0}

    def batches(self, plan: Plan, cells: Sequence[Cell], workers: int) -> list[list[Cell]]:
        """Cells of one condition; a batch is of one town, whose street is then built once."""
        return grouped(
            cells, plan.suite.chunk, workers=workers,
            by=lambda c: (
                c.spec["scenario"]["town"], c.system, c.spec["perturbation"], c.spec["severity"], c.spec.get("wearer")
            ),
        )  # fmt: skip

    def start(self, job: Job) -> None:
        """Loads the world's kernels, which are compiled on first use."""
        load_world(job.device)

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Drives the episodes as one batch, and measures component and system."""
        episodes, traces, seen = drive(cells, device=job.device, seed=job.settings["seed"])
        repaired = _repaired(cells, traces, job) if cells[0].spec["repair"] else {}
        results: dict[str, dict[str, Any]] = {}
        for k, (cell, episode, trace) in enumerate(zip(cells, episodes, traces, strict=True)):
            artefacts = {"trace": f"traces/{cell.key}.npz"}
            save_trace(job.folder / artefacts["trace"], trace)
            signs = bool((town(trace.town).sign_kind == SignKind.STOP).any())
            metrics = plain(episode_metrics(trace, stop_signs=signs).as_dict())
            metrics |= {"impact_speed": impact_speed(trace), "hard_braking": hard_braking(trace)}
            about: dict[str, Any] = {"end": trace.end, "trace_hash": trace_hash(trace), "town": trace.town}
            if seen is not None:
                own = System.model_validate(cell.spec["settings"])
                metrics |= component_metrics(trace, seen.perceived(k), sure=own.high)
                metrics |= sign_metrics(trace, seen.perceived(k), signs_of_route(town(trace.town), trace.route))
                metrics["phantom_stop_s"] = phantom_stop(trace, seen.perceived(k))
                about["cause"] = cause_of_collision(trace, seen.perceived(k))
                if job.settings["sheets"] and seen.shots[k]:
                    artefacts["sheet"] = f"sheets/{cell.key}.jpg"
                    picture = drive_sheet(trace, seen.perceived(k), seen.shots[k], town(trace.town))
                    safeio.make_folder(job.folder / "sheets")
                    save_picture(job.folder / artefacts["sheet"], picture)
            metrics = {name: None if value is None else _rounded(value) for name, value in metrics.items()}
            about |= {"repaired": repaired[k]} if k in repaired else {}
            results[cell.key] = {
                "metrics": metrics, "artefacts": artefacts, "case": motion_hash(trace), **about,
                "episode": {"scenario": episode.scenario.name, "metrics": metrics, **about},
            }  # fmt: skip
        return results

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Drives the episode again and compares every bit of its trace; films it beside the clean drive."""
        quiet_warp()
        recorded = load_trace(folder / record["artefacts"]["trace"])
        spec, graph = cell.spec, town(recorded.town)
        clean = replace(cell, spec={k: v for k, v in spec.items() if k != "wearer"} | {"perturbation": NONE})
        drives, again = [], []
        for one in [cell] if spec["perturbation"] == NONE else [clean, cell]:
            _, (trace,), seen = drive([one], device=plan.device, seed=plan.suite.seed)
            again.append(trace)
            if seen is not None and seen.shots[0]:
                title = f"{spec['perturbation']} {spec['severity']}" if one is cell and spec["severity"] else "clean"
                drives.append(Seen(title, trace, seen.perceived(0), seen.shots[0]))
        film = (drive_film(drives, graph, every=EVERY), EVERY) if drives else None
        return Replay(cell, first_difference(recorded, again[-1]), again[-1], graph, film=film)


def drive(
    cells: Sequence[Cell], *, device: str, seed: int, repair: Repair | None = None
) -> tuple[list[Episode], list[EpisodeTrace], Watcher | None]:
    """Episodes and traces of cells of one condition, run as one batch, and what was perceived in them."""
    from ssad.recording.loop_sensors import Onboard
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    first = cells[0].spec
    episodes = [episode_of(cell) for cell in cells]
    # pictures are keyed by the episode: conditions of one drive must share their noise and weather
    episodes = [_paired(episode, cell) for episode, cell in zip(episodes, cells, strict=True)]
    simulator = World(episodes, {episode.town: town(episode.town) for episode in episodes}, device=device)
    if first["settings"] is None:
        traces = rollout(simulator, system_of(cells[0].system))
        return episodes, _named(traces, cells), None
    driver: Driver
    own = System.model_validate(first["settings"])
    watcher = Watcher(front(own.width, own.cameras), len(cells))
    driver = own.make(watcher, repair=repair)
    driver.to(device)
    texture = worn(first["perturbation"], first["wearer"]) if "wearer" in first else None
    onboard = Onboard(device=device, attack=texture)
    sensors, changes = perturbed(
        onboard, driver.cameras, first["perturbation"], first["severity"], detector=driver.detector, seed=seed
    )
    traces = rollout(simulator, driver, sensors=sensors, perturbation=changes)
    return episodes, _named(traces, cells), watcher


def _repaired(cells: Sequence[Cell], traces: Sequence[EpisodeTrace], job: Job) -> dict[int, dict[str, Any]]:
    """Drives that ended in a collision driven again with whom they hit found where it is: does that one error decide?

    Returns:
        By the drive's number: whether there is a collision now, and whether with the same agent.
    """
    first = {k: np.flatnonzero(trace.contact_agent > 0) for k, trace in enumerate(traces)}
    hit = {k: int(traces[k].contact_agent[steps[0]]) for k, steps in first.items() if len(steps)}
    if not hit:
        return {}
    repair = Repair(dict(enumerate(hit.values())))
    _, again, _ = drive([cells[k] for k in hit], device=job.device, seed=job.settings["seed"], repair=repair)
    return {
        k: {"collision": bool(episode_metrics(one, stop_signs=False).collision),
            "same": bool((one.contact_agent == agent).any())}
        for (k, agent), one in zip(hit.items(), again, strict=True)
    }  # fmt: skip


def _family(condition: tuple[Any, str, int]) -> str:
    return perturbation_names()[condition[1]]


def _paired(episode: Episode, cell: Cell) -> Episode:
    return replace(episode, key=digest("gap", cell.spec["scenario"]["name"], cell.seed)[:16])


def _named(traces: Sequence[EpisodeTrace], cells: Sequence[Cell]) -> list[EpisodeTrace]:
    return [replace(trace, key=cell.key) for trace, cell in zip(traces, cells, strict=True)]


def _conditions(suite: GapSuite) -> list[tuple[Any, str, int]]:
    """System, perturbation, severity; ceilings first, then each system clean and perturbed."""
    found: list[tuple[Any, str, int]] = [(name, NONE, 0) for name in suite.ceilings]
    for system in suite.systems:
        found.append((system, NONE, 0))
        if not system.perfect:
            names = [name for name in dict.fromkeys(suite.perturbations) if name != NONE]
            for name in names:
                once = perturbation_names()[name] == TEXTURE  # a texture has no severity
                found += [(system, name, severity) for severity in ([1] if once else dict.fromkeys(suite.severities))]
    return found


@lru_cache(maxsize=4)
def _detector(name: str, weights: str | None, width: int | None) -> Any:
    """A detector, made once a process."""
    from ssad.detectors import make_detector

    options: dict[str, Any] = {} if width is None else {"input_width": width}
    return make_detector(name, weights=weights, **options)


def _version(system: System) -> str:
    """Hash of the weights of a system's detector."""
    from ssad.core.checkpoints import state_hash

    if system.perfect:
        return ""
    return state_hash(_detector(system.detector, system.weights, system.input_width))


def _rounded(value: Any) -> Any:
    return round(value, 6) if isinstance(value, float) else value
