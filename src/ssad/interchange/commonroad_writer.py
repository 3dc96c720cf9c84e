"""Scenarios as CommonRoad XML 2020a: lanelets of the town, obstacles with trajectories, and a planning problem.

A planning problem is a start, a goal and a time limit: the goal is the end of the ego's route, reached with at most
its target speed. Positions are centres of bodies. Facts that only SSAD understands are in the attribute `source`.
"""

from __future__ import annotations

import math
from typing import Final
from xml.etree.ElementTree import Element, indent, tostring

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, AgentKind, Controller, Episode, EpisodeAgent, Pose
from ssad.interchange.commonroad_lanes import write_lanes
from ssad.interchange.commonroad_xml import TYPES, VERSION, add_element, decimal, format_source, points
from ssad.world.models import agent_model, model
from ssad.world.roads import route_along

DATE: Final = "2026-01-01"  # required by the format; fixed, so that a scenario always gives the same text
GOAL: Final = 10.0  # m, radius of the goal around the end of the route
PARTS: Final = (1, 2, 4, 5, 10)  # a file's step may be the world's, or one of these fractions of it
STILL: Final = (Controller.NONE, Controller.TRAJECTORY)
_STATIC = {"barrier": "roadBoundary", "cone": "constructionZone"}


def commonroad_text(
    episode: Episode, graph: LaneGraph, *, number: int = 1, dt: float = 0.1
) -> tuple[str, tuple[str, ...]]:
    """Write an episode as CommonRoad XML 2020a.

    Args:
        episode: The episode; all agents but the ego stand or follow a trajectory
            (`ssad.scenarios.dynamic.frozen`).
        graph: Its town.
        number: Number of the scenario in its map.
        dt: Step of the world, s.

    Returns:
        The text, the same for the same episode, and the features that it does not carry over, one line each.

    Raises:
        ValueError: Another agent makes decisions of its own.
    """
    return _Writer(episode, graph, dt).write(number)


def benchmark_map(town: str) -> str:
    """Return a town's name as used in benchmark ids: letters and digits."""
    return "".join(character for character in town if character.isalnum() and character.isascii()) or "Town"


class _Writer:
    def __init__(self, episode: Episode, graph: LaneGraph, dt: float) -> None:
        self.episode, self.graph, self.dt = episode, graph, _fitting_step(episode, dt)
        limits = episode.limits
        self.steps = max(1, round(min(limits.max_steps * dt, limits.max_time) / self.dt))
        self.omissions: list[str] = []

    def write(self, number: int) -> tuple[str, tuple[str, ...]]:
        episode, scenario = self.episode, self.episode.scenario
        unreplayed = [agent.name for agent in episode.agents[1:] if agent.controller not in STILL]
        if unreplayed:
            raise ValueError(f"{scenario.name}: {', '.join(unreplayed)} have no trajectory")
        recorded = any(agent.trajectory for agent in episode.agents[1:])
        metadata = {
            "name": scenario.name,
            "town": scenario.town,
            "group": scenario.group or scenario.type,
            "contact": episode.limits.contact,
            "max_distance": episode.limits.max_distance,
            "signals_until": episode.override_until,
        }
        root = Element(
            "commonRoad",
            {
                "timeStepSize": decimal(self.dt),
                "commonRoadVersion": VERSION,
                "author": "SSAD",
                "affiliation": "",
                "source": format_source(metadata.items()),
                "date": DATE,
                "benchmarkID": f"ZAM_{benchmark_map(scenario.town)}-{number}_1{'_T-1' if recorded else ''}",
            },
        )
        location = add_element(root, "location")
        for tag, value in (("geoNameId", -999), ("gpsLatitude", 999), ("gpsLongitude", 999)):  # a made-up place
            add_element(location, tag, value)
        add_element(add_element(root, "scenarioTags"), "simulated")
        first_free_id = self.graph.lane_count + 1
        first_id, omission_lines = write_lanes(
            root, self.graph, episode.signal_override, dt=self.dt, number=first_free_id
        )
        self.omissions += omission_lines
        if episode.signal_override and episode.override_until < self.steps * self.dt:
            self.omissions.append(f"signals are forced only until {episode.override_until:g} s: here they stay")
        others = list(enumerate(episode.agents[1:], first_id))  # ids in the order of the agents
        for obstacle_id, agent in others:
            if self._is_static(agent):
                self._write_static(root, obstacle_id, agent)
        for obstacle_id, agent in others:
            if not self._is_static(agent):
                self._write_dynamic(root, obstacle_id, agent)
        if len(episode.agents) > 1:
            self.omissions.append("names of actors: obstacles have numbers")
        self._write_problem(root, first_id + len(others))
        indent(root, " ")
        text = '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
        return text, tuple(self.omissions)

    @staticmethod
    def _is_static(agent: EpisodeAgent) -> bool:
        """Return whether an agent is a static obstacle: a parked vehicle or a prop."""
        return not agent.trajectory and model(agent.model).kind not in (AgentKind.WALKER, AgentKind.BICYCLE)

    def _write_shape(self, obstacle: Element, agent: EpisodeAgent) -> None:
        body = agent_model(agent)
        shape = add_element(add_element(obstacle, "shape"), "rectangle")
        add_element(shape, "length", body.length)
        add_element(shape, "width", body.width)

    def _write_static(self, root: Element, number: int, agent: EpisodeAgent) -> None:
        obstacle = add_element(root, "staticObstacle", id=number)
        is_prop = model(agent.model).kind == AgentKind.PROP
        add_element(obstacle, "type", _STATIC.get(agent.model, "unknown") if is_prop else "parkedVehicle")
        self._write_shape(obstacle, agent)
        _write_state(add_element(obstacle, "initialState"), 0, agent.pose, 0.0)

    def _write_dynamic(self, root: Element, number: int, agent: EpisodeAgent) -> None:
        first_step, rows = self._motion_rows(agent)
        if len(rows) < 2:
            self.omissions.append(f"{agent.name}, who is there for less than two steps")
            return
        obstacle = add_element(root, "dynamicObstacle", id=number)
        add_element(obstacle, "type", TYPES[model(agent.model).kind])
        self._write_shape(obstacle, agent)
        velocity = np.diff(rows[:, :2], axis=0) / self.dt
        heading_vector = np.stack([np.cos(rows[:, 2]), np.sin(rows[:, 2])], 1)
        speed = (np.concatenate([velocity, velocity[-1:]]) * heading_vector).sum(1)
        states = [
            (first_step + offset, Pose(*row), row_speed)
            for offset, (row, row_speed) in enumerate(zip(rows.tolist(), speed.tolist(), strict=True))
        ]
        # The format keeps the first state apart from the trajectory.
        _write_state(add_element(obstacle, "initialState"), *states[0])
        trajectory = add_element(obstacle, "trajectory")
        for state in states[1:]:
            _write_state(add_element(trajectory, "state"), *state)

    def _motion_rows(self, agent: EpisodeAgent) -> tuple[int, F64]:
        """Return the first step, and x, y, yaw [T, 3] at each step at which an agent exists."""
        if not agent.trajectory:
            return 0, np.tile([agent.pose.x, agent.pose.y, agent.pose.yaw], (self.steps + 1, 1))
        rows = np.array(agent.trajectory, np.float64)
        first_step = max(0, math.ceil(rows[0, 0] / self.dt - 1e-6))
        last_step = min(self.steps, math.floor(rows[-1, 0] / self.dt + 1e-6))
        times = self.dt * np.arange(first_step, last_step + 1)
        yaw = np.unwrap(rows[:, 3])
        columns = [np.interp(times, rows[:, 0], values) for values in (rows[:, 1], rows[:, 2], yaw)]
        columns[2] = np.asarray(wrap_angle(columns[2]))
        return first_step, np.stack(columns, 1)

    def _write_problem(self, root: Element, number: int) -> None:
        ego = self.episode.agents[0]
        assert ego.route is not None
        problem = add_element(root, "planningProblem", id=number)
        start = add_element(problem, "initialState")
        points(add_element(start, "position"), [[ego.pose.x, ego.pose.y]])
        yaw = float(wrap_angle(ego.pose.yaw))
        for tag, value in (("velocity", ego.speed), ("orientation", yaw), ("yawRate", 0.0), ("slipAngle", 0.0)):
            add_element(add_element(start, tag), "exact", float(value))
        add_element(add_element(start, "time"), "exact", 0)
        goal = add_element(problem, "goalState")
        _write_interval(add_element(goal, "time"), 0, self.steps)
        goal_pose = Pose(float(ego.route.xy[-1, 0]), float(ego.route.xy[-1, 1]), float(ego.route.yaw[-1]))
        circle = add_element(add_element(goal, "position"), "circle")
        add_element(circle, "radius", GOAL)
        centre = add_element(circle, "center")
        add_element(centre, "x", goal_pose.x)
        add_element(centre, "y", goal_pose.y)
        _write_interval(add_element(goal, "velocity"), 0.0, float(self.episode.scenario.target_speed))
        self._check_route(ego, goal_pose)

    def _check_route(self, ego: EpisodeAgent, end: Pose) -> None:
        """Say what is lost where the shortest way to the goal is not the ego's route."""
        assert ego.route is not None
        try:
            shortest = route_along(self.graph, (ego.pose, end))
        except RouteError:
            self.omissions.append("the ego's route: its start is not where a route can begin")
            return
        if abs(shortest.length - ego.route.length) > 1.5:
            self.omissions.append(
                "the ego's route: a planning problem has a goal alone, and the shortest way is another"
            )
        elif len(shortest.xy) != len(ego.route.xy):
            self.omissions.append("where the ego's route begins: a planning problem begins where the ego is")


def _fitting_step(episode: Episode, dt: float) -> float:
    """Return the longest step (`dt`, or a fraction of it) that fits the times of all rows, else the shortest."""
    times = np.array([row[0] for agent in episode.agents for row in agent.trajectory])
    relevant_times = times[(times > 0.0) & (times < episode.limits.max_steps * dt)]
    steps = [dt / divisor for divisor in PARTS]
    candidates = (
        step for step in steps if np.all(np.abs(relevant_times / step - np.round(relevant_times / step)) < 1e-6)
    )
    return next(candidates, steps[-1])


def _write_state(element: Element, step: int, pose: Pose, speed: float) -> None:
    points(add_element(element, "position"), [[pose.x, pose.y]])
    add_element(add_element(element, "orientation"), "exact", float(pose.yaw))
    add_element(add_element(element, "time"), "exact", step)
    add_element(add_element(element, "velocity"), "exact", float(speed))


def _write_interval(element: Element, low: float, high: float) -> None:
    add_element(element, "intervalStart", low)
    add_element(element, "intervalEnd", high)
