"""Differentiable torch twin of the world's motion, for gradient-based optimisation of trajectories.

It applies controls as the kernels of `ssad.world.kernels.motion` do (kinematic bicycle and walker), batched and in
any floating-point type. It also provides two differentiable distances: between oriented boxes, and from the road.
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
from ssad.core.tensor_boxes import rectangle_corners, rotate
from ssad.core.types import DEFAULT_FRICTION, AgentKind, LaneType, Model
from ssad.world.models import GRAVITY, REVERSE_SPEED, STEER_TIME, WALKER_RATE, lateral_grip, model
from ssad.world.roads.query import DRIVABLE, LaneQuery

SUBSTEPS = 2  # of a step, as in the world
_ROWS = 1 << 22  # pairs of point and segment looked at in one go


class Bodies(NamedTuple):
    """Bodies and limits of agents; every field has the shape of the agents, such as [A] or [B, A].

    Attributes:
        walker: Whether the agent is a walker.
        length, width: Of the box, m.
        wheelbase: m; at least 0.1.
        max_steer: Angle of the front wheels at steer = 1, rad.
        max_accel, max_brake: m/s^2.
        max_speed: m/s; 0 for objects that cannot move by themselves.
        traction, grip: Accelerations that the surface allows along the heading and across it, m/s^2.
    """

    walker: Tensor
    length: Tensor
    width: Tensor
    wheelbase: Tensor
    max_steer: Tensor
    max_accel: Tensor
    max_brake: Tensor
    max_speed: Tensor
    traction: Tensor
    grip: Tensor


class MotionState(NamedTuple):
    """Poses and motion of agents.

    Attributes:
        pose: [..., 3] x, y (world frame, m), yaw (rad).
        speed: [...] m/s, negative in reverse.
        wheel: [...] angle of the front wheels, rad, left positive.
    """

    pose: Tensor
    speed: Tensor
    wheel: Tensor


def bodies_of(
    models: Sequence[str | Model],
    *,
    friction: float | Sequence[float] = DEFAULT_FRICTION,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
) -> Bodies:
    """Return the bodies [A] of models (see `ssad.world.models.MODELS`). Their brakes act at once.

    Args:
        models: Models, or their names.
        friction: Coefficient of friction of the surface, or of the surface under each of them.
        dtype: Floating-point type.
        device: Torch device.

    Raises:
        UnknownNameError: There is no such model.
    """
    bodies = [model(entry) if isinstance(entry, str) else entry for entry in models]
    frictions = [friction] * len(bodies) if isinstance(friction, float) else list(friction)

    def column(values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=device)

    return Bodies(
        torch.tensor([body.kind == AgentKind.WALKER for body in bodies], device=device),
        column([body.length for body in bodies]),
        column([body.width for body in bodies]),
        column([max(body.wheelbase, 0.1) for body in bodies]),
        column([body.max_steer for body in bodies]),
        column([body.max_accel for body in bodies]),
        column([body.max_brake for body in bodies]),
        column([body.max_speed for body in bodies]),
        column([GRAVITY * value for value in frictions]),
        column([lateral_grip(value) for value in frictions]),
    )


def advance(
    state: MotionState, control: Tensor, bodies: Bodies, *, dt: float = 0.1, substeps: int = SUBSTEPS
) -> MotionState:
    """Advance agents by one step, as the world's kernels do.

    Args:
        state: Of agents of any shape.
        control: [..., 4] throttle, brake in [0, 1], steer in [-1, 1] (left positive), reverse (above 0.5: yes); for a
            walker the throttle is the desired speed over the top speed, and steer its rate of turn. Values outside
            the range are clipped, and have no gradient.
        bodies: Of the agents; state, control and bodies are broadcast against one another.
        dt: Length of the step, s.
        substeps: Parts in which the bicycle is integrated.

    Returns:
        The state after the step.

    Raises:
        ConfigError: dt is not above 0, or substeps is below 1.
    """
    trajectory = unroll(state, control[None], bodies, dt=dt, substeps=substeps)
    return MotionState(*(part[-1] for part in trajectory))


def unroll(
    state: MotionState, controls: Tensor, bodies: Bodies, *, dt: float = 0.1, substeps: int = SUBSTEPS
) -> MotionState:
    """Roll out a sequence of controls.

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
    steps, *control_shape, width = controls.shape
    controls = controls.reshape(steps, *[1] * (len(shape) - len(control_shape)), *control_shape, width).expand(
        steps, *shape, width
    )
    states = _drive(state, controls, bodies, dt / substeps, substeps)
    if not bool(bodies.walker.any()):  # Skip the walkers' half of the work where there is none.
        return states
    walked = _walk(state, controls, bodies, dt)
    walker = bodies.walker
    return MotionState(
        torch.where(walker[..., None], walked.pose, states.pose),
        torch.where(walker, walked.speed, states.speed),
        torch.where(walker, walked.wheel, states.wheel),
    )


def box_gap(first: Tensor, second: Tensor) -> Tensor:
    """Return the signed distance between oriented boxes, m: negative where they overlap.

    The depth of an overlap is the shortest translation that separates the boxes. Equal to
    `ssad.core.geometry.obb_distance` where they are disjoint.

    Args:
        first: [..., 5] x, y, yaw, length, width.
        second: Likewise; broadcast against the first.

    Returns:
        [...], with a gradient almost everywhere.
    """
    first, second = _broadcast(first, second)
    first_corners, second_corners = _corners(first), _corners(second)
    outside_one, depth_one = _signed_distance_from_box(_to_local(first, second_corners), 0.5 * first[..., None, 3:5])
    outside_two, depth_two = _signed_distance_from_box(_to_local(second, first_corners), 0.5 * second[..., None, 3:5])
    depth = torch.maximum(depth_one, depth_two)
    return torch.where(depth > 0.0, torch.minimum(outside_one, outside_two), depth)


class RoadField:
    """Signed distance of points from the road, with a gradient.

    The value is the distance from the nearest lane's centre line, less half its width: positive off the road, minus
    half a width on a centre line, and 0 on the border between two lanes side by side. It is at most 0 where
    `ssad.world.roads.query.LaneQuery` finds the road.

    Args:
        graph: The town.
        types: Kinds of lanes that count as road.
    """

    def __init__(self, graph: LaneGraph, types: Sequence[LaneType] = DRIVABLE) -> None:
        self._query = LaneQuery(graph)
        self._types = tuple(types)
        self._grid = self._query.grid(self._types)
        if not len(self._grid.seg):
            raise ConfigError(
                f"town '{graph.name}' has no lane of the kinds {[lane_type.name for lane_type in self._types]}"
            )

    def __call__(self, points: Tensor) -> Tensor:
        """Return the distances [...] of points [..., 2] (world frame, m)."""
        flat_points = points.reshape(-1, 2)
        segment_index = self._nearest(flat_points.detach().cpu().numpy())
        segment = torch.as_tensor(self._grid.seg[segment_index], dtype=points.dtype, device=points.device)
        half_width = torch.as_tensor(self._grid.seg_half[segment_index], dtype=points.dtype, device=points.device)
        return _strip_gap(flat_points, segment, half_width).reshape(points.shape[:-1])

    def of_boxes(self, boxes: Tensor) -> Tensor:
        """Return how far bodies leave the road [...]: the largest distance of the corners of boxes [..., 5].

        A box is x, y, yaw, length, width.
        """
        return self(_corners(boxes)).amax(-1)

    def _nearest(self, points: Any) -> Any:
        """Return the nearest segment of each point [n] by exhaustive search in float64."""
        segment, half_width = self._grid.seg.astype(np.float64), self._grid.seg_half.astype(np.float64)
        nearest = np.empty(len(points), np.int64)
        # Bounds the memory of the pairwise distances.
        chunk_size = max(1, _ROWS // len(segment))
        for chunk_start in range(0, len(points), chunk_size):
            chunk = torch.from_numpy(np.asarray(points[chunk_start : chunk_start + chunk_size], np.float64))
            distances = _strip_gap(chunk[:, None], torch.from_numpy(segment)[None], torch.from_numpy(half_width)[None])
            nearest[chunk_start : chunk_start + chunk_size] = distances.argmin(1).numpy()
        return nearest


def _drive(state: MotionState, controls: Tensor, bodies: Bodies, substep: float, substeps: int) -> MotionState:
    """The kinematic bicycle; see `ssad.world.kernels.motion.bicycle`.

    Only speeds and wheels go step by step: places and headings are sums over time of what follows from these.
    """
    controls = controls.repeat_interleave(substeps, 0) if substeps > 1 else controls
    throttle, brake = controls[..., 0].clamp(0.0, 1.0), controls[..., 1].clamp(0.0, 1.0)
    movable = bodies.max_speed > 0.0
    push = torch.minimum(throttle * bodies.max_accel, bodies.traction)
    speed_gain = torch.where(controls[..., 3] > 0.5, -push, push) * substep
    drag = torch.minimum(brake * bodies.max_brake, bodies.traction) * substep
    speed = _speeds(state.speed, torch.where(movable, speed_gain, 0.0), drag, bodies)
    # a vehicle that stands without throttle keeps its wheels where they are; what cannot move stays
    turning = movable & ((controls[..., 0] > 0.0) | (speed[:-1:substeps] != 0.0).repeat_interleave(substeps, 0))
    target_wheel = controls[..., 2].clamp(-1.0, 1.0) * bodies.max_steer
    wheel = _wheels(state.wheel, target_wheel, bodies.max_steer * (substep / STEER_TIME), turning)
    mean_speed = torch.where(movable, 0.5 * (speed[:-1] + speed[1:]), 0.0)
    slip = torch.atan(0.5 * torch.tan(wheel[1:]))
    max_rate = bodies.grip / mean_speed.abs().clamp_min(1e-3)
    yaw_rate = mean_speed * torch.sin(slip) * 2.0 / bodies.wheelbase
    yaw_rate = torch.minimum(torch.maximum(yaw_rate, -max_rate), max_rate)
    x, y, yaw = state.pose.unbind(-1)
    yaws = _cumulative(yaw, yaw_rate * substep)
    heading = yaws[:-1] + slip + 0.5 * yaw_rate * substep
    x_values, y_values = (
        _cumulative(x, mean_speed * torch.cos(heading) * substep),
        _cumulative(y, mean_speed * torch.sin(heading) * substep),
    )
    poses = torch.stack([x_values, y_values, _wrap_angles(yaws)], -1)
    return MotionState(poses[::substeps], speed[::substeps], wheel[::substeps])


def _speeds(start: Tensor, push: Tensor, drag: Tensor, bodies: Bodies) -> Tensor:
    """Speeds [T + 1, ...] under changes [T, ...] by the engine, and by brakes, which stop and do not turn back."""
    movable = bodies.max_speed > 0.0
    top_speed, reverse_speed = bodies.max_speed, torch.full_like(bodies.max_speed, -REVERSE_SPEED)
    with torch.no_grad():
        values = [start]
        for gain, loss in zip(push, drag, strict=True):
            pushed = values[-1] + gain
            value = torch.minimum(torch.maximum(pushed - pushed.clamp(-loss, loss), reverse_speed), top_speed)
            values.append(torch.where(movable, value, values[-1]))
        speed = torch.stack(values)
        pushed = speed[:-1] + push
        unclipped = (pushed.abs() > drag) & (speed[1:] > reverse_speed) & (speed[1:] < top_speed)
        direction = pushed.sign()
    local_change = torch.where(unclipped & movable, push - direction * drag, 0.0)
    coasting = (pushed == 0.0) & (drag == 0.0)  # from a standstill: any speed would last
    return _run_recursion(speed, unclipped | coasting | ~movable, start, local_change)


def _wheels(start: Tensor, aim: Tensor, turn: Tensor, drives: Tensor) -> Tensor:
    """Angles [T + 1, ...] of wheels that turn towards an aim [T, ...] by at most `turn` a step, while it drives."""
    with torch.no_grad():
        limits, values = torch.where(drives, turn, 0.0), [start]
        for step_target, limit in zip(aim, limits, strict=True):
            values.append(values[-1] + (step_target - values[-1]).clamp(-limit, limit))
        wheel = torch.stack(values)
        remaining = aim - wheel[:-1]
        reaches_target = drives & (remaining.abs() <= turn)
    return _run_recursion(
        wheel,
        ~reaches_target,
        start,
        torch.where(reaches_target, aim, torch.where(drives, remaining.sign() * turn, 0.0)),
    )


class _Recursion(torch.autograd.Function):
    """Recursion v[t + 1] = v[t] + local[t] where `keeps`, else local[t], as one graph node for all steps."""

    @staticmethod
    def forward(context: Any, values: Tensor, keeps: Tensor, start: Tensor, offsets: Tensor) -> Tensor:
        context.save_for_backward(keeps)
        return values.clone()

    @staticmethod
    def backward(context: Any, *slopes: Tensor) -> tuple[None, None, Tensor, Tensor]:
        keeps = context.saved_tensors[0].to(slopes[0].dtype)
        # The reverse recursion: a step that keeps its value passes its gradient on to the step before.
        accumulated = [slopes[0][-1]]
        for slope, keep in zip(slopes[0][:-1].flip(0), keeps.flip(0), strict=True):
            accumulated.append(torch.addcmul(slope, keep, accumulated[-1]))
        gradients = torch.stack(accumulated).flip(0)
        return None, None, gradients[0], gradients[1:]


def _run_recursion(values: Tensor, keeps: Tensor, start: Tensor, offsets: Tensor) -> Tensor:
    return _Recursion.apply(values, keeps, start, offsets)  # type: ignore[no-any-return]


def _walk(state: MotionState, controls: Tensor, bodies: Bodies, dt: float) -> MotionState:
    """Integrate walkers: they turn, then walk straight ahead, with limited acceleration."""
    desired_speeds = controls[..., 0].clamp(0.0, 1.0) * bodies.max_speed
    max_change = bodies.max_accel * dt
    speeds = [state.speed]
    for desired_speed in desired_speeds:
        speeds.append(speeds[-1] + (desired_speed - speeds[-1]).clamp(-max_change, max_change))
    speed = torch.stack(speeds)
    x, y, yaw = state.pose.unbind(-1)
    yaws = _cumulative(yaw, controls[..., 2].clamp(-1.0, 1.0) * (WALKER_RATE * dt))
    distances = 0.5 * (speed[:-1] + speed[1:]) * dt
    x_values, y_values = (
        _cumulative(x, distances * torch.cos(yaws[1:])),
        _cumulative(y, distances * torch.sin(yaws[1:])),
    )
    return MotionState(torch.stack([x_values, y_values, _wrap_angles(yaws)], -1), speed, state.wheel.expand_as(speed))


def _cumulative(start: Tensor, changes: Tensor) -> Tensor:
    """Return values [T + 1, ...] with a given start and changes [T, ...]."""
    return torch.cat([start[None], changes]).cumsum(0)


def _broadcast(*tensors: Tensor) -> list[Tensor]:
    """Broadcast tensors to one shape."""
    return list(torch.broadcast_tensors(*tensors))  # type: ignore[no-untyped-call]


def _wrap_angles(angle: Tensor) -> Tensor:
    """Wrap angles to [-pi, pi), with the gradient of the angle itself."""
    return angle - 2 * math.pi * torch.floor((angle.detach() + math.pi) / (2 * math.pi))


def _corners(boxes: Tensor) -> Tensor:
    """Return the corners [..., 4, 2] of boxes [..., 5]: front left, rear left, rear right, front right."""
    return rectangle_corners(boxes[..., :2], boxes[..., 3:5], boxes[..., 2])


def _to_local(boxes: Tensor, points: Tensor) -> Tensor:
    """Transform world points [..., n, 2] into the frames of boxes [..., 5]."""
    return rotate(points - boxes[..., None, :2], -boxes[..., 2:3])


def _signed_distance_from_box(points: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far points [..., n, 2] are from a box of half extents [..., 1, 2] at the origin.

    Returns:
        The smallest distance [...]; and the largest separation [...] along an axis of the box, negative where they
        overlap on both.
    """
    outside = (points.abs() - half).clamp_min(0.0)
    squared_distance = outside.square().sum(-1)
    is_outside = squared_distance > 0.0
    # The inner `where` keeps the gradient of the square root finite at 0.
    distance = torch.where(is_outside, torch.where(is_outside, squared_distance, 1.0).sqrt(), 0.0)
    extent = half[..., 0, :]
    separation = torch.maximum(points.amin(-2) - extent, -extent - points.amax(-2))
    return distance.amin(-1), separation.amax(-1)


def _strip_gap(points: Tensor, segment: Tensor, half: Tensor) -> Tensor:
    """Return the distance [...] of points [..., 2] outside strips about segments [..., 4]; negative inside.

    half: Half widths [..., 2] at the ends of the segments.
    """
    segment_start, direction = segment[..., :2], segment[..., 2:] - segment[..., :2]
    offset = points - segment_start
    fraction = ((offset * direction).sum(-1) / direction.square().sum(-1).clamp_min(1e-12)).clamp(0.0, 1.0)
    squared_distance = (offset - fraction[..., None] * direction).square().sum(-1)
    is_off_line = squared_distance > 0.0
    # The inner `where` keeps the gradient of the square root finite at 0.
    distance = torch.where(is_off_line, torch.where(is_off_line, squared_distance, 1.0).sqrt(), 0.0)
    return distance - (half[..., 0] + fraction * (half[..., 1] - half[..., 0]))
