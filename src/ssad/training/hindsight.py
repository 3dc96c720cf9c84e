"""Hindsight: could a careful driver have avoided the present contact with an adversary? For many scenes at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssad.core.driving import WorldState
from ssad.core.geometry import obb_distance, to_local
from ssad.core.types import F64, I32, Bool
from ssad.drivers.careful.driver import (
    EASY,
    PULL,
    RESPONSE,
    bend_speed,
    following_acceleration,
    is_coming,
    is_in_the_way,
    squared_bend_speeds,
)
from ssad.drivers.careful.encounter import Encounter
from ssad.drivers.careful.grade import AFTER, EARLIEST, HORIZON, conflict_start
from ssad.drivers.careful.models import CarefulModel, careful_model, initial_reaction, react
from ssad.drivers.careful.sight import BEHIND, Path, encounters_on_paths
from ssad.metrics.criticality import time_to_collision
from ssad.scenarios.dynamic.frozen import brake

ROUTE_POINTS = 120  # points of the ego's route, 1 m apart


class Hindsight:
    """Remembers the last 6 s of scenes, and plays them again with a careful driver at the wheel.

    It is `ssad.drivers.careful.grade` for two in an empty town: the careful driver takes over when the danger begins,
    goes on along the ego's route at the speed that it finds (less in bends), brakes as its model says, and follows the
    other once it has braked for it. The other does what it did, and from the contact on brakes to a stop straight
    ahead, as in a saved scenario. Whom else there is, red lights and what hides the other from sight are left out.
    """

    def __init__(self, scenes: int, agents: int, *, dt: float = 0.1, model: CarefulModel | None = None) -> None:
        """Start with an empty record.

        Args:
            scenes: Number of scenes.
            agents: Agents per scene.
            dt: Time between states, s.
            model: The careful driver; None: that of UN Regulation 157.
        """
        self.dt, self.model = dt, careful_model("reg157") if model is None else model
        rows = round(EARLIEST / dt) + 1
        self._motion = np.zeros((rows, scenes, agents, 4))  # x, y, yaw, speed; the last row is now
        self._point = np.zeros((rows, scenes), np.int64)  # of the ego's route
        self._known_steps = np.zeros(scenes, np.int64)

    def record(self, state: WorldState) -> None:
        """Record the state of a step."""
        for rows in (self._motion, self._point):
            rows[:-1] = rows[1:]
        self._motion[-1, ..., :3], self._motion[-1, ..., 3] = state.pose, state.speed
        self._point[-1] = state.progress[:, 0]
        self._known_steps += 1

    def forget(self, scenes: npt.ArrayLike) -> None:
        """Clear the record of restarted scenes."""
        self._known_steps[np.asarray(scenes)] = 0

    def is_avoidable(self, state: WorldState, agents: I32) -> Bool:
        """Return [N] True where the careful driver stays clear until 5 s after now.

        Args:
            state: The state recorded last.
            agents: [N, 2] scene and agent in contact with the ego.
        """
        scene, agent = agents.T
        danger_row = np.array([self._danger_row(state, *pair) for pair in agents.tolist()], np.int64)
        steps = np.arange(len(self._motion) + round(AFTER / self.dt))
        rows = danger_row[:, None] + steps
        last_row = len(self._motion) - 1
        time_since_now: F64 = np.asarray((rows - last_row) * self.dt, np.float64)
        # Rows after now do not exist yet: the last one is extrapolated.
        stopped_motion = _stopping(
            self._motion[np.minimum(rows, last_row), scene[:, None], agent[:, None]], time_since_now
        )
        ego_start = self._motion[danger_row, scene, 0]
        start_pose = ego_start[:, None, :3]
        first_point, point_count = np.moveaxis(state.route[scene, 0], -1, 0)
        route_point = np.maximum(self._point[danger_row, scene] - 2, 0)[:, None] + np.arange(ROUTE_POINTS)
        route = to_local(
            start_pose, state.roads.path[first_point[:, None] + np.minimum(route_point, point_count[:, None] - 1), :2]
        )
        path = Path(route)
        local_positions: F64 = np.asarray(to_local(start_pose, stopped_motion[..., :2]), np.float64)
        yaw = stopped_motion[..., 2] - ego_start[:, None, 2]
        other_size = np.broadcast_to(state.size[scene, agent][:, None].astype(np.float64), (*yaw.shape, 2))
        ego_size = state.size[scene, 0].astype(np.float64)
        speed = np.maximum(ego_start[:, 3], 0.0)
        encounter = encounters_on_paths(
            path,
            half_extent=0.5 * ego_size,
            places=local_positions,
            yaw=yaw,
            speed=stopped_motion[..., 3],
            size=other_size,
            own_speed=speed,
            own_accel=speed * 0.0,
        )
        ego_path = self._drive(path, squared_bend_speeds(route), encounter, 0.5 * ego_size[:, 0])
        ego = np.concatenate([ego_path, np.broadcast_to(ego_size[:, None], (*yaw.shape, 2))], -1)
        distance = obb_distance(ego, np.concatenate([local_positions, yaw[..., None], other_size], -1))
        return np.asarray(((distance > 0.0) | (rows > last_row + round(AFTER / self.dt))).all(1))

    def _danger_row(self, state: WorldState, scene: int, agent: int) -> int:
        """Return the row at which the danger begins."""
        first_row = max(len(self._motion) - int(self._known_steps[scene]), 0)
        motion = self._motion[first_row:, scene][:, [0, agent]]
        size = np.broadcast_to(state.size[scene, [0, agent]], (*motion.shape[:2], 2))
        boxes = np.concatenate([motion[..., :3], size], -1)
        velocity = motion[..., 3:] * np.stack([np.cos(motion[..., 2]), np.sin(motion[..., 2])], -1)
        on_course = time_to_collision(boxes[:, 0], boxes[:, 1], velocity[:, 0] - velocity[:, 1]) <= HORIZON
        return first_row + conflict_start(on_course)

    def _drive(self, path: Path, speed_caps: F64, encounter: Encounter, half_length: F64) -> F64:
        """Return the poses [N, T, 3] of the careful driver, which starts at the origin and keeps to its path.

        Args:
            path: The path.
            speed_caps: Speed limits by its bends.
            encounter: The other at each step, as if the driver stayed where it is.
            half_length: [N] half the length of its body, m.
        """
        speed = encounter.speed[:, 0]
        bend_positions = np.arange(speed_caps.shape[1]) - 1.0  # a driver sees its route from a metre ahead on
        kept_speed = np.maximum(speed, 1.0)
        arc_position, left, _ = (part[:, 0] for part in path.project(np.zeros((len(speed), 1, 2))))
        x, accel, memory, poses = np.zeros(len(speed)), np.zeros(len(speed)), initial_reaction(speed.shape), []
        follows = np.zeros(speed.shape, bool)
        for t in range(encounter.gap.shape[1]):
            lateral_offset = left * np.maximum(1.0 - x / 10.0, 0.0)
            poses.append(
                np.concatenate([path.at(arc_position + x, lateral_offset), path.heading(arc_position + x)[:, None]], 1)
            )
            current_values = {name: value[:, t] for name, value in vars(encounter).items()}
            current_encounter = Encounter(
                **current_values | {"speed": speed, "accel": accel, "gap": current_values["gap"] - x}
            )
            requested_accel, memory = react(self.model, current_encounter, memory, self.dt)
            follows |= memory.brake > 0.0
            bend_limit = bend_speed(speed_caps, bend_positions - (arc_position - BEHIND + x)[:, None])
            free_accel = np.clip((np.minimum(kept_speed, bend_limit) - speed) / RESPONSE, -2.0 * EASY, PULL)
            following = following_acceleration(self.model, current_encounter, follows)
            free_accel = np.minimum(free_accel, np.maximum(following, -EASY))
            free_accel = np.where(is_coming(current_encounter), np.minimum(free_accel, 0.0), free_accel)
            requested_accel = np.where(
                is_in_the_way(current_encounter, half_length) & (speed < 1.5),
                np.maximum(requested_accel, 2.0 * EASY),
                requested_accel,
            )
            next_speed = np.maximum(
                speed + np.where(requested_accel > 0.0, np.minimum(free_accel, -requested_accel), free_accel) * self.dt,
                0.0,
            )
            x, accel, speed = x + 0.5 * (speed + next_speed) * self.dt, (next_speed - speed) / self.dt, next_speed
        return np.stack(poses, 1)


def _stopping(motion: F64, delay: F64) -> F64:
    """Return rows [N, T, 4] of x, y, yaw and speed of an agent that brakes to a stop from `delay` = 0 s on."""
    x, y, yaw, speed = np.moveaxis(motion, -1, 0)
    distance, speed_left = brake(speed, delay)
    return np.stack([x + distance * np.cos(yaw), y + distance * np.sin(yaw), yaw, speed_left], -1)
