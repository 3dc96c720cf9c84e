"""Placement of actors by the impact with the ego that happens if nobody acts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.rotations import wrap_scalar
from ssad.core.types import Actor, Impact, Model, Pose, Route, Scenario
from ssad.scenarios.dynamic.knowledge._placing import move_pose
from ssad.world.models import model, model_with_body

_ALONG: Final = 1.0e-6  # sine of the angle to the route below which an actor drives along it
_STRAIGHT: Final = 0.02  # rad; a route that bends less is straight
_STEP: Final = 2.0  # m between points of a path along a bending route
_AHEAD: Final = 150.0  # m that such a path goes on after the impact


def place_actors(scenario: Scenario, route: Route, start: float, start_speed: float) -> Scenario:
    """Return a scenario whose actors with an impact have the pose and the path that lead to it.

    Args:
        scenario: The scenario.
        route: The ego's route.
        start: Where the ego starts, m along the route.
        start_speed: Its speed there, m/s.

    Raises:
        RouteError: An actor would start beyond the end of a bending route.
    """
    if all(actor.impact is None for actor in scenario.actors):
        return scenario
    ego = model_with_body(model(scenario.ego_model), scenario.ego_body)
    ego_speed = start_speed or scenario.target_speed
    actors = [
        actor if actor.impact is None else _placed_actor(actor, actor.impact, route, ego, (start, ego_speed))
        for actor in scenario.actors
    ]
    return dataclasses.replace(scenario, actors=tuple(actors))


def lateral_offset(impact: Impact, ego_width: float, half_width: float) -> float:
    """Return how far left of the ego's centre line an actor's centre is at an impact, m.

    Args:
        impact: The impact.
        ego_width: Width of the ego, m.
        half_width: Half of the actor's extent across the ego, m.
    """
    if impact.overlap is None:
        return (0.5 - impact.location) * ego_width
    covered = impact.overlap * ego_width
    # A full overlap has its centre lines together, and so has that of a body too narrow to cover more.
    if impact.overlap >= 1.0 or covered >= 2.0 * half_width:
        return 0.0
    offset = 0.5 * ego_width + half_width - covered
    return offset if impact.side == "left" else -offset


def _placed_actor(actor: Actor, impact: Impact, route: Route, ego: Model, start: tuple[float, float]) -> Actor:
    """Return an actor at its start; `start` has the ego's position along its route, m, and its speed, m/s."""
    body = model_with_body(model(actor.model), actor.body)
    cosine, sine = math.cos(impact.heading), math.sin(impact.heading)
    half_length = 0.5 * (abs(cosine) * body.length + abs(sine) * body.width)  # of its extent along the route
    half_width = 0.5 * (abs(sine) * body.length + abs(cosine) * body.width)
    left = lateral_offset(impact, ego.width, half_width)
    position, ego_speed = start
    way = actor.speed * impact.distance / (impact.ego_speed or ego_speed)
    ahead = 0.5 * ego.length + half_length
    ego_station = position + impact.distance
    if abs(sine) < _ALONG:
        sign = math.copysign(1.0, cosine)
        first, last = ego_station + ahead - sign * way, ego_station + ahead
        path_end = last + sign * _AHEAD
        pose = move_pose(route_pose(route, first), 0.0, left, impact.heading)
        if _is_straight(route, (min(first, path_end), max(first, path_end))):
            return dataclasses.replace(actor, pose=pose, path=())
        if not -_STEP <= min(first, last) <= max(first, last) <= route.length + _STEP:
            raise RouteError(
                f"actor {actor.name}: its impact: it would start {first:.0f} m along a route of {route.length:.0f} m; "
                "lengthen the route, or bring the impact nearer"
            )
        stations = np.append(np.arange(first, path_end, sign * _STEP), path_end)
        return dataclasses.replace(actor, pose=pose, path=_path(route, stations.tolist(), left))
    contact = move_pose(route_pose(route, ego_station), ahead, left, impact.heading)
    return dataclasses.replace(actor, pose=move_pose(contact, -way, 0.0), path=())


def route_pose(route: Route, station: float) -> Pose:
    """Return the pose at a distance along a route, m; before its start and behind its end straight on."""
    inside = min(max(station, 0.0), route.length)
    index = min(int(inside / route.spacing), len(route.xy) - 2)
    share = inside / route.spacing - index
    (x0, y0), (x1, y1) = route.xy[index : index + 2].tolist()
    yaw, next_yaw = route.yaw[index : index + 2].tolist()
    heading = wrap_scalar(yaw + share * wrap_scalar(next_yaw - yaw))
    return move_pose(Pose(x0 + share * (x1 - x0), y0 + share * (y1 - y0), heading), station - inside, 0.0)


def _is_straight(route: Route, stations: tuple[float, float]) -> bool:
    """Return whether a route has one direction between two distances along it."""
    first, last = (min(max(round(station / route.spacing), 0), len(route.yaw) - 1) for station in stations)
    yaw = np.unwrap(route.yaw[first : last + 1].astype(np.float64))
    return bool(np.ptp(yaw) < _STRAIGHT)


def _path(route: Route, stations: Sequence[float], left: float) -> tuple[tuple[float, float], ...]:
    """Return points beside a route."""
    poses = [move_pose(route_pose(route, station), 0.0, left) for station in stations]
    return tuple((round(pose.x, 3), round(pose.y, 3)) for pose in poses)
