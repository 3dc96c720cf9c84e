"""Films of traffic from above: `python -m benchmarks.traffic_film --town Twinford --minutes 5 --out DIR`.

Drives one scene as `benchmarks.traffic` does, with drivers of the population, walkers and cyclists, and draws its
busiest junctions side by side: lanes, stop lines in the colour of their signal, brake lights, turn signals, the number
and the speed of each agent, and the clock. The recorded drive lies beside the film (`TOWN.npz`) and is used again:
`--at X,Y` shows another place, `--agent N` goes with an agent, `--whole` shows the town, `--begin S --end S` take a
part, and `--sheet S` writes pictures S seconds apart on one sheet instead of a film. The command prints conspicuous
moments: contacts, bodies that nearly touch, hard braking, starts on red, vehicles that stand without a reason.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from benchmarks.traffic import SETTLE, town_routes, traffic
from ssad.core.geometry import corners, obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.lane_strips import LAYERS, junction_areas, make_lane_strips
from ssad.core.machine import start_warp_quietly
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import atomic_path, load_npz, save_npz
from ssad.core.top_view import BODY, EDGE, GROUND, LAMP, ROAD, SIDEWALK, VEHICLE, Frame
from ssad.core.types import AgentKind, Episode, LaneType, Route, SignalState, TrafficPlan
from ssad.report.video import save_frames
from ssad.scenarios.dynamic.knowledge.vulnerable_users import draw_cyclists, draw_walkers
from ssad.world.kernels.data import LEADERS, NO_LEADER, Presence
from ssad.world.roads import load_town
from ssad.world.world import VERSION, World

ROUTES = 200  # of a town, from which each vehicle takes one
LENGTH = 9000.0  # m of a route, too long for a vehicle to arrive
BRAKES = 0.4  # m/s^2 from which the brake lights are on
AREA = 30.0  # m around the middle of a junction within which vehicles count for it
VIEWS = 4  # junctions of a film
VIEW = (960, 540)  # pixels of a view
VIEW_WIDTH = 100.0  # m that a view shows from left to right
HARD = 4.0  # m/s^2 of braking that is reported
NEAR = 0.3  # m between two bodies that is reported
IDLE = 15.0  # s at rest that are reported, if no signal, leader or junction explains them
PAST_LINE = 2.5  # m between the stop line and the front of a vehicle that has started
LATE = 1.5  # s of red after which vehicles that entered at yellow have passed
CREEPS = 0.6  # m/s
SHORT_STOP = 2.0  # s
OPEN = 20.0  # m to the next leader or line, from which a vehicle is free to go
BRAKE_LIGHT, TURN_LIGHT, CLOCK = (255, 40, 40), (255, 214, 0), (30, 41, 59)
CROSSWALK, ROUND = (214, 214, 206), 4  # OpenCV draws at 1/16 pixel
SUBPIXELS = 1 << ROUND

Floats = npt.NDArray[np.floating[Any]]
Ints = npt.NDArray[np.integer[Any]]
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Drive:
    """Recorded scene: T steps of `dt` s, A agents, S signals.

    Attributes:
        pose: [T, A, 3] x, y (m), yaw (rad).
        speed: [T, A] m/s.
        acceleration: [T, A] m/s^2 along the heading.
        present: [T, A].
        turn: [T, A] turn signal: 1 left, -1 right, 0 none.
        gap: [T, A] m to the vehicle that it follows; infinite without one.
        leader: [T, A] that vehicle, -1 none.
        line: [T, A] m from the front to the next stop line, and to the next junction where that is nearer.
        lane: [T, A] lane under the centre, -1 none.
        signal: [T, S] `SignalState`.
        size: [A, 2] length and width, m.
        kind: [A] `AgentKind`.
        names: [A].
        dt: [1].
    """

    pose: Floats
    speed: Floats
    acceleration: Floats
    present: npt.NDArray[np.bool_]
    turn: Ints
    gap: Floats
    leader: Ints
    line: Floats
    lane: Ints
    signal: Ints
    size: Floats
    kind: Ints
    names: npt.NDArray[np.str_]
    dt: Floats

    def box(self, step: int) -> Floats:
        """Return the boxes at a step [A, 5]: x, y, yaw, length, width."""
        return np.concatenate([self.pose[step].astype(np.float64), self.size.astype(np.float64)], axis=1)


def filmed_episode(graph: LaneGraph, given: argparse.Namespace) -> Episode:
    """Return one scene of traffic with walkers and cyclists near the routes of its first vehicles."""
    routes = town_routes(graph, ROUTES, LENGTH)
    episode = traffic(graph, routes, given.vehicles, key=given.seed, green=False, drivers=given.drivers)
    plan = TrafficPlan(wake_distance=0.0, drivers=given.drivers, walkers=given.walkers, cyclists=given.cyclists)
    near = _joined([agent.route for agent in episode.agents[:4] if agent.route is not None])
    key = ("traffic film", graph.name, given.seed)
    cyclists = draw_cyclists(plan, graph, near, episode.agents, *key)
    standing = [*episode.agents, *cyclists]
    walkers = draw_walkers(plan, graph, near, standing, 60.0 * given.minutes, *key)
    return replace(episode, agents=(*episode.agents, *cyclists, *walkers))


def _joined(routes: Sequence[Route]) -> Route:
    """Return the first 1000 m of some routes, one after the other."""
    names = ("xy", "yaw", "lane", "speed_limit", "width")
    parts = {name: np.concatenate([getattr(route, name)[:1000] for route in routes]) for name in names}
    return Route(**parts, spacing=routes[0].spacing)


def record(graph: LaneGraph, episode: Episode, seconds: float, device: str = "cpu") -> Drive:
    """Drive one episode and keep every step."""
    world = World([episode], {graph.name: graph}, device=device)
    columns: dict[str, list[Any]] = {}
    for _ in range(round(seconds / world.dt)):
        world.step()
        for name, value in _observed(world).items():
            columns.setdefault(name, []).append(value[0])
    stacked = {name: np.stack(values) for name, values in columns.items()}
    state = world.state()
    return Drive(
        **stacked,
        size=state.size[0].astype(np.float32),
        kind=state.kind[0].astype(np.int32),
        names=np.array([agent.name for agent in episode.agents]),
        dt=np.array([world.dt]),
    )


def _observed(world: World) -> dict[str, Any]:
    """Return the arrays of a `Drive` at the current step, of all scenes."""
    state, route = world.state(), world.bank.route[world.assigned]
    point = route[..., 0] + world.array("progress")
    path, rule = world.bank.tables.path[point], world.bank.tables.rule[point]
    pose, half = world.array("pose").copy(), 0.5 * world.bank.size[world.assigned][..., 0]
    beyond = pose[..., :2] - path[..., :2]
    offset = beyond[..., 0] * np.cos(path[..., 2]) + beyond[..., 1] * np.sin(path[..., 2])
    leader = world.work.leader.numpy()
    return {
        "pose": pose,
        "speed": state.speed.copy(),
        "acceleration": state.accel.copy(),
        "present": world.array("active") != Presence.ABSENT,
        "turn": state.turn_signal.astype(np.int8),
        "gap": np.where(leader == NO_LEADER, np.inf, 0.01 * (leader // LEADERS)).astype(np.float32),
        "leader": np.where(leader == NO_LEADER, -1, leader % LEADERS).astype(np.int32),
        "line": (np.minimum(rule[..., 1], rule[..., 2]) - offset - half).astype(np.float32),
        "lane": state.lane.astype(np.int32),
        "signal": state.signal.astype(np.uint8),
    }


def busiest_junctions(graph: LaneGraph, drive: Drive, count: int) -> list[tuple[float, float]]:
    """Return the middles of the junctions in which most vehicles spend time, apart from each other."""
    lanes = drive.lane[drive.present & (drive.lane >= 0)]
    visits = np.bincount(graph.junction[lanes][graph.junction[lanes] >= 0], minlength=1)
    middles: list[tuple[float, float]] = []
    for junction in np.argsort(-visits, kind="stable")[: np.count_nonzero(visits)].tolist():
        points = np.concatenate(
            [graph.xy[graph.points(lane)] for lane in np.flatnonzero(graph.junction == junction).tolist()]
        )
        x, y = (float(value) for value in 0.5 * (points.min(axis=0) + points.max(axis=0)))
        if all(math.dist((x, y), other) > AREA for other in middles):
            middles.append((x, y))
        if len(middles) == count:
            break
    return middles


class View:
    """View of a place from above, north up; the roads are drawn once.

    Args:
        graph: The town.
        centre: Middle of the view, m.
        size: Pixels.
        width: m from left to right.
    """

    def __init__(self, graph: LaneGraph, centre: tuple[float, float], size: tuple[int, int], width: float) -> None:
        self.graph, self.size, self.width, self.scale = graph, size, width, size[0] / width
        self.strips = make_lane_strips(graph)
        self.areas = junction_areas(graph, self.strips)
        self.move(centre)

    def move(self, centre: tuple[float, float]) -> None:
        """Show another place."""
        graph, size, self.centre = self.graph, self.size, centre
        self.background: Frame = np.full((size[1], size[0], 3), GROUND, np.uint8)
        self.image = self.background
        for area in self.areas:
            self._fill(area, ROAD)
        for strip in self.strips:
            self._fill(strip.outline, SIDEWALK if strip.layer == 0 else ROAD)
            if strip.layer == LAYERS[LaneType.DRIVING] and not strip.junction:
                self._line(strip.left, EDGE, 1)
                self._line(strip.right, EDGE, 1)
        for begin, end in zip(graph.crosswalk_offset[:-1], graph.crosswalk_offset[1:], strict=True):
            self._line(graph.crosswalk_xy[begin:end], CROSSWALK, 1, closed=True)

    def draw(self, drive: Drive, step: int, caption: str) -> Frame:
        """Return an RGB image [H, W, 3] of a step."""
        self.image = self.background.copy()
        self._stop_lines(drive.signal[step])
        for agent in np.flatnonzero(drive.present[step]).tolist():
            self._agent(drive, step, agent)
        cv2.putText(self.image, caption, (12, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.65, CLOCK, 2, cv2.LINE_AA)
        return self.image

    def _stop_lines(self, states: Ints) -> None:
        for signal, x, y, yaw, half in _stop_lines(self.graph):
            colour = LAMP.get(int(states[signal]))
            if colour is not None:
                side = half * np.array([-math.sin(yaw), math.cos(yaw)])
                self._line([np.array([x, y]) - side, np.array([x, y]) + side], colour, 4)

    def _agent(self, drive: Drive, step: int, agent: int) -> None:
        x, y, yaw = (float(value) for value in drive.pose[step, agent])
        length, width = (float(value) for value in drive.size[agent])
        kind = AgentKind(int(drive.kind[agent]))
        self._fill(corners(x, y, yaw, length, width), BODY.get(kind, VEHICLE))
        forward, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])

        def part(along: float, aside: float, long: float, wide: float, colour: Colour) -> None:
            middle = np.array([x, y]) + along * forward + aside * left
            self._fill(corners(middle[0], middle[1], yaw, long, wide), colour)

        if kind != AgentKind.WALKER:
            part(0.28 * length, 0.0, 0.12 * length, 0.8 * width, (226, 232, 240))
            if drive.acceleration[step, agent] < -BRAKES or drive.speed[step, agent] < 0.1:
                part(0.2 - 0.5 * length, 0.0, 0.4, width, BRAKE_LIGHT)
            turn = int(drive.turn[step, agent])
            if turn != 0 and step * float(drive.dt[0]) % 1.0 < 0.6:  # it blinks
                for along in (0.5 * length - 0.3, 0.3 - 0.5 * length):
                    part(along, 0.5 * turn * width, 0.6, 0.4, TURN_LIGHT)
        place = tuple(int(value) // SUBPIXELS for value in self._pixels([[x + 1.2, y + 1.2]])[0])
        label = f"{agent}" if kind == AgentKind.WALKER else f"{agent} {drive.speed[step, agent]:.0f}"
        cv2.putText(self.image, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, CLOCK, 3, cv2.LINE_AA)
        cv2.putText(self.image, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1, cv2.LINE_AA)

    def _pixels(self, xy: npt.ArrayLike) -> npt.NDArray[np.int32]:
        pixels = (np.asarray(xy, np.float64) - self.centre) * (self.scale, -self.scale)
        pixels += (self.size[0] / 2, self.size[1] / 2)
        return np.round(pixels * SUBPIXELS).astype(np.int32)

    def _fill(self, xy: npt.ArrayLike, colour: Colour) -> None:
        cv2.fillPoly(self.image, [self._pixels(xy)], colour, cv2.LINE_AA, ROUND)

    def _line(self, xy: npt.ArrayLike, colour: Colour, width: int, *, closed: bool = False) -> None:
        cv2.polylines(self.image, [self._pixels(xy)], closed, colour, width, cv2.LINE_AA, ROUND)


def frames(views: Sequence[View], drive: Drive, steps: Sequence[int], agent: int | None = None) -> Iterator[Frame]:
    """Yield the views side by side, two in a row; with an agent, the first view goes with it."""
    for step in steps:
        clock = f"{drive.dt[0] * (step + 1):6.1f} s"
        if agent is not None:
            x, y, _ = drive.pose[step, agent].tolist()
            views[0].move((x, y))
        pictures = [view.draw(drive, step, f"{clock}  ({view.centre[0]:.0f}, {view.centre[1]:.0f})") for view in views]
        if len(pictures) % 2 and len(pictures) > 1:
            pictures.append(np.full_like(pictures[0], 255))
        rows = [np.concatenate(pictures[row : row + 2], axis=1) for row in range(0, len(pictures), 2)]
        yield np.concatenate(rows, axis=0)


def remarks(graph: LaneGraph, drive: Drive) -> list[tuple[float, str]]:
    """Return the conspicuous moments after the settling time: time in s, and agents, places and values in one line."""
    lines: list[tuple[float, str]] = []
    dt, steps = float(drive.dt[0]), len(drive.speed)
    moves = drive.kind != AgentKind.WALKER

    def tell(step: int, agent: int, text: str) -> None:
        x, y, _ = drive.pose[step, agent].tolist()
        lines.append((dt * (step + 1), f"{agent} ({drive.names[agent]}) at ({x:.0f}, {y:.0f}): {text}"))

    near_before: set[tuple[int, int]] = set()
    for step in range(steps):
        near_now = set(_near_pairs(drive, step))
        for first, second in sorted(near_now - near_before):
            apart = float(obb_distance(drive.box(step)[first], drive.box(step)[second]))
            speeds = f"{drive.speed[step, first]:.1f} and {drive.speed[step, second]:.1f} m/s"
            tell(step, first, f"{apart:.2f} m from {second} ({drive.names[second]}), {speeds}")
        near_before = near_now
    hard = moves & drive.present & (drive.acceleration < -HARD)
    for step, agent in np.argwhere(hard[1:] & ~hard[:-1]).tolist():
        strength = float(-drive.acceleration[step + 1 : step + 11, agent].min())
        tell(step + 1, agent, f"brakes by up to {strength:.1f} m/s² from {drive.speed[step, agent]:.1f} m/s")
    stands = moves & drive.present & (drive.speed < 0.2) & (drive.gap > OPEN) & (drive.line > OPEN)
    _spells(stands, dt, lambda step, agent, s: tell(step, agent, f"stands for {s:.0f} s, nothing within {OPEN:.0f} m"))
    waits = moves & drive.present & (drive.speed < 0.2)
    _spells(waits, dt, lambda step, agent, s: tell(step, agent, f"stands for {s:.0f} s") if s > 60.0 else None)
    off = moves & drive.present & (drive.lane < 0)
    _spells(off, dt, lambda step, agent, s: tell(step, agent, f"off the lanes for {s:.1f} s"), 0.5)
    for step, agent, red in _red_starts(graph, drive):
        tell(step, agent, f"passes its stop line {red:.1f} s after red began")
    return sorted(line for line in lines if line[0] > SETTLE)


def summary(drive: Drive) -> str:
    """Return how often the vehicles creep and stop, and the greatest acceleration to the side, after the settling."""
    dt = float(drive.dt[0])
    first = round(SETTLE / dt)
    vehicles = np.isin(drive.kind, [AgentKind.WALKER, AgentKind.BICYCLE], invert=True)
    speed, present = np.abs(drive.speed[first:, vehicles]), drive.present[first:, vehicles]
    creeps = present & (speed > 0.05) & (speed < CREEPS)
    stops: list[float] = []
    _spells(present & (speed < 0.2), dt, lambda _step, _agent, seconds: stops.append(seconds), 0.0)
    turned = wrap_angle(np.diff(drive.pose[first:, vehicles, 2].astype(np.float64), axis=0))
    side = np.where(present[1:] & present[:-1], np.abs(turned) / dt * speed[1:], 0.0)
    return (
        f"creeping (below {CREEPS:g} m/s) {creeps.sum() / max(present.sum(), 1):.1%} of the time; {len(stops)} stops, "
        f"{sum(seconds < SHORT_STOP for seconds in stops)} of them below {SHORT_STOP:g} s; up to {side.max():.1f} m/s² "
        "to the side"
    )


def _red_starts(graph: LaneGraph, drive: Drive) -> Iterator[tuple[int, int, float]]:
    """Yield step, agent and s of red where a vehicle crosses a stop line on red, except for turns to the near side."""
    forward = np.stack([np.cos(drive.pose[..., 2]), np.sin(drive.pose[..., 2])], axis=-1)
    front = drive.pose[..., :2] + 0.5 * drive.size[:, 0, None] * forward
    near_side = 1 if graph.left_hand[0] else -1
    able = drive.present & (drive.kind != AgentKind.WALKER) & (drive.turn != near_side)
    for signal, x, y, yaw, half in _stop_lines(graph):
        along = np.array([math.cos(yaw), math.sin(yaw)])
        offset = front - np.array([x, y])
        beyond, aside = offset @ along, offset @ np.array([-along[1], along[0]])
        on_lane = able & (np.abs(aside) < half) & (forward @ along > 0.8)
        passed = on_lane[1:] & on_lane[:-1] & (beyond[:-1] < PAST_LINE) & (beyond[1:] >= PAST_LINE)
        red = drive.signal[:, signal] == SignalState.RED
        for step, agent in np.argwhere(passed & red[1:, None]).tolist():
            other = np.flatnonzero(~red[: step + 1])
            seconds = float(drive.dt[0]) * (step + 1 - (int(other[-1]) if len(other) else 0))
            if seconds > LATE:
                yield step + 1, agent, seconds


def _stop_lines(graph: LaneGraph) -> Iterator[tuple[int, float, float, float, float]]:
    """Yield signal, x, y, yaw and half width, in m and rad, of each stop line."""
    for signal, lane, s in zip(graph.stop_signal, graph.stop_lane, graph.stop_s, strict=True):
        points = graph.points(int(lane))
        x, y = (float(np.interp(s, graph.s[points], graph.xy[points, axis])) for axis in (0, 1))
        yaw = float(np.interp(s, graph.s[points], np.unwrap(graph.yaw[points])))
        yield int(signal), x, y, yaw, 0.45 * float(np.interp(s, graph.s[points], graph.width[points]))


def _near_pairs(drive: Drive, step: int) -> Iterator[tuple[int, int]]:
    """Yield the pairs whose bodies are nearer than NEAR, one of them moving; walkers of a group are left out."""
    box = drive.box(step)
    agents = np.flatnonzero(drive.present[step])
    for index, first in enumerate(agents.tolist()):
        others = agents[index + 1 :]
        reach = 0.5 * (box[first, 3] + box[others, 3]) + 1.0
        close = np.hypot(*(box[others, :2] - box[first, :2]).T) < reach
        for second in others[close].tolist():
            if drive.kind[first] == drive.kind[second] == AgentKind.WALKER:
                continue
            moving = max(abs(drive.speed[step, first]), abs(drive.speed[step, second])) > 0.5
            if moving and float(obb_distance(box[first], box[second])) < NEAR:
                yield first, second


def _spells(
    state: npt.NDArray[np.bool_], dt: float, tell: Callable[[int, int, float], None], least: float = IDLE
) -> None:
    """Call `tell(step, agent, seconds)` for every time that a state [T, A] holds on for longer than `least`."""
    for agent in range(state.shape[1]):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], state[:, agent].astype(np.int8), [0]])))
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if dt * (end - begin) >= least:
                tell(begin, agent, dt * (end - begin))


def contact_sheet(pictures: Sequence[Frame], columns: int) -> Frame:
    """Return pictures in rows of `columns`."""
    blank = np.full_like(pictures[0], 255)
    padded = [*pictures, *[blank] * (-len(pictures) % columns)]
    rows = [np.concatenate(padded[row : row + columns], axis=1) for row in range(0, len(padded), columns)]
    return np.concatenate(rows, axis=0)


def main() -> None:
    """Drive or load, print, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--town", default="Twinford", help="name or file")
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--out", type=Path, required=True, help="folder of the film and the recorded drive")
    parser.add_argument("--drivers", choices=("uniform", "population"), default="population")
    parser.add_argument("--vehicles", type=int, default=40)
    parser.add_argument("--walkers", type=int, default=16)
    parser.add_argument("--cyclists", type=int, default=5)
    parser.add_argument("--seed", type=int, default=5000, help="number of the scene; published tables use those from 0")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--anew", action="store_true", help="drive again: the recorded drive is of another version")
    parser.add_argument("--speed", type=int, default=4, help="times as fast as life")
    parser.add_argument("--at", type=_numbers, help="X,Y in m: one view, there")
    parser.add_argument("--agent", type=int, help="one view, which goes with this agent")
    parser.add_argument("--whole", action="store_true", help="one view of the whole town")
    parser.add_argument("--width", type=float, default=VIEW_WIDTH, help="m that a view shows from left to right")
    parser.add_argument("--begin", type=float, default=0.0, help="s")
    parser.add_argument("--end", type=float, default=math.inf, help="s")
    parser.add_argument("--sheet", type=float, help="s between the pictures of a sheet; no film")
    parser.add_argument("--size", type=_numbers, default=VIEW, help="W,H of a view in pixels")
    parser.add_argument("--columns", type=int, default=3, help="of a sheet")
    given = parser.parse_args()
    start_warp_quietly()
    graph = load_town(given.town)
    drive, is_new = recorded(graph, given)
    if is_new:
        for time, line in remarks(graph, drive):
            print(f"{time:6.1f} s  {line}")
        print(summary(drive))
    name, views = views_of(graph, drive, given)
    dt, steps = float(drive.dt[0]), len(drive.speed)
    first, last = round(given.begin / dt), round(min(given.end / dt, steps))
    if given.sheet:
        shown = range(first, last, max(1, round(given.sheet / dt)))
        path = given.out / f"{graph.name}-{name}-{given.begin:.0f}.jpg"
        sheet = contact_sheet([*frames(views, drive, shown, given.agent)], given.columns)
        with atomic_path(path) as temporary:
            Image.fromarray(sheet).save(temporary, "JPEG", quality=80)
    else:
        path = given.out / f"{graph.name}-{name}.mp4"
        save_frames(frames(views, drive, range(first, last), given.agent), path, dt=dt / given.speed)
    print(path)


def views_of(graph: LaneGraph, drive: Drive, given: argparse.Namespace) -> tuple[str, list[View]]:
    """Return a name for the views that were asked for, and the views."""
    size = int(given.size[0]), int(given.size[1])
    if given.agent is not None:
        return f"agent-{given.agent}", [View(graph, (0.0, 0.0), size, given.width)]
    if given.at:
        return "{:.0f},{:.0f}".format(*given.at), [View(graph, given.at, size, given.width)]
    if given.whole:
        lower, upper = graph.xy.min(axis=0) - 10.0, graph.xy.max(axis=0) + 10.0
        x, y = (0.5 * (lower + upper)).tolist()
        width = max(upper[0] - lower[0], (upper[1] - lower[1]) * size[0] / size[1])
        return "town", [View(graph, (x, y), size, float(width))]
    middles = busiest_junctions(graph, drive, VIEWS)
    return "junctions", [View(graph, middle, size, given.width) for middle in middles]


def _numbers(text: str) -> tuple[float, float]:
    x, y = text.split(",")
    return float(x), float(y)


def recorded(graph: LaneGraph, given: argparse.Namespace) -> tuple[Drive, bool]:
    """Return the drive in the output folder if it is of the same command, else a new one, and whether it is new."""
    file, same = given.out / f"{graph.name}.npz", ("minutes", "drivers", "vehicles", "walkers", "cyclists", "seed")
    about = json.dumps({"world": VERSION} | {name: getattr(given, name) for name in same})
    if file.is_file() and not given.anew:
        arrays = load_npz(file)
        if str(arrays.pop("about")) == about:
            return Drive(**arrays), False
    drive = record(graph, filmed_episode(graph, given), 60.0 * given.minutes, given.device)
    given.out.mkdir(parents=True, exist_ok=True)
    save_npz(file, {field.name: getattr(drive, field.name) for field in fields(Drive)} | {"about": np.array(about)})
    return drive, True


if __name__ == "__main__":
    main()
