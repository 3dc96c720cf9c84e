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
from ssad.world.models import GRIP, REVERSE_SPEED, STEER_TIME, WALKER_RATE, model
from ssad.world.roads.query import DRIVABLE, LaneQuery

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
        bodies: Of the agents; state, control and bodies are broadcast against one another.
        dt: Length of the step, s.
        substeps: Parts in which the bicycle is integrated.

    Returns:
        The state after the step.

    Raises:
        ConfigError: dt is not above 0, or substeps is below 1.
    """
    after = unroll(state, control[None], bodies, dt=dt, substeps=substeps)
    return MotionState(*(part[-1] for part in after))


def unroll(
    state: MotionState, controls: Tensor, bodies: Bodies, *, dt: float = 0.1, substeps: int = SUBSTEPS
) -> MotionState:
    """Motion under a sequence of controls.

    Args:
        state: At the start.
        controls: [T, ..., 4], see `advance`.
        bodies: Of the agents; state, controls and bodies are broadcast against one another.
        dt: Length of a step, s.
        substeps: Parts of a step.

    Returns:
        States [T + 1, ...], the first is the start; all yaws in [-pi, pi).

    Raises:
        ConfigError: See `advance`.
    """
    if not dt > 0.0 or substeps < 1:
        raise ConfigError(f"a step needs dt > 0 and substeps >= 1, not {dt} and {substeps}")
    shape = np.broadcast_shapes(state.speed.shape, bodies.max_speed.shape, controls.shape[1:-1])
    state = MotionState(state.pose.expand(*shape, 3), state.speed.expand(shape), state.wheel.expand(shape))
    steps, *own, width = controls.shape
    controls = controls.reshape(steps, *[1] * (len(shape) - len(own)), *own, width).expand(steps, *shape, width)
    driven = _drive(state, controls, bodies, dt / substeps, substeps)
    if not bool(bodies.walker.any()):  # half of the work for nothing where nobody walks
        return driven
    walked = _walk(state, controls, bodies, dt)
    walker = bodies.walker
    return MotionState(
        torch.where(walker[..., None], walked.pose, driven.pose),
        torch.where(walker, walked.speed, driven.speed),
        torch.where(walker, walked.wheel, driven.wheel),
    )


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
    On the road as `ssad.world.roads.query.LaneQuery` finds it means at most 0.

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


def _drive(state: MotionState, controls: Tensor, bodies: Bodies, h: float, substeps: int) -> MotionState:
    """The kinematic bicycle; see `ssad.world.kernels.motion.bicycle`.

    Only speeds and wheels go step by step: places and headings are sums over time of what follows from these.
    """
    controls = controls.repeat_interleave(substeps, 0) if substeps > 1 else controls
    throttle, brake = controls[..., 0].clamp(0.0, 1.0), controls[..., 1].clamp(0.0, 1.0)
    able = bodies.max_speed > 0.0
    push = torch.where(controls[..., 3] > 0.5, -throttle, throttle) * bodies.max_accel * h
    speed = _speeds(state.speed, torch.where(able, push, 0.0), brake * bodies.max_brake * h, bodies)
    # a vehicle that stands without throttle keeps its wheels where they are; what cannot move stays
    drives = able & ((controls[..., 0] > 0.0) | (speed[:-1:substeps] != 0.0).repeat_interleave(substeps, 0))
    aim = controls[..., 2].clamp(-1.0, 1.0) * bodies.max_steer
    wheel = _wheels(state.wheel, aim, bodies.max_steer * (h / STEER_TIME), drives)
    mean = torch.where(able, 0.5 * (speed[:-1] + speed[1:]), 0.0)
    slip = torch.atan(0.5 * torch.tan(wheel[1:]))
    cut = GRIP / mean.abs().clamp_min(1e-3)
    rate = mean * torch.sin(slip) * 2.0 / bodies.wheelbase
    rate = torch.minimum(torch.maximum(rate, -cut), cut)
    x, y, yaw = state.pose.unbind(-1)
    yaws = _summed(yaw, rate * h)
    heading = yaws[:-1] + slip + 0.5 * rate * h
    xs, ys = _summed(x, mean * torch.cos(heading) * h), _summed(y, mean * torch.sin(heading) * h)
    pose = torch.stack([xs, ys, _wrapped(yaws)], -1)
    return MotionState(pose[::substeps], speed[::substeps], wheel[::substeps])


def _speeds(start: Tensor, push: Tensor, drag: Tensor, bodies: Bodies) -> Tensor:
    """Speeds [T + 1, ...] under changes [T, ...] by the engine, and by brakes, which stop and do not turn back."""
    able = bodies.max_speed > 0.0
    most, least = bodies.max_speed, torch.full_like(bodies.max_speed, -REVERSE_SPEED)
    with torch.no_grad():
        values = [start]
        for pushing, dragging in zip(push, drag, strict=True):
            pushed = values[-1] + pushing
            value = torch.minimum(torch.maximum(pushed - pushed.clamp(-dragging, dragging), least), most)
            values.append(torch.where(able, value, values[-1]))
        speed = torch.stack(values)
        pushed = speed[:-1] + push
        rolls = (pushed.abs() > drag) & (speed[1:] > least) & (speed[1:] < most)
        sign = pushed.sign()
    own = torch.where(rolls & able, push - sign * drag, 0.0)
    coasts = (pushed == 0.0) & (drag == 0.0)  # from a standstill: any speed would last
    return _recursive(speed, rolls | coasts | ~able, start, own)


def _wheels(start: Tensor, aim: Tensor, turn: Tensor, drives: Tensor) -> Tensor:
    """Angles [T + 1, ...] of wheels that turn towards an aim [T, ...] by at most `turn` a step, while it drives."""
    with torch.no_grad():
        turns, values = torch.where(drives, turn, 0.0), [start]
        for aims, most in zip(aim, turns, strict=True):
            values.append(values[-1] + (aims - values[-1]).clamp(-most, most))
        wheel = torch.stack(values)
        ahead = aim - wheel[:-1]
        there = drives & (ahead.abs() <= turn)
    return _recursive(wheel, ~there, start, torch.where(there, aim, torch.where(drives, ahead.sign() * turn, 0.0)))


class _Recursion(torch.autograd.Function):
    """Known values of v[t + 1] = v[t] + own[t] where `keeps`, else own[t]: one node of the graph for all steps."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, keeps: Tensor, start: Tensor, own: Tensor) -> Tensor:
        ctx.save_for_backward(keeps)
        return values.clone()

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[None, None, Tensor, Tensor]:
        keeps = ctx.saved_tensors[0].to(slopes[0].dtype)
        found = [slopes[0][-1]]
        for slope, keep in zip(slopes[0][:-1].flip(0), keeps.flip(0), strict=True):
            found.append(torch.addcmul(slope, keep, found[-1]))
        back = torch.stack(found).flip(0)
        return None, None, back[0], back[1:]


def _recursive(values: Tensor, keeps: Tensor, start: Tensor, own: Tensor) -> Tensor:
    return _Recursion.apply(values, keeps, start, own)  # type: ignore[no-any-return]


def _walk(state: MotionState, controls: Tensor, bodies: Bodies, dt: float) -> MotionState:
    """It turns, then goes straight ahead; the speed follows the wanted one as fast as the model can."""
    wanted = controls[..., 0].clamp(0.0, 1.0) * bodies.max_speed
    change = bodies.max_accel * dt
    speeds = [state.speed]
    for aim in wanted:
        speeds.append(speeds[-1] + (aim - speeds[-1]).clamp(-change, change))
    speed = torch.stack(speeds)
    x, y, yaw = state.pose.unbind(-1)
    yaws = _summed(yaw, controls[..., 2].clamp(-1.0, 1.0) * (WALKER_RATE * dt))
    go = 0.5 * (speed[:-1] + speed[1:]) * dt
    xs, ys = _summed(x, go * torch.cos(yaws[1:])), _summed(y, go * torch.sin(yaws[1:]))
    return MotionState(torch.stack([xs, ys, _wrapped(yaws)], -1), speed, state.wheel.expand_as(speed))


def _summed(start: Tensor, changes: Tensor) -> Tensor:
    """Values [T + 1, ...] that start somewhere and change [T, ...]."""
    return torch.cat([start[None], changes]).cumsum(0)


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
