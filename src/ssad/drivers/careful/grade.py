"""Avoidability of collisions: the same encounter again, with careful drivers in control once the danger exists."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from ssad.core.driving import Policies, Sensor
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Bool, Episode, EpisodeTrace
from ssad.core.visibility import is_visible
from ssad.drivers.careful.driver import REACH, Careful
from ssad.drivers.careful.limit import Evasions, Limit, WrongSideObserver, limit_of, manoeuvres
from ssad.drivers.careful.models import MODELS
from ssad.drivers.careful.replay import ReplayPlan, Takeover, run_replays
from ssad.metrics.criticality import ttc
from ssad.metrics.driving import first_contact
from ssad.world.world import World

Verdict = Literal["avoidable", "limit", "unavoidable"]
Drive = tuple[Episode, LaneGraph, EpisodeTrace]
"""What was driven, its town, and how."""
HORIZON = 4.0  # s: danger exists while both agents, at constant velocity, would touch within it
EARLIEST = 6.0  # s before the contact from which danger is searched
FLICKER = 3  # steps that a danger may be interrupted
SCENES = 1024  # scenes per world in the search over manoeuvres
AFTER = 5.0  # s after the contact without collision that count as staying clear


@dataclass(frozen=True)
class Grade:
    """Avoidability of the first collision of a drive.

    Attributes:
        verdict: `avoidable` (a careful model stays clear), `limit` (no model, but some manoeuvre does), `unavoidable`
            (nothing does).
        avoids: Short name of a careful model -> True if it stays clear.
        danger: s at which the danger begins and the models take over.
        contact: Time of the contact, s.
        agent: Index of the agent that was hit; -1: unknown.
        exact: True if the replay matches the recording bit by bit up to the takeover.
        limit: The kinematic limit.
    """

    verdict: Verdict
    avoids: Mapping[str, bool]
    danger: float
    contact: float
    agent: int
    exact: bool
    limit: Limit

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a record."""
        return asdict(self)

    def metrics(self) -> dict[str, float]:
        """Return the fields of `EpisodeMetrics` that the grade fills: 1 where the model stays clear."""
        fields = {f"avoided_by_{name}": float(is_clear) for name, is_clear in self.avoids.items()}
        return fields | {"avoided_by_limit": float(self.verdict != "unavoidable")}


class _ReplayObserver:
    """Observer of replays, one drive per scene: fidelity, trigger and visibility of the other agent.

    Attributes:
        seen, triggered, same: [B, T] of each scene and step; rows are as long as the longest drive.
    """

    def __init__(self, drives: Sequence[Drive], agents: Sequence[int]) -> None:
        self.agents, self.step = np.asarray(agents), 0
        self.poses = [np.stack([trace.x, trace.y, trace.yaw], -1) for _, _, trace in drives]
        shape = len(drives), max(map(len, self.poses))
        self.seen, self.triggered, self.same = np.zeros(shape, bool), np.zeros(shape, bool), np.ones(shape, bool)
        scripts = [
            agent > 0 and bool(episode.agents[agent].phases)
            for (episode, _, _), agent in zip(drives, agents, strict=True)
        ]
        self.scripted = np.array(scripts)

    def __call__(self, world: World) -> None:
        self.step += 1
        step = self.step
        if step >= self.same.shape[1]:
            return
        pose, rows = world.array("pose"), np.arange(world.batch)
        for scene, recorded in enumerate(self.poses):
            if step < len(recorded):
                scene_pose = pose[scene, : recorded.shape[1]]
                self.same[scene, step] = self.same[scene, step - 1] and bool((scene_pose == recorded[step]).all())
        self.triggered[:, step] = self.scripted & (world.array("phase")[rows, self.agents] > 0)
        is_observed = (self.agents > 0) & (world.ended() == 0)
        if is_observed.any():
            visible = is_visible(pose[:, 0, :2], world.truth(), REACH)
            self.seen[:, step] = is_observed & visible[rows, self.agents]


def danger_start(trace: EpisodeTrace, agent: int, contact: int, is_triggered: Bool, is_visible: Bool) -> int:
    """The step in which a danger begins that ends in a contact.

    It exists once the other is triggered (if it follows a script), or while both would touch within 4 s if they went
    straight on at their speeds, up to the contact without a break; and not before the other is in sight.

    Args:
        trace: The drive.
        agent: Index of the agent that was hit.
        contact: The step of the contact.
        is_triggered: [T] True once its script has begun.
        is_visible: [T] True where the ego sees it.

    Returns:
        A step from 6 s before the contact to the contact.
    """
    earliest = max(contact - round(EARLIEST / trace.dt), 0)
    if agent < 1:
        return earliest
    on_course = ttc(trace)[: contact + 1, agent - 1] <= HORIZON
    danger_step = earliest + conflict_start(on_course[earliest:])
    trigger_steps = np.flatnonzero(is_triggered[: contact + 1])
    if len(trigger_steps):
        danger_step = min(danger_step, int(trigger_steps[0]))
    danger_step = max(danger_step, earliest)
    visible_steps = np.flatnonzero(is_visible[danger_step:contact])
    return danger_step + int(visible_steps[0]) if len(visible_steps) else contact


def conflict_start(on_course: Bool) -> int:
    """Return the step since which two agents are on a collision course, up to the last one [T], the contact."""
    first_step, interruption = len(on_course) - 1, 0
    for step in range(len(on_course) - 2, -1, -1):
        if on_course[step]:
            first_step, interruption = step, 0
        else:
            interruption += 1
            if interruption > FLICKER:
                break
    return first_step


def grade_collision(
    episode: Episode,
    graph: LaneGraph,
    trace: EpisodeTrace,
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
) -> Grade:
    """Grade the first collision of one drive; see `grade_collisions`."""
    return grade_collisions([(episode, graph, trace)], device=device, policies=policies, sensors=sensors)[0]


def grade_collisions(
    drives: Sequence[Drive],
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
) -> list[Grade]:
    """Grade the first collision of each drive in the world, side by side; the same every time and in any company.

    The drive is played again from its recorded controls. At the moment that the danger begins, the ego is handed to
    each careful model, which keeps the speed that it finds (less in bends and for red lights) and knows only what it
    sees; and, from then on until the contact, to each manoeuvre of the search for the kinematic limit. Who touches
    nobody until 5 s after the contact stays clear. All others do what the episode says, and react to the ego as ever.

    Args:
        drives: What was driven, its ego as it was driven; its town; and how, which must hold a contact.
        device: Where the world computes.
        policies: Makes the drivers that the episodes name for others, as in `rollout`.
        sensors: What these ask for.

    Returns:
        The grades.

    Raises:
        ValueError: A drive has no contact.
    """
    if not drives:
        return []
    run_options: dict[str, Any] = {"device": device, "policies": policies, "sensors": sensors}
    encounters = _play_again(drives, run_options)
    limits = _limits(
        drives, [encounter.start for encounter in encounters], [encounter.end for encounter in encounters], run_options
    )
    grades = []
    for encounter, limit in zip(encounters, limits, strict=True):
        verdict: Verdict = "unavoidable" if limit.manoeuvre is None else "limit"
        if any(encounter.avoids.values()):
            verdict = "avoidable"
        grades.append(
            Grade(verdict, encounter.avoids, encounter.start, encounter.end, encounter.agent, encounter.is_exact, limit)
        )
    return grades


def careful_drivers_avoid(
    drives: Sequence[Drive],
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
) -> list[Mapping[str, bool]]:
    """Return for the first collision of each drive which careful models stay clear, by short name.

    As `grade_collisions`, without the kinematic limit, whose search takes most of the time.
    """
    if not drives:
        return []
    options: dict[str, Any] = {"device": device, "policies": policies, "sensors": sensors}
    return [encounter.avoids for encounter in _play_again(drives, options)]


@dataclass(frozen=True)
class _Encounter:
    """A collision, driven again by the careful models.

    Attributes:
        avoids: Short name of a careful model -> True if it stays clear.
        start: s at which the danger begins.
        end: s of the contact.
        agent: Index of the agent that was hit; -1: unknown.
        is_exact: As `Grade.exact`.
    """

    avoids: Mapping[str, bool]
    start: float
    end: float
    agent: int
    is_exact: bool


def _play_again(drives: Sequence[Drive], run_options: Mapping[str, Any]) -> list[_Encounter]:
    """Find out when the danger of each drive begins, and hand the ego to each careful model from then on."""
    contacts = [first_contact(trace) for _, _, trace in drives]
    contact_times = [step * trace.dt for (step, _), (_, _, trace) in zip(contacts, drives, strict=True)]
    no_takeover = Takeover(Careful(), math.inf)
    observer = _ReplayObserver(drives, [agent for _, agent in contacts])
    run_replays(
        [ReplayPlan(*drive, [no_takeover], end) for drive, end in zip(drives, contact_times, strict=True)],
        watch=observer,
        **run_options,
    )
    danger_steps = [
        danger_start(
            trace, agent, contact, observer.triggered[index, : len(trace.x)], observer.seen[index, : len(trace.x)]
        )
        for index, ((_, _, trace), (contact, agent)) in enumerate(zip(drives, contacts, strict=True))
    ]
    takeover_times = [begin * trace.dt for begin, (_, _, trace) in zip(danger_steps, drives, strict=True)]
    models = [Careful(name, keep_speed=True) for name in MODELS]
    collided = run_replays(
        [
            ReplayPlan(*drive, [Takeover(model, start) for model in models], end + AFTER)
            for drive, start, end in zip(drives, takeover_times, contact_times, strict=True)
        ],
        **run_options,
    )
    return [
        _Encounter(
            avoids={name: not bool(is_hit) for name, is_hit in zip(MODELS, model_hits, strict=True)},
            start=takeover_times[index],
            end=contact_times[index],
            agent=contacts[index][1],
            is_exact=bool(observer.same[index, danger_steps[index]]),
        )
        for index, model_hits in enumerate(collided)
    ]


def _limits(
    drives: Sequence[Drive], starts: Sequence[float], ends: Sequence[float], run_options: Mapping[str, Any]
) -> list[Limit]:
    """The kinematic limits, of as many drives side by side as fit into a world."""
    options_by_drive = [
        manoeuvres(drive[0], start, end) for drive, start, end in zip(drives, starts, ends, strict=True)
    ]
    limits: list[Limit] = []
    while len(limits) < len(drives):
        begin, cumulative_count = len(limits), np.cumsum([len(options) for options in options_by_drive[len(limits) :]])
        stop = begin + max(int((cumulative_count <= SCENES).sum()), 1)
        chunk = range(begin, stop)
        options = [manoeuvre for index in chunk for manoeuvre in options_by_drive[index]]
        evasions = Evasions(options)
        episodes = [drives[index][0] for index in chunk for _ in options_by_drive[index]]
        side_watch = WrongSideObserver(
            episodes,
            {drives[index][0].town: drives[index][1] for index in chunk},
            [manoeuvre.start for manoeuvre in options],
        )
        endings = [
            ReplayPlan(
                *drives[index],
                [Takeover(evasions, manoeuvre.start) for manoeuvre in options_by_drive[index]],
                ends[index] + AFTER,
            )
            for index in chunk
        ]
        hits = run_replays(endings, watch=side_watch, **run_options)
        left_road = np.split(side_watch.left, np.cumsum([len(collided) for collided in hits])[:-1])
        for index, collided, left_side in zip(chunk, hits, left_road, strict=True):
            limits.append(limit_of(options_by_drive[index], ~collided & ~left_side, contact=ends[index]))
    return limits
