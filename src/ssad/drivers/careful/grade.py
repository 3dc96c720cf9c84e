"""How avoidable was a collision? The same encounter again, with careful drivers at the wheel once the danger exists."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from ssad.core.driving import Policies, Sensor
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Bool, Episode, EpisodeTrace
from ssad.drivers.belief import in_sight
from ssad.drivers.careful.driver import REACH, Careful
from ssad.drivers.careful.limit import Evasions, Limit, OwnSide, limit_of, manoeuvres
from ssad.drivers.careful.models import MODELS
from ssad.drivers.careful.replay import Ending, Takeover, play
from ssad.metrics.criticality import ttc
from ssad.metrics.driving import first_contact
from ssad.world.world import World

Verdict = Literal["avoidable", "limit", "unavoidable"]
Drive = tuple[Episode, LaneGraph, EpisodeTrace]
"""What was driven, its town, and how."""
HORIZON = 4.0  # s: danger exists while both, going straight on at their speeds, would touch within it
EARLIEST = 6.0  # s before the contact that danger is looked for
FLICKER = 3  # steps that a danger may be gone for and yet be the same
SCENES = 1024  # of one world, of those that try manoeuvres
AFTER = 5.0  # s after the contact that somebody must stay clear for


@dataclass(frozen=True)
class Grade:
    """How avoidable the first collision of a drive was.

    Attributes:
        verdict: `avoidable` (a careful model stays clear), `limit` (none does, but some manoeuvre), `unavoidable`
            (nothing that was tried).
        avoids: By the short name of a careful model: whether it stays clear.
        danger: s at which the danger begins, and the models take the wheel.
        contact: s of the contact.
        agent: Number of who was hit; -1: nobody known.
        exact: Whether the replay was the recorded drive to the bit, up to the takeover.
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
        """Plain data for a record."""
        return asdict(self)

    def metrics(self) -> dict[str, float]:
        """The fields of `EpisodeMetrics` that the grade fills: 1 for who stays clear."""
        fields = {f"avoided_by_{name}": float(fine) for name, fine in self.avoids.items()}
        return fields | {"avoided_by_limit": float(self.verdict != "unavoidable")}


class _Onlooker:
    """Follows replays, a scene each: is it the recorded drive, when was the other triggered, when in sight?

    Attributes:
        seen, triggered, same: [B, T] of each scene and step; rows are as long as the longest drive.
    """

    def __init__(self, drives: Sequence[Drive], agents: Sequence[int]) -> None:
        self.agents, self.step = np.asarray(agents), 0
        self.poses = [np.stack([t.x, t.y, t.yaw], -1) for _, _, t in drives]
        shape = len(drives), max(map(len, self.poses))
        self.seen, self.triggered, self.same = np.zeros(shape, bool), np.zeros(shape, bool), np.ones(shape, bool)
        scripts = [k > 0 and bool(one.agents[k].phases) for (one, _, _), k in zip(drives, agents, strict=True)]
        self.scripted = np.array(scripts)

    def __call__(self, world: World) -> None:
        self.step += 1
        k = self.step
        if k >= self.same.shape[1]:
            return
        pose, rows = world.array("pose"), np.arange(world.batch)
        for b, recorded in enumerate(self.poses):
            if k < len(recorded):
                here = pose[b, : recorded.shape[1]]
                self.same[b, k] = self.same[b, k - 1] and bool((here == recorded[k]).all())
        self.triggered[:, k] = self.scripted & (world.array("phase")[rows, self.agents] > 0)
        looks = (self.agents > 0) & (world.ended() == 0)
        if looks.any():
            sight = in_sight(pose[:, 0, :2], world.truth(), REACH)
            self.seen[:, k] = looks & sight[rows, self.agents]


def danger_begins(trace: EpisodeTrace, agent: int, contact: int, triggered: Bool, seen: Bool) -> int:
    """The step in which a danger begins that ends in a contact.

    It exists once the other is triggered (if it follows a script), or while both would touch within 4 s if they went
    straight on at their speeds, up to the contact without a break; and not before the other is in sight.

    Args:
        trace: The drive.
        agent: Who was hit.
        contact: The step of the contact.
        triggered: [T] whether its script has begun.
        seen: [T] whether the ego sees it.

    Returns:
        A step from 6 s before the contact to the contact.
    """
    earliest = max(contact - round(EARLIEST / trace.dt), 0)
    if agent < 1:
        return earliest
    on_course = ttc(trace)[: contact + 1, agent - 1] <= HORIZON
    begin = earliest + conflict_begins(on_course[earliest:])
    started = np.flatnonzero(triggered[: contact + 1])
    if len(started):
        begin = min(begin, int(started[0]))
    begin = max(begin, earliest)
    sight = np.flatnonzero(seen[begin:contact])
    return begin + int(sight[0]) if len(sight) else contact


def conflict_begins(on_course: Bool) -> int:
    """The step since which two have been on a course to touch, up to the last one [T], the contact."""
    begin, gap = len(on_course) - 1, 0
    for k in range(len(on_course) - 2, -1, -1):
        if on_course[k]:
            begin, gap = k, 0
        else:
            gap += 1
            if gap > FLICKER:
                break
    return begin


def grade_collision(
    episode: Episode,
    graph: LaneGraph,
    trace: EpisodeTrace,
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
) -> Grade:
    """Grade the first collision of a drive in the world; see `grade_collisions`."""
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
    about: dict[str, Any] = {"device": device, "policies": policies, "sensors": sensors}
    contacts = [first_contact(trace) for _, _, trace in drives]
    ends = [step * trace.dt for (step, _), (_, _, trace) in zip(contacts, drives, strict=True)]
    nobody = Takeover(Careful(), math.inf)
    watch = _Onlooker(drives, [agent for _, agent in contacts])
    play([Ending(*drive, [nobody], end) for drive, end in zip(drives, ends, strict=True)], watch=watch, **about)
    begins = [
        danger_begins(trace, agent, contact, watch.triggered[k, : len(trace.x)], watch.seen[k, : len(trace.x)])
        for k, ((_, _, trace), (contact, agent)) in enumerate(zip(drives, contacts, strict=True))
    ]
    starts = [begin * trace.dt for begin, (_, _, trace) in zip(begins, drives, strict=True)]
    models = [Careful(name, keep_speed=True) for name in MODELS]
    hits = play(
        [
            Ending(*drive, [Takeover(model, start) for model in models], end + AFTER)
            for drive, start, end in zip(drives, starts, ends, strict=True)
        ],
        **about,
    )
    limits = _limits(drives, starts, ends, about)
    grades = []
    for k, (hit, limit) in enumerate(zip(hits, limits, strict=True)):
        avoids = {name: not bool(touched) for name, touched in zip(MODELS, hit, strict=True)}
        verdict: Verdict = "unavoidable" if limit.manoeuvre is None else "limit"
        if any(avoids.values()):
            verdict = "avoidable"
        exact = bool(watch.same[k, begins[k]])
        grades.append(Grade(verdict, avoids, starts[k], ends[k], contacts[k][1], exact, limit))
    return grades


def _limits(
    drives: Sequence[Drive], starts: Sequence[float], ends: Sequence[float], about: Mapping[str, Any]
) -> list[Limit]:
    """The kinematic limits, of as many drives side by side as fit into a world."""
    tried = [manoeuvres(drive[0], start, end) for drive, start, end in zip(drives, starts, ends, strict=True)]
    found: list[Limit] = []
    while len(found) < len(drives):
        first, size = len(found), np.cumsum([len(options) for options in tried[len(found) :]])
        last = first + max(int((size <= SCENES).sum()), 1)
        part = range(first, last)
        options = [m for k in part for m in tried[k]]
        hand = Evasions(options)
        episodes = [drives[k][0] for k in part for _ in tried[k]]
        side = OwnSide(episodes, {drives[k][0].town: drives[k][1] for k in part}, [m.start for m in options])
        endings = [Ending(*drives[k], [Takeover(hand, m.start) for m in tried[k]], ends[k] + AFTER) for k in part]
        hits = play(endings, watch=side, **about)
        left = np.split(side.left, np.cumsum([len(hit) for hit in hits])[:-1])
        for k, hit, gone in zip(part, hits, left, strict=True):
            found.append(limit_of(tried[k], ~hit & ~gone, contact=ends[k]))
    return found
