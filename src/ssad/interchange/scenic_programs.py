"""Scenic programs as scenarios: each sample is simulated here, and what happened becomes a scenario.

The ego is driven anew by the system under test, along the way that the program drove it; all others repeat what the
program had them do. A Scenic program is code: run only what you trust. Needs the extra `scenic`.
"""

from __future__ import annotations

import contextlib
import io
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core.errors import ConfigError, MissingExtraError, RouteError, SSADError
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.lane_graph import LaneGraph
from ssad.core.registry import describe
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import home, make_folder, read_text, write_atomic
from ssad.core.seeding import digest
from ssad.core.types import F64, Actor, LaneType, Limits, Pose, Scenario
from ssad.interchange.ego_start import start_parameters
from ssad.interchange.scenario_parts import scenario_name
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.frozen import agent_pose, stopping, told_rows
from ssad.scenarios.dynamic.knowledge._placing import Place, lane_path
from ssad.world.roads import load_town, route_along, town_names, town_xodr
from ssad.world.roads.query import nearest_all

MODEL: Final = "ssad.interchange.scenic_model"
STEP: Final = 0.1  # s
STEPS: Final = 300  # of a simulation, where the program does not end it before
SCENES: Final = 2000  # draws before a program's requirements count as impossible
TRIES: Final = 10  # simulations before they do
KEY_POINT: Final = 25.0  # m between key points of the ego's way
LEAST: Final = 15.0  # m that an ego drives at least for its way to be its route
BEYOND: Final = 50.0  # m along its lane that the way of an ego goes on
WAY: Final = 120.0  # m along its lane that another ego gets
STILL: Final = 0.05  # m; who moves less stands
_MOST: Final = 60.0  # m/s


@dataclass(frozen=True)
class Program:
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
class Sampled:
    """A sample of a program.

    Attributes:
        scenario: The scenario.
        ended: Why the program's simulation ended, in Scenic's words.
        lost: What of it the scenario does not carry, a line each.
    """

    scenario: Scenario
    ended: str
    lost: tuple[str, ...]


def load_program(path: Path, town: str | None = None, parameters: Mapping[str, Any] | None = None) -> Program:
    """Compile a program.

    Args:
        path: Its file.
        town: Town that it takes place in; None: the one whose name the program's map file has.
        parameters: Global parameters that are set otherwise.

    Raises:
        ConfigError: The program is broken, or its map is no town here.
        MissingExtraError: Scenic is not installed.
    """
    if town is not None and town not in town_names():
        load_town(town)  # says which there are
    if path.suffix != ".scenic" or not path.is_file():
        raise ConfigError(f"{path}: no such Scenic program (a file that ends in .scenic)")
    read_text(path, limit=1 << 20)
    with _quiet():
        try:
            import scenic
        except ModuleNotFoundError:
            raise MissingExtraError(f"{path}", "scenic") from None
        given = dict(parameters or {})
        if town is not None:
            given["map"] = str(_map_file(town))
        try:
            with _seeded(0):
                compiled = scenic.scenarioFromFile(str(path), params=given, model=MODEL, mode2D=True)
        except (Exception, SystemExit) as error:  # whatever a program does
            raise _broken(path, error) from None
        if compiled.egoObject is None:
            raise ConfigError(f"{path}: it has no ego")
    name = town or Path(str(compiled.params.get("map", ""))).stem
    return Program(path, name, load_town(name), compiled)


def sample(program: Program, seed: int, *, steps: int = STEPS, name: str | None = None) -> Sampled:
    """Draw a scene, simulate it, and turn what happened into a scenario.

    Args:
        program: The program.
        seed: Of all that Scenic draws.
        steps: Most steps of 0.1 s.
        name: Of the scenario; None: the program's, and the seed.

    Raises:
        ConfigError: No scene, or no simulation, meets the program's requirements, or the program fails.
        RouteError: The ego does not stand on a road.
    """
    from scenic.core.distributions import RejectionException

    where = f"{program.path}, seed {seed}"
    with _quiet(), _seeded(seed):
        try:
            scene, _ = program.compiled.generate(maxIterations=SCENES)
            simulator = program.compiled.getSimulator()
            drive = simulator.simulate(scene, maxSteps=steps, maxIterations=TRIES)
        except RejectionException:
            raise ConfigError(f"{where}: none of {SCENES} scenes meets its requirements") from None
        except (Exception, SystemExit) as error:
            raise _broken(program.path, error, f", seed {seed}") from None
    if drive is None:
        raise ConfigError(f"{where}: none of {TRIES} simulations meets its requirements")
    label = name or f"{scenario_name(program.path.stem) or 'scenic'}/{seed:02d}"
    try:
        return _scenario(program, drive, label, seed)
    except (ConfigError, RouteError) as error:
        raise type(error)(f"{where}: {error}") from None


def map_of(town: str) -> Path:
    """The OpenDRIVE file of a town, for `param map` of a program."""
    return _map_file(town)


# ---------------------------------------------------------------- a generator


class ScenicSearch:
    """Samples of a Scenic program in the towns of the bases; learns nothing."""

    name = "scenic"

    def __init__(self, path: str, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        towns = {base.graph.name for base in bases}
        self._programs = {town: load_program(Path(path), town) for town in sorted(towns)}
        self._bases, self._seeds = tuple(bases), tuple(seeds)
        self._drawn = [0] * len(self._bases)

    def ask(self, count: int) -> list[list[Proposal]]:
        """The next samples of each base; those that meet no requirement are left out."""
        return [self._of(b, count) for b in range(len(self._bases))]

    def _of(self, b: int, count: int) -> list[Proposal]:
        base, found = self._bases[b], []
        for _ in range(count):
            seed = int(digest("scenic", self._seeds[b], self._drawn[b])[:8], 16)
            self._drawn[b] += 1
            with contextlib.suppress(SSADError):
                found.append(Proposal(sample(self._programs[base.graph.name], seed).scenario))
        return found

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Nothing is learned."""


# ---------------------------------------------------------------- inside


def _map_file(town: str) -> Path:
    """Where Scenic finds a town's map; it keeps what it works out beside it."""
    path = make_folder(home() / "scenic") / f"{Path(town).stem}.xodr"
    text = town_xodr(town)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        write_atomic(path, text)
    return path


def _broken(path: Path, error: BaseException, more: str = "") -> ConfigError:
    """What is wrong with a program, in one line: its file and the line of it where something was raised."""
    line = getattr(error, "lineno", None)
    trace = error.__traceback__
    while trace is not None and not isinstance(line, int):
        if trace.tb_frame.f_code.co_filename == str(path.resolve()):
            line = None
            last = trace.tb_lineno
            following = trace.tb_next
            if following is None or following.tb_frame.f_code.co_filename != str(path.resolve()):
                line = last
        trace = trace.tb_next
    text = " ".join(str(error).split())[:300] or describe(error)
    at = f"{path}:{line}" if isinstance(line, int) else f"{path}"
    return ConfigError(f"{at}{more}: {type(error).__name__}: {text}")


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Scenic draws from the global generators of Python and numpy: set them, and put them back as they were."""
    before = random.getstate(), np.random.get_state()  # noqa: NPY002
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what Scenic, and the libraries that it loads, print and warn of."""
    import warnings

    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _scenario(program: Program, drive: Any, name: str, seed: int) -> Sampled:
    rows = np.stack(drive.rows)
    lost: list[str] = []
    ego = rows[:, 0]
    route, speed = _route(program, ego, lost)
    line = route_along(program.graph, route)
    until = STEP * (len(rows) + 100)
    start = Pose(*ego[0, :3].tolist())
    target = float(np.clip(np.abs(ego[:, 3]).max(), 0.0, _MOST))
    scenario = Scenario(
        name=name,
        type="Custom",
        town=program.town,
        route=route,
        parameters=start_parameters(line, start, max(speed, 0.0), digits=6),
        actors=tuple(_actor(drive, rows, k, until) for k in range(1, rows.shape[1])),
        limits=Limits(max_steps=len(rows) + 100),
        target_speed=round(target, 2) if target >= 1.0 else 8.0,
        group=scenario_name(program.path.stem),
        source=f"Scenic {program.path.name}, seed {seed}",
    )
    build_episode(scenario, program.graph, seed=0)
    for k, body in enumerate(drive.models):
        size = drive.sizes[k]
        if k and max(abs(a - b) for a, b in zip(size, _size(body), strict=True)) > 0.01:
            lost.append(f"the body of a {size[0]:.3g} x {size[1]:.3g} m object becomes '{body}'")
    return Sampled(scenario, str(drive.result.terminationReason), tuple(dict.fromkeys(lost)))


def _size(model: str) -> tuple[float, float]:
    from ssad.world.models import MODELS

    return MODELS[model].length, MODELS[model].width


def _actor(drive: Any, rows: F64, k: int, until: float) -> Actor:
    """What one of the others did."""
    time = STEP * np.arange(len(rows))
    way = np.column_stack([time, rows[:, k, :3]])
    if np.hypot(*np.ptp(way[:, 1:3], axis=0)) < STILL:
        return Actor(drive.names[k], drive.models[k], agent_pose(way[0]))
    told = told_rows(stopping(way, until))
    return Actor(drive.names[k], drive.models[k], Pose(*told[0][1:]), trajectory=told)


def _route(program: Program, ego: F64, lost: list[str]) -> tuple[tuple[Pose, ...], float]:
    """Key points of the ego's way, and its speed at the start, m/s."""
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ego[:, :2], axis=0).T))])
    start = Pose(*ego[0, :3].tolist())
    if driven[-1] >= LEAST:
        at = np.linspace(0.0, driven[-1], max(1, round(driven[-1] / KEY_POINT)) + 1)
        kept = np.searchsorted(driven, at, side="left").clip(0, len(ego) - 1)
        route = tuple(Pose(*ego[n, :3].tolist()) for n in kept)
        for beyond in (BEYOND, 0.0):  # who does not stop where the program's ego did drives on
            with contextlib.suppress(RouteError):
                longer = (*route, *_ahead(program.graph, route[-1], beyond)[1:]) if beyond else route
                if route_along(program.graph, longer).length < 1.5 * driven[-1] + beyond + 10.0:
                    return longer, float(ego[0, 3])
        lost.append("the way of the ego, which leaves its lanes: its lane is its route")
    return _ahead(program.graph, start), float(ego[0, 3])


def _ahead(graph: LaneGraph, start: Pose, way: float = WAY) -> tuple[Pose, ...]:
    """Key points along the lane under a pose, so many metres."""
    lanes, along, gap = nearest_all(graph, (start.x, start.y), (LaneType.DRIVING,))
    places = [Place(n, s) for n, s in zip(lanes.tolist(), along.tolist(), strict=True)]
    turn = [abs(float(wrap_angle(graph.at(place.lane, place.s)[2] - start.yaw))) for place in places]
    good = [k for k in range(len(places)) if gap[k] <= 2.0 and turn[k] < 0.5 * math.pi]
    if not good:
        raise RouteError(f"the ego does not stand on a road of '{graph.name}' that goes its way")
    path = lane_path(graph, places[min(good, key=lambda k: (max(float(gap[k]), 0.0), turn[k]))], way)
    if len(path) < 3:
        raise RouteError(f"the road ends before the ego in '{graph.name}'")
    kept = np.unique(np.linspace(0, len(path) - 2, 6).astype(int))[1:]
    step = path[kept + 1] - path[kept]
    rows = np.column_stack([path[kept], np.arctan2(step[:, 1], step[:, 0])])
    return (start, *(Pose(x, y, yaw) for x, y, yaw in rows.tolist()))
