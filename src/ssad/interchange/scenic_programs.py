"""Scenic programs as scenarios: each sample is simulated, and the simulation becomes a scenario.

The ego is driven anew by the system under test, along the path that the program drove; all other agents repeat their
motion of the simulation. A Scenic program is code: run only trusted programs. Needs the extra `scenic`.
"""

from __future__ import annotations

import contextlib
import io
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core.errors import ConfigError, MissingExtraError, RouteError, SSADError
from ssad.core.generators import Base, GeneratorFactory, Outcome, Proposal
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.registry import describe
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import home_folder, make_folder, read_text, write_atomic
from ssad.core.seeding import digest
from ssad.core.types import F64, Actor, EpisodeLimits, LaneType, Pose, Scenario
from ssad.interchange.ego_start import start_parameters
from ssad.interchange.scenario_parts import scenario_name
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.frozen import agent_pose, extend_by_stop, round_rows
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, lane_path
from ssad.world.roads import load_town, route_along, town_names, town_xodr
from ssad.world.roads.query import nearest_all

MODEL: Final = "ssad.interchange.scenic_model"
STEP: Final = 0.1  # s
STEPS: Final = 300  # largest number of steps of a simulation
SCENES: Final = 2000  # scenes drawn before the requirements of a program count as impossible
TRIES: Final = 10  # simulations before they do
KEY_POINT: Final = 25.0  # m between key points of the ego's route
LEAST: Final = 15.0  # m, an ego that drives less follows its lane instead of its own path
BEYOND: Final = 50.0  # m along its lane by which the route of an ego is extended
WAY: Final = 120.0  # m, length of the route along its lane of any other ego
STILL: Final = 0.05  # m; an agent that moves less is standing
_MOST: Final = 60.0  # m/s


@dataclass(frozen=True)
class ScenicProgram:
    """A Scenic program, compiled for a town.

    Attributes:
        path: Its file.
        town: Name of the town.
        graph: The town.
        compiled: Scenic's scenario.
    """

    path: Path
    town: str
    graph: LaneGraph
    compiled: Any


@dataclass(frozen=True)
class SampledScenario:
    """A sample of a program.

    Attributes:
        scenario: The scenario.
        end_reason: Scenic's reason for the end of the simulation.
    """

    scenario: Scenario
    end_reason: str


def load_program(path: Path, town: str | None = None, parameters: Mapping[str, Any] | None = None) -> ScenicProgram:
    """Compile a program.

    Args:
        path: Its file.
        town: Its town; None: the town with the name of the program's map file.
        parameters: Global parameters to override.

    Raises:
        ConfigError: The program is broken, or its map is no existing town.
        MissingExtraError: Scenic is not installed.
    """
    if town is not None and town not in town_names():
        load_town(town)  # raises an error that lists the towns
    if path.suffix != ".scenic" or not path.is_file():
        raise ConfigError(f"{path}: no such Scenic program (a file that ends in .scenic)")
    read_text(path, limit=1 << 20)
    with _suppress_output():
        try:
            import scenic
        except ModuleNotFoundError:
            raise MissingExtraError(f"{path}", "scenic") from None
        global_parameters = dict(parameters or {})
        if town is not None:
            global_parameters["map"] = str(_map_file(town))
        try:
            with _global_seeds(0):
                compiled = scenic.scenarioFromFile(str(path), params=global_parameters, model=MODEL, mode2D=True)
        except (Exception, SystemExit) as error:  # a program can raise anything
            raise _error_line(path, error) from None
        if compiled.egoObject is None:
            raise ConfigError(f"{path}: it has no ego")
    town_name = town or Path(str(compiled.params.get("map", ""))).stem
    return ScenicProgram(path, town_name, load_town(town_name), compiled)


def sample(
    program: ScenicProgram,
    seed: int,
    *,
    steps: int = STEPS,
    name: str | None = None,
    report: ImportReport | None = None,
) -> SampledScenario:
    """Draw a scene, simulate it, and convert the simulation to a scenario.

    Args:
        program: The program.
        seed: Seed of all of Scenic's draws.
        steps: Largest number of steps of 0.1 s.
        name: Name of the scenario; None: from the program and the seed.
        report: Filled with what of the simulation the scenario does not carry.

    Raises:
        ConfigError: No scene, or no simulation, meets the program's requirements, or the program fails.
        RouteError: The ego does not stand on a road.
    """
    from scenic.core.distributions import RejectionException

    location = f"{program.path}, seed {seed}"
    with _suppress_output(), _global_seeds(seed):
        try:
            scene, _ = program.compiled.generate(maxIterations=SCENES)
            simulator = program.compiled.getSimulator()
            simulation = simulator.simulate(scene, maxSteps=steps, maxIterations=TRIES)
        except RejectionException:
            raise ConfigError(f"{location}: none of {SCENES} scenes meets its requirements") from None
        except (Exception, SystemExit) as error:
            raise _error_line(program.path, error, f", seed {seed}") from None
    if simulation is None:
        raise ConfigError(f"{location}: none of {TRIES} simulations meets its requirements")
    label = name or f"{scenario_name(program.path.stem) or 'scenic'}/{seed:02d}"
    try:
        return _scenario(program, simulation, label, seed, ImportReport(location) if report is None else report)
    except (ConfigError, RouteError) as error:
        raise type(error)(f"{location}: {error}") from None


def map_of(town: str) -> Path:
    """Return the OpenDRIVE file of a town, for `param map` of a program."""
    return _map_file(town)


# ---------------------------------------------------------------- a generator


def scenic_search(path: str) -> GeneratorFactory:
    """Return the search that samples a Scenic program; the entry point behind "scenic:FILE".

    Raises:
        MissingExtraError: Scenic is not installed.
    """
    if find_spec("scenic") is None:
        raise MissingExtraError(f"generator 'scenic:{path}'", "scenic")
    return partial(ScenicSearch, path)


class ScenicSearch:
    """Samples of a Scenic program in the towns of the bases; learns nothing."""

    name = "scenic"

    def __init__(self, path: str, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        towns = {base.graph.name for base in bases}
        self._programs = {town: load_program(Path(path), town) for town in sorted(towns)}
        self._bases, self._seeds = tuple(bases), tuple(seeds)
        self._sample_counts = [0] * len(self._bases)

    def ask(self, count: int) -> list[list[Proposal]]:
        """Return the next samples of each base; samples that meet no requirements are left out."""
        return [self._base_proposals(base_index, count) for base_index in range(len(self._bases))]

    def _base_proposals(self, b: int, count: int) -> list[Proposal]:
        base, proposals = self._bases[b], []
        for _ in range(count):
            seed = int(digest("scenic", self._seeds[b], self._sample_counts[b])[:8], 16)
            self._sample_counts[b] += 1
            with contextlib.suppress(SSADError):
                proposals.append(Proposal(sample(self._programs[base.graph.name], seed).scenario))
        return proposals

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Do nothing: the search does not learn."""


# ---------------------------------------------------------------- internals


def _map_file(town: str) -> Path:
    """Return the file of a town's map for Scenic, which stores its own results beside it."""
    path = make_folder(home_folder() / "scenic") / f"{Path(town).stem}.xodr"
    text = town_xodr(town)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        write_atomic(path, text)
    return path


def _error_line(path: Path, error: BaseException, suffix: str = "") -> ConfigError:
    """Return a ConfigError of one line for an error in a program: its file and the line that raised it."""
    line = getattr(error, "lineno", None)
    trace = error.__traceback__
    while trace is not None and not isinstance(line, int):
        # The last frame of the program before code of other files.
        if trace.tb_frame.f_code.co_filename == str(path.resolve()):
            line = None
            trace_line = trace.tb_lineno
            following = trace.tb_next
            if following is None or following.tb_frame.f_code.co_filename != str(path.resolve()):
                line = trace_line
        trace = trace.tb_next
    message = " ".join(str(error).split())[:300] or describe(error)
    location = f"{path}:{line}" if isinstance(line, int) else f"{path}"
    return ConfigError(f"{location}{suffix}: {type(error).__name__}: {message}")


@contextlib.contextmanager
def _global_seeds(seed: int) -> Iterator[None]:
    """Seed the global generators of Python and numpy, which Scenic draws from, and restore them afterwards."""
    previous_states = random.getstate(), np.random.get_state()  # noqa: NPY002
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(previous_states[0])
        np.random.set_state(previous_states[1])  # noqa: NPY002


@contextlib.contextmanager
def _suppress_output() -> Iterator[None]:
    """Suppress the output and warnings of Scenic and of the libraries that it loads."""
    import warnings

    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _scenario(program: ScenicProgram, drive: Any, name: str, seed: int, report: ImportReport) -> SampledScenario:
    rows = np.stack(drive.rows)
    ego = rows[:, 0]
    key_points, speed = _route(program, ego, report, f"seed {seed}")
    ego_route = route_along(program.graph, key_points)
    end_time = STEP * (len(rows) + 100)
    start_pose = Pose(*ego[0, :3].tolist())
    top_speed = float(np.clip(np.abs(ego[:, 3]).max(), 0.0, _MOST))
    scenario = Scenario(
        name=name,
        type="Custom",
        town=program.town,
        route=key_points,
        parameters=start_parameters(ego_route, start_pose, max(speed, 0.0), digits=6, report=report),
        actors=tuple(_actor(drive, rows, index, end_time) for index in range(1, rows.shape[1])),
        limits=EpisodeLimits(max_steps=len(rows) + 100),
        target_speed=round(top_speed, 2) if top_speed >= 1.0 else 8.0,
        group=scenario_name(program.path.stem),
        source=f"Scenic {program.path.name}, seed {seed}",
    )
    build_episode(scenario, program.graph, seed=0)
    for index, model in enumerate(drive.models):
        size = drive.sizes[index]
        if (
            index
            and max(abs(extent - model_extent) for extent, model_extent in zip(size, _model_size(model), strict=True))
            > 0.01
        ):
            report.omit(
                f"the body of a {size[0]:.3g} x {size[1]:.3g} m object becomes '{model}'",
                f"seed {seed}, {drive.names[index]}",
            )
    reason = str(drive.result.terminationReason)
    report.note(f"simulations end: {reason[:80]}", f"seed {seed}")
    return SampledScenario(scenario, reason)


def _model_size(model: str) -> tuple[float, float]:
    from ssad.world.models import MODELS

    return MODELS[model].length, MODELS[model].width


def _actor(drive: Any, rows: F64, index: int, until: float) -> Actor:
    """Return the actor that replays the motion of an agent other than the ego."""
    time = STEP * np.arange(len(rows))
    trajectory = np.column_stack([time, rows[:, index, :3]])
    if np.hypot(*np.ptp(trajectory[:, 1:3], axis=0)) < STILL:
        return Actor(drive.names[index], drive.models[index], agent_pose(trajectory[0]))
    kept_rows = round_rows(extend_by_stop(trajectory, until))
    return Actor(drive.names[index], drive.models[index], Pose(*kept_rows[0][1:]), trajectory=kept_rows)


def _route(program: ScenicProgram, ego: F64, report: ImportReport, place: str) -> tuple[tuple[Pose, ...], float]:
    """Return the key points of the ego's route, and its speed at the start, m/s."""
    distances = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ego[:, :2], axis=0).T))])
    start = Pose(*ego[0, :3].tolist())
    if distances[-1] >= LEAST:
        key_distances = np.linspace(0.0, distances[-1], max(1, round(distances[-1] / KEY_POINT)) + 1)
        row_indices = np.searchsorted(distances, key_distances, side="left").clip(0, len(ego) - 1)
        route = tuple(Pose(*ego[row_index, :3].tolist()) for row_index in row_indices)
        for extension in (BEYOND, 0.0):  # a system that does not stop where the program's ego did needs more route
            with contextlib.suppress(RouteError):
                extended = (*route, *_key_points_ahead(program.graph, route[-1], extension)[1:]) if extension else route
                if route_along(program.graph, extended).length < 1.5 * distances[-1] + extension + 10.0:
                    return extended, float(ego[0, 3])
        report.omit("the way of the ego, which leaves its lanes: its lane is its route", place)
    return _key_points_ahead(program.graph, start), float(ego[0, 3])


def _key_points_ahead(graph: LaneGraph, start: Pose, way: float = WAY) -> tuple[Pose, ...]:
    """Key points along the lane under a pose, so many metres."""
    lanes, distances, lane_distances = nearest_all(graph, (start.x, start.y), (LaneType.DRIVING,))
    places = [LanePosition(lane, distance) for lane, distance in zip(lanes.tolist(), distances.tolist(), strict=True)]
    heading_differences = [abs(float(wrap_angle(graph.at(place.lane, place.s)[2] - start.yaw))) for place in places]
    candidates = [
        index
        for index in range(len(places))
        if lane_distances[index] <= 2.0 and heading_differences[index] < 0.5 * math.pi
    ]
    if not candidates:
        raise RouteError(f"the ego does not stand on a road of '{graph.name}' that goes its way")
    path = lane_path(
        graph,
        places[min(candidates, key=lambda index: (max(float(lane_distances[index]), 0.0), heading_differences[index]))],
        way,
    )
    if len(path) < 3:
        raise RouteError(f"the road ends before the ego in '{graph.name}'")
    point_indices = np.unique(np.linspace(0, len(path) - 2, 6).astype(int))[1:]
    directions = path[point_indices + 1] - path[point_indices]
    rows = np.column_stack([path[point_indices], np.arctan2(directions[:, 1], directions[:, 0])])
    return (start, *(Pose(x, y, yaw) for x, y, yaw in rows.tolist()))
