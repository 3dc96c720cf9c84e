"""Tables of scripted agents: their phases, the conditions that start them, and where lateral phases lead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.triggers import EGO, PAIRS, PHASE_KINDS, all_phases, default_rule, reference_of, trigger_groups
from ssad.core.types import (
    AgentKind,
    Controller,
    Episode,
    EpisodeAgent,
    FollowingGap,
    LateralPhase,
    Phase,
    PhaseTrigger,
    Pose,
    Route,
)
from ssad.world.kernels.data import Edge, PhaseCondition, ScriptMotion, Scripts, SpeedProfile, SpeedShape, array_types
from ssad.world.models import MODELS

BEND = 0.01  # rad by which the heading of a route that bends changes
LATERAL_TIME = 3.0  # s of a lateral phase that says nothing else
MAX_OFF_PATH = 5.0  # m that a meeting point may be off the path of its agent
WORD = 32  # bits of a word of a condition's history
_MEASURES = ("straight", "road", "lateral")
_SIDES = {"behind": 1.0, "ahead": -1.0, "any": 0.0}


def script_motion(agent: EpisodeAgent) -> ScriptMotion:
    """Return the way in which the world moves an agent by its script.

    Agents with lateral phases move exactly along their route, and so do walkers on a route that bends: they do not
    steer. Walkers of natural traffic move as `ssad.world.kernels.walkers` says.
    """
    if agent.walk is not None:
        return ScriptMotion.WALK
    if not (agent.phases or agent.lateral or (agent.controller == Controller.SCRIPT and agent.speed > 0.0)):
        return ScriptMotion.NONE
    is_walker = agent.model in MODELS and MODELS[agent.model].kind == AgentKind.WALKER
    bends = agent.route is not None and len(agent.route.xy) > 1 and float(np.ptp(np.unwrap(agent.route.yaw))) > BEND
    return ScriptMotion.RAIL if agent.lateral or (is_walker and bends) else ScriptMotion.STEERED


class ScriptTables:
    """Builder of `Scripts` for a bank of episodes."""

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._rows: dict[str, list[Any]] = {name: [] for name in array_types(Scripts)}
        self._sizes: list[tuple[int, int]] = []
        self._is_scripted = False

    def add(self, episode: Episode, agent_rows: npt.NDArray[np.int32]) -> None:
        """Append the scripts of an episode.

        Args:
            episode: The episode.
            agent_rows: [A, 4] Written: row of `EpisodeArrays.script` of each agent.

        Raises:
            ConfigError: A phase refers to an agent or a phase that the episode does not have.
        """
        first = len(self._rows["motion"])
        self._rows["episode"].append((first, 0, len(self._rows["condition"]), 0))
        names: dict[str, int] = {EGO: 0}
        for index, agent in enumerate(episode.agents):
            names.setdefault(agent.name, index)
        phase_rows: dict[tuple[int, str], int] = {}
        row = 0
        for index, agent in enumerate(episode.agents):
            agent_rows[index] = row, len(agent.phases), len(agent.lateral), script_motion(agent)
            for phase in all_phases(agent):
                if phase.name:
                    phase_rows[index, phase.name] = row
                row += 1
        history = 0
        for index, agent in enumerate(episode.agents):
            label = f"episode {episode.key}: agent {agent.name}"
            lookup = _Lookup(label, index, agent.name, names, phase_rows)
            if agent.lateral and (agent.route is None or len(agent.route.xy) < 2):
                raise ConfigError(f"{label}: lateral phases need a route of at least two points")
            if len(agent.lateral_targets) != len(agent.lateral):
                raise ConfigError(f"{label}: {len(agent.lateral)} lateral phases, {len(agent.lateral_targets)} targets")
            for number, phase in enumerate(agent.phases):
                history = self._condition_rows(phase.when, lookup, agent_rows[index, 0] + number - 1, number, history)
                self._speed_row(phase, episode, index, lookup)
            for number, lateral in enumerate(agent.lateral):
                before = agent_rows[index, 0] + len(agent.phases) + number - 1
                history = self._condition_rows(lateral.when, lookup, before, number, history)
                self._lateral_row(lateral, agent, number)
        counts = len(self._rows["motion"]) - first, len(self._rows["condition"]) - self._rows["episode"][-1][2]
        self._rows["episode"][-1] = (first, counts[0], self._rows["episode"][-1][2], counts[1])
        self._sizes.append((row, history))
        self._is_scripted |= bool(agent_rows[:, 3].any())

    @property
    def sizes(self) -> tuple[int, int]:
        """Rows of phases and words of history that the widest episode needs; (0, 0): no agent is scripted."""
        if not self._is_scripted:
            return 0, 0
        return max(1, *(rows for rows, _ in self._sizes)), max(1, *(words for _, words in self._sizes))

    @property
    def episode_sizes(self) -> npt.NDArray[np.int32]:
        """Rows of phases and words of history of each episode, [E, 2]."""
        return np.array(self._sizes, np.int32)

    def _condition_rows(self, trigger: PhaseTrigger, lookup: _Lookup, before: int, number: int, history: int) -> int:
        """Append the groups and conditions of a phase; return the number of words of history used so far."""
        groups = trigger_groups(trigger)
        self._rows["begin"].append((len(self._rows["group"]), len(groups)))
        for group in groups:
            self._rows["group"].append((len(self._rows["condition"]), len(group)))
            for condition in group:
                history = self._condition_row(condition, lookup, before if number else -1, history)
        return history

    def _condition_row(self, condition: PhaseTrigger, lookup: _Lookup, before: int, history: int) -> int:
        kind = condition.kind
        agent = lookup.agent(condition.agent) if condition.agent else lookup.index
        reference, phase = -1, before
        if kind == "ego_distance":
            agent, reference = 0, condition.actor + 1
        elif kind == "ego_speed":
            agent = 0
        elif kind in PAIRS and condition.position is None:
            reference = lookup.agent(reference_of(condition, lookup.name))
        elif kind in PHASE_KINDS:
            phase = lookup.phase(agent, condition.phase)
        delay = round(condition.delay / self._dt)
        bits = delay + 2 if delay or condition.edge != "none" else 0
        words = -(-bits // WORD) + (kind == "standstill")
        rule = condition.rule or default_rule(kind)
        self._rows["condition"].append((PhaseCondition[kind.upper()], agent, reference, phase))
        self._rows["form"].append(
            (
                int(rule == "above"),
                Edge[condition.edge.upper()],
                int(condition.free_space),
                _MEASURES.index(condition.measure),
            )
        )
        self._rows["number"].append((condition.value, *(condition.position or (0.0, 0.0)), 0.0))
        self._rows["ring"].append((history, bits, delay))
        return history + words

    def _speed_row(self, phase: Phase, episode: Episode, index: int, lookup: _Lookup) -> None:
        agent = episode.agents[index]
        profile = SpeedProfile.LIMITED
        timing = 0.0
        reference = lookup.agent(phase.reference) if phase.reference else -1
        own_meeting: tuple[float, ...] = (0.0, 0.0, 0.0)
        other_meeting: tuple[float, ...] = (0.0, 0.0, 0.0)
        if phase.arrival is not None:
            profile = SpeedProfile.ARRIVAL
            reference = lookup.agent(phase.arrival.reference)
            own_meeting = meeting_point(agent, phase.arrival.point)
            other_meeting = meeting_point(episode.agents[reference], phase.arrival.reference_point)
        elif phase.gap is not None:
            profile = SpeedProfile.GAP
            reference = lookup.agent(phase.gap.reference)
            own_meeting, other_meeting = _gap_rows(phase.gap)
        elif phase.shape == "step":
            profile = SpeedProfile.STEP
        elif phase.duration is not None:
            profile, timing = SpeedProfile.DURATION, phase.duration
        elif phase.distance is not None:
            profile, timing = SpeedProfile.DISTANCE, phase.distance
        elif phase.shape != "linear" and phase.acceleration is not None:
            profile, timing = SpeedProfile.RATE, abs(phase.acceleration)
        acceleration = 0.0 if phase.acceleration is None else abs(phase.acceleration)
        speed = -1.0 if phase.speed is None else phase.speed
        self._rows["motion"].append((speed, acceleration, phase.jerk or 0.0, timing))
        flags = int(phase.factor) + 2 * int(phase.continuous) + 4 * int(phase.speed is not None)
        self._rows["course"].append((profile, SpeedShape[phase.shape.upper()], reference, flags))
        self._rows["anytime"].append(int(phase.anytime))
        self._rows["meeting"].append((*own_meeting, 0.0)[:4])
        self._rows["other_meeting"].append((*other_meeting, 0.0)[:4])

    def _lateral_row(self, phase: LateralPhase, agent: EpisodeAgent, number: int) -> None:
        profile, timing = SpeedProfile.DURATION, LATERAL_TIME
        if phase.shape == "step":
            profile = SpeedProfile.STEP
        elif phase.duration is not None:
            timing = phase.duration
        elif phase.distance is not None:
            profile, timing = SpeedProfile.DISTANCE, phase.distance
        elif phase.rate is not None:
            profile, timing = SpeedProfile.RATE, phase.rate
        targets = np.asarray(agent.lateral_targets[number], np.float32)
        self._rows["motion"].append((0.0, 0.0, 0.0, timing))
        self._rows["course"].append((profile, SpeedShape[phase.shape.upper()], len(self._rows["target"]), len(targets)))
        self._rows["anytime"].append(int(phase.anytime))
        self._rows["meeting"].append((0.0,) * 4)
        self._rows["other_meeting"].append((0.0,) * 4)
        self._rows["target"].extend(targets.tolist())

    def build(self, device: str) -> Scripts:
        """Return the tables on a device."""
        scripts = Scripts()
        for name, array_type in array_types(Scripts).items():
            rows = self._rows[name]
            width = getattr(array_type.dtype, "_length_", 1)
            values = np.array(rows, np.float64).reshape(-1, *((width,) if width > 1 else ()))
            if len(values) == 0:  # an array on a device needs a row
                values = np.zeros((1, *values.shape[1:]))
            setattr(scripts, name, wp.array(values, dtype=array_type.dtype, device=device))
        return scripts


def _gap_rows(gap: FollowingGap) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the rows of `Scripts.meeting` and `Scripts.other_meeting` of a gap."""
    limits = (gap.max_acceleration, gap.max_deceleration, gap.max_speed)
    return (
        (gap.distance, gap.time, _SIDES[gap.side], float(gap.free_space)),
        (*(limit or 0.0 for limit in limits), 0.0),
    )


@dataclass(frozen=True)
class _Lookup:
    """Names to which the conditions of an agent refer."""

    label: str
    index: int
    name: str
    names: dict[str, int]
    phases: dict[tuple[int, str], int]

    def agent(self, name: str) -> int:
        if name not in self.names:
            raise ConfigError(f"{self.label}: there is no agent '{name}'; there are: {', '.join(self.names)}")
        return self.names[name]

    def phase(self, agent: int, name: str) -> int:
        if (agent, name) not in self.phases:
            raise ConfigError(f"{self.label}: agent number {agent} has no phase '{name}'")
        return self.phases[agent, name]


def meeting_point(agent: EpisodeAgent, point: tuple[float, float]) -> tuple[float, float, float]:
    """Return x, y of a meeting point and its distance along the agent's route, m (-1: the agent has no route).

    Raises:
        ConfigError: The point is more than 5 m off the route.
    """
    if agent.route is None or len(agent.route.xy) < 2:
        return (*point, -1.0)
    along, off = along_route(agent.route, point)
    if abs(off) > MAX_OFF_PATH:
        raise ConfigError(
            f"agent {agent.name}: the meeting point ({point[0]:g}, {point[1]:g}) is {abs(off):.1f} m off its path;"
            " choose one on it"
        )
    return (*point, along)


def along_route(route: Route, point: tuple[float, float]) -> tuple[float, float]:
    """Return the distance along a route of the place nearest to a point, and the point's distance from it, m."""
    xy = route.xy.astype(np.float64)
    steps = np.diff(xy, axis=0)
    share = ((np.asarray(point) - xy[:-1]) * steps).sum(1) / np.maximum((steps**2).sum(1), 1e-12)
    share = np.clip(share, 0.0, 1.0)
    off = np.hypot(*(np.asarray(point) - xy[:-1] - share[:, None] * steps).T)
    nearest = int(off.argmin())
    return (nearest + float(share[nearest])) * route.spacing, float(off[nearest])


def straight_route(pose: Pose, length: float) -> Route:
    """Return the route straight ahead from a pose, sampled every metre."""
    along = np.arange(int(length) + 1, dtype=np.float64)
    xy = np.stack([pose.x + along * np.cos(pose.yaw), pose.y + along * np.sin(pose.yaw)], 1)
    count = len(xy)
    return Route(
        xy=xy.astype(np.float32),
        yaw=np.full(count, pose.yaw, np.float32),
        lane=np.full(count, -1, np.int32),
        speed_limit=np.full(count, 50.0, np.float32),
        width=np.full(count, 3.5, np.float32),
    )
