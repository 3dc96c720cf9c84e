"""Differentiable twin of the world's motion in torch, for whoever optimises trajectories by their gradient.

It repeats, batched and in any floating type, what the kernels do with a control: the kinematic bicycle and the walker
of `ssad.world.kernels.motion`. Beside it stand the two distances that an adversary or a planner wants gradients of:
between oriented boxes, and from the road.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import AgentKind, LaneType
from ssad.roads.query import DRIVABLE, LaneQuery
from ssad.world.models import GRIP, REVERSE_SPEED, STEER_TIME, WALKER_RATE, model

SUBSTEPS = 2  # of a step, as in the world
_ROWS = 1 << 22  # pairs of point and segment looked at in one go


class Bodies(NamedTuple):
    """Bodies and limits of agents; every field has the shape of the agents, such as [A] or [B, A].

    Attributes:
        walker: Whether it is a walker.
        length, width: Of the box, m.
        wheelbase: m; at least 0.1.
        max_steer: Angle of the front wheels at steer = 1, rad.
        max_accel, max_brake: m/s^2.
        max_speed: m/s; 0 for what does not move by itself.
    """

    walker: Tensor
    length: Tensor
    width: Tensor
    wheelbase: Tensor
    max_steer: Tensor
    max_accel: Tensor
    max_brake: Tensor
    max_speed: Tensor


class MotionState(NamedTuple):
    """Where agents are and how they move.

    Attributes:
        pose: [..., 3] x, y (world frame, m), yaw (rad).
        speed: [...] m/s, negative in reverse.
        wheel: [...] angle of the front wheels, rad, left positive.
    """

    pose: Tensor
    speed: Tensor
    wheel: Tensor


def bodies_of(models: Sequence[str], *, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Bodies:
    """The bodies [A] of models by name (see `ssad.world.models.MODELS`).

    Args:
        models: Names.
        dtype: Of the numbers.
        device: Where they are.

    Raises:
        UnknownNameError: There is no such model.
    """
    found = [model(name) for name in models]

    def column(values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=device)

    return Bodies(
        torch.tensor([m.kind == AgentKind.WALKER for m in found], device=device),
        column([m.length for m in found]),
        column([m.width for m in found]),
        column([max(m.wheelbase, 0.1) for m in found]),
        column([m.max_steer for m in found]),
        column([m.max_accel for m in found]),
        column([m.max_brake for m in found]),
        column([m.max_speed for m in found]),
    )


def advance(
    state: MotionState, control: Tensor, bodies: Bodies, *, dt: float = 0.1, substeps: int = SUBSTEPS
) -> MotionState:
    """One step of motion, as the world's kernels do it.

    Args:
        state: Of agents of any shape.
        control: [..., 4] throttle, brake in [0, 1], steer in [-1, 1] (left positive), reverse (above 0.5: yes); for a
            walker the throttle is the wanted speed over the top speed, and steer how fast it turns. What lies
            outside is cut, and has no gradient.
        bodies: Of the agents; broadcast against their shape.
        dt: Length of the step, s.
        substeps: Parts in which the bicycle is integrated.

    Returns:
        The state after the step.

    Raises:
        ConfigError: dt is not above 0, or substeps is below 1.
    """
    if not dt > 0.0 or substeps < 1:
        raise ConfigError(f"a step needs dt > 0 and substeps >= 1, not {dt} and {substeps}")
    throttle, brake = control[..., 0].clamp(0.0, 1.0), control[..., 1].clamp(0.0, 1.0)
    driven = _bicycle(state, throttle, brake, control, bodies, dt / substeps, substeps)
    # half of the work for nothing where nobody walks
    walkers = bool(bodies.walker.any())
    walked = _walk(state, throttle, control[..., 2].clamp(-1.0, 1.0), bodies, dt) if walkers else driven
    # a vehicle that stands without throttle keeps its wheels where they are; what cannot move stays
    drives = (bodies.max_speed > 0.0) & ((state.speed != 0.0) | (control[..., 0] > 0.0))
    parts = []
    for old, of_vehicle, of_walker in zip(state, driven, walked, strict=True):
        walker, moves = (
            mask[..., None] if old.ndim > state.speed.ndim else mask for mask in (bodies.walker, drives)
        )  # fmt: skip
        moved = torch.where(moves, of_vehicle, old)
        parts.append(torch.where(walker, of_walker, moved) if walkers else moved)
    return MotionState(*parts)


def unroll(
    state: MotionState, controls: Tensor, bodies: Bodies, *, dt: float = 0.1, substeps: int = SUBSTEPS
) -> MotionState:
    """Motion under a sequence of controls.

    Args:
        state: At the start.
        controls: [T, ..., 4], see `advance`.
        bodies: Of the agents.
        dt: Length of a step, s.
        substeps: Parts of a step.

    Returns:
        States [T + 1, ...], the first is the start.
    """
    states = [state]
    for control in controls:
        states.append(advance(states[-1], control, bodies, dt=dt, substeps=substeps))
    return MotionState(*(torch.stack(_alike(*parts)) for parts in zip(*states, strict=True)))


def box_gap(first: Tensor, second: Tensor) -> Tensor:
    """How far oriented boxes are apart, m: their distance, or less than 0 how deep they overlap.

    The depth is the shortest way that separates them. Equal to `ssad.core.geometry.obb_distance` where they are apart.

    Args:
        first: [..., 5] x, y, yaw, length, width.
        second: Likewise; broadcast against the first.

    Returns:
        [...], with a gradient almost everywhere.
    """
    first, second = _alike(first, second)
    one, two = _corners(first), _corners(second)
    outside_one, depth_one = _beside(_to_local(first, two), 0.5 * first[..., None, 3:5])
    outside_two, depth_two = _beside(_to_local(second, one), 0.5 * second[..., None, 3:5])
    depth = torch.maximum(depth_one, depth_two)
    return torch.where(depth > 0.0, torch.minimum(outside_one, outside_two), depth)


class RoadField:
    """How far points are from the road, with a gradient.

    The value is the distance from the nearest strip of a lane: from its centre line, less half its width. It is
    positive off the road and falls to minus half a width on a centre line; between two lanes side by side it is 0.
    On the road as `ssad.roads.query.LaneQuery` finds it means at most 0.

    Args:
        graph: Of the town.
        types: Kinds of lanes that count as road.
    """

    def __init__(self, graph: LaneGraph, types: Sequence[LaneType] = DRIVABLE) -> None:
        self._query = LaneQuery(graph)
        self._types = tuple(types)
        self._grid = self._query.grid(self._types)
        if not len(self._grid.seg):
            raise ConfigError(f"town '{graph.name}' has no lane of the kinds {[t.name for t in self._types]}")

    def __call__(self, points: Tensor) -> Tensor:
        """Distances [...] of points [..., 2] (world frame, m), anywhere."""
        flat = points.reshape(-1, 2)
        pick = self._nearest(flat.detach().cpu().numpy())
        segment = torch.as_tensor(self._grid.seg[pick], dtype=points.dtype, device=points.device)
        half = torch.as_tensor(self._grid.seg_half[pick], dtype=points.dtype, device=points.device)
        return _strip_gap(flat, segment, half).reshape(points.shape[:-1])

    def of_boxes(self, boxes: Tensor) -> Tensor:
        """How far bodies leave the road [...]: the largest distance of the corners of boxes [..., 5].

        A box is x, y, yaw, length, width.
        """
        return self(_corners(boxes)).amax(-1)

    def _nearest(self, points: Any) -> Any:
        """The nearest segment of each point [n]: all of them are looked at, in float64."""
        segment, half = self._grid.seg.astype(np.float64), self._grid.seg_half.astype(np.float64)
        found = np.empty(len(points), np.int64)
        size = max(1, _ROWS // len(segment))
        for start in range(0, len(points), size):
            part = torch.from_numpy(np.asarray(points[start : start + size], np.float64))
            gap = _strip_gap(part[:, None], torch.from_numpy(segment)[None], torch.from_numpy(half)[None])
            found[start : start + size] = gap.argmin(1).numpy()
        return found


def _bicycle(  # noqa: PLR0917
    state: MotionState, throttle: Tensor, brake: Tensor, control: Tensor, bodies: Bodies, h: float, substeps: int
) -> MotionState:
    """The kinematic bicycle; see `ssad.world.kernels.motion.bicycle`."""
    (x, y, yaw), v, wheel = state.pose.unbind(-1), state.speed, state.wheel
    aim = control[..., 2].clamp(-1.0, 1.0) * bodies.max_steer
    turn = bodies.max_steer * (h / STEER_TIME)
    push = torch.where(control[..., 3] > 0.5, -throttle, throttle) * bodies.max_accel * h
    drag = brake * bodies.max_brake * h
    least = torch.full_like(bodies.max_speed, -REVERSE_SPEED)
    for _ in range(substeps):
        wheel = wheel + torch.minimum(torch.maximum(aim - wheel, -turn), turn)
        before = v
        v = v + push
        v = torch.where(v > 0.0, (v - drag).clamp_min(0.0), (v + drag).clamp_max(0.0))
        v = torch.minimum(torch.maximum(v, least), bodies.max_speed)
        mean = 0.5 * (before + v)
        slip = torch.atan(0.5 * torch.tan(wheel))
        rate = mean * torch.sin(slip) * 2.0 / bodies.wheelbase
        cut = GRIP / mean.abs().clamp_min(1e-3)
        rate = torch.minimum(torch.maximum(rate, -cut), cut)
        heading = yaw + slip + 0.5 * rate * h
        x = x + mean * torch.cos(heading) * h
        y = y + mean * torch.sin(heading) * h
        yaw = yaw + rate * h
    return MotionState(torch.stack(_alike(x, y, _wrapped(yaw)), -1), v, wheel)


def _walk(state: MotionState, throttle: Tensor, steer: Tensor, bodies: Bodies, dt: float) -> MotionState:
    """It turns, then goes straight ahead; the speed follows the wanted one as fast as the model can."""
    (x, y, yaw), speed = state.pose.unbind(-1), state.speed
    yaw = _wrapped(yaw + steer * (WALKER_RATE * dt))
    change = bodies.max_accel * dt
    after = speed + torch.minimum(torch.maximum(throttle * bodies.max_speed - speed, -change), change)
    go = 0.5 * (speed + after) * dt
    pose = torch.stack(_alike(x + go * torch.cos(yaw), y + go * torch.sin(yaw), yaw), -1)
    return MotionState(pose, after, state.wheel)


def _alike(*tensors: Tensor) -> list[Tensor]:
    """Tensors broadcast to one shape."""
    return list(torch.broadcast_tensors(*tensors))  # type: ignore[no-untyped-call]


def _wrapped(angle: Tensor) -> Tensor:
    """Angles in [-pi, pi), with the gradient of the angle itself."""
    return angle - 2 * math.pi * torch.floor((angle.detach() + math.pi) / (2 * math.pi))


def _turned(points: Tensor, yaw: Tensor) -> Tensor:
    """Vectors [..., 2] turned counter-clockwise by angles [...]."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    x, y = points.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def _corners(boxes: Tensor) -> Tensor:
    """Corners [..., 4, 2] of boxes [..., 5]: front left, rear left, rear right, front right."""
    along = 0.5 * boxes[..., 3:4] * boxes.new_tensor([1.0, -1.0, -1.0, 1.0])
    across = 0.5 * boxes[..., 4:5] * boxes.new_tensor([1.0, 1.0, -1.0, -1.0])
    return _turned(torch.stack([along, across], -1), boxes[..., 2:3]) + boxes[..., None, :2]


def _to_local(boxes: Tensor, points: Tensor) -> Tensor:
    """World points [..., n, 2] in the frames of boxes [..., 5]."""
    return _turned(points - boxes[..., None, :2], -boxes[..., 2:3])


def _beside(points: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """How far points [..., n, 2] are from a box of half extents [..., 1, 2] at the origin.

    Returns:
        The least distance [...]; and how far the axis of the box that separates them best does so [...], below 0: by
        how much they overlap there.
    """
    outside = (points.abs() - half).clamp_min(0.0)
    square = outside.square().sum(-1)
    some = square > 0.0
    distance = torch.where(some, torch.where(some, square, 1.0).sqrt(), 0.0)
    extent = half[..., 0, :]
    apart = torch.maximum(points.amin(-2) - extent, -extent - points.amax(-2))
    return distance.amin(-1), apart.amax(-1)


def _strip_gap(points: Tensor, segment: Tensor, half: Tensor) -> Tensor:
    """Distance [...] of points [..., 2] outside strips about segments [..., 4]; below 0 inside.

    half: Half widths [..., 2] at the ends of the segments.
    """
    start, way = segment[..., :2], segment[..., 2:] - segment[..., :2]
    to = points - start
    share = ((to * way).sum(-1) / way.square().sum(-1).clamp_min(1e-12)).clamp(0.0, 1.0)
    square = (to - share[..., None] * way).square().sum(-1)
    some = square > 0.0
    distance = torch.where(some, torch.where(some, square, 1.0).sqrt(), 0.0)
    return distance - (half[..., 0] + share * (half[..., 1] - half[..., 0]))
