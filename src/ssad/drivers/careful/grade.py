"""How avoidable was a collision? The same encounter again, with careful drivers at the wheel once the danger exists."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from ssad.core.driving import Policies, Sensor
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Bool, Episode, EpisodeTrace
from ssad.drivers.belief import in_sight
from ssad.drivers.careful.driver import REACH, Careful
from ssad.drivers.careful.limit import Limit, OwnSide, limit_of, manoeuvres, takeovers
from ssad.drivers.careful.models import MODELS
from ssad.drivers.careful.replay import Takeover, play
from ssad.metrics.criticality import ttc
from ssad.metrics.driving import first_contact
from ssad.world.world import World

Verdict = Literal["avoidable", "limit", "unavoidable"]
HORIZON = 4.0  # s: danger exists while both, going straight on at their speeds, would touch within it
EARLIEST = 6.0  # s before the contact that danger is looked for
FLICKER = 3  # steps that a danger may be gone for and yet be the same
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
    """Follows the replay: is it the recorded drive, when was the other triggered, when in sight?"""

    def __init__(self, episode: Episode, trace: EpisodeTrace, agent: int) -> None:
        self.trace, self.agent, self.step = trace, agent, 0
        count = len(trace.x)
        self.seen, self.triggered, self.same = np.zeros(count, bool), np.zeros(count, bool), np.ones(count, bool)
        scripted = agent > 0 and bool(episode.agents[agent].phases)
        self.scripted = scripted

    def __call__(self, world: World) -> None:
        self.step += 1
        k = self.step
        if k >= len(self.trace.x):
            return
        pose, n = world.array("pose")[0], len(self.trace.names)
        recorded = np.stack([self.trace.x[k], self.trace.y[k], self.trace.yaw[k]], 1)
        self.same[k] = self.same[k - 1] and bool((pose[:n] == recorded).all())
        if self.scripted:
            self.triggered[k] = world.array("phase")[0, self.agent] > 0
        if self.agent > 0 and world.ended()[0] == 0:
            belief = world.truth().rows([0])
            self.seen[k] = in_sight(pose[:1, :2], belief, REACH)[0, self.agent]


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
    begin, gap = contact, 0
    for k in range(contact - 1, earliest - 1, -1):
        if on_course[k]:
            begin, gap = k, 0
        else:
            gap += 1
            if gap > FLICKER:
                break
    started = np.flatnonzero(triggered[: contact + 1])
    if len(started):
        begin = min(begin, int(started[0]))
    begin = max(begin, earliest)
    sight = np.flatnonzero(seen[begin:contact])
    return begin + int(sight[0]) if len(sight) else contact


def grade_collision(
    episode: Episode,
    graph: LaneGraph,
    trace: EpisodeTrace,
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
) -> Grade:
    """Grade the first collision of a drive in the world; the same every time.

    The drive is played again from its recorded controls. At the moment that the danger begins, the ego is handed to
    each careful model, which keeps the speed that it finds (less in bends and for red lights) and knows only what it
    sees; and, from then on until the contact, to each manoeuvre of the search for the kinematic limit. Who touches
    nobody until 5 s after the contact stays clear. All others do what the episode says, and react to the ego as ever.

    Args:
        episode: What was driven; its ego as it was driven.
        graph: Its town.
        trace: How it was driven; it must hold a contact.
        device: Where the world computes.
        policies: Makes the drivers that the episode names for others, as in `rollout`.
        sensors: What these ask for.

    Returns:
        The grade.

    Raises:
        ValueError: The drive has no contact.
    """
    contact, agent = first_contact(trace)
    about: dict[str, Any] = {"device": device, "policies": policies, "sensors": sensors}
    end = contact * trace.dt
    watch = _Onlooker(episode, trace, agent)
    play(episode, graph, trace, takeovers=[Takeover(Careful(), math.inf)], until=end, watch=watch, **about)
    begin = danger_begins(trace, agent, contact, watch.triggered, watch.seen)
    start = begin * trace.dt
    careful = [Takeover(Careful(name, keep_speed=True), start) for name in MODELS]
    hit = play(episode, graph, trace, takeovers=careful, until=end + AFTER, **about)
    avoids = {name: not bool(hit[k]) for k, name in enumerate(MODELS)}
    options = manoeuvres(episode, start, end)
    side = OwnSide(episode, graph, [m.start for m in options])
    hit = play(episode, graph, trace, takeovers=takeovers(options), until=end + AFTER, watch=side, **about)
    limit = limit_of(options, ~hit & ~side.left, contact=end)
    verdict: Verdict = "unavoidable" if limit.manoeuvre is None else "limit"
    if any(avoids.values()):
        verdict = "avoidable"
    return Grade(verdict, avoids, start, end, agent, bool(watch.same[begin]), limit)
