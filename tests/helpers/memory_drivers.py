"""Drivers that look away for a while in each episode: one reads the clock, the others count steps of their own.

All of them drive alike from the start of an episode, so the one without a memory knows what the others must measure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ssad.core.driving import Observation
from ssad.core.types import F32, Bool, Controller, Episode

AWAY = (30, 50)  # steps in which it goes on as it is
_calls = {"all": 0}


class Clock:
    """Follows its lane and its leader; it looks away in certain steps, by the time that it observes."""

    name, controller = "clock", Controller.EXTERNAL

    def reset(self, episodes: Sequence[Episode]) -> None: ...

    def snapshot(self) -> Mapping[str, Any]:
        return {}

    def restore(self, states: Mapping[str, Any]) -> None: ...

    def looks_away(self, view: Observation) -> Bool:
        return away(np.round(np.asarray(view.time, float) / 0.1))

    def act(self, view: Observation) -> F32:
        x, y, speed, kind = (view.others[..., column] for column in (0, 1, 3, 6))
        gap = np.where((kind > 0) & (x > 0) & (np.abs(y) < 2), x, np.inf)
        nearest = gap.argmin(1)[:, None]
        gap, lead = np.take_along_axis(gap, nearest, 1)[:, 0], np.take_along_axis(speed, nearest, 1)[:, 0]
        wanted = np.minimum(view.target_speed, np.where(np.isfinite(gap), lead + 0.4 * (gap - 10.0), np.inf))
        push = np.where(self.looks_away(view), 0.05, np.clip(0.5 * (wanted - view.speed), -1.0, 1.0))
        steer = np.clip(np.arctan2(view.route[:, 6, 1], view.route[:, 6, 0]) * 1.5, -1, 1)
        return np.stack([np.maximum(push, 0.0), np.maximum(-push, 0.0), steer], 1).astype(np.float32)


class Hidden(Clock):
    """Counts its steps and tells nobody."""

    name = "hidden"
    snapshot = restore = None  # type: ignore[assignment]

    def reset(self, episodes: Sequence[Episode]) -> None:
        self.count = np.zeros(len(episodes), int)

    def looks_away(self, view: Observation) -> Bool:
        count = self.count[view.scene]
        self.count[view.scene] += 1
        return away(count)


class Saved(Hidden):
    """Saves and restores its count."""

    name = "saved"

    def snapshot(self) -> Mapping[str, Any]:
        return {"count": self.count}

    def restore(self, states: Mapping[str, Any]) -> None:
        self.count = states["count"]


class Forgetful(Saved):
    """Saves its count, and does not restore it."""

    name = "forgetful"

    def restore(self, states: Mapping[str, Any]) -> None: ...


class Undeclared(Hidden):
    """Says that it has no memory."""

    name = "undeclared"

    def snapshot(self) -> Mapping[str, Any]:
        return {}

    def restore(self, states: Mapping[str, Any]) -> None: ...


class Shared(Saved):
    """Has one count for all episodes, and restores that."""

    name = "shared"

    def restore(self, states: Mapping[str, Any]) -> None:
        self.count = np.full_like(states["count"], states["count"][0])


class Seeded(Clock):
    """Looks away in steps that it chooses at the start of each episode, and does not save which."""

    name = "seeded"

    def reset(self, episodes: Sequence[Episode]) -> None:
        self.phase = np.array([episode.seed % 5 for episode in episodes])

    def looks_away(self, view: Observation) -> Bool:
        return (np.round(np.asarray(view.time, float) / 0.1) + self.phase[view.scene]) % 5 == 0


class Dice(Clock):
    """Looks away by a generator of its own, which it does not save."""

    name = "dice"

    def reset(self, episodes: Sequence[Episode]) -> None:
        self.draws = np.random.default_rng(5)

    def looks_away(self, view: Observation) -> Bool:
        return self.draws.random(len(view.scene)) < 0.2


class Global(Clock):
    """Counts its calls in a variable of the module."""

    name = "global"

    def looks_away(self, view: Observation) -> Bool:
        _calls["all"] += 1
        return np.full(len(view.scene), _calls["all"] % 7 == 0)


class Rattled(Clock):
    """Brakes less after it has braked hard once, which few episodes show, and does not save that."""

    name = "rattled"

    def reset(self, episodes: Sequence[Episode]) -> None:
        self.rattled = np.zeros(len(episodes), bool)

    def act(self, view: Observation) -> F32:
        controls = super().act(view)
        controls[:, 1] *= np.where(self.rattled[view.scene], 0.5, 1.0)
        self.rattled[view.scene] |= controls[:, 1] > 0.9
        return controls


def away(step: Any) -> Bool:
    """Whether the driver looks away at a step."""
    return np.asarray((step >= AWAY[0]) & (step < AWAY[1]))
